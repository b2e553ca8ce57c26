# SPDX-License-Identifier: MIT
"""Lays out the pages of the site for Sphinx: copies of what people read in the repository, with links mapped.

README.md, docs/*.md and others stay plain Markdown for GitHub. Their copies have other places, so every relative link
is rewritten; a link to a file of code leads to a page that shows it, one to a folder to a page that lists it.
"""

import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[2]
RENAMED = {"README.md": "overview.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
COPIED = {".png", ".gif", ".svg", ".csv"}
LANGUAGES = {".py": "python", ".pyi": "python", ".toml": "toml", ".sh": "sh", ".md": "md"}
LANGUAGES |= dict.fromkeys((".cu", ".cuh", ".cpp", ".h"), "cpp") | {".proto": "protobuf"}
LARGEST = 200_000  # bytes of a file that is shown; meshes are larger
CODE = re.compile(r"^(```|~~~).*?^\1|`[^`\n]+`", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(\]\()([^)\s]+)(\))")


class BadLink(Exception):
    """A link that leads to nothing in the repository."""


def pages() -> list[Path]:
    """Markdown files that are pages of the site, relative to the repository."""
    found = [ROOT / name for name in RENAMED]
    found += (ROOT / "docs").rglob("*.md")
    return sorted(path.relative_to(ROOT) for path in found)


def place(path: Path) -> str:
    """Where a file of the repository is on the site. path: relative to the repository."""
    if path.as_posix() in RENAMED:
        return RENAMED[path.as_posix()]
    parts = path.parts
    if parts[:2] == ("docs", "site") and path.suffix == ".md":
        return "/".join(parts[2:])
    if parts[0] == "docs" and path.suffix in {".md", *COPIED}:
        return "/".join(parts[1:])
    return f"source/{path.as_posix()}{'/index' if (ROOT / path).is_dir() else ''}.md"


def mapped(text: str, at: Path, wanted: Callable[[Path], None] = lambda path: None) -> str:
    """The text of a page with its links as they are on the site; code is left alone.

    at: the file, relative to the repository. wanted: is told of each file that a link leads to. Raises BadLink.
    """

    def link(found: re.Match[str]) -> str:
        name, sharp, anchor = found[2].partition("#")
        if not name or re.match(r"[a-z]+:", name):
            return found[0]
        there = Path(os.path.normpath(ROOT / at.parent / name))
        if not there.exists() or not there.is_relative_to(ROOT):
            raise BadLink(f"{at}: {found[2]}")
        there = there.relative_to(ROOT)
        wanted(there)
        here = PurePosixPath(place(at)).parent
        return f"{found[1]}{os.path.relpath(place(there), here)}{sharp}{anchor}{found[3]}"

    parts, last = [], 0
    for code in CODE.finditer(text):
        parts += [LINK.sub(link, text[last : code.start()]), code[0]]
        last = code.end()
    return "".join([*parts, LINK.sub(link, text[last:])])


def source_page(path: Path) -> str:
    """A page that shows a file of the repository, or lists a folder."""
    title = f"---\norphan: true\n---\n# {path.as_posix()}\n\n"
    if (ROOT / path).is_dir():
        here = PurePosixPath(place(path)).parent
        names = [(each.name, os.path.relpath(place(each), here)) for each in listed(path)]
        return title + "\n".join(f"* [{name}]({to})" for name, to in names) + "\n"
    text = (ROOT / path).read_text()
    return f"{title}````{LANGUAGES.get(path.suffix, 'text')}\n{text}\n````\n"


def listed(folder: Path) -> list[Path]:
    """Files of a folder that can be shown, relative to the repository."""
    files = [file for file in sorted((ROOT / folder).iterdir()) if file.is_file() and file.suffix in LANGUAGES]
    return [file.relative_to(ROOT) for file in files if file.stat().st_size < LARGEST]


def staged() -> Iterator[tuple[str, str]]:
    """Yields the place and the text of each page that is not generated. Raises BadLink."""
    asked: set[Path] = set()
    told = pages()
    for path in told:
        yield place(path), mapped((ROOT / path).read_text(), path, asked.add)
    queue = sorted(path for path in asked if place(path).startswith("source/"))
    shown: set[Path] = set()
    while queue:
        path = queue.pop()
        if path not in shown:
            shown.add(path)
            queue += listed(path) if (ROOT / path).is_dir() else []
            yield place(path), source_page(path)


def lay_out(folder: Path, generated: dict[str, str]) -> None:
    """Writes all pages and pictures to a folder, and removes from it what is none of them.

    Files whose text is as before are left alone, so that Sphinx reads again only what has changed.
    """
    texts = {**dict(staged()), **generated}
    pictures = {place(p.relative_to(ROOT)): p for p in (ROOT / "docs").rglob("*") if p.suffix in COPIED}
    for old in [path for path in folder.rglob("*") if path.is_file()]:
        if old.relative_to(folder).as_posix() not in {*texts, *pictures}:
            old.unlink()
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
    for name, picture in pictures.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_bytes() != picture.read_bytes():
            shutil.copyfile(picture, path)
