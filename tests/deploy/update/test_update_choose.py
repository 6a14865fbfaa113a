"""Which release a card starts, whatever is on it: some release always is."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from card_stand import CHECKOUT, NEW, NOW, OLD, Card, contents

from deploy.board import start
from deploy.board.releases import choose
from deploy.board.releases.choose import FRAMELESS, STARTS, Choice, State

UNIT = CHECKOUT / "deploy/board/root/usr/lib/systemd/system/blimp-payload.service"
TRIAL = {"id": "t", "release": NEW, "previous": OLD, "boot_id": "b", "started_s": 1.0}
OF_IMAGE = TRIAL | {"previous": ""}
BACK = {"id": "t", "release": NEW, "previous": OLD, "outcome": "fell back", "reason": "why"}
GOOD = BACK | {"outcome": "healthy", "reason": ""}
DARK = f"{NEW}: no frame in {FRAMELESS} starts"
NEVER = f"{NEW}: started {STARTS} times without getting healthy"


@pytest.mark.parametrize(
    ("state", "broken", "expected"),
    [
        (State(), (), Choice("", "factory")),
        (State(NEW), (), Choice(NEW, "update")),
        (State(NEW, OLD, last=GOOD), (), Choice(NEW, "update")),
        # On trial: so many starts, then the one before.
        (State(NEW, trial=TRIAL), (), Choice(NEW, "update")),
        (State(NEW, trial=TRIAL, starts=STARTS - 1), (), Choice(NEW, "update")),
        (State(NEW, trial=TRIAL, starts=STARTS), (), Choice(OLD, "fell back", NEVER)),
        (State(NEW, trial=OF_IMAGE, starts=STARTS), (), Choice("", "fell back", NEVER)),
        (State(NEW, trial=TRIAL, starts=STARTS), (OLD,), Choice("", "fell back", NEVER)),
        (
            State(NEW, trial=TRIAL, starts=-1),
            (),
            Choice(OLD, "fell back", f"{NEW}: its starts cannot be counted on /data/state"),
        ),
        # A trial of another release than the one in force is over, or has not begun.
        (State(OLD, trial=TRIAL, starts=STARTS), (), Choice(OLD, "update")),
        # Later on: so many starts without a frame, then the one before, then the image's.
        (State(NEW, OLD, frameless=FRAMELESS - 1), (), Choice(NEW, "update")),
        (State(NEW, OLD, frameless=FRAMELESS), (), Choice(OLD, "fell back", DARK)),
        (State(NEW, OLD, frameless=2 * FRAMELESS), (), Choice("", "fell back", DARK)),
        (State("", OLD, frameless=FRAMELESS), (), Choice("", "factory")),
        (State(NEW, trial=TRIAL, frameless=FRAMELESS), (), Choice(NEW, "update")),
        # Damaged ones are passed over; the first reason is told.
        (State(NEW, OLD), (NEW,), Choice(OLD, "fell back", f"{NEW}: broken")),
        (State(NEW, OLD), (NEW, OLD), Choice("", "fell back", f"{NEW}: broken")),
        (State(NEW), (NEW,), Choice("", "fell back", f"{NEW}: broken")),
        (State(NEW, trial=TRIAL), (NEW,), Choice(OLD, "fell back", f"{NEW}: broken")),
        # An update that failed is told until another is in force.
        (State(OLD, last=BACK), (), Choice(OLD, "fell back", "why")),
        (State("", last=BACK | {"previous": ""}), (), Choice("", "fell back", "why")),
        (State(NEW, last=BACK | {"previous": ""}), (), Choice(NEW, "update")),
    ],
)
def test_the_choice(state: State, broken: tuple[str, ...], expected: Choice) -> None:
    assert choose.choose(state, lambda name: "broken" if name in broken else "") == expected


def test_a_card_without_updates_starts_the_images_release(card: Card) -> None:
    assert card.choice() == Choice("", "factory")
    card.at.releases.rmdir()
    assert card.choice() == Choice("", "factory")


@pytest.mark.parametrize("target", ["gone", "../../etc", "/etc", "a b", "9.part", "."])
def test_a_link_to_no_release_is_the_images(card: Card, target: str) -> None:
    (card.at.releases / "current").symlink_to(target)
    assert card.choice().name == ""


def replaced_by_a_link(folder: Path) -> None:
    folder.rename(folder.with_name("7.0"))
    folder.symlink_to("7.0")


DAMAGES: dict[str, Callable[[Path], object]] = {
    "cut file": lambda folder: os.truncate(folder / "site/native.so", 100),
    "missing file": lambda folder: (folder / "pi_firmware/__main__.py").unlink(),
    "no list": lambda folder: (folder / "manifest.json").unlink(),
    "nonsense": lambda folder: (folder / "manifest.json").write_text('{"files": [[1, 2], null]}'),
    "empty list": lambda folder: os.truncate(folder / "manifest.json", 0),
    "a link in its place": replaced_by_a_link,
}


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_release_is_not_started(card: Card, what: str) -> None:
    card.take(card.bundle(contents(NEW)))
    card.at.trial.unlink()
    assert card.choice() == Choice(NEW, "update")
    DAMAGES[what](card.at.folder(NEW))
    chosen = card.choice()
    assert (chosen.name, chosen.how) == ("", "fell back") and chosen.reason.startswith(NEW)


def test_starts_of_a_trial_are_counted_across_power_cuts(card: Card) -> None:
    card.take(card.bundle(contents(NEW)))
    assert [card.choice().name for _ in range(STARTS + 2)] == [NEW] * STARTS + ["", ""]
    assert card.choice() == Choice("", "fell back", NEVER)


def test_an_update_without_frames_leaves_its_place_until_frames_come(card: Card) -> None:
    card.take(card.bundle(contents(NEW)))
    card.at.trial.unlink()
    names = [card.choice().name for _ in range(FRAMELESS + 2)]
    assert names == [NEW] * FRAMELESS + ["", ""]
    assert card.choice() == Choice("", "fell back", DARK)
    after = re.search(r"ExecStartPost=-/usr/bin/rm -f (/\S+)", UNIT.read_text())
    assert after is not None  # systemd does it once READY=1 came
    Path(f"{card.root}{after[1]}").unlink()
    assert card.choice() == Choice(NEW, "update")
    card.at.frameless.unlink()
    card.at.frameless.parent.rmdir()
    assert card.choice() == Choice(NEW, "update")  # what cannot be counted holds up no flight


def test_another_trial_of_the_same_release_counts_from_zero(card: Card) -> None:
    card.take(card.bundle(contents(NEW)))
    for _ in range(STARTS + 1):
        card.choice()
    trial = json.loads(card.at.trial.read_text())
    card.at.trial.write_text(json.dumps(trial | {"id": "another"}))
    assert card.choice().name == NEW


def test_a_trial_that_cannot_be_counted_is_not_started(card: Card) -> None:
    card.take(card.bundle(contents(NEW)))
    card.at.starts.parent.rmdir()
    assert card.choice().name == "" and "cannot be counted" in card.choice().reason


@pytest.mark.parametrize("body", [b"", b"\xff", b"[]", b"[" * 9999, b"{}", b'{"id": 1}'])
def test_state_files_of_nonsense_are_as_none(card: Card, body: bytes) -> None:
    card.take(card.bundle(contents(NEW)))
    for path in (card.at.trial, card.at.last, card.at.starts):
        path.write_bytes(body)
    assert card.choice() == Choice(NEW, "update")


def test_start_becomes_the_firmware_of_the_chosen_release(card: Card) -> None:
    program = b"""
import json, os, sys
import pi_firmware, library
told = json.loads(os.environ["BLIMP_RELEASE"]), sys.dont_write_bytecode
print(json.dumps([pi_firmware.__version__, library.NAME, os.getpid(), sys.argv[1:], told]))
"""
    more = {"pi_firmware/__main__.py": program, "site/library.py": b"NAME = 'of the update'\n"}
    card.take(card.bundle(contents(NEW, more)))
    process = subprocess.Popen(
        [sys.executable, "-m", "deploy.board.start", "--root", str(card.root), "--set", "a.b=1"],
        cwd=card.root,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    out, _ = process.communicate(timeout=60)
    first, second = out.splitlines()
    version, library, pid, arguments, told = json.loads(second)
    assert first == f"start: release {NEW} (update)"
    assert (version, library, pid) == (NEW, "of the update", process.pid)
    assert arguments == ["--config", str(card.at.config), "--set", "a.b=1"]
    assert told == [{"version": NEW, "how": "update", "reason": ""}, True]
    running: dict[str, Any] = json.loads(card.at.running.read_text())
    assert (running["name"], running["version"], running["how"]) == (NEW, NEW, "update")
    assert running["trial"] == json.loads(card.at.trial.read_text())["id"]


def test_start_tells_the_version_of_the_images_release(card: Card) -> None:
    assert start.release_of(card.at, card.choice())["version"] == NOW
    (card.at.factory / "release.json").unlink()
    told = start.release_of(card.at, card.choice())
    assert told == {"version": "", "how": "factory", "reason": ""}


def test_a_start_loads_little() -> None:
    """Each of these would cost a Pi Zero a good part of a second, at each start."""
    heavy = ["subprocess", "shutil", "tempfile", "dataclasses", "argparse", "hashlib"]
    code = (
        f"import sys; sys.path.insert(0, {str(CHECKOUT)!r}); import deploy.board.start;"
        f" print([name for name in {heavy} if name in sys.modules])"
    )
    command = [sys.executable, "-S", "-E", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"
