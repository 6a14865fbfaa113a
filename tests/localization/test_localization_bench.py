"""The bench's ratios, of one run on one machine, and the command that prints them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ground_station import cli
from ground_station.localization import bench

ATRIUM = Path(__file__).parents[2] / "maps/atrium"


def test_association_is_five_times_a_loop_with_the_same_pairs():
    row = bench.association(seed=41, repetitions=12)
    assert row["same"] and row["pairs"] > 900
    assert row["ratio"] >= 5


def test_the_direct_pose_is_four_times_the_graph_with_the_same_optimum():
    row = bench.pose(seed=42, repetitions=12)
    assert row["apart_m"] < 1e-4
    assert row["ratio"] >= 4


def test_a_frame_hardly_costs_more_in_a_larger_map():
    small, large = bench.growth(seed=43, repetitions=20, sizes=(10_000, 200_000))
    assert small["in_view"] == large["in_view"] > 200
    assert large["indexed_ms"] / small["indexed_ms"] <= 1.5
    assert large["plain_ms"] > 2 * large["indexed_ms"]


def test_the_command_prints_and_writes_every_table(tmp_path, capsys):
    out = tmp_path / "bench.json"
    arguments = ["--frames", "4", "--repetitions", "3", "--landmarks", "2000", "8000"]
    status = cli.main(
        ["bench", "localize", "--map", str(ATRIUM), *arguments, "--json", str(out), "--seed", "44"]
    )
    printed = capsys.readouterr().out
    assert status == 0
    for title in ("association", "pose", "decode", "features", "total", "localized", "8000"):
        assert title in printed
    result = json.loads(out.read_text())
    assert result["seed"] == 44 and result["machine"]["cores"] >= 1
    presets = result["frame"]["presets"]
    assert presets["default"]["localized"] == presets["thesis"]["localized"] == 4
    assert [row["landmarks"] for row in result["growth"]] == [2000, 8000]


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
