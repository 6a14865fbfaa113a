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
_MESSAGES = ("battery", "health", "autopilot")


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_HEADER = _object(
    stamp=_object(sec={"type": "integer"}, nanosec={"type": "integer"}),
    frame_id={"type": "string"},
)
_POSE = _object(
    pose=_object(
        position=_object(**{name: {"type": "number"} for name in "xyz"}),
        orientation=_object(**{name: {"type": "number"} for name in "xyzw"}),
    ),
    covariance={"type": "array", "items": {"type": "number"}},
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
    sec, nanosec = conversion.seconds(time_ns)
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
    return {name: document[name] for name in document if name not in _MESSAGES[:2]}


def estimate_schema() -> dict[str, Any]:
    """Of `estimate`."""
    return _schema(
        "blimp.Estimate",
        {
            "header": _HEADER,
            "child_frame_id": {"type": "string"},
            "pose": _POSE,
            **_properties(EstimateMessage, leave=_LEFT_OUT),
        },
    )


def neighbours_schema() -> dict[str, Any]:
    """Of `neighbours`."""
    one = _object(
        payload={"type": "string"},
        child_frame_id={"type": "string"},
        pose=_POSE,
        age_s={"type": "number"},
        distance_m={"type": "number"},
        distance_sigma_m={"type": "number"},
    )
    listed = {"type": "array", "items": one}
    return _schema("blimp.Neighbours", {"header": _HEADER, "neighbours": listed})


def event_schema() -> dict[str, Any]:
    """Of `event`."""
    return _schema("blimp.Event", {"payload": {"type": "string"}, **_properties(EventMessage)})


def recording_schema() -> dict[str, Any]:
    """Of a `RecordingMessage`."""
    return _schema("blimp.Recording", _properties(RecordingMessage))


def status_schema() -> dict[str, Any]:
    """Of `status`."""
    return _schema("blimp.Payload", _properties(PayloadMessage, leave=_MESSAGES[:2]))


def battery_schema() -> dict[str, Any]:
    """Of a payload's battery message."""
    return _schema("blimp.Battery", _properties(messages.Battery))


def health_schema() -> dict[str, Any]:
    """Of a payload's health message."""
    return _schema("blimp.Health", _properties(messages.Health))


def _schema(title: str, properties: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


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
