"""Checks of the machine: its clock, its memory and cores, and the disk that recordings go to."""

from __future__ import annotations

import ctypes
import os
import shutil
import stat
import tempfile
import time
from pathlib import Path

from ground_station.doctor.findings import Finding, ok, problem, warning
from ground_station.service.settings import RecordingSettings

_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised
_TIMESYNC = Path("/run/systemd/timesync/synchronized")
_TRIAL_MB = 4
_SLOWEST_MB_S = 5.0
"""Four payloads at 2 Mbit/s, with their pictures' poses, are 1 MB/s; this leaves bursts room."""
_BASE_MB, _LOCALIZER_MB = 550, 320
"""Resident with the sample map: intake, web and their parent together 500 MB, a localizer 300."""
_MEBI = 2**20


def clock(timesync: Path = _TIMESYNC) -> Finding:
    """The clock is right: payloads, which have none, take their time from it."""
    year = time.gmtime().tm_year
    fix = "sudo timedatectl set-ntp true (or install chrony); where there is no network: sudo date"
    made_s = Path(__file__).stat().st_mtime
    if time.time() < made_s - 86_400:
        found = f"it is {year} by this clock, which is before this program was installed"
        return problem("clock", found, fix)
    state, error_ms = _adjtimex()
    if timesync.exists() or (state is not None and state != _TIME_ERROR):
        within = f" within {error_ms:.0f} ms" if error_ms is not None else ""
        return ok("clock", f"synchronised{within}")
    return warning(
        "clock", "not synchronised; payloads and recordings take their time from it", fix
    )


def _adjtimex() -> tuple[int | None, float | None]:
    """The kernel's state of its clock, and the most that it may be off in ms; None: not told."""
    # struct timex: `modes` 0 only reads; maxerror is the fourth of its long members.
    buffer = (ctypes.c_long * 64)()
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(buffer))
    except (AttributeError, OSError):
        return None, None
    if state < 0:
        return None, None
    return state, buffer[3] / 1000


def memory(most: int, meminfo: Path = Path("/proc/meminfo")) -> Finding:
    """Room for the service's processes, of which each of `most` payloads has one, and two cores."""
    fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    total, free = (
        int(fields[name].split()[0]) * 1024 // 10**6 for name in ("MemTotal", "MemAvailable")
    )
    cores = len(os.sched_getaffinity(0))
    found = f"{free} of {total} MB free, {cores} core{'s' if cores > 1 else ''}"
    one, all_ = (_BASE_MB + number * _LOCALIZER_MB for number in (1, most))
    if free < one:
        return problem("memory", found, f"end other programs: one payload needs {one} MB")
    if free < all_:
        fix = f"payloads.most = {most} needs {all_} MB: set it lower, or end other programs"
        return warning("memory", found, fix)
    if cores < 2:
        return warning("memory", found, "two cores are needed to keep up with 30 Hz")
    return ok("memory", f"{found}, for up to {most} payloads")


def disk(recording: RecordingSettings) -> Finding:
    """The recordings' folder can be written, fast enough, and has room."""
    folder = Path(recording.folder).absolute()
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        return problem("disk", f"{place} is no folder", "set recording.folder to another")
    if not os.access(place, os.W_OK | os.X_OK):
        return _closed(folder, place)
    free_mb = shutil.disk_usage(place).free / 1e6
    rate = write_rate(place)
    new = "" if folder == place else " (it will be made)"
    found = f"{folder}{new}: {free_mb:.0f} MB free, {rate:.0f} MB/s written through"
    room_mb = free_mb - recording.min_free_MB
    if room_mb <= 0:
        fix = f"make room: recording ends below recording.min_free_MB = {recording.min_free_MB}"
        return problem("disk", found, fix)
    if room_mb < recording.max_file_MB:
        fix = f"make room: no whole file of {recording.max_file_MB} MB fits before recording ends"
        return warning("disk", found, fix)
    if rate < _SLOWEST_MB_S:
        return warning("disk", found, "set recording.folder to a faster disk")
    return ok("disk", found)


def _closed(folder: Path, place: Path) -> Finding:
    """A folder that this user cannot write; its owner, the service for one, perhaps can."""
    status = place.stat()
    found = f"{place}: not this user's to write"
    if status.st_mode & stat.S_IWUSR and status.st_uid not in (0, os.geteuid()):
        return warning("disk", found, f"sudo -u '#{status.st_uid}' blimp doctor tries it")
    return problem("disk", found, f"sudo install -d -o $USER {folder}, or set recording.folder")


def write_rate(folder: Path, megabytes: int = _TRIAL_MB) -> float:
    """MB/s at which a file is written through to the disk; the file is gone afterwards."""
    block = os.urandom(_MEBI)  # no disk compresses it
    with tempfile.TemporaryFile(dir=folder, prefix=".blimp-doctor-") as file:
        begin_s = time.perf_counter()
        for _ in range(megabytes):
            file.write(block)
        file.flush()
        os.fsync(file.fileno())
        return megabytes * _MEBI / 1e6 / (time.perf_counter() - begin_s)
