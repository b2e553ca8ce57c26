# SPDX-License-Identifier: MIT
"""What a step by a Rosenbrock-W method costs and how exact it is: work against precision, age of the factor, stability.

deploy/run bench rosenbrock                                         all of it, on a CPU
deploy/run bench rosenbrock --device gpu --limit 500 --out a        on a GPU, as far as 500 s go
deploy/run bench rosenbrock --only "precision 3000" times --out b   some of it
deploy/run bench rosenbrock --merge a/rosenbrock.json b/rosenbrock.json
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tests.bench.harness.main import Bench
from tests.bench.rosenbrock import page
from tests.bench.rosenbrock.bars import CELLS
from tests.bench.rosenbrock.units import KEYS, SIZES, units

QUICK_SIZES = (162,)


def main() -> None:
    bench = Bench("rosenbrock", "A step without iterations", KEYS, page.write)
    parser = bench.options(__doc__, "'precision 3000, one E'", list(CELLS), SIZES, "of precision and times")
    parser.add_argument(
        "--rounds", type=int, default=1, help="of each run of precision; the least time of a step counts"
    )
    o = parser.parse_args()
    sizes, rounds = QUICK_SIZES if o.quick else tuple(o.sizes), max(1, o.rounds)
    bench.run(o, {"sizes": sizes, "rounds": o.rounds}, lambda: units(o.device, sizes, rounds, o.quick))


if __name__ == "__main__":
    main()
