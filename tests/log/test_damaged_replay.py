# SPDX-License-Identifier: MIT
"""Logs damaged anywhere, simulated again: repeated up to the damage, or refused in a sentence."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.records import Channel
from mcap.records import Message as McapMessage

from protocol import messages_pb2 as pb
from protocol.log_chunks import BadLog, ChunkFile
from sim_server.recording.mcap_file import McapFile
from sim_server.replay.log import Recording
from sim_server.replay.run import Replay
from tests.ports import free_endpoint
from tests.system.server_process import beam, run

STEPS, MUTATIONS = 20, 80
KINDS = {"scene": pb.Scene, "topology": pb.Topology, "step": pb.ObjectStep, "state": pb.State}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Iterator[bytes]:
    """A run by a server, in chunks of ten messages: channels are told in the first of them alone."""
    folder = tmp_path_factory.mktemp("run")
    scene = beam(folder, bar=(1, 1, 2))
    scene.write_text(scene.read_text().replace('"cholesky"', '"block_jacobi"'))
    end = ("--free-run", "--steps", str(STEPS), "--listen", free_endpoint(), "--device", "cpu")
    done = run("sim_server", str(scene), "--record", str(folder / "run.mcap"), *end)
    assert done.returncode == 0, done.stderr
    source, topics, count = ChunkFile.open(folder / "run.mcap"), {}, 0
    file = McapFile(folder / "small.mcap", "lz4", overwrite=True)
    for _, records in source.scan():
        for record in records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
                continue
            assert isinstance(record, McapMessage)
            topic = topics[record.channel_id]
            kind = KINDS[topic.split("/")[1]]
            file.write(topic, kind, record.log_time, record.publish_time, record.sequence, record.data)
            count += 1
            if count % 10 == 0:
                file.flush()
    source.close()
    file.finish({})
    yield (folder / "small.mcap").read_bytes()


def replayed(path: Path) -> tuple[int, list[str]]:
    """Steps that were repeated, all the same, and notes but for the one that other tests here compiled more kernels."""
    with Recording(path) as recording:
        found = Replay(recording).run()
        assert found.same, found.lines()
        return recording.steps, [note for note in found.notes if not note.startswith("another build")]


def chunks(log: bytes, folder: Path) -> list[int]:
    """Where the chunks of a log begin."""
    path = folder / "whole.mcap"
    path.write_bytes(log)
    file = ChunkFile.open(path)
    begins = [offset for offset, _ in file.scan()]
    file.close()
    return begins


def test_the_log_itself(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "whole.mcap"
    path.write_bytes(whole)
    assert replayed(path) == (STEPS, [])


def test_without_the_chunk_that_names_the_channels(whole: bytes, tmp_path: Path) -> None:
    """The messages behind it belong to no channel, and the scene is gone with it."""
    damaged = bytearray(whole)
    damaged[chunks(whole, tmp_path)[0] + 60] ^= 0xFF
    path = tmp_path / "headless.mcap"
    path.write_bytes(damaged)
    with pytest.raises(BadLog, match=r"headless\.mcap: the log holds no scene; its beginning is damaged"):
        Recording(path)
    done = run("sim_server.replay", str(path))
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) == 1 and "holds no scene" in done.stderr


def test_a_damaged_chunk_ends_the_replay_there(whole: bytes, tmp_path: Path) -> None:
    damaged = bytearray(whole)
    damaged[chunks(whole, tmp_path)[2] + 60] ^= 0xFF
    path = tmp_path / "gap.mcap"
    path.write_bytes(damaged)
    steps, notes = replayed(path)
    assert 5 < steps < STEPS and any("is damaged and left out" in note for note in notes)
    assert any(f"no record of object 'beam', step {steps + 1}: the replay ends before it" in note for note in notes)


def test_a_chunk_that_is_taken_for_something_else_is_missed(whole: bytes, tmp_path: Path) -> None:
    """Its type changed from CHUNK to MESSAGE_INDEX: skipped, and the messages counted at the end tell."""
    damaged = bytearray(whole)
    begin = chunks(whole, tmp_path)[-2]
    assert damaged[begin] == 6
    damaged[begin] = 7
    path = tmp_path / "skipped.mcap"
    path.write_bytes(damaged)
    steps, notes = replayed(path)
    assert steps < STEPS and any("messages were found" in note and "a block is damaged" in note for note in notes)


def test_a_length_beyond_all_numbers(whole: bytes, tmp_path: Path) -> None:
    """The bytes of a chunk, said to be 2^63 and more."""
    damaged = bytearray(whole)
    begin = chunks(whole, tmp_path)[2]
    damaged[begin + 9 + 8 + 8 + 8 + 4 + 4 + 3 + 7] = 0x80  # times, size, checksum, "lz4", highest byte of the length
    path = tmp_path / "long.mcap"
    path.write_bytes(damaged)
    steps, notes = replayed(path)
    assert 5 < steps < STEPS and any("is damaged and left out" in note for note in notes)


def test_damage_anywhere(whole: bytes, tmp_path: Path) -> None:
    """Bytes changed, zeroed, taken out, put in or cut off, by a fixed seed."""
    path, random, repeated = tmp_path / "damaged.mcap", np.random.default_rng(77), 0
    for _ in range(MUTATIONS):
        damaged, at, size = bytearray(whole), int(random.integers(8, len(whole))), int(random.integers(1, 200))
        match int(random.integers(5)):
            case 0:
                damaged[at] ^= 1 << int(random.integers(8))
            case 1:
                damaged[at : at + size] = bytes(size)
            case 2:
                del damaged[at : at + size]
            case 3:
                damaged[at:at] = random.bytes(size)
            case 4:
                del damaged[at:]
        path.write_bytes(damaged)
        try:
            steps, notes = replayed(path)
        except BadLog as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error)
        else:
            repeated += 1
            assert 0 < steps <= STEPS and (steps == STEPS or notes)
    assert MUTATIONS / 4 < repeated < MUTATIONS
