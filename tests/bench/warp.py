# SPDX-License-Identifier: MIT
"""The warp off, on and automatic: table 2 of Courtecuisse et al. 2010, and what `warp = "auto"` makes of its rows.

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

from sim_server.driver import Driver
from sim_server.engine import HELD
from tests.bench._paper_beam import CELLS, LOADS, MODELS, QUICK, Beam, Load, Model, calibrated
from tests.bench._paper_figures import CONDITION
from tests.bench._pieces import Limit, Merged, Piece, Row, arguments_of_pieces
from tests.bench._units import Unit, arguments_of_units, asked_for, chosen, measure
from tests.bench.report import Report, plots

TITLE = "The warp off, on and automatic"
KEYS = ("load", "model", "update")  # what tells rows apart

MODES: dict[str, Any] = {"off": False, "on": True, "auto": "auto"}
ALLOWED = 1.05  # of the better of on and off
SOLVER = {"preconditioner": "cholesky", "tolerance": 1e-6, "max_iterations": 20_000, "factor_precision": "float32"}
EXPLAINED = """\
The beams, loads and models of bench paper (3000 tetrahedra, condition number 1246, dt 30 ms, true residual 1e-6,
float32 Cholesky factors), each with the warp off, on and `"auto"`. *never*: one factor, of the first matrix (the
paper's precomputed); *every-N*: made within each N-th step; *lockstep-D*: taken up D steps after its matrix, the
deterministic twin of async. Iterations are means over all steps and repeat to the digit; ms are means of processor
time over the steps that made no factor, of each step the least of the rounds. *held*: steps that auto made without the
warp, trials among them. *turned*: mean angle of the nodes from where the factor was made, over steps [rad], with the
warp on."""


@dataclass
class Made:
    """One run: of each step, (k,). seconds: of processor time, of steps that made no factor."""

    iterations: NDArray[Any]
    seconds: NDArray[Any]
    held: NDArray[np.bool_]
    unconverged: int


def run(beam: Beam, load: Load, update: str, warp: Any, steps: int) -> Made:
    """Lockstep begins with the factor of the first matrix."""
    driver = Driver(beam.simulation(load, **SOLVER, update=update, warp=warp), counted=True)
    first = [driver.step_with_fresh_factors()] if driver.kind == "lockstep" else []
    r = np.concatenate([*first, driver.advance(steps - len(first))])
    steps_alone = r["factor_step"] != r["step"] - 1  # that made no factor
    return Made(r["iterations"], r["cpu"][steps_alone], r["warping"] & HELD > 0, int((r["status"] != 0).sum()))


def measured(beam: Beam, load: Load, update: str, steps: int, rounds: int) -> Row:
    """A row: the three modes taking turns in every round."""
    runs: dict[str, list[Made]] = {mode: [] for mode in MODES}
    for _ in range(rounds):
        for mode, warp in MODES.items():
            runs[mode].append(run(beam, load, update, warp, steps))
    row: Row = {"load": load.name, "model": beam.model.name, "update": update}
    iterations = {mode: float(made[0].iterations.mean()) for mode, made in runs.items()}
    least = {mode: np.min([m.seconds for m in made], axis=0) for mode, made in runs.items()}  # they do the same
    ms = {mode: 1e3 * float(seconds.mean()) for mode, seconds in least.items()}
    row |= iterations | {"auto / better": iterations["auto"] / min(iterations["on"], iterations["off"])}
    row |= {f"{mode} [ms]": value for mode, value in ms.items()}
    row |= {"auto / better [ms]": ms["auto"] / min(ms["on"], ms["off"])}
    row["held %"] = 100 * float(runs["auto"][0].held.mean())
    row["turned"] = _turned(beam, load, update, steps)
    row["unconverged"] = sum(made.unconverged for several in runs.values() for made in several)
    row["repeats"] = all(np.array_equal(m.iterations, made[0].iterations) for made in runs.values() for m in made)
    return row


def _turned(beam: Beam, load: Load, update: str, steps: int) -> float:
    """With frames that are noted, which they are only where auto may hold them; without holding any."""
    sim = beam.simulation(load, **SOLVER, update=update, warp="auto")
    driver = Driver(sim, counted=True)
    for track in driver.tracks:
        assert track.warping is not None
        track.warping.consider = lambda turned: None  # type: ignore[method-assign]
    found = []
    for _ in range(steps):
        driver.advance(1)
        if sim.engine.factor_step(0) >= 0:
            found.append(sim.system.turned(sim.world.bodies[0].nodes))
    return float(np.mean(found)) if found else 0.0


def picture(rows: list[Row]) -> Any:
    """Iterations of off and auto against those of on."""
    plt = plots()
    figure, axis = plt.subplots(figsize=(9, 0.28 * len(rows) + 1.6), layout="constrained")
    place = np.arange(len(rows))
    for mode, mark in (("off", "o"), ("auto", "D")):
        axis.plot([row[mode] / row["on"] for row in rows], place, mark, label=mode)
    axis.axvline(1, color="0.4", lw=1, label="on")
    axis.set(xscale="log", xlabel="iterations by those with the warp on", yticks=place)
    axis.set_yticklabels([f"{row['load']}, {row['model']}, {row['update']}" for row in rows], fontsize="small")
    axis.invert_yaxis()
    axis.grid(True, axis="x", which="both", alpha=0.3)
    axis.legend()
    return figure


def verdict(rows: list[Row]) -> str:
    """Where auto is within what it is allowed, and where not."""
    beyond = [row for row in rows if row["auto / better"] > ALLOWED]
    slower = [row for row in rows if row["auto / better [ms]"] > ALLOWED]
    off = [row for row in rows if row["off"] < row["on"]]
    names = "; ".join(f"{r['load']}, {r['model']}, {r['update']}: {r['auto / better']:.3f}" for r in beyond)
    return (
        f"The warp costs iterations in {len(off)} of {len(rows)} rows. Iterations of auto: at most "
        f"{max(r['auto / better'] for r in rows):.3f} times those of the better of on and off"
        + (f"; beyond {ALLOWED:g} in: {names}. " if beyond else ". ")
        + f"By processor time beyond {ALLOWED:g} in {len(slower)} rows (largest "
        f"{max(r['auto / better [ms]'] for r in rows):.3f}). Solves that did not reach the tolerance: "
        f"{sum(r['unconverged'] for r in rows)}. Iterations of all rounds alike: "
        f"{'yes' if all(r['repeats'] for r in rows) else 'NO'}."
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
    report.figure(picture(rows), "warp.png", "Iterations with the warp off and automatic, by those with it on.")
    report.table(rows, [key for key in rows[0] if key not in ("unconverged", "repeats")])
    report.data["rows"] = rows
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
