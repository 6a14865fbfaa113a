"""The bench's ratios, of one run on one machine, and the command that prints them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ground_station import cli

ATRIUM = Path(__file__).parents[2] / "maps/atrium"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """What the command printed and wrote; a process of its own has the threads a user's has."""
    out = tmp_path_factory.mktemp("bench") / "bench.json"
    arguments = ["--frames", "4", "--repetitions", "20", "--landmarks", "10000", "200000"]
    blimp = Path(sys.executable).with_name("blimp")
    done = subprocess.run(
        [blimp, "bench", "localize", "--map", ATRIUM, *arguments, "--seed", "44", "--json", out],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads(out.read_text())


def test_association_is_five_times_a_loop_with_the_same_pairs(run):
    row = run[1]["association"]
    assert row["same"] and row["pairs"] > 900
    assert row["ratio"] >= 5


def test_the_direct_pose_is_four_times_the_graph_with_the_same_optimum(run):
    row = run[1]["pose"]
    assert row["apart_m"] < 1e-4
    assert row["ratio"] >= 4


def test_a_frame_hardly_costs_more_in_a_larger_map(run):
    small, large = run[1]["growth"]
    assert (small["landmarks"], large["landmarks"]) == (10_000, 200_000)
    assert small["in_view"] == large["in_view"] > 200
    assert large["indexed_ms"] / small["indexed_ms"] <= 1.5
    assert large["plain_ms"] > 2 * large["indexed_ms"]


def test_the_command_prints_and_writes_every_table(run):
    printed, result = run
    for title in ("association", "pose", "decode", "features", "total", "localized", "200000"):
        assert title in printed
    assert result["seed"] == 44 and result["machine"]["cores"] >= 1
    presets = result["frame"]["presets"]
    assert presets["default"]["localized"] == presets["thesis"]["localized"] == 4


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--frames", "1"], "--frames is 1; at least 2"),
        (["--map", "nowhere"], "nowhere: there is no such map"),
        (["--landmarks", "5", "4"], "100 <= 5 < 4"),
    ],
)
def test_a_bad_value_is_one_line(arguments, said, capsys):
    if "--map" not in arguments:
        arguments = [*arguments, "--map", str(ATRIUM)]
    assert cli.main(["bench", "localize", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
