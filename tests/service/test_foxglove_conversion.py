"""What goes to ROS and Foxglove is what was estimated: axes, covariance, ellipsoid, floor plan."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_stand import CAPTURE_NS, estimate
from scipy.spatial.transform import Rotation
from station_notes import PAYLOAD

from ground_station.geometry import poses
from ground_station.service.bus_messages import (
    EventMessage,
    FrameMessage,
    PayloadMessage,
    RecordingMessage,
    as_document,
)
from ground_station.service.foxglove import conversion, documents, drawing, world
from ground_station.service.foxglove.neighbours import neighbours

SAMPLES = 10_000
NEAR = 0.03  # of the deviations' product; a sample's own error is 1 / sqrt(SAMPLES) of it


def a_pose() -> np.ndarray:
    return poses.pose(Rotation.from_euler("zyx", [2.0, 0.4, -1.1]).as_matrix(), [8.0, -3.0, 2.0])


def a_covariance() -> np.ndarray:
    """Far from round, with every pair of axes correlated; rotation in hundredths of a radian."""
    rng = np.random.default_rng(5)
    mixed = rng.normal(size=(6, 6)) * np.array([3, 1, 5, 20, 90, 40])[:, None] * 2e-3
    return mixed @ mixed.T / 6


def sampled(wTc: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """The covariance of position and fixed-axis rotation over wTc·exp(ξ), ξ drawn."""
    tangents = np.random.default_rng(6).multivariate_normal(np.zeros(6), covariance, SAMPLES)
    moved = np.array([wTc @ poses.exp(xi) for xi in tangents])
    turned = Rotation.from_matrix(moved[:, :3, :3] @ wTc[:3, :3].T).as_rotvec()
    return np.cov(np.hstack([moved[:, :3, 3], turned]).T)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    deviations = np.sqrt(np.diag(a))
    return float(np.abs((a - b) / np.outer(deviations, deviations)).max())


def test_the_covariance_is_that_of_position_and_rotation_about_the_maps_axes() -> None:
    wTc, covariance = a_pose(), a_covariance()
    truth = sampled(wTc, covariance)
    assert distance(truth, conversion.ros_covariance(wTc, covariance)) < NEAR
    # The same numbers in another order only, or in the camera's axes, are far off.
    order = [3, 4, 5, 0, 1, 2]
    assert distance(truth, covariance[np.ix_(order, order)]) > 5 * NEAR


def test_the_covariance_does_not_depend_on_which_axes_of_the_camera_the_pose_names() -> None:
    wTo, covariance = a_pose(), a_covariance()
    solved = conversion.solved(
        estimate(
            position_m=wTo[:3, 3].tolist(),
            quaternion_xyzw=poses.to_quaternion(wTo).tolist(),
            covariance=covariance.ravel().tolist(),
        )
    )
    assert solved is not None and solved.covariance is not None
    # The tangent in body axes, whose covariance about the body's pose must come out the same.
    turn = np.kron(np.eye(2), conversion.OPTICAL_IN_CAMERA[:3, :3])
    again = conversion.ros_covariance(solved.wTc, turn @ covariance @ turn.T)
    assert np.allclose(solved.covariance, again, rtol=1e-9, atol=1e-15)


def test_a_relative_pose_has_the_covariance_of_both() -> None:
    one, other = a_pose(), a_pose() @ poses.exp([0.5, -0.8, 0.3, 2.0, -1.0, 4.0])
    scales = 0.3, 0.5
    notes = [
        estimate(
            position_m=wTo[:3, 3].tolist(),
            quaternion_xyzw=poses.to_quaternion(wTo).tolist(),
            covariance=(scale * a_covariance()).ravel().tolist(),
        )
        for wTo, scale in zip((one, other), scales, strict=True)
    ]
    (found,) = neighbours("a", notes[0], {"a": notes[0], "b": notes[1]})
    body = conversion.body_pose
    expected = poses.inverse(body(one)) @ body(other)
    assert np.allclose(found.pose.wTc, expected)
    assert found.distance_m == pytest.approx(np.linalg.norm(expected[:3, 3]))
    rng = np.random.default_rng(7)
    a, b = (rng.multivariate_normal(np.zeros(6), s * a_covariance(), SAMPLES) for s in scales)
    moved = np.array(
        [poses.inverse(body(one @ poses.exp(x))) @ body(other @ poses.exp(y))
         for x, y in zip(a, b, strict=True)]
    )  # fmt: skip
    turned = Rotation.from_matrix(moved[:, :3, :3] @ expected[:3, :3].T).as_rotvec()
    truth = np.cov(np.hstack([moved[:, :3, 3], turned]).T)
    assert found.pose.covariance is not None and distance(truth, found.pose.covariance) < NEAR
    grown = [replace(note, map=f"hall-{k}", coordinates="c") for k, note in enumerate(notes)]
    assert [one.payload_id for one in neighbours("a", grown[0], {"b": grown[1]})] == ["b"]
    assert not [*neighbours("a", grown[0], {"b": replace(grown[1], coordinates="d")})]
    far = np.linalg.norm(moved[:, :3, 3], axis=1)
    assert found.distance_sigma_m == pytest.approx(far.std(), rel=NEAR)


def test_the_ellipsoid_holds_19_of_20() -> None:
    R = Rotation.from_euler("zyx", [0.3, 1.0, -0.7]).as_matrix()
    covariance = R @ np.diag([0.01, 0.25, 0.04]) @ R.T
    diameters, quaternion = conversion.ellipsoid(covariance)
    points = np.random.default_rng(7).multivariate_normal(np.zeros(3), covariance, SAMPLES)
    inner = Rotation.from_quat(quaternion).inv().apply(points) / (diameters / 2)
    assert abs(float((np.linalg.norm(inner, axis=1) < 1).mean()) - 0.95) < 0.005


def test_a_flat_covariance_has_an_ellipsoid_that_can_be_seen() -> None:
    diameters, quaternion = conversion.ellipsoid(np.diag([1e-2, 0.0, -1e-18]))
    assert diameters.min() >= 1e-3 and np.isclose(np.linalg.norm(quaternion), 1)


def test_a_covariance_that_is_not_known_is_not_told() -> None:
    solved = conversion.solved(estimate(covariance=None))
    assert solved is not None and solved.covariance is None
    document = documents.estimate(PAYLOAD, estimate(covariance=None), solved)
    assert document["pose"]["covariance"] is None


def test_stamps_are_the_captures_or_the_next_best() -> None:
    assert conversion.stamp_ns(estimate()) == CAPTURE_NS
    assert conversion.stamp_ns(estimate(capture_ns=None)) == CAPTURE_NS + 50_000_000
    frame = FrameMessage(1, 2, 3, 4, 5, 1_000, 640, 480, 9)
    assert conversion.stamp_ns(frame) == 1_000


@pytest.mark.parametrize(
    ("schema", "document"),
    [
        (
            documents.ESTIMATE,
            documents.estimate(PAYLOAD, estimate(), conversion.solved(estimate())),
        ),
        (documents.EVENT, documents.event("-", EventMessage(1, "web", "info", "a", "b"))),
        (documents.STATUS, documents.status(PayloadMessage(True, 5, clock={"a": 1}))),
        (documents.RECORDING, as_document(RecordingMessage(True, "f", free_MB=1.5))),
    ],
)
def test_what_is_said_is_what_the_schema_says(schema: dict, document: dict) -> None:
    def check(schema: dict, value: object) -> None:
        kinds = {
            "object": dict, "array": list, "string": str, "integer": int, "boolean": bool,
            "number": int | float,
        }  # fmt: skip
        if value is None:
            return
        assert isinstance(value, kinds[schema["type"]])
        if isinstance(value, dict) and "properties" in schema:
            assert value.keys() == schema["properties"].keys()
            for name, item in value.items():
                check(schema["properties"][name], item)
        for item in value if isinstance(value, list) else []:
            check(schema["items"], item)

    check(schema, document)


def test_a_floor_plan_lies_with_its_lower_left_corner_at_the_origin() -> None:
    grey = np.array([[10, 20, 30], [40, 50, 60]], np.uint8)  # row 0: the lower edge
    plan = world.Plan(grey, 0.5, (-1.0, -2.0, math.pi / 2))
    grid = Grid.FromString(world.grid(plan, CAPTURE_NS).encode())
    assert grid.frame_id == "map" and grid.timestamp.ToNanoseconds() == CAPTURE_NS
    assert (grid.pose.position.x, grid.pose.position.y) == (-1.0, -2.0)
    assert grid.pose.orientation.z == pytest.approx(math.sqrt(0.5))
    assert (grid.column_count, grid.cell_size.x, grid.row_stride) == (3, 0.5, 12)
    assert grid.data[:4] == bytes([10, 10, 10, 255]) and grid.data[12:13] == bytes([40])
    assert [field.name for field in grid.fields] == ["red", "green", "blue", "alpha"]


def test_a_large_floor_plan_becomes_coarser_and_keeps_its_lower_left_corner() -> None:
    grey = np.zeros((1501, 1502), np.uint8)
    grey[-2:, :2] = 200
    coarser, resolution_m = world.coarse(grey, 0.1)
    assert coarser.size <= 1_000_000 and resolution_m == pytest.approx(0.2)
    assert coarser[-1, 0] == 200 and coarser.sum() == 200
    assert world.coarse(grey[:9, :9], 0.1) == (pytest.approx(grey[:9, :9]), 0.1)


def test_landmarks_are_points() -> None:
    data = struct.pack("<6f", 1, 2, 3, 4, 5, 6)
    cloud = PointCloud.FromString(world.cloud(data, CAPTURE_NS).encode())
    assert cloud.frame_id == "map" and cloud.point_stride == 12 and cloud.data == data
    assert [(field.name, field.offset) for field in cloud.fields] == [("x", 0), ("y", 4), ("z", 8)]


def test_no_line_leads_to_where_it_was_found_again() -> None:
    points = [[float(x), 0.0, 0.0] for x in range(5)]
    scene = SceneUpdate.FromString(drawing.trail(points, [3], CAPTURE_NS).encode())
    (entity,) = scene.entities
    assert [[p.x for p in line.points] for line in entity.lines] == [[0, 1, 2], [3, 4]]
