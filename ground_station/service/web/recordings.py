"""The ground's recordings: a list, downloads, trajectories as TUM text, and their end."""

from __future__ import annotations

import contextlib
import functools
import io
import os
import re
import stat
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fastapi import APIRouter, Request, Response
from fastapi.responses import StreamingResponse
from mcap.records import MetadataIndex
from starlette.exceptions import HTTPException

from ground_station.errors import GroundStationError
from ground_station.service.fleet.shelf import Shelf
from ground_station.service.intake.files import AFTER_TABLE, LACKS, MAP_TABLE
from ground_station.service.web.models import (
    FILE_PATTERN,
    AnswerModel,
    FileName,
    RecordingModel,
    StationName,
)
from ground_station.service.web.problems import Busy, NotFound, problems
from pi_firmware.wire.errors import BlimpError, os_errors_as

_FILES = 500
_PIECE_BYTES = 256 * 1024
_NAME = re.compile(FILE_PATTERN)
_MAPS_SHOWN = 8
_RECORD_HEAD_BYTES, _TABLE_BYTES = 9, 4096
_MOST = 10**9
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


class _Told(NamedTuple):
    """What a file's summary says; nothing where it has none, as after a cut."""

    started_ns: int | None = None
    duration_s: float | None = None
    maps: Sequence[str] = ()
    lacks: Mapping[str, int] | None = None
    """Frames that were sent and are not in it, by why; None where it does not say."""
    after: str = ""
    """STATION/FILE that a flight was recorded in before."""


class Recordings:
    """The files of one folder; `active` tells which is being written. Safe from any thread."""

    def __init__(self, folder: Path, active: Callable[[], str]) -> None:
        self._folder, self._active = folder, active
        self._exporting = threading.BoundedSemaphore(1)

    def list(self) -> list[dict[str, Any]]:
        """The newest recordings, newest first."""
        found = []
        with contextlib.suppress(OSError), os.scandir(self._folder) as entries:
            for entry in entries:
                if _NAME.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                    with contextlib.suppress(OSError):
                        found.append((entry.stat(follow_symlinks=False), entry.name))
        found.sort(key=lambda item: (-item[0].st_mtime_ns, item[1]))
        active = self._active()
        return [
            {
                "file": name,
                "size_MB": round(status.st_size / 1e6, 3),
                "modified_ns": status.st_mtime_ns,
                **(_Told() if name == active else self._told(name, status))._asdict(),
                "active": name == active,
            }
            for status, name in found[:_FILES]
        ]

    @contextlib.contextmanager
    def open(self, name: str) -> Iterator[int]:
        """The descriptor of a recording while it is read; raises `NotFound`.

        It is a regular file that lies in the folder itself: no link, no path.
        """
        descriptor = -1
        if _NAME.fullmatch(name):
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            with contextlib.suppress(OSError):
                descriptor = os.open(self._folder / name, flags)
        try:
            if descriptor < 0 or not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise NotFound(f"there is no recording {name[:128]!r}")
            yield descriptor
        finally:
            if descriptor >= 0:
                os.close(descriptor)

    def path(self, name: str) -> Path:
        """Where a recording lies; raises `NotFound`."""
        self.size(name)
        return self._folder / name

    def size(self, name: str) -> int:
        """How many bytes a recording has now; raises `NotFound`."""
        with self.open(name) as descriptor:
            return os.fstat(descriptor).st_size

    def pieces(self, name: str, begin: int, end: int) -> Iterator[bytes]:
        """The bytes from begin to end, as far as they are there; the file may have grown since.

        It opens the file only when the first is asked for: who leaves before holds nothing open.
        """
        with self.open(name) as descriptor:
            while begin < end:
                piece = os.pread(descriptor, min(_PIECE_BYTES, end - begin), begin)
                if not piece:
                    return
                begin += len(piece)
                yield piece

    def trajectory(self, name: str) -> str:
        """Poses of a recording as TUM text; raises a `BlimpError` with one line.

        One at a time, and whole before it is sent: who takes it slowly holds up nobody.
        """
        from ground_station.recording.export import read_poses, tum

        path = self.path(name)
        if not self._exporting.acquire(blocking=False):
            raise Busy("another trajectory is being read; try again then")
        try:
            with os_errors_as(name, NotFound):
                return "".join(tum(read_poses(path)))
        finally:
            self._exporting.release()

    def delete(self, name: str) -> None:
        """Deletes one that is not being written; raises a `BlimpError` with one line."""
        self.size(name)
        if name == self._active():
            raise GroundStationError(f"{name} is being written; stop the recording first")
        with os_errors_as(name, NotFound):
            (self._folder / name).unlink()

    def _told(self, name: str, status: os.stat_result) -> _Told:
        return _summed_up(self._folder.absolute() / name, status.st_size, status.st_mtime_ns)


@functools.lru_cache(2 * _FILES)
def _summed_up(path: Path, _size: int, _modified_ns: int) -> _Told:
    """What a file says that has this size and was written then: read again when it is another."""
    from pi_firmware.wire.recording import RecordingReader

    try:
        summary = RecordingReader(path).summary
    except BlimpError:  # a foreign file
        return _Told()
    figures = summary.statistics if summary else None
    if summary is None or figures is None or not figures.message_count:
        return _Told()
    started_ns = figures.message_start_time
    tables = sorted({index.name for index in summary.metadata_indexes})
    maps = [name.removeprefix(MAP_TABLE)[:128] for name in tables if name.startswith(MAP_TABLE)]
    duration_s = round(1e-9 * (figures.message_end_time - started_ns), 3)
    after = next((name for name in tables if name.startswith(AFTER_TABLE)), "")
    return _Told(
        started_ns,
        duration_s,
        maps[:_MAPS_SHOWN],
        _lacks(path, summary.metadata_indexes),
        after.removeprefix(AFTER_TABLE)[:256],
    )


def _lacks(path: Path, tables: Sequence[MetadataIndex]) -> dict[str, int] | None:
    """What a recording's end says; its table alone is read, whatever size the file has."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Metadata

    for table in tables:
        if table.name != "recording_end" or table.length > _TABLE_BYTES:
            continue
        # A stranger's table may be anything; one from before it said this lacks the keys.
        with contextlib.suppress(Exception), path.open("rb") as file:
            file.seek(table.offset + _RECORD_HEAD_BYTES)
            said = Metadata.read(ReadDataStream(io.BytesIO(file.read(table.length)))).metadata
            return {fate: min(max(0, int(said[fate])), _MOST) for fate in LACKS}
    return None


def _portion(header: str | None, size: int) -> tuple[int, int] | None:
    """What a Range header asks for, as begin and end; None for all (RFC 9110, section 14).

    Raises an `HTTPException` where there is no such part. Several parts at once give all.
    """
    found = _RANGE.fullmatch(header.strip()) if header else None
    if found is None or found.groups() == ("", ""):
        return None
    first, last = found.groups()
    begin, end = int(first or 0), min(size, int(last) + 1) if last else size
    if not first:
        begin, end = max(0, size - int(last)), size
    elif last and int(last) < begin:
        return None
    if begin >= end:
        raise HTTPException(
            416, f"the file has {size} bytes", headers={"content-range": f"bytes */{size}"}
        )
    return begin, end


def _sent(
    shelf: Shelf, file: str, size: int, part: tuple[int, int] | None = None
) -> StreamingResponse:
    """A file of that size as a download, or a part of it."""
    begin, end = part or (0, size)
    headers = {
        "content-length": str(end - begin),
        "content-disposition": f'attachment; filename="{file}"',
    }
    if part:
        headers["content-range"] = f"bytes {begin}-{end - 1}/{size}"
    return StreamingResponse(
        shelf.pieces(file, begin, end),
        206 if part else 200,
        headers,
        media_type="application/octet-stream",
    )


_BYTES: dict[str, Any] = {"content": {"application/octet-stream": {}}}


def elsewhere(shelf: Callable[[str], Shelf]) -> APIRouter:
    """Recordings of other stations; `shelf` is a station's, by its name."""
    result = APIRouter(prefix="/api/stations", tags=["recordings"])

    @result.get(
        "/{station}/recordings", response_model=list[RecordingModel], responses=problems(404)
    )
    def all_recordings(station: StationName) -> Any:
        """The newest recordings of another station, newest first."""
        return shelf(station).list()

    @result.get(
        "/{station}/recordings/{file}",
        response_class=Response,
        responses={200: _BYTES, **problems(404)},
    )
    def download(station: StationName, file: FileName) -> Response:
        """A recording of another station's, as it is now."""
        theirs = shelf(station)
        return _sent(theirs, file, theirs.size(file))

    return result


def router(recordings: Recordings) -> APIRouter:
    """Recordings over HTTP."""
    result = APIRouter(prefix="/api/recordings", tags=["recordings"])

    @result.get("", response_model=list[RecordingModel])
    def all_recordings() -> Any:
        """The newest recordings, newest first."""
        return recordings.list()

    @result.get(
        "/{file}",
        response_class=Response,
        responses={
            200: _BYTES,
            206: {**_BYTES, "description": "The range."},
            **problems(404, 416),
        },
    )
    def download(file: FileName, request: Request) -> Response:
        """A recording's bytes as they are now, or a range of them."""
        size = recordings.size(file)
        answer = _sent(recordings, file, size, _portion(request.headers.get("range"), size))
        answer.headers["accept-ranges"] = "bytes"
        return answer

    @result.delete("/{file}", response_model=AnswerModel, responses=problems(404, 409))
    def delete(file: FileName) -> Any:
        """Deletes a recording for good."""
        recordings.delete(file)
        return {"done": True, "reason": "", "values": {}}

    @result.get(
        "/{file}/trajectory.txt",
        response_class=Response,
        responses={200: {"content": {"text/plain": {}}}, **problems(404, 409)},
    )
    def trajectory(file: FileName) -> Response:
        """The estimated poses, as TUM text: timestamp tx ty tz qx qy qz qw."""
        return Response(recordings.trajectory(file), media_type="text/plain")

    return result
