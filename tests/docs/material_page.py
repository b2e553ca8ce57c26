# SPDX-License-Identifier: MIT
"""Writes docs/materials.md from the files of materials: `python -m tests.docs.material_page`; a test compares both."""

from typing import Any

from protocol import materials
from tests.docs.figures import DOCS

PAGE = DOCS / "materials.md"
HEAD = """\
# Materials

What `material = "NAME"` of an [object](scenes.md#materials-by-name) may name. Written from the files in
[protocol/materials](../protocol/materials) by `python -m tests.docs.material_page`; `sim-client materials` shows the
same on a terminal.

Constants are in Pa, where they have a unit; densities in kg/m³. `low` and `high` are the ends of what the sources say,
where they say them. Tissue differs tenfold by preparation, rate, blood and age: these are starting points for a scene,
not properties of a patient. What is chosen was not measured: one-dimensional tests say nothing of the bulk modulus.
Where a source has a curve, a test holds our law against it within the error that the file says; where it has a modulus,
the law has it at small strains. Constants hold for the stretches below, and without what depends on time:
[prony](scenes.md#materials-that-remember) and others stand beside a law.

| name | what | law | density | stretch |
|---|---|---|---|---|
"""


def page() -> str:
    """Returns the page that the files ask for."""
    files = {name: materials.read(name) for name in materials.names()}
    rows = [
        f"| [{name}](#{name}) | {f['title']} | `{f['law']}` | {f['density']:g} | {_ends(f['stretch'])} |"
        for name, f in files.items()
    ]
    return HEAD + "\n".join(rows) + "\n" + "".join(_section(name, f) for name, f in files.items())


def _section(name: str, file: dict[str, Any]) -> str:
    places = [place for place in materials.PLACES if place in file]
    rows = [
        f"| `{key}` | " + " | ".join(_value(file[place][key]) for place in places) + " |" for key in file["typical"]
    ]
    sources = [f"* {each['text']}. {_link(each)}" for each in file["source"]]
    curves = [
        f"* Curve, {c['at']}: (stretch, nominal stress) "
        + ", ".join(f"({stretch:g}, {stress:g})" for stretch, stress in c["points"])
        + f"; error {c['error']:g} of the largest"
        for c in file.get("curve", [])
    ]
    return "\n".join(
        [
            f"\n## {name}\n",
            f"{file['title']}. Measured: {file['condition']}. Chosen: {file['chosen']}. "
            f"Density: {file['density_source']}.\n",
            f"| {file['law']} | " + " | ".join(places) + " |",
            "|---|" + "---|" * len(places),
            *rows,
            "",
            *sources,
            *curves,
            "",
        ]
    )


def _link(source: dict[str, str]) -> str:
    if "doi" in source:
        return f"[{source['doi']}](https://doi.org/{source['doi']})"
    return f"<{source['url']}>"


def _ends(stretch: list[float]) -> str:
    return " to ".join(f"{end:g}" for end in stretch)


def _value(number: Any) -> str:
    return f"[{', '.join(map(_value, number))}]" if isinstance(number, list) else f"{number:.6g}"


if __name__ == "__main__":
    PAGE.write_text(page())
