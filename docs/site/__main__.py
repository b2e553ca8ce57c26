# SPDX-License-Identifier: MIT
"""Builds the documentation site into out/site; with --links asks whether external links still lead somewhere."""

import argparse
import subprocess
import sys
from pathlib import Path

from docs.site import command_pages, protocol_pages, python_page, scene_keys
from docs.site.stage import ROOT, BadLink, lay_out

HERE = Path(__file__).parent


def generated() -> dict[str, str]:
    """The pages that are made from the code, by their places on the site."""
    return {
        "reference/scene_keys.md": scene_keys.page(),
        "reference/commands_and_options.md": command_pages.page(),
        "reference/messages.md": protocol_pages.page(),
        "reference/python.md": python_page.page(),
    }


def built(out: Path, work: Path, builder: str = "html", strict: bool = True) -> int:
    """Lays the pages out and runs Sphinx; returns its exit code. work: for what it reads and keeps. Raises BadLink."""
    lay_out(work / "pages", generated())
    strictly = ["--fail-on-warning", "--keep-going"] if strict else []
    arguments = ["-b", builder, "-c", str(HERE), "-d", str(work / "doctrees"), "-q", *strictly]
    return subprocess.call([sys.executable, "-m", "sphinx", *arguments, str(work / "pages"), str(out)], cwd=ROOT)


def main() -> int:
    parser = argparse.ArgumentParser(prog="deploy/run site", description=__doc__)
    parser.add_argument("--links", action="store_true", help="check external links, which needs the internet")
    links = parser.parse_args().links
    work, out = ROOT / "out" / "site-work", ROOT / "out" / "site"
    try:
        code = built(work / "links", work, "linkcheck", False) if links else built(out, work)
    except BadLink as error:
        print(f"deploy/run site: no such file: {error}", file=sys.stderr)
        return 2
    if links:
        print((work / "links" / "output.txt").read_text() or "all external links lead somewhere")
    elif code == 0:
        print(f"open {out / 'index.html'}")
    return code


if __name__ == "__main__":
    sys.exit(main())
