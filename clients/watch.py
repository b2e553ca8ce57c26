# SPDX-License-Identifier: MIT
"""The server's health, and parameters that may change, as tables on a terminal."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from clients.client import Client
from clients.log.scalars import ended, enum_name, reaction_name
from protocol import messages_pb2 as pb

PERIOD = 0.5  # s between two readings
MOST_KEY = 36  # characters of a parameter that are not broken into lines
ERRORS = {  # fields of ObjectStep with estimated errors -> of what
    "solve_error": "error of the linear solve",
    "step_error": "of the step's equation",
    "estimate": "of the time step",
}
COMPACT: dict[str, Any] = {"box": SIMPLE_HEAD, "padding": (0, 1), "pad_edge": False}  # fits 80 columns


def watch(client: Client, count: int = 0) -> None:
    """Shows the status until Ctrl-C, or `count` times."""
    shown = 0
    with Live(tables(client.status()), auto_refresh=False) as live:
        while not count or shown < count:
            live.update(tables(client.status()), refresh=True)
            shown += 1
            time.sleep(PERIOD)


def tables(status: pb.Status) -> Group:
    """Tables of a status: summary, objects, workers, and the local workers that the server supervises."""
    local = [_local(status)] if status.local_workers else []
    pace = [Text(status.pace, "bold red")] if status.pace else []
    return Group(
        _summary(status), *pace, _objects(status), *_events(status), *_errors(status), *_contacts(status),
        *_readings(status), *_energies(status), _workers(status), *local,
    )  # fmt: skip


def _summary(status: pb.Status) -> Text:
    lines = [
        f"{status.scene or '(no scene)'} on {status.device or '?'}: {status.state}, "
        f"step {status.step}, t = {status.time:.3f} s, dt = {status.dt * 1e3:g} ms",
        f"step p50 {_ms(status.step_p50)}, p99 {_ms(status.step_p99)}, max {_ms(status.step_max)}, "
        f"late {status.late_steps}; dropped: frames {status.frames_dropped}, step records {status.records_dropped}; "
        f"lost to the log {status.records_lost}, left out of it {status.records_thinned}",
        f"refused: messages {status.refused}, commands {status.commands_refused}; "
        f"arrays through shared memory {status.bulk_shared}{_on_device(status)}, "
        f"as bytes {status.bulk_copied}; clients {len(status.clients)}",
    ]
    if status.recording_failure:
        lines.append(f"the log is not whole: {status.recording_failure}")
    return Text("\n".join(lines))


def _objects(status: pb.Status) -> Table:
    table = Table("object", "nodes", "iter.", "mean", "residual", "status", "age/max", "precond.", **COMPACT)
    for found in status.objects:
        last = found.last
        _add(
            table,
            found.object,
            str(found.nodes),
            str(last.iterations),
            f"{found.mean_iterations:.1f}",
            f"{last.residual:.1e}",
            _status(found),
            f"{_known(found.factor_age)}/{_known(found.factor_age_bound)}",
            last.preconditioner,
        )
    return table


def places(status: pb.Status) -> Table | Text:
    """Table of the extents and tips of the objects; a line where the status has none."""
    table = Table("object", "x", "y", "z [m]", "tip", **COMPACT)
    for found in status.objects:
        if found.HasField("low"):
            low, high, tip = found.low, found.high, found.tip
            spans = ((low.x, high.x), (low.y, high.y), (low.z, high.z))
            _add(table, found.object, *(f"{a:.3g} … {b:.3g}" for a, b in spans), f"{tip.x:.3g} {tip.y:.3g} {tip.z:.3g}")
    return table if table.row_count else Text("where objects are: the server had no time to tell; ask again")


def _status(found: pb.ObjectStatus) -> Text:
    away = found.last.status == pb.RUNAWAY
    return Text("RUNAWAY", style="bold red") if away else Text(ended(found.last))


def _events(status: pb.Status) -> list[Table]:
    """Table of what went wrong so far, of the objects where something did; empty without such objects."""
    table = Table("object", "steps", "factors", "why the last one was refused", **COMPACT)
    for found in status.objects:
        steps = ", ".join(f"{e.event} {e.steps}" for e in found.events)
        counts = {"mended": found.factors_mended, "refused": found.factors_refused}
        factors = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
        if steps or factors:
            _add(table, found.object, steps or "-", factors or "-", found.refusal or "-")
    return [table] if table.row_count else []


def _errors(status: pb.Status) -> list[Table]:
    """Table of estimated errors of the last step, of the objects that have any; empty without such objects."""
    shown = [o for o in status.objects if o.last.form or any(o.last.HasField(name) for name in ERRORS)]
    table = Table("object", "step by", *(f"{title} [m]" for title in ERRORS.values()), **COMPACT)
    for found in shown:
        errors = (f"{getattr(found.last, name):.1e}" if found.last.HasField(name) else "-" for name in ERRORS)
        _add(table, found.object, enum_name("form", found.last.form), *errors)
    return [table] if shown else []


def _contacts(status: pb.Status) -> list[Table]:
    """Tables of contacts and forces, and of where obstacles are; none if there is no contact and no grab."""
    if not status.obstacles and not any(found.last.reactions for found in status.objects):
        return []
    table = Table("object", "contacts", "passes", "contact residual", "clipped", "no row", "force on [N]", **COMPACT)
    for found in status.objects:
        last = found.last
        forces = (f"{reaction_name(r)} {math.hypot(r.force.x, r.force.y, r.force.z):.3g}" for r in last.reactions)
        residual = f"{last.contact_residual:.1e}" if last.HasField("contact_residual") else "-"
        numbers = str(last.contacts), str(last.passes), residual, str(found.clipped), str(found.crowded)
        _add(table, found.object, *numbers, ", ".join(forces) or "-")
    where = Table("obstacle", "at [m]", "turned by [°]", **COMPACT)
    for pose in status.obstacles:
        p, w = pose.position, min(abs(pose.rotation.w), 1.0)
        _add(where, pose.header.object, f"{p.x:.3g} {p.y:.3g} {p.z:.3g}", f"{math.degrees(2 * math.acos(w)):.3g}")
    return [table, where] if status.obstacles else [table]


def _readings(status: pb.Status) -> list[Table]:
    """Table of what effects tell of the objects: pressures, tensions; empty where none does."""
    table = Table("object", "of", "in the last step", **COMPACT)
    for found in status.objects:
        of: dict[str, list[str]] = {}
        for r in found.last.readings:
            of.setdefault(r.of, []).append(f"{r.quantity} {r.value:.4g} {r.unit}")
        for name, told in of.items():
            _add(table, found.object, name, ", ".join(told))
    return [table] if table.row_count else []


def _energies(status: pb.Status) -> list[Table]:
    """Table of the objects whose energy is known or that have run away; empty without such objects."""
    shown = [o for o in status.objects if o.HasField("total_energy") or o.runaway_steps]
    table = Table("object", "energy [J]", "kinetic [J]", "runaway steps", **COMPACT)
    for found in shown:
        total = f"{found.total_energy:.4g}" if found.HasField("total_energy") else "-"
        _add(table, found.object, total, f"{found.last.kinetic_energy:.4g}", str(found.runaway_steps or "-"))
    return [table] if shown else []


def _on_device(status: pb.Status) -> str:
    """How many of them stayed in memory of a GPU, if any did."""
    return f" ({status.bulk_on_device} of them on the device)" if status.bulk_on_device else ""


def _workers(status: pb.Status) -> Table | Text:
    if not status.workers:
        return Text("no workers")
    table = Table("worker", "host", "pid", "library", "threads", "jobs", "failed", "refused", "shm", **COMPACT)
    for worker in status.workers:
        numbers = (worker.threads, worker.jobs, worker.failures, worker.refused)
        shared = "device" if worker.device_memory else "yes" if worker.shared_memory else "no"
        _add(table, worker.worker, worker.host, str(worker.pid), worker.library, *map(str, numbers), shared)
    return table


def _local(status: pb.Status) -> Table:
    table = Table("local worker", "state", "pid", "restarts", "last end", **COMPACT)
    for worker in status.local_workers:
        ended = _end(worker.exit_code) if worker.restarts or worker.state != "running" else "-"
        _add(table, worker.worker, worker.state, str(worker.pid or "-"), str(worker.restarts), ended)
    return table


def parameter_table(found: Sequence[pb.LiveParameter]) -> Table:
    """Returns a table of keys, values, units and meanings."""
    table = Table("key", "value", "unit", "about", **COMPACT)
    longest = max((len(short_key(each.now.key)) for each in found), default=0)
    table.columns[0].min_width, table.columns[0].max_width = min(MOST_KEY, longest), MOST_KEY
    table.columns[0].overflow = table.columns[1].overflow = "fold"
    for each in found:
        _add(table, short_key(each.now.key), each.now.value, each.unit, each.about.split(", or ")[0])
    return table


def short_key(key: str) -> str:
    """Returns a key without what the server can do without: NAME.EFFECT.KEY, EFFECT.KEY, NAME.KEY."""
    kind, _, rest = key.partition(".")
    return rest.replace(".effects.", ".", 1) if kind in ("object", "obstacle", "effects") else key


def _add(table: Table, *cells: str | Text) -> None:
    """Adds a row of plain texts: rich would take brackets in a string for markup, and fail on such as [/x]."""
    table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in cells))


def _end(code: int) -> str:
    """Names the exit code of a process, or the signal that ended it."""
    if code >= 0:
        return f"exit {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def _known(steps: int) -> str:
    return str(steps) if steps >= 0 else "-"


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.2f} ms"
