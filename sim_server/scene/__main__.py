# SPDX-License-Identifier: MIT
"""Prints scenes as they are with defaults and overrides: `python -m sim_server.scene SCENE.toml [OVERRIDE]...`.

For programs that know nothing of scenes: JSON on one line; exit code 2 and a message if the scene cannot be read.
"""

import json
import sys

from sim_server.errors import InputError
from sim_server.scene import load


def main(path: str, *overrides: str) -> int:
    """Prints the scene; returns the exit code."""
    try:
        scene = load(path, overrides)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(json.dumps(scene.resolved()))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
