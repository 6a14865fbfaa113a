"""The folder of the payload's recordings: numbers, bounds, and what is not ours."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from recorded import (
    Events,
    feed,
    files,
    info,
    recorder,
    sequences,
    unit,
    video,
)

from pi_firmware.recording import Recorder
from pi_firmware.settings import RecordingSettings
from pi_firmware.wire.errors import RecordingError
from pi_firmware.wire.recorder.file import DurableFile


class Watched(DurableFile):
    """Notes the most that all of our files have together after any write."""

    folder: Path
    most_bytes = 0

    def _write(self, data: memoryview) -> int:
        written = super()._write(data)
        Watched.most_bytes = max(
            Watched.most_bytes, sum(path.stat().st_size for path in files(self.folder))
        )
        return written


def test_all_files_together_stay_bounded_and_the_oldest_go(tmp_path: Path) -> None:
    Watched.folder, Watched.most_bytes = tmp_path, 0
    (tmp_path / "flight-000001.mcap").write_bytes(b"")  # a power cut's
    (tmp_path / "flight-000002.mcap").write_bytes(b"x" * 1_500_000)
    made = recorder(tmp_path, max_file_MB=1, max_total_MB=3, open_file=Watched)
    made.start()
    assert (tmp_path / "flight-000002.mcap").exists()  # there is room yet
    units = feed(made, range(400), 15_000)
    assert made.stop() == "flight-000009.mcap"
    left = files(tmp_path)
    assert 2_000_000 < Watched.most_bytes <= 3_000_000
    assert made.dropped == 0 and len(left) >= 2 and left[-1].name == "flight-000009.mcap"
    kept = video(*left)
    assert kept == units[-len(kept) :]


def test_a_file_larger_than_all_may_be_shrinks_to_half_of_that(tmp_path: Path) -> None:
    made = recorder(tmp_path, max_file_MB=4000, max_total_MB=2)
    made.start()
    feed(made, range(300), 15_000)
    made.stop()
    assert sum(path.stat().st_size for path in files(tmp_path)) <= 2_000_000
    assert sequences(files(tmp_path)[-1])[-1] == 299


def test_only_our_own_files_are_touched_and_none_is_overwritten(tmp_path: Path) -> None:
    folder, outside = tmp_path / "card", tmp_path / "outside.mcap"
    (folder / "flight-000007.mcap").mkdir(parents=True)
    outside.write_bytes(b"o" * 2_000_000)
    (folder / "flight-000008.mcap").symlink_to(outside)
    os.mkfifo(folder / "flight-000004.mcap")
    (folder / "flight-000002.mcap").write_bytes(b"ours" * 300_000)
    others = [
        "flight-000001.mcap.bak", "Flight-000001.mcap", "flight-1.mcap", "flight-abc.mcap",
        "flight-000001.mcap\n", "flight-٠٠٠٠٠١.mcap", "flight-9999999999999.mcap", "photo.jpg",
    ]  # fmt: skip
    for name in others:
        (folder / name).write_bytes(b"x" * 500_000)
    (folder / os.fsdecode(b"flight-\xff\xfe.mcap")).write_bytes(b"x")
    before = set(folder.iterdir())
    made = recorder(folder, max_file_MB=1, max_total_MB=2)
    assert made.start() == "flight-000009.mcap"
    feed(made, range(200), 15_000)
    made.stop()
    assert before - set(folder.iterdir()) == {folder / "flight-000002.mcap"}
    assert outside.stat().st_size == 2_000_000
    assert all((folder / name).stat().st_size == 500_000 for name in others)


def test_numbers_rise_whatever_the_clock_believes(tmp_path: Path) -> None:
    newest = tmp_path / "flight-000041.mcap"
    newest.write_bytes(b"from 2031")
    os.utime(newest, (1_930_000_000, 1_930_000_000))
    made = recorder(tmp_path)
    names = []
    for start in (0, 20, 40):
        names.append(made.start())
        assert made.start() == names[-1]  # a command said twice
        made.unit(info(0, time_ns=5_000_000_000 + start), unit(0))  # 1970
        assert made.stop() == made.stop() == names[-1]
    assert names == [f"flight-{number:06d}.mcap" for number in (42, 43, 44)]
    assert newest.read_bytes() == b"from 2031"


def test_what_cannot_be_recorded_to_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = tmp_path / "plain"
    plain.write_text("no folder")
    full = tmp_path / "full"
    full.mkdir()
    (full / "flight-999999999.mcap").mkdir()
    for folder, says in (
        ("", " is empty: nothing can be recorded"),
        (str(plain), "File exists"),
        (str(tmp_path / "no" / "where"), "No such file or directory"),
        ("/proc/blimp", "No such file or directory"),
        (str(full), "no number above 999999999"),
    ):
        events = Events()
        made = Recorder(RecordingSettings(folder=folder, min_free_MB=0), events)
        for _ in range(2):
            with pytest.raises(RecordingError, match=rf"^recording\.folder[^\n]*{says}[^\n]*$"):
                made.start()
        feed(made, range(3))
        assert (made.file, made.stop(), events.told) == ("", "", [])
    made = recorder(tmp_path / "card", min_free_MB=1_000_000)
    with pytest.raises(RecordingError, match=r"MB are free, recording\.min_free_MB is 1000000$"):
        made.start()
    assert files(tmp_path / "card") == []
