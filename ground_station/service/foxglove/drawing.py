"""Foxglove's messages from what is known of a payload: pure functions."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from foxglove.messages import (
    ArrowPrimitive,
    CameraCalibration,
    Color,
    CompressedImage,
    FrameTransform,
    FrameTransforms,
    ImageAnnotations,
    LinePrimitive,
    LinePrimitiveLineType,
    Log,
    LogLevel,
    Point2,
    Point3,
    PointsAnnotation,
    PointsAnnotationType,
    Pose,
    PoseInFrame,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.estimate import State
from ground_station.service import bus_messages
from ground_station.service.bus_messages import EventMessage
from ground_station.service.foxglove import conversion
from ground_station.service.foxglove.conversion import Solved

MARKER, ELLIPSOID, TRAIL = "marker", "ellipsoid", "trail"
_LENGTH_M = 0.5
_TEXT_M = 0.2
_TRAIL_M = 0.02
# Okabe and Ito's colours, which the colour-blind tell apart; the state's name stands beside them.
_COLOURS = {
    State.TRACKING.value: (0.0, 0.62, 0.45),
    State.DEGRADED.value: (0.90, 0.62, 0.0),
    State.LOST.value: (0.84, 0.37, 0.0),
}
_UNKNOWN = (0.6, 0.6, 0.6)
_BLUE = (0.34, 0.71, 0.91)
_LEVELS = {
    bus_messages.INFO: LogLevel.Info,
    bus_messages.WARNING: LogLevel.Warning,
    bus_messages.ALARM: LogLevel.Error,
}


def stamp(time_ns: int) -> Timestamp:
    """A time as Foxglove has it."""
    return Timestamp(*divmod(time_ns, 1_000_000_000))


def pose_in_map(pose: Solved, time_ns: int) -> PoseInFrame:
    """The camera's body axes in the map."""
    return PoseInFrame(timestamp=stamp(time_ns), frame_id=conversion.MAP, pose=_pose(pose))


def transforms(payload_id: str, pose: Solved, time_ns: int) -> FrameTransforms:
    """map → camera → camera_optical; both in each message, so that no listener lacks the second."""
    camera, optical = conversion.camera_frame(payload_id), conversion.optical_frame(payload_id)
    fixed = poses.to_quaternion(conversion.OPTICAL_IN_CAMERA)
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=stamp(time_ns),
                parent_frame_id=conversion.MAP,
                child_frame_id=camera,
                translation=_vector(pose.position_m),
                rotation=_quaternion(pose.quaternion_xyzw),
            ),
            FrameTransform(
                timestamp=stamp(time_ns),
                parent_frame_id=camera,
                child_frame_id=optical,
                translation=_vector((0.0, 0.0, 0.0)),
                rotation=_quaternion(fixed),
            ),
        ]
    )


def calibration(payload_id: str, camera: Camera, time_ns: int) -> CameraCalibration:
    """The camera as `sensor_msgs/CameraInfo` has it; its pictures are not rectified."""
    K = camera.matrix
    return CameraCalibration(
        timestamp=stamp(time_ns),
        frame_id=conversion.optical_frame(payload_id),
        width=camera.width_px,
        height=camera.height_px,
        distortion_model=camera.distortion_model,
        D=camera.distortion.tolist(),
        K=K.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.hstack([K, np.zeros((3, 1))]).ravel().tolist(),
    )


def picture(payload_id: str, jpeg: bytes, time_ns: int) -> CompressedImage:
    """A frame."""
    return CompressedImage(
        timestamp=stamp(time_ns),
        frame_id=conversion.optical_frame(payload_id),
        data=jpeg,
        format="jpeg",
    )


def tracked(pixels: Sequence[tuple[float, float]], time_ns: int) -> ImageAnnotations:
    """Tracked landmarks, as pixels of the frame as it was taken."""
    dots = PointsAnnotation(
        timestamp=stamp(time_ns),
        type=PointsAnnotationType.Points,
        points=[Point2(x=u, y=v) for u, v in pixels],
        outline_color=_colour(_BLUE),
        thickness=4.0,
    )
    return ImageAnnotations(timestamp=stamp(time_ns), points=[dots])


def scene(payload_id: str, state: str, pose: Solved, time_ns: int, *, fresh: bool) -> SceneUpdate:
    """The marker in its state's colour, and the ellipsoid of a `fresh` pose.

    An older one's marker stays where it was last, in the colour of its state now.
    """
    colour = _colour(_COLOURS.get(state, _UNKNOWN))
    marker = _entity(
        MARKER,
        time_ns,
        arrows=[
            ArrowPrimitive(
                pose=_pose(pose),
                shaft_length=0.7 * _LENGTH_M,
                shaft_diameter=0.15 * _LENGTH_M,
                head_length=0.3 * _LENGTH_M,
                head_diameter=0.3 * _LENGTH_M,
                color=colour,
            )
        ],
        texts=[
            TextPrimitive(
                pose=placed([*pose.position_m[:2], pose.position_m[2] + 2 * _TEXT_M]),
                billboard=True,
                font_size=_TEXT_M,
                color=colour,
                text=f"{payload_id} {state}",
            )
        ],
    )
    if not fresh or pose.covariance is None:
        return SceneUpdate(deletions=[_deletion(ELLIPSOID, time_ns)], entities=[marker])
    diameters, axes = conversion.ellipsoid(pose.covariance[:3, :3])
    ellipsoid = SpherePrimitive(
        pose=placed(pose.position_m, axes),
        size=_vector(diameters),
        color=_colour(_COLOURS.get(state, _UNKNOWN), 0.35),
    )
    return SceneUpdate(entities=[marker, _entity(ELLIPSOID, time_ns, spheres=[ellipsoid])])


def trail(points: Sequence[Sequence[float]], begins: Sequence[int], time_ns: int) -> SceneUpdate:
    """Where it flew; no line leads to a point at which a stretch `begins`."""
    bounds = [0, *begins, len(points)]
    lines = [
        LinePrimitive(
            type=LinePrimitiveLineType.LineStrip,
            thickness=_TRAIL_M,
            points=[Point3(x=x, y=y, z=z) for x, y, z in points[first:last]],
            color=_colour(_BLUE),
        )
        for first, last in itertools.pairwise(bounds)
        if last - first > 1
    ]
    return SceneUpdate(entities=[_entity(TRAIL, time_ns, lines=lines)])


def gone(time_ns: int) -> SceneUpdate:
    """A payload that is gone is drawn no more; where it flew stays."""
    return SceneUpdate(deletions=[_deletion(name, time_ns) for name in (MARKER, ELLIPSOID)])


def log(payload_id: str, note: EventMessage) -> Log:
    """An event for the Log panel."""
    return Log(
        timestamp=stamp(note.time_ns),
        level=_LEVELS.get(note.level, LogLevel.Unknown),
        message=f"{note.name}: {note.text}",
        name=note.source if payload_id == bus_messages.STATION else f"{payload_id} {note.source}",
    )


def _entity(name: str, time_ns: int, **primitives: Sequence[object]) -> SceneEntity:
    return SceneEntity(
        timestamp=stamp(time_ns),
        frame_id=conversion.MAP,
        id=name,
        **primitives,  # type: ignore[arg-type]
    )


def _deletion(name: str, time_ns: int) -> SceneEntityDeletion:
    return SceneEntityDeletion(timestamp=stamp(time_ns), id=name)


def placed(
    position_m: Sequence[float], quaternion_xyzw: Sequence[float] | F64 = (0.0, 0.0, 0.0, 1.0)
) -> Pose:
    """A pose as Foxglove has it."""
    return Pose(position=_vector(position_m), orientation=_quaternion(quaternion_xyzw))


def _pose(pose: Solved) -> Pose:
    return placed(pose.position_m, pose.quaternion_xyzw)


def _vector(values: Sequence[float] | F64) -> Vector3:
    x, y, z = (float(value) for value in values)
    return Vector3(x=x, y=y, z=z)


def _quaternion(values: Sequence[float] | F64) -> Quaternion:
    x, y, z, w = (float(value) for value in values)
    return Quaternion(x=x, y=y, z=z, w=w)


def _colour(rgb: tuple[float, float, float], alpha: float = 1.0) -> Color:
    return Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)
