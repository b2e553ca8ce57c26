# SPDX-License-Identifier: MIT
"""The command rerun-importer-warpfactor, by which rerun opens logs: it asks every executable on PATH of such a name.

Rerun passes the file and options, and reads a recording from stdout; the exit code NOT_OURS lets others try. It asks
for files whose suffix it does not know itself; it knows .mcap, and shows its messages without a picture of bodies.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from protocol.process.extras import missing_extra

NOT_OURS = 66
MAGIC = b"\x89MCAP0\r\n"


def main() -> None:
    """Writes a log as a recording to stdout. Exit codes: 0 done, 66 not a log of ours, 1 anything else."""
    parser = argparse.ArgumentParser(prog="rerun-importer-warpfactor", allow_abbrev=False, description=__doc__)
    parser.add_argument("file", type=Path, help="a log of sim-server, with any suffix")
    parser.add_argument("--application-id", default="warpfactor", help="of the recording")
    parser.add_argument("--recording-id", help="of the recording; by default one of its own")
    asked, _ = parser.parse_known_args()  # times and prefixes are for files that have none
    if not _is_ours(asked.file):
        sys.exit(NOT_OURS)
    try:
        _import(asked.file, asked.application_id, asked.recording_id)
    except Exception as error:
        print(f"rerun-importer-warpfactor: {missing_extra(error) or error}", file=sys.stderr)
        sys.exit(1)


def _is_ours(path: Path) -> bool:
    """Tells by the first bytes of a file, and reads more only of MCAP files: rerun waits for the answer."""
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return False
    except OSError:
        return False
    from protocol.log_chunks import BadLog
    from protocol.log_file import LogFile

    try:
        with LogFile.open(path) as file:
            next(file.messages(), None)
    except BadLog:
        return False
    return True


def _import(path: Path, application: str, recording: str | None) -> None:
    from clients.log.reader import Log
    from clients.viewer.view import write_recording

    with Log(path) as log:
        for note in log.notes:
            print(note, file=sys.stderr)
        write_recording(log, sys.stdout.buffer, application, recording)


if __name__ == "__main__":
    main()
