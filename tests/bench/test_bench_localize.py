"""What the bench compares is the same, and is printed; how fast it was is for a reader."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ATRIUM = Path(__file__).parents[2] / "maps/atrium"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """What the command printed and wrote; a process of its own has the threads a user's has."""
    out = tmp_path_factory.mktemp("bench") / "bench.json"
    arguments = ["--frames", "4", "--repetitions", "5", "--landmarks", "10000", "200000"]
    blimp = Path(sys.executable).with_name("blimp")
    done = subprocess.run(
        [blimp, "bench", "localize", "--map", ATRIUM, *arguments, "--seed", "44", "--json", out],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads(out.read_text())


def test_association_is_compared_with_a_loop_that_has_the_same_pairs(run):
    row = run[1]["association"]
    assert row["same"] and row["pairs"] > 900 and row["ratio"] > 0


def test_a_larger_map_shows_no_more_of_itself(run):
    small, large, dense = run[1]["growth"]
    assert (small["landmarks"], large["landmarks"]) == (10_000, 200_000)
    assert large["in_view"] == pytest.approx(small["in_view"], rel=0.2) and small["in_view"] > 200
    assert dense["landmarks"] == 200_000 and dense["density"] == 10
    assert dense["in_view"] > 7 * large["in_view"]
    assert small["localized"] == large["localized"] == dense["localized"] == 5


def test_a_large_map_stays_small_in_memory(run):
    memory = run[1]["memory"]
    assert memory["landmarks"] == 200_000 and memory["tracked"]
    # A fifth of 10⁶ landmarks; 1.5 GB are allowed for those.
    assert 50 < memory["peak_mb"] - memory["idle_mb"] < 300


def test_the_command_prints_and_writes_every_table(run):
    printed, result = run
    for title in (
        "association",
        "pose",
        "decode",
        "features",
        "total",
        "localized",
        "200000",
        "MB resident",
    ):
        assert title in printed
    assert result["seed"] == 44 and result["machine"]["cores"] >= 1
    presets = result["frame"]["presets"]
    assert presets["default"]["localized"] == presets["thesis"]["localized"] == 4
