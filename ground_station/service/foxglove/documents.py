"""The JSON channels: what they say, and their JSON Schema from the classes that they come from."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterable
from typing import Any, Literal

from ground_station.service import bus_messages
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    PayloadMessage,
    RecordingMessage,
)
from ground_station.service.foxglove import conversion
from ground_station.service.foxglove.conversion import Solved, stamp_ns
from ground_station.service.foxglove.neighbours import Neighbour
from pi_firmware.wire import messages

_TYPES = {int: "integer", float: "number", str: "string", bool: "boolean", dict: "object"}
_LEFT_OUT = (
    "position_m", "quaternion_xyzw", "covariance", "position_sigma_m", "points_px",
)  # fmt: skip
_OF_THEIR_OWN = ("battery", "health")
_TEXT, _NUMBER = {"type": "string"}, {"type": "number"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_HEADER = _object(
    stamp=_object(sec={"type": "integer"}, nanosec={"type": "integer"}),
    frame_id=_TEXT,
)
_POSE = _object(
    pose=_object(
        position=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER),
        orientation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
    ),
    covariance={"type": "array", "items": _NUMBER},
)


def estimate(payload_id: str, note: EstimateMessage, pose: Solved | None) -> dict[str, Any]:
    """An estimate: `header` and `pose` as in `geometry_msgs/PoseWithCovarianceStamped`.

    `pose` is null for a frame that was not solved, `covariance` where none is known: no zeros,
    which would claim to be certain. `child_frame_id` names whose pose it is.
    """
    document = {
        "header": _header(stamp_ns(note), conversion.MAP),
        "child_frame_id": conversion.camera_frame(payload_id),
        "pose": None if pose is None else _posed(pose),
    }
    rest = bus_messages.as_document(note)
    return document | {name: rest[name] for name in rest if name not in _LEFT_OUT}


def neighbours(payload_id: str, time_ns: int, near: Iterable[Neighbour]) -> dict[str, Any]:
    """The other blimps in a camera's axes, each with `pose` as in `estimate`."""
    return {
        "header": _header(time_ns, conversion.camera_frame(payload_id)),
        "neighbours": [
            {
                "payload": one.payload_id,
                "child_frame_id": conversion.camera_frame(one.payload_id),
                "pose": _posed(one.pose),
                "age_s": one.age_s,
                "distance_m": one.distance_m,
                "distance_sigma_m": one.distance_sigma_m,
            }
            for one in near
        ],
    }


def _header(time_ns: int, frame_id: str) -> dict[str, Any]:
    sec, nanosec = divmod(time_ns, 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}


def _posed(pose: Solved) -> dict[str, Any]:
    return {
        "pose": {
            "position": dict(zip("xyz", pose.position_m, strict=True)),
            "orientation": dict(zip("xyzw", pose.quaternion_xyzw, strict=True)),
        },
        "covariance": None if pose.covariance is None else pose.covariance.ravel().tolist(),
    }


def event(payload_id: str, note: EventMessage) -> dict[str, Any]:
    """An event and whose it is, "-" for the station's."""
    return {"payload": payload_id, **bus_messages.as_document(note)}


def status(note: PayloadMessage) -> dict[str, Any]:
    """A payload's account, without the messages that have topics of their own."""
    document = bus_messages.as_document(note)
    return {name: document[name] for name in document if name not in _OF_THEIR_OWN}


def _schema(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, **_object(**properties)}


def _properties(of: type, leave: tuple[str, ...] = ()) -> dict[str, Any]:
    """Each field's type. What may be null has its other type: Foxglove reads no unions."""
    hints = typing.get_type_hints(of)
    names = [field.name for field in dataclasses.fields(of) if field.name not in leave]
    return {name: _property(hints[name]) for name in names}


def _property(hint: Any) -> dict[str, Any]:
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        hint = next(item for item in typing.get_args(hint) if item is not type(None))
    origin = typing.get_origin(hint)
    if origin is list:
        return {"type": "array", "items": _property(typing.get_args(hint)[0])}
    if origin is Literal:
        return {"type": "string"}
    return {"type": "object" if dataclasses.is_dataclass(hint) else _TYPES[origin or hint]}


ESTIMATE = _schema(
    "blimp.Estimate",
    header=_HEADER,
    child_frame_id=_TEXT,
    pose=_POSE,
    **_properties(EstimateMessage, leave=_LEFT_OUT),
)
_NEIGHBOUR = _object(
    payload=_TEXT,
    child_frame_id=_TEXT,
    pose=_POSE,
    age_s=_NUMBER,
    distance_m=_NUMBER,
    distance_sigma_m=_NUMBER,
)
NEIGHBOURS = _schema(
    "blimp.Neighbours", header=_HEADER, neighbours={"type": "array", "items": _NEIGHBOUR}
)
EVENT = _schema("blimp.Event", payload=_TEXT, **_properties(EventMessage))
RECORDING = _schema("blimp.Recording", **_properties(RecordingMessage))
STATUS = _schema("blimp.Payload", **_properties(PayloadMessage, leave=_OF_THEIR_OWN))
BATTERY = _schema("blimp.Battery", **_properties(messages.Battery))
HEALTH = _schema("blimp.Health", **_properties(messages.Health))
