# SPDX-License-Identifier: MIT
"""The documentation site: references have all of what the code has, links of its pages lead somewhere, it is built."""

import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from typer.core import TyperGroup

import warpfactor
from docs.site import command_pages, docstrings, protocol_pages, python_page, scene_keys, stage
from docs.site.__main__ import built, generated
from protocol import messages_pb2
from protocol.channels import CHANNELS
from sim_server import effects
from sim_server.scene.model import Scene
from tests.docs.figures import ROOT, Row, table_under


def keys_of(schema: dict[str, Any]) -> Iterator[tuple[str, set[str]]]:
    """Name and keys of each table that a JSON schema describes; keys may be none."""
    for model in (schema, *schema.get("$defs", {}).values()):
        if "properties" in model:
            yield model["title"], set(model["properties"])


def key_of(row: Row) -> str:
    return row["key"].strip("`")


def tables(text: str, marks: str) -> dict[str, set[str]]:
    """Keys by heading of a page, of headings of some levels."""
    headings = re.findall(rf"^(?:{marks}) (.+)$", text, re.MULTILINE)
    return {h: {key_of(row) for row in table_under(text, h)} for h in headings if f" {h}\n\nNo keys" not in text}


def test_every_key_of_a_scene_is_in_the_reference() -> None:
    top = scene_keys.page().partition("## Effects")[0]
    shown = list(tables(top, "##").values())
    wanted = dict(keys_of(Scene.model_json_schema()))
    assert len(wanted) > 12
    assert [name for name, keys in wanted.items() if keys not in shown] == []
    assert len(shown) == len(wanted)


@pytest.mark.parametrize("name", effects.known_effects())
def test_every_key_of_an_effect_is_in_the_reference(name: str) -> None:
    text = scene_keys.page().partition("## Effects")[2]
    (part,) = re.findall(rf"^### {name}$(.*?)(?=^### |\Z)", text, re.MULTILINE | re.DOTALL)
    found = [{key_of(row) for row in table_under(f"# x\n{t}", "x")} for t in re.split("^####.*", part, flags=re.M)]
    wanted = [keys for _, keys in keys_of(effects.effect(name).Params.model_json_schema()) if keys]
    assert [keys for keys in wanted if keys not in found] == []


def test_every_key_has_a_meaning_and_a_type() -> None:
    of_effects = (s for name in effects.known_effects() for s in scene_keys.effect_sections(name))
    sections = [*scene_keys.sections(), *of_effects]
    rows = [(section.title, row) for section in sections for row in section.rows]
    assert len(rows) > 250
    assert [(title, row.key) for title, row in rows if not row.meaning or not row.type] == []


def test_defaults_and_bounds_are_those_of_the_models() -> None:
    text = scene_keys.page()
    solver = {key_of(row): row for row in table_under(text, "[solver]")}
    assert solver["tolerance"]["default"] == "`1e-6`" and solver["tolerance"]["allowed"] == "above 0, below 1"
    assert solver["warp"]["type"] == "boolean" and solver["build"]["allowed"] == '`"server"`, `"worker"`'
    assert {key_of(row): row for row in table_under(text, "[[object]]")}["friction"]["live"] == "live"
    law = {key_of(row): row for row in table_under(text, "corotational")}
    assert law["young"]["unit"] == "Pa" and law["young"]["type"] == "number or list of tables"
    assert law["poisson"]["allowed"] == "above -1, below 0.5"


def commands_in(words: str, command: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(command, TyperGroup):
        for name, inner in command.commands.items():
            yield from commands_in(f"{words} {name}", inner)
    else:
        yield words, command


def test_every_command_and_option_is_in_the_reference() -> None:
    from clients.__main__ import app as client
    from clients.demo.command import app as face
    from precond_worker.cli import app as worker
    from sim_server.cli import app as server

    apps = {"sim-server": server, "precond-worker": worker, "sim-client": client, "warpfactor": face}
    text = command_pages.page()
    found = [pair for name, app in apps.items() for pair in commands_in(name, typer.main.get_command(app))]
    assert len(found) > 20
    for words, command in found:
        params = [p for p in command.params if not p.hidden]
        assert re.search(rf"^###? {words}$", text, re.MULTILINE), words
        rows = table_under(text, words)
        shown = {name for row in rows for name in re.findall(r"`(--?[a-z-]+)", row["option"])}
        options = {name for p in params for name in (*p.opts, *p.secondary_opts) if name.startswith("-")}
        assert shown == options, words
        assert len(rows) == len(params), words


def test_every_message_and_channel_is_in_the_reference() -> None:
    text = protocol_pages.page()
    file = messages_pb2.DESCRIPTOR
    for name, message in file.message_types_by_name.items():
        assert {row["name"].strip("`") for row in table_under(text, name)} == {f.name for f in message.fields}
    for name, enum in file.enum_types_by_name.items():
        assert {row["name"].strip("`") for row in table_under(text, name)} == {v.name for v in enum.values}
    assert [row["channel"] for row in table_under(text, "Channels")] == list(CHANNELS)
    header = {row["name"].strip("`"): row for row in table_under(text, "Header")}
    assert header["epoch"]["meaning"] == "topology epoch of the object, 1 at start"
    step = {row["name"].strip("`"): row for row in table_under(text, "ObjectStep")}
    assert step["work"]["type"] == "optional double" and step["form"]["type"] == "[StepForm](#stepform)"


def test_comments_are_those_of_their_fields() -> None:
    text = "// Of it.\n// More.\nmessage A {\n  // before\n  int32 b = 1;  // behind\n  int32 c = 2;\n}\nmessage D {}\n"
    assert protocol_pages.comments(text) == {"A": ("Of it. More.", {"b": "before behind", "c": ""}), "D": ("", {})}


def test_every_public_name_of_python_is_in_the_reference() -> None:
    text = python_page.page()
    for name in warpfactor.__all__:
        assert f"## wf.{name}\n" in text
    assert ".. autoclass:: warpfactor.Simulation\n   :members:" in text


def test_docstrings_become_rest() -> None:
    lines = [
        "Sets |x|, *all* of `name`.",
        "radius: in m, of node_",
        ">>> f(*a)",
        "Formula::",
        "",
        "    a * b",
        "",
        "* one",
    ]
    assert docstrings.converted(lines) == [
        r"Sets \|x\|, \*all\* of ``name``.", "", r"radius: in m, of node\_", "", ">>> f(*a)", "", "Formula::", "",
        "    a * b", "", "* one",
    ]  # fmt: skip


def test_links_are_mapped_to_where_pages_are() -> None:
    asked: list[Path] = []
    text = "[a](../README.md#limits) ![b](figures/web.png) [c](../sim_server/effects/rod.py) [d](#x) `[e](f)` [g](https://h)"
    assert stage.mapped(text, Path("docs/use.md"), asked.append) == (
        "[a](overview.md#limits) ![b](figures/web.png) [c](source/sim_server/effects/rod.py.md) [d](#x) `[e](f)` "
        "[g](https://h)"
    )
    assert Path("sim_server/effects/rod.py") in asked
    assert stage.mapped("[a](docs/bench/cpu.md)", Path("README.md")) == "[a](bench/cpu.md)"
    assert stage.mapped("```\n[a](b)\n```\n", Path("README.md")) == "```\n[a](b)\n```\n"
    with pytest.raises(stage.BadLink, match=r"README.md: docs/nothing.md"):
        stage.mapped("[a](docs/nothing.md)", Path("README.md"))


def test_every_link_of_the_site_leads_to_a_page_of_it(tmp_path: Path) -> None:
    stage.lay_out(tmp_path, {})
    made = generated()
    (tmp_path / "old.md").write_text("of a page that is gone")
    stage.lay_out(tmp_path, made)
    assert not (tmp_path / "old.md").exists()
    files = [path for path in tmp_path.rglob("*.md") if "source" not in path.relative_to(tmp_path).parts[:1]]
    assert len(files) > 40
    for path in files:
        for found in stage.LINK.finditer(stage.CODE.sub("", path.read_text())):
            name = found[2].partition("#")[0]
            if name and not re.match(r"[a-z]+:", name):
                assert (path.parent / name).exists(), (path, found[0])


@pytest.mark.skipif(importlib.util.find_spec("sphinx") is None, reason="needs the extra docs")
def test_the_site_is_built_without_a_warning(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert built(tmp_path / "html", tmp_path / "work") == 0, capfd.readouterr().err
    page = (tmp_path / "html" / "reference" / "python.html").read_text()
    public = [getattr(warpfactor, name) for name in warpfactor.__all__]
    methods = [
        f"warpfactor.{c.__name__}.{name}"
        for c in public
        if isinstance(c, type)
        for name, member in vars(c).items()
        if not name.startswith("_") and callable(getattr(c, name)) and member.__doc__
    ]
    assert len(methods) > 10 and [name for name in methods if f'id="{name}"' not in page] == []
    assert (tmp_path / "html" / "index.html").read_text().count("sd-card-body") == 6


def test_ignored_files_are_no_pages() -> None:
    assert ROOT / "docs" / "scenes.md" in [ROOT / path for path in stage.pages()]
    assert all(path.suffix == ".md" for path in stage.pages())


def test_every_page_is_in_a_table_of_contents() -> None:
    """What Sphinx says of one that is not ends the build; it is not there where the default tests run."""
    trees = re.findall(
        r"```\{toctree\}(.*?)```", "".join(p.read_text() for p in (ROOT / "docs/site").glob("*.md")), re.S
    )
    listed = {Path(line.split("<")[-1].strip(" >")).name for tree in trees for line in tree.splitlines()}
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert len(pages) > 20 and pages - listed == set()
