"""`blimp bench map --campus`: time and memory of builds of many images."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys

from ground_station import cli
from ground_station.bench.maps import scale


def test_builds_of_many_images_are_measured_in_processes_of_their_own(tmp_path, capsys):
    told, drawn = tmp_path / "told.json", tmp_path / "drawn.png"
    words = ("--campus", "50", "--seed", "1", "--json", str(told), "--plot", str(drawn))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert cli.main(["bench", "map", *words]) == 0
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
