"""The live channel serves what the station says, to whoever asks, and waits for nobody."""

from __future__ import annotations

import dataclasses
import logging
import math
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove import Context
from foxglove_stand import CAPTURE_NS, Client, Station, estimate, server
from process_stand import SAMPLE, program
from station_notes import PAYLOAD
from waiting import eventually
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from ground_station.geometry.camera import Camera
from ground_station.map import store
from ground_station.service import bus_messages
from ground_station.service.bus_messages import (
    EventMessage,
    FrameMessage,
    PayloadMessage,
    RecordingMessage,
)
from ground_station.service.ending import RateLimitedLog
from ground_station.service.foxglove.payload import json_topic
from ground_station.service.foxglove.process import PAYLOADS, Inbox, RateLimitedHandler
from pi_firmware.wire import messages

RAMP = np.tile(np.linspace(0, 255, 640).astype(np.uint8), (480, 1))
SCHEMAS = {
    "/tf": "foxglove.FrameTransforms",
    "/map/floorplan": "foxglove.Grid",
    "/map/landmarks": "foxglove.PointCloud",
    "/events": "blimp.Event",
    "/log": "foxglove.Log",
    "/recording": "blimp.Recording",
    f"/{PAYLOAD}/camera/image": "foxglove.CompressedImage",
    f"/{PAYLOAD}/camera/points": "foxglove.ImageAnnotations",
    f"/{PAYLOAD}/camera/calibration": "foxglove.CameraCalibration",
    f"/{PAYLOAD}/pose": "foxglove.PoseInFrame",
    f"/{PAYLOAD}/scene": "foxglove.SceneUpdate",
    f"/{PAYLOAD}/estimate": "blimp.Estimate",
    f"/{PAYLOAD}/neighbours": "blimp.Neighbours",
    f"/{PAYLOAD}/battery": "blimp.Battery",
    f"/{PAYLOAD}/health": "blimp.Health",
    f"/{PAYLOAD}/status": "blimp.Payload",
}


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    """One process for all tests that leave it as it was."""
    folder = tmp_path_factory.mktemp("run")
    with Station(folder) as stand, server(folder) as (stand.process, stand.port):
        yield stand
        assert stand.process.poll() is None


def close(a: Any, *b: float) -> bool:
    """Whether a message's x, y, z (and w) are these numbers."""
    return np.allclose([getattr(a, name) for name in "xyzw"[: len(b)]], b, atol=1e-9)


def test_every_topic_has_its_schema(stand: Station) -> None:
    with stand.client() as client:
        client.until(
            lambda: SCHEMAS.keys() <= client.channels.keys(),
            "topics",
            again=lambda: stand.say(estimate()),
        )
        assert {name: client.channels[name]["schemaName"] for name in SCHEMAS} == SCHEMAS
        # Nothing can be asked of it but to be told.
        assert client.info["capabilities"] == []


def test_a_pose_goes_out_in_ros_frames(stand: Station) -> None:
    say = lambda: stand.say(estimate())  # noqa: E731
    with stand.client() as client:
        client.subscribe("/tf", f"/{PAYLOAD}/pose", f"/{PAYLOAD}/estimate")
        log_ns, pose = client.first(f"/{PAYLOAD}/pose", say)
        assert log_ns == CAPTURE_NS == pose.timestamp.ToNanoseconds()
        assert pose.frame_id == "map"
        assert close(pose.pose.position, 3, 4, 2.5) and close(pose.pose.orientation, 0, 0, 0, 1)

        _, tf = client.first("/tf", say)
        camera, optical = tf.transforms
        assert (camera.parent_frame_id, camera.child_frame_id) == ("map", f"{PAYLOAD}/camera")
        assert close(camera.translation, 3, 4, 2.5) and close(camera.rotation, 0, 0, 0, 1)
        assert optical.parent_frame_id == f"{PAYLOAD}/camera"
        assert optical.child_frame_id == f"{PAYLOAD}/camera_optical"
        # As in REP 103; together they are the pose that was estimated.
        assert close(optical.rotation, 0.5, -0.5, 0.5, -0.5) or close(
            optical.rotation, -0.5, 0.5, -0.5, 0.5
        )

        _, said = client.first(f"/{PAYLOAD}/estimate", say)
        sec, nanosec = divmod(CAPTURE_NS, 1_000_000_000)
        assert said["header"] == {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "map"}
        assert said["pose"]["pose"]["position"] == {"x": 3.0, "y": 4.0, "z": 2.5}
        covariance = np.reshape(said["pose"]["covariance"], (6, 6))
        assert np.allclose(np.diag(covariance), [3e-4, 1e-4, 2e-4, 3e-6, 1e-6, 2e-6])
        assert (said["state"], said["inliers"], said["sequence"]) == ("TRACKING", 40, 7)


def test_the_others_are_seen_from_each_whichever_station_they_fly_with(stand: Station) -> None:
    # Two metres to the left of the first, and half a second later two and a half.
    other = estimate(
        position_m=[3.0, 6.0, 2.5], capture_ns=CAPTURE_NS - 500_000_000,
        velocity_mps=[0.0, 1.0, 0.0], turn_radps=[0.0, 0.0, 0.0],
    )  # fmt: skip
    elsewhere = dataclasses.replace(other, position_m=[5.0, 4.0, 2.5])
    lost = dataclasses.replace(other, state="LOST")
    foreign = dataclasses.replace(other, map="hall")
    bus = stand.bus

    def say() -> None:
        stand.say(other, "blimp-2")
        stand.say(lost, "blimp-3")
        stand.say(foreign, "blimp-4")
        bus.publish(bus_messages.ELSEWHERE, "blimp-5", elsewhere)
        stand.say(estimate())

    say()
    with stand.client() as client:
        client.subscribe(f"/{PAYLOAD}/neighbours")
        topic = f"/{PAYLOAD}/neighbours"
        got = client.received[topic]
        whole = lambda: bool(got) and len(got[-1][1]["neighbours"]) == 2  # noqa: E731
        client.until(whole, "both", say)
        log_ns, said = got[-1]
        assert log_ns == CAPTURE_NS and said["header"]["frame_id"] == f"{PAYLOAD}/camera"
        left, ahead = said["neighbours"]
        assert (left["payload"], ahead["payload"]) == ("blimp-2", "blimp-5")
        assert left["child_frame_id"] == "blimp-2/camera" and left["age_s"] == pytest.approx(0.5)
        at = [[one["pose"]["pose"]["position"][axis] for axis in "xyz"] for one in (left, ahead)]
        assert np.allclose(at, [[0.0, 2.5, 0.0], [2.0, 0.5, 0.0]], atol=1e-9)
        assert left["distance_m"] == pytest.approx(2.5)
        # Both cameras' own deviation to the left, and the turn of the first over the distance.
        assert left["distance_sigma_m"] == pytest.approx(math.sqrt(2 * 1e-4), rel=1e-6)


def test_a_frame_that_was_not_solved_has_no_pose(stand: Station) -> None:
    lost = estimate(9, state="LOST", reason="too few", position_m=None, quaternion_xyzw=None)
    with stand.client() as client:
        client.subscribe(f"/{PAYLOAD}/pose", f"/{PAYLOAD}/estimate", f"/{PAYLOAD}/scene")
        got = client.received[f"/{PAYLOAD}/estimate"]
        client.until(
            lambda: bool(got) and got[-1][1]["sequence"] == 9,
            "the lost one",
            lambda: stand.say(lost),
        )
        _, said = got[-1]
        assert said["pose"] is None and (said["state"], said["reason"]) == ("LOST", "too few")
        poses = len(client.received[f"/{PAYLOAD}/pose"])
        stand.say(lost)
        client.drain()
        assert got[-1][1]["pose"] is None and len(client.received[f"/{PAYLOAD}/pose"]) == poses
        # The marker stays where it was last and says so; nothing claims to know how well.
        scene = client.received[f"/{PAYLOAD}/scene"]
        client.until(
            lambda: any("LOST" in e.texts[0].text for _, s in scene for e in s.entities if e.texts),
            "marker",
            lambda: stand.say(lost),
        )
        assert "ellipsoid" in [deletion.id for deletion in scene[-1][1].deletions]


def test_the_scene_has_marker_ellipsoid_and_trail(stand: Station) -> None:
    with stand.client() as client:
        client.subscribe(f"/{PAYLOAD}/scene")
        found: dict[str, Any] = {}
        x = iter(range(1000))

        def fly() -> None:
            stand.say(estimate(position_m=[3.0 + 0.1 * next(x), 4.0, 2.5]))

        def complete() -> bool:
            for _, scene in client.received[f"/{PAYLOAD}/scene"]:
                found.update({entity.id: entity for entity in scene.entities})
            return (
                found.keys() >= {"marker", "ellipsoid", "trail"} and len(found["trail"].lines) > 0
            )

        client.until(complete, "scene", fly)
        assert found["marker"].texts[0].text == f"{PAYLOAD} TRACKING"
        assert {entity.frame_id for entity in found.values()} == {"map"}
        size = found["ellipsoid"].spheres[0].size
        expected = 2 * 2.7955 * np.sqrt([1e-4, 2e-4, 3e-4])
        assert np.allclose(sorted([size.x, size.y, size.z]), expected, rtol=1e-3)
        # Gone: drawn no more.
        gone = PayloadMessage(False, 1)
        client.until(
            lambda: (
                {"marker", "ellipsoid"}
                <= {
                    d.id
                    for _, scene in client.received[f"/{PAYLOAD}/scene"]
                    for d in scene.deletions
                }
            ),
            "deletion",
            lambda: stand.bus.publish(bus_messages.PAYLOAD, PAYLOAD, gone),
        )


def test_pictures_are_the_rings_with_their_capture_time_and_points(stand: Station) -> None:
    sequence = iter(range(10_000))
    with stand.client() as client:
        client.subscribe(f"/{PAYLOAD}/camera/image", f"/{PAYLOAD}/camera/points")
        log_ns, image = client.first(
            f"/{PAYLOAD}/camera/image", lambda: stand.show(RAMP, next(sequence))
        )
        assert log_ns == CAPTURE_NS == image.timestamp.ToNanoseconds()
        assert (image.frame_id, image.format) == (f"{PAYLOAD}/camera_optical", "jpeg")
        decoded = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert decoded is not None and decoded.shape == RAMP.shape
        assert np.abs(decoded.astype(int) - RAMP).mean() < 2
        _, points = client.first(f"/{PAYLOAD}/camera/points", lambda: stand.say(estimate()))
        assert [(p.x, p.y) for p in points.points[0].points] == [(10.0, 20.0), (30.5, 40.5)]


def test_pictures_come_no_faster_than_the_dashboards(stand: Station) -> None:
    with stand.client() as client:
        client.subscribe(f"/{PAYLOAD}/camera/image")
        begin_s, sequence = time.monotonic(), 0
        while time.monotonic() - begin_s < 1.5:
            sequence += 1
            stand.show(RAMP, sequence)
            client.receive(0.005)
        count = len(client.received[f"/{PAYLOAD}/camera/image"])
        # 15 Hz of about 150; the first may come at once and each a quarter of a period early.
        assert 1 <= count <= 15 * (time.monotonic() - begin_s) + 2 < sequence


def test_a_new_subscriber_is_told_what_still_holds_and_nobody_else_again(stand: Station) -> None:
    battery = messages.Battery(5, 3.9)
    health = messages.Health(6, uptime_s=3.0)
    note = PayloadMessage(True, 1, battery=battery, health=health, rate_hz=30.0)
    event = EventMessage(CAPTURE_NS, "localizer", "warning", "map-refused", "why")
    recording = RecordingMessage(True, "a.mcap", 1.0)
    kept = (
        "/events", "/log", "/recording", "/map/floorplan", "/map/landmarks",
        f"/{PAYLOAD}/battery", f"/{PAYLOAD}/health", f"/{PAYLOAD}/status",
        f"/{PAYLOAD}/camera/calibration", f"/{PAYLOAD}/scene",
    )  # fmt: skip
    with stand.client() as first:
        first.subscribe(*kept)

        def say() -> None:
            stand.bus.publish(bus_messages.PAYLOAD, PAYLOAD, note)
            stand.bus.publish(bus_messages.EVENT, PAYLOAD, event)
            stand.bus.publish(bus_messages.RECORDING, bus_messages.STATION, recording)
            stand.show(RAMP, 1)
            stand.say(estimate())

        first.until(lambda: all(first.received[topic] for topic in kept), "all", say)
        first.drain()
        before = {topic: len(first.received[topic]) for topic in kept}
        with stand.client() as second:
            second.subscribe(*kept)
            second.until(lambda: all(second.received[topic] for topic in kept), "what holds")
            first.drain()
            assert {topic: len(first.received[topic]) for topic in kept} == before
            told = {topic: second.received[topic][0] for topic in kept}
    camera: Camera = store.load_info(SAMPLE).camera
    _, calibration = told[f"/{PAYLOAD}/camera/calibration"]
    assert calibration.frame_id == f"{PAYLOAD}/camera_optical"
    assert (calibration.width, calibration.height) == (640, 480)
    assert list(calibration.K) == camera.matrix.ravel().tolist()
    assert list(calibration.D) == camera.distortion.tolist()
    assert calibration.P[0] == camera.fx_px and len(calibration.P) == 12
    assert told[f"/{PAYLOAD}/battery"][1] == dataclasses.asdict(battery)
    assert told[f"/{PAYLOAD}/status"][1]["rate_hz"] == 30.0
    log_ns, said = told["/events"]
    assert log_ns == CAPTURE_NS and (said["payload"], said["text"]) == (PAYLOAD, "why")
    assert told["/log"][1].message == "map-refused: why" and told["/log"][1].level == 3
    assert told["/recording"][1]["file"] == "a.mcap"
    # The sample's plan is 1020x700 of 25 mm.
    grid, cloud = told["/map/floorplan"][1], told["/map/landmarks"][1]
    assert (grid.column_count, len(grid.data)) == (1020, 4 * 1020 * 700)
    assert grid.cell_size.x == 0.025 and close(grid.pose.position, -0.75, -0.75, 0)
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
    assert 1000 < len(points) <= 20_000
    truth = store.load(SAMPLE).landmarks.position_m.astype("<f4")
    assert {tuple(point) for point in points.tolist()} <= {tuple(p) for p in truth.tolist()}


def test_notes_that_cannot_be_end_nothing(stand: Station) -> None:
    with stand.client() as client:
        client.subscribe(f"/{PAYLOAD}/estimate", f"/{PAYLOAD}/scene", "/events", "/log")
        hostile: list[Any] = [
            estimate(1, state=[1], reason=5, map={"a": 1}),
            estimate(2, position_m="abc", points_px={"a": 1}),
            estimate(3, capture_ns="x", done_ns=None),
            estimate(4, points_px=[1.0, float("nan"), 2.0]),
        ]
        for note in hostile:
            stand.say(note)
        bus = stand.bus
        bus.publish(bus_messages.EVENT, PAYLOAD, EventMessage("x", 1, [2], None, {}))  # type: ignore[arg-type]
        bus.publish(bus_messages.PAYLOAD, PAYLOAD, PayloadMessage("x", [], battery=3, health=[]))  # type: ignore[arg-type]
        bus.publish(bus_messages.FRAME, PAYLOAD, FrameMessage(-1, "a", None, 0, 0, 0, 640, 480, 0))  # type: ignore[arg-type]
        bus.publish(bus_messages.ESTIMATE, "No Payload", estimate())
        client.until(
            lambda: any(
                said["sequence"] == 77 for _, said in client.received[f"/{PAYLOAD}/estimate"]
            ),
            "the next",
            lambda: stand.say(estimate(77)),
        )
        bus.publish(
            bus_messages.EVENT, PAYLOAD, EventMessage(CAPTURE_NS, "web", "info", "next", "one")
        )
        client.until(
            lambda: any(said.message == "next: one" for _, said in client.received["/log"]),
            "the next event",
        )
        with stand.client() as later:
            later.subscribe("/log")
            later.until(lambda: bool(later.received["/log"]), "what was kept")
        assert not any("No Payload" in topic for topic in client.channels)


def test_a_client_that_does_not_read_delays_nobody(stand: Station) -> None:
    topics = tuple(topic for topic in SCHEMAS if topic.startswith(f"/{PAYLOAD}/"))
    with stand.client() as slow, stand.client() as quick:
        slow.subscribe(*topics)
        quick.subscribe(f"/{PAYLOAD}/estimate")
        long = "x" * 100_000  # more than sockets and the slow client's queue can hold
        for sequence in range(100, 500):
            stand.say(estimate(sequence, reason=long))
            quick.receive(0.0)
        got = quick.received[f"/{PAYLOAD}/estimate"]
        quick.until(
            lambda: bool(got) and got[-1][1]["sequence"] == 2000,
            "the newest",
            lambda: stand.say(estimate(2000)),
        )
        beats = len(stand.beats)
        eventually(lambda: len(stand.beats) > beats, what="beat")
        # It did lose some, and not the newest.
        slow.drain()
        numbers = [said["sequence"] for _, said in slow.received[f"/{PAYLOAD}/estimate"]]
        assert numbers[-1] == 2000 and len(set(numbers)) < 401 and numbers == sorted(numbers)


def test_it_says_that_it_lives(stand: Station) -> None:
    eventually(lambda: bool(stand.beats), what="beat")
    beat = stand.beats[-1]
    assert (beat.name, beat.pid) == ("foxglove", stand.process.pid)


def test_another_protocol_is_refused(stand: Station) -> None:
    url, other = f"ws://127.0.0.1:{stand.port}", Subprotocol("chat")
    with pytest.raises(InvalidStatus), connect(url, subprotocols=[other]):
        pass


def test_a_bus_that_comes_back_is_heard_again(tmp_path: Path) -> None:
    topic = f"/{PAYLOAD}/estimate"
    with (
        Station(tmp_path) as station,
        server(tmp_path) as (process, station.port),
        station.client() as client,
    ):
        client.subscribe(topic)
        client.first(topic, lambda: station.say(estimate()))
        station.close()
        station.open()
        client.until(
            lambda: client.received[topic][-1][1]["sequence"] == 8,
            "the next",
            lambda: station.say(estimate(8)),
        )
        eventually(lambda: bool(station.beats), what="beat")
        # With a client and a map being asked for, it still ends when it is told to.
        client.subscribe("/map/landmarks")
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0


def test_a_port_that_is_taken_is_told_in_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with Station(tmp_path, port=port), program("foxglove", str(tmp_path), **pipes) as process:
            out, err = process.communicate(timeout=60)
    assert process.returncode == 2 and out == ""
    (line,) = err.splitlines()
    assert f"foxglove.port {port}" in line and "in use" in line


def test_what_clients_make_the_sdk_say_is_said_once_a_minute() -> None:
    said: list[str] = []
    times_s = iter([0.0, 1.0, 59.0, 61.0])
    handler = RateLimitedHandler(
        RateLimitedLog(lambda _, text: said.append(text), lambda: next(times_s))
    )
    for number in range(4):
        text = f"client {number}: {'x' * 10_000}"
        handler.handle(logging.LogRecord("sdk", logging.ERROR, "", 0, text, None, None))
    first, second = said
    assert first.startswith("client 0") and len(first) <= 200
    assert second.startswith("client 3") and second.endswith("(2 more since the last line)")


def test_nothing_is_built_that_nobody_wants() -> None:
    topic = json_topic("/a", {}, Context())
    topic.publish(lambda: pytest.fail("built for nobody"), 1)


def test_a_full_inbox_loses_the_oldest() -> None:
    inbox, seen = Inbox(), []
    for number in range(2003):
        inbox.put(lambda number=number: seen.append(number))
    for task in inbox.take(0.0):
        task()
    assert seen == list(range(3, 2003))
    assert inbox.take(0.0) == []


def test_a_payload_that_is_gone_gives_its_place_to_a_new_one(tmp_path: Path) -> None:
    """The 33rd of an evening had no topics until a restart."""
    with Station(tmp_path) as station, server(tmp_path) as (_, port), Client(port) as client:

        def come_and_go(name: str) -> None:
            for alive in (True, False):
                station.bus.publish(bus_messages.PAYLOAD, name, PayloadMessage(alive, 0))

        for number in range(PAYLOADS + 2):
            topic, flown = f"/flown-{number}/status", partial(come_and_go, f"flown-{number}")
            flown()
            client.until(lambda topic=topic: topic in client.channels, topic, flown)
        client.until(lambda: "/flown-1/status" not in client.channels, "the end of its topics")
        assert f"/flown-{PAYLOADS + 1}/status" in client.channels
