# SPDX-License-Identifier: MIT
"""What accuracy costs in time: errors of standard scenes by source, and work against precision along each axis.

deploy/run bench accuracy                                     all of it, many minutes
deploy/run bench accuracy --device gpu --share 1/4 --out a    the first of four parts of what there is for a GPU
deploy/run bench accuracy --only "points beam" sources --out b   some of it
deploy/run bench accuracy --only peers --peer-python ~/peers/bin/python   pip install mujoco newton pybullet there
deploy/run bench accuracy --merge a/accuracy.json b/accuracy.json
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pathlib import Path

from tests.bench.accuracy import page
from tests.bench.accuracy.units import KEYS, units
from tests.bench.harness.main import Bench


def main() -> None:
    bench = Bench("accuracy", "What accuracy costs in time", KEYS, page.write)
    parser = bench.options(__doc__, "'points beam' or sources")
    parser.add_argument("--rounds", type=int, default=1, help="of each point; medians count")
    parser.add_argument(
        "--peer-python", type=Path, help="a Python that has MuJoCo, Newton and PyBullet; without it they are out"
    )
    o = parser.parse_args()
    rounds = max(1, o.rounds)
    bench.run(o, {"rounds": rounds}, lambda: units(o.device, rounds, o.quick, o.peer_python))


if __name__ == "__main__":
    main()
