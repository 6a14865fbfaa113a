"""A small experiment from nothing to its report: flown, mapped, localized, and all of it again."""

from __future__ import annotations

import functools
import json
import shutil
import tomllib
from dataclasses import replace

import pytest

from ground_station.cli import main
from ground_station.experiments import flights, schedule
from ground_station.simulator import lighting
from ground_station.simulator.simulate import simulate

TEXT = """
seeds = [3]
[default.flight]
duration_s = 2.0
rate_hz = 5.0
[default.map]
images = 10
seed = 3
[default.map.flight]
plan = "loop"
duration_s = 5.0
rate_hz = 2.0
[experiment.path]
level = "covered for, s"
[experiment.path.case."0"]
[experiment.path.case."1"]
presets = ["default"]
alter.dark_from_s = 0.5
alter.dark_s = 1.0
alter.stamp_error_s = 0.01
"""
ONLY = '[default]\npresets = ["default"]\n'


def coarsely(job, folder, data):
    """Does a job; what is flown is drawn more coarsely, and lit from fewer directions."""
    coarse = {"texels_per_m": 60.0, "supersampling": 1.0}
    lighting._SKY_DIRECTIONS, lighting._SUN_MAP_PX = 8, 1024
    flights.simulate = lambda settings: simulate(replace(settings, **coarse))
    schedule.work(job, folder, data)


@pytest.fixture
def flown(tmp_path, monkeypatch):
    """A folder with experiments."""
    (tmp_path / "e.toml").write_text(TEXT)
    monkeypatch.setattr(schedule, "carry_out", functools.partial(schedule.carry_out, do=coarsely))
    return tmp_path


def run(folder, capfd):
    """Of the command in the folder; its results and what it printed."""
    words = ["experiments", "--file", str(folder / "e.toml"), "--out", str(folder / "out")]
    status = main([*words, "--jobs", "1"])
    said = capfd.readouterr()
    found = json.loads((folder / "out" / "results.json").read_text())
    assert status == (1 if found["worse"] else 0)
    return found, said.out + said.err


def test_it_is_flown_mapped_and_localized_and_again_gives_the_same(flown, capfd):
    first, _ = run(flown, capfd)
    whole, covered = first["experiments"][0]["cases"]
    for preset in ("thesis", "alone", "default"):
        row = whole["presets"][preset]
        assert row["failed"] == [] and row["keyframes"] == 10 and row["landmarks"] > 300
        assert row["localized"] >= 0.8 and row["position_m"]["mean"] < 0.15, row["position_m"]
    ours = whole["presets"]["default"]
    assert ours["position_m"]["mean"] < 0.05 and ours["consistency"]["inside_95"] > 0.5
    assert ours["smoothed_m"]["mean"] < 0.05
    dark = covered["presets"]["default"]
    assert len(dark["runs"][0]["seen_s"]) == 10 and dark["runs"][0]["localized"] <= 6
    assert dark["gap_s"]["mean"] > 0.9
    judged = dark["runs"][0]["series"]["time_s"]  # by the true times, whatever it was told
    assert len(judged) == dark["runs"][0]["localized"] and judged == [round(t, 1) for t in judged]
    page = (flown / "out" / "report.html").read_text()
    assert "covered for, s" in page and "data:image/png" in page

    # The default's runs again, in a map that is built again by what the lost build has found.
    shutil.rmtree(flown / "out" / "maps")
    shutil.rmtree(flown / "out" / "runs")
    (flown / "e.toml").write_text(TEXT.replace("[default.flight]", f"{ONLY}[default.flight]"))
    second, said = run(flown, capfd)
    (file,) = (flown / "out" / "maps").glob("*/map.toml")
    cache = tomllib.loads(file.read_text())["built"]["cache"]
    assert (cache["features_found"], cache["features_made"]) == (10, 0)
    assert "experiments, jobs: 3 in" in said
    for one, other in zip(_runs(first), _runs(second), strict=True):
        assert one["localized"] == other["localized"]
        assert one["position_m"] == pytest.approx(other["position_m"], abs=1e-4)
        assert one["rotation_deg"] == pytest.approx(other["rotation_deg"], abs=1e-3)


def _runs(document):
    cases = document["experiments"][0]["cases"]
    return [run for case in cases for run in case["presets"]["default"]["runs"]]
