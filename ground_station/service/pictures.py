"""Pictures between processes: one ring of frames a payload, in a file mapped into memory.

The writer never waits. Each slot carries a stamp that is odd while it is being written (a sequence
lock): a reader copies the picture and keeps the copy only when the stamp was the same before and
after. Who is too slow finds another stamp and gets nothing, which is what a live view wants.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_station.arrays import Bools
from ground_station.service.bus_messages import FrameMessage
from pi_firmware.wire import annexb

SLOTS = 16
_HEADER_BYTES, _STAMP_BYTES = 64, 64  # so that stamps lie apart from the pictures, and aligned


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


def _slot(height: int, width: int) -> np.dtype[np.void]:
    return np.dtype(
        {
            "names": ["stamp", "image"],
            "formats": ["<i8", ("u1", (height, width))],
            "offsets": [0, _STAMP_BYTES],
            "itemsize": _STAMP_BYTES + -(-height * width // _STAMP_BYTES) * _STAMP_BYTES,
        }
    )


class PictureWriter:
    """Writes pictures (H, W) uint8; the file is made again when their size changes."""

    def __init__(self, folder: Path, payload_id: str) -> None:
        self._path = path_of(folder, payload_id)
        self._ring: np.memmap[Any, np.dtype[np.void]] | None = None
        self._count = 0

    def write(self, image: NDArray[np.uint8]) -> tuple[int, int]:
        """Puts a picture into the next slot; returns the slot and its stamp."""
        ring = self._ring
        if ring is None or image.shape != ring.dtype["image"].shape:
            ring = self._ring = self._made(*image.shape)
        slot = self._count % SLOTS
        self._count += 1
        ring["stamp"][slot] = 2 * self._count - 1
        ring["image"][slot] = image
        ring["stamp"][slot] = 2 * self._count
        return slot, 2 * self._count

    def close(self) -> None:
        """Removes the ring."""
        self._ring = None
        self._path.unlink(missing_ok=True)

    def _made(self, height: int, width: int) -> np.memmap[Any, np.dtype[np.void]]:
        slot = _slot(height, width)
        # Beside and renamed: a reader has the old file or the new one, never a half.
        part = self._path.with_name(self._path.name + ".part")
        with open(os.open(part, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600), "wb+") as file:
            os.posix_fallocate(file.fileno(), 0, _HEADER_BYTES + SLOTS * slot.itemsize)
            np.array([height, width], "<u4").tofile(file)
            ring = np.memmap(file, slot, "r+", _HEADER_BYTES, SLOTS)
        part.replace(self._path)
        return ring


class PictureReader:
    """Reads a payload's pictures; opens the ring again by itself when it was made again."""

    def __init__(self, folder: Path, payload_id: str) -> None:
        self._path = path_of(folder, payload_id)
        self._ring: np.memmap[Any, np.dtype[np.void]] | None = None
        self._identity = (0, 0)

    def read(self, slot: int, stamp: int) -> NDArray[np.uint8] | None:
        """A copy of the picture (H, W) that was written with this stamp; None: it is gone."""
        try:
            ring = self._current()
        except (OSError, ValueError):
            return None
        if not 0 <= slot < SLOTS or ring["stamp"][slot] != stamp:
            return None
        image = np.array(ring["image"][slot])
        return image if ring["stamp"][slot] == stamp else None

    def close(self) -> None:
        """Lets go of the ring."""
        self._ring = None

    def _current(self) -> np.memmap[Any, np.dtype[np.void]]:
        """The ring in the file that is at the path now; raises `OSError` where there is none."""
        found = self._path.stat()
        identity = (found.st_dev, found.st_ino)
        if self._ring is None or identity != self._identity:
            with self._path.open("rb") as file:
                height, width = map(int, np.fromfile(file, "<u4", 2))
                self._ring = np.memmap(file, _slot(height, width), "r", _HEADER_BYTES, SLOTS)
            self._identity = identity
        return self._ring
