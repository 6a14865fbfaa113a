"""The pictures that a model was made of, found again by their names."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ground_station.errors import InputError
from ground_station.recording.folder import SUFFIXES, read_grey
from ground_station.recording.frames import Frame, FrameSource
from ground_station.recording.open import open_input


@dataclass(frozen=True)
class Pictures:
    """Frames under the model's names, of those that are there.

    From a folder, the names are paths in it, and picture k of the sorted names is at k / rate s. Of
    a recording or video, `frame-000123`, with or without an image's suffix or the input's name
    before it, is the frame of that number.
    """

    names: Sequence[str]
    source: Path | FrameSource
    rate_hz: float
    stem: str = ""

    def __iter__(self) -> Iterator[Frame]:
        if isinstance(self.source, Path):
            for k, name in enumerate(self.names):
                path = self.source / name
                if path.is_file():
                    yield Frame(k, name, round(k * 1e9 / self.rate_hz), read_grey(path))
            return
        wanted: dict[str, str] = {}
        for name in self.names:
            plain = _plain(name)
            if plain in wanted:
                raise InputError(f"'{wanted[plain]}' and '{name}' would be the same frame")
            wanted[plain] = name
        for frame in self.source:
            for name in (frame.name, f"{self.stem}/{frame.name}"):
                if name in wanted:
                    yield replace(frame, name=wanted.pop(name))
                    break


def open_pictures(where: str | Path, names: Sequence[str], rate_hz: float) -> Pictures:
    """The pictures of a folder or recording; raises `InputError` or the recording's error."""
    where = Path(where)
    if not (math.isfinite(rate_hz) and 0.001 <= rate_hz <= 10_000):
        raise InputError(f"the frame rate is {rate_hz} Hz; allowed: 0.001 to 10000 Hz")
    if where.is_dir():
        return Pictures(names, where, rate_hz)
    return Pictures(names, open_input(where, rate_hz), rate_hz, where.resolve().stem)


def _plain(name: str) -> str:
    """Without an image's suffix."""
    return str(Path(name).with_suffix("")) if Path(name).suffix.lower() in SUFFIXES else name
