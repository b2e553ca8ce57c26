# SPDX-License-Identifier: MIT
"""The client in Rust: built from the schema as it stands here, it holds a beam of a real server by the spring's law."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from protocol.channels import PROTOCOL, SERVER_NAME
from tests.system.server_process import Stage, beam, until
from tests.system.test_replay_of_a_server import CPU

ROOT = Path(__file__).parents[2]
CRATE = ROOT / "clients" / "examples" / "rust"
OLDEST = (1, 85)  # rust-version of Cargo.toml
STIFFNESS = 1e4  # N/m, of the grab in main.rs
NO_NETWORK = re.compile(r"failed to download|failed to get|Could not resolve|Couldn't resolve|spurious network error")
FELT = re.compile(r"step (\d+) force (\S+) (\S+) (\S+) N at (\S+) (\S+) (\S+) m")


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path)
    yield made
    made.close()


def cargo(*arguments: str) -> "subprocess.CompletedProcess[str]":
    target = {"CARGO_TARGET_DIR": str(ROOT / "out" / "rust")} | os.environ
    return subprocess.run(["cargo", *arguments], cwd=CRATE, env=target, capture_output=True, text=True)


def built() -> Path:
    """Builds the client; returns the program. Skips the test where there is no compiler, or crates cannot be had."""
    if shutil.which("cargo") is None:
        pytest.skip("there is no cargo, which builds the client in Rust")
    found = cargo("--version").stdout.split()[1]
    if tuple(map(int, found.split(".")[:2])) < OLDEST:
        pytest.skip(f"cargo {found} is too old for the client in Rust")
    fetched = cargo("fetch", "--locked")
    if fetched.returncode and NO_NETWORK.search(fetched.stderr):
        pytest.skip(f"crates cannot be downloaded: {fetched.stderr.splitlines()[-1]}")
    result = cargo("build", "--locked")
    assert result.returncode == 0, fetched.stderr + result.stderr
    folder = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "out" / "rust"))
    return folder / "debug" / "warpfactor-client"


@pytest.mark.system
@pytest.mark.timeout(3600)  # a first build compiles all crates
def test_a_client_in_rust_feels_the_spring_of_its_grab(stage: Stage, tmp_path: Path) -> None:
    program = built()
    server = stage.server(beam(tmp_path), "--set", "effects.gravity.g=[0, 0, 0]", *CPU)
    with stage.client() as client:

        def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
            where = {**os.environ, "WARPFACTOR_CONNECT": stage.endpoint}
            return subprocess.run([str(program), *arguments], env=where, capture_output=True, text=True, timeout=60)

        done = run("beam", "0.05", "0.1", "0", "2")
        assert done.returncode == 0, done.stderr + server.output()
        first, *_, last = done.stdout.splitlines()
        assert first.startswith("grabbed beam at ") and last == "released"
        start = np.array(first.split()[3:6], float)
        felt = np.array([list(map(float, found)) for found in FELT.findall(done.stdout)])
        steps, force, point = felt[:, 0], felt[:, 1:4], felt[:, 4:7]
        assert len(steps) > 20 and (np.diff(steps) > 0).all()
        # Without gravity the force stays below its bound. The hand feels k (point - target): the target was on its
        # way, and never went back.
        way = point - force / STIFFNESS - start
        by = np.array([0.05, 0.1, 0])
        along = way @ by / (by @ by)
        np.testing.assert_allclose(way, along[:, None] * by, atol=1e-3)
        assert along[0] < 0.2 and along[-1] > 0.9 and (np.diff(along) > -0.01).all()
        until(lambda: not client.status(fresh=True).objects[0].last.interactions, "the grab has ended")
        wrong = run("nobody")
        assert wrong.returncode == 1 and "no object 'nobody'" in wrong.stderr
    assert run("beam", "0.1").returncode == 2


def test_its_numbers_are_those_of_the_protocol() -> None:
    text = (CRATE / "src" / "main.rs").read_text()
    assert f"const PROTOCOL: u32 = {PROTOCOL};" in text and f'const SERVER: &str = "{SERVER_NAME}";' in text
    manifest = (CRATE / "Cargo.toml").read_text()
    assert f'rust-version = "{OLDEST[0]}.{OLDEST[1]}"' in manifest
