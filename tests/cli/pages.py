"""The project's README files: their blocks, and the command lines of ours in them."""

from __future__ import annotations

import re
import shlex
import textwrap
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOMS = ("deploy", "ground_station", "hw", "maps", "pi_firmware", "tests")
PAGES = [ROOT / "README.md", *(page for room in ROOMS for page in (ROOT / room).rglob("README.md"))]
MODULES = ("hw", "deploy.flash", "pi_firmware")
"""Programs that pages start by `python -m`."""


def blocks(page: Path) -> Iterator[str]:
    """The indented blocks of a page, whole; those of a list are indented by more."""
    for block in re.findall(r"(?:^ {4,}.*\n|^\n(?= {4}))+", page.read_text(), re.MULTILINE):
        yield textwrap.dedent(block).strip("\n")


def commands(page: Path) -> Iterator[list[str]]:
    """The words of each command line of ours in a page's blocks, without prompt and comment."""
    for block in blocks(page):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"\s#\s|\s{6,}(?=[a-z])", line)[0].split(";"):
                words = shlex.split(part) if part.count("'") % 2 == 0 else []
                words = [word for word in words if word != "sudo" and not word.startswith("blimp=")]
                if words and Path(words[0]).name in ("make", "blimp", "$blimp"):
                    yield [Path(words[0]).name.removeprefix("$"), *words[1:]]
                elif len(words) > 2 and words[1] == "-m" and words[2] in MODULES:
                    yield words[2:]
