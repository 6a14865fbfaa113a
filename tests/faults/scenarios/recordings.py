"""Invariant 3: recordings can be read, and lack nothing but the last second. Pure, but for files.

All checks return what is wrong, in words; nothing where they hold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pi_firmware.wire import sei
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.recording import VIDEO_TOPIC, RecordingReader, VideoSample

CUT_S = 1.0
"""What a cut may cost: `recording.sync_s`."""
NOISE_S = 2.0
"""More, where the machine is busy: a frame may be that late on its way to the disk."""

Window = list[float]
"""From when to when something ended a recording at some moment, `time.monotonic`."""
Frame = tuple[int, int]
"""Sequence number, and the payload's clock at capture."""


@dataclass(frozen=True)
class Recorded:
    """What is in a file; `left_out` is what it says at its end that it lacks."""

    name: str
    frames: list[Frame]
    cut: bool = False
    left_out: int = 0
    problem: str = ""


@dataclass(frozen=True)
class Came:
    """A frame that came to a recorder, and when."""

    frame: Frame
    at_s: float


def read(path: Path) -> Recorded:
    """All video of a file, of whichever payload, up to its last whole chunk."""
    frames: list[Frame] = []
    try:
        reader = RecordingReader(path)
        topics = {topic for topic in reader.topics() if topic.endswith(VIDEO_TOPIC)}
        for topic in sorted(topics):
            frames += [_frame(sample, path) for sample in reader.video(topic)]
        table = {} if reader.cut else reader.metadata_table("recording_end")
        return Recorded(path.name, frames, reader.cut, int(table.get("left_out", "0")))
    except (BlimpError, ValueError, OSError) as error:
        return Recorded(path.name, frames, problem=f"{path.name}: {error}")


def _frame(sample: VideoSample, path: Path) -> Frame:
    info = sei.find(sample.data)
    if info is None:
        raise ValueError(f"{path}: a frame without its numbers")
    return info.sequence, info.clock_ns


def lacking(
    files: Sequence[Recorded], came: Sequence[Came], ended_s: Sequence[Window]
) -> list[str]:
    """Each file has all that came from its first frame to its last, but what it says it lacks.

    And nothing came more than a second (and the machine's noise) before the recorder's end, within
    one of the windows `ended_s`, that is in no file. A file ends where the next one begins, too.
    """
    place = {one.frame: index for index, one in enumerate(came)}
    complaints = [file.problem for file in files if file.problem]
    kept = {frame for file in files for frame in file.frames}
    for file in files:
        known = [index for index, frame in enumerate(file.frames) if frame in place]
        if not known:
            continue
        # Who listens beside it begins later, and ends earlier, than a recorder that is killed.
        inner = file.frames[known[0] : known[-1] + 1]
        if len(inner) > len(known):
            complaints.append(f"{file.name}: {len(inner) - len(known)} frames that never came")
        places = sorted(place[file.frames[index]] for index in known)
        begin, end = places[0], places[-1]
        missing = [one for one in came[begin : end + 1] if one.frame not in kept]
        if len(missing) > file.left_out:
            complaints.append(
                f"{file.name}: {len(missing)} frames are missing in it, it says {file.left_out}"
            )
        complaints += _tail(file, came[end:], kept, ended_s)
    return complaints


def _tail(
    file: Recorded, after: Sequence[Came], kept: set[Frame], ended_s: Sequence[Window]
) -> list[str]:
    last_s = after[0].at_s
    until_s = min((begin_s for begin_s, end_s in ended_s if end_s >= last_s), default=math.inf)
    # The next file has taken over from the first frame on that it has.
    lost = []
    for one in after[1:]:
        if one.frame in kept:
            break
        lost.append(one)
    late = [one for one in lost if one.at_s < until_s - CUT_S - NOISE_S]
    if len(late) <= file.left_out:
        return []
    span_s = min(until_s, lost[-1].at_s) - last_s
    return [f"{file.name}: lacks the last {span_s:.1f} s, {len(late)} frames of them in vain"]
