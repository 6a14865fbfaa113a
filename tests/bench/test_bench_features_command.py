"""`blimp bench features`: what is measured, and what is left out."""

from __future__ import annotations

import json
import shutil

import pytest
from test_bench_features import write_pair

from ground_station import cli


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Runs the command with made-up data in a folder of its own; its status and figures."""
    monkeypatch.setenv("BLIMP_MODELS", str(tmp_path / "no models"))
    write_pair(tmp_path / "data" / "illumination")

    def run(*words: str):
        out = tmp_path / "figures.json"
        out.unlink(missing_ok=True)
        status = cli.main(
            ["bench", "features", "--data", str(tmp_path / "data"), "--json", str(out), "--quick",
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


def test_what_has_no_data_is_left_out_by_name_and_the_rest_is_measured(bench, tmp_path, capsys):
    shutil.rmtree(tmp_path / "data")
    status, found = bench()
    assert status == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert "homographies left out" in line and "data/illumination" in line
    assert set(found["extractors"]["orb"]) == {"name", "sha256", "dimension", "time"}


def test_what_is_asked_for_and_has_no_data_ends_with_status_2(bench, tmp_path, capsys):
    shutil.rmtree(tmp_path / "data")
    status, _ = bench("--only", "homographies")
    assert status == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "data/illumination" in line
