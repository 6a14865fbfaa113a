"""The payload's program: instant help, and a check of its configuration."""

import subprocess
import sys
from pathlib import Path

import pytest
from tapped import run

from pi_firmware import settings

PACKAGE = Path(settings.__file__).parent


def loaded(code: str) -> str:
    """What a new interpreter prints."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


def test_help_shows_an_example_and_waits_for_no_heavy_import() -> None:
    told = loaded(
        "import sys, runpy; sys.argv = ['pi_firmware', '--help']\n"
        "try: runpy.run_module('pi_firmware', run_name='__main__')\n"
        "except SystemExit as end: assert end.code == 0\n"
        "print(sorted({'numpy', 'gi', 'zenoh', 'mcap'} & set(sys.modules)))"
    )
    assert "example:" in told and "--config" in told and told.endswith("\n[]\n")


def test_check_reads_the_shipped_file_and_opens_nothing() -> None:
    shipped = str(PACKAGE / "payload.toml")
    told = run("--config", shipped, "--check", "--set", "camera.uri=replay:not-there.mcap")
    assert told == (0, "configuration is good\n", "")


def test_a_check_does_without_what_only_pictures_need() -> None:
    """A card checks what it is told before its first start: numpy would be a third of that."""
    code = "import sys, pi_firmware.__main__ as program; sys.argv[1:] = ['--check']\n"
    code += "assert program.main() == 0; print('numpy' in sys.modules)"
    assert loaded(code) == "configuration is good\nFalse\n"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--check", "--config", "no-such.toml"], "no-such.toml: No such file"),
        (["--check", "--set", "gate.min_entropy_bits=9"], "0 to 8"),
        (["--check", "--set", "camera.uri=webcam:"], "unknown scheme"),
        (["--check", "--set", "battery.uri=i2c:max17048@1:0x40"], "allowed for max17048"),
        (["--set", "camera.uri=test:?pattern=cat"], "allowed: zone-plate"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments: list[str], named: str) -> None:
    status, out, err = run(*arguments)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1 and named in err and err.startswith("pi_firmware: ")
