"""What the README files say can be typed: commands, options, targets; links lead somewhere."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from pages import PAGES, ROOT, blocks, commands

from deploy.flash.__main__ import _parser as flash
from ground_station.cli import parser as blimp
from hw.command import parser as hw
from pi_firmware.__main__ import _parser as firmware

TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
MOST_WORDS, MOST_PICTURE_BYTES = 1200, 200 * 1024
PARSERS: dict[str, Callable[[], object]] = {
    "blimp": blimp, "hw": hw, "deploy.flash": flash, "pi_firmware": firmware,
}  # fmt: skip


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_is_one(page: Path) -> None:
    for program, *words in commands(page):
        if program == "make":
            named = {word for word in words if "=" not in word}
            assert named <= TARGETS, f"{page}: make {' '.join(words)}"
        else:
            accepts(program, words, page)


def accepts(program: str, words: Sequence[str], page: Path) -> None:
    """Fails where the program's own parser refuses the words."""
    try:
        PARSERS[program]().parse_args(words)  # type: ignore[attr-defined]
    except SystemExit as ended:
        pytest.fail(f"{page}: {program} {' '.join(words)}: status {ended.code}")


def test_the_pages_have_commands_to_check() -> None:
    found = [words[0] for page in PAGES for words in commands(page)]
    assert found.count("blimp") > 30 and found.count("make") > 20 and "hw" in found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    text = re.sub(r"`[^`]*`", "", page.read_text())
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{page}: {link}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", target.read_text(), re.MULTILINE)
            slugs = [re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-") for h in headings]
            assert anchor in slugs, f"{page}: {link}"


def test_the_readme_is_short_and_has_pictures_that_are_small() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.split()) <= MOST_WORDS
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert {"maps/atrium/map.png", "maps/atrium/dashboard.jpg"} == set(pictures)
    for picture in pictures:
        assert (ROOT / picture).stat().st_size <= MOST_PICTURE_BYTES, picture


def test_python_of_the_pages_is_python() -> None:
    found = [block for page in PAGES for block in blocks(page) if block.startswith("import ")]
    assert found
    for block in found:
        ast.parse(block)
