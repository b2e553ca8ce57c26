# SPDX-License-Identifier: MIT
"""A run with a worker, pushes and a grab, recorded by real processes and repeated bit for bit from its log."""

import itertools
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.message import Message
from mcap.records import Channel
from mcap.records import Message as McapMessage

from clients.client import Client
from protocol import messages_pb2 as pb
from protocol.log_chunks import BadLog, ChunkFile
from sim_server.recording.mcap_file import McapFile
from sim_server.replay.log import Recording
from tests.system.link_helpers import PATIENCE
from tests.system.server_process import Stage, beam, fresh, run, until

pytestmark = pytest.mark.system

STEPS = 120
CPU = ("--device", "cpu")
TYPES: dict[str, type[Message]] = {
    "scene": pb.Scene, "topology": pb.Topology, "step": pb.ObjectStep, "state": pb.State,
    "interaction": pb.Interaction, "touch": pb.TouchSet, "factor": pb.FactorUse,
    "obstacle": pb.Obstacle, "pose": pb.ObstaclePose, "targets": pb.ObstacleTargets,
    "parameters": pb.ParameterSet,
}  # fmt: skip
Change = Callable[[Any], bool]  # of a message in place; False: leave it out


def push_and_grab(client: Client) -> None:
    """A push, a grab that is moved about, and a push during a pause.

    The last moves are each followed by a step, so that the loop takes up several sets at different steps, however slow
    client and server are.
    """
    client.push("beam", at=(0.5, 0.5, 4), force=(100, 0, 0), duration=0.3)
    with client.grab("beam", (1, 1, 4), stiffness=1e5, max_force=9000) as held:
        for k in range(25):
            held.move((1 + 0.02 * k, 1, 4))
            time.sleep(0.01)
        client.pause()
        for k in range(6):
            held.move((1.5, 1, 4 + 0.01 * k))
            client.step()
        client.push("beam", at=(0, 0, 3), force=(0, 90, 0), duration=0.1)
        client.resume()


def grab_often(client: Client) -> None:
    """Grabs that begin at odd moments and last a few steps."""
    for k in itertools.cycle(range(5)):
        if fresh(client).step > STEPS * 3 // 4:
            return
        with client.grab("beam", (1, 1, 4), target=(1.01, 1, 4), stiffness=1e5, max_force=9000):
            time.sleep(0.004 * k)
        time.sleep(0.02 + 0.003 * k)


def recorded(
    folder: Path, solver: str = "", preconditioner: str = "cholesky", *options: str,
    touch: Callable[[Client], None] = push_and_grab, effects: str = "", patience: float = PATIENCE,
) -> Path:  # fmt: skip
    """A log of a beam that is touched while a worker makes its factors, which is there from one of the first steps on.

    options: of the server [default: on the CPU]. effects: more lines of its table of effects. patience: s that it is
    waited for at most
    """
    stage, log = Stage(folder), folder / "run.mcap"
    scene = beam(folder, solver=solver)
    scene.write_text(scene.read_text().replace('"cholesky"', f'"{preconditioner}"') + effects)
    try:
        server = stage.server(scene, "--steps", str(STEPS), "--record", str(log), "--workers", "1", *(options or CPU))
        with stage.client() as client:
            client.pause()
            until(lambda: preconditioner == "none" or fresh(client).workers, "the worker has joined")
            client.step()  # in real time it waits for the first factor; all that a client does meanwhile would be one
            client.resume()
            touch(client)
        assert server.wait(patience) == 0, server.output()
    finally:
        stage.close()
    return log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    yield recorded(tmp_path_factory.mktemp("run"))


def messages(log: Path, kind: str) -> list[Any]:
    """All messages of a kind in the order of the file."""
    found: list[Any] = []
    copied(log, log.with_name("copy.mcap"), {kind: lambda m: found.append(m) or True})  # type: ignore[func-returns-value]
    return found


def copied(log: Path, to: Path, changes: dict[str, Change]) -> Path:
    """A copy of a log with messages changed."""
    source, topics = ChunkFile.open(log), {}
    file = McapFile(to, "lz4", overwrite=True)
    for _, records in source.scan():
        for record in records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
                continue
            assert isinstance(record, McapMessage)
            topic = topics[record.channel_id]
            kind = topic.split("/")[1]
            message = TYPES[kind].FromString(record.data)
            if changes.get(kind, lambda m: True)(message):
                file.write(
                    topic, TYPES[kind], record.log_time, record.publish_time, record.sequence,
                    message.SerializeToString(),
                )  # fmt: skip
    file.finish({})
    source.close()
    return to


def replayed(log: Path, code: int, timeout: float = PATIENCE) -> dict[str, Any]:
    """What `sim-client replay --simulate --json` says."""
    result = run("clients", "replay", str(log), "--simulate", "--json", timeout=timeout)
    assert result.returncode == code, result.stdout + result.stderr
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def test_the_same_bit_for_bit(log: Path) -> None:
    found = replayed(log, 0)
    assert found["same"] and found["first"] is None and found["other_factor"] is None and not found["notes"]
    assert (found["steps"], found["solves"], found["frames"]) == (STEPS, STEPS, STEPS + 1)
    factors = messages(log, "factor")
    assert len(factors) > 12 and all(f.library and f.threads == 1 and f.worker for f in factors)
    assert len({s.factor_step for s in messages(log, "step")}) > 12, "factors came from the worker all along"
    assert len(messages(log, "touch")) > 5 and messages(log, "touch")[-1].step > messages(log, "touch")[0].step
    told = run("clients", "replay", str(log), "--simulate")
    assert told.returncode == 0 and f"{STEPS} steps repeated, the same bit for bit" in told.stdout


def test_a_run_on_a_gpu_is_refused_where_there_is_none(log: Path, tmp_path: Path) -> None:
    def on_gpu(message: pb.Scene) -> bool:
        message.device, message.software = "gpu", "warpfactor 0, gpu, Python 3"
        return True

    moved = copied(log, tmp_path / "gpu.mcap", {"scene": on_gpu})
    result = run("clients", "replay", str(moved), "--simulate", CUDA_VISIBLE_DEVICES="")
    assert result.returncode == 2
    assert "gpu.mcap: recorded on a GPU" in result.stderr and "no GPU: " in result.stderr
    assert "Traceback" not in result.stderr


def test_another_push_is_told_with_its_step(log: Path, tmp_path: Path) -> None:
    """One force a little larger: the first step that differs is the one that it acts in first."""
    at = messages(log, "touch")[0].step

    def stronger(message: pb.TouchSet) -> bool:
        for i in message.interactions:
            i.force.x += 1e-6 if i.kind == "push" else 0
        return True

    found = replayed(copied(log, tmp_path / "other.mcap", {"touch": stronger}), 1)
    assert (found["first"]["step"], found["first"]["object"]) == (at + 1, "beam")
    assert 0 < found["largest"]["distance"] < 1e-3
    assert found["largest"]["step"] > at


def test_another_hand_over_is_told_with_its_step(log: Path, tmp_path: Path) -> None:
    """One solve said to have used an older factor than it did."""
    steps = {s.step: s for s in messages(log, "step")}
    made = sorted({s.factor_step for s in steps.values()})
    at = max((s for s in steps if steps[s].factor_step >= made[10]), key=lambda s: steps[s].iterations)
    older = made[made.index(steps[at].factor_step) - 8]

    def change(message: pb.ObjectStep) -> bool:
        if message.step == at:
            message.factor_step = older
        return True

    found = replayed(copied(log, tmp_path / "other.mcap", {"step": change}), 1)
    assert (found["first"]["step"], found["first"]["object"]) == (at, "beam")
    assert found["first"]["what"] == "solve" and "residual" in found["first"]["detail"]
    told = run("clients", "replay", str(tmp_path / "other.mcap"), "--simulate")
    assert told.returncode == 1 and f"diverged at step {at}, object 'beam'" in told.stdout


def test_another_factor_is_told(log: Path, tmp_path: Path) -> None:
    """The log says that the worker's factor was another one: a hint, and by itself no divergence."""
    factor = messages(log, "factor")[3]

    def change(message: pb.FactorUse) -> bool:
        message.checksum ^= message.step == factor.step
        return True

    found = replayed(copied(log, tmp_path / "other.mcap", {"factor": change}), 0)
    assert found["other_factor"]["step"] == factor.step and factor.worker in found["other_factor"]["detail"]


def test_logs_with_gaps_are_repeated_up_to_them(log: Path, tmp_path: Path) -> None:
    whole, cut = log.read_bytes(), tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 3 // 4])
    found = replayed(cut, 0)
    assert 10 < found["steps"] < STEPS and "without an end mark" in found["notes"][0]
    gap = copied(log, tmp_path / "gap.mcap", {"step": lambda m: m.step != 50})
    found = replayed(gap, 0)
    assert found["steps"] == 49 and "step 50" in found["notes"][-1]


def test_what_cannot_be_repeated_is_refused(log: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    refused: list[tuple[dict[str, Change], str]] = [
        ({"scene": lambda m: False}, "no scene"), ({"step": lambda m: False}, "no step"),
        ({"topology": lambda m: False}, "no mesh of beam"),
    ]  # fmt: skip
    for changes, told in refused:
        with pytest.raises(BadLog, match=told):
            Recording(copied(log, other, changes))
    result = run("clients", "replay", str(other), "--simulate")
    assert result.returncode == 2 and "no mesh of beam" in result.stderr and "Traceback" not in result.stderr
    assert run("clients", "replay", str(tmp_path / "none.mcap"), "--simulate").returncode == 2
    assert run("clients", "replay", str(log), "--simulate", "--loop").returncode == 2


def test_an_old_log_says_what_it_lacks(log: Path, tmp_path: Path) -> None:
    """Without the build, the interactions taken up and the factors' makers: read, compared, and said."""

    def old(message: pb.Scene) -> bool:
        message.device = message.build = message.server = ""
        return True

    changes: dict[str, Change] = {"scene": old, "touch": lambda m: False, "factor": lambda m: False}
    found = replayed(copied(log, tmp_path / "old.mcap", changes), 1)
    assert any("older version" in note for note in found["notes"])
    assert found["first"]["step"] == messages(log, "touch")[0].step + 1, "the pushes are missing"


@pytest.mark.parametrize("update", ["every-10", "lockstep-3"])
def test_other_policies(update: str, tmp_path: Path) -> None:
    assert replayed(recorded(tmp_path, f'update = "{update}"'), 0)["same"]


def test_the_automatic_preconditioner(tmp_path: Path) -> None:
    """Which solves probe and which factors are asked for is decided by the clock; the log holds it."""
    log = recorded(tmp_path, preconditioner="auto")
    assert replayed(log, 0)["same"]
    factors = messages(log, "factor")
    assert factors[0].method == "incomplete_cholesky" and factors[0].library == "native"
    assert {f.method for f in factors} <= {"incomplete_cholesky", "cholesky"}


def grab_and_await_factors(client: Client) -> None:
    """What comes after the grab is made of positions; for the first of these the worker imports and compiles, which may
    take longer than the run, so that the run stands meanwhile."""
    push_and_grab(client)
    for _ in range(4):
        until(lambda: fresh(client).objects[0].in_flight, "a job is under way")
        client.pause()
        until(lambda: not fresh(client).objects[0].in_flight, "it is over")
        client.resume()


def test_factors_of_positions_sent_ahead(tmp_path: Path) -> None:
    solver = 'build = "worker"\nextrapolate = 0.02'
    log = recorded(tmp_path, solver, touch=grab_and_await_factors, patience=2 * PATIENCE)
    assert replayed(log, 0)["same"]
    ahead = {f.ahead for f in messages(log, "factor")}
    assert 0.0 in ahead and max(ahead) > 0, "matrices while grabbed, positions otherwise"


def test_grabs_that_begin_while_positions_are_on_their_way(tmp_path: Path) -> None:
    """A factor of a step with a grab is made from the matrix, though positions were asked for before it began."""
    log = recorded(tmp_path, 'build = "worker"', touch=grab_often)
    begun = [t.step for t in messages(log, "touch") if any(i.kind == "grab" for i in t.interactions)]
    assert len(begun) > 5
    found = replayed(log, 0)
    assert found["same"] and found["other_factor"] is None


def test_factors_that_were_dropped(tmp_path: Path) -> None:
    """Few iterations and old factors without the warp: some are left again and again, and solves go on without."""
    log = recorded(tmp_path, 'update = "lockstep-25"\nmax_iterations = 20\nwarp = false\ntolerance = 1e-15')
    steps = messages(log, "step")
    assert sum(s.fallbacks for s in steps) >= 3
    assert any(s.preconditioner == "block_jacobi" and not s.asked and s.step > 60 for s in steps), "asked for as such"
    assert replayed(log, 0)["same"]


def test_solves_that_ran_out_of_time(tmp_path: Path) -> None:
    """Where a budget of wall time ended a solve is in its record."""
    log = recorded(tmp_path, "budget = 2e-5", "block_jacobi")
    assert any(s.status == pb.BUDGET for s in messages(log, "step"))
    assert replayed(log, 0)["same"]


@pytest.mark.parametrize("preconditioner", ["incomplete_cholesky", "ssor_factor", "ssor"])
def test_other_preconditioners(preconditioner: str, tmp_path: Path) -> None:
    """A worker's incomplete factors, each with a pattern of its own, are made again from the same matrices."""
    log = recorded(tmp_path, preconditioner=preconditioner)
    used = messages(log, "step")
    assert used[-1].preconditioner == preconditioner
    if preconditioner != "ssor":
        factors = messages(log, "factor")
        assert len({s.factor_step for s in used}) > 10
        assert all(f.library == "native" and not f.remedy for f in factors)
        assert (len({f.pattern for f in factors}) == 1) == (preconditioner == "ssor_factor")
    found = replayed(log, 0)
    assert found["same"] and not found["notes"] and found["other_factor"] is None


def test_several_linearizations_of_another_scheme(tmp_path: Path) -> None:
    """What a step begins with, each of its solves and the line search follow from the scene."""
    integrator = '\n[integrator]\nscheme = "bdf2"\nlinearizations = 5\ntolerance = 1e-8\n'
    log = recorded(tmp_path, integrator)
    assert any(s.linearizations > 1 and 0 < s.nonlinear_residual < 1e-6 for s in messages(log, "step"))
    assert replayed(log, 0)["same"]


def test_explicit_substeps_start_no_worker_and_are_repeated(tmp_path: Path) -> None:
    explicit = recorded(tmp_path, '[integrator]\nscheme = "central_difference"', "none")
    steps = messages(explicit, "step")
    assert all(s.substeps > 0 and s.iterations == 0 and not s.factor_age > 0 for s in steps)
    assert not messages(explicit, "factor") and len(messages(explicit, "touch")) > 5
    assert replayed(explicit, 0)["same"]
