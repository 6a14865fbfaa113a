"""The JSON channels: what they say, and their JSON Schema from the classes that they come from."""

from __future__ import annotations

import dataclasses
import types
import typing
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
from pi_firmware.wire import messages

_TYPES = {int: "integer", float: "number", str: "string", bool: "boolean", dict: "object"}
_ELSEWHERE = (
    "position_m", "quaternion_xyzw", "covariance", "position_sigma_m", "points_px",
)  # fmt: skip
_MESSAGES = ("battery", "health", "autopilot")


def estimate(payload_id: str, note: EstimateMessage, pose: Solved | None) -> dict[str, Any]:
    """An estimate: `header` and `pose` as in `geometry_msgs/PoseWithCovarianceStamped`.

    `pose` is null for a frame that was not solved, `covariance` where none is known: no zeros,
    which would claim to be certain. `child_frame_id` names whose pose it is.
    """
    sec, nanosec = conversion.seconds(stamp_ns(note))
    document: dict[str, Any] = {
        "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": conversion.MAP},
        "child_frame_id": conversion.camera_frame(payload_id),
        "pose": None,
    }
    if pose is not None:
        document["pose"] = {
            "pose": {
                "position": dict(zip("xyz", pose.position_m, strict=True)),
                "orientation": dict(zip("xyzw", pose.quaternion_xyzw, strict=True)),
            },
            "covariance": None if pose.covariance is None else pose.covariance.ravel().tolist(),
        }
    rest = bus_messages.as_document(note)
    return document | {name: rest[name] for name in rest if name not in _ELSEWHERE}


def event(payload_id: str, note: EventMessage) -> dict[str, Any]:
    """An event and whose it is, "-" for the station's."""
    return {"payload": payload_id, **bus_messages.as_document(note)}


def status(note: PayloadMessage) -> dict[str, Any]:
    """A payload's account, without the messages that have topics of their own."""
    document = bus_messages.as_document(note)
    return {name: document[name] for name in document if name not in _MESSAGES[:2]}


def estimate_schema() -> dict[str, Any]:
    """Of `estimate`."""
    numbers = {"type": "array", "items": {"type": "number"}}
    return _schema(
        "blimp.Estimate",
        {
            "header": _object(
                stamp=_object(sec={"type": "integer"}, nanosec={"type": "integer"}),
                frame_id={"type": "string"},
            ),
            "child_frame_id": {"type": "string"},
            "pose": _object(
                pose=_object(
                    position=_object(**{name: {"type": "number"} for name in "xyz"}),
                    orientation=_object(**{name: {"type": "number"} for name in "xyzw"}),
                ),
                covariance=numbers,
            ),
            **_properties(EstimateMessage, leave=_ELSEWHERE),
        },
    )


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


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


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
