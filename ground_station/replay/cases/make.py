"""A case out of a recording: `blimp replay --make-case`."""

from __future__ import annotations

import math
import os
import tomllib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError, Message

from ground_station.errors import InputError
from ground_station.evaluation import ate
from ground_station.evaluation.figures import AT_LEAST, digits
from ground_station.files import check_new, write_text
from ground_station.geometry.trajectory import Trajectory, read_tum
from ground_station.map import store
from ground_station.recording.flight import trajectory_of
from ground_station.recording.frames import CAMERA_TABLE
from ground_station.replay.cases.case import (
    BOUNDS,
    GOLDEN,
    NONE,
    RECORDING,
    SURVEY,
    Keys,
    Limits,
    Truth,
)
from ground_station.replay.cases.commented import commented
from ground_station.replay.cases.measure import Figure, figures
from ground_station.replay.cases.outcome import Outcome
from ground_station.replay.cases.source import Source, check_start, examine, missing, payloads_of
from ground_station.replay.cases.truth import Reference
from pi_firmware.wire import config, files
from pi_firmware.wire.config import range_of
from pi_firmware.wire.errors import BlimpError, os_errors_as
from pi_firmware.wire.recording import (
    CALIBRATION_TOPIC,
    ESTIMATE_TOPIC,
    FRAME_INFO_TOPIC,
    TRUTH_TOPIC,
    VIDEO_TOPIC,
    RecordingReader,
    RecordingWriter,
)
from pi_firmware.wire.text import printable

GOLDEN_SUFFIX = ".golden.txt"
_BRIEF = ("bounds.image", "bounds.ssh")
_HEAD = """\
# A replay test; make hil flies it. Paths are relative to this file's folder.
# Every key stands here with what it is, its unit, range and default; leave out what you don't
# change. A bound that is set must hold; one whose figure is not measured fails.
"""


@dataclass(frozen=True)
class Asked:
    """What a case is made of.

    `truth` is None, `golden`, `recording`, `recording:TOPIC` or a TUM file; `outcome` a run whose
    figures the bounds are proposed from, `flown` the case's keys on how it is flown, by name.
    """

    recording: Path
    map: Path
    out: Path
    truth: str | None = None
    payload_id: str | None = None
    outcome: Outcome | None = None
    force: bool = False
    flown: dict[str, Any] = field(default_factory=dict)
    settings: list[str] = field(default_factory=list)


@dataclass
class Made:
    """What was written, and what a person should know of it."""

    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def make_case(asked: Asked) -> Made:
    """Writes the case, and a recording of its own where the payload is one of several.

    Raises a `BlimpError` with one line; then nothing was written.
    """
    out = asked.out
    if out.suffix != ".toml" or not out.stem:
        raise InputError(f"{out}: a case is a .toml file")
    check_new(out, force=asked.force)
    map_ = store.load(asked.map)
    prefix = _prefix(asked)
    if not prefix:
        return _make(asked, map_, asked.recording, Made())
    recording = out.with_suffix(".mcap")
    check_new(recording, force=asked.force)
    count = extract(asked.recording, prefix, recording)
    note = f"the {count} frames of {prefix.strip('/')} are in a recording of their own"
    try:
        return _make(asked, map_, recording, Made([recording], [note]))
    except BlimpError:
        recording.unlink(missing_ok=True)
        raise


def _make(asked: Asked, map_: store.Map, recording: Path, made: Made) -> Made:
    """The case of a recording whose only flight is the one that is wanted."""
    out = asked.out
    source = examine(recording)
    made.notes += source.notes
    truth, poses = _truth(asked, source)
    if truth.kind in (RECORDING, SURVEY) and not map_.info.registered:
        raise InputError(
            f"{asked.map}: the map is not registered, so its poses compare with no truth; "
            "blimp map register"
        )
    limits: dict[str, Any] = {}
    remarks = _remarks(source)
    if asked.outcome is not None:
        reference = None if poses is None else Reference(poses, "the truth")
        limits, more = propose(figures(asked.outcome, reference))
        remarks |= more
    text = (
        _HEAD
        + "\n"
        + commented(
            _keys(asked, recording, map_, truth, limits, source), remarks=remarks, brief=_BRIEF
        )
    )
    config.from_mapping(tomllib.loads(text), Keys, where=str(out))  # it reads back
    write_text(out, text)
    made.files.append(out)
    if truth.kind == GOLDEN:
        made.notes.append(
            "fly it, then accept the run: blimp replay --accept OUTCOME --by NAME --tolerance-m M "
            f"--tolerance-deg D --out {out.with_suffix(GOLDEN_SUFFIX)}"
        )
    if not limits:
        made.notes.append("no bounds are set: only the frames' accounts and telemetry are judged")
    return made


def _keys(
    asked: Asked,
    recording: Path,
    map_: store.Map,
    truth: Truth,
    limits: dict[str, Any],
    source: Source,
) -> Keys:
    """The case's keys, each checked."""
    flown = dict(asked.flown)
    if flown.get("init", "none") not in ("none", "truth"):
        flown["init"] = _relative(Path(flown["init"]), asked.out)
    document = {
        "title": printable(f"{asked.recording.stem} in {map_.info.name}", 200),
        "recording": _relative(recording, asked.out),
        "map": _relative(asked.map, asked.out),
        "payload": {"settings": asked.settings},
        "truth": asdict(truth),
        "bounds": limits,
        **flown,
    }
    keys = config.from_mapping(document, Keys, where="--make-case")
    check_start(source, "--start-s", keys.start_s)
    if keys.init == "truth" and not source.topics.get(TRUTH_TOPIC):
        raise InputError(f"--init truth: {missing(source, TRUTH_TOPIC)}")
    return keys


def _prefix(asked: Asked) -> str:
    """What stands before the topics of the payload that was asked for; the only one's by itself."""
    reader = RecordingReader(asked.recording)
    topics = reader.topics()
    known = payloads_of(reader)
    flown = {name: prefix for name, prefix in known.items() if topics.get(prefix + VIDEO_TOPIC)}
    told = f"it has {', '.join(sorted(flown))}" if flown else "it names no payload"
    if asked.payload_id is None:
        if len(flown) > 1:
            raise InputError(f"{asked.recording}: {told}; say which by --payload-id")
        return next(iter(flown.values()), "")
    if asked.payload_id not in flown:
        raise InputError(f"{asked.recording}: no video of payload '{asked.payload_id}'; {told}")
    return flown[asked.payload_id]


def _truth(asked: Asked, source: Source) -> tuple[Truth, Trajectory | None]:
    """The table of the case, and its poses where they are known now."""
    kind, _, topic = (asked.truth or NONE).partition(":")
    if asked.truth is None:
        return Truth(), None
    if asked.truth == GOLDEN:
        return Truth(GOLDEN, asked.out.with_suffix(GOLDEN_SUFFIX).name), None
    if kind == RECORDING:
        topic = topic or TRUTH_TOPIC
        if not source.topics.get(topic):
            raise InputError(f"--truth {asked.truth}: {missing(source, topic)}")
        poses = trajectory_of(source.path, topic)
        truth = Truth(RECORDING, topic=topic)
    else:
        poses = read_tum(asked.truth)
        truth = Truth(SURVEY, _relative(Path(asked.truth), asked.out))
    pairs, _ = ate.associate(poses.time_ns, np.sort(source.time_ns))
    if not len(pairs):
        raise InputError(
            f"--truth {asked.truth}: none of its {len(poses)} poses is within {ate.MAX_DIFF_S:g} s"
            f" of a frame of {source.path}, whose times are"
            f" {source.time_ns.min() / 1e9:.3f} to {source.time_ns.max() / 1e9:.3f} s"
        )
    return truth, poses


def _remarks(source: Source) -> dict[str, str]:
    camera = source.camera
    about = (
        f"{len(source.time_ns)} frames of {camera.width_px}x{camera.height_px} px,"
        f" {source.span_s:.1f} s"
    )
    return {
        "recording": "\n".join([about, *source.notes]),
        "bounds": "What a run must hold; a key without a value is not judged.",
        "bounds.image": "The keys of [bounds] for the emulated card, each in place of that above.",
        "bounds.ssh": "The same for a real board.",
        "kinds.image": "How much of the flight the emulated card bears.",
        "kinds.ssh": "The same for a real board.",
    }


def _relative(path: Path, case: Path) -> str:
    return Path(os.path.relpath(path.resolve(), case.resolve().parent)).as_posix()


MARGINS = {
    "coverage_min": (0.0, 0.05),
    "tracking_min": (0.0, 0.05),
    "lost_max": (0.0, 0.02),
    "position_rmse_m_max": (0.5, 0.005),
    "rotation_rmse_deg_max": (0.5, 0.05),
    "position_max_m": (0.5, 0.02),
    "latency_p50_ms_max": (1.0, 10.0),
    "latency_p99_ms_max": (1.0, 50.0),
    "recovery_s_max": (0.5, 0.5),
    "payload_memory_MB_max": (0.25, 0.0),
    "ground_memory_MB_max": (0.25, 0.0),
    "payload_cpu_max": (0.5, 0.0),
}
"""What is left between a measured value and its bound: a share of it, and a fixed part.

The cell's voltage has none: what is healthy is no matter of one run."""


def propose(figures: dict[str, Figure]) -> tuple[dict[str, float], dict[str, str]]:
    """Bounds of what was measured, by name, and for each a remark that says how it came about."""
    bounds: dict[str, float] = {}
    remarks: dict[str, str] = {}
    for name, figure_name, _, sense in BOUNDS:
        value = figures[figure_name].value
        if name not in MARGINS or value is None or not math.isfinite(value):
            continue
        share, fixed = MARGINS[name]
        room = share * abs(value) + fixed
        bound = value - room if sense == AT_LEAST else value + room
        outward = _outward(max(0.0, bound), down=sense == AT_LEAST)
        bounds[name] = min(outward, range_of(Limits, name)[1])
        parts = [f"{share:.0%} of it"] * (share > 0) + [f"{fixed:g}"] * (fixed > 0)
        remarks[f"bounds.{name}"] = (
            f"Measured {digits(value, None)}; the margin is {' and '.join(parts)}."
        )
    return bounds, remarks


def _outward(value: float, *, down: bool) -> float:
    """Rounded to two digits, away from what was measured."""
    if value == 0:
        return 0.0
    scale = 10.0 ** (math.floor(math.log10(abs(value))) - 1)
    whole = math.floor(value / scale) if down else math.ceil(value / scale)
    return float(f"{whole * scale:.6g}")


_KINDS: dict[str, type[Message]] = {
    VIDEO_TOPIC: CompressedVideo,
    CALIBRATION_TOPIC: CameraCalibration,
    TRUTH_TOPIC: PoseInFrame,
    ESTIMATE_TOPIC: PoseInFrame,
}
_TABLES = (CAMERA_TABLE, "simulation")
_FRAME_SCHEMA = "blimp.Frame"


def extract(source: str | Path, prefix: str, path: str | Path) -> int:
    """Copies the video, camera and poses behind a payload's `prefix` to their own topics.

    Written beside and renamed; what a cut recording has is copied. Returns the number of frames.
    Raises `InputError` when there are none.
    """
    source, path = Path(source), Path(path)
    reader = RecordingReader(source)
    wanted = {prefix + topic: topic for topic in (*_KINDS, FRAME_INFO_TOPIC)}
    frames = 0
    try:
        with os_errors_as(path, InputError), files.replacing(path) as part:
            with RecordingWriter(part) as writer:
                for channel, record in reader.messages(set(wanted)):
                    _copy(writer, wanted[channel.topic], record.log_time, record.data)
                    frames += wanted[channel.topic] == VIDEO_TOPIC
                for name in _TABLES:
                    if reader.metadata.get(name):
                        writer.write_metadata(name, reader.metadata[name])
            if not frames:
                raise InputError(f"{source}: no video on {prefix}{VIDEO_TOPIC}")
    except DecodeError:
        raise InputError(f"{source}: a message is not what its topic says") from None
    return frames


def _copy(writer: RecordingWriter, topic: str, log_ns: int, data: bytes) -> None:
    if topic == FRAME_INFO_TOPIC:
        writer.write_json_text(topic, log_ns, data, schema_name=_FRAME_SCHEMA)
    else:
        writer.write_protobuf(topic, log_ns, _KINDS[topic].FromString(data))
