# SPDX-License-Identifier: MIT
"""Many short commands of one of our programs in one process: its start is what they take longest for."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
IN_TURN = """
import contextlib, importlib, io, json, sys, traceback
main = importlib.import_module(sys.argv[1] + ".__main__").main
for sys.argv[1:] in json.loads(sys.argv[2]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
            code = 0
        except SystemExit as ended:
            code = ended.code or 0
        except BaseException:
            traceback.print_exc()
            code = 1
    print(json.dumps([code, out.getvalue(), err.getvalue()]))
"""
Ended = tuple[int, str, str]


def in_turn(package: str, commands: Sequence[Sequence[str]]) -> dict[tuple[str, ...], Ended]:
    """Exit code, stdout and stderr of each command, by its arguments."""
    command = [sys.executable, "-c", IN_TURN, package, json.dumps([list(arguments) for arguments in commands])]
    environment = os.environ | {"COLUMNS": "160"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    ended = [tuple(json.loads(line)) for line in done.stdout.splitlines()]
    return dict(zip(map(tuple, commands), ended, strict=True))
