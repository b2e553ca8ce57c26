# SPDX-License-Identifier: MIT
"""What attacks of whoever reaches the port cost: steps, answers, and time until factors come again.

Each attack of tests/attacks is made alone while an honest client holds and pushes a beam: by a bare session against a
server on loopback, and by the holder of a viewer's certificate against a server with --tls.
"""

import argparse
from pathlib import Path
from typing import Any

from tests.attacks.arena import Arena, Outcome
from tests.attacks.attacks import ATTACKS, RULING, Attack
from tests.bench.harness.report import Report

TITLE = "What attacks cost"
QUICK = 3  # attacks of a smoke run
COLUMNS = ("attack", "by", "steps", "steps lost", "steps wrong", "answers lost", "messages believed", "iterations",
           "next factor s", "new session s")  # fmt: skip


def met(by: str, attacks: dict[str, Attack]) -> list[dict[str, Any]]:
    """Makes the attacks against one server; returns the rows of the table."""
    outcomes: dict[str, Outcome] = {}
    with Arena(tls=by == "viewer") as arena:
        for name, attack in attacks.items():
            outcomes[name] = arena.meet(attack)
            print(f"{by}: {name}: {outcomes[name]}", flush=True)
        judged = arena.judged()
    return [
        {
            "attack": name, "by": by, "steps": o.last - o.first, "steps lost": judged.missing(o.first, o.last),
            "steps wrong": judged.wrong(o.first, o.last), "answers lost": o.refused_honest,
            "messages believed": o.strangers, "iterations": judged.mean_iterations(o.first, o.last),
            "next factor s": o.seconds, "new session s": o.session,
        }
        for name, o in outcomes.items()
    ]  # fmt: skip


def summed(rows: list[dict[str, Any]], by: str) -> dict[str, Any]:
    """One row of all attacks of an attacker."""
    mine = [row for row in rows if row["by"] == by]
    seconds = sorted(row["next factor s"] for row in mine)
    sums = {name: sum(row[name] for row in mine) for name in COLUMNS[2:7]}
    return {"by": by, "attacks": len(mine), **sums, "next factor s, median": seconds[len(seconds) // 2],
            "next factor s, longest": seconds[-1],
            "new session s, longest": max(row["new session s"] for row in mine)}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} attacks of each attacker")
    parser.add_argument("--out", type=Path, help="folder, instead of out/bench/attacks")
    o = parser.parse_args()
    report = Report("attacks", TITLE, {"quick": True} if o.quick else {}, o.out, o.quick)
    attacks = dict(list(ATTACKS.items())[:QUICK]) if o.quick else ATTACKS
    ruling = dict(list(RULING.items())[:QUICK]) if o.quick else RULING
    rows = [*met("bare session", attacks), *met("viewer", {**attacks, **ruling})]
    report.say(
        "A beam of 540 tetrahedra in real time, dt 20 ms, one local worker, and an honest client that moves a grab, "
        "pushes, and reads status, steps and states. Each attack is made on a session of its own, once that of the one "
        "before is gone: by a bare session against a server on loopback, and by the holder of a viewer's certificate "
        "against one with `--tls`, there also what on loopback everybody may. Steps are those from the attack's "
        "beginning until a factor that was made after it is in use. Lost: not in the log; wrong: true residual above "
        "the tolerance, or not converged; answers lost: the honest client was not served within 2 s, or by another; "
        "messages believed: steps and states that it took from somebody else; next factor, new session: from the end "
        "of the attack until one is used, and until a new client has got in. After each handshake of TLS that fails "
        "zenoh takes no other connection for 0.1 s; sessions that are there go on."
    )
    report.table([summed(rows, by) for by in ("bare session", "viewer")])
    report.say("## Each attack")
    report.table(rows, COLUMNS)
    report.data["rows"] = rows
    report.remember(rows, ("attack", "by"), ("steps lost", "steps wrong", "answers lost"))
    report.write()


if __name__ == "__main__":
    main()
