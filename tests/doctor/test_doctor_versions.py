"""The doctor tells which firmware a payload runs, and when it is not this checkout's."""

import os
import subprocess
from pathlib import Path

import pytest

from ground_station.doctor import running
from ground_station.doctor.findings import OK, WARNING
from ground_station.stream.telemetry import PayloadState
from pi_firmware import __version__
from pi_firmware.wire.messages import Health


def git(folder: Path, *words: str) -> str:
    names = ("-c", "user.name=x", "-c", "user.email=x@localhost")
    done = subprocess.run(
        ["git", *names, "-C", str(folder), *words],
        env={**os.environ, "HOME": str(folder)},
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
    )
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    (tmp_path / "pi_firmware").mkdir()
    (tmp_path / "pi_firmware/a.py").write_text("1\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "one")
    return tmp_path


def commit(checkout: Path) -> str:
    return f"{__version__}+git{git(checkout, 'rev-parse', 'HEAD')[:12]}"


def test_the_same_firmware_is_no_difference_whatever_else_was_committed(checkout: Path) -> None:
    version = commit(checkout)
    assert running.difference(version, checkout) == ""
    (checkout / "README").write_text("2\n")
    git(checkout, "add", ".")
    git(checkout, "commit", "-qm", "two")
    assert commit(checkout) != version and running.difference(version, checkout) == ""
    (checkout / "pi_firmware/a.py").write_text("3\n")
    assert running.difference(version, checkout) == "the firmware here is another"
    git(checkout, "commit", "-qam", "three")
    assert running.difference(version, checkout) == "the firmware here is another"
    assert running.difference(commit(checkout), checkout) == ""


def test_what_git_cannot_tell(checkout: Path, tmp_path: Path) -> None:
    unknown = f"{__version__}+git{'0123456789ab'}"
    assert running.difference(unknown, checkout) == "its commit is not known here"
    dirty = f"{commit(checkout)}.dirty.01234567"
    assert running.difference(dirty, checkout) == "it has changes that no commit holds"
    assert running.difference(f"{__version__} in 9.0", checkout) == ""
    assert running.difference("0.0.9+gitabcdef0", checkout) == f"here it is {__version__}"
    # An installed service has no git beside it; a hostile version is no argument of git's.
    bare = tmp_path / "bare"
    bare.mkdir()
    assert running.difference(unknown, bare) == ""
    for hostile in ("", "+git", "--output=x", f"{__version__}+git--output=x", "\x1b[2J"):
        assert "\x1b" not in running.difference(hostile, checkout)
    assert not (checkout / "x").exists()


def heard(version: str, release: str = "", reason: str = "") -> PayloadState:
    health = Health(1, 2.0, version=version, release=release, release_reason=reason)
    return PayloadState("blimp-1", health=health)


def test_versions_are_told_and_an_update_that_did_not_stay_is_a_warning(checkout: Path) -> None:
    version = commit(checkout)
    same = running.judge_payloads({"blimp-1": heard(version, "update")}, checkout)
    assert (same.level, same.found) == (OK, f"blimp-1 runs {version} (update)")
    back = running.judge_payloads({"blimp-1": heard(version, "fell back", "no frames")}, checkout)
    assert back.level == WARNING and back.found.endswith("(fell back): no frames") and back.fix
    other = running.judge_payloads({"blimp-1": heard("0.0.1", "factory")}, checkout)
    assert other.level == WARNING and f"here it is {__version__}" in other.found
    assert "make update PAYLOAD=blimp-1" in other.fix
    older = running.judge_payloads({"blimp-1": heard(""), "blimp-2": None}, checkout)
    assert older.level == OK and older.found.count("a version that it does not tell") == 2
