"""The payload's program: instant help, a check of its configuration, no ground station in it."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from pi_firmware import settings

PACKAGE = Path(settings.__file__).parent


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pi_firmware", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_help_shows_an_example() -> None:
    done = run("--help")
    assert done.returncode == 0
    assert "example:" in done.stdout and "--config" in done.stdout


def test_help_waits_for_no_heavy_import() -> None:
    code = (
        "import sys, runpy; sys.argv = ['pi_firmware', '--help']\n"
        "try: runpy.run_module('pi_firmware', run_name='__main__')\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'gi', 'zenoh', 'mcap'} & set(sys.modules)), file=sys.stderr)"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == "[]\n"


def test_check_reads_the_shipped_file_and_opens_nothing() -> None:
    shipped = str(PACKAGE / "payload.toml")
    done = run("--config", shipped, "--check", "--set", "camera.uri=replay:not-there.mcap")
    assert (done.returncode, done.stderr) == (0, "")


def test_a_check_does_without_what_only_pictures_need() -> None:
    """A card checks what it is told before its first start: numpy would be a third of that."""
    code = "import sys, pi_firmware.__main__ as program; sys.argv[1:] = ['--check']\n"
    code += "assert program.main() == 0; print('numpy' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "configuration is good\nFalse\n"


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
    done = run(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1 and named in done.stderr
    assert done.stderr.startswith("pi_firmware: ")


def test_the_payload_imports_nothing_of_the_ground_station() -> None:
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.split(".")[0] == "ground_station" for name in names), path
