"""Which payloads have a localizer: those that fly here, and a few that fly with other stations."""

import time
from pathlib import Path

import pytest
from station_notes import SilentBus

from ground_station.service import bus_messages, processes, serve
from ground_station.service.bus_messages import PayloadMessage
from ground_station.service.settings import StationSettings
from pi_firmware.wire.config import from_mapping


class Parent:
    """A service's parent that starts nothing, on a computer of so many processors."""

    def __init__(self, folder: Path, name: str, most: int = 4) -> None:
        self._bus, self.folder = SilentBus(), folder
        settings = from_mapping({"name": name, "payloads": {"most": most}}, StationSettings)
        self._parent = serve._Parent(folder, settings, self._bus, None)  # type: ignore[arg-type]

    def hears(self, name: str, station: str = "") -> None:
        """A payload lives, and flies here or with another station."""
        message = PayloadMessage(alive=True, seen_ns=0, station=station)
        self._bus.put(bus_messages.PAYLOAD, name, message)

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
        parent.hears(name, "second")
    parent.hears("own")
    assert parent.localizers("own") == {"own"}
    assert len(parent.localizers(*others)) == standing_by  # of four places one is taken


def test_stations_stand_by_for_different_ones(tmp_path: Path) -> None:
    names = [f"p{k}" for k in range(4)]
    chosen = set()
    for station in range(12):
        parent = Parent(tmp_path, f"station-{station}", 1)
        for name in names:
            parent.hears(name, "another")
        chosen |= parent.localizers(*names)
    assert chosen == set(names)


def test_what_comes_here_is_served_first(tmp_path: Path) -> None:
    parent = Parent(tmp_path, "main", 1)
    parent.hears("a", "second")
    assert parent.localizers("a", "b") == {"a"}
    parent.hears("b")
    assert parent.localizers("a", "b") == {"b"}


def test_one_that_is_gone_keeps_its_own_for_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parent = Parent(tmp_path, "main")
    parent.hears("a")
    now_s = time.monotonic()
    monkeypatch.setattr("time.monotonic", lambda: now_s + 55)
    assert parent.localizers("a") == {"a"}
    monkeypatch.setattr("time.monotonic", lambda: now_s + 65)
    assert parent.localizers("a") == set()
