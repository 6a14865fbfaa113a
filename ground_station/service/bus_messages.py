"""What the service's processes say to one another: JSON objects on the local bus.

All of them run the same version, so a message has no schema of its own; what does not fit is
dropped. Times are int nanoseconds; `capture_ns`, `arrival_ns` and `done_ns` are this machine's
wall clock.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any, TypeVar

from ground_station.errors import GroundStationError
from ground_station.files import finite

FRAME, ESTIMATE, PAYLOAD = "frame", "estimate", "payload"
EVENT, RECORDING, PROCESS = "event", "recording", "process"
KINDS = (FRAME, ESTIMATE, PAYLOAD, EVENT, RECORDING, PROCESS)
STATION = "-"
"""Stands for a payload's id where a message is of none."""

INFO, WARNING, ALARM = "info", "warning", "alarm"
RECORDING_RESUMED = "recording-resumed"
"""An event: a recording that was cut goes on in another file."""

N = TypeVar("N", bound="Message")

_DEEPEST, _FLAT_BRACKETS = 32, 32


class MessageError(GroundStationError):
    """Bytes on the bus that are no message of the kind."""


@dataclass(frozen=True)
class Message:
    """Base of all messages."""


@dataclass(frozen=True)
class FrameMessage(Message):
    """A received frame, whose picture lies in the ring at `slot` while `stamp` still holds."""

    slot: int
    stamp: int
    sequence: int
    time_ns: int  # the camera's
    clock_ns: int  # the payload's clock at capture
    arrival_ns: int
    width_px: int
    height_px: int
    ssrc: int
    capture_ns: int | None = None  # None while the payload's clock is not known
    exposure_s: float | None = None
    gain: float | None = None
    entropy_bits: float = 0.0
    sharpness: float = 0.0
    heartbeat: bool = False


@dataclass(frozen=True)
class EstimateMessage(Message):
    """A frame's pose, or why there is none.

    `quaternion_xyzw` and `position_m` are wTc, `covariance` (36, row by row) is of the right
    tangent in the camera's axes, rotation before translation; `position_sigma_m` (9) is the
    position's covariance in world axes, m². `points_px` are the tracked landmarks, u, v by turns,
    `landmarks` their indices in the map, which only a replay asks for.
    `processed`, `localized` and `skipped` count this payload's frames since the localizer's start.
    `overload` says in words that the processor is too slow for them; "" while it is not.
    """

    sequence: int
    time_ns: int
    clock_ns: int
    done_ns: int
    state: str
    capture_ns: int | None = None
    reason: str = ""
    position_m: list[float] | None = None
    quaternion_xyzw: list[float] | None = None
    covariance: list[float] | None = None
    position_sigma_m: list[float] | None = None
    velocity_mps: list[float] | None = None  # world axes
    heading_deg: float | None = None  # of the view, from the map's x axis towards y
    speed_mps: float | None = None
    height_m: float | None = None
    relocalized: bool = False
    tracked: bool = False
    inliers: int = 0
    expected: int = 0
    points_px: list[float] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    stage_ms: dict[str, float] = field(default_factory=dict)
    map: str = ""
    processed: int = 0
    localized: int = 0
    skipped: int = 0
    overload: str = ""


@dataclass(frozen=True)
class PayloadMessage(Message):
    """A payload as the intake sees it, twice a second.

    `frames` by fate: captured, gated, sent, discarded (the payload's own account), received, lost,
    withheld, dropped. `stream` has the receiver's counters. `battery`, `health` and `autopilot` are
    the newest messages as they came; `refused` counts those that were not as agreed. `ended`: it
    said that its stream is over, and its own account is final.
    """

    alive: bool
    seen_ns: int
    ssrc: int | None = None
    encrypted: bool = False
    frames: dict[str, int] = field(default_factory=dict)
    stream: dict[str, int] = field(default_factory=dict)
    rate_hz: float = 0.0
    bitrate_kbps: float = 0.0  # as received
    lost_share: float = 0.0  # of late
    clock: dict[str, int] | None = None  # offset_ns, uncertainty_ns, steps
    round_trip_s: float | None = None
    battery: dict[str, Any] | None = None
    health: dict[str, Any] | None = None
    autopilot: dict[str, Any] | None = None
    recording: str = ""  # the file on the payload's own card
    refused: int = 0
    ended: bool = False


@dataclass(frozen=True)
class EventMessage(Message):
    """Something that happened; `source` is payload, intake, localizer, web or station."""

    time_ns: int
    source: str
    level: str
    name: str
    text: str


@dataclass(frozen=True)
class RecordingMessage(Message):
    """The ground's own recording, each second."""

    active: bool
    file: str = ""
    size_MB: float = 0.0
    duration_s: float = 0.0
    dropped: int = 0
    free_MB: float | None = None
    problem: str = ""
    resumed: str = ""  # where it goes on from one that was cut: both files, and what is lost


@dataclass(frozen=True)
class ProcessMessage(Message):
    """A process of the service says that it lives."""

    name: str
    pid: int
    memory_MB: float = 0.0
    cpu: float = 0.0  # of one core, since the last message
    uptime_s: float = 0.0
    restarts: int = 0


def encode(message: Message) -> bytes:
    """A message as JSON; numbers that are not finite become null, which JSON can say."""
    document = {item.name: getattr(message, item.name) for item in dataclasses.fields(message)}
    try:
        return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    except ValueError:
        return json.dumps(finite(document), separators=(",", ":"), allow_nan=False).encode()


def decode(kind: type[N], data: bytes) -> N:
    """A message of a kind; raises `MessageError` with one line."""
    try:
        document = json.loads(data)
        # None of ours has so many; one that nests without end could be read and not be written.
        if data.count(b"[") + data.count(b"{") > _FLAT_BRACKETS and _depth(document) > _DEEPEST:
            raise ValueError(f"it nests deeper than {_DEEPEST}")
        return kind(**document)
    except (ValueError, TypeError, RecursionError) as error:
        raise MessageError(f"{kind.__name__}: {str(error)[:120]}") from None


def _depth(value: Any) -> int:
    """How deep a document nests, as far as it matters."""
    level, depth = [value], 0
    while level and depth <= _DEEPEST:
        depth += 1
        inner = [list(i.values()) if isinstance(i, dict) else i for i in level]
        level = [v for i in inner if isinstance(i, list) for v in i if isinstance(v, dict | list)]
    return depth


def as_document(message: Message) -> dict[str, Any]:
    """A message as plain JSON values."""
    document = {item.name: getattr(message, item.name) for item in dataclasses.fields(message)}
    told: dict[str, Any] = finite(document)
    return told
