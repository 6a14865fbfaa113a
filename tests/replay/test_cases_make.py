"""A case out of a recording: what is written reads back, and what cannot be one is said why."""

from __future__ import annotations

import random
import struct
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cases_stand as stand
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_station.errors import InputError
from ground_station.geometry.trajectory import Trajectory, write_tum
from ground_station.recording.flight import trajectory_of
from ground_station.replay.cases import judge
from ground_station.replay.cases.case import Keys, load_case
from ground_station.replay.cases.commented import commented
from ground_station.replay.cases.make import Asked, make_case
from ground_station.replay.cases.source import check_case, examine
from ground_station.replay.cases.truth import MISSING, accept, read_golden, write_golden
from pi_firmware.wire import config
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.recording import RecordingReader


def make(folder: Path, name: str = "loop.toml", **changes: Any) -> Any:
    usual: dict[str, Any] = {"recording": folder / "flight.mcap", "map": stand.SAMPLE}
    return make_case(Asked(**(usual | {"out": folder / name} | changes)))


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    stand.recording(tmp_path / "flight.mcap", 60)
    return tmp_path


def test_what_is_written_is_a_case_with_every_key_and_its_comment(flight: Path) -> None:
    made = make(flight, truth="recording")
    case = load_case(flight / "loop.toml")
    assert made.files == [flight / "loop.toml"]
    assert case.recording == "flight.mcap" and case.truth.kind == "recording"
    assert case.map_path.resolve() == stand.SAMPLE
    assert check_case(case).notes == []
    text = (flight / "loop.toml").read_text()
    for name in ("rate_hz", "loss", "coverage_min", "battery_V_max", "outages", "drop"):
        assert any(line.lstrip("# ").startswith(name + " =") for line in text.splitlines()), name
    assert "(share, 0 to 1, not set by default)" in text and "60 frames of 64x48 px" in text
    assert max(map(len, text.splitlines())) <= 110
    assert any("no bounds are set" in note for note in made.notes)


def test_bounds_are_proposed_from_a_run_with_the_margin_said_and_then_hold(flight: Path) -> None:
    rows = [stand.off(k, 0.02 if k % 2 else 0.03) for k in range(60)]
    rows[3] = stand.row(3, wTc=None, state="LOST")
    run = stand.outcome(rows)
    make(flight, truth="recording", outcome=run)
    case = load_case(flight / "loop.toml")
    bounds = case.limits("process")
    assert bounds.coverage_min == 0.93  # 59 of 60, less 0.05, rounded down
    assert bounds.position_max_m == 0.065  # 3 cm, half as much again and 2 cm
    assert bounds.recovery_s_max is None and bounds.battery_V_min is None
    text = (flight / "loop.toml").read_text()
    assert "# Measured 0.9833; the margin is 0.05." in text
    assert "# Measured 0.03; the margin is 50% of it and 0.02." in text
    assert judge.judged(run, case, "process").passed


def test_a_case_takes_over_how_it_is_flown(flight: Path) -> None:
    write_tum(flight / "start.txt", stand.truth())
    flown = {"init": str(flight / "start.txt"), "rate_hz": 10.0, "start_s": 1.0, "stepped": True}
    make(flight, flown=flown, settings=["gate.min_entropy_bits=6.0"])
    case = load_case(flight / "loop.toml")
    assert (case.rate_hz, case.start_s, case.stepped, case.init) == (10.0, 1.0, True, "start.txt")
    assert case.flown("process").settings == ["gate.min_entropy_bits=6.0"]


def test_a_survey_is_named_beside_the_case(flight: Path) -> None:
    write_tum(flight / "survey.txt", stand.truth())
    (flight / "cases").mkdir()
    make(flight, name="cases/loop.toml", truth=str(flight / "survey.txt"))
    case = load_case(flight / "cases" / "loop.toml")
    assert (case.truth.kind, case.truth.file) == ("survey", "../survey.txt")
    assert case.recording == "../flight.mcap"


def test_an_accepted_run_is_named_and_how_to_accept_it_said(flight: Path) -> None:
    made = make(flight, truth="golden")
    case = load_case(flight / "loop.toml")
    assert (case.truth.kind, case.truth.file) == ("golden", "loop.golden.txt")
    assert any("--accept OUTCOME --by NAME" in note for note in made.notes)


@pytest.mark.parametrize(
    ("recorded", "changes", "says"),
    [
        ({"calibrated": False}, {}, "no camera calibration; record with --camera"),
        ({"n": 0}, {}, "no video on /camera/video"),
        ({"true_poses": False}, {"truth": "recording"}, "no poses on /truth/pose and no other"),
        (
            {"true_poses": False, "estimates": True},
            {"truth": "recording"},
            "(poses are on /estimate/pose)",
        ),
        ({}, {"truth": "recording:/other/pose"}, "no poses on /other/pose"),
        ({}, {"truth": "gone.txt"}, "gone.txt: No such file"),
        ({}, {"truth": "FOLDER/late.txt"}, "none of its 1 poses is within 0.01 s of a frame"),
        ({}, {"payload_id": "blimp-2"}, "no video of payload 'blimp-2'; it names no payload"),
        ({}, {"name": "loop.yaml"}, "a case is a .toml file"),
        ({}, {"name": "none/loop.toml"}, "its folder does not exist"),
        ({}, {"map": Path("no-map")}, "no-map"),
        ({}, {"flown": {"rate_hz": 0.0}}, "'rate_hz' is 0.0; allowed: 1.0 to 120.0 Hz"),
        ({}, {"flown": {"start_s": float("nan")}}, "'start_s' must be a finite number"),
        ({}, {"flown": {"start_s": 5.0}}, "--start-s is 5 s; allowed: less than the 1.967 s"),
        ({"true_poses": False}, {"flown": {"init": "truth"}}, "--init truth: "),
        ({}, {"settings": ["telemetry.connect=[]"]}, "cannot set 'telemetry.connect'"),
    ],
)
def test_what_cannot_be_a_case_is_refused_in_one_line_and_nothing_is_left(
    tmp_path: Path, recorded: dict[str, Any], changes: dict[str, Any], says: str
) -> None:
    stand.recording(tmp_path / "flight.mcap", **({"n": 60} | recorded))
    write_tum(tmp_path / "late.txt", Trajectory.from_poses([90_000_000_000], [np.eye(4)]))
    truth = changes.get("truth")
    if truth is not None:
        changes = {**changes, "truth": truth.replace("FOLDER", str(tmp_path))}
    before = sorted(tmp_path.iterdir())
    with pytest.raises(BlimpError) as error:
        make(tmp_path, **changes)
    assert says in str(error.value) and "\n" not in str(error.value)
    assert sorted(tmp_path.iterdir()) == before


def test_an_estimate_of_the_flight_may_be_the_truth_where_it_is_named(tmp_path: Path) -> None:
    stand.recording(tmp_path / "flight.mcap", true_poses=False, estimates=True)
    make(tmp_path, truth="recording:/estimate/pose")
    case = load_case(tmp_path / "loop.toml")
    assert case.truth.topic == "/estimate/pose" and check_case(case).notes == []


def test_nothing_is_overwritten_unless_it_is_asked_for(flight: Path) -> None:
    make(flight)
    (flight / "loop.toml").write_text("mine")
    with pytest.raises(InputError, match="exists already; --force"):
        make(flight)
    assert (flight / "loop.toml").read_text() == "mine"
    make(flight, force=True)
    assert load_case(flight / "loop.toml").title == "flight in atrium"


def test_one_payload_of_several_gets_a_recording_of_its_own(tmp_path: Path) -> None:
    stand.recording(tmp_path / "flight.mcap", 20, payloads=("blimp-1", "blimp-2"), estimates=True)
    with pytest.raises(InputError, match=r"it has blimp-1, blimp-2; say which by --payload-id"):
        make(tmp_path)
    with pytest.raises(InputError, match=r"no video of payload 'blimp-3'; it has blimp-1, blimp-2"):
        make(tmp_path, payload_id="blimp-3")
    made = make(tmp_path, payload_id="blimp-2", truth="recording")
    case = load_case(tmp_path / "loop.toml")
    assert made.files == [tmp_path / "loop.mcap", tmp_path / "loop.toml"]
    assert case.recording == "loop.mcap"
    whole, own = RecordingReader(tmp_path / "flight.mcap"), RecordingReader(tmp_path / "loop.mcap")
    assert list(own.video()) == list(whole.video("/blimp-2/camera/video"))
    assert own.poses("/estimate/pose") == whole.poses("/blimp-2/estimate/pose")
    assert examine(tmp_path / "loop.mcap").camera == examine(tmp_path / "flight.mcap").camera
    assert [v for _, v in own.json("/camera/frame")] == [{"sequence": k} for k in range(20)]
    # The first one's topics are where a replay looks for them.
    make(tmp_path, name="first.toml", payload_id="blimp-1")
    assert load_case(tmp_path / "first.toml").recording == "flight.mcap"


def test_a_payload_without_a_camera_leaves_no_recording_behind(tmp_path: Path) -> None:
    stand.recording(tmp_path / "flight.mcap", payloads=("a", "b"), calibrated=False)
    with pytest.raises(InputError, match="no camera calibration"):
        make(tmp_path, payload_id="b")
    assert [path.name for path in tmp_path.iterdir()] == ["flight.mcap"]


def chunk_ends(data: bytes) -> Iterator[int]:
    """Where each chunk of an MCAP file ends (opcode, length, content)."""
    at = 8
    while at + 9 < len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        at += 9 + length
        if opcode == 6:
            yield at


def test_a_recording_cut_anywhere_says_so_and_how_much_is_readable(tmp_path: Path) -> None:
    """At 100 random bytes: what is before is whole, or it is refused in one line."""
    whole = stand.recording(tmp_path / "whole.mcap", 60, chunk_bytes=1000).read_bytes()
    frames = examine(tmp_path / "whole.mcap").time_ns
    path, chosen = tmp_path / "flight.mcap", random.Random(8)
    ends = list(chunk_ends(whole))
    readable, last = [], -1
    for size in sorted(chosen.sample(range(1, len(whole)), 100)):
        path.write_bytes(whole[:size])
        try:
            source = examine(path)
        except BlimpError as error:
            assert "\n" not in str(error) and not readable  # only before the first frame
            continue
        n = len(source.time_ns)
        assert (source.time_ns == frames[:n]).all() and n >= last
        assert source.cut and f"was cut ({source.cut}): {n} frames" in source.notes[0]
        end = max((e for e in ends if e <= size), default=0)
        assert n >= whole[:end].count(stand.UNIT)  # to the last whole chunk
        readable.append(size)
        last = n
    assert len(ends) > 10 and len(readable) > 80
    made = make(tmp_path, truth="recording")
    assert any("was cut" in note for note in made.notes)
    assert "was cut" in (tmp_path / "loop.toml").read_text()
    assert "was cut" in check_case(load_case(tmp_path / "loop.toml")).notes[0]


def test_a_case_that_begins_behind_the_cut_is_refused_with_what_is_readable(flight: Path) -> None:
    make(flight, flown={"start_s": 1.5})
    data = (flight / "flight.mcap").read_bytes()
    (flight / "flight.mcap").write_bytes(data[: len(data) // 2])
    case = load_case(flight / "loop.toml")
    with pytest.raises(InputError, match=r"'start_s' is 1\.5 s; allowed: less than the readable"):
        check_case(case)


def test_truth_that_a_cut_took_away_is_told(flight: Path) -> None:
    make(flight, truth="recording")
    stand.recording(flight / "flight.mcap", true_poses=False)
    with pytest.raises(InputError, match=r"'truth\.kind' is 'recording', but .* no poses on"):
        check_case(load_case(flight / "loop.toml"))


_TEXT = st.text(
    st.characters(codec="utf-8", exclude_categories=("C", "Z")), min_size=1, max_size=30
)
_SHARE = st.floats(0, 1)


@settings(deadline=None, max_examples=50)
@given(
    title=_TEXT,
    recording=_TEXT,
    rate_hz=st.floats(1, 120),
    loss=_SHARE,
    seed=st.integers(0, 2**31 - 1),
    outage=st.none() | st.tuples(st.floats(0, 100), st.floats(0.01, 100)).map(list),
    coverage=st.none() | _SHARE,
    image=st.none() | _SHARE,
)
def test_any_keys_read_back_as_they_were(
    title: str, recording: str, rate_hz: float, loss: float, seed: int,
    outage: list[float] | None, coverage: float | None, image: float | None,
) -> None:  # fmt: skip
    link = {"kind": "proxy", "loss": loss, "seed": seed, "outages": [outage] if outage else []}
    bounds: dict[str, Any] = {} if coverage is None else {"coverage_min": coverage}
    if image is not None:
        bounds["image"] = {"coverage_min": image}
    document = {"title": title, "recording": recording, "map": "m", "rate_hz": rate_hz,
                "link": link, "bounds": bounds}  # fmt: skip
    keys = config.from_mapping(document, Keys)
    text = commented(keys, brief=("bounds.image", "bounds.ssh"))
    assert config.from_mapping(tomllib.loads(text), Keys) == keys


def test_an_accepted_run_reads_back_and_any_tool_reads_its_poses(tmp_path: Path) -> None:
    run = stand.outcome(case="loop\u2028x", versions={"ground_station": "1, source ab"})
    made = accept(run, by="the bench", tolerance_m=0.05, tolerance_deg=1.0)
    write_golden(tmp_path / "g.txt", made)
    read = read_golden(tmp_path / "g.txt")
    assert read.accepted == made.accepted and read.accepted.case == "loop?x"
    assert (read.poses.time_ns == run.estimate.time_ns).all()
    assert np.abs(read.poses.position_m - run.estimate.position_m).max() < 1e-9
    assert read.accepted.missing_max == MISSING
    first = (tmp_path / "g.txt").read_text().splitlines()[0]
    assert first.startswith("# A run that was accepted by the bench at 2")


@pytest.mark.parametrize(
    ("terms", "says"),
    [
        ({"by": " "}, "'accepted_by' is empty"),
        ({"by": "a\nb"}, "one line"),
        ({"tolerance_m": float("nan")}, "'tolerance_m' must be a finite number"),
        ({"tolerance_m": -0.1}, "'tolerance_m' is -0.1; allowed: 0.0 to 1000.0 m"),
        ({"tolerance_deg": 200.0}, "'tolerance_deg' is 200.0; allowed: 0.0 to 180.0"),
        ({"missing_max": 2.0}, "'missing_max' is 2.0; allowed: 0.0 to 1.0 share"),
    ],
)
def test_terms_that_nobody_can_mean_are_refused(terms: dict[str, Any], says: str) -> None:
    usual = {"by": "the bench", "tolerance_m": 0.05, "tolerance_deg": 1.0}
    with pytest.raises(BlimpError) as error:
        accept(stand.outcome(), **(usual | terms))
    assert says in str(error.value) and "\n" not in str(error.value)


def test_a_run_without_poses_or_with_broken_ones_is_not_accepted() -> None:
    lost = stand.outcome([stand.row(k, wTc=None, state="LOST") for k in range(5)])
    broken = stand.outcome([stand.row(0), stand.row(1, wTc=np.full((4, 4), np.inf))])
    for run, says in ((lost, "nothing to accept"), (broken, "1 poses are not finite")):
        with pytest.raises(InputError, match=says):
            accept(run, by="the bench", tolerance_m=1.0, tolerance_deg=1.0)


def test_a_trajectory_without_terms_is_no_accepted_run(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.txt", stand.truth())
    with pytest.raises(InputError, match="not an accepted run"):
        read_golden(tmp_path / "t.txt")
    for line, says in (("#: a = [", "not valid TOML"), ('#: accepted_by = "x"', "tolerance_m")):
        (tmp_path / "t.txt").write_text(f"{line}\n5.0 1 2 1.5 0 0 0 1\n")
        with pytest.raises(BlimpError, match=says):
            read_golden(tmp_path / "t.txt")


def test_the_sample_flight_becomes_a_case(tmp_path: Path) -> None:
    make(tmp_path, recording=stand.SAMPLE / "flight.mcap", truth="recording")
    case = load_case(tmp_path / "loop.toml")
    assert len(check_case(case).time_ns) == len(trajectory_of(case.recording_path)) == 960
