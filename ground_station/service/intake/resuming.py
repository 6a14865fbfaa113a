"""A recording that was cut goes on: what a service was recording when it was killed.

The recordings themselves tell. One that was ended, by whomever, has MCAP's closing magic; one whose
writer died has not.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from ground_station.service import bus_messages
from ground_station.service.bus_messages import Level
from ground_station.service.intake.recording import GroundRecorder
from ground_station.service.settings import RecordingSettings
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.mcap_records import MAGIC
from pi_firmware.wire.recorder.folder import number_of

CUT = "recording-cut"
MOST_IN_A_ROW = 5
"""So many cut ones within ten minutes: it may be recording that kills the process."""
_ROW_NS = 600 * 10**9
_RECORD = struct.Struct("<BQ")
_TIMES = struct.Struct("<QQ")
_MOST_RECORDS = 1_000_000

Report = Callable[[str, Level, str], object]
"""(name, level, text) of an event."""


@dataclass(frozen=True)
class Cut:
    """The newest recording, without its end.

    `until_ns` is the newest log time that can be read in it, of this machine's clock, None without
    any; `written_ns` is when it was written last; `in_a_row` counts the cut ones up to it.
    """

    file: str
    until_ns: int | None
    written_ns: int
    in_a_row: int


def newest_cut(folder: Path) -> Cut | None:
    """The newest recording in a folder if it was cut; raises `OSError` for what cannot be read."""
    cut = list(_cut(folder))
    if not cut:
        return None
    newest, written_ns = cut[0]
    return Cut(newest.name, _until_ns(newest), written_ns, len(cut))


def begin(recorder: GroundRecorder, settings: RecordingSettings, report: Report) -> None:
    """Goes on with a recording that was cut lately, and begins one where that is configured.

    Whatever hinders either is said, and stands as the recorder's problem. It may wait for the disk.
    """
    now_ns = time.time_ns()
    try:
        cut = newest_cut(Path(settings.folder))
    except FileNotFoundError:
        cut = None  # the first recording makes the folder
    except OSError as error:
        cut = None
        report(
            CUT,
            bus_messages.WARNING,
            f"recording.folder '{settings.folder}': {error.strerror or error}",
        )
    if cut is not None and not _goes_on(cut, settings, now_ns):
        report(
            CUT, bus_messages.INFO, f"{cut.file} was cut and does not go on (recording.resume_s)"
        )
        cut = None
    try:
        if cut is None:
            if settings.at_start:
                recorder.start()
            return
        if cut.in_a_row >= MOST_IN_A_ROW:
            recorder.refuse(f"the last {cut.in_a_row} recordings were cut; start one by hand")
            return
        _resume(recorder, cut, report)
    except BlimpError as error:
        where = f"{cut.file} was cut and cannot go on: " if cut else ""
        recorder.refuse(f"{where}{error}")


def _resume(recorder: GroundRecorder, cut: Cut, report: Report) -> None:
    file = recorder.start()
    text = f"{cut.file} was cut and has no index; {file} goes on"
    if cut.until_ns is not None:
        text += f", {max(0.0, 1e-9 * (time.time_ns() - cut.until_ns)):.1f} s between them are lost"
    report(bus_messages.RECORDING_RESUMED, bus_messages.WARNING, text)
    recorder.resumed = text


def _goes_on(cut: Cut, settings: RecordingSettings, now_ns: int) -> bool:
    # Written in the future: the clock was set back, and recording too much costs less.
    return settings.resume_s > 0 and now_ns - cut.written_ns <= 1e9 * settings.resume_s


def _cut(folder: Path) -> Iterator[tuple[Path, int]]:
    """Recordings without their end and when they were written last, newest first.

    Up to one that has it, or is much older than the newest.
    """
    newest_ns: int | None = None
    ours = [(number, path) for path in folder.iterdir() if (number := number_of(path.name))]
    for _, path in sorted(ours, reverse=True):
        if path.is_symlink() or not path.is_file():
            continue
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            file.seek(max(0, status.st_size - len(MAGIC)))
            # A whole file has it twice: at its beginning, and at its end.
            if status.st_size > len(MAGIC) and file.read() == MAGIC:
                return
        newest_ns = newest_ns or status.st_mtime_ns
        if newest_ns - status.st_mtime_ns > _ROW_NS:
            return
        yield path, status.st_mtime_ns


def _until_ns(path: Path) -> int | None:
    """The newest log time of its chunks; what is in them is not read."""
    newest: int | None = None
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        at = len(MAGIC)
        for _ in range(_MOST_RECORDS):
            if size - at < _RECORD.size + _TIMES.size:
                break
            file.seek(at)
            opcode, length = _RECORD.unpack(file.read(_RECORD.size))
            if opcode == 0 or length > size - at - _RECORD.size:
                break
            if opcode == Opcode.CHUNK and length >= _TIMES.size:
                newest = max(newest or 0, _TIMES.unpack(file.read(_TIMES.size))[1])
            at += _RECORD.size + length
    return newest
