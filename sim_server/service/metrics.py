# SPDX-License-Identifier: MIT
"""Metrics of a server for Prometheus (docs/operations.md lists them).

Nothing is taken within a step: the service thread adds up the records that it reads from the loop anyway and keeps the
last status, which it makes once a second. A scrape, in a thread of its own, reads these and the network's counters.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)

from protocol import messages_pb2 as pb
from protocol.process.version import version
from sim_server.network.link import ServerLink
from sim_server.recording.recorder import Recorder

# s; 1, 2 and 5 of each decade: a step of 50 us is as well resolved as one of 20 s
BUCKETS = tuple(m * 10.0**e for e in range(-5, 2) for m in (1, 2, 5))
MOST_OBJECTS = 200  # with series of their own; those beyond share one
OTHERS = "(others)"
STATES = ("running", "paused", "stopping")

Row = tuple[list[str], float]


class ServerMetrics:
    """A collector of prometheus_client. objects: names in the order of bodies; lost: returns NeedMeter.lost"""

    def __init__(
        self, objects: list[str], link: ServerLink, recorder: Recorder | None, lost: Callable[[], float] = lambda: 0.0
    ):
        self.lost = lost
        self._names = [name if i < MOST_OBJECTS else OTHERS for i, name in enumerate(objects)]
        self._link, self._recorder = link, recorder
        self.status = pb.Status()
        # Replaced as a whole, so that a scrape sees numbers of one moment.
        self._times: tuple[NDArray[np.int64], float] = np.zeros(len(BUCKETS) + 1, np.int64), 0.0
        self._sums: NDArray[np.float64] = np.zeros((len(objects), 2))  # steps, iterations of each body

    def add(self, records: NDArray[Any]) -> None:
        """Adds step records (structs.RECORD)."""
        whole = records["whole"][records["body"] == 0]
        counts, total = self._times
        places = np.searchsorted(BUCKETS, whole)  # of the first bound that is not below
        self._times = counts + np.bincount(places, minlength=len(counts)), total + float(whole.sum())
        body, most = records["body"], len(self._sums)
        steps, iterations = np.bincount(body, minlength=most), np.bincount(body, records["iterations"], most)
        self._sums = self._sums + np.stack([steps, iterations], axis=1)

    def collect(self) -> Iterator[Metric]:
        """Yields all metrics."""
        yield from self._run()
        yield from self._objects()
        yield from self._network()
        yield from self._log()

    def _run(self) -> Iterator[Metric]:
        status, (counts, total) = self.status, self._times
        yield InfoMetricFamily(
            "warpfactor_server", "What runs", value={
                "server": self._link.name, "scene": status.scene, "device": status.device, "version": version(),
            },
        )  # fmt: skip
        yield _gauge("warpfactor_server_state", "1: the server is in this state", ["state"], (
            ([state], float(state == status.state)) for state in STATES
        ))  # fmt: skip
        yield _counter("warpfactor_steps", "Steps completed", status.step)
        yield _counter("warpfactor_late_steps", "Steps that began more than dt after their deadline", status.late_steps)
        yield _gauge("warpfactor_time_step_seconds", "dt of the scene", [], [([], status.dt)])
        yield _gauge(
            "warpfactor_behind_clock", "1: in real time, and steps do not keep pace", [],
            [([], float(bool(status.pace)))],
        )  # fmt: skip
        bounds = [*map(repr, map(float, BUCKETS)), "+Inf"]
        buckets = list(zip(bounds, np.cumsum(counts).tolist(), strict=True))
        yield HistogramMetricFamily("warpfactor_step_seconds", "Time of a step of all objects", buckets, total)
        yield _counter(
            "warpfactor_step_records_dropped", "Step records that were not read in time", status.records_dropped
        )
        yield _counter(
            "warpfactor_frames_dropped", "Frames that the log or viewers were too slow for", status.frames_dropped
        )

    def _objects(self) -> Iterator[Metric]:
        names, objects, sums = self._names, list(self.status.objects), self._sums

        def rows(value: Callable[[pb.ObjectStatus], float]) -> list[Row]:
            return [([name], value(o)) for name, o in zip(names, objects, strict=False)]

        def counter(name: str, text: str, found: Iterable[Row], labels: tuple[str, ...] = ("object",)) -> Metric:
            family = CounterMetricFamily(f"warpfactor_{name}", text, labels=labels)
            for values, number in _summed(found):
                family.add_metric(values, number)
            return family

        steps, iterations = ([([n], float(v)) for n, v in zip(names, sums[:, k], strict=True)] for k in (0, 1))
        yield counter("object_steps", "Steps of the object", steps)
        yield counter("iterations", "Iterations of its solves", iterations)
        yield counter(
            "step_events", "Steps that did not converge, by status, fell back to block Jacobi or were halved",
            [([n, e.event], e.steps) for n, o in zip(names, objects, strict=False) for e in o.events],
            ("object", "event"),
        )  # fmt: skip
        yield counter("factors_used", "Factors that solves used", rows(lambda o: o.factors_used))
        yield counter("factors_refused", "Factors that were refused or abandoned", rows(lambda o: o.factors_refused))
        yield counter("factors_mended", "Factors of matrices that were not positive definite", rows(
            lambda o: o.factors_mended
        ))  # fmt: skip
        excess = "Iterations above those with a fresh factor since its last one was taken up"
        yield _gauge("warpfactor_excess_iterations", excess, ["object"], _summed(rows(lambda o: o.excess)))
        ages = [row for row in rows(lambda o: o.factor_age) if row[1] >= 0]
        age = "Steps since the matrix of its newest factor; absent without one"
        yield _gauge("warpfactor_factor_age_steps", age, ["object"], _largest(ages))
        flight = _summed(rows(lambda o: o.in_flight))
        yield _gauge("warpfactor_factors_in_flight", "Matrices that are copied or factorized", ["object"], flight)

    def _network(self) -> Iterator[Metric]:
        counts, refusals = self._link.counters.copy()
        status = self.status
        need = "Time that solves lose to old or missing factors, in a second"
        yield _gauge("warpfactor_need_seconds", need, [], [([], self.lost())])
        yield _gauge("warpfactor_workers", "Workers that may be given jobs", [], [([], len(status.workers))])
        yield _gauge("warpfactor_clients", "Clients that are connected", [], [([], len(status.clients))])
        yield _counter("warpfactor_jobs", "Matrices sent to workers", counts.get("jobs", 0))
        yield _counter("warpfactor_factors", "Factors that came from workers", counts.get("factors", 0))
        lost = CounterMetricFamily("warpfactor_jobs_failed", "Jobs that brought no factor", labels=["why"])
        for why, name in (("failed", "failures"), ("lost", "jobs_lost"), ("late", "leases_over")):
            lost.add_metric([why], counts.get(name, 0))
        yield lost
        size = CounterMetricFamily("warpfactor_bulk_bytes", "Matrices sent, factors received", labels=["direction"])
        for direction, name in (("out", "bytes_out"), ("in", "bytes_in")):
            size.add_metric([direction], counts.get(name, 0))
        yield size
        arrays = CounterMetricFamily("warpfactor_bulk_arrays", "The same, by how they travelled", labels=["by"])
        for by, name in (("shared_memory", "bulk_shared"), ("bytes", "bulk_copied")):
            arrays.add_metric([by], counts.get(name, 0))
        yield arrays
        refused = CounterMetricFamily("warpfactor_messages_refused", "Messages that were refused", labels=["kind"])
        for kind, number in refusals.items():
            refused.add_metric([kind], number)
        yield refused
        commands = counts.get("commands_refused", 0)
        yield _counter("warpfactor_commands_refused", "Commands beyond a client's rate or the queue", commands)

    def _log(self) -> Iterator[Metric]:
        if (log := self._recorder) is None:
            return
        yield _counter("warpfactor_log_records", "Records written to the log", log.written)
        yield _counter("warpfactor_log_bytes", "Bytes written to the log", log.bytes_written)
        yield _counter("warpfactor_log_records_lost", "Records but frames that are not in the log", log.lost)
        yield _counter(
            "warpfactor_log_records_thinned", "Step records left out of the log, which could not follow", log.thinned
        )
        yield _counter("warpfactor_log_frames_dropped", "Frames that are not in the log", log.dropped)
        yield _gauge("warpfactor_log_broken", "1: the log is not written", [], [([], float(log.broken))])


def _counter(name: str, text: str, value: float) -> Metric:
    return CounterMetricFamily(name, text, value)


def _gauge(name: str, text: str, labels: list[str], rows: Iterable[Row]) -> Metric:
    family = GaugeMetricFamily(name, text, labels=labels)
    for values, number in rows:
        family.add_metric(values, number)
    return family


def _joined(rows: Iterable[Row], join: Callable[[float, float], float]) -> list[Row]:
    """Joins rows of the same labels: those of the objects beyond MOST_OBJECTS."""
    found: dict[tuple[str, ...], float] = {}
    for labels, value in rows:
        place = tuple(labels)
        found[place] = join(found[place], value) if place in found else value
    return [(list(labels), value) for labels, value in found.items()]


def _summed(rows: Iterable[Row]) -> list[Row]:
    return _joined(rows, lambda a, b: a + b)


def _largest(rows: Iterable[Row]) -> list[Row]:
    return _joined(rows, max)
