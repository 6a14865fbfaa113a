"""A station without payloads: serves the dashboard and tells it of a scripted flight.

It says what `ground_station.service.web` says, out of the sample's recording with its true poses:
states that change, an alarm that comes and goes, a second payload that disappears. Run it to look
at the page while working on it:

    python tests/service/fake_station.py --port 8099
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import functools
import json
import math
import socket
import struct
import threading
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response, WebSocket, WebSocketDisconnect

from ground_station.geometry.trajectory import Trajectory
from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.service.web.app import STATIC, static_files

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "maps" / "atrium"
POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; connect-src 'self'; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'self'"
)
FRAMES = 200
RATE_HZ = 30.0
LATENCY_S = 0.04
_PLAN = {"resolution_m": 0.025, "origin": [-0.75, -0.75, 0.0], "width_px": 1020, "height_px": 700}
_SHAPE = np.array([1.0, 0.4, 0.0, 0.4, 0.5, 0.0, 0.0, 0.0, 0.2])
_FOCAL_PX, _CENTRE_PX = 503.0, (312.5, 241.2)
STEPS = [
    {"name": "payload", "title": "A payload is heard", "state": "done", "check": "blimp doctor",
     "found": "blimp-1: 30 frames a second", "ways": [], "choices": []},
    {"name": "build", "title": "A map is built", "state": "ready", "check": "blimp map view x",
     "found": "no map of <b>your own</b> yet", "choices": ["a.mcap", "b.mcap"],
     "ways": [{"text": "of a video", "command": "blimp map build 'a b.mp4' --out maps/NAME"},
              {"text": "or film it again", "command": ""}]},
    {"name": "fly", "title": "The payload flies in it", "state": "waiting", "check": "look",
     "found": "needs a map", "ways": [], "choices": []},
]  # fmt: skip


@dataclass(frozen=True)
class Flight:
    """The sample as the fake tells it: a JPEG, a pose and the landmarks seen, for each frame."""

    jpegs: list[bytes]
    positions_m: np.ndarray
    quaternions_xyzw: np.ndarray
    points_px: list[list[float]]
    landmarks_m: np.ndarray


@functools.cache
def sample_flight(frames: int = FRAMES) -> Flight:
    """Reads the first frames of the sample, every second one's picture."""
    from safetensors.numpy import load_file

    path = SAMPLE / "flight.mcap"
    truth: Trajectory = trajectory_of(path)
    landmarks_m = load_file(SAMPLE / "landmarks.safetensors")["position_m"]
    jpegs: list[bytes] = []
    for k, frame in enumerate(FlightRecording(path)):
        if k >= frames:
            break
        if k % 2 == 0:
            quality = [cv2.IMWRITE_JPEG_QUALITY, 70]
            jpegs.append(cv2.imencode(".jpg", frame.image, quality)[1].tobytes())
    wTc = truth.wTc[:frames]
    return Flight(
        jpegs,
        truth.position_m[:frames],
        truth.quaternion_xyzw[:frames],
        [_seen(landmarks_m, pose[:3, :3], pose[:3, 3]) for pose in wTc],
        landmarks_m,
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
    """One payload of the fake; tests set its fields."""

    id: str
    first: int = 0
    alive: bool = True
    state: str = "TRACKING"
    reason: str = ""
    recording: str = ""
    seen_ns: int = 0
    sequence: int = 0
    map: str = "atrium"
    flies: bool = True
    version: str = "0.0.0+git0123456789ab"
    release: str = "update"
    release_reason: str = ""


@dataclass
class FakeStation:
    """What the page sees; tests and the show change it while it is served."""

    payloads: dict[str, Payload] = field(default_factory=dict)
    alarms: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    recording: bool = False
    recording_ns: int = 0
    recordings: list[dict[str, Any]] = field(default_factory=list)
    job: dict[str, Any] | None = None
    demo: bool = True
    map: str = "atrium"
    floorplan: bool = True
    camera: dict[str, Any] | None = None
    refuse: str = ""
    """Commands are refused with this reason."""
    answer_s: float = 0.0
    """Commands take this long."""
    name: str = "Atrium station"
    signed_out: bool = False
    asked: list[tuple[str, Any]] = field(default_factory=list)
    heard: list[dict[str, Any]] = field(default_factory=list)
    begun_ns: int = field(default_factory=time.time_ns)
    sockets: int = 0

    def event(self, level: str, text: str, payload: str = "-", name: str = "said") -> None:
        """Adds an event."""
        event = {"time_ns": time.time_ns(), "source": "station", "level": level, "name": name}
        self.events.append({**event, "text": text, "payload": payload})
        del self.events[:-500]

    def alarm(self, name: str, level: str, payload: str, text: str) -> None:
        """Lets an alarm stand."""
        self.alarms.append(
            {
                "id": f"{name}/{payload}",
                "level": level,
                "payload": payload,
                "text": text,
                "since_ns": time.time_ns(),
            }
        )

    def end_alarms(self) -> None:
        """Ends them all."""
        self.alarms.clear()

    def document(self, *, full: bool = True) -> dict[str, Any]:
        """The state document."""
        now_ns = time.time_ns()
        active_s = 1e-9 * (now_ns - self.recording_ns) if self.recording else 0.0
        document: dict[str, Any] = {
            "now_ns": now_ns,
            "station": {
                "name": self.name,
                "version": "0.0.0",
                "uptime_s": 1e-9 * (now_ns - self.begun_ns),
                "map": self.map,
                "demo": self.demo,
            },
            "processes": [],
            "recording": {
                "active": self.recording,
                "file": "flight-0001.mcap" if self.recording else "",
                "size_MB": 0.21 * active_s,
                "duration_s": active_s,
                "dropped": 0,
                "free_MB": 48_211.0,
                "problem": "",
            },
            "payloads": {
                one.id: self._payload(one, now_ns, full) for one in self.payloads.values()
            },
            "alarms": list(self.alarms),
            "job": self.job,
        }
        if full:
            document["events"] = self.events[-200:]
        return document

    def _payload(self, one: Payload, now_ns: int, full: bool) -> dict[str, Any]:
        if one.alive:
            one.seen_ns = now_ns
        age_s = 1e-9 * (now_ns - one.seen_ns)
        estimate = self.estimate(one, points=full)
        entry: dict[str, Any] = {
            "payload": self._note(one, now_ns),
            "estimate": estimate,
            "alive": one.alive,
            "age_s": dict.fromkeys(("payload", "estimate", "frame", "battery", "health"), age_s),
            "stale": [] if one.alive else ["payload", "estimate", "frame", "battery", "health"],
        }
        if full:
            flight = sample_flight()
            begin = max(0, (one.first + one.sequence) % FRAMES - 90)
            end = (one.first + one.sequence) % FRAMES
            entry["trail"] = flight.positions_m[begin:end:3].round(3).tolist()
            entry["trail_breaks"] = []
        return entry

    def _note(self, one: Payload, now_ns: int) -> dict[str, Any]:
        n = one.sequence
        slow = math.sin(n / 200)
        return {
            "alive": one.alive,
            "seen_ns": one.seen_ns,
            "ssrc": 77,
            "encrypted": one.first == 0,
            "frames": {
                "captured": n + n // 12,
                "gated": n // 12,
                "sent": n,
                "discarded": 0,
                "received": n - n // 90,
                "lost": n // 90,
                "withheld": 0,
                "dropped": 0,
            },
            "stream": {},
            "rate_hz": RATE_HZ,
            "bitrate_kbps": 1210 + 90 * slow,
            "lost_share": 0.011 + 0.008 * slow,
            "clock": {"offset_ns": 0, "uncertainty_ns": 200_000},
            "round_trip_s": 0.0042,
            "battery": {
                "voltage": 3.84 - n * 1e-6,
                "percentage": 0.72,
                "current": -0.61,
                "time_left_s": 2520.0,
                "power_supply_status": 2,
                "alarm": "",
            },
            "health": {
                "uptime_s": 1e-9 * (now_ns - self.begun_ns) + 831,
                "temperature_C": 58.4 + 3 * slow,
                "cpu": 0.71,
                "throttled": [],
                "wifi_signal_dBm": -61.0 - 5 * slow,
                "disk_free_MB": 9_120.0,
                "recording": one.recording,
                "recording_MB": 12.0,
                "version": one.version,
                "release": one.release,
                "release_reason": one.release_reason,
            },
            "autopilot": {"connected": True, "armed": False, "battery_percentage": 0.66},
            "recording": one.recording,
        }

    def estimate(self, one: Payload, *, points: bool = True) -> dict[str, Any]:
        """The newest estimate of a payload."""
        flight = sample_flight()
        k = (one.first + one.sequence) % FRAMES
        knows = one.state in ("TRACKING", "DEGRADED")
        done_ns = one.seen_ns or time.time_ns()
        x, y, z = (float(value) for value in flight.positions_m[k])
        ahead = flight.positions_m[min(k + 3, FRAMES - 1)] - flight.positions_m[max(k - 3, 0)]
        velocity = ahead * RATE_HZ / 6
        q = flight.quaternions_xyzw[k]
        view = _turn(q, np.array([0.0, 0.0, 1.0]))
        sigma = 0.35 if one.state == "DEGRADED" else 0.04
        return {
            "sequence": one.sequence,
            "time_ns": done_ns,
            "clock_ns": done_ns,
            "done_ns": done_ns,
            "capture_ns": done_ns - int(1e9 * LATENCY_S * (1 + 0.2 * math.sin(k))),
            "state": one.state,
            "reason": one.reason,
            "position_m": [x, y, z] if knows else None,
            "quaternion_xyzw": q.tolist() if knows else None,
            "position_sigma_m": (sigma**2 * _SHAPE).tolist(),
            "velocity_mps": velocity.tolist() if knows else None,
            "speed_mps": float(np.linalg.norm(velocity)) if knows else None,
            "heading_deg": math.degrees(math.atan2(view[1], view[0])) if knows else None,
            "height_m": z if knows else None,
            "inliers": 184 if knows else 0,
            "expected": 240,
            "points_px": flight.points_px[k] if points and knows else [],
            "map": one.map,
            "processed": one.sequence,
            "localized": one.sequence - one.sequence // 25,
            "skipped": one.sequence // 60,
        }


def _turn(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    t = 2 * np.cross(q[:3], v)
    return v + q[3] * t + np.cross(q[:3], t)


def make_app(station: FakeStation) -> FastAPI:
    """The contract's endpoints around a station."""

    @contextlib.asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        async def fly() -> None:
            while True:
                await asyncio.sleep(1 / RATE_HZ)
                for one in station.payloads.values():
                    if one.alive and one.flies:
                        one.sequence += 1
                        one.seen_ns = time.time_ns()

        flying = asyncio.create_task(fly())
        yield
        flying.cancel()

    app = FastAPI(lifespan=life)

    @app.middleware("http")
    async def headers(request: Request, call_next: Any) -> Response:
        if station.signed_out and request.url.path.startswith("/api"):
            return Response('{"detail": "a token is needed"}', 401)
        response: Response = await call_next(request)
        response.headers["Content-Security-Policy"] = POLICY
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Cache-Control"] = "no-cache"
        return response

    async def answer(what: str, body: Any) -> dict[str, Any]:
        station.asked.append((what, body))
        await asyncio.sleep(station.answer_s)
        return {"done": not station.refuse, "reason": station.refuse, "values": {}}

    def known(payload_id: str) -> Payload:
        if payload_id not in station.payloads:
            raise HTTPException(404, f"there is no payload {payload_id}")
        return station.payloads[payload_id]

    @app.get("/")
    def page() -> Response:
        return Response((STATIC / "index.html").read_bytes(), media_type="text/html")

    @app.get("/login")
    def login() -> Response:
        return Response("<!doctype html><title>Log in</title>", media_type="text/html")

    @app.get("/api/state")
    def state() -> dict[str, Any]:
        return station.document()

    @app.get("/api/maps")
    def maps() -> list[dict[str, Any]]:
        facts = {"registered": True, "landmarks": 7573, "extent_m": [25.5, 17.5, 6.2]}
        return [
            {"name": "atrium", "floorplan": True, **facts},
            {"name": "great-hall-of-the-east-wing", "floorplan": False, **facts},
        ]

    @app.get("/api/maps/{name}")
    def map_details(name: str) -> dict[str, Any]:
        has_plan = station.floorplan and name == "atrium"
        plan = {**_PLAN, "url": f"/api/maps/{name}/floorplan.png"} if has_plan else None
        bounds = {"min": [-3.0, -40.0, -1.0], "max": [60.0, 30.0, 9.0]}  # with what a window shows
        facts = {"registered": True, "floorplan": plan, "bounds": bounds}
        return {"name": name, "camera": station.camera, **facts}

    @app.get("/api/maps/{name}/floorplan.png")
    def floorplan(name: str) -> Response:
        return Response((SAMPLE / "floorplan.png").read_bytes(), media_type="image/png")

    @app.get("/api/maps/{name}/landmarks")
    def landmarks(name: str) -> Response:
        data = sample_flight().landmarks_m.astype("<f4").tobytes()
        return Response(data, media_type="application/octet-stream")

    @app.get("/api/guide")
    def guide() -> dict[str, Any]:
        return {"folder": "/srv/blimp", "steps": STEPS}

    @app.post("/api/job")
    async def start(request: Request) -> dict[str, Any]:
        return await answer("job", await request.json())

    @app.delete("/api/job")
    async def stop() -> dict[str, Any]:
        return await answer("job", None)

    @app.get("/api/recordings")
    def recordings() -> list[dict[str, Any]]:
        return station.recordings

    @app.delete("/api/recordings/{name}")
    async def delete(name: str) -> dict[str, Any]:
        result = await answer("delete", name)
        if result["done"]:
            station.recordings = [one for one in station.recordings if one["file"] != name]
        return result

    @app.post("/api/recording")
    async def record(request: Request) -> dict[str, Any]:
        body = await request.json()
        result = await answer("recording", body)
        if result["done"]:
            station.recording, station.recording_ns = bool(body["active"]), time.time_ns()
        return result

    @app.post("/api/payloads/{payload_id}/command")
    async def command(payload_id: str, request: Request) -> dict[str, Any]:
        one, body = known(payload_id), await request.json()
        result = await answer(f"{payload_id}/command", body)
        if result["done"] and body["name"].startswith("record-"):
            one.recording = "payload-0001.mcap" if body["name"] == "record-start" else ""
        return result

    @app.post("/api/payloads/{payload_id}/relocalize")
    async def relocalize(payload_id: str) -> dict[str, Any]:
        known(payload_id)
        return await answer(f"{payload_id}/relocalize", {})

    @app.post("/api/payloads/{payload_id}/map")
    async def choose_map(payload_id: str, request: Request) -> dict[str, Any]:
        one, body = known(payload_id), await request.json()
        result = await answer(f"{payload_id}/map", body)
        if result["done"]:
            one.map = body["name"]
        return result

    @app.websocket("/api/live")
    async def live(socket_: WebSocket, payload: str = "") -> None:
        if station.signed_out:
            await socket_.close()
            return
        await socket_.accept()
        station.sockets += 1
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await _Viewer(station, socket_, payload).serve()
        station.sockets -= 1

    app.mount("/static", static_files(STATIC))
    return app


class _Viewer:
    """One page at the WebSocket."""

    def __init__(self, station: FakeStation, socket_: WebSocket, payload: str) -> None:
        self.station, self.socket = station, socket_
        self.selected = payload or next(iter(station.payloads), "")
        self.video = True
        self.events = len(station.events)

    async def serve(self) -> None:
        """Until the page goes."""
        hello = {"type": "hello", "now_ns": time.time_ns(), "payload": self.selected or None}
        state = self.station.document()
        await self._say({**hello, "video": True, "video_rate_hz": 15, "state": state})
        telling = asyncio.create_task(self._tell())
        try:
            while True:
                self._hear(message := json.loads(await self.socket.receive_text()))
                if message["type"] == "ping":
                    now_ns = time.time_ns()
                    await self._say(
                        {"type": "pong", "sent_ms": message["sent_ms"], "now_ns": now_ns}
                    )
        finally:
            telling.cancel()

    def _hear(self, message: dict[str, Any]) -> None:
        self.station.heard.append(message)
        del self.station.heard[:-500]
        if message["type"] == "select":
            self.selected = message["payload"]
        elif message["type"] == "video":
            self.video = message["on"]

    async def _say(self, message: dict[str, Any]) -> None:
        await self.socket.send_text(json.dumps(message))

    async def _tell(self) -> None:
        begun_s, tick, told = time.monotonic(), 0, dict.fromkeys(self.station.payloads, -1)
        seen = list(self.station.events)
        while True:
            tick += 1
            await asyncio.sleep(max(0.0, begun_s + tick / RATE_HZ - time.monotonic()))
            if tick % 8 == 0:
                await self._say({"type": "state", **self.station.document(full=False)})
            for event in [event for event in self.station.events if event not in seen]:
                await self._say({"type": "event", "event": event})
                seen.append(event)
            for one in list(self.station.payloads.values()):
                is_shown = one.id == self.selected
                if not one.alive or one.sequence == told.get(one.id) or (not is_shown and tick % 6):
                    continue
                told[one.id] = one.sequence
                estimate = self.station.estimate(one, points=is_shown)
                await self._say({"type": "estimate", "payload": one.id, "estimate": estimate})
                if is_shown and self.video and one.sequence % 2 == 0:
                    await self._picture(one, estimate)

    async def _picture(self, one: Payload, estimate: dict[str, Any]) -> None:
        flight = sample_flight()
        header = json.dumps(
            {
                "type": "video",
                "payload": one.id,
                "sequence": one.sequence,
                "capture_ns": estimate["capture_ns"],
                "width_px": 640,
                "height_px": 480,
            }
        ).encode()
        jpeg = flight.jpegs[(one.first + one.sequence) % FRAMES // 2]
        await self.socket.send_bytes(struct.pack(">I", len(header)) + header + jpeg)


class Served:
    """The app on a port of loopback in a thread, which can be stopped and started again."""

    def __init__(self, station: FakeStation, port: int = 0) -> None:
        self.station = station
        with socket.socket() as free:
            free.bind(("127.0.0.1", port))
            self.port = int(free.getsockname()[1])
        self.start()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://127.0.0.1:{self.port}/"

    def start(self) -> None:
        """Serves; returns when it does."""
        config = uvicorn.Config(
            make_app(self.station),
            host="127.0.0.1",
            port=self.port,
            log_level="critical",
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._thread.start()
        deadline_s = time.monotonic() + 20
        while not self._server.started:
            if time.monotonic() > deadline_s or not self._thread.is_alive():
                raise RuntimeError("the fake station did not start")
            time.sleep(0.02)

    def stop(self) -> None:
        """Ends it, and every page's connection."""
        self._server.should_exit = True
        self._server.force_exit = True
        self._thread.join(20)


def sample_station() -> FakeStation:
    """One payload that tracks and a second one."""
    station = FakeStation()
    station.payloads["blimp-1"] = Payload("blimp-1")
    station.payloads["blimp-2"] = Payload("blimp-2", first=100)
    station.event("info", "blimp-1 appeared", "blimp-1")
    station.event("info", "map atrium: 7573 landmarks")
    return station


def show(station: FakeStation) -> None:
    """A quarter of an hour's events in a minute, again and again."""
    one, two = station.payloads["blimp-1"], station.payloads["blimp-2"]
    while True:
        time.sleep(10)
        one.state, one.reason = "DEGRADED", "few landmarks: 14 of 120 expected"
        station.event("warning", "few landmarks", "blimp-1")
        time.sleep(6)
        one.state, one.reason = "LOST", "no landmarks for 2.0 s"
        station.event("alarm", "lost: no landmarks for 2.0 s", "blimp-1")
        station.alarm("lost", "alarm", "blimp-1", "LOST for 2 s: no landmarks")
        time.sleep(6)
        station.end_alarms()
        one.state, one.reason = "TRACKING", ""
        station.event("info", "relocalized", "blimp-1")
        time.sleep(6)
        two.alive = False
        station.alarm("gone", "alarm", "blimp-2", "gone: nothing is heard of the payload")
        time.sleep(10)
        two.alive = True
        station.end_alarms()


def main() -> None:
    """Serves the show until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, default=8099)
    station = sample_station()
    sample_flight()
    served = Served(station, parser.parse_args().port)
    print(served.url, flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        show(station)


if __name__ == "__main__":
    main()
