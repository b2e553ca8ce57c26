# SPDX-License-Identifier: MIT
"""The warp off and on: the rows of table 2 of Courtecuisse et al. 2010.

    deploy/run bench warp                                            all of it
    deploy/run bench warp --only "rows bend, springs" --limit 500 --out a
    deploy/run bench warp --share 3/12 --out 3                       the third of 12 processes that run at once
    deploy/run bench warp --merge a/warp.json 3/warp.json

Pieces that are made at once share the memory and the clock of the machine: iterations are the same, times may not be.
"""

import argparse
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.updates.driver import Driver
from tests.bench.harness.pieces import Limit, Merged, Piece, Row, arguments_of_pieces
from tests.bench.harness.report import Report, plots
from tests.bench.harness.units import Unit, arguments_of_units, asked_for, chosen, measure
from tests.bench.paper.beam import CELLS, LOADS, MODELS, QUICK, Beam, Load, Model, calibrated
from tests.bench.paper.figures import CONDITION

TITLE = "The warp off and on"
KEYS = ("load", "model", "update")  # what tells rows apart

MODES = {"off": False, "on": True}
SOLVER = {"preconditioner": "cholesky", "tolerance": 1e-6, "max_iterations": 20_000, "factor_precision": "float32"}
EXPLAINED = """\
The beams, loads and models of bench paper (3000 tetrahedra, condition number 1246, dt 30 ms, true residual 1e-6,
float32 Cholesky factors), each with the warp off and on. *never*: one factor, of the first matrix (the
paper's precomputed); *every-N*: made within each N-th step; *lockstep-D*: taken up D steps after its matrix, the
deterministic twin of async. Iterations are means over all steps and repeat to the digit; ms are means of processor
time over the steps that made no factor, of each step the least of the rounds. *turned*: mean angle of the nodes from
where the factor was made, over steps [rad], with the warp on."""


@dataclass
class Made:
    """One run: of each step, (k,). seconds: of processor time, of steps that made no factor."""

    iterations: NDArray[Any]
    seconds: NDArray[Any]
    unconverged: int


def run(beam: Beam, load: Load, update: str, warp: bool, steps: int) -> Made:
    """Lockstep begins with the factor of the first matrix."""
    driver = Driver(beam.simulation(load, **SOLVER, update=update, warp=warp), counted=True)
    first = [driver.step_with_fresh_factors()] if driver.solver.update.kind == "lockstep" else []
    r = np.concatenate([*first, driver.advance(steps - len(first))])
    steps_alone = r["factor_step"] != r["step"] - 1  # that made no factor
    return Made(r["iterations"], r["cpu"][steps_alone], int((r["status"] != 0).sum()))


def measured(beam: Beam, load: Load, update: str, steps: int, rounds: int) -> Row:
    """A row: both modes taking turns in every round."""
    runs: dict[str, list[Made]] = {mode: [] for mode in MODES}
    for _ in range(rounds):
        for mode, warp in MODES.items():
            runs[mode].append(run(beam, load, update, warp, steps))
    row: Row = {"load": load.name, "model": beam.model.name, "update": update}
    iterations = {mode: float(made[0].iterations.mean()) for mode, made in runs.items()}
    least = {mode: np.min([m.seconds for m in made], axis=0) for mode, made in runs.items()}  # they do the same
    ms = {mode: 1e3 * float(seconds.mean()) for mode, seconds in least.items()}
    row |= iterations | {"on / off": iterations["on"] / iterations["off"]}
    row |= {f"{mode} [ms]": value for mode, value in ms.items()} | {"on / off [ms]": ms["on"] / ms["off"]}
    row["turned"] = _turned(beam, load, update, steps)
    row["unconverged"] = sum(made.unconverged for several in runs.values() for made in several)
    row["repeats"] = all(np.array_equal(m.iterations, made[0].iterations) for made in runs.values() for m in made)
    return row


def _turned(beam: Beam, load: Load, update: str, steps: int) -> float:
    """Mean over the steps that had a factor."""
    sim = beam.simulation(load, **SOLVER, update=update, warp=True)
    driver = Driver(sim, counted=True)
    frames, found = [], []  # frames: of every step
    for _ in range(steps):
        driver.advance(1)
        frames.append(sim.system.rotation.copy())
        if (made := sim.engine.factor_step(0)) >= 0:
            cosine = (np.einsum("nij,nij->n", frames[-1], frames[made]) - 1) / 2
            found.append(float(np.arccos(np.clip(cosine, -1, 1)).mean()))
    return float(np.mean(found)) if found else 0.0


def picture(rows: list[Row]) -> Any:
    """Iterations of off against those of on."""
    plt = plots()
    figure, axis = plt.subplots(figsize=(9, 0.28 * len(rows) + 1.6), layout="constrained")
    place = np.arange(len(rows))
    axis.plot([row["off"] / row["on"] for row in rows], place, "o", label="off")
    axis.axvline(1, color="0.4", lw=1, label="on")
    axis.set(xscale="log", xlabel="iterations by those with the warp on", yticks=place)
    axis.set_yticklabels([f"{row['load']}, {row['model']}, {row['update']}" for row in rows], fontsize="small")
    axis.invert_yaxis()
    axis.grid(True, axis="x", which="both", alpha=0.3)
    axis.legend()
    return figure


def verdict(rows: list[Row]) -> str:
    """Where the warp costs iterations or time, and how many at most."""
    dearer, slower = ([row for row in rows if row[ratio] > 1] for ratio in ("on / off", "on / off [ms]"))
    names = "; ".join(f"{r['load']}, {r['model']}, {r['update']}: {r['on / off']:.3f}" for r in dearer)
    return (
        f"The warp costs iterations in {len(dearer)} of {len(rows)} rows"
        + (f" (on / off in {names})" if dearer else "")
        + f", processor time in {len(slower)} (largest on / off {max(r['on / off [ms]'] for r in rows):.3f}). "
        f"Solves that did not reach the tolerance: {sum(r['unconverged'] for r in rows)}. "
        f"Iterations of all rounds alike: {'yes' if all(r['repeats'] for r in rows) else 'NO'}."
    )


def units(o: argparse.Namespace) -> list[Unit]:
    """A unit for each load and model."""
    cells = QUICK if o.quick else CELLS[3000]

    def rows(load: Load, model: Model) -> list[Row]:
        beam, _ = calibrated(cells, model, CONDITION)
        return [measured(beam, load, update, o.steps, o.rounds) for update in o.updates]

    models = MODELS[:2] if o.quick else MODELS
    return [Unit("rows", f"{load.name}, {m.name}", 60, partial(rows, load, m)) for m in models for load in LOADS]


def ordered(rows: list[Row]) -> list[Row]:
    """As a single run has them: pieces come in any order."""
    models, loads = [model.name for model in MODELS], [load.name for load in LOADS]
    return sorted(rows, key=lambda row: (models.index(row["model"]), loads.index(row["load"])))


def page(report: Report, rows: list[Row]) -> None:
    """Text, picture and JSON."""
    rows = ordered(rows)
    report.say(EXPLAINED, verdict(rows))
    report.figure(picture(rows), "warp.png", "Iterations with the warp off, by those with it on.")
    report.table(rows, [key for key in rows[0] if key not in ("unconverged", "repeats")])
    report.data["rows"] = rows
    report.remember([r for r in rows if r["model"] == MODELS[0].name], ("load", "update"), ("on", "on [ms]"))
    report.write()


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=150, help="of each run")
    parser.add_argument("--rounds", type=int, default=2, help="repetitions, the modes taking turns")
    parser.add_argument("--updates", type=lambda text: text.split(","), metavar="POLICY,POLICY",
                        default=["never", "every-30", "lockstep-3", "lockstep-10"], help="update policies")  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="a small smoke run")
    arguments_of_units(parser, "'rows bend, springs'")
    arguments_of_pieces(parser)
    o = parser.parse_args()
    if o.steps < 2 or o.rounds < 1:
        parser.error("allowed: --steps 2 or more, --rounds 1 or more")
    if o.quick:
        o.steps, o.rounds, o.updates = 30, 1, ["never", "lockstep-3"]
    return o


def main() -> None:
    o = options()
    if o.merge:
        merged = Merged("warp", TITLE, o.merge, o.out)
        page(merged, merged.rows("rows", KEYS))
        return
    wanted = chosen(units(o), o)
    arguments = {"steps": o.steps, "rounds": o.rounds, "updates": o.updates, **({"quick": True} if o.quick else {})}
    report = Piece("warp", TITLE, arguments | asked_for(o), o.out, o.quick)
    page(report, measure(wanted, Limit(o.limit), report)["rows"])


if __name__ == "__main__":
    main()
