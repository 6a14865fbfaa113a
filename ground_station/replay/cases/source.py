"""What a recording has for a replay: frames, camera, poses, and whether it was cut."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ground_station.errors import InputError
from ground_station.geometry.camera import Camera
from ground_station.recording.flight import camera_of
from ground_station.replay.cases.case import RECORDING, Case
from pi_firmware.wire.recording import VIDEO_TOPIC, RecordingReader


@dataclass(frozen=True)
class Source:
    """A recording's flight: its F frames' times (F,) int64 ns, its camera, its topics by count.

    `cut` says where and why the file ends early, "" for a whole one; what is before that is whole.
    """

    path: Path
    time_ns: np.ndarray
    camera: Camera
    topics: dict[str, int]
    cut: str = ""

    @property
    def span_s(self) -> float:
        """From the first frame to the last."""
        return float(self.time_ns[-1] - self.time_ns[0]) / 1e9

    @property
    def notes(self) -> list[str]:
        """What a reader must know: that it was cut, and how much of it is readable."""
        if not self.cut:
            return []
        return [
            f"{self.path.name} was cut ({self.cut}): {len(self.time_ns)} frames, "
            f"{self.span_s:.1f} s, are readable"
        ]


def examine(path: str | Path) -> Source:
    """Reads through a recording.

    Raises `RecordingError` for what is none, `InputError` without frames or camera; in one line.
    """
    path = Path(path)
    reader = RecordingReader(path)
    topics = reader.topics()
    cut = reader.cut_reason if reader.cut else ""
    after = f"; it was cut ({cut})" if cut else ""
    if not topics.get(VIDEO_TOPIC):
        raise InputError(f"{path}: no video on {VIDEO_TOPIC}{after}")
    times = np.array([sample.time_ns for sample in reader.video()], dtype=np.int64)
    camera = camera_of(reader)
    if camera is None:
        raise InputError(
            f"{path}: it carries no camera calibration; record with --camera CAMERA.toml{after}"
        )
    return Source(path, times, camera, topics, cut)


def payloads_of(reader: RecordingReader) -> dict[str, str]:
    """Names of the payloads that a recording tells of, and what stands before their topics.

    After an iteration has come to its end.
    """
    return {
        table["payload_id"]: table["topics"]
        for name, table in reader.metadata.items()
        if (name == "payload" or name.startswith("payload "))
        and {"payload_id", "topics"} <= set(table)
    }


def check_case(case: Case) -> Source:
    """Whether a case's recording has what the case asks of it, and what it has.

    Raises a `BlimpError` with one line that names the case's file, key, value and range.
    """
    source = examine(case.recording_path)
    check_start(source, f"{case.path}: 'start_s'", case.start_s)
    for kind in ("image", "ssh"):
        start_s = getattr(case.kinds, kind).start_s
        check_start(source, f"{case.path}: 'kinds.{kind}.start_s'", start_s or 0.0)
    if case.init == "truth" and not source.topics.get(case.truth.topic):
        raise InputError(f"{case.path}: 'init' is 'truth', but {missing(source, case.truth.topic)}")
    if case.truth.kind == RECORDING and not source.topics.get(case.truth.topic):
        raise InputError(
            f"{case.path}: 'truth.kind' is 'recording', but {missing(source, case.truth.topic)}"
        )
    return source


def check_start(source: Source, what: str, start_s: float) -> None:
    """Raises `InputError` where a flight would begin behind a recording's readable end."""
    if start_s and not start_s < source.span_s:
        readable = "readable " if source.cut else ""
        raise InputError(
            f"{what} is {start_s:g} s; allowed: less than the {readable}{source.span_s:.3f} s of"
            f" {source.path}"
        )


def missing(source: Source, topic: str) -> str:
    """That a recording has no poses on a topic, and which others it has."""
    found = sorted(name for name in source.topics if name.endswith("/pose"))
    others = f" (poses are on {', '.join(found)})" if found else " and no other poses"
    cut = f"; it was cut ({source.cut})" if source.cut else ""
    return f"{source.path} has no poses on {topic}{others}{cut}"
