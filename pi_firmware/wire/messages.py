"""Telemetry messages: small JSON objects with `schema` and `time_ns`.

`schema` is `blimp.<kind>/<major>.<minor>`. A reader takes its own major version with any minor one:
it ignores fields it does not know and gives the default to those an older writer did not send.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import json
import math
import types
import typing
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

from pi_firmware.wire.errors import TelemetryError

M = TypeVar("M", bound="Message")

MOST_LETTERS, MOST_ITEMS = 1024, 64
"""Of a text, of which the rest is cut, and of a list or an object, which is refused beyond it."""

ALARM_NONE, ALARM_LOW, ALARM_CRITICAL = "", "low", "critical"
UNDERVOLTAGE, WAS = "undervoltage", "-was"
"""What holds a board back, and how the name of what did so before ends."""


@dataclass(frozen=True)
class Message:
    """Base of all messages; `time_ns` is the payload's clock when it was made."""

    SCHEMA: ClassVar[str] = ""
    MAJOR: ClassVar[int] = 1
    MINOR: ClassVar[int] = 0

    time_ns: int


@dataclass(frozen=True)
class Battery(Message):
    """ROS `sensor_msgs/BatteryState`: its names, units and codes; None is ROS's unmeasured NaN."""

    SCHEMA: ClassVar[str] = "blimp.battery"
    MINOR: ClassVar[int] = 1

    voltage: float  # V
    percentage: float | None = None  # 0 to 1
    current: float | None = None  # A, negative when discharging
    charge: float | None = None  # Ah
    capacity: float | None = None  # Ah, last full
    design_capacity: float | None = None  # Ah
    temperature: float | None = None  # degrees Celsius
    power_supply_status: int = 0  # 1 charging, 2 discharging, 3 not charging, 4 full
    power_supply_health: int = 0  # 1 good
    power_supply_technology: int = 0  # 3 LiPo
    present: bool = True
    # Ours, not of ROS.
    time_left_s: float | None = None  # until the critical voltage, at the power of late
    alarm: str = ALARM_NONE
    read_errors: int = 0  # failed transfers so far; most of them were repeated with success
    refused: int = 0  # readings that could not be, none of which was sent
    reopened: int = 0  # times the bus was opened again
    resets: int = 0  # times the gauge had lost its settings


class Reason(enum.StrEnum):
    """Why the gate decides as it does: `PASS`, or what of a frame says too little."""

    PASS = "pass"
    ENTROPY = "entropy"
    BLUR = "blur"
    DUPLICATE = "duplicate"


@dataclass(frozen=True)
class Gate(Message):
    """The gate's decision on one captured frame, and the counters after it.

    `captured` = `gated` + frames handed to the encoder; `sent` of those have left it so far, and
    `discarded` never will: the encoder dropped them or was restarted. Heartbeats are frames sent
    although the gate would have dropped them.
    `reason` is a `Reason`'s value, a heartbeat's is what gates the frames around it; an older
    writer gave none. `difference` from the last frame sent, grey levels, is None before one was.
    """

    SCHEMA: ClassVar[str] = "blimp.gate"
    MINOR: ClassVar[int] = 2

    capture_ns: int
    sequence: int
    passed: bool
    heartbeat: bool
    entropy_bits: float
    sharpness: float
    captured: int
    gated: int
    heartbeats: int
    sent: int
    ssrc: int
    reason: str = ""
    difference: float | None = None
    discarded: int = 0


@dataclass(frozen=True)
class Event(Message):
    """Something that happened once: `name` for programs, `text` for people."""

    SCHEMA: ClassVar[str] = "blimp.event"

    name: str
    text: str
    values: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Pose(Message):
    """The ground station's estimate of one frame; `time_ns` is the ground station's clock.

    `capture_ns` is the frame's, of the payload's clock. Position (m) and quaternion x, y, z, w are
    those of wTc; None where the frame was not solved. `covariance` has 36 numbers, row by row, of
    the right tangent wTc·exp(xi) in the camera's axes, rotation (rad) before translation (m).
    `velocity_mps` is in world axes, `turn_radps` about the camera's; None where not estimated.
    `quality` is the share of the landmarks expected in view that were found, 0 to 1.
    """

    SCHEMA: ClassVar[str] = "blimp.pose"

    capture_ns: int
    sequence: int
    state: str  # INITIALIZING, TRACKING, DEGRADED or LOST
    position_m: list[float] | None = None
    quaternion_xyzw: list[float] | None = None
    covariance: list[float] | None = None
    velocity_mps: list[float] | None = None
    turn_radps: list[float] | None = None
    quality: float | None = None
    relocalized: bool = False


@dataclass(frozen=True)
class Autopilot(Message):
    """What the autopilot says of itself, and what it was given; None: it has not said yet."""

    SCHEMA: ClassVar[str] = "blimp.autopilot"

    connected: bool  # its heartbeat was heard within 3 s
    heartbeats: int = 0
    armed: bool | None = None
    mode: int | None = None  # ArduPilot's custom_mode
    system_status: int | None = None  # MAV_STATE
    roll_rad: float | None = None
    pitch_rad: float | None = None
    yaw_rad: float | None = None
    battery_V: float | None = None
    battery_A: float | None = None  # positive when discharging, as MAVLink has it
    battery_percentage: float | None = None  # 0 to 1
    sent: int = 0  # poses
    stale: int = 0  # poses not sent: too old, or out of order
    lost: int = 0  # not solved
    refused: int = 0  # not valid
    reset_counter: int = 0
    lines_opened: int = 0  # times the serial line was opened
    reason: str = ""  # why it is not open


@dataclass(frozen=True)
class Health(Message):
    """How payload and board are; None: this board cannot tell, or nothing was heard."""

    SCHEMA: ClassVar[str] = "blimp.health"
    MINOR: ClassVar[int] = 4

    uptime_s: float  # of the program
    captured: int = 0
    gated: int = 0
    sent: int = 0
    discarded: int = 0
    rate_hz: float = 0.0  # frames that left the encoder, of late
    bitrate_kbps: int = 0  # asked of the encoder
    lost: float | None = None  # share of packets, as the ground reports it
    round_trip_s: float | None = None
    ground_offset_s: float | None = None  # the ground's clock less ours
    temperature_C: float | None = None
    cpu: float | None = None  # share of all cores, 0 to 1
    memory_MB: float | None = None  # resident, of the program
    memory_free_MB: float | None = None
    disk_free_MB: float | None = None
    throttled: list[str] | None = None  # what the board is held back by now, or was (`WAS`)
    wifi_interface: str = ""
    wifi_signal_dBm: float | None = None
    wifi_quality: float | None = None  # 0 to 1
    wifi_restarts: int = 0
    camera_restarts: int = 0
    encoder_restarts: int = 0
    process_restarts: int = 0
    board_restarts: int = 0
    late: list[str] = field(default_factory=list)  # tasks that missed their watchdog
    recording: str = ""  # the file's name; empty: none
    recording_MB: float = 0.0
    recording_dropped: int = 0  # frames that a slow disk did not take
    version: str = ""  # of the program, with the release's commit; an older writer gave none
    release: str = ""  # how it came: factory, update, fell back; empty: it runs on no card
    release_reason: str = ""  # why an update did not stay
    early_reports: bool = False  # it takes link reports between those of each second
    idr_gap_s: float = 0.1  # a wish for an IDR sooner than this after another is not heard
    rtx_ssrc: int | None = None  # what is asked for again comes with it; None: nothing does
    correction_ssrc: int | None = None  # forward correction comes with it; None: none ever does
    ground: str = ""  # the station that it found and sends its video to; empty: it looks for none


@dataclass(frozen=True)
class LinkReport(Message):
    """What a ground station sees of a payload's video, once a second; `time_ns` is its own clock.

    `packets` and `packets_lost` count since it first saw the stream, `lost` is the share of late.
    One with `wants_idr` comes between these, at once when frames can't be shown for a loss, and so
    do others while a queue stands or overflows, if the payload's `Health` says `early_reports`.
    `received_kbps`, `queue_s` and `dropped` are None where an older ground station measures none
    or has nothing to measure them by.

    A packet was sent, and is one of `packets` or of `packets_lost`; `packets_recovered` of the
    former were missing, asked for again, and came in time, and `packets_corrected` were found from
    corrections. So `lost` is what is left after both, and `missed` and `dropped` are of what the
    link lost before them.
    """

    SCHEMA: ClassVar[str] = "blimp.link"
    MINOR: ClassVar[int] = 5

    ground: str  # its name
    video_port: int  # where it takes the video
    ssrc: int | None = None  # the stream that it takes; None: none
    packets: int = 0
    packets_lost: int = 0
    lost: float = 0.0
    round_trip_s: float | None = None
    wants_idr: bool = False
    received_kbps: float | None = None  # of the packets' payloads, over the last half second
    queue_s: float | None = None  # what most frames waited on the way, beyond the least of late
    dropped: float | None = None  # share of packets lost in the last second while others came
    packets_recovered: int = 0
    missed: float | None = None  # share of packets that were lost or recovered, of late
    retransmitted_kbps: float | None = None  # of received_kbps: packets that were sent again
    corrects: bool = False  # it takes forward correction
    packets_corrected: int = 0
    answered: int = 0  # retransmissions, whether or not their packets had been corrected meanwhile
    burst: float | None = None  # packets that were missing in a row, on average, of late
    largest_bytes: int | None = None  # the largest RTP packet of the last second, of ten and more


@dataclass(frozen=True)
class Command(Message):
    """What the ground asks for; its name stands in the key. `time_ns` is the ground's clock."""

    SCHEMA: ClassVar[str] = "blimp.command"

    arguments: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Answer(Message):
    """What became of a command: done, or why not; `values` is what is set now."""

    SCHEMA: ClassVar[str] = "blimp.answer"

    done: bool
    reason: str = ""
    values: dict[str, float] = field(default_factory=dict)


KINDS: dict[str, type[Message]] = {
    kind.SCHEMA.partition(".")[2]: kind for kind in (Battery, Gate, Event, Autopilot, Health)
}
"""What a payload tells by itself, by the kind that its key ends with."""

EVENT_STARTED = "started"
EVENT_SOURCE_CUT = "source-cut"
EVENT_END_OF_STREAM = "end-of-stream"
EVENT_STOPPED = "stopped"
EVENT_FAILED = "failed"
EVENT_BATTERY_LOW = "battery-low"
EVENT_BATTERY_CRITICAL = "battery-critical"
EVENT_GAUGE_FAILED = "gauge-failed"
EVENT_GAUGE_BACK = "gauge-back"
EVENT_CAMERA_RESTARTED = "camera-restarted"
EVENT_ENCODER_RESTARTED = "encoder-restarted"
EVENT_STREAMING_AGAIN = "streaming-again"
EVENT_RECORDING_STARTED = "recording-started"
EVENT_RECORDING_ENDED = "recording-ended"
EVENT_RADIO_RESTARTED = "radio-restarted"
EVENT_RADIO_FAILED = "radio-failed"
EVENT_COMMAND = "command"


_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False)


@functools.cache
def _names(kind: type[Message]) -> tuple[str, ...]:
    """The fields of a kind: a message leaves the payload with every frame."""
    return tuple(field.name for field in dataclasses.fields(kind))


def encode(message: Message) -> bytes:
    """The message as JSON text; raises `TelemetryError` on a number that is not finite."""
    document: dict[str, Any] = {"schema": f"{message.SCHEMA}/{message.MAJOR}.{message.MINOR}"}
    for name in _names(type(message)):  # type: ignore[arg-type]  # a class is hashable
        document[name] = getattr(message, name)
    try:
        return _ENCODER.encode(document).encode()
    except ValueError:
        raise TelemetryError(f"{message.SCHEMA}: a number is not finite: {message}") from None


def decode(kind: type[M], data: bytes) -> M:
    """Reads a message of one kind; raises `TelemetryError` with one line on anything else."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        raise TelemetryError(f"{kind.SCHEMA}: not JSON text") from None
    if not isinstance(document, dict):
        raise TelemetryError(f"{kind.SCHEMA}: not a JSON object")
    name, _, version = str(document.get("schema", "")).partition("/")
    if name != kind.SCHEMA or version.split(".")[0] != str(kind.MAJOR):
        found = str(document.get("schema"))[:60]
        raise TelemetryError(f"{kind.SCHEMA}/{kind.MAJOR}: the message's schema is {found!r}")
    hints = typing.get_type_hints(kind)
    values: dict[str, Any] = {}
    for item in dataclasses.fields(kind):
        if item.name in document:
            what = f"{kind.SCHEMA}: '{item.name}'"
            values[item.name] = _value(document[item.name], hints[item.name], what)
        elif item.default is item.default_factory is dataclasses.MISSING:
            raise TelemetryError(f"{kind.SCHEMA}: '{item.name}' is missing")
    return kind(**values)


def _value(value: Any, kind: Any, what: str) -> Any:
    if isinstance(kind, types.UnionType):
        if value is None:
            return None
        kind = typing.get_args(kind)[0]
    origin = typing.get_origin(kind)
    if origin in (list, dict):
        if not isinstance(value, origin):
            expected = "a list" if origin is list else "an object"
            raise TelemetryError(f"{what} must be {expected}, not {str(value)[:60]!r}")
        if len(value) > MOST_ITEMS:
            raise TelemetryError(f"{what} has {len(value)} items; allowed: {MOST_ITEMS}")
        item = typing.get_args(kind)[-1]
        if origin is list:
            return [_value(v, item, f"{what}[{i}]") for i, v in enumerate(value)]
        return {k[:MOST_LETTERS]: _value(v, item, f"{what}[{k!r:.40}]") for k, v in value.items()}
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) < 2**1000 else math.inf
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise TelemetryError(f"{what} must be {kind.__name__}, not {str(value)[:60]!r}")
    if isinstance(value, str):
        value = value[:MOST_LETTERS]
        if any("\ud800" <= letter <= "\udfff" for letter in value):
            raise TelemetryError(f"{what} holds half a character, which no text can")
    if isinstance(value, float) and not math.isfinite(value):
        raise TelemetryError(f"{what} must be finite, not {value}")
    return value
