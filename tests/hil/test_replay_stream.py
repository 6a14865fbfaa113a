"""A stretch of the sample flight through firmware, link and localizer, in the sample's map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground_station import cli
from ground_station.evaluation import ate
from ground_station.map import store
from ground_station.recording.flight import trajectory_of
from ground_station.replay import flight_report
from ground_station.replay.cases import measure
from ground_station.replay.cases.outcome import read_outcome
from ground_station.replay.replay import ReplayResult, replay, settings_for
from pi_firmware.wire.recording import RecordingReader, RecordingWriter

SAMPLE = Path(__file__).parents[2] / "maps" / "atrium"


@pytest.fixture(scope="module")
def flown() -> ReplayResult:
    settings = settings_for(
        "thesis", SAMPLE / "flight.mcap", start_s=2.0, duration_s=4.0, stepped=True
    )
    return replay(store.load(SAMPLE), settings)


def test_every_frame_is_accounted_for(flown: ReplayResult) -> None:
    accounts = flown.live.accounts()
    assert flown.live.complete
    assert accounts["captured"] == 20
    assert accounts["captured"] == accounts["gated"] + accounts["sent"] + accounts["discarded"]
    assert accounts["sent"] == accounts["received"] + accounts["lost"]
    assert accounts["lost"] == accounts["dropped"] == 0
    assert accounts["received"] == len(flown.live.frames)


def test_capture_times_are_the_recordings_own(flown: ReplayResult) -> None:
    """What the SEI carried past encoder and decoder is exact to the nanosecond."""
    truth_ns = set(trajectory_of(SAMPLE / "flight.mcap").time_ns.tolist())
    times = [frame.estimate.time_ns for frame in flown.live.frames]
    assert set(times) <= truth_ns
    assert np.diff(times).min() > 150e6


def test_poses_are_where_the_truth_is(flown: ReplayResult) -> None:
    accounts = flown.live.accounts()
    assert accounts["localized"] >= 0.95 * accounts["sent"] > 0
    assert flown.evaluation is not None
    rmse = flown.evaluation.errors["none"].rmse()
    assert rmse["position_m"] <= 0.10 and rmse["rotation_deg"] <= 0.6


def test_latency_is_between_capture_and_now(flown: ReplayResult) -> None:
    """The payload's clock at capture travels with the frame; on one host it is our clock."""
    for frame in flown.live.frames:
        assert frame.clock_ns < frame.arrival_ns < frame.done_ns
        assert frame.done_ns - frame.clock_ns < 60e9


def test_the_payloads_clock_is_measured_and_its_uncertainty_told(flown: ReplayResult) -> None:
    """Here it is our own, so that its offset is within the bound, and latencies are, too."""
    clock = flown.live.clock
    assert clock is not None and clock == flown.document()["clock_offset"]
    assert abs(clock["offset_ns"]) <= clock["uncertainty_ns"] < 10**9
    for frame, latency_ms in zip(flown.live.frames, flown.live.latency_ms(), strict=True):
        assert abs(latency_ms - (frame.done_ns - frame.clock_ns) / 1e6) < 1000
    assert any("Latencies are exact to" in note for note in flight_report.notes(flown))


def test_a_missed_bound_is_judged_so(flown: ReplayResult) -> None:
    bounds = flight_report.judge(flown, {flight_report.POSITION: 0.10, flight_report.GATED: 5.0})
    assert all(bound.holds for bound in bounds)
    missed = flight_report.judge(flown, {flight_report.POSITION: 1e-6})
    assert not missed[0].holds


def test_the_command_flies_live_and_writes_results_and_report(tmp_path: Path) -> None:
    words = ["--map", SAMPLE, "--out", tmp_path, "--start-s", "2", "--duration-s", "3",
             "--json", tmp_path / "copy.json"]  # fmt: skip
    assert cli.main(["replay", str(SAMPLE / "flight.mcap"), *map(str, words)]) == 0
    results: dict[str, Any] = json.loads((tmp_path / "results.json").read_text())
    assert results == json.loads((tmp_path / "copy.json").read_text())
    assert {"gated", "sent", "localized"} <= results["frames"].keys()
    assert results["frames"]["captured"] == results["frames"]["received"] == 90
    assert set(results["ate"]) == set(ate.ALIGNMENTS)
    for values in results["ate"].values():
        assert values is None or {"position_m", "rotation_deg"} <= values.keys()
    assert results["latency_ms"].keys() == {"p50", "p99"}
    assert results["stage_p99_ms"]["features"] >= results["stage_ms"]["features"] > 0
    page = (tmp_path / "report.html").read_text()
    assert "simulated" in page.lower() and "<script" not in page
    outcome = read_outcome(tmp_path)
    assert len(outcome.frames) + results["frames"]["dropped"] == results["frames"]["received"]
    assert len(outcome.frames) > 0
    assert results["frames"]["localized"] == int(outcome.frames.localized.sum())
    assert outcome.run.health is not None and outcome.run.battery is not None
    assert outcome.truth is not None and outcome.floorplan is not None
    # Where the first search has landed, however busy the machine, no pose is wrong.
    assert measure.errors(outcome, outcome.truth).position_m.max(initial=0.0) < 0.25
    for side in (outcome.run.payload_side, outcome.run.ground_side):
        assert side.memory_MB is not None and side.memory_MB > 10
        assert side.cpu is not None and side.cpu > 0


def test_a_recording_without_truth_needs_a_first_pose(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare.mcap"
    reader = RecordingReader(SAMPLE / "flight.mcap")
    calibration = reader.calibration()
    assert calibration is not None
    with RecordingWriter(bare) as writer:
        writer.write_calibration(
            0, width_px=calibration.width, height_px=calibration.height,
            matrix=list(calibration.K), distortion=list(calibration.D),
        )  # fmt: skip
        for _, sample in zip(range(30), reader.video(), strict=False):
            writer.write_video(sample.time_ns, sample.data)
    words = ["replay", str(bare), "--map", str(SAMPLE), "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--preset", "thesis"]) == 2
    assert "--init truth: the recording has no true poses" in capsys.readouterr().err
    # The default localizer finds its place itself.
    assert cli.main(words) == 0
