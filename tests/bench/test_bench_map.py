"""`blimp bench map --campus`: time and memory of builds of many images."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys

import pytest

from ground_station import cli
from ground_station.bench.maps import scale


def bench(*words: object) -> int:
    return cli.main(["bench", "map", *map(str, words)])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "give one of them"),
        (("--campus", "60", "--study", "atrium"), "give one of them"),
        (("--campus", "60", "--seeds", "0"), "--seeds is 0; allowed: 1 to 100"),
        (("--campus", "10"), "--campus is 10; allowed: 50 to 100000"),
        (("--campus", "60", "--processes", "999"), "--processes is 999; allowed: 0 to 256"),
        (
            ("--campus", "60", "--json", "nowhere/told.json"),
            "nowhere/told.json: its folder does not exist",
        ),
    ],
)
def test_a_bad_value_is_one_line(words, said, capsys):
    assert bench(*words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line


def test_builds_of_many_images_are_measured_in_processes_of_their_own(tmp_path, capsys):
    told, drawn = tmp_path / "told.json", tmp_path / "drawn.png"
    words = ("--campus", "50", "--seed", "1", "--json", told, "--plot", drawn)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert bench(*words) == 0
    (row,) = json.loads(told.read_text())["campus"]
    assert row["images"] == row["registered"] == 50 and row["processes"] == 0
    assert set(row["stage_s"]) == {"match", "sfm", "refine", "write"}
    assert row["cpu_s"] > 0 and 0.1 < row["peak_gb"] < 2
    assert 0 < row["median_m"] <= row["max_m"] < 0.3
    said = capsys.readouterr().out
    assert "simulated features" in said and "50" in said
    assert drawn.read_bytes().startswith(b"\x89PNG")
    # What it took was not taken here.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 200_000


def test_memory_is_that_of_all_processes():
    held = "import time; x = bytearray(120_000_000); print(1, flush=True); time.sleep(60)"
    before = scale._resident_bytes(os.getpid())
    with subprocess.Popen([sys.executable, "-c", held], stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        assert scale._resident_bytes(os.getpid()) > before + 110_000_000
        child.kill()
