"""A run's own ground station is asked for its ports when both of its processes are there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ground_station.replay import station
from ground_station.service.bus_messages import EventMessage


class LateIntake:
    """A bus whose localizer has its map before the intake answers."""

    def __init__(self) -> None:
        self.asked = 0

    def subscribe(self, topic: str, kind: type, told: Any) -> None:
        if kind is EventMessage:
            told("-", EventMessage(1, "localizer", "info", "map-loaded", "atrium"))

    def query(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        assert (name, request) == ("intake", {"do": "endpoints"})
        self.asked += 1
        if self.asked < 3:
            return {"done": False, "reason": "the service's intake did not answer"}
        return {"done": True, "reason": "", "video_port": 5600, "telemetry": ["tcp/127.0.0.1:1"]}


class NoChildren:
    def __init__(self, specs: object, said: object) -> None:
        self.steps = 0

    def step(self) -> None:
        self.steps += 1

    def pids(self) -> dict[str, int]:
        return {}


def test_an_intake_that_comes_after_the_map_is_waited_for(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(station, "Children", NoChildren)
    monkeypatch.setattr(station.processes, "intake", lambda folder: None)
    monkeypatch.setattr(station.processes, "localizer", lambda folder, payload_id: None)
    bus: Any = LateIntake()
    made = station.Station(tmp_path, None, "blimp-1", bus)  # type: ignore[arg-type]
    made.ready()
    assert bus.asked == 3 and made.children.steps >= 3  # type: ignore[attr-defined]
    assert (made.video_port, made.endpoints) == (5600, ("tcp/127.0.0.1:1",))
