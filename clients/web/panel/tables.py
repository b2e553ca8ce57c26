# SPDX-License-Identifier: MIT
"""Objects and workers of a status as HTML tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from clients.log.scalars import ended
from protocol import messages_pb2 as pb

MOST = 30  # objects that are listed
STYLE = "border-collapse:collapse;width:100%;font-size:0.75em;line-height:1.3;white-space:nowrap"


def summary(status: pb.Status) -> str:
    """Returns one line of HTML."""
    late = f" · {status.late_steps} late" if status.late_steps else ""
    pace = f"<br>{escape(status.pace)}" if status.pace else ""
    return (
        f'<div style="font-size:0.8em;padding:0.3em 1em"><b>{escape(status.state)}</b> · {escape(status.scene)} on '
        f"{escape(status.device)} · step {status.step} · t = {status.time:.2f} s · {1e3 * status.step_p50:.2f} ms of "
        f"{1e3 * status.dt:g} ms{late}{pace}</div>"
    )


def warning(text: str) -> str:
    """Returns a line of HTML that stands out."""
    style = "font-size:0.85em;margin:0.3em 1em;padding:0.4em;background:#c92a2a;color:white"
    return f'<div style="{style}">{escape(text)}</div>'


def tables(status: pb.Status) -> str:
    """Returns tables of objects, workers and local workers."""
    objects = _table(
        ("object", "nodes", "iterations", "residual", "age", "status"),
        (
            (o.object, o.nodes, f"{o.mean_iterations:.1f}", f"{o.last.residual:.1e}", _age(o.factor_age),
             ended(o.last))
            for o in status.objects[:MOST]
        ),
    )  # fmt: skip
    more = f"<div>and {len(status.objects) - MOST} more</div>" if len(status.objects) > MOST else ""
    workers = _table(
        ("worker", "library", "jobs", "failed", "memory"),
        ((w.worker, w.library, w.jobs, w.failures, _memory(w)) for w in status.workers[:MOST]),
    )
    local = _table(
        ("local worker", "state", "pid", "restarts"),
        ((w.worker, w.state, w.pid or "-", w.restarts) for w in status.local_workers[:MOST]),
    )
    return f'<div style="padding:0 1em">{objects}{more}{workers}{local}</div>'


def _memory(worker: pb.WorkerInfo) -> str:
    """How arrays travel to and from a worker."""
    return "device" if worker.device_memory else "shared" if worker.shared_memory else "bytes"


def _age(steps: int) -> str:
    return str(steps) if steps >= 0 else "-"


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = "".join(f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>" for row in rows)
    if not lines:
        return ""
    head = "".join(f'<th style="text-align:left">{escape(name)}</th>' for name in heads)
    return f'<table style="{STYLE}"><tr>{head}</tr>{lines}</table>'
