# SPDX-License-Identifier: MIT
"""The table at the top of the page: what a reader in a hurry asks, answered from the tables below."""

from collections.abc import Iterator

from tests.bench.contact import impact, peers
from tests.bench.contact.bodies import FACTOR, JACOBI, REST, SLIDING, Row

Tables = dict[str, list[Row]]
TETS = 3000
DEVICES = {"cpu": "CPU", "gpu": "GPU"}


def rows(tables: Tables) -> list[Row]:
    """Of what was measured."""
    found: list[Row] = []
    for part in (_right, _real_time, _effect, _impact, _peers):
        found += [{"asked": asked, "answer": answer} for asked, answer in part(tables)]
    return found


def _of(rows: list[Row], **named: object) -> list[Row]:
    return [row for row in rows if all(row[name] == value for name, value in named.items())]


def _right(tables: Tables) -> Iterator[tuple[str, str]]:
    if answers := tables.get("answers"):
        bounded = [row for row in answers if row["holds"]]
        held = sum(row["holds"] == "yes" for row in bounded)
        yield "Is it right?", f"{held} of {len(bounded)} [known answers](#known-answers) hold"
    if paths := tables.get("paths"):
        wrong = sum(row["wrong"] > 0 for row in paths)
        yield (
            "Does anything pass through an obstacle?",
            f"in {wrong} of {len(paths)} [runs](#nodes-on-the-wrong-side) at 1 to 100 m/s",
        )


def _real_time(tables: Tables) -> Iterator[tuple[str, str]]:
    for device, where in DEVICES.items():
        lines = _of(tables.get("cost", []), device=device, tets=TETS, kappa=1.0, preconditioner=FACTOR)
        for situation in (REST.name, SLIDING.name):
            for row in _of(lines, situation=situation):
                yield (
                    f"A step of {TETS:,} tetrahedra, {situation}, {row['contacts']} contacts, {where}",
                    f"{row['p50 ms']:.3g} ms p50, {row['p99 ms']:.3g} ms p99, {row['iterations']:.3g} iterations",
                )
        if pile := _of(tables.get("pile", []), device=device):
            falling = max((row["bodies"] for row in pile if row["in real time"] == "yes"), default=0)
            resting = max((row["bodies"] for row in pile if row["in real time"] != "no"), default=0)
            yield (
                f"Bodies of 540 tetrahedra in real time at 60 steps a second, {where}",
                f"{falling} while they fall on [each other](#a-pile), {resting} at rest, "
                f"of up to {max(row['bodies'] for row in pile)} tried",
            )


def _effect(tables: Tables) -> Iterator[tuple[str, str]]:
    for device, where in DEVICES.items():
        if lines := _of(tables.get("own", []), device=device):
            over = {row["case"]: f"{row['over without']:.3g}" for row in lines}
            counts = ", ".join(f"{over[f'{n} contacts']} with {n}" for n in (1, 10, 100))
            yield (
                f"What [the effect](#the-effect-itself) costs, over a scene without it, {where}",
                f"{over['listed, an obstacle far away']} times with nothing near; {counts} contacts",
            )


def _impact(tables: Tables) -> Iterator[tuple[str, str]]:
    for device, where in DEVICES.items():
        lines = _of(tables.get("impact", []), device=device, tets=TETS)
        at = {
            row["preconditioner"]: next((line for line in impact.phases(row) if line["impact"] == "at"), None)
            for row in lines
        }
        told = [f"{name} {line['most ms']:.3g} ms" for name in (FACTOR, impact.NONE_IN_CONTACT, JACOBI)
                if (line := at.get(name))]  # fmt: skip
        if told:
            asked = f"The worst step of [an impact](#an-impact-step-by-step), {TETS:,} tetrahedra, {where}"
            yield asked, "; ".join(told)


def _peers(tables: Tables) -> Iterator[tuple[str, str]]:
    """Ours by default, others with the last of their settings, which are the most exact."""
    shown = {way.who: way.name for way in peers.WAYS} | {peers.OURS: peers.WAYS[0].name}
    for who, settings in shown.items():
        mine = {row["case"]: row for row in tables.get("peers", [])
                if row["device"] == "cpu" and (row["who"], row["settings"]) == (who, settings)}  # fmt: skip
        if {peers.SLIDE.name, peers.STEEP.name} <= set(mine):
            slide, creep = mine[peers.SLIDE.name], mine[peers.STEEP.name]["creep mm/s"]
            yield (
                f"[Beside others](#beside-others): {who}, {settings}",
                f"stops {100 * slide['error']:+.2g} % off, creeps {creep:.2g} mm/s below the limit of friction, "
                f"{slide['ms a frame']:.3g} ms a frame of 1/60 s",
            )
