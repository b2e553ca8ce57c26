# SPDX-License-Identifier: MIT
"""What the page of bench paper says beside its tables: how they were measured, and what they should show."""

from typing import Any

from tests.bench.paper.beam import DAMPING, DENSITY, DT, LENGTH, LOADS, POISSON
from tests.bench.paper.tables import AHEAD, Setting

COLUMNS1 = ("tets", "condition", "factorize ms", "paper factorize ms", "latency", "iterations", "paper iterations",
            "step ms", "paper step ms", "steps to factorize", "paper steps to factorize", "own latency",
            "iterations at it", "step ms at it")  # fmt: skip
AIM2 = """\
async + warp or auto should be within 5 % of the fastest scheme of their row, with no more iterations than the paper's
async + warp."""
AIM5 = "Cholesky and incomplete Cholesky, asynchronous and warped, should stay within ten iterations."
COLUMNS5 = ("updated", "preconditioner", "iterations", "paper iterations", "most iterations", "invert ms",
            "paper invert ms", "solve ms", "paper solve ms", "total ms", "paper total ms")  # fmt: skip

COLUMNS_OF_PUBLISHING = ("tets", "steps", "iterations", "steps a matrix", "p50 ms", "p99 ms", "p99 / p50", "p50 off ms",
                         "p99 off ms", "p99 / p50 off", "publishing %", "publishing, CPU %", "of steps that publish %",
                         "the same, CPU %")  # fmt: skip
PUBLISHING = """\
The beams of table 1 under *{load}*, update = "async": a worker process on another core gets a matrix whenever the last
factor has come, the loop runs freely ({cores}). *off*: the same steps with the same factors, taken up at the same
steps, but nothing is copied or sent, and the worker is idle. They take turns, {stretch} steps each, in one process, and
take the same iterations step by step. *publishing*: median over all steps of the time of a step by that of its twin,
less one; *of steps that publish*: over those whose matrix went out. Times are wall clock, *CPU* of
the simulation thread. Publishing should cost a step at most 2 % (median), and p99 be at most 1.3 times p50."""

AUTOMATIC = """\
Corotational beams of the sizes of table 1, with the stiffness of table 2 (*one*) and with that of table 5, in bands.
update = "async" with one worker in virtual time that takes *latency* steps for an exact factor and fewer for an
incomplete one, by its operations; warp. ms: processor time of the simulation thread, of each step the least of the
rounds, mean over the steps, the first ones without a factor among them."""

COLUMNS_OF_POLICIES = ("update", "iterations", "most iterations", "factors", "step ms", "wait ms")
POLICIES = """\
The beam of table 2 under *{load}*, Cholesky with warp. *async* and *adaptive* with one worker in virtual time that
takes {latency} steps for a factor (a matrix is copied in the step after the last factor came); *adaptive* sends none
before the iterations lost to the factor in use have cost as much as a factorization, a byte moved counted like an
operation. *wait*: for factors made within the step."""

EXTRAPOLATIONS = """\
With build = "worker" the state that a matrix is made of costs nothing to change: positions go out as x + v t. Mean
iterations by t, under *{load}*, asynchronous with warp (lockstep), {steps} steps; *all of it*: t is the time from
the matrix to its factor, the latency."""

COLUMNS_OF_EXTRAPOLATIONS = ("beam", "latency", "as it is", "1 step", "2 steps", "all of it")


def explained(setting: Setting) -> tuple[str, ...]:
    return (
        f"""\
After Courtecuisse et al. 2010 (their machine: Core i7 at 3.07 GHz, four cores, GTX 480). A beam of {LENGTH:g} x 1 x 1
m, {DENSITY:g} kg/m3, held at one end, dt = {DT:g} s, Rayleigh damping {DAMPING:g} /s of the mass, Poisson's ratio
{POISSON:g} where the model has one. The stiffness is chosen so that A at rest (held nodes left out) has the paper's
condition number, by Lanczos on the assembled matrix. {setting.steps} steps from rest, loads put on at once. Each
solve ends at a true residual of {setting.tolerance:g} |b| and starts from the last step's solution where that
is better than zero (the paper states neither). Factors are exact Cholesky ones in float32.""",
        f"""\
*async* is lockstep-D here, its deterministic twin: the factor of the matrix of step t is used from step t + D to
t + 2 D - 1, the first step has the factor of its own matrix. D is {setting.latency} in tables 2 and 5, about what the
paper's table 1 says for 3000 tetrahedra. So iterations repeat to the digit (the rounds of this very run are
compared); the time of a factorization is not in the step, as it is made elsewhere. *precomputed*: the factor of the
first matrix for ever. *extrapolated*: build = "worker" with positions at most {AHEAD} steps ahead. Times
are of assembly, solve and integration, means over the steps, each the median of {setting.rounds} rounds in which the
schemes take turns. The paper's figures stand in brackets or in columns of their own.""",
    )


def loads() -> str:
    """The three of table 2."""
    what = "\n".join(f"- *{load.name}*: {load.what}" for load in LOADS)
    shown = (
        "The paper shows its three loads as pictures only (material, geometrical and both non-linearities). Ours, for "
        "a beam of 1 MPa and in proportion to the stiffness of others:"
    )
    return f"{shown}\n\n{what}"


def shown2(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line for each load and model: iterations and ms of each scheme, the paper's in brackets."""
    lines: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        line = lines.setdefault((row["load"], row["model"]), {"load": row["load"], "model": row["model"]})
        text = f"{row['iterations']:.2f}, {row['step ms']:.3g} ms"
        if "paper ms" in row:
            text += f" ({row['paper iterations']:.2f}, {row['paper ms']:.3g} ms)"
        line[row["scheme"]] = text
    return list(lines.values())
