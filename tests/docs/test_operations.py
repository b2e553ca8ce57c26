# SPDX-License-Identifier: MIT
"""docs/operations.md and the dashboard name the metrics that server and worker have, and no others."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from protocol.counters import Counters
from tests.docs.figures import DOCS, ROOT

pytest.importorskip("prometheus_client")
NAME = re.compile(r"\b(?:warpfactor|process)_\w+")
OWN = re.compile(r"\bwarpfactor_\w+")


def _counters() -> Counters:
    import logging

    from protocol.refused import Refused

    counters = Counters(logging.getLogger("nobody"))
    counters.refuse(Refused("it", "late"))
    return counters


def _server() -> set[str]:
    """Names of series of a server with an object to which everything has happened."""
    from sim_server.backends.cpu.structs import RECORD
    from sim_server.service.metrics import ServerMetrics

    log = SimpleNamespace(written=1, bytes_written=1, lost=0, thinned=0, dropped=0, broken=False)
    link = SimpleNamespace(name="sim", counters=_counters())
    metrics = ServerMetrics(["a"], link, log)  # type: ignore[arg-type]
    metrics.add(np.ones(1, RECORD)[:0])
    metrics.status = pb.Status(objects=[pb.ObjectStatus(events=[pb.EventCount(event="budget", steps=1)])])
    return {sample.name for family in metrics.collect() for sample in family.samples}


def _worker() -> set[str]:
    from precond_worker.metrics import WorkerMetrics

    queue = SimpleNamespace(dropped=0)
    connection = SimpleNamespace(server="sim", incarnation=1, shared_memory=True, counters=_counters(), received=queue)
    metrics = WorkerMetrics("w", "native", 1, [connection])  # type: ignore[list-item]
    return {s.name for family in metrics.collect() for s in family.samples if not s.name.endswith("_created")}


def _families(names: set[str]) -> set[str]:
    """Histograms are one name to the reader."""
    return {re.sub(r"(_seconds)_(bucket|count|sum)$", r"\1", name) for name in names}


def test_the_page_lists_the_metrics() -> None:
    text = (DOCS / "operations.md").read_text()
    for title, names in (("server", _server()), ("worker", _worker())):
        table = re.search(rf"^\| {title} \| what \|\n(.*?)\n\n", text, re.MULTILINE | re.DOTALL)
        assert table is not None
        firsts = " ".join(line.split("|")[1] for line in table[1].splitlines())
        assert set(OWN.findall(firsts)) == _families(names), title


def test_the_dashboard_asks_for_metrics_that_there_are() -> None:
    text = (ROOT / "deploy" / "grafana" / "warpfactor.json").read_text()
    board = json.loads(text)
    expressions = [target["expr"] for panel in board["panels"] for target in panel.get("targets", [])]
    expressions += [v["query"]["query"] for v in board["templating"]["list"] if v["type"] == "query"]
    asked = {name for expression in expressions for name in NAME.findall(expression)}
    there = _server() | _worker() | {"process_resident_memory_bytes"}
    assert asked and asked <= there
    # What a person on call wants to see is on it.
    for wanted in ("steps", "late_steps", "iterations", "jobs_failed", "messages_refused", "log_records_lost"):
        assert f"warpfactor_{wanted}_total" in asked, wanted
    assert {"warpfactor_step_seconds_bucket", "warpfactor_factor_age_steps", "warpfactor_excess_iterations"} <= asked


def test_panels_do_not_overlap() -> None:
    board = json.loads((ROOT / "deploy" / "grafana" / "warpfactor.json").read_text())
    taken: set[tuple[int, int]] = set()
    for panel in board["panels"]:
        p = panel["gridPos"]
        cells = {(x, y) for x in range(p["x"], p["x"] + p["w"]) for y in range(p["y"], p["y"] + p["h"])}
        assert p["x"] + p["w"] <= 24 and not cells & taken, panel["title"]
        taken |= cells
