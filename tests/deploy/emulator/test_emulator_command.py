"""What a person does wrong at the emulator's command is one line."""

import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[3]


def said(*words: str) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "deploy.emulator", *words],
        cwd=CHECKOUT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ((), "expected an IMAGE, or --card"),
        (("a.img", "--card", "b.img"), "not both"),
        (("a.img", "--volts", "6"), "volts 6 is not 0 to 5.11"),
        (("a.img", "--percentage", "70"), "percentage 70 is not 0 to 1"),
        (("a.img", "--ssh-port", "70000"), "--ssh-port is 70000"),
    ],
)
def test_a_wrong_word_is_one_line(words: tuple[str, ...], named: str) -> None:
    status, error = said(*words)
    assert status == 2 and error.startswith("deploy.emulator: ") and named in error
    assert error.count("\n") == 1


def test_help_shows_an_example() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "deploy.emulator", "--help"],
        cwd=CHECKOUT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0 and "example:" in done.stdout
