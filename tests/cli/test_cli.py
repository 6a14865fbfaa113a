"""The `blimp` command: help is instant and shows an example, errors are one line and status 2."""

import subprocess
import sys
from pathlib import Path

import pytest

BLIMP = Path(sys.executable).with_name("blimp")
COMMANDS = [
    ["simulate"],
    ["calibrate"],
    ["map", "build"],
    ["map", "register"],
    ["map", "info"],
    ["localize"],
    ["replay"],
    ["command"],
    ["serve"],
    ["import"],
    ["models", "list"],
    ["models", "import"],
    ["models", "quantize"],
    ["models", "info"],
    ["models", "train"],
    ["evaluate"],
    ["keys"],
    ["bench", "localize"],
    ["bench", "payload"],
]
HEAVY = (
    "numpy",
    "cv2",
    "pycolmap",
    "gtsam",
    "mujoco",
    "matplotlib",
    "zenoh",
    "av",
    "gi",
    "scipy",
    "onnx",
    "onnxruntime",
    "torch",
)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_shows_an_example(command: list[str]) -> None:
    run = subprocess.run([BLIMP, *command, "--help"], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0
    assert f"blimp {' '.join(command)} " in run.stdout.split("xample", 1)[1]


def test_help_imports_nothing_heavy() -> None:
    """Parsers are built before heavy modules are imported, so that help is instant."""
    code = (
        "import sys, ground_station.cli as c; c.parser();"
        f"print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert run.stdout.strip() == "[]", run.stdout + run.stderr


def test_a_closed_pipe_is_not_an_error() -> None:
    run = subprocess.run(f"{BLIMP} --help | true", shell=True, capture_output=True, timeout=60)
    assert b"Traceback" not in run.stderr
