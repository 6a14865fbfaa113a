"""Which payloads have a localizer: those that fly here, and a few that fly with other stations."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ground_station.service import bus_messages, processes, serve
from ground_station.service.bus_messages import PayloadMessage
from ground_station.service.settings import StationSettings
from pi_firmware.wire.config import from_mapping


class Heard:
    """A bus that says what it is told to say."""

    def __init__(self) -> None:
        self.takes: dict[str, Callable[[str, Any], None]] = {}

    def subscribe(self, kind: str, of: type, take: Callable[[str, Any], None], *_: str) -> None:
        self.takes[kind] = take

    def payload(self, name: str, station: str = "") -> None:
        message = PayloadMessage(alive=True, seen_ns=0, station=station)
        self.takes[bus_messages.PAYLOAD](name, message)


class Parent:
    """A service's parent that starts nothing, on a computer of so many processors."""

    def __init__(self, folder: Path, name: str, most: int = 4) -> None:
        self.bus, self.folder = Heard(), folder
        settings = from_mapping({"name": name, "payloads": {"most": most}}, StationSettings)
        self._parent = serve._Parent(folder, settings, self.bus, None)  # type: ignore[arg-type]

    def localizers(self, *names: str) -> set[str]:
        self._parent._follow_payloads()
        children = self._parent.children
        return {name for name in names if processes.localizer(self.folder, name).name in children}


@pytest.mark.parametrize(("processors", "standing_by"), [(1, 1), (2, 1), (8, 3)])
def test_few_stand_by_for_what_flies_elsewhere(
    processors: int, standing_by: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: processors)
    parent = Parent(tmp_path, "main")
    others = [f"p{k}" for k in range(10)]
    for name in others:
        parent.bus.payload(name, "second")
    parent.bus.payload("own")
    assert parent.localizers("own") == {"own"}
    assert len(parent.localizers(*others)) == standing_by  # of four places one is taken


def test_stations_stand_by_for_different_ones(tmp_path: Path) -> None:
    names = [f"p{k}" for k in range(4)]
    chosen = set()
    for station in range(12):
        parent = Parent(tmp_path, f"station-{station}", 1)
        for name in names:
            parent.bus.payload(name, "another")
        chosen |= parent.localizers(*names)
    assert chosen == set(names)


def test_what_comes_here_is_served_first(tmp_path: Path) -> None:
    parent = Parent(tmp_path, "main", 1)
    parent.bus.payload("a", "second")
    assert parent.localizers("a", "b") == {"a"}
    parent.bus.payload("b")
    assert parent.localizers("a", "b") == {"b"}


def test_one_that_is_gone_keeps_its_own_for_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parent = Parent(tmp_path, "main")
    parent.bus.payload("a")
    now_s = time.monotonic()
    monkeypatch.setattr("time.monotonic", lambda: now_s + 55)
    assert parent.localizers("a") == {"a"}
    monkeypatch.setattr("time.monotonic", lambda: now_s + 65)
    assert parent.localizers("a") == set()
