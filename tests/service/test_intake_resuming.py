"""A recording that was cut goes on by itself, and whoever cannot go on says so."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

import pytest

from ground_station.service import bus_messages
from ground_station.service.bus_messages import EventMessage
from ground_station.service.intake import resuming
from ground_station.service.intake.recording import GroundRecorder
from ground_station.service.settings import RecordingSettings
from pi_firmware.wire.recording import RecordingReader


class Station:
    """A recorder over a folder, and what it says."""

    def __init__(self, folder: Path, **settings: object) -> None:
        values = {"folder": str(folder), "min_free_MB": 0, **settings}
        self.settings = RecordingSettings(**values)  # type: ignore[arg-type]
        self.told: list[tuple[str, str, str]] = []
        self.recorder = GroundRecorder(self.settings, lambda *said: self.told.append(said))

    def begin(self) -> None:
        resuming.begin(self.recorder, self.settings, lambda *said: self.told.append(said))

    def said(self, name: str) -> list[tuple[str, str]]:
        """Level and text of its events of one name."""
        return [(level, text) for event, level, text in self.told if event == name]


def record(folder: Path, *, cut: bool, age_s: float = 0.0) -> Path:
    """A recording of a few events, whole or without its end, and written some time ago."""
    station = Station(folder)
    path = folder / station.recorder.start()
    for index in range(3):
        station.recorder.note(bus_messages.EVENT, "-", EventMessage(index, "web", "info", "a", "b"))
    station.recorder.close()
    if cut:
        # The last byte of the summary's footer, and what a chunk needs not.
        os.truncate(path, path.stat().st_size - 9)
    written_s = time.time() - age_s
    os.utime(path, (written_s, written_s))
    return path


def test_one_that_was_cut_goes_on_in_a_new_file(tmp_path: Path) -> None:
    # As it was named before its name had the time.
    record(tmp_path, cut=False).rename(tmp_path / "flight-000001.mcap")
    cut = record(tmp_path, cut=True)
    station = Station(tmp_path)
    time.sleep(0.3)  # what lies between the two
    station.begin()
    state = station.recorder.state()
    assert state.active and state.file.startswith("flight-000003-") and state.problem == ""
    ((level, text),) = station.said(bus_messages.RECORDING_RESUMED)
    assert level == bus_messages.WARNING and text == state.resumed
    assert text.startswith(f"{cut.name} was cut and has no index; {state.file} goes on, ")
    lost_s = float(text.split(", ")[1].split()[0])
    assert 0.3 <= lost_s < 60
    station.recorder.stop()
    assert station.recorder.state().resumed == ""
    assert not RecordingReader(tmp_path / state.file).cut
    again = Station(tmp_path)  # nothing was cut since
    again.begin()
    assert not again.recorder.file and again.told == []


@pytest.mark.parametrize(("resume_s", "age_s"), [(0.0, 0.0), (600.0, 1000.0)])
def test_none_goes_on_that_is_too_old_or_where_it_is_not_wanted(
    tmp_path: Path, resume_s: float, age_s: float
) -> None:
    cut = record(tmp_path, cut=True, age_s=age_s)
    station = Station(tmp_path, resume_s=resume_s)
    station.begin()
    assert not station.recorder.file and station.recorder.state().problem == ""
    assert [text.split()[0] for _, text in station.said(resuming.CUT)] == [cut.name]


def test_one_from_the_future_goes_on(tmp_path: Path) -> None:
    record(tmp_path, cut=True, age_s=-1e6)  # the clock was set back meanwhile
    station = Station(tmp_path)
    station.begin()
    assert station.recorder.file
    station.recorder.close()


@pytest.mark.parametrize("at_start", [False, True])
def test_without_one_it_is_as_configured(tmp_path: Path, at_start: bool) -> None:
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "flight-000007.mcap").symlink_to(tmp_path / "nowhere")
    (tmp_path / "new" / "notes.txt").write_text("x")
    for folder in (tmp_path / "new", tmp_path / "missing"):
        station = Station(folder, at_start=at_start)
        station.begin()
        assert bool(station.recorder.file) == at_start
        station.recorder.close()


def test_one_that_cannot_go_on_is_a_problem_until_one_begins(tmp_path: Path) -> None:
    cut = record(tmp_path, cut=True)
    station = Station(tmp_path, min_free_MB=10_000_000)
    station.begin()
    problem = station.recorder.state().problem
    assert problem.startswith(f"{cut.name} was cut and cannot go on: recording.folder")
    assert station.told[-1][1:] == (bus_messages.ALARM, problem)
    assert station.recorder.state().problem == problem
    able = Station(tmp_path)
    able.recorder.refuse("it could not")
    assert able.recorder.state().problem == "it could not"
    able.recorder.start()
    assert able.recorder.state().problem == ""
    able.recorder.close()
    assert able.recorder.state().problem == ""


def test_what_dies_each_time_is_not_begun_for_ever(tmp_path: Path) -> None:
    for _ in range(resuming.MOST_IN_A_ROW):
        record(tmp_path, cut=True)
    station = Station(tmp_path)
    station.begin()
    assert not station.recorder.file
    assert station.recorder.state().problem == "the last 5 recordings were cut; start one by hand"
    # Five power cuts on five days are another matter.
    for age, path in enumerate(sorted(tmp_path.iterdir(), reverse=True)):
        written_s = time.time() - 10 - 86_400 * age
        os.utime(path, (written_s, written_s))
    station.begin()
    assert station.recorder.file.startswith("flight-000006-")
    station.recorder.close()


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + 5000 * b"\x07"])
def test_a_file_with_nothing_in_it_goes_on_too(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "flight-000001.mcap").write_bytes(content)
    cut = resuming.newest_cut(tmp_path)
    assert cut is not None and cut.until_ns is None
    station = Station(tmp_path)
    station.begin()
    assert re.search(r"flight-000002-\w+\.mcap goes on$", station.recorder.state().resumed)
    station.recorder.close()
