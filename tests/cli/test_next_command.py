"""Every command ends with the next one, which is a command."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from ground_station import cli
from ground_station.cli import parser as blimp

MAKEFILE = (Path(__file__).parents[2] / "Makefile").read_text()
SILENT = {
    "keys release": "deploy.update reads its last line",
    "map build": "the map says, by ground_station.mapping.construction.verdict",
}


def leaves(
    parser: argparse.ArgumentParser, words: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], argparse.ArgumentParser]]:
    """Each command that runs, by its words."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, sub in action.choices.items():
                yield from leaves(sub, (*words, name))
            return
    yield words, parser


LEAVES = dict(leaves(blimp()))


@pytest.mark.parametrize("words", LEAVES, ids=" ".join)
def test_every_command_ends_with_the_next_which_is_one(words: tuple[str, ...]) -> None:
    command = LEAVES[words]
    template = command.get_default("next")
    if " ".join(words) in SILENT:
        assert template == ""
        return
    values = {action.dest: "X" for action in command._actions}
    said = cli.next_of(argparse.Namespace(**values, next=template))
    program, *rest = shlex.split(said.split("    ")[0])
    if program == "make":
        assert f"\n{rest[0]}:" in MAKEFILE
    else:
        assert program == "blimp"
        blimp().parse_args(rest)


def test_values_are_quoted_and_those_that_were_not_given_leave_it_out() -> None:
    given = argparse.Namespace(next="blimp map view {out|map}", out=None, map="maps/a b")
    assert cli.next_of(given) == "blimp map view 'maps/a b'"
    given.out = Path("maps/{map}")
    assert cli.next_of(given) == "blimp map view 'maps/{map}'"
    assert cli.next_of(argparse.Namespace(next="blimp map view {out}", out=None)) == ""
    assert cli.next_of(argparse.Namespace(next="blimp x {names}", names=["a", "b c"])) == (
        "blimp x a 'b c'"
    )


def test_it_is_the_last_line_and_not_said_after_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "keys"
    assert cli.main(["keys", "--folder", str(folder), "init"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "next: blimp keys ground main"
    assert cli.main(["keys", "--folder", str(folder), "init"]) == 2
    assert "next:" not in capsys.readouterr().out
