"""The localizer process on its bus: each frame that is told of gets a pose or is counted."""

from __future__ import annotations

import contextlib
import functools
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from localizing_stand import (
    LIMIT_S,
    NAME,
    Intake,
    Station,
    copy_map,
    localizer,
    payload,
)
from process_stand import ROOT, SAMPLE
from station_notes import PAYLOAD
from waiting import eventually

from ground_station.localization.localizer import Localizer
from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.recording.frames import Frame, FrameRange
from ground_station.replay.rig import FirmwareProcess
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import EstimateMessage
from ground_station.service.ending import status_of
from ground_station.service.localizing import __main__ as main
from ground_station.service.localizing import maps
from ground_station.service.localizing.process import RESTART, Localizing, Overload
from ground_station.service.pictures import SLOTS
from ground_station.stream.newest import Newest

FLIGHT = SAMPLE / "flight.mcap"
TRUTH = trajectory_of(FLIGHT)


@pytest.fixture(scope="module")
def flight() -> list[Frame]:
    return list(FlightRecording(FLIGHT, FrameRange(60, 90)))


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps to choose from: a good one, one that is not registered, and one that is cut."""
    shelf = tmp_path_factory.mktemp("shelf")
    copy_map(shelf / "hall")
    copy_map(shelf / "unregistered", frame="sfm")
    cut = copy_map(shelf / "cut") / "landmarks.safetensors"
    cut.write_bytes(cut.read_bytes()[:1000])
    return shelf


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory, shelf: Path) -> Iterator[Station]:
    """One localizer that has loaded its map, for all tests that leave it as it was."""
    folder = tmp_path_factory.mktemp("run")
    with Station(folder, shelf=str(shelf)) as told, localizer(folder) as told.process:
        eventually(lambda: told.event("map-loaded") is not None, what="the map")
        yield told


@pytest.fixture
def told(kept: Station) -> Iterator[Station]:
    """What the localizer says from the beginning of a session; it lives through the test."""
    kept.anew()
    yield kept
    assert kept.process.poll() is None


def error_m(note: EstimateMessage) -> float:
    """How far a pose is from the flight's truth at the camera's time."""
    assert note.position_m is not None
    return float(np.linalg.norm(TRUTH.at(note.time_ns)[:3, 3] - note.position_m))


def localized(told: Station, frame: Frame, **fields: Any) -> EstimateMessage:
    """One frame shown, and what is said of it."""
    before = len(told.estimates)
    note = told.show(frame.image, frame.index, frame.time_ns, **fields)
    eventually(lambda: len(told.estimates) > before, what=f"frame {frame.index}'s estimate")
    estimate = told.estimates[-1]
    assert estimate.sequence == note.sequence and told.accounted()
    return estimate


def test_the_sample_flight_is_localized_and_every_frame_accounted_for(
    told: Station, tmp_path: Path
) -> None:
    """4 s of the real firmware's video at 30 Hz, however slow the machine."""
    with Intake(told) as intake:
        with FirmwareProcess(payload(intake.receiver.port), tmp_path) as firmware:
            eventually(lambda: not firmware.running(), what="the stream's end")
            firmware.check()
        eventually(told.accounted, what="the last frame")
        assert told.process.poll() is None
        assert told.said == intake.receiver.counters.decoded > 60
        last = told.estimates[-1]
        assert last.processed == len(told.estimates)
        assert last.processed + last.skipped == told.said
        assert last.localized == sum(note.position_m is not None for note in told.estimates)
        # How many is a matter of how fast this machine is; hil/test_stepped_replay.py says all.
        assert last.processed > 5
        # As they come: none twice, none out of turn.
        assert (np.diff([note.sequence for note in told.estimates]) > 0).all()
        assert max(error_m(note) for note in told.estimates if note.position_m) < 0.25
        assert all(note.map == "atrium" for note in told.estimates)
        for note in told.estimates:
            assert note.capture_ns is not None and note.capture_ns < note.done_ns
        found = [note for note in told.estimates if note.position_m]
        assert all(20 <= len(note.points_px) <= 600 for note in found)
        assert told.beats and told.beats[-1].pid == told.process.pid


def test_velocity_and_covariance_are_those_of_the_flight(
    told: Station, flight: list[Frame]
) -> None:
    said = [localized(told, frame) for frame in flight[:20]]
    last = said[-1]
    assert any(note.state == "TRACKING" for note in said)
    assert last.velocity_mps and last.position_sigma_m and last.covariance and last.position_m
    before, after = TRUTH.at(last.time_ns - 10**8)[:3, 3], TRUTH.at(last.time_ns + 10**8)[:3, 3]
    assert np.linalg.norm((after - before) / 0.2 - last.velocity_mps) < 0.15
    view = TRUTH.at(last.time_ns)[:3, 2]
    assert last.heading_deg == pytest.approx(np.rad2deg(np.arctan2(view[1], view[0])), abs=1.5)
    assert last.height_m == last.position_m[2]
    sigma = np.reshape(last.position_sigma_m, (3, 3))
    assert np.linalg.eigvalsh(sigma).min() > 0
    own = np.reshape(last.covariance, (6, 6))[3:, 3:]
    assert np.trace(sigma) == pytest.approx(np.trace(own))


def test_another_stream_begins_anew(told: Station, flight: list[Frame]) -> None:
    """A payload that was restarted has another SSRC; a replay that begins again goes back."""
    for frame in flight[10:13]:
        localized(told, frame)
    for at, ssrc in ((flight[0], told.ssrc), (flight[25], told.ssrc + 1)):
        again = localized(told, at, ssrc=ssrc)
        assert again.relocalized and error_m(again) < 0.1
        assert not localized(told, flight[26], ssrc=ssrc).relocalized


def test_relocalize_forgets_the_pose_and_searches(told: Station, flight: list[Frame]) -> None:
    said = [localized(told, frame) for frame in flight[:5]]
    assert [note.relocalized for note in said] == [True, False, False, False, False]
    assert told.bus.query(NAME, {"do": "relocalize"}) == {"done": True, "reason": ""}
    assert localized(told, flight[5]).relocalized
    assert not localized(told, flight[6]).relocalized


def test_a_map_is_changed_while_frames_come(told: Station, flight: list[Frame]) -> None:
    before = localized(told, flight[0])
    assert before.map == "atrium"
    answer = told.bus.query(NAME, {"do": "map", "name": "hall"}, timeout_s=LIMIT_S)
    assert answer["done"] and answer["map"] == "hall"
    eventually(
        lambda: any("'hall' is in use" in event.text for event in told.events), what="the map"
    )
    changed = localized(told, flight[1])
    assert changed.map == "hall" and changed.relocalized and error_m(changed) < 0.1
    assert (changed.processed, changed.localized) == (2, 2)
    assert "" != changed.coordinates != before.coordinates != ""
    assert told.bus.query(NAME, {"do": "map", "name": "atrium"}, timeout_s=LIMIT_S)["done"]
    assert localized(told, flight[2]).map == "atrium"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("cut", "landmarks.safetensors"),
        ("unregistered", "it is not registered"),
        ("../run", "a plain name is needed"),
        ("absent", "there is none of that name"),
        (None, "a plain name is needed"),
    ],
)
def test_a_map_that_is_refused_leaves_the_old_one_in_use(
    name: Any, reason: str, told: Station, flight: list[Frame]
) -> None:
    localized(told, flight[0])
    answer = told.bus.query(NAME, {"do": "map", "name": name}, timeout_s=LIMIT_S)
    assert not answer["done"] and reason in answer["reason"] and "\n" not in answer["reason"]
    kept = localized(told, flight[1])
    assert kept.map == "atrium" and kept.position_m and not kept.relocalized


def test_a_question_that_is_not_known_is_refused(told: Station) -> None:
    for request in ({}, {"do": "dance"}, {"do": ["map"]}):
        answer = told.bus.query(NAME, request)
        assert not answer["done"] and "is not known (known: relocalize, map)" in answer["reason"]


def test_without_a_map_it_stays_says_so_and_takes_another(
    tmp_path: Path, shelf: Path, flight: list[Frame]
) -> None:
    with (
        Station(tmp_path, folder=str(shelf / "cut"), shelf=str(shelf)) as told,
        localizer(tmp_path) as process,
    ):
        eventually(lambda: told.event("map-refused") is not None, what="the refusal")
        refused = told.event("map-refused")
        assert refused is not None and refused.level == "alarm"
        assert "landmarks.safetensors" in refused.text and "\n" not in refused.text
        answer = told.bus.query(NAME, {"do": "relocalize"})
        assert not answer["done"] and "nothing to search: no map: " in answer["reason"]
        said = localized(told, flight[0])
        assert said.state == "INITIALIZING" and said.reason.startswith("no map: ")
        assert (said.processed, said.skipped, said.position_m) == (0, 1, None)
        assert told.bus.query(NAME, {"do": "map", "name": "hall"}, timeout_s=LIMIT_S)["done"]
        eventually(lambda: told.event("map-loaded") is not None, what="the map")
        found = localized(told, flight[1])
        assert found.map == "hall" and error_m(found) < 0.1
        assert (found.processed, found.skipped) == (1, 1)
        assert process.poll() is None


def test_what_is_no_message_is_dropped_and_a_picture_that_is_not_there_is_counted(
    told: Station, flight: list[Frame]
) -> None:
    localized(told, flight[0])
    frame, session = flight[1], told.bus._session
    key = f"station/frame/{PAYLOAD}"
    for raw in (b"", b"\xff\x00", b"[" * 100_000, b"{}", b'{"slot": 1}', b"[1, 2]", b"NaN"):
        # What a busy machine has no room for would be dropped, and the frames after it as well.
        session.put(key, raw, congestion_control=zenoh.CongestionControl.BLOCK)
    for fields in (
        {"slot": -1}, {"slot": "0"}, {"time_ns": None}, {"ssrc": {}}, {"exposure_s": "x"},
    ):  # fmt: skip
        told.show(frame.image, frame.index, frame.time_ns, **fields)
        told.said -= 1  # the bus takes it for no message
    gone = [{"slot": SLOTS}, {"slot": 1 << 62}, {"stamp": 999_999}]
    for fields in gone:
        told.show(frame.image, frame.index, frame.time_ns, **fields)
    # A time far ahead is one more new stream.
    ahead = localized(told, flight[20], time_ns=1 << 62)
    assert ahead.time_ns == 1 << 62
    found = localized(told, flight[21])
    assert found.relocalized and error_m(found) < 0.1
    assert found.processed == 3 and found.skipped == len(gone)


def test_frames_of_another_cameras_size_are_refused_and_it_lives(
    told: Station, flight: list[Frame]
) -> None:
    small = np.ascontiguousarray(flight[0].image[::2, ::2])
    for k in range(12):  # more than may fail
        before = len(told.estimates)
        told.show(small, k, flight[0].time_ns + k)
        eventually(lambda count=before: len(told.estimates) > count)
        said = told.estimates[-1]
        assert said.state == "INITIALIZING" and said.position_m is None
        assert said.reason.startswith(f"frame {k} has 320x240 pixels, the camera 640x480: ")
    assert sum(event.name == "frame-refused" for event in told.events) == 1
    assert localized(told, flight[1]).position_m


def test_a_picture_that_was_overwritten_is_skipped(told: Station, flight: list[Frame]) -> None:
    localized(told, flight[0])
    old = told.show(flight[1].image, 1, flight[1].time_ns)
    eventually(lambda: len(told.estimates) == 2)
    for _ in range(SLOTS):
        told.pictures.write(flight[2].image)
    told.say(replace(old, shown=old.shown + 1))
    said = localized(told, flight[3])
    assert (said.processed, said.skipped) == (3, 1)
    assert told.event("frame-refused") is None


def test_an_intake_that_comes_back_is_heard_again(told: Station, flight: list[Frame]) -> None:
    """It makes its ring again."""
    localized(told, flight[0])
    told.pictures.close()
    told.pictures = type(told.pictures)(told.folder, PAYLOAD)
    assert error_m(localized(told, flight[1])) < 0.1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_what_does_not_end_by_itself_is_ended(number: signal.Signals) -> None:
    """As a search in a large map, which nobody waits for."""
    code = (
        "import time; from ground_station.service.ending import ending; ending(0.2);"
        "print('ready', flush=True); time.sleep(3600)"
    )
    command = [sys.executable, "-c", code]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    process.send_signal(number)
    try:
        assert process.wait(LIMIT_S) == 0
    finally:
        process.kill()
        process.communicate()


def test_bad_input_is_one_line_and_status_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "ending", threading.Event)
    for folder, name in ((tmp_path / "absent", PAYLOAD), (tmp_path, "../etc"), (tmp_path, PAYLOAD)):
        monkeypatch.setattr(sys, "argv", ["localizing", str(folder), name])
        assert status_of("localizer x", main.serve) == 2
        said = capsys.readouterr().err
        assert said.startswith("localizer x: ") and said.count("\n") == 1


@contextlib.contextmanager
def in_a_thread(told: Station, *, stepped: bool = False) -> Iterator[list[int]]:
    """The process's loop in this one, until the block ends; the status that it gave, then."""
    stop, ended = threading.Event(), list[int]()
    with Bus(told.folder, NAME, lossless=stepped) as bus:
        localizing = Localizing(bus, told.folder, PAYLOAD, replace(told.run, stepped=stepped))
        thread = threading.Thread(target=lambda: ended.append(localizing.run(stop)))
        thread.start()
        try:
            yield ended
        finally:
            stop.set()
            thread.join()


def test_while_its_map_is_loaded_it_says_so(
    tmp_path: Path, flight: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    """That is no alarm, and no frame is without account."""
    release, real = threading.Event(), maps.prepare

    def slow(*arguments: Any) -> Localizer:
        release.wait(LIMIT_S)
        return real(*arguments)

    monkeypatch.setattr(maps, "prepare", slow)
    with Station(tmp_path) as told, in_a_thread(told):
        ask = functools.partial(told.bus.query, NAME, {"do": "map", "name": "atrium"})
        # Answered, it also hears of frames: it subscribes first.
        loading = "the map 'atrium' is being loaded; try again then"
        eventually(lambda: ask()["reason"] == loading)
        said = localized(told, flight[0])
        assert (said.state, said.reason) == ("INITIALIZING", "the map is being loaded")
        release.set()
        eventually(lambda: told.event("map-loaded") is not None, what="the map")
        assert error_m(localized(told, flight[1])) < 0.1


class _Failing:
    """Makes the localizer fail while `times` is above 0."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, times: int) -> None:
        self.times, self.resets = times, 0
        real, reset = Localizer.process, Localizer.reset

        def process(localizer: Localizer, *arguments: Any) -> Any:
            if self.times > 0:
                self.times -= 1
                raise RuntimeError("made up")
            return real(localizer, *arguments)

        def counted(localizer: Localizer) -> None:
            self.resets += 1
            reset(localizer)

        monkeypatch.setattr(Localizer, "process", process)
        monkeypatch.setattr(Localizer, "reset", counted)


@pytest.mark.parametrize("times", [9, 10])
def test_failures_are_counted_and_ten_in_a_row_end_it(
    times: int, tmp_path: Path, flight: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    failing = _Failing(monkeypatch, times)
    with Station(tmp_path) as told, in_a_thread(told) as ended:
        eventually(lambda: told.event("map-loaded") is not None, what="the map")
        failing.resets = 0
        for frame in flight[:times]:
            said = localized(told, frame)
            assert said.state == "INITIALIZING" and said.position_m is None
            assert said.reason == "RuntimeError: made up"
        assert failing.resets == 1
        failed = [event for event in told.events if event.name == "frame-failed"]
        assert len(failed) == 1 and "RuntimeError: made up" in failed[0].text
        if times == 9:
            assert error_m(localized(told, flight[20])) < 0.1
            assert told.estimates[-1].processed == 10
        else:
            eventually(lambda: bool(ended), what="the end")
            eventually(lambda: told.event("localizer-failed") is not None, what="the event")
    assert ended == ([RESTART] if times == 10 else [0])


@pytest.mark.parametrize("stepped", [False, True])
def test_how_long_frames_wait_counts_unless_no_clock_is_to_decide(
    tmp_path: Path, flight: list[Frame], monkeypatch: pytest.MonkeyPatch, stepped: bool
) -> None:
    heard: list[float] = []
    monkeypatch.setattr(Newest, "waiting_s", 0.25)
    monkeypatch.setattr(Overload, "watch", lambda *known: heard.append(known[-1]) or "")
    with Station(tmp_path) as told, in_a_thread(told, stepped=stepped):
        eventually(lambda: told.event("map-loaded") is not None, what="the map")
        localized(told, flight[0])
    assert heard == [0.0 if stepped else 0.25]


def test_a_localizer_that_is_killed_is_counted_on_and_another_session_anew(
    tmp_path: Path, flight: list[Frame]
) -> None:
    def with_a_map(before: int = 0) -> bool:
        return "map-loaded" in [event.name for event in told.events[before:]]

    with Station(tmp_path) as told:
        with localizer(tmp_path) as process:
            eventually(with_a_map, what="the map")
            for frame in flight[:3]:
                localized(told, frame)
            process.kill()
        for frame in flight[3:5]:  # nobody takes them
            told.show(frame.image, frame.index, frame.time_ns)
        before = len(told.events)
        with localizer(tmp_path) as again:
            eventually(lambda: with_a_map(before), what="the map")
            found = localized(told, flight[5])
            # What was processed within the last quarter of a second may count as skipped.
            assert 2 <= found.processed <= 4 and found.processed + found.skipped == 6
            found = localized(told, flight[6], ssrc=2)
            assert (found.processed, found.skipped) == (1, 0)
            again.terminate()
            assert again.wait(LIMIT_S) == 0
            assert again.stderr is not None and again.stderr.read() == ""
