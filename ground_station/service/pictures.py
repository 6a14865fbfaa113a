"""Pictures between processes: one ring of frames a payload, in a file mapped into memory.

The writer never waits. Each slot carries a stamp that is odd while it is being written (a sequence
lock): a reader copies the picture and keeps the copy only when the stamp was the same before and
after. Who is too slow finds another stamp and gets nothing, which is what a live view wants.
"""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ground_station.arrays import Bools
from ground_station.service.bus_messages import FrameMessage
from pi_firmware.wire import annexb

SLOTS = 8
_MAGIC = b"blimpic1"
_FILE = struct.Struct("<8sIIII")  # magic, slots, width, height, reserved
_SLOT = struct.Struct("<q")  # stamp
_HEADER_BYTES, _SLOT_BYTES = 64, 64


def packed(damaged: Bools | None) -> bytes:
    """Which macroblocks (rows, columns) of a picture a loss took, as a message tells it."""
    return b"" if damaged is None else np.packbits(damaged).tobytes()


def damaged_in(frame: FrameMessage) -> Bools | None:
    """The same of a message; None: all is as it was sent."""
    if not frame.damaged:
        return None
    size_px = np.array([frame.height_px, frame.width_px])
    rows, columns = -(-size_px // annexb.MACROBLOCK_PX)
    bits = np.unpackbits(np.frombuffer(frame.damaged, np.uint8), count=rows * columns)
    return np.asarray(bits.reshape(rows, columns) > 0)


def path_of(folder: Path, payload_id: str) -> Path:
    """The ring's file."""
    return folder / f"{payload_id}.pictures"


class PictureWriter:
    """Writes pictures (H, W) uint8; the file is made again when their size changes."""

    def __init__(self, folder: Path, payload_id: str) -> None:
        self._path = path_of(folder, payload_id)
        self._map: mmap.mmap | None = None
        self._shape = (0, 0)
        self._count = 0

    def write(self, image: NDArray[np.uint8]) -> tuple[int, int]:
        """Puts a picture into the next slot; returns the slot and its stamp."""
        if self._map is None or image.shape != self._shape:
            self._make(image.shape[0], image.shape[1])
        assert self._map is not None
        slot = self._count % SLOTS
        self._count += 1
        at = _HEADER_BYTES + slot * (_SLOT_BYTES + image.size)
        _SLOT.pack_into(self._map, at, 2 * self._count - 1)
        target = np.frombuffer(self._map, np.uint8, image.size, at + _SLOT_BYTES)
        target[:] = np.ascontiguousarray(image).reshape(-1)
        del target  # a map with views of it cannot be closed
        _SLOT.pack_into(self._map, at, 2 * self._count)
        return slot, 2 * self._count

    def close(self) -> None:
        """Removes the ring."""
        if self._map is not None:
            self._map.close()
            self._map = None
        self._path.unlink(missing_ok=True)

    def _make(self, height: int, width: int) -> None:
        if self._map is not None:
            self._map.close()
        size = _HEADER_BYTES + SLOTS * (_SLOT_BYTES + height * width)
        # Beside and renamed: a reader has the old file or the new one, never a half.
        part = self._path.with_name(self._path.name + ".part")
        descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, size)
            self._map = mmap.mmap(descriptor, size)
        finally:
            os.close(descriptor)
        _FILE.pack_into(self._map, 0, _MAGIC, SLOTS, width, height, 0)
        part.replace(self._path)
        self._shape = (height, width)


class PictureReader:
    """Reads a payload's pictures; opens the ring again by itself when it was made again."""

    def __init__(self, folder: Path, payload_id: str) -> None:
        self._path = path_of(folder, payload_id)
        self._map: mmap.mmap | None = None
        self._identity = (0, 0)
        self._shape = (0, 0)

    def read(self, slot: int, stamp: int) -> NDArray[np.uint8] | None:
        """A copy of the picture (H, W) that was written with this stamp; None: it is gone."""
        if not self._current() or not 0 <= slot < SLOTS or self._map is None:
            return None
        height, width = self._shape
        at = _HEADER_BYTES + slot * (_SLOT_BYTES + height * width)
        if _SLOT.unpack_from(self._map, at)[0] != stamp:
            return None
        source = np.frombuffer(self._map, np.uint8, height * width, at + _SLOT_BYTES)
        image = source.reshape(height, width).copy()
        del source
        return image if _SLOT.unpack_from(self._map, at)[0] == stamp else None

    def close(self) -> None:
        """Lets go of the ring."""
        if self._map is not None:
            self._map.close()
            self._map = None

    def _current(self) -> bool:
        """Whether the file that is mapped is the one at the path."""
        try:
            found = self._path.stat()
        except OSError:
            return False
        identity = (found.st_dev, found.st_ino)
        if self._map is not None and identity == self._identity:
            return True
        self.close()
        try:
            with self._path.open("rb") as file:
                mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError):
            return False
        magic, slots, width, height, _ = _FILE.unpack_from(mapped, 0)
        expected = _HEADER_BYTES + SLOTS * (_SLOT_BYTES + height * width)
        if magic != _MAGIC or slots != SLOTS or len(mapped) != expected:
            mapped.close()
            return False
        self._map, self._identity, self._shape = mapped, identity, (height, width)
        return True
