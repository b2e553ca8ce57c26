# SPDX-License-Identifier: MIT
"""Metrics of a worker for Prometheus (docs/operations.md lists them)."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from prometheus_client import Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric

from protocol.process.version import version

if TYPE_CHECKING:
    from precond_worker.network.server_connection import ServerConnection

BUCKETS = tuple(m * 10.0**e for e in range(-4, 2) for m in (1, 2, 5))  # s


@dataclass(eq=False)  # a registry keeps it by identity
class WorkerMetrics:
    """A collector of prometheus_client. factorization: to be given the seconds of each"""

    worker: str
    library: str
    threads: int
    connections: "list[ServerConnection]" = field(default_factory=list)

    def __post_init__(self) -> None:
        self.factorization = Histogram(
            "warpfactor_worker_factorization_seconds", "Numeric factorization of a job", buckets=BUCKETS, registry=None
        )

    def collect(self) -> Iterator[Metric]:
        """Yields all metrics."""
        yield InfoMetricFamily(
            "warpfactor_worker", "What runs", value={
                "worker": self.worker, "library": self.library, "threads": str(self.threads), "version": version(),
            },
        )  # fmt: skip
        yield from self.factorization.collect()
        connected = GaugeMetricFamily("warpfactor_worker_serving", "1: this server is served now", labels=["server"])
        shared = GaugeMetricFamily("warpfactor_worker_shared_memory", "1: by shared memory", labels=["server"])
        counters = {
            name: CounterMetricFamily(f"warpfactor_worker_{name}", text, labels=["server"])
            for name, text in (
                ("jobs", "Matrices taken"),
                ("failures", "Jobs without a factor"),
                ("superseded", "Matrices replaced by newer ones before they were factorized"),
            )
        }
        arrays = CounterMetricFamily("warpfactor_worker_bulk_arrays", "Matrices received", labels=["server", "by"])
        refused = CounterMetricFamily(
            "warpfactor_worker_messages_refused", "Messages that were refused", labels=["server", "kind"]
        )
        for each in list(self.connections):
            counts, refusals = each.counters.copy()
            server = [each.server]
            connected.add_metric(server, float(each.incarnation != 0))
            shared.add_metric(server, float(each.shared_memory))
            dropped = {"superseded": each.received.dropped}
            for name, family in counters.items():
                family.add_metric(server, counts.get(name, 0) + dropped.get(name, 0))
            for by, name in (("shared_memory", "bulk_shared"), ("bytes", "bulk_copied")):
                arrays.add_metric([*server, by], counts.get(name, 0))
            for kind, number in refusals.items():
                refused.add_metric([*server, kind], number)
        yield from (connected, shared, *counters.values(), arrays, refused)
