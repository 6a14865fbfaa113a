"""`blimp bench map`: sizes against accuracy, in shares of the whole map of the same run."""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ground_station import cli
from ground_station.bench.maps import measure, scale
from ground_station.bench.maps.table import tables
from ground_station.errors import InputError
from ground_station.geometry.trajectory import Trajectory, write_tum
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.recording.flight import trajectory_of
from ground_station.recording.frames import ALL_FRAMES

ATRIUM = Path(__file__).parents[2] / "maps/atrium"


def bench(*words: object) -> int:
    return cli.main(["bench", "map", *map(str, words)])


def test_a_line_of_the_sample_is_measured_and_written(tmp_path, capsys):
    """A few frames: that all is there and fits each other, not how good it is."""
    told, picture = tmp_path / "told.json", tmp_path / "told.png"
    status = bench(
        ATRIUM, "--range", "0:9", "--shares", "0.2", "--descriptor-bytes", "0", "--methods",
        "observations", "--sought", "2", "--seed", "5", "--json", told, "--plot", picture,
    )  # fmt: skip
    assert status == 0
    found = json.loads(told.read_text())
    assert found["seeds"] == [5] and found["map"] == "atrium"
    assert found["flights"] == {"flight": {"simulated": True, "frames": 9}}
    whole, small = found["rows"]
    assert (whole["name"], small["name"]) == ("whole", "0.2, observations")
    assert small["landmarks"] == round(0.2 * whole["landmarks"])
    assert small["descriptor_bytes"] == whole["descriptor_bytes"] == 128
    assert small["bytes"]["total"] < 0.2 * whole["bytes"]["total"]
    for row in (whole, small):
        figures = row["flights"]["flight"]
        assert figures["rmse_m"] < 0.1 and figures["localized_share"] == 1 and figures["ms"] > 0
        (run,) = figures["runs"]
        assert run["sought"] == 2 and run["found"] + run["wrong"] <= 2
    printed = capsys.readouterr().out
    assert "simulated flight 'flight', 9 frames" in printed and "seeds 5 to 5" in printed
    assert picture.read_bytes().startswith(b"\x89PNG")


def _row(name: str, error_m: float, kilobytes: int, **figures: float) -> dict:
    flight = {"rmse_m": error_m, "localized_share": 1.0, "found_share": 0.75, "wrong_share": 0.0}
    sizes = {"landmarks": 500, "keyframes": 300, "sparse": 150, "other": 50}
    scaled = {part: kilobytes * size for part, size in sizes.items()}
    return {
        "name": name,
        "method": "coverage",
        "landmarks": 10 * kilobytes,
        "descriptor_bytes": 32,
        "bytes": scaled | {"total": 1000 * kilobytes},
        "flights": {"hall": flight | {"ms": 20.0} | figures},
    }


def test_shares_are_of_the_first_row():
    rows = [_row("whole", 0.02, 400), _row("0.5", 0.021, 100, ms=15.0, localized_share=0.987)]
    lines = tables(rows, {"hall": {"simulated": False, "frames": 77}})
    assert lines[1] == "flight 'hall', 77 frames"
    head, whole, half = (line.split() for line in lines[2:5])
    assert head[0] == "map"
    assert whole == ["whole", "4000", "32", "400", "100%", "320", "100%", "2.00", "100%",
                     "100.0%", "75%", "0%", "100%"]  # fmt: skip
    assert half == ["0.5", "1000", "32", "100", "25%", "80", "25%", "2.10", "105%", "98.7%",
                    "75%", "0%", "75%"]  # fmt: skip


def test_a_map_in_which_nothing_is_localized_has_no_error():
    rows = [_row("whole", 0.02, 400), _row("0.1", math.nan, 10, localized_share=0.0)]
    half = tables(rows, {"hall": {"simulated": True, "frames": 1}})[4].split()
    assert half[7:10] == ["-", "-", "0.0%"]


def test_runs_of_a_line_are_averaged_and_frames_counted_together(monkeypatch, tmp_path):
    errors = iter([0.01, 0.03])
    runs = {"rmse_deg": 0.2, "median_m": 0.01, "ms": 20.0, "judged": 10, "localized": 9}
    monkeypatch.setattr(
        measure, "localize", lambda map_, flight, settings, label: {**runs, "rmse_m": next(errors)}
    )
    monkeypatch.setattr(
        measure, "relocalize",
        lambda map_, sought, truth, settings: {"sought": 4, "found": 3, "wrong": settings.seed},
    )  # fmt: skip
    flight = measure.Flight(Path("hall.mcap"), ALL_FRAMES, trajectory(), False)
    from ground_station.localization.settings import load_preset

    row = measure.row(ATRIUM, None, [(flight, None)], load_preset("default"), range(2), tmp_path)
    figures = row["flights"]["hall"]
    assert figures["rmse_m"] == pytest.approx(0.02) and len(figures["runs"]) == 2
    assert figures["localized_share"] == 0.9 and figures["found_share"] == 0.75
    assert figures["wrong_share"] == 1 / 8
    assert row["bytes"]["total"] == sum(v for k, v in row["bytes"].items() if k != "total")


def trajectory() -> Trajectory:
    return Trajectory.from_poses([0, 10**9], np.stack([np.eye(4)] * 2))


def test_a_frame_is_found_within_ten_centimetres_and_five_degrees(monkeypatch):
    moved, far, turned = np.eye(4), np.eye(4), np.eye(4)
    moved[0, 3], far[0, 3] = 0.09, 0.11
    a = np.deg2rad(6.0)
    turned[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    poses = iter([moved, far, turned, None])

    class Localizer:
        def __init__(self, *_: object) -> None: ...
        def reset(self) -> None: ...
        def process_features(self, time_ns: int, features: object) -> PoseEstimate:
            return PoseEstimate(time_ns, 0, State.LOST, wTc=next(poses))

    monkeypatch.setattr(measure, "Localizer", Localizer)
    monkeypatch.setattr(measure, "extractor_for", lambda *_: None)
    from ground_station.localization.settings import load_preset

    class Info:
        info = None

    sought = measure.Sought(None, [0, 1, 2, 3], [None] * 4)
    found = measure.relocalize(Info(), sought, trajectory(), load_preset("default"))
    assert found == {"sought": 4, "found": 1, "wrong": 2}


def test_true_poses_are_the_flights_own_or_a_files(tmp_path):
    own = measure.open_flight(ATRIUM / "flight.mcap", ALL_FRAMES, None)
    assert own.simulated and len(own.truth) == len(trajectory_of(ATRIUM / "flight.mcap"))
    write_tum(tmp_path / "truth.txt", trajectory())
    given = measure.open_flight(ATRIUM / "flight.mcap", ALL_FRAMES, tmp_path / "truth.txt")
    assert len(given.truth) == 2 and given.simulated
    folder = tmp_path / "frames"
    folder.mkdir()
    (folder / "0.png").write_bytes(b"of a test")
    with pytest.raises(InputError, match="frames: it carries no true poses; --truth"):
        measure.open_flight(folder, ALL_FRAMES, None)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nowhere",), "nowhere: there is no such map"),
        ((ATRIUM, "--flight", "nowhere.mcap"), "nowhere.mcap"),
        ((ATRIUM, "--shares", "0"), "--shares has 0; allowed: above 0 to 1"),
        ((ATRIUM, "--shares", "nan"), "--shares has nan"),
        ((ATRIUM, "--descriptor-bytes", "-1"), "--descriptor-bytes is -1; allowed: 0 to 4096"),
        ((ATRIUM, "--methods", "best"), "--methods has 'best'; allowed: coverage, observations"),
        ((ATRIUM, "--seeds", "0"), "--seeds is 0; allowed: 1 to 100"),
        (("--campus", "10"), "--campus is 10; allowed: 50 to 100000"),
        (("--campus", "60", "--processes", "999"), "--processes is 999; allowed: 0 to 256"),
        ((ATRIUM, "--sought", "-1"), "--sought is -1"),
        ((ATRIUM, "--json", "nowhere/told.json"), "nowhere/told.json: its folder does not exist"),
        ((ATRIUM, "--range", "9:3"), "'9:3'"),
        (
            (ATRIUM, "--flight", ATRIUM / "flight.mcap", ATRIUM / "mapping.mcap", "--truth", "t"),
            "is of one flight; 2 are given",
        ),
        (
            (ATRIUM, "--flight", ATRIUM / "flight.mcap", ATRIUM / "flight.mcap"),
            "two flights have the same name",
        ),
    ],
)
def test_a_bad_value_is_one_line(words, said, capsys):
    assert bench(*words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line


def test_builds_of_many_images_are_measured_in_processes_of_their_own(tmp_path, capsys):
    told, drawn = tmp_path / "told.json", tmp_path / "drawn.png"
    words = ("--campus", "60", "--seed", "1", "--json", told, "--plot", drawn)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert bench(*words) == 0
    (row,) = json.loads(told.read_text())["campus"]
    assert row["images"] == row["registered"] == 60 and row["processes"] == 0
    assert set(row["stage_s"]) == {"match", "sfm", "refine", "write"}
    assert row["cpu_s"] > 0 and 0.1 < row["peak_gb"] < 2
    assert 0 < row["median_m"] <= row["max_m"] < 0.3
    said = capsys.readouterr().out
    assert "simulated features" in said and "60" in said
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
