"""What the service's processes say of a station at which one payload flies, as tests say it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ground_station.service import bus_messages
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    PayloadMessage,
    ProcessMessage,
    RecordingMessage,
)
from pi_firmware.wire import messages

PAYLOAD = "blimp-1"
WIDTH, HEIGHT = 64, 48


class Clock:
    """A monotonic clock that a test sets."""

    ns = 1000 * 10**9

    def __call__(self) -> int:
        return self.ns


@dataclass
class SilentBus:
    """A bus on which `put` says what others would, and `query` gives the answer that was set."""

    dropped: int = 0
    asked: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    answer: Mapping[str, Any] = field(default_factory=lambda: {"done": True, "reason": ""})
    said: list[tuple[str, str, bus_messages.Message]] = field(default_factory=list)
    _takes: dict[str, list[Callable[[str, Any], None]]] = field(default_factory=dict)

    def subscribe(self, kind: str, _: type, take: Callable[[str, Any], None]) -> None:
        self._takes.setdefault(kind, []).append(take)

    def publish(self, kind: str, payload_id: str, note: bus_messages.Message) -> None:
        self.said.append((kind, payload_id, note))

    def put(self, kind: str, payload_id: str, note: bus_messages.Message) -> None:
        """As over the bus: what is no message is dropped and counted."""
        try:
            note = bus_messages.decode(type(note), bus_messages.encode(note))
        except bus_messages.MessageError:
            self.dropped += 1
            return
        for take in self._takes.get(kind, ()):
            take(payload_id, note)

    def query(self, name: str, request: Mapping[str, Any], timeout_s: float = 5.0) -> Any:
        self.asked.append((name, dict(request)))
        return self.answer


def frame(slot: int = 0, stamp: int = 2, sequence: int = 1, **values: Any) -> FrameMessage:
    now_ns = time.time_ns()
    note = FrameMessage(
        slot, stamp, sequence, time_ns=now_ns, clock_ns=now_ns, arrival_ns=now_ns,
        width_px=WIDTH, height_px=HEIGHT, ssrc=7, capture_ns=now_ns,
    )  # fmt: skip
    return replace(note, **values)


def estimate(sequence: int = 1, **values: Any) -> EstimateMessage:
    now_ns = time.time_ns()
    note = EstimateMessage(
        sequence, now_ns, now_ns, done_ns=now_ns, state="TRACKING", capture_ns=now_ns - 40_000_000,
        position_m=[1.0, 2.0, 1.5], quaternion_xyzw=[0.0, 0.0, 0.0, 1.0], covariance=[0.01] * 36,
        position_sigma_m=[0.01] * 9, velocity_mps=[0.1, 0.0, 0.0], heading_deg=12.0, speed_mps=0.1,
        height_m=1.5, inliers=90, expected=120, points_px=[10.0, 20.0, 30.0, 40.0],
        stage_ms={"track": 5.0, "pose": 2.5}, map="atrium", processed=9, localized=8, skipped=1,
    )  # fmt: skip
    return replace(note, **values)


_REQUIRED = {"battery": {"voltage": 3.9}, "health": {"uptime_s": 60.0}}


def payload(**values: Any) -> PayloadMessage:
    now_ns = time.time_ns()
    note = PayloadMessage(
        alive=True, seen_ns=now_ns, ssrc=7, frames={"captured": 100, "received": 90, "lost": 1},
        stream={"packets": 1000, "packets_lost": 10}, rate_hz=29.9, bitrate_kbps=1500.0,
        clock={"offset_ns": 5, "uncertainty_ns": 100_000}, round_trip_s=0.01,
        battery=messages.Battery(
            now_ns, 3.9, percentage=0.8, current=-0.4, time_left_s=900.0, alarm=""
        ),
        health=messages.Health(
            now_ns, uptime_s=60.0, temperature_C=51.0, cpu=0.4, wifi_signal_dBm=-55.0
        ),
    )  # fmt: skip
    kinds = {
        "battery": messages.Battery,
        "health": messages.Health,
        "autopilot": messages.Autopilot,
    }
    for name, kind in kinds.items():
        if isinstance(fields := values.get(name), dict):
            values[name] = kind(**{"time_ns": now_ns, **_REQUIRED.get(name, {}), **fields})
    return replace(note, **values)


def event(**values: Any) -> EventMessage:
    return replace(
        EventMessage(time.time_ns(), "station", bus_messages.INFO, "hello", "a text"), **values
    )


def recording(**values: Any) -> RecordingMessage:
    return replace(RecordingMessage(active=False, free_MB=50_000.0), **values)


def process(name: str = "intake", pid: int = 100, **values: Any) -> ProcessMessage:
    return replace(ProcessMessage(name, pid, memory_MB=80.0, cpu=0.2, uptime_s=5.0), **values)


def say_all(put: Callable[[str, str, bus_messages.Message], None]) -> None:
    """One note of each kind, as a station with a payload that flies says them."""
    put(bus_messages.PROCESS, bus_messages.STATION, process())
    put(bus_messages.RECORDING, bus_messages.STATION, recording())
    put(bus_messages.PAYLOAD, PAYLOAD, payload())
    put(bus_messages.FRAME, PAYLOAD, frame())
    put(bus_messages.ESTIMATE, PAYLOAD, estimate())
    put(bus_messages.EVENT, PAYLOAD, event())
