"""What the service's processes say to one another: JSON objects on the local bus.

All of them run the same version, so a message has no schema of its own. It is checked once, as it
is decoded: what is not of these types and ranges is no message, and who takes one may trust it.
Times are nanoseconds; `capture_ns`, `arrival_ns` and `done_ns` are this machine's wall clock.
"""

from __future__ import annotations

import functools
import threading
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from ground_station.errors import GroundStationError
from pi_firmware.wire import messages

FRAME, ESTIMATE, PAYLOAD = "frame", "estimate", "payload"
EVENT, RECORDING, PROCESS, LEAVE = "event", "recording", "process", "leave"
ELSEWHERE = "elsewhere"
"""An `EstimateMessage` of a payload that flies with another station."""
STATION = "-"
"""Stands for a payload's id where a message is of none."""

Level = Literal["info", "warning", "alarm"]
INFO: Level = "info"
WARNING: Level = "warning"
ALARM: Level = "alarm"
RECORDING_RESUMED = "recording-resumed"
"""An event: a recording that was cut goes on in another file."""

N = TypeVar("N", bound="Message")

Count = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
Time = Count
WallTime = Annotated[int, Meta(ge=0, lt=(1 << 32) * 1_000_000_000)]
"""Of this machine: until 2106, which is as far as Foxglove's stamps go."""
Vector3 = Annotated[list[float], Meta(min_length=3, max_length=3)]
Quaternion = Annotated[list[float], Meta(min_length=4, max_length=4)]
Matrix3 = Annotated[list[float], Meta(min_length=9, max_length=9)]
Matrix6 = Annotated[list[float], Meta(min_length=36, max_length=36)]


class MessageError(GroundStationError):
    """Bytes on the bus that are no message of the kind."""


@dataclass(frozen=True, slots=True)
class Message:
    """Base of all messages."""


@dataclass(frozen=True, slots=True)
class FrameMessage(Message):
    """A received frame, whose picture lies in the ring at `slot` while `stamp` still holds."""

    slot: Count
    stamp: Count
    sequence: Count
    time_ns: Time  # the camera's
    clock_ns: Time  # the payload's clock at capture
    arrival_ns: WallTime
    width_px: Count
    height_px: Count
    ssrc: Count
    capture_ns: WallTime | None = None  # None while the payload's clock is not known
    exposure_s: float | None = None
    gain: float | None = None
    entropy_bits: float = 0.0
    sharpness: float = 0.0
    heartbeat: bool = False
    shown: Count = 0  # frames of this session up to this one
    damaged: bytes = b""  # macroblocks that a loss took, a bit each, row by row; empty: none


@dataclass(frozen=True, slots=True)
class EstimateMessage(Message):
    """A frame's pose, or why there is none.

    `quaternion_xyzw` and `position_m` are wTc, `covariance` (36, row by row) is of the right
    tangent in the camera's axes, rotation before translation; `position_sigma_m` (9) is the
    position's covariance in world axes, m². `points_px` are the tracked landmarks, u, v by turns,
    `landmarks` their indices in the map, which only a replay asks for.
    `processed`, `localized` and `skipped` count the frames of this payload's session.
    `coordinates` are those of the map, which maps that grew from it have, too.
    `overload` says in words that the processor is too slow for them; "" while it is not. `damaged`
    is the share of the picture that a loss took.
    """

    sequence: Count
    time_ns: Time
    clock_ns: Time
    done_ns: WallTime
    state: Literal["INITIALIZING", "TRACKING", "DEGRADED", "LOST"]
    capture_ns: WallTime | None = None
    reason: str = ""
    position_m: Vector3 | None = None
    quaternion_xyzw: Quaternion | None = None
    covariance: Matrix6 | None = None
    position_sigma_m: Matrix3 | None = None
    velocity_mps: Vector3 | None = None  # world axes
    turn_radps: Vector3 | None = None  # about the camera's axes
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
    coordinates: str = ""
    processed: int = 0
    localized: int = 0
    skipped: int = 0
    overload: str = ""
    damaged: float = 0.0


@dataclass(frozen=True, slots=True)
class PayloadMessage(Message):
    """A payload as the intake sees it, twice a second.

    `frames` by fate: captured, gated, sent, discarded (the payload's own account), received (of
    these `damaged`), lost, withheld, dropped. `stream` has the receiver's counters. `battery`,
    `health` and `autopilot` are the newest messages as they came; `refused` counts those that were
    not as agreed. `ended`: it said that its stream is over, and its own account is final.
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
    battery: messages.Battery | None = None
    health: messages.Health | None = None
    autopilot: messages.Autopilot | None = None
    recording: str = ""  # the file on the payload's own card
    refused: int = 0
    ended: bool = False
    station: str = ""  # another one, to which it sends its video
    relayed: bool = False  # by that station, which sees it; nothing is judged here


@dataclass(frozen=True, slots=True)
class EventMessage(Message):
    """Something that happened; `source` is payload, intake, localizer, web or station."""

    time_ns: WallTime
    source: str
    level: Level
    name: str
    text: str


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class LeaveMessage(Message):
    """The payloads that are left to other stations for now; told again as long as that holds."""

    payloads: list[str]


@dataclass(frozen=True, slots=True)
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
    return msgspec.json.encode(message)


_BUILDING = threading.Lock()


@functools.cache
def _decoder(kind: type[N]) -> msgspec.json.Decoder[N]:
    # msgspec shows a class to other threads before it knows all its fields: two that hear their
    # first message of a kind at once ended the process (0.22.0).
    with _BUILDING:
        return msgspec.json.Decoder(kind)


def decode(kind: type[N], data: bytes) -> N:
    """A message of a kind; raises `MessageError` with one line."""
    try:
        message: N = _decoder(kind).decode(data)  # type: ignore[arg-type]  # a class is hashable
    except (msgspec.MsgspecError, RecursionError, ValueError) as error:
        raise MessageError(f"{kind.__name__}: {str(error)[:120]!r}") from None
    return message


def as_document(message: Message) -> dict[str, Any]:
    """A message as plain JSON values."""
    document: dict[str, Any] = msgspec.to_builtins(message)
    return document
