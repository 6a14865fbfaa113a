"""The `blimp` command: help is instant and shows an example; each command ends with the next."""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ground_station import cli

BLIMP = Path(sys.executable).with_name("blimp")
HEAVY = ("numpy", "cv2", "pycolmap", "gtsam", "mujoco", "matplotlib", "zenoh", "av", "gi", "scipy",
         "onnx", "onnxruntime", "torch")  # fmt: skip
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


LEAVES = dict(leaves(cli.parser()))


@pytest.mark.parametrize(
    "words", sorted({words[:1] if words[0] == "keys" else words for words in LEAVES}), ids=" ".join
)
def test_help_shows_an_example(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*words, "--help"])
    assert f"blimp {' '.join(words)} " in capsys.readouterr().out.split("xample", 1)[1]


def test_help_imports_nothing_heavy() -> None:
    """Parsers are built before heavy modules are imported, so that help is instant."""
    code = (
        "import sys, ground_station.cli as c; c.parser();"
        f"print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert run.stdout.strip() == "[]", run.stdout + run.stderr


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
        cli.parser().parse_args(rest)


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
