# SPDX-License-Identifier: MIT
"""Gives hostile inputs to what reads them. What is not refused in words for users, or not right, raises."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from clients.errors import BadInput
from clients.log.obstacles import obstacle_frame_of, obstacle_of
from clients.log.reader import Log
from precond_worker.network.pool import read_need
from protocol import messages_pb2
from protocol.channels import MIB, check_name
from protocol.factor import FactorPattern, check_values
from protocol.refused import Refused
from protocol.validate import check_header, check_numbers, check_strings, parse
from sim_server.errors import InputError
from sim_server.mesh import check, read
from sim_server.mesh.surface import volumes
from sim_server.scene import load
from sim_server.service.commands import FAILED, Commands
from tests.sample_run import positions
from tests.scenes import bar, simulation

PATIENCE = 20  # s for one input, far above what any needs


class TooLong(BaseException):
    """An input that takes too long. No Exception, since readers take those for damaged input."""


@contextmanager
def in_time(seconds: int = PATIENCE) -> Iterator[None]:
    """Raises TooLong in what takes longer, between two steps of Python."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLong(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def scene(data: bytes, folder: Path) -> bool:
    path = folder / "fuzzed.toml"
    path.write_bytes(data)
    try:
        load(path)
    except InputError as error:
        assert str(error).strip(), "refused without a word"
        return False
    return True


def mesh(given: tuple[str, bytes], folder: Path) -> bool:
    path = folder / f"fuzzed{given[0]}"
    path.write_bytes(given[1])
    try:
        found = check(read(path))
    except InputError as error:
        assert path.name in str(error), str(error)
        return False
    assert np.isfinite(found.rest).all() and (volumes(found.rest, found.tets) > 0).all()
    assert found.tets.min() >= 0 and found.tets.max() < len(found.rest)
    return True


def log(data: bytes, folder: Path) -> bool:
    path = folder / "fuzzed.mcap"
    path.write_bytes(data)
    try:
        with Log(path) as opened:
            for name in opened.objects:
                for frame in opened.frames(name):
                    np.testing.assert_array_equal(frame.x, positions(frame.step))  # what is damaged is not believed
    except BadInput as error:
        assert path.name in str(error), str(error)
        return False
    return True


def commands() -> Commands:
    """Of a beam that may be touched, without a network."""
    sim = simulation(bar(young=1e5, fixed="X < 0.01", touch=True), dt=0.02)
    return Commands(sim, lambda interaction, time: None)


def wire(given: tuple[str, bytes], folder: Path) -> bool:
    """As the reader of each message does; a Command is carried out, and a step made with what it did."""
    name, data = given
    try:
        message = parse(getattr(messages_pb2, name), data, MIB)
        if "header" in message.DESCRIPTOR.fields_by_name:
            check_header(message)
        check_strings(message)
        check_numbers(message)
        _read(name, message, data)
    except Refused as refusal:
        assert str(refusal).isprintable(), "control characters"
        return False
    return True


def _read(name: str, message: Any, data: bytes) -> None:
    if name == "Need":
        read_need(data, {message.header.incarnation})
    elif name == "Obstacle":
        obstacle_of(message)
    elif name == "ObstaclePose":
        obstacle_frame_of(message)
    elif name == "FactorPattern":
        pattern = FactorPattern.from_message(message)
        check_values(np.ones(pattern.nonzeros, np.float32), pattern, None)
    elif name == "Command":
        check_name(message.client, "Command.client")
        there = commands()
        assert not there.carry_out(message).error.startswith(FAILED), "an error that no check foresees"
        there.carry_out(messages_pb2.Command(client="anna", verb="resume"))  # or the step would wait
        there.simulation.engine.run(1)
        assert np.isfinite(there.simulation.world.x).all(), "not finite"


TARGETS = {"scene": scene, "mesh": mesh, "log": log, "wire": wire}


def accepted(kind: str, given: Any, folder: Path) -> bool:
    """Returns True if an input is taken, False if it is refused in words; raises for anything else."""
    with in_time():
        return TARGETS[kind](given, folder)  # type: ignore[operator, no-any-return]
