# SPDX-License-Identifier: MIT
"""What deploy/run says while it sets a machine up, and what it leaves alone. Scripts play the commands."""

import os
import pty
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.system
SETUP = Path(__file__).parents[1] / "deploy" / "setup.sh"
SLOW = 'slow() { for name in a b c; do echo "Unpacking lib$name ..."; sleep 0.7; done; }'


def bash(script: str, path: Path | None = None, **kwargs: object) -> "subprocess.CompletedProcess[str]":
    """Runs a script that has read setup.sh; path: looked for commands before all others."""
    environment = os.environ | {"PATH": f"{path}:{os.environ['PATH']}" if path else os.environ["PATH"]}
    whole = f"set -euo pipefail\n. '{SETUP}'\nEVERY=1\n{script}"
    return subprocess.run(["bash", "-c", whole], text=True, env=environment, timeout=60, **kwargs)  # type: ignore[call-overload]


def test_a_command_that_takes_long_says_how_far_it_is(tmp_path):
    log = tmp_path / "log"
    found = bash(f"{SLOW}\nshown 'installing (apt-get)' {log} slow", capture_output=True)
    lines = found.stderr.splitlines()
    assert found.returncode == 0 and found.stdout == ""
    assert lines[0] == "deploy/run: installing (apt-get)"
    assert any(
        line.startswith("deploy/run: still installing (apt-get), ") and "Unpacking lib" in line for line in lines
    )
    assert lines[-1].startswith("deploy/run: installing (apt-get): done in ")
    assert log.read_text().count("Unpacking") == 3


def test_on_a_terminal_it_does_so_in_one_line(tmp_path):
    try:
        ours, theirs = pty.openpty()
    except OSError as error:  # a container without /dev/pts
        pytest.skip(f"no pseudo-terminals here: {error}")
    bash(f"{SLOW}\nshown 'installing (apt-get)' {tmp_path / 'log'} slow", stderr=theirs)
    os.close(theirs)
    said = os.read(ours, 100_000).decode()
    os.close(ours)
    assert "\r\x1b[Kdeploy/run: installing (apt-get), " in said and "Unpacking lib" in said
    assert said.count("\n") == 1 and said.rstrip().rpartition("\x1b[K")[2].startswith(
        "deploy/run: installing (apt-get): done"
    )


def test_a_command_that_fails_keeps_its_exit_code(tmp_path):
    found = bash(
        f"bad() {{ echo oops; return 3; }}\nshown trying {tmp_path / 'log'} bad || say code $?", capture_output=True
    )
    assert found.stderr.splitlines() == ["deploy/run: trying", "deploy/run: code 3"]


@pytest.mark.parametrize("user", [0, 1000])
def test_the_libraries_of_the_whole_machine_are_left_as_they_are(user, tmp_path):
    """Also by root: it says what would help."""
    commands = {
        "id": f"echo {user}",
        "update-alternatives": f"""echo "$*" >> {tmp_path}/calls
case $1 in
    --get-selections) echo "libblas.so.3-x86_64-linux-gnu manual /usr/lib/x86_64-linux-gnu/blas/libblas.so.3" ;;
    --query) echo "Value: /usr/lib/x86_64-linux-gnu/blas/libblas.so.3" ;;
esac""",
    }
    for name, script in commands.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)
    found = bash("check_blas", tmp_path, capture_output=True)
    (line,) = found.stderr.splitlines()
    assert "libblas.so.3-x86_64-linux-gnu is the slow reference library" in line
    assert line.endswith("sudo update-alternatives --auto libblas.so.3-x86_64-linux-gnu")
    calls = (tmp_path / "calls").read_text().splitlines()
    assert calls == ["--get-selections", "--query libblas.so.3-x86_64-linux-gnu"]
