# SPDX-License-Identifier: MIT
"""What the deformation models cost: force, tangent and assembly of a step, for every model, on a CPU and on a GPU.

Of each: the elements' kernel, the sums over elements at nodes and blocks, and the rest of a step up to the solve;
beside the bytes that these move over the bandwidth measured. And MJED against the same law by d2W/dF2 as a 9x9 matrix.
A run may be cut into pieces (--devices, --sizes, --models), whose results --merge makes into one page.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from pathlib import Path
from typing import Any

from sim_server.errors import DeviceError
from tests.bench.gpu.problem import BARS
from tests.bench.harness.pieces import Merged
from tests.bench.harness.report import Report, plots
from tests.bench.models import parts as models
from tests.bench.models import timing

SIZES = (3000, 24_000, 98_304)
DEVICES = ("cpu", "gpu")
PRECISIONS = ("float64", "mixed", "float32")
TITLE = "What the models cost"

Row = dict[str, Any]
Data = dict[str, Any]

SETUP = (
    "A beam of 4 x 1 x 1 m, dt 30 ms, constants of about the same stiffness, in two shapes: bent (curvature 0.15 / m, "
    "so half of it is pressed by up to 7.5 % and needs its tangent projected) and stretched by 5 %; nodes moved by "
    "another hundredth of an edge, velocities of 1 m/s at random. us: of the bent beam; elements: force and tangent of "
    "every element; sums: over elements at nodes and blocks; rest: start, rotations of nodes, A and b into the "
    "material frame. On a GPU sums and rest are one kernel for nodes and one for blocks, and stand together. CPU: one "
    "thread by its own clock, every kernel by itself, all in turn, the median; GPU: many calls in a graph."
)
BYTES = (
    "MB: arrays of the kernels, each once a kernel (also rows that a GPU keeps in registers); bytes: over the speed of "
    "a copy (read and written) measured in the same run; a floor for what does not stay in caches."
)
GENERIC = (
    "Elements' kernels alone, stretched, without projection; both texts compiled by the same compiler with the same "
    "flags, both leave the same numbers (difference: of the largest, between the two). 9x9: dW/dF and d2W/dF2 as 9 and "
    "81 numbers, then blocks by contraction with the gradients of the shape functions "
    "(tests/bench/models/generic_elements.cu). Six edges: those that MJED computes, the corners' own by translation; "
    "all blocks: as a stiffness matrix of 12x12 has them."
)


def measure(o: argparse.Namespace) -> Data:
    """Rows of all models, and of MJED against 9x9."""
    data: Data = {"devices": [], "models": [], "generic": []}
    laws = [law for law in timing.LAWS if law in o.models]
    for device in o.devices:
        speed = _described(device, data, o.quick)
        for tets in o.sizes:
            for precision in PRECISIONS if device == "gpu" else PRECISIONS[:1]:
                for name in o.models:
                    row = timing.row(name, tets, device, precision, o.seconds)
                    row["bytes us"] = 1e3 * row["MB"] / speed
                    data["models"].append(_said(row | {"us / bytes": row["us"] / row["bytes us"]}))
                data["generic"] += [_said(timing.generic_row(x, tets, device, precision, o.seconds)) for x in laws]
    return data


def _said(row: Row) -> Row:
    print({k: float(f"{v:.3g}") if isinstance(v, float) else v for k, v in row.items()}, flush=True)
    return row


def _described(device: str, data: Data, quick: bool) -> float:
    """GB/s of a copy; adds what the device is."""
    if device == "gpu":
        from tests.bench.gpu.device import described

        found = described()
        what, speed = f"{found['gpu']}, driver {found['driver']}, CUDA {found['CUDA']}", 1e3 * found["copy TB/s"]
    else:
        what, speed = "one thread", timing.copy_speed(32 if quick else 256)
    data["devices"].append({"device": device, "what": what, "copy GB/s": speed})
    return speed


def write(report: Report, data: Data) -> None:
    """The page."""
    report.data |= data
    largest = max(r["tets"] for r in data["models"])
    usual = [r for r in data["models"] if (r["tets"], r["precision"]) == (largest, "float64")]
    report.remember(usual, ("device", "tets", "model"), ("us",))
    report.say(SETUP, BYTES)
    report.table(data["devices"])
    if left_out := models.missing():
        report.say(f"Not measured, as this benchmark has no constants for them: {', '.join(left_out)}.")
    columns = (
        "model", "us", "elements us", "sums us", "rest us", "elements us, stretched", "MB", "bytes us", "us / bytes",
    )  # fmt: skip
    for device, precision in dict.fromkeys((r["device"], r["precision"]) for r in data["models"]):
        report.say(f"## {device.upper()}, {precision}")
        for tets in sorted({r["tets"] for r in data["models"]}):
            here = (device, precision, tets)
            rows = [r for r in data["models"] if (r["device"], r["precision"], r["tets"]) == here]
            if rows:
                report.say(f"{tets:,} tetrahedra:")
                report.table(rows, [c for c in columns if c != "rest us" or device == "cpu"])
    if data["generic"]:
        report.say("## MJED against 9x9", GENERIC)
        report.table(data["generic"])
    draw(report, data["models"])
    report.write()


def draw(report: Report, rows: list[Row]) -> None:
    """Time per element, by model, at the largest size."""
    plt = plots()
    tets = max(r["tets"] for r in rows)
    kinds = list(dict.fromkeys((r["device"], r["precision"]) for r in rows if r["tets"] == tets))
    names = list(dict.fromkeys(r["model"] for r in rows))
    figure, axes = plt.subplots(figsize=(8, 0.6 + 0.35 * len(names) * max(1, len(kinds) / 2)), layout="constrained")
    for k, (device, precision) in enumerate(kinds):
        mine = {r["model"]: r for r in rows if (r["device"], r["precision"], r["tets"]) == (device, precision, tets)}
        places = [n + 0.8 * (k + 0.5) / len(kinds) for n in range(len(names))]
        lengths = [1e3 * mine[name]["us"] / tets if name in mine else 0 for name in names]
        axes.barh(places, lengths, 0.7 / len(kinds), label=f"{device}, {precision}")
    axes.set(
        yticks=[n + 0.4 for n in range(len(names))],
        yticklabels=names,
        xlabel="ns per element and step, up to the solve",
    )
    axes.invert_yaxis()
    if len({device for device, _ in kinds}) > 1:
        axes.set_xscale("log")
    axes.legend()
    report.figure(figure, "models.png", f"Force, tangent and assembly at {tets:,} tetrahedra")


KEYS = {
    "devices": ("device",), "models": ("device", "precision", "tets", "model"),
    "generic": ("device", "precision", "tets", "law"),
}  # fmt: skip


def merge(files: list[Path], out: Path | None) -> None:
    """One page of the results of several runs; where two have the same row, that of the later one."""
    merged = Merged("models", TITLE, files, out)
    write(merged, {section: merged.rows(section, names) for section, names in KEYS.items()})


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--devices", nargs="+", choices=DEVICES, help="[default: those there are]")
    parser.add_argument("--sizes", type=int, nargs="+", choices=list(BARS), default=list(SIZES))
    parser.add_argument("--models", nargs="+", choices=models.present(), default=models.present())
    parser.add_argument("--seconds", type=float, default=2.0, help="about, for each model, size and precision")
    parser.add_argument("--quick", action="store_true", help="540 tets, a tenth of the time")
    parser.add_argument("--merge", type=Path, nargs="+", metavar="JSON", help="only make one page of these results")
    parser.add_argument("--out", type=Path)
    o = parser.parse_args()
    if o.quick:
        o.sizes, o.seconds = [540], 0.1 * o.seconds
    o.devices = o.devices or ["cpu", *(["gpu"] if _gpu() else [])]
    return o


def _gpu() -> bool:
    from sim_server.backends.gpu.device import cupy

    try:
        cupy()
    except DeviceError as error:
        print(f"bench models: on the CPU only ({error})", flush=True)
        return False
    return True


def main() -> None:
    o = options()
    if o.merge:
        merge(o.merge, o.out)
        return
    words = {k: getattr(o, k) for k in ("devices", "sizes", "models", "seconds")}
    report = Report("models", TITLE, words, o.out, o.quick)
    write(report, measure(o))


if __name__ == "__main__":
    main()
