# SPDX-License-Identifier: MIT
"""The report of a load test: figures of its bodies, steps, workers and clients, as JSON and as tables."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clients.load_test.options import LoadOptions
from clients.load_test.verdict import verdict
from clients.log.scalars import Columns
from protocol import messages_pb2 as pb

if TYPE_CHECKING:
    from rich.console import Group

RATIOS = ("ms_p50", "ms_p99", "ms_max", "start_ms_p99", "start_ms_max")
SHOWN = 24  # bodies in the table on a terminal; all are in the JSON


class StatusSamples(NamedTuple):
    """The status of the server before the test, as the clients begin, and at the end."""

    before: pb.Status
    begin: pb.Status
    end: pb.Status


def report(
    load: LoadOptions, samples: StatusSamples, clients: list[dict[str, Any]], steps: dict[str, Columns]
) -> dict[str, Any]:
    """Reports the steps under load (between samples.begin and samples.end) and those without clients before.

    clients: reports of the clients (client_process.py). steps: scalars of each body, from samples.before on.
    """
    before, begun, ended = samples
    seconds = max(ended.uptime - begun.uptime, 1e-9)
    within = {name: _between(found, begun.step, ended.step) for name, found in steps.items()}
    tets = {found.object: found.tets for found in ended.objects}
    used = {o.object: o.factors_used for o in ended.objects}
    used_before = {o.object: o.factors_used for o in begun.objects}
    ours = _steps(begun, ended, steps)
    return {
        "verdict": verdict(ended, ours, seconds, within),
        "scene": ended.scene, "seed": None if load.connect else load.seed, "device": ended.device, "dt": ended.dt,
        "seconds": seconds,
        "steps": ours | {"quiet": _quiet(before, begun, ended, steps)},
        "objects": [
            {"object": name, "tets": tets.get(name), "factors": used[name] - used_before.get(name, 0), **_body(found)}
            for name, found in sorted(within.items())
            if name in used
        ],
        "workers": _workers(begun, ended, seconds),
        "clients": {"commands": _commands(clients, seconds), "each": [_client(c) for c in clients]},
        "server": {
            "commands_refused": ended.commands_refused - begun.commands_refused,
            "moves_replaced": ended.moves_replaced - begun.moves_replaced,
            "messages_refused": ended.refused - begun.refused,
            "step_records_dropped": ended.records_dropped - begun.records_dropped,
            "lost_to_the_log": ended.records_lost - begun.records_lost,
        },
    }  # fmt: skip


def _between(found: Columns, first: int, last: int) -> Columns:
    mine = (found["step"] > first) & (found["step"] <= last)
    return {name: values[mine] for name, values in found.items()}


def _steps(begun: pb.Status, ended: pb.Status, steps: dict[str, Columns]) -> dict[str, Any]:
    """Figures of whole steps, all bodies together.

    late: steps that began more than dt after their time; over_dt: steps that took longer than dt; ms: duration of each;
    start_ms: delay of the start of a step; cpu_ms_max: processor time of the simulation thread.
    """
    seconds = max(ended.uptime - begun.uptime, 1e-9)
    found = (_between(columns, begun.step, ended.step) for columns in steps.values())
    mine: Columns = next((columns for columns in found if len(columns["step"])), {})
    whole, start, cpu = (1e3 * mine.get(f"{n}_seconds", np.zeros(0)) for n in ("step", "late", "cpu"))
    return {
        "count": ended.step - begun.step, "per_second": (ended.step - begun.step) / seconds,
        "start_ms_p99": _percentile(start, 99), "start_ms_max": _percentile(start, 100),
        "cpu_ms_max": _percentile(cpu, 100),
        "ms_p50": _percentile(whole, 50), "ms_p99": _percentile(whole, 99), "ms_max": _percentile(whole, 100),
        "late": ended.late_steps - begun.late_steps, "over_dt": int((whole > 1e3 * ended.dt).sum()),
        "ms": np.round(whole, 4).tolist(),
    }  # fmt: skip


def _quiet(before: pb.Status, begun: pb.Status, ended: pb.Status, steps: dict[str, Columns]) -> dict[str, Any] | None:
    """The same figures without clients, and the ratio of those with clients to them; None if none were measured."""
    if begun.step <= before.step:
        return None
    alone, loaded = _steps(before, begun, steps), _steps(begun, ended, steps)
    ratio = {name: loaded[name] / alone[name] if loaded[name] and alone[name] else None for name in RATIOS}
    return {**{k: v for k, v in alone.items() if k != "ms"}, "ratio": ratio}


def _body(found: Columns) -> dict[str, Any]:
    age = found["factor_age"][found["factor_age"] >= 0]
    return {
        "steps": len(found["step"]),
        "iterations_mean": _mean(found["iterations"]), "iterations_p99": _percentile(found["iterations"], 99),
        "factor_age_mean": _mean(age), "factor_age_p99": _percentile(age, 99), "factor_age_max": _percentile(age, 100),
        "unconverged": int((found["status"] != "converged").sum()),
    }  # fmt: skip


def _workers(begun: pb.Status, ended: pb.Status, seconds: float) -> dict[str, Any]:
    def grown(name: str) -> int:
        return getattr(ended, name) - getattr(begun, name)

    factors = sum(o.factors_used for o in ended.objects) - sum(o.factors_used for o in begun.objects)
    return {
        "count": len(ended.workers), "factors": factors, "factors_per_second": factors / seconds,
        "bytes_out": grown("bulk_bytes_out"), "bytes_in": grown("bulk_bytes_in"),
        "arrays_shared": grown("bulk_shared"), "arrays_copied": grown("bulk_copied"),
    }  # fmt: skip


def _commands(clients: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    found: dict[str, Any] = {
        key: sum(client[key] for client in clients) for key in ("sent", "done", "refused", "unanswered", "skipped")
    }
    replies = 1e3 * np.array([s for client in clients for s in client["reply_seconds"]])
    reasons: dict[str, int] = {}
    for client in clients:
        for reason, count in client["reasons"].items():
            reasons[reason] = reasons.get(reason, 0) + count
    return {
        **found, "per_second": found["sent"] / seconds, "reply_ms_p50": _percentile(replies, 50),
        "reply_ms_p99": _percentile(replies, 99), "refusals": dict(sorted(reasons.items(), key=lambda r: -r[1])),
    }  # fmt: skip


def _client(client: dict[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in client.items() if key not in ("reply_seconds", "reasons")}
    return {**kept, "reply_ms_p50": _percentile(1e3 * np.array(client["reply_seconds"]), 50)}


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if len(values) else None


def _percentile(values: NDArray[Any], q: float) -> float | None:
    return float(np.percentile(values, q)) if len(values) else None


def tables(found: dict[str, Any]) -> Group:
    """Tables of a report for a terminal."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from clients.watch import COMPACT

    steps, workers, server, commands = found["steps"], found["workers"], found["server"], found["clients"]["commands"]
    seed = "" if found["seed"] is None else f", seed {found['seed']}"
    lines = [
        found["verdict"],
        f"{found['scene']} on {found['device']}{seed}: {steps['count']} steps in {found['seconds']:.1f} s, "
        f"dt {1e3 * found['dt']:g} ms",
        f"step p50 {_cell(steps['ms_p50'])}, p99 {_cell(steps['ms_p99'])}, max {_cell(steps['ms_max'])} ms; "
        f"late {steps['late']}, longer than dt {steps['over_dt']}",
        *_comparison(steps),
        f"{workers['count']} workers: {workers['factors_per_second']:.1f} factors/s, "
        f"{workers['bytes_out'] / 1e6:.1f} MB to them, {workers['bytes_in'] / 1e6:.1f} MB from them",
        f"{len(found['clients']['each'])} clients: {commands['sent']} commands sent ({commands['per_second']:.0f}/s), "
        f"{commands['done']} done, {commands['refused']} refused, {commands['unanswered']} unanswered, "
        f"{commands['skipped']} skipped; reply p50 {_cell(commands['reply_ms_p50'])}, "
        f"p99 {_cell(commands['reply_ms_p99'])} ms",
        f"server: {server['commands_refused']} commands refused for their number, {server['moves_replaced']} moves "
        f"replaced by newer ones, {server['step_records_dropped']} step records dropped",
        *(f"  refused {count}: {reason}" for reason, count in list(commands["refusals"].items())[:5]),
    ]
    heads = ("object", "tets", "iter. mean", "p99", "factor age", "p99", "max", "factors", "unconverged")
    table = Table(*heads, **COMPACT)
    names = ("iterations_mean", "iterations_p99", "factor_age_mean", "factor_age_p99", "factor_age_max", "factors")
    for body in found["objects"][:SHOWN]:
        table.add_row(
            body["object"], str(body["tets"]), *(_cell(body[name]) for name in names), str(body["unconverged"])
        )
    more = len(found["objects"]) - SHOWN
    return Group(Text("\n".join(lines)), table, *([Text(f"and {more} more")] if more > 0 else []))


def _comparison(steps: dict[str, Any]) -> list[str]:
    quiet = steps["quiet"]
    if quiet is None:
        return []
    words = {
        "ms_p50": "step p50",
        "ms_p99": "p99",
        "ms_max": "max",
        "start_ms_p99": "begun late p99",
        "start_ms_max": "max",
    }
    shown = (
        f"{word} {_cell(quiet[k])} -> {_cell(steps[k])} ms (x {_cell(quiet['ratio'][k])})" for k, word in words.items()
    )
    return [f"without clients -> with: {', '.join(shown)}; late {quiet['late']} -> {steps['late']}"]


def _cell(value: float | None) -> str:
    return "-" if value is None else str(value) if isinstance(value, int) else f"{value:.3g}"
