"""What the HTTP API takes and gives, as its OpenAPI document tells it.

What is taken is checked against these; what is given is built from notes and only described here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field, StrictBool, StringConstraints

from ground_station.service.alarms import Alarm
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    PayloadMessage,
    ProcessMessage,
    RecordingMessage,
)
from ground_station.service.settings import MAP_NAME

PAYLOAD_PATTERN = "^[a-z0-9][a-z0-9_-]{0,31}$"
MAP_PATTERN = f"^{MAP_NAME}$"
FILE_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.:+-]{0,127}\.mcap$"

PayloadId = Annotated[str, Path(pattern=PAYLOAD_PATTERN, description="As blimp-1.")]
StationName = Annotated[str, Path(pattern=PAYLOAD_PATTERN, description="As GET /api/state tells.")]
MapName = Annotated[str, Path(pattern=MAP_PATTERN, description="As atrium.")]
FileName = Annotated[str, Path(pattern=FILE_PATTERN, description="As GET /api/recordings tells.")]

CommandName = Literal[
    "record-start", "record-stop", "idr", "bitrate", "exposure", "shutdown", "reboot"
]
ArgumentName = Annotated[str, StringConstraints(pattern="^[a-z][a-zA-Z0-9_]{0,31}$")]
Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12, strict=True)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid")


class JobRequest(_Model):
    """A long job: its step, one of the choices that the guide has for it, and a new map's name."""

    step: Literal["calibrate", "build", "register", "extend"]
    choice: Annotated[str, StringConstraints(min_length=1, max_length=255)]
    map: Annotated[str, StringConstraints(pattern=MAP_PATTERN)] | None = None


@dataclass(frozen=True)
class Way:
    """A command that goes on, and when it is the one; without a command, what to do by hand."""

    text: str
    command: str = ""


@dataclass(frozen=True)
class Step:
    """A step from payload to flight: `ready` can be taken now, `waiting` needs another first.

    `choices` are what the page's own button may be given: recordings, or names of maps.
    """

    name: str
    title: str
    state: Literal["done", "ready", "waiting"]
    found: str
    check: str
    ways: list[Way] = field(default_factory=list)
    choices: list[str] = field(default_factory=list)


class GuideModel(BaseModel):
    """The steps as the station sees them from the folder that its commands are given in."""

    folder: str
    steps: list[Step]


class JobModel(BaseModel):
    """The job of now or the last: its last line, how far it is, the page that it opened."""

    step: str
    command: str
    started_ns: int
    running: bool
    status: int | None
    line: str
    share: float | None
    page: str


class Problem(BaseModel):
    """Why a request was not carried out, in one line."""

    detail: str


class CommandRequest(_Model):
    """What a payload is asked for; its numbers by name, as {"kbps": 1500}."""

    name: CommandName
    arguments: Annotated[dict[ArgumentName, Number], Field(max_length=8)] = {}


class MapRequest(_Model):
    """The map that a payload's poses are to be in."""

    name: Annotated[str, StringConstraints(pattern=MAP_PATTERN)]


class StationRequest(_Model):
    """The station that a payload is to fly with; "": whichever has room."""

    name: Annotated[str, StringConstraints(pattern=f"{PAYLOAD_PATTERN}|^$")]


class RecordingRequest(_Model):
    """Whether the station records."""

    active: StrictBool


class AnswerModel(BaseModel):
    """What became of it: done, or why not; `values` are what is set now."""

    done: bool
    reason: str
    values: dict[str, Any] = {}


class Health(BaseModel):
    """That this process serves."""

    status: Literal["ok"]


class StationModel(BaseModel):
    """Which station this is; with `loopback` payloads on the network do not reach it."""

    name: str
    version: str
    uptime_s: float
    started_ns: int
    map: str
    demo: bool
    loopback: bool
    min_free_MB: int
    apart_m: float


@dataclass(frozen=True, kw_only=True)
class ProcessModel(ProcessMessage):
    """A process of the service; `age_s` since it last said that it lives."""

    age_s: float
    restarted_s: float | None


class PayloadModel(BaseModel):
    """A payload; what `stale` names is older than it may be to speak of now."""

    payload: PayloadMessage | None
    estimate: EstimateMessage | None
    alive: bool
    alive_s: float | None
    gone_s: float | None
    ended: bool
    age_s: dict[str, float | None]
    stale: list[str]
    state_s: float | None
    nothing_known_s: float | None
    clock_unknown_s: float | None
    trail: list[list[float]] = []
    trail_breaks: list[int] = []


@dataclass(frozen=True)
class EventModel(EventMessage):
    """Something that happened, and to whom; "-" is the station itself."""

    payload: str


class OtherStationModel(BaseModel):
    """Another station: its clock less this one's (`clock_s`), the payloads that fly with it."""

    name: str
    version: str
    map: str
    same_map: bool
    load: float
    age_s: float
    clock_s: float
    recording: bool
    payloads: list[str]


class OfferModel(BaseModel):
    """A map of another station: this one's, grown by so many (`more`) landmarks."""

    station: str
    map: str
    more: int


class FleetModel(BaseModel):
    """The other stations, and where persons want payloads to fly (`pins`).

    `twins` are payloads of one name, `refused` says who was and why.
    """

    stations: list[OtherStationModel]
    offers: list[OfferModel]
    pins: dict[str, str]
    twins: dict[str, str]
    refused: list[str]


class StateModel(BaseModel):
    """The whole station, now."""

    now_ns: int
    station: StationModel
    processes: list[ProcessModel]
    payloads: dict[str, PayloadModel]
    recording: RecordingMessage | None
    recording_age_s: float | None
    events: list[EventModel]
    alarms: list[Alarm]
    job: JobModel | None
    fleet: FleetModel | None = None


class FloorPlanModel(BaseModel):
    """A floor plan as in ROS map_server: its lower left corner lies at `origin` (x, y, yaw)."""

    resolution_m: float
    origin: list[float]
    width_px: int
    height_px: int
    url: str


class MapModel(BaseModel):
    """A map on the shelf; `extent_m` is the size of the box of its landmarks."""

    name: str
    registered: bool
    landmarks: int
    extent_m: list[float]
    floorplan: bool


class BoundsModel(BaseModel):
    """The box of a map's landmarks."""

    min: list[float]
    max: list[float]


class CameraModel(BaseModel):
    """A camera: `K` (3, 3) in pixels, `distortion` OpenCV's k1, k2, p1, p2, k3.

    Of a `model` that is 'fisheye' they are k1 to k4; else it is 'opencv5'. The centre of the
    top-left pixel is (0, 0).
    """

    width_px: int
    height_px: int
    K: list[list[float]]
    distortion: list[float]
    model: str


class MapDetailsModel(BaseModel):
    """A map with its floor plan and bounds.

    `camera` is the one that payloads are localized with in it: the configured one, or its own.
    """

    name: str
    registered: bool
    landmarks: int
    extent_m: list[float]
    bounds: BoundsModel
    features: str
    camera: CameraModel
    floorplan: FloorPlanModel | None


class RecordingModel(BaseModel):
    """A recording of the ground's; the one that is being written is `active`.

    A flight that came from another station goes on from the one `after`, STATION/FILE.
    """

    file: str
    size_MB: float
    modified_ns: int
    started_ns: int | None
    duration_s: float | None
    maps: list[str]
    lacks: dict[str, int] | None = None
    after: str = ""
    active: bool
