"""Topics for which nothing is built that nobody listens to, and those of one payload."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from foxglove import Channel, Context
from foxglove.channels import (
    CameraCalibrationChannel,
    CompressedImageChannel,
    ImageAnnotationsChannel,
    PoseInFrameChannel,
    SceneUpdateChannel,
)

from ground_station.arrays import U8
from ground_station.geometry.camera import Camera
from ground_station.service import bus_messages
from ground_station.service.bus_messages import EstimateMessage, FrameMessage, PayloadMessage
from ground_station.service.foxglove import conversion, documents, drawing
from ground_station.service.foxglove.conversion import Solved
from ground_station.service.foxglove.neighbours import neighbours
from ground_station.service.pictures import PictureReader
from ground_station.service.settings import HttpSettings
from ground_station.service.web.trail import Trail

Make = Callable[[], Any]
Kept = Callable[[], Iterable[tuple[Make, int]]]


class Topic:
    """A channel, and what a new subscriber is told at once: pairs of a maker and a log time.

    To be used from one thread. The server never waits for a client: one that is slow loses the
    oldest messages of its own queue.
    """

    def __init__(self, channel: Any, kept: Kept | None = None) -> None:
        self._channel, self._kept = channel, kept

    @property
    def id(self) -> int:
        """The channel's, as subscriptions name it."""
        number: int = self._channel.id()
        return number

    @property
    def wanted(self) -> bool:
        """Whether anyone listens."""
        return bool(self._channel.has_sinks())

    def publish(self, make: Make, log_ns: int, client: int | None = None) -> None:
        """Sends what `make` gives, a message or a JSON object, to all or to one client."""
        if not self.wanted:
            return
        message = make()
        if isinstance(message, dict):
            message = json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
        self._channel.log(message, log_time=log_ns, sink_id=client)

    def close(self) -> None:
        """Nobody can subscribe to it any more."""
        self._channel.close()

    def greet(self, client: int) -> None:
        """Tells a new subscriber what was said before it came and still holds."""
        for make, log_ns in self._kept() if self._kept else ():
            self.publish(make, log_ns, client)


def json_topic(
    name: str, schema: dict[str, Any], context: Context, kept: Kept | None = None
) -> Topic:
    """A topic of JSON objects."""
    return Topic(Channel(name, schema=schema, context=context), kept)


_TRAIL_PERIOD_S = 1.0
_SEEN_PERIOD_S = 0.2
_EARLY = 0.25
"""A frame may come this share of a period early: cameras and networks are not regular."""

Message = tuple[dict[str, Any], int]


class Payload:
    """What is known of a payload, and its topics; `tf` is everyone's."""

    def __init__(
        self,
        payload_id: str,
        context: Context,
        folder: Path,
        tf: Topic,
        camera: Camera | None,
        http: HttpSettings,
    ) -> None:
        self._id, self._tf, self._camera = payload_id, tf, camera
        self._period_s, self._quality = 1.0 / http.video_rate_hz, http.jpeg_quality
        self._pictures = PictureReader(folder, payload_id)
        self._size = (0, 0)
        self._due_s = self._trail_s = self._seen_s = 0.0
        self._trail = Trail()
        self._last: tuple[Solved, int] | None = None
        self._state = ""
        self._was_solved = self.alive = False
        self._told: dict[str, Message] = {}
        root = f"/{payload_id}"
        self._image = Topic(CompressedImageChannel(f"{root}/camera/image", context=context))
        self._points = Topic(ImageAnnotationsChannel(f"{root}/camera/points", context=context))
        self._calibration = Topic(
            CameraCalibrationChannel(f"{root}/camera/calibration", context=context),
            self._calibrated,
        )
        self._pose = Topic(PoseInFrameChannel(f"{root}/pose", context=context))
        self._scene = Topic(SceneUpdateChannel(f"{root}/scene", context=context), self._drawn)
        self._estimate = json_topic(f"{root}/estimate", documents.ESTIMATE, context)
        self._neighbours = json_topic(f"{root}/neighbours", documents.NEIGHBOURS, context)
        self._messages = {
            name: json_topic(f"{root}/{name}", schema, context, partial(self._recall, name))
            for name, schema in {
                "battery": documents.BATTERY,
                "health": documents.HEALTH,
                "status": documents.STATUS,
            }.items()
        }
        self.topics = (
            self._image, self._points, self._calibration, self._pose, self._scene, self._estimate,
            self._neighbours, *self._messages.values(),
        )  # fmt: skip

    def close(self) -> None:
        """Ends its topics, and lets go of its pictures."""
        for topic in self.topics:
            topic.close()
        self._pictures.close()

    def wants(self, note: FrameMessage) -> bool:
        """Whether a frame is of use, from any thread: someone looks, or its size is another."""
        return self._image.wanted or (note.width_px, note.height_px) != self._size

    def frame(self, note: FrameMessage) -> None:
        """A received frame; its picture is encoded for those who look, as often as is allowed."""
        size = (note.width_px, note.height_px)
        if size != self._size:
            self._size = size
            for make, log_ns in self._calibrated():
                self._calibration.publish(make, log_ns)
        now_s = time.monotonic()
        if not self._image.wanted or now_s < self._due_s - _EARLY * self._period_s:
            return
        image = self._pictures.read(note.slot, note.stamp)
        if image is None:  # overwritten meanwhile: the next one comes
            return
        self._due_s = max(self._due_s, now_s - self._period_s) + self._period_s
        time_ns = conversion.stamp_ns(note)
        self._image.publish(lambda: self._encoded(image, time_ns), time_ns)

    def estimate(self, note: EstimateMessage) -> None:
        """A frame's pose, or why there is none."""
        time_ns, pose = conversion.stamp_ns(note), conversion.solved(note)
        self._state, self.alive = note.state, True
        if pose is not None:
            begins = not self._was_solved or note.relocalized
            self._trail.add(time_ns, pose.position_m, begins=begins)
            self._last = (pose, time_ns)
            self._pose.publish(lambda: drawing.pose_in_map(pose, time_ns), time_ns)
            self._tf.publish(lambda: drawing.transforms(self._id, pose, time_ns), time_ns)
        self._was_solved = pose is not None
        self._estimate.publish(lambda: documents.estimate(self._id, note, pose), time_ns)
        points = list(zip(note.points_px[::2], note.points_px[1::2], strict=True))
        self._points.publish(lambda: drawing.tracked(points, time_ns), time_ns)
        if self._last is not None:
            self._scene.publish(lambda: self._marker(time_ns), time_ns)
            now_s = time.monotonic()
            if now_s - self._trail_s >= _TRAIL_PERIOD_S:
                self._trail_s = now_s
                self._scene.publish(lambda: self._line(time_ns), time_ns)

    def see(self, note: EstimateMessage, others: Mapping[str, EstimateMessage]) -> None:
        """Where the others are at the time of its pose, at most five times a second."""
        now_s = time.monotonic()
        if note.position_m is None or now_s - self._seen_s < _SEEN_PERIOD_S:
            return
        self._seen_s = now_s
        time_ns = conversion.stamp_ns(note)
        self._neighbours.publish(
            lambda: documents.neighbours(self._id, time_ns, neighbours(self._id, note, others)),
            time_ns,
        )

    def status(self, note: PayloadMessage) -> None:
        """What the intake says of it; its messages when they are new."""
        now_ns = time.time_ns()
        document = bus_messages.as_document(note)
        told = {**{name: document[name] for name in ("battery", "health")},
                "status": documents.status(note)}  # fmt: skip
        for name, document in told.items():
            if document is not None and document != self._told.get(name, ({}, 0))[0]:
                self._told[name] = (document, now_ns)
                for make, log_ns in self._recall(name):
                    self._messages[name].publish(make, log_ns)
        if self.alive and not note.alive:
            self._scene.publish(lambda: drawing.gone(now_ns), now_ns)
            self._was_solved = False
        self.alive = note.alive

    def _recall(self, name: str) -> Iterator[tuple[Make, int]]:
        if name in self._told:
            document, log_ns = self._told[name]
            yield lambda: document, log_ns

    def _calibrated(self) -> Iterator[tuple[Make, int]]:
        """Where the camera is known and of the size that the pictures have."""
        camera = self._camera
        if camera is not None and (camera.width_px, camera.height_px) == self._size:
            now_ns = time.time_ns()
            yield lambda: drawing.calibration(self._id, camera, now_ns), now_ns

    def _drawn(self) -> Iterator[tuple[Make, int]]:
        if self._last is not None:
            _, time_ns = self._last
            yield lambda: self._line(time_ns), time_ns
            if self.alive:
                yield lambda: self._marker(time_ns), time_ns

    def _marker(self, time_ns: int) -> Any:
        assert self._last is not None
        pose, _ = self._last
        return drawing.scene(self._id, self._state, pose, time_ns, fresh=self._was_solved)

    def _line(self, time_ns: int) -> Any:
        return drawing.trail(*self._trail.document(), time_ns)

    def _encoded(self, image: U8, time_ns: int) -> Any:
        import cv2

        quality = [cv2.IMWRITE_JPEG_QUALITY, self._quality]
        _, jpeg = cv2.imencode(".jpg", image, quality)
        return drawing.picture(self._id, jpeg.tobytes(), time_ns)
