"""The real web application, told of the sample's flight by messages on its bus."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import web_station
from safetensors.numpy import load_file

from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.service import bus_messages
from ground_station.service.pictures import PictureWriter
from ground_station.service.web.app import Web, build

FRAMES = 200
RATE_HZ = 30.0
LATENCY_NS = 40_000_000
_FOCAL_PX, _CENTRE_PX = 503.0, (312.5, 241.2)


@dataclass(frozen=True)
class Flight:
    """The sample's first frames: every second one's picture, each one's pose and landmarks."""

    pictures: list[np.ndarray]
    positions_m: np.ndarray
    quaternions_xyzw: np.ndarray
    points_px: list[list[float]]


@functools.cache
def sample_flight() -> Flight:
    path = web_station.ATRIUM / "flight.mcap"
    truth = trajectory_of(path)
    landmarks_m = load_file(web_station.ATRIUM / "landmarks.safetensors")["position_m"]
    frames = zip(FlightRecording(path), range(FRAMES), strict=False)
    return Flight(
        [frame.image for frame, k in frames if k % 2 == 0],
        truth.position_m[:FRAMES],
        truth.quaternion_xyzw[:FRAMES],
        [_seen(landmarks_m, pose[:3, :3], pose[:3, 3]) for pose in truth.wTc[:FRAMES]],
    )


def _seen(landmarks_m: np.ndarray, R: np.ndarray, t: np.ndarray) -> list[float]:
    """Some of the landmarks in front of the camera, as u, v by turns."""
    camera = (landmarks_m[::5] - t) @ R
    camera = camera[(camera[:, 2] > 1.0) & (camera[:, 2] < 15.0)]
    uv = _FOCAL_PX * camera[:, :2] / camera[:, 2:] + _CENTRE_PX
    inside = (uv > 0).all(1) & (uv[:, 0] < 639) & (uv[:, 1] < 479)
    return [round(float(value), 1) for value in uv[inside][:300].ravel()]


@dataclass
class Payload:
    """What is said of a payload; tests set its fields."""

    id: str
    sequence: int = 0
    alive: bool = True
    flies: bool = True
    state: str = "TRACKING"
    reason: str = ""
    map: str = "atrium"
    station: str = ""
    health: dict[str, Any] = field(
        default_factory=lambda: {"version": "0.0.0+git0123456789ab", "release": "update"}
    )


class _AskedBus(web_station.SilentBus):
    """Does what it is asked at once, unless the station refuses."""

    def __init__(self, station: FlownStation) -> None:
        super().__init__()
        self._station = station

    def query(self, name: str, request: Mapping[str, Any], timeout_s: float = 5.0) -> Any:
        station = self._station
        station.asked.append((name, dict(request)))
        time.sleep(station.answer_s)
        if station.refuse:
            return {"done": False, "reason": station.refuse}
        if request["do"] in ("record-start", "record-stop"):
            station.recording = request["do"] == "record-start"
        elif request["do"] == "map":
            station.payloads[name.partition("/")[2]].map = request["name"]
        return {"done": True, "reason": ""}


class FlownStation:
    """Payloads that fly the sample, seen at `url`; the server can be stopped and started again.

    `asked` is what the service's other processes were asked for; with `refuse` they refuse for that
    reason, after `answer_s` seconds.
    """

    def __init__(self, folder: Path, *payloads: Payload) -> None:
        self.folder = folder
        (folder / "maps").mkdir()
        (folder / "maps" / "atrium").symlink_to(web_station.ATRIUM)
        self.run = web_station.run_of(folder, shelf=folder / "maps")
        self.payloads = {one.id: one for one in payloads}
        self.job: dict[str, Any] | None = None
        self.recording, self.refuse, self.answer_s = False, "", 0.0
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.port = 0
        self._rings = {one.id: PictureWriter(folder, one.id) for one in payloads}
        self.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def start(self, token: str | None = None) -> None:
        """Serves; returns when it does."""
        self.bus = _AskedBus(self)
        self.web: Web = build(self.run, self.folder, self.bus, token)
        self.web.snapshot.job = lambda: self.job
        self._ends, self._open = threading.Event(), contextlib.ExitStack()
        self.port = self._open.enter_context(web_station.serving(self.web, self.port))
        self._flying = threading.Thread(target=self._fly, daemon=True)
        self._flying.start()

    def stop(self) -> None:
        """Ends it, and every page's connection."""
        self._ends.set()
        self._flying.join(10.0)
        self._open.close()

    def event(self, level: Any, text: str) -> None:
        """Something happens to the first payload."""
        note = web_station.event(level=level, text=text)
        self.bus.put(bus_messages.EVENT, next(iter(self.payloads)), note)

    def _fly(self) -> None:
        tick = 0
        while not self._ends.wait(1 / RATE_HZ):
            for one in self.payloads.values():
                if one.alive:
                    one.sequence += one.flies
                    self._frame(one)
                if tick % 15 == 0:
                    note = web_station.payload(
                        alive=one.alive, health=dict(one.health), station=one.station,
                        relayed=bool(one.station),
                    )  # fmt: skip
                    self.bus.put(bus_messages.PAYLOAD, one.id, note)
            if tick % 8 == 0:
                note = web_station.recording(active=self.recording, file="now.mcap")
                self.bus.put(bus_messages.RECORDING, bus_messages.STATION, note)
            tick += 1

    def _frame(self, one: Payload) -> None:
        flight, k = sample_flight(), one.sequence % FRAMES
        picture = flight.pictures[k // 2]
        height, width = picture.shape
        capture_ns = time.time_ns() - LATENCY_NS
        if k % 2 == 0:
            slot, stamp = self._rings[one.id].write(picture)
            note = web_station.frame(
                slot, stamp, one.sequence, width_px=width, height_px=height, capture_ns=capture_ns
            )
            self.bus.put(bus_messages.FRAME, one.id, note)
        found: dict[str, Any] = {"position_m": None, "quaternion_xyzw": None, "points_px": []}
        if one.state in ("TRACKING", "DEGRADED"):
            found["position_m"] = flight.positions_m[k].tolist()
            found["quaternion_xyzw"] = flight.quaternions_xyzw[k].tolist()
            found["points_px"] = flight.points_px[k]
        note = web_station.estimate(
            one.sequence, capture_ns=capture_ns, state=one.state, reason=one.reason, map=one.map,
            **found,
        )  # fmt: skip
        self.bus.put(bus_messages.ESTIMATE, one.id, note)


@contextlib.contextmanager
def flown(folder: Path, *payloads: Payload) -> Iterator[FlownStation]:
    """A station on an empty folder, until it is left."""
    sample_flight()
    station = FlownStation(folder, *payloads)
    try:
        yield station
    finally:
        station.stop()
