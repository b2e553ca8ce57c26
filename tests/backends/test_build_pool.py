# SPDX-License-Identifier: MIT
"""Compilers at work: side by side, counted, and gone with the process. The compilers are shell scripts."""

import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from sim_server.backends.build_pool import CompileError, Compilers, Job
from sim_server.service.compile_notice import CompileNotice, compile_notices

ROOT = Path(__file__).parents[2]
SCENE = """dt = 0.02
[effects]
gravity = true
[[object]]
name = "block"
mesh = { bar = [2, 2, 2], size = [1, 1, 1] }
[object.effects]
corotational = { young = 1e5, poisson = 0.3 }
fixed = { where = "X < 0.01" }
"""


def job(folder: Path, name: str, script: str) -> Job:
    """A compiler that runs the script in the folder; $2: the file it writes."""
    return Job(name, folder / f"{name}.so", ["sh", "-c", f"cd '{folder}'; {script}", "sh"])


def finish(compilers: Compilers, *jobs: Job) -> None:
    for one in jobs:
        compilers.begin(one)
    for one in jobs:
        compilers.finish(one.library)


def test_texts_are_compiled_side_by_side(tmp_path):
    """Each writes once the other has begun: one after another neither would."""
    wait = "touch {0}.begun; n=0; while ! [ -e {1}.begun ]; do sleep 0.01; n=$((n+1)); [ $n -lt 2000 ] || exit 1; done"
    a, b = (job(tmp_path, x, f'{wait.format(x, y)}; echo {x} > "$2"') for x, y in ("ab", "ba"))
    finish(Compilers(2), a, b)
    assert [one.library.read_text() for one in (a, b)] == ["a\n", "b\n"]


def test_no_more_compilers_run_than_there_are_cores(tmp_path):
    alone = 'mkdir busy || exit 1; sleep 0.02; rmdir busy; touch "$2"'
    jobs = [job(tmp_path, name, alone) for name in "abcde"]
    finish(Compilers(1), *jobs)
    assert all(one.library.exists() for one in jobs)


def test_a_text_asked_for_twice_is_compiled_once(tmp_path):
    compilers, one = Compilers(2), job(tmp_path, "a", 'echo x >> count; sleep 0.05; touch "$2"')
    compilers.begin(one)
    finish(compilers, one)
    assert (tmp_path / "count").read_text() == "x\n"


def test_what_a_compiler_says_is_shown_to_all_who_wait_and_it_may_be_tried_again(tmp_path):
    compilers = Compilers(2)
    bad = job(tmp_path, "a.cu", "echo 'error: nonsense' >&2; touch \"$2\"; exit 1")
    compilers.begin(bad)
    for _ in range(2):
        with pytest.raises(CompileError, match=r"a\.cu did not compile:\nsh -c [\s\S]*error: nonsense"):
            compilers.finish(bad.library)
    assert [path.suffix for path in tmp_path.iterdir()] == []  # neither a library nor half of one
    good = Job(bad.name, bad.library, job(tmp_path, "a.cu", 'touch "$2"').command)
    finish(compilers, good)
    assert good.library.exists()


def test_progress_counts_texts_until_nothing_is_left_to_do(tmp_path):
    compilers, seen = Compilers(1), []
    compilers.progress = lambda done, total: seen.append((done, total))
    finish(compilers, *(job(tmp_path, name, 'sleep 0.05; touch "$2"') for name in "abc"))
    assert sorted(set(seen)) == [(0, 3), (1, 3), (2, 3), (3, 3)] and seen == sorted(seen)
    seen.clear()
    finish(compilers, job(tmp_path, "d", 'sleep 0.05; touch "$2"'))
    assert set(seen) == {(0, 1), (1, 1)}


def test_progress_counts_what_was_done_before_anybody_waited(tmp_path):
    compilers, seen = Compilers(1), []
    compilers.begin(job(tmp_path, "a", 'touch "$2"'))
    deadline = time.monotonic() + 60
    while compilers.running:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    compilers.progress = lambda done, total: seen.append((done, total))
    finish(compilers, job(tmp_path, "b", 'sleep 0.05; touch "$2"'))
    assert set(seen) == {(1, 2), (2, 2)}


def test_what_nobody_has_waited_for_is_kept_at_the_end(tmp_path):
    compilers, one = Compilers(2), job(tmp_path, "a", 'touch "$2"')
    compilers.begin(one)
    deadline = time.monotonic() + 20
    while compilers.running:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    compilers.stop()
    assert one.library.exists()


def test_with_the_process_its_compilers_end(tmp_path):
    """They and what they have started, and their half-written libraries go."""
    script = f"echo $$ > '{tmp_path}/pid'; touch \"$2\"; sleep 600; true"
    code = (
        "import sys, time, pathlib; from sim_server.backends.build_pool import *\n"
        f"compilers.begin(Job('a', Path({str(tmp_path / 'a.so')!r}), ['sh', '-c', {script!r}, 'sh']))\n"
        f"while not list(pathlib.Path({str(tmp_path)!r}).glob('*.tmp')): time.sleep(0.01)\n"
        "sys.exit(3)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=60).returncode == 3
    group = int((tmp_path / "pid").read_text())
    deadline = time.monotonic() + 20  # the last of the group is taken up by init
    while alive(group) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not alive(group)
    assert [path.name for path in tmp_path.iterdir()] == ["pid"]


def alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_one_line_says_that_kernels_are_compiled_and_one_that_they_are(tmp_path):
    said: list[str] = []
    bars: list[list[tuple[int, int]]] = []
    now = [100.0]

    def bar(closing: ExitStack):
        bars.append([])
        closing.callback(said.append, "the bar is gone")
        return lambda done, total: bars[-1].append((done, total))

    notice = CompileNotice(said.append, bar, lambda: now[0])
    notice.end()
    assert said == [], "nothing was compiled"
    for done in range(4):
        notice.progress(done, 3)
        now[0] += 10
    begin = "compiling kernels for this machine, once: less than a minute"
    assert said == [begin, "the bar is gone", "compiled 3 kernel texts in 30 s"]
    assert bars == [[(0, 3), (1, 3), (2, 3), (3, 3)]]
    notice.end()
    assert len(said) == 3, "said once"
    notice.progress(1, 0)  # by a compiler that does not say how many there are
    now[0] += 5
    notice.progress(2, 0)
    now[0] += 60
    notice.end()
    assert said[3:] == [begin, "the bar is gone", "compiled 2 kernel texts in 5 s"]


def test_what_another_compiler_makes_counts_if_it_took_its_time(monkeypatch):
    said: list[str] = []
    now = iter([0.0, 0.01, 1.0, 9.0])
    monkeypatch.setattr("sim_server.backends.build_pool.time.monotonic", lambda: next(now))
    compilers = Compilers(1)
    compilers.progress = lambda done, total: said.append(f"{done} of {total}")
    with compilers.counted():
        pass  # from a cache
    with compilers.counted():
        pass
    assert said == ["1 of 0"]


def test_progress_is_told_within_and_not_after(tmp_path, capsys):
    compilers, said = Compilers(1), []
    with compile_notices(said.append, compilers):
        finish(compilers, job(tmp_path, "a", 'sleep 0.05; touch "$2"'))
    finish(compilers, job(tmp_path, "b", 'sleep 0.05; touch "$2"'))
    assert [line.split()[0] for line in said] == ["compiling", "compiled"]
    with pytest.raises(CompileError), compile_notices(said.append, compilers):
        finish(compilers, job(tmp_path, "c", "sleep 0.05; exit 1"))
    assert [line.split()[0] for line in said[2:]] == ["compiling"], "it has not been compiled"
    assert capsys.readouterr().err == ""  # stderr is no terminal: no bar


@pytest.mark.slow
def test_a_first_run_says_what_it_waits_for_and_a_second_does_not(tmp_path):
    """With a compiler that does not optimize, for time. Without an NVIDIA device neither says a word of GPUs."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "c++").write_text('#!/bin/sh\nexec g++ "$@" -O0\n')
    (tmp_path / "c++").chmod(0o755)
    environment = os.environ | {
        "WARPFACTOR_CACHE": str(tmp_path / "cache"), "CXX": str(tmp_path / "c++"), "CUDA_VISIBLE_DEVICES": ""
    }  # fmt: skip
    command = [sys.executable, "-m", "sim_server", str(tmp_path / "scene.toml"), "--steps", "2", "--free-run"]
    runs = []
    for _ in range(2):
        run = subprocess.run(
            [*command, "--listen", f"unixsock-stream/{tmp_path}/socket"], cwd=ROOT, env=environment,
            capture_output=True, text=True, timeout=100,
        )  # fmt: skip
        assert run.returncode == 0, run.stderr
        runs.append(run)
    first = runs[0].stdout.splitlines()
    assert first[0] == "sim-server: compiling kernels for this machine, once: less than a minute"
    assert first[1].startswith("sim-server: compiled ")
    texts = int(first[1].split()[2])
    assert texts == len(list((tmp_path / "cache").glob("*.so"))) >= 8, "begun together, told together"
    assert "compil" not in runs[1].stdout
    assert all(word not in run.stdout + run.stderr for run in runs for word in ("GPU", "CuPy", "CUDA"))
