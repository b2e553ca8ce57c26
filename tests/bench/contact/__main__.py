# SPDX-License-Identifier: MIT
"""Contact with obstacles, on a CPU: known answers, what it costs with which preconditioner, what passes do.

deploy/run bench contact                                    all of it, minutes
deploy/run bench contact --only "cost 540" hertz --out b    some of it
deploy/run bench contact --merge a/contact.json b/contact.json
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from typing import Any

from tests.bench.contact import page
from tests.bench.contact.bodies import CELLS
from tests.bench.contact.units import KEYS, SIZES, units
from tests.bench.harness.pieces import Limit, Merged, Piece, arguments_of_pieces
from tests.bench.harness.units import arguments_of_units, asked_for, chosen, measure

TITLE = "Contact and friction"


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", choices=list(CELLS), default=list(SIZES), help="of cost")
    arguments_of_units(parser, f"{', '.join(KEYS)}, 'cost 3000, kappa 10'")
    parser.add_argument("--quick", action="store_true", help="a small smoke run")
    arguments_of_pieces(parser)
    return parser.parse_args()


def main() -> None:
    o = options()
    if o.merge:
        merged = Merged("contact", TITLE, o.merge, o.out)
        page.write(merged, {name: merged.rows(name, keys) for name, keys in KEYS.items()})
        return
    sizes = SIZES[:1] if o.quick else tuple(o.sizes)
    arguments: dict[str, Any] = {"sizes": sizes} | ({"quick": True} if o.quick else {})
    report = Piece("contact", TITLE, arguments | asked_for(o), o.out, o.quick)
    page.write(report, measure(chosen(units(sizes, o.quick), o), Limit(o.limit), report))


if __name__ == "__main__":
    main()
