# SPDX-License-Identifier: MIT
"""The page of the GPU benchmark: tables out of the rows of one run or of several."""

from typing import Any

from tests.bench.gpu.figure import figure
from tests.bench.gpu.problem import AIMS, MATERIALS
from tests.bench.harness.report import Report

Row = dict[str, Any]
Data = dict[str, Any]
KEYS = {  # what tells rows of a section apart
    "steps": ("tets", "material", "beams", "settings", "gpu"),
    "others": ("tets", "material", "what", "settings", "gpu"),
    "served": ("tets", "material", "worker", "settings", "gpu"),
    "publishing": ("tets", "material", "matrices", "settings", "gpu"),
    "realtime": ("tets", "worker", "dt", "settings", "gpu"),
    "linearizations": ("tets", "tolerance", "linearizations", "needed", "settings", "gpu"),
    "trial": ("tets", "settings", "gpu"),
}

PROBLEM = (
    "Beams of 4 x 1 x 1 m, clamped at one end and let go from horizontal; linear corotational tetrahedra, Poisson "
    "0.45, 1000 kg/m3, Rayleigh damping of the mass 0.1, dt 30 ms. Homogeneous: E 1 MPa. Heterogeneous: 5 MPa times "
    "1 : 0.05 : 0.01 in three segments. Tolerance 1e-6, warp on. Rounds of 16 steps with a factor 1 to 16 steps old, "
    "of the last matrix of the round before; it is made between the rounds and no step waits for it (what that takes "
    "is told apart). Step times are those of single steps on the device; between: from one step to the next, and host "
    "CPU: time of the thread that launches them, both per step of a long run. Residual: |b - A y| / |b| of the last "
    "step of each round in float64 on the host, the largest; A, b and y as "
    "copied from the device."
)
AIMED = (
    "CG and block Jacobi: the whole step of ours without a factor, a few steps of every round. Direct: cuDSS, "
    "refactorization and solution in float64 alone, without assembly. The paper: Courtecuisse et al. 2010, GTX 480."
)
BATCHED = (
    "Eight kinds whose stiffness differs by a factor 2 in all; each beam has a matrix, a factor and a stop test of its "
    "own. Others: one step of each round."
)
BYTES = (
    "MB of a step counted from sizes and iterations, each array once per pass over it, over the bandwidth measured in "
    "its run: a floor for what does not stay in caches (smaller bodies do, and may be faster). Latency: in each "
    "iteration two sums and the phases of the factor's application wait for other thread blocks; each taken as the "
    "barrier measured."
)
OTHERS = (
    "Of the last matrix of a run. The first two are one application of the factor that ours applies once an "
    "iteration, made of the same matrix (their residual is that of one application); the others are whole solves "
    "without assembly. Prepared: analysis, or the inverse."
)
SERVED = (
    "Matrices and factors over shared memory, one worker, as fast as it goes; the beam is put back to its start every "
    "100 steps so that it keeps swinging. Residual: as the solver reports it."
)
IN_TIME = (
    "A server of its own with one worker process on the same GPU, over shared memory; homogeneous, in steps of 10 ms, "
    "in real time. First: from the first answer of the server until a step used a factor. Then, in the second half of "
    "the run: factors a second, their age, and the time from the beginning of the step whose matrix is factorized to "
    "the beginning of the first step with its factor (told in whole steps); steps. Answer: of a status query meanwhile."
)
SEARCHED = (
    "The same beam of stable Neo-Hookean material, dt 20 ms, E 1 MPa, with as many linearizations as the scene "
    "allows and as its steps need: to need all, the goal of Newton-Raphson is one that is never reached; to need "
    "one, any that is smaller than before. Tolerance: of each linear solve. Made: mean of a step. Of one: p50 over "
    "that of one linearization solved to 1e-6. Factors as above; the projection is clamp in all."
)
PUBLISHED = "In turns; the factor stays the same, what the worker (on the CPU) sends back is thrown away."


TRIED = (
    "Of the step that may have four linearizations, needs one and solves it to 1e-6, p50: what it takes to know that "
    "one is enough. Forces: what the kernels over elements and nodes of the first assembly take when they are launched "
    "once more. Loop: with it, less without it. The rest: the state at the end, its judgement, the way back. The last "
    "column: at best, if the next step got its forces for nothing, which it can where nothing changes in between."
)


def merged(parts: list[Data]) -> Data:
    """One set of rows of several runs; where two have the same row, that of the later one. device: of the last."""
    direct = [part["device"]["cuDSS"] for part in parts if part["device"]["cuDSS"] != "absent"]
    out: Data = {"device": parts[-1]["device"] | {"cuDSS": direct[-1] if direct else "absent"}}
    for section, names in KEYS.items():
        told = [
            _of_its_card(row, part["device"], section == "steps") for part in parts for row in part.get(section, [])
        ]
        rows = {tuple(row[n] for n in names): row for row in told}
        out[section] = [rows[key] for key in sorted(rows, key=_order)]
    return out


def _of_its_card(row: Row, device: Row, floors: bool) -> Row:
    """The row with its card, where it does not tell it yet; floors: with what floors of its time are counted from."""
    told = ("gpu", "copy TB/s", "barrier us") if floors else ("gpu",)
    return {name: device[name] for name in told} | row


def _order(key: tuple[Any, ...]) -> tuple[Any, ...]:
    """Homogeneous before heterogeneous, then as numbers and names go."""
    return tuple(MATERIALS.index(part) if part in MATERIALS else part for part in key)


def write(report: Report, data: Data) -> None:
    """Everything, in the order of interest."""
    report.data |= data
    usual = [row for row in data["steps"] if row["material"] == MATERIALS[0] and not row["settings"]]
    report.remember(usual, ("tets", "beams"), ("us p50", "iterations"))
    report.say(_device(data["device"]), PROBLEM)
    if data["steps"]:
        _steps(report, data)
    for section, title, words in (
        ("others", "Others on the same matrices", OTHERS), ("served", "With a worker process", SERVED),
        ("publishing", "Steps with and without matrices leaving the device", PUBLISHED),
        ("realtime", "In real time, with a worker process on the same GPU", IN_TIME),
    ):  # fmt: skip
        if data[section]:
            report.say(f"## {title}", words)
            report.table(data[section], _columns(data[section]))
    if data["linearizations"]:
        report.say("## Several linearizations", SEARCHED)
        rows = [_beside_one(row, data["linearizations"]) for row in data["linearizations"]]
        report.table(rows, _columns(rows))
    if data["trial"]:
        report.say(TRIED)
        report.table(data["trial"], _columns(data["trial"]))
    report.write()


def _beside_one(row: Row, rows: list[Row]) -> Row:
    same = [r for r in rows if all(r[k] == row[k] for k in ("tets", "settings", "gpu"))]
    one = [r["us p50"] for r in same if r["linearizations"] == 1 and r["tolerance"] == 1e-6]
    return {**row, "of one": row["us p50"] / one[0] if one else None}


def _columns(rows: list[Row]) -> list[str]:
    """Every key, in the order of their first appearance; the settings only where there are several."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    return [n for n in names if n != "settings" or any(row.get(n) for row in rows)]


def _device(device: Row) -> str:
    return (
        f"{device['gpu']}, {device['processors']} multiprocessors, driver {device['driver']}, CUDA {device['CUDA']}, "
        f"CuPy {device['cupy']}, cuDSS {device['cuDSS']}. Measured in this run: copy within its memory "
        f"{device['copy TB/s']:.3g} TB/s (read and written), barrier of all multiprocessors with a store before and a "
        f"dependent load after it {device['barrier us']:.3g} us."
    )


def _steps(report: Report, data: Data) -> None:
    rows, usual = data["steps"], [row for row in data["steps"] if not row["settings"]]
    more = ["settings"] if len(usual) < len(rows) else []
    aims = [_against(r, data) for r in usual if (r["beams"], r["tets"]) in AIMS and r["material"] == MATERIALS[0]]
    if aims:
        report.say("## Aims, homogeneous, us per step of all beams", AIMED)
        report.table(aims)
    columns = (
        "us p50", "us p99", "us max", "between us", "host CPU us", "solve us", "iterations", "most", "residual",
        "factor age", "oldest", "factor ms", "expansion ms", "library", "CG us", "CG iterations", "block Jacobi us",
        "block Jacobi iterations", "unconverged",
        *(c for c in ("by factor %", "by iterate %", "by euler %", "estimate m") if any(c in r for r in rows)),
    )  # fmt: skip
    if single := [r for r in rows if r["beams"] == 1]:
        report.say("## One beam")
        report.table(single, ["tets", "material", "gpu", *more, *columns])
        figure(report, [r for r in single if not r["settings"]], data["others"])
    if batches := [{**r, "beam steps/s": 1e6 * r["beams"] / r["us p50"]} for r in rows if r["beams"] > 1]:
        report.say("## Many beams in the same launches", BATCHED)
        report.table(batches, ["beams", "tets", "gpu", *more, "beam steps/s", *columns])
    report.say("## Bytes and latencies", BYTES)
    floors = [_floors(row) for row in rows]
    report.table(floors, _columns(floors))


def _against(row: Row, data: Data) -> Row:
    aim = AIMS[row["beams"], row["tets"]]
    name = f"{row['beams']} beams of {row['tets']:,}" if row["beams"] > 1 else f"{row['tets']:,} tets"
    direct = [
        r.get("us") for r in data["others"]
        if row["beams"] == 1 and r["what"] == DIRECT and all(r[k] == row[k] for k in ("tets", "material", "gpu"))
    ]  # fmt: skip
    return {
        "scene": name, "gpu": row["gpu"], "aim": aim.aim, "**ours, p50**": row["us p50"],
        "ours / aim": row["us p50"] / aim.aim, "p99": row["us p99"], "iterations": row["iterations"],
        "residual": row["residual"],
        "oldest factor": row["oldest"], "prototype": aim.prototype, "CG, same GPU": row.get("CG us"),
        "block Jacobi, same GPU": row.get("block Jacobi us"),
        "direct each step, same GPU": direct[0] if direct else None, "the paper": aim.paper,
    }  # fmt: skip


DIRECT = "cuDSS, float64"


def _floors(row: Row) -> Row:
    floor, phases = row["MB all"] / row["copy TB/s"], row.get("phases")
    latency = row["iterations"] * (phases + 2) * row["barrier us"] if phases else None
    return {
        **{k: row[k] for k in ("tets", "material", "beams", "gpu", "settings", "copy TB/s", "iterations")},
        **{f"MB {k}": row[f"MB {k}"] for k in ("matrix", "vectors", "factor", "assembly")},
        "all / bandwidth, us": floor, "phases": phases, "latency, us": latency, "us p50": row["us p50"],
        "p50 / bytes floor": row["us p50"] / floor,
        "p50 / sum of both": row["us p50"] / (floor + latency) if latency else None,
    }  # fmt: skip
