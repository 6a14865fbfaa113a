"""What stands around the Foxglove process in its tests: a station's voice, and a client."""

from __future__ import annotations

import base64
import json
import struct
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import process_stand as stand
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from process_stand import program
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from ground_station.service.bus_messages import EstimateMessage, FrameMessage

LIMIT_S = 60.0
CAPTURE_NS = 1_790_000_000_123_456_789


def estimate(sequence: int = 7, **fields: Any) -> EstimateMessage:
    """A solved frame's."""
    values: dict[str, Any] = {
        "sequence": sequence,
        "time_ns": 5,
        "clock_ns": 6,
        "done_ns": CAPTURE_NS + 50_000_000,
        "capture_ns": CAPTURE_NS,
        "state": "TRACKING",
        "position_m": [3.0, 4.0, 2.5],
        # It looks along the map's x axis: right is -y, down is -z.
        "quaternion_xyzw": [-0.5, 0.5, -0.5, 0.5],
        "covariance": np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4]).ravel().tolist(),
        "points_px": [10.0, 20.0, 30.5, 40.5],
        "inliers": 40,
        "map": "atrium",
    }
    return EstimateMessage(**(values | fields))


class Station(stand.Station):
    """The voices of intake and localizer on a bus."""

    def __init__(self, folder: Path, **foxglove: Any) -> None:
        super().__init__(folder, foxglove={"port": 0, **foxglove})

    def client(self) -> Client:
        """One that is told of the payload's topics, which come with its first estimate."""
        return Client(self.port, lambda: self.say(estimate()))

    def show(self, image: Any, sequence: int, **fields: Any) -> FrameMessage:
        return super().show(image, sequence, **{"capture_ns": CAPTURE_NS, **fields})


@contextmanager
def server(folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The process, as the service starts it, and its port."""
    with program("foxglove", str(folder), stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("foxglove: ws://"), line
        yield process, int(line.rpartition(":")[2])


class Client:
    """A client that knows nothing but the protocol: it decodes by the schemas it is told."""

    def __init__(self, port: int, again: Callable[[], object] | None = None) -> None:
        self._stack, self._again = ExitStack(), again
        self.socket = self._stack.enter_context(
            connect(
                f"ws://127.0.0.1:{port}",
                subprotocols=[Subprotocol("foxglove.sdk.v1")],
                max_size=None,
                close_timeout=0.2,  # with messages unread its end of the closing is unread, too
            )
        )
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.received: dict[str, list[tuple[int, Any]]] = {}
        self._topics: dict[int, str] = {}

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def subscribe(self, *topics: str) -> None:
        """Waits until they are told of, and subscribes."""
        there = lambda: all(topic in self.channels for topic in topics)  # noqa: E731
        self.until(there, f"{topics}", self._again)
        self.received |= {topic: [] for topic in topics}
        self._ask(topics)

    def _ask(self, topics: Iterable[str]) -> None:
        numbers = {self.channels[topic]["id"]: topic for topic in topics}
        self._topics |= numbers
        asked = [{"id": number, "channelId": number} for number in numbers]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))

    def until(
        self, condition: Callable[[], bool], what: str, again: Callable[[], object] | None = None
    ) -> None:
        """Receives until something holds; does something `again` whenever nothing more waits.

        Sooner, what is asked for could be dropped from a queue that only grows.
        """
        deadline_s = time.monotonic() + LIMIT_S
        while not condition():
            assert time.monotonic() < deadline_s, f"{what} did not come"
            if not self.receive(0.1) and again is not None:
                again()

    def first(self, topic: str, again: Callable[[], object] | None = None) -> tuple[int, Any]:
        """The first message on a topic: its log time, ns, and what it says."""
        self.until(lambda: bool(self.received[topic]), topic, again)
        return self.received[topic][0]

    def drain(self) -> None:
        """Receives until nothing came for half a second."""
        while self.receive(0.5):
            pass

    def receive(self, timeout_s: float) -> bool:
        """Takes one message; whether one came."""
        try:
            data = self.socket.recv(timeout=timeout_s)
        except TimeoutError:
            return False
        if isinstance(data, bytes):
            kind, number, log_ns = struct.unpack_from("<BIQ", data)
            assert kind == 1
            topic = self._topics[number]
            self.received[topic].append((log_ns, self._decode(topic, data[13:])))
            return True
        said = json.loads(data)
        if said["op"] == "serverInfo":
            self.info = said
        elif said["op"] == "advertise":
            told = {channel["topic"]: channel for channel in said["channels"]}
            self.channels |= told
            # A payload that went and came has another channel, as Foxglove itself knows.
            wanted = told.keys() & self.received.keys()
            if new := [topic for topic in wanted if told[topic]["id"] not in self._topics]:
                self._ask(new)
        elif said["op"] == "unadvertise":
            ended = set(said["channelIds"])
            self.channels = {t: c for t, c in self.channels.items() if c["id"] not in ended}
        return True

    def _decode(self, topic: str, data: bytes) -> Any:
        channel = self.channels[topic]
        if channel["encoding"] == "json":
            return json.loads(data)
        pool = descriptor_pool.DescriptorPool()
        for file in FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
            pool.Add(file)
        found = pool.FindMessageTypeByName(channel["schemaName"])
        return message_factory.GetMessageClass(found).FromString(data)
