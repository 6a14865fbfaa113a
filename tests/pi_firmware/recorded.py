"""A small flight as the encoder hands it over, and disks that misbehave."""

from __future__ import annotations

import errno
import functools
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from pi_firmware.recording import Recorder
from pi_firmware.settings import RecordingSettings
from pi_firmware.wire import annexb, sei
from pi_firmware.wire.recorder.file import DurableFile
from pi_firmware.wire.recording import FRAME_INFO_TOPIC, RecordingReader

GOP = 10
PERIOD_NS = 33_333_333
START_NS = 1_700_000_000_000_000_001
LIMIT_S = 60.0
"""How long a condition is waited for on a busy machine before a test fails."""


@functools.cache
def _pictures() -> tuple[bytes, ...]:
    sys.path.insert(0, str(Path(__file__).parents[1] / "recording"))
    from numbered_video import FRAMES, encode, picture

    return tuple(encode(map(picture, range(FRAMES))))


def number_in(image: object) -> int:
    """The number that a decoded picture shows, the frame's modulo 40."""
    from numbered_video import number_in as shown

    return shown(image)


def info(index: int, time_ns: int | None = None) -> sei.FrameInfo:
    """What travels with frame `index`."""
    time_ns = START_NS + index * PERIOD_NS if time_ns is None else time_ns
    return sei.FrameInfo(
        sequence=index,
        time_ns=time_ns,
        clock_ns=time_ns,
        entropy_bits=7.0,
        sharpness=10.0,
        exposure_s=0.001 * (index % 7 + 1),
        gain=2.0,
    )


def unit(index: int, padding_bytes: int = 0) -> bytes:
    """Frame `index`'s access unit with its SEI: an IDR each 10, with filler to be as large as one
    of a larger picture (H.264, 7.3.2.7)."""
    pictures = _pictures()
    stamped = annexb.insert_before_slice(pictures[index % len(pictures)], sei.encode(info(index)))
    if padding_bytes:
        stamped += annexb.START_CODE + b"\x0c" + b"\xff" * padding_bytes + b"\x80"
    return stamped


def feed(recorder: Recorder, indices: Iterable[int], padding_bytes: int = 0) -> list[bytes]:
    """Hands over these frames as fast as it goes; their access units."""
    units = []
    for index in indices:
        units.append(unit(index, padding_bytes))
        recorder.unit(info(index), units[-1])
    return units


class Events:
    """What a recorder announces."""

    def __init__(self) -> None:
        self.told: list[tuple[str, str]] = []

    def __call__(self, name: str, text: str) -> None:
        self.told.append((name, text))

    def names(self) -> list[str]:
        return [name for name, _ in self.told]


def recorder(
    folder: Path,
    events: Events | None = None,
    *,
    open_file: object = DurableFile,
    force_idr: Callable[[], object] = lambda: None,
    **settings: object,
) -> Recorder:
    """A recorder that leaves the disk's free space alone unless told otherwise."""
    limits = RecordingSettings(**{"folder": str(folder), "min_free_MB": 0, **settings})
    return Recorder(limits, events or Events(), open_file=open_file, force_idr=force_idr)


def video(*paths: Path) -> list[bytes]:
    """The access units of these files, one file after the other."""
    return [sample.data for path in paths for sample in RecordingReader(path).video()]


def sequences(*paths: Path) -> list[int]:
    """The numbers of the frames in these files."""
    return [
        value["sequence"]
        for path in paths
        for _, value in RecordingReader(path).json(FRAME_INFO_TOPIC)
    ]


def files(folder: Path) -> list[Path]:
    """Our files, by number."""
    return sorted(folder.glob("flight-*.mcap"))


def is_cut(path: Path) -> bool:
    """Whether a file lacks its end, or is damaged."""
    reader = RecordingReader(path)
    reader.topics()
    return reader.cut


class FullDisk(DurableFile):
    """Takes `capacity_bytes` and then none; a device that broke says another error."""

    capacity_bytes = 300_000
    error = errno.ENOSPC

    def _write(self, data: memoryview) -> int:
        room = self.capacity_bytes - self.tell()
        if room <= 0:
            raise OSError(self.error, "No space left on device")
        return super()._write(data[:room])


class BrokenDisk(DurableFile):
    """Fails to write back from the second sync on."""

    syncs = 0

    def sync(self) -> None:
        self.syncs += 1
        if self.syncs > 2:
            self._failure = OSError(errno.EIO, "Input/output error")
            raise self._failure
        super().sync()


class HeldDisk(DurableFile):
    """Takes the head, then nothing until `released` is set."""

    released = threading.Event()

    def _write(self, data: memoryview) -> int:
        if self.tell() > 500:
            self.released.wait(LIMIT_S)
        return super()._write(data)


class PowerCut(DurableFile):
    """Knows what is on the card for certain, and since when."""

    opened: list[PowerCut]

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.path = path
        self.durable_bytes = 0
        self.opened.append(self)

    def sync(self) -> None:
        reached = self.tell()
        super().sync()
        self.durable_bytes = reached
