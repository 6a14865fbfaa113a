"""Programs whose output nobody reads on end quietly."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "words",
    ["ground_station.cli --help", "ground_station.cli --version", "ground_station.cli models list",
     "hw budget"],
)  # fmt: skip
def test_a_closed_pipe_is_not_an_error(words: str) -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", *words.split()]
    run = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, timeout=60)
    os.close(write)
    assert (run.returncode, run.stderr) == (0, b"")
