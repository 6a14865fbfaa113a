"""The poses of a recording for other programs: TUM text, or an MCAP with nothing else in it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ground_station.errors import GroundStationError, InputError
from ground_station.geometry.trajectory import tum_line
from pi_firmware.wire import files
from pi_firmware.wire.errors import os_errors_as
from pi_firmware.wire.recording import ESTIMATE_TOPIC, PoseSample, RecordingReader, RecordingWriter

HEADER = "# timestamp tx ty tz qx qy qz qw\n"
AGAIN = "# the camera's time begins again\n"
"""Before the first pose of another stream: a payload that was restarted, a replay's next round."""


@dataclass(frozen=True)
class Poses:
    """A recording's poses on a topic in the file's order, `wTc` at the camera's times.

    `left_out` counts those that are no poses; `again` how often the camera's time went back;
    `cut_reason` says where the file stops early, "" for a whole one.
    """

    topic: str
    samples: list[PoseSample]
    left_out: int
    again: int
    cut_reason: str


def read_poses(path: str | Path, topic: str | None = None) -> Poses:
    """The poses on a topic; None: of the only one with estimates.

    Raises `RecordingError` for what is no recording or no pose, `InputError` where there are no
    poses or several topics to choose from; in one line.
    """
    reader = RecordingReader(path)
    if topic is None:
        topic = _only_topic(path, reader.topics())
    samples = reader.poses(topic)
    if not samples:
        raise InputError(f"{path}: no poses on {topic}")
    usable = [sample for sample in samples if _usable(sample)]
    again = sum(b.time_ns < a.time_ns for a, b in itertools.pairwise(usable))
    reason = reader.cut_reason if reader.cut else ""
    return Poses(topic, usable, len(samples) - len(usable), again, reason)


def tum(poses: Poses) -> Iterator[str]:
    """Poses that were read as the lines of a TUM file, each with its end.

    Timestamps are the camera's, in seconds. What is left out is told in a comment, and where the
    camera's time begins again.
    """
    yield HEADER
    last_ns: int | None = None
    for sample in poses.samples:
        if last_ns is not None and sample.time_ns < last_ns:
            yield AGAIN
        last_ns = sample.time_ns
        yield tum_line(sample.time_ns, sample.position_m, sample.quaternion_xyzw) + "\n"
    if poses.left_out:
        yield f"# {poses.left_out} left out: no finite pose or time\n"
    if poses.cut_reason:
        yield f"# the recording is cut: {poses.cut_reason}\n"


def write_mcap(path: str | Path, poses: Poses, source: str) -> None:
    """Writes the poses alone as a recording, beside and renamed; `source` names where from."""
    path = Path(path)
    with (
        os_errors_as(path, GroundStationError),
        files.replacing(path) as part,
        RecordingWriter(part) as writer,
    ):
        writer.write_metadata("export", {"source": source, "topic": poses.topic})
        for sample in poses.samples:
            writer.write_pose(
                sample.time_ns, sample.position_m, sample.quaternion_xyzw, topic=poses.topic
            )


def _only_topic(path: str | Path, topics: Iterable[str]) -> str:
    """The topic of estimates; those of a ground station begin with the payload's name."""
    found = sorted(name for name in topics if name.endswith(ESTIMATE_TOPIC))
    if not found:
        raise InputError(
            f"{path}: no poses on {ESTIMATE_TOPIC}; blimp localize makes them, --topic takes others"
        )
    if len(found) > 1:
        raise InputError(f"{path}: poses on {', '.join(found)}; say which by --topic")
    return found[0]


def _usable(sample: PoseSample) -> bool:
    numbers = (*sample.position_m, *sample.quaternion_xyzw)
    finite = bool(np.isfinite(numbers).all() and np.linalg.norm(sample.quaternion_xyzw) > 1e-6)
    return finite and 0 <= sample.time_ns < 1 << 63
