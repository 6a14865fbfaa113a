"""`blimp bench features`: what is measured, what is left out, what is kept."""

from __future__ import annotations

import json

import pytest
from test_bench_features import write_pair

from ground_station import cli
from ground_station.bench.features import flights, poses
from ground_station.errors import MapError


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Runs the command with made-up data in a folder of its own; its status and figures."""
    monkeypatch.setenv("BLIMP_MODELS", str(tmp_path / "no models"))
    write_pair(tmp_path / "data" / "illumination")

    def run(*words: str):
        out = tmp_path / "figures.json"
        out.unlink(missing_ok=True)
        status = cli.main(
            ["bench", "features", "--data", str(tmp_path / "data"), "--sample", str(tmp_path),
             "--work", str(tmp_path / "work"), "--json", str(out), "--quick",
             "--extractors", "rootsift", "orb", *words]
        )  # fmt: skip
        return status, json.loads(out.read_text()) if out.is_file() else None

    return run


def test_all_extractors_stand_in_one_table_and_in_the_json(bench, capsys):
    status, found = bench("--only", "homographies", "times", "--max-features", "400")
    assert status == 0 and found["quick"] is True and found["max_features"] == 400
    for name in ("rootsift", "orb"):
        row = found["extractors"][name]
        assert row["homographies"]["accuracy"] > 0.7 and row["time"]["ms"] > 0
        assert row["homographies"]["pairs"][0]["pair"] == "wall 1-2"
    out = capsys.readouterr().out
    assert "rootsift" in out and "orb" in out and "wall" in out


def test_what_has_no_data_is_left_out_by_name_and_the_rest_is_measured(bench, capsys):
    status, found = bench()
    assert status == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert len(lines) == 2
    assert "poses left out" in lines[0] and "redkitchen/frames: there is no such" in lines[0]
    assert "flights left out" in lines[1] and "mapping.mcap: there is no such" in lines[1]
    assert set(found["extractors"]["orb"]) == {
        "name", "sha256", "dimension", "homographies", "time",
    }  # fmt: skip


def test_what_is_asked_for_and_has_no_data_ends_with_status_2(bench, capsys):
    status, _ = bench("--only", "poses")
    assert status == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "redkitchen/frames" in line


@pytest.mark.parametrize(
    "words, reason",
    [
        (("--max-features", "3"), "--max-features is 3; allowed: 50 to 20000"),
        (("--threads", "99"), "--threads is 99"),
        (("--repetitions", "1"), "--repetitions is 1"),
        (("--extractors", "surf"), "no extractor 'surf' (known: "),
    ],
)
def test_values_out_of_range_are_refused_in_one_line(bench, capsys, words, reason):
    status, _ = bench(*words)
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert status == 2 and reason in line


def test_long_rows_are_kept_and_a_bench_that_was_stopped_goes_on(bench, tmp_path, monkeypatch):
    calls = []

    def measure(folder, mapping, localizer, ranges, work):
        calls.append(mapping.features)
        assert work.is_dir() and localizer.features.max_features == 1000
        if mapping.features == "orb" and len(calls) == 2:
            raise KeyboardInterrupt
        return {"frames": 9, "judged": 9, "localized": 9, "median_m": 0.004}

    monkeypatch.setattr(poses, "measure", measure)
    kitchen = tmp_path / "data" / "redkitchen"
    (kitchen / "frames").mkdir(parents=True)
    for name in ("camera.toml", poses.TRUTH, "frames/frame-000000.jpg"):
        (kitchen / name).write_text("of a test")
    status, found = bench("--only", "poses")
    assert (status, found, calls) == (130, None, ["rootsift", "orb"])
    status, found = bench("--only", "poses")
    assert status == 0 and calls == ["rootsift", "orb", "orb"]
    kept = {name: row["poses"]["kept"] for name, row in found["extractors"].items()}
    assert kept == {"rootsift": True, "orb": False}
    (kitchen / "frames" / "frame-000000.jpg").write_text("another")
    bench("--only", "poses")
    assert calls[3:] == ["rootsift", "orb"]
    assert not list((tmp_path / "work").glob("map-*"))


def test_features_that_make_no_map_are_a_row_that_says_so(bench, tmp_path, monkeypatch, capsys):
    def measure(sample, recording, mapping, localizer, step, work):
        assert mapping.sfm.min_track == 4 and localizer.pose.solver == "graph"
        raise MapError("no two of the 9 images overlap")

    monkeypatch.setattr(flights, "measure", measure)
    monkeypatch.setattr(flights, "flight", lambda folder, seconds: tmp_path / "flight.mcap")
    for name in ("mapping.mcap", "flight.mcap"):
        (tmp_path / name).write_text("of a test")
    (tmp_path / "mapping.toml").write_text("[sfm]\nmin_track = 4\n")
    status, found = bench("--only", "flights")
    assert status == 0
    assert found["extractors"]["orb"]["flights"]["failed"] == "no two of the 9 images overlap"
    assert "orb, flights: no two of the 9 images overlap" in capsys.readouterr().out
