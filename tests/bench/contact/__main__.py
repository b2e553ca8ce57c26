# SPDX-License-Identifier: MIT
"""Contact and friction: known answers, what it costs with which preconditioner, what passes do, and others beside it.

deploy/run bench contact                                    all of it, many minutes
deploy/run bench contact --device gpu --share 1/4 --out a   the first of four parts of what there is for a GPU
deploy/run bench contact --only "cost 540" hertz --out b    some of it
deploy/run bench contact --only peers --peer-python ~/peers/bin/python   pip install mujoco newton there
deploy/run bench contact --merge a/contact.json b/contact.json
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pathlib import Path

from tests.bench.contact import page
from tests.bench.contact.bodies import CELLS
from tests.bench.contact.units import KEYS, SIZES, units
from tests.bench.harness.main import Bench


def main() -> None:
    bench = Bench("contact", "Contact and friction", KEYS, page.write)
    parser = bench.options(__doc__, "'cost 3000, kappa 10'", list(CELLS), SIZES, "of cost")
    parser.add_argument("--peer-python", type=Path, help="a Python that has MuJoCo and Newton; without it they are out")
    o = parser.parse_args()
    sizes = SIZES[:1] if o.quick else tuple(o.sizes)
    bench.run(o, {"sizes": sizes}, lambda: units(o.device, sizes, o.quick, o.peer_python))


if __name__ == "__main__":
    main()
