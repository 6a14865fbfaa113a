"""Each module of the product is reached from its own room's tests, or named as one that is not."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterable
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
ELSEWHERE = REPOSITORY / "tests/cli/covered_elsewhere.txt"
PACKAGES = ("pi_firmware", "ground_station", "deploy", "hw")
ROOMS = {
    "cli": ("cli", "commands"),
    "replay": ("replay", "hil"),
    "pi_firmware": ("pi_firmware", "wire", "i2c", "faults"),
}
"""Rooms whose tests are in more folders than the one of their name."""


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)


@functools.cache
def modules() -> dict[str, Path]:
    files = (path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py"))
    return {name_of(path): path for path in files if path.name != "__init__.py"}


def room(module: str) -> str:
    package, first, *more = module.split(".")
    if package != "ground_station":
        return package
    return first if more and first != "commands" else "cli"


@functools.cache
def named_in(path: Path) -> set[str]:
    """Modules that a file imports, by a folder in which they are found, or starts by name."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            folders = {name.rpartition(".")[0] for name in modules()} & names
            found |= {node.module, *names}
            found |= {name for name in modules() if name.rpartition(".")[0] in folders}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found |= {node.value, f"{node.value}.__main__"}  # as `python -m` takes it
    return found & modules().keys()


def reached(folders: Iterable[str], own: str) -> set[str]:
    """Modules of a room that its tests name, and those of the room that these import."""
    tests = [path for name in folders for path in (REPOSITORY / "tests" / name).rglob("*.py")]
    new = set().union(*(named_in(path) for path in tests))
    if any(room(module) == "cli" for module in new):  # and these its commands
        new |= {
            one for one, path in modules().items() if "\ndef add_arguments(" in path.read_text()
        }
    new = {module for module in new if room(module) == own}
    found: set[str] = set()
    while new:
        found |= new
        named = set().union(*(named_in(modules()[module]) for module in new))
        new = {module for module in named if room(module) == own} - found
    return found


def test_each_module_is_reached_from_the_tests_of_its_own_room() -> None:
    """A module that is not has its tests to be written there; the list may only shrink."""
    rooms = {room(module) for module in modules()}
    covered = set().union(*(reached(ROOMS.get(own, (own,)), own) for own in rooms))
    lacking = modules().keys() - covered
    listed = {line for line in ELSEWHERE.read_text().splitlines() if line and line[0] != "#"}
    assert sorted(lacking - listed) == [], "no test of its own room reaches it"
    assert sorted(listed - lacking) == [], "it is covered now: take it out of the list"
