# SPDX-License-Identifier: MIT
"""`python -m sim_server.replay LOG.mcap [--json]`: exit code 0 the same, 1 diverged, 2 a bad log, 130 on Ctrl-C."""

import argparse
import json
import logging
import os
import sys
from functools import partial


def main() -> int:
    """Repeats the run of a log and reports what differs; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim_server.replay", description="Run a log again and compare.")
    parser.add_argument("log", metavar="LOG.mcap", help="A run recorded by sim-server --record")
    parser.add_argument("--json", action="store_true", help="For programs")
    arguments = parser.parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as workers have it: factors are then the same bit by bit
    logging.basicConfig(level=logging.WARNING, format="replay: %(message)s")

    from protocol.log_chunks import BadLog
    from protocol.printable import printable
    from sim_server.backends.compiler import CompileError
    from sim_server.errors import DeviceLost, InputError
    from sim_server.replay.log import Recording
    from sim_server.replay.run import Replay
    from sim_server.service.compile_notice import compile_notices

    try:
        say = partial(print, "replay:", file=sys.stderr, flush=True)
        with Recording(arguments.log) as recording, compile_notices(say):
            found = Replay(recording).run()
    except (BadLog, InputError, CompileError, DeviceLost) as error:
        print(f"replay: {printable(str(error))}", file=sys.stderr)
        return 2
    if arguments.json:
        print(json.dumps(found.plain()))
    else:
        print("\n".join(map(printable, found.lines())))
    return 0 if found.same else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:  # also while it still imports
        sys.exit(130)
