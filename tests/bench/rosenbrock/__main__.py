# SPDX-License-Identifier: MIT
"""What a step by a Rosenbrock-W method costs and how exact it is: work against precision, age of the factor, stability.

deploy/run bench rosenbrock                                         all of it, on a CPU
deploy/run bench rosenbrock --device gpu --limit 500 --out a        on a GPU, as far as 500 s go
deploy/run bench rosenbrock --only "precision 3000" times --out b   some of it
deploy/run bench rosenbrock --merge a/rosenbrock.json b/rosenbrock.json
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from typing import Any

from tests.bench.harness.pieces import Limit, Merged, Piece, arguments_of_pieces
from tests.bench.harness.units import arguments_of_units, asked_for, chosen, measure
from tests.bench.rosenbrock import page
from tests.bench.rosenbrock.bars import CELLS
from tests.bench.rosenbrock.units import KEYS, SIZES, units

TITLE = "A step without iterations"
QUICK_SIZES = (162,)


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument(
        "--sizes", type=int, nargs="+", choices=list(CELLS), default=list(SIZES), help="of precision and times"
    )
    parser.add_argument(
        "--rounds", type=int, default=1, help="of each run of precision; the least time of a step counts"
    )
    arguments_of_units(parser, f"{', '.join(KEYS)}, 'precision 3000, one E'")
    parser.add_argument("--quick", action="store_true", help="a small smoke run")
    arguments_of_pieces(parser)
    return parser.parse_args()


def main() -> None:
    o = options()
    if o.merge:
        merged = Merged("rosenbrock", TITLE, o.merge, o.out)
        page.write(merged, {name: merged.rows(name, keys) for name, keys in KEYS.items()})
        return
    sizes = QUICK_SIZES if o.quick else tuple(o.sizes)
    arguments: dict[str, Any] = {"device": o.device, "sizes": sizes, "rounds": o.rounds} | (
        {"quick": True} if o.quick else {}
    )
    wanted = chosen(units(o.device, sizes, max(1, o.rounds), o.quick), o)
    report = Piece("rosenbrock", TITLE, arguments | asked_for(o), o.out, o.quick)
    page.write(report, measure(wanted, Limit(o.limit), report))


if __name__ == "__main__":
    main()
