# SPDX-License-Identifier: MIT
"""The command line of the worker."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from link_helpers import ROOT, process

from sim_server.network.link import ServerLink
from tests.ports import free_endpoint
from tests.support.commands import Ended, in_turn

pytestmark = pytest.mark.system


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "precond_worker", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_help_shows_examples() -> None:
    done = run("--help")
    assert done.returncode == 0
    for text in ("--connect", "--threads", "--name", "--server", "--no-shared-memory", "Examples", "tcp/10.0.0.5:7447"):
        assert text in done.stdout


BAD: list[tuple[list[str], str]] = [
    (["--connect", "nonsense"], "endpoint 'nonsense' cannot be used; allowed: PROTOCOL/HOST:PORT"),
    (["--connect", "tcp/127.0.0.1:99999"], "PORT 1 to 65535"),
    (["--name", "a/b"], "--name is 'a/b'; allowed: 1 to 64 characters"),
    (["--server", ""], "--server is ''; allowed"),
    (["--server", "a@nonsense"], "endpoint 'nonsense' cannot be used"),
    (["--server", "a", "--server", "a"], "--server a is given twice"),
    (["--threads", "0"], "--threads"),
    (["--threads", "many"], "--threads"),
    (["--nonsense"], "--nonsense"),
    (["--device", "tpu"], "--device tpu: allowed are auto, cpu, gpu"),
    (["--device", "gpu", "--precision", "float16"], "--precision float16: allowed are auto, float32, float64"),
    (["--device", "gpu", "--arithmetic", "float16"], "--arithmetic is called --precision now"),
    (["--device", "gpu", "--arithmetic", "float16"], "--precision float16: allowed are auto, float32"),
]


@pytest.fixture(scope="module")
def ended() -> dict[tuple[str, ...], Ended]:
    return in_turn("precond_worker", [arguments for arguments, _ in BAD])


@pytest.mark.parametrize(("arguments", "text"), BAD)
def test_bad_input_is_one_clear_message(ended: dict[tuple[str, ...], Ended], arguments: list[str], text: str) -> None:
    code, _, said = ended[tuple(arguments)]
    assert code == 2
    assert text in said and "Traceback" not in said


def test_bad_input_ends_the_process() -> None:
    assert run("--threads", "0").returncode == 2


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_it_waits_for_the_server_and_says_so_once_and_ends_when_told(number: signal.Signals, code: int) -> None:
    endpoint = free_endpoint()
    with process("-m", "precond_worker", "--connect", endpoint, "--name", "early", "--threads", "2") as child:
        assert child.stderr is not None and child.stdout is not None
        line = child.stderr.readline()
        assert f"cannot connect to {endpoint}: no answer; trying until the server is there" in line
        with ServerLink(listen=[endpoint]):
            assert "early ready: " in (ready := child.stdout.readline())
            assert ", 2 threads, " in ready
        assert "is gone, waiting for it" in child.stderr.readline()
        child.send_signal(number)
        out, err = child.communicate(timeout=30)
        assert child.returncode == code
        assert out == "" and err == ""


@pytest.mark.parametrize("compiler", ['exec g++ "$@" -O0', "exit 1"], ids=["with a compiler", "without"])
def test_it_compiles_before_a_server_waits_for_it(
    compiler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also a worker that cannot comes so far: CHOLMOD needs no compiler."""
    pytest.importorskip("sksparse.cholmod")
    compile_by(compiler, tmp_path, monkeypatch)
    monkeypatch.setenv("WARPFACTOR_FACTORIZATION", "cholmod")
    with process("-m", "precond_worker", "--connect", free_endpoint(), "--name", "early") as child:
        assert child.stderr is not None and "trying until the server is there" in child.stderr.readline()
        assert len(list((tmp_path / "cache").glob("incomplete-*.so"))) == (compiler != "exit 1")


def test_a_worker_that_can_make_no_factor_says_so_and_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compile_by("exit 1", tmp_path, monkeypatch)
    monkeypatch.setenv("WARPFACTOR_FACTORIZATION", "supernodal")
    done = run("--connect", free_endpoint())
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "complete factors need a C++ compiler" in done.stderr


def compile_by(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiler that runs `command` of the shell, and a cache without libraries."""
    (folder / "c++").write_text(f'#!/bin/sh\n[ "$1" != --version ] || exec g++ --version\n{command}\n')
    (folder / "c++").chmod(0o755)
    monkeypatch.setenv("CXX", str(folder / "c++"))
    monkeypatch.setenv("WARPFACTOR_CACHE", str(folder / "cache"))


def test_a_second_worker_of_one_name_is_told_and_leaves() -> None:
    endpoint = free_endpoint()
    arguments = ("-m", "precond_worker", "--connect", endpoint, "--name", "twin")
    with ServerLink(listen=[endpoint]), process(*arguments) as first:
        assert first.stdout is not None and "twin ready: " in first.stdout.readline()
        with process(*arguments) as second:
            out, err = second.communicate(timeout=30)
            assert (second.returncode, out) == (2, "")
            assert "another worker of server sim is called twin; --name" in err
        assert first.poll() is None


def test_of_two_of_one_name_that_join_at_the_same_instant_one_leaves() -> None:
    """Both wait for the server, find nobody of their name when it comes, and are told by one another's hello."""
    endpoint = free_endpoint()
    arguments = ("-m", "precond_worker", "--connect", endpoint, "--name", "twin")
    with process(*arguments) as one, process(*arguments) as other:
        for child in (one, other):
            assert child.stderr is not None and "trying until the server is there" in child.stderr.readline()
        with ServerLink(listen=[endpoint]) as link:
            end = time.monotonic() + 40
            while one.poll() is None and other.poll() is None:
                assert time.monotonic() < end, "both stay"
                time.sleep(0.05)
            left, stays = (one, other) if one.poll() is not None else (other, one)
            assert left.stderr is not None and left.returncode == 2
            assert "of server sim is called twin; --name gives this one its own" in left.stderr.read()
            while [worker.pid for worker in link.dispatch.workers()] != [stays.pid]:
                assert time.monotonic() < end, "the other one is not taken"
                time.sleep(0.05)
            assert stays.poll() is None


def test_it_ends_at_once_if_its_parent_is_another_one_by_now() -> None:
    """As when the parent dies before the child asks to be told."""
    with process("-m", "precond_worker", "--exit-with-parent", "--parent", "1", "--connect", free_endpoint()) as child:
        assert child.wait(40) == 0
        assert child.stdout is not None and child.stdout.read() == ""


def test_it_ends_with_its_parent() -> None:
    endpoint = free_endpoint()
    parent = (
        "import subprocess, sys, time\n"
        f"command = [sys.executable, '-m', 'precond_worker', '--connect', {endpoint!r}, '--exit-with-parent']\n"
        "worker = subprocess.Popen(command)\n"
        "print(worker.pid, flush=True)\n"
        "time.sleep(1000)\n"
    )
    with ServerLink(listen=[endpoint]), process("-c", parent) as child:
        assert child.stdout is not None
        assert int(child.stdout.readline()) > 0
        assert " ready: " in child.stdout.readline()
        os.kill(child.pid, signal.SIGKILL)
        # The pipe that both hold is at its end when the worker is gone too.
        assert child.stdout.read() == ""
