"""A case out of a recording: `blimp replay --make-case`."""

from __future__ import annotations

import os
import tomllib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.errors import InputError
from ground_station.evaluation import ate
from ground_station.files import check_outputs, write_text
from ground_station.geometry.trajectory import Trajectory, read_tum
from ground_station.map import store
from ground_station.recording.flight import trajectory_of
from ground_station.replay.cases.case import GOLDEN, NONE, RECORDING, SURVEY, Keys, Truth
from ground_station.replay.cases.commented import commented
from ground_station.replay.cases.extract import extract
from ground_station.replay.cases.measure import figures
from ground_station.replay.cases.outcome import Outcome
from ground_station.replay.cases.propose import propose
from ground_station.replay.cases.source import Source, check_start, examine, missing, payloads_of
from ground_station.replay.cases.truth import Reference
from pi_firmware.wire import config
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.recording import TRUTH_TOPIC, VIDEO_TOPIC, RecordingReader
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
    check_outputs(out)
    _free(out, asked.force)
    map_ = store.load(asked.map)
    prefix = _prefix(asked)
    if not prefix:
        return _make(asked, map_, asked.recording, Made())
    recording = out.with_suffix(".mcap")
    _free(recording, asked.force)
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


def _free(path: Path, force: bool) -> None:
    if path.exists() and not force:
        raise InputError(f"{path}: it exists already; --force overwrites it")


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
