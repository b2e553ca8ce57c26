# SPDX-License-Identifier: MIT
"""CUDA graphs of the steps of a scene, and of what is launched between them."""

from collections.abc import Callable
from functools import partial

from sim_server.backends.gpu.copy_lists import ListedCopies
from sim_server.backends.gpu.cupy_types import Graph, Stream
from sim_server.backends.gpu.loop import GRAPH_STEPS, DeviceLoop
from sim_server.backends.gpu.step_records import StepRecords
from sim_server.backends.gpu.step_sequence import StepSequence

FEW = 16  # largest number of trials in a step without loops for which several steps are captured in one graph


class StepGraphs:
    """Captures the graphs of a scene, and keeps them.

    stream: of the steps. sequence: launches of a step
    writer: writes the records of a batch. copies: makes copies. loop: whose lists of both they read

    second_half: of a step whose assembly was launched without a graph; None: all that follows may be, too
    """

    def __init__(
        self, stream: Stream, sequence: StepSequence, writer: StepRecords, copies: ListedCopies, loop: DeviceLoop
    ):  # fmt: skip
        self._stream, self._sequence, self._writer, energies = stream, sequence, writer, sequence.energies
        self._kept: list[Graph] = []
        self._steps = [self._captured_steps(steps, begin) for begin in (False, True) for steps in GRAPH_STEPS]
        others = [energies.launch_balance, energies.launch_elastic]
        others += [sequence.assemble_matrix] if sequence.makes_matrix_apart else []
        self._others = [self.captured(launch) for launch in others]
        self._records = [self.captured(partial(self._end_batch, target)) for target in loop.targets]
        self._copies = [self.captured(partial(copies.launch, each)) for each in loop.copy_launches]
        self.second_half = self.captured(sequence.finish) if sequence.branches else None

    def give_to(self, loop: DeviceLoop) -> None:
        """Has a loop launch them."""
        steps = [handle(graph) if graph else 0 for graph in self._steps]
        records = [handle(graph) for graph in self._records]
        copies = [handle(graph) for graph in self._copies]
        loop.use_graphs(steps, records, copies, *(handle(graph) for graph in self._others))

    def captured(self, launch: Callable[[], None]) -> Graph:
        """Returns the graph of the work that `launch` appends to the stream; it is kept as long as this object."""
        with self._stream:
            self._stream.begin_capture()
            launch()
            self._kept.append(self._stream.end_capture())
        return self._kept[-1]

    def _captured_steps(self, steps: int, begin: bool) -> Graph | None:
        """Returns the graph of some steps; None: they are not captured together."""
        newton = self._sequence.newton
        many = newton is None or newton.loops or newton.rounds <= FEW
        return self.captured(partial(self._launch_steps, steps, begin)) if steps == 1 or many else None

    def _launch_steps(self, steps: int, begin: bool) -> None:
        """Appends steps to the stream. begin: with the kernel that writes the time at which the first one begins"""
        if begin:
            self._sequence.begin()
        for _ in range(steps):
            self._sequence.launch()

    def _end_batch(self, target: int) -> None:
        """Appends what ends a batch: the energy balance of its last step, the others' are part of the next step's first
        kernel, and the records."""
        self._sequence.energies.launch_balance()
        self._writer.launch(target)


def handle(graph: Graph) -> int:
    """Returns the driver's handle of a graph."""
    return int(graph.graphExec)
