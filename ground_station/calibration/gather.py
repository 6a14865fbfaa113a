"""Every frame of the inputs looked at once: where the board was seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from ground_station.arrays import U8
from ground_station.calibration.detection import BoardFinder, BoardObservation
from ground_station.errors import InputError
from ground_station.progress import Progress
from ground_station.recording.frames import FrameSource

_PICTURES = 12


@dataclass
class Gathered:
    """What was seen: frames looked at, their size, observations by input and time.

    `without` are a few pictures in which the board was not found, more widely apart the longer it
    lasted.
    """

    frames: int = 0
    size_px: tuple[int, int] = (0, 0)
    observations: list[BoardObservation] = field(default_factory=list)
    without: list[U8] = field(default_factory=list)
    interrupted: bool = False


def gather(
    sources: Sequence[FrameSource],
    names: Sequence[str],
    finder: BoardFinder,
    on_frame: Callable[[Gathered], None] | None = None,
) -> Gathered:
    """Looks for the board in all frames; Ctrl-C ends the looking and keeps what was seen.

    `names` are the inputs', for errors. Raises `InputError` where frames differ in size.
    """
    result = Gathered()
    counts = [source.count() for source in sources]
    known = [count for count in counts if count is not None]
    total = sum(known) if len(known) == len(counts) else None
    missing = 0
    with Progress("calibrate", total) as progress:
        try:
            for number, (source, name) in enumerate(zip(sources, names, strict=True)):
                for frame in source:
                    height, width = frame.image.shape
                    if result.frames == 0:
                        result.size_px = (width, height)
                    elif result.size_px != (width, height):
                        raise InputError(
                            f"{name}: {frame.name} has {width}x{height} px, the frames before it "
                            f"{result.size_px[0]}x{result.size_px[1]} px: a camera is calibrated "
                            "at one size"
                        )
                    result.frames += 1
                    seen = finder.find(frame, number)
                    if seen is not None:
                        result.observations.append(seen)
                    else:
                        missing += 1
                        if missing & (missing - 1) == 0 and len(result.without) < _PICTURES:
                            result.without.append(frame.image)
                    if on_frame is not None:
                        on_frame(result)
                    progress.step()
        except KeyboardInterrupt:
            result.interrupted = True
    return result
