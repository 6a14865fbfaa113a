"""The builds of `builds.toml`: read, checked and put together."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from hw.builds import Build, Conditions, Hull, with_ballast
from hw.errors import HardwareError
from hw.parts import Part, entries_of, shipped_parts
from hw.quantities import checked
from pi_firmware.wire import config

BUILDS_FILE = Path(__file__).with_name("builds.toml")
_BUILD_KEYS = ("name", "about", "hull", "parts", "conditions", "ballast_g", "ballast_station",
               "ballast_to_mass_g")  # fmt: skip


@dataclass(frozen=True)
class Catalogue:
    """The builds of one file."""

    builds: dict[str, Build]
    default: str
    simulated: str

    def named(self, name: str | None) -> Build:
        """A build by name, the default for None; raises `HardwareError`."""
        name = name or self.default
        if name not in self.builds:
            known = ", ".join(self.builds)
            raise HardwareError(f"build {name!r} is unknown; there are: {known}")
        return self.builds[name]


def load_builds(path: str | Path = BUILDS_FILE) -> Catalogue:
    """The hulls and builds of a file; raises a one-line error that names the build and the key."""
    document, parts = config.read(path), shipped_parts()
    known = {"default", "simulated", "conditions", "hull", "build"}
    unknown = sorted(set(document) - known)
    if unknown:
        raise HardwareError(f"{path}: unknown key {unknown[0]!r}")
    hulls: dict[str, Hull] = {}
    for entry in entries_of(document, "hull", path):
        where = f"{path}: hull {entry.get('id')!r}"
        entry = dict(entry)
        stations = _stations(entry.pop("stations", {}), where)
        entry_hull = config.from_mapping(entry, Hull, where=where)
        hulls[entry_hull.id] = _with_stations(entry_hull, stations)
    days = {
        name: config.from_mapping(entry, Conditions, where=f"{path}: conditions {name!r}")
        for name, entry in _table(document, "conditions", str(path)).items()
    }
    builds: dict[str, Build] = {}
    for entry in entries_of(document, "build", path):
        where = f"{path}: build {entry.get('name')!r}"
        build = _build(entry, hulls, days, parts, where)
        if build.name in builds:
            raise HardwareError(f"{where} stands there twice")
        builds[build.name] = build
    for key in ("default", "simulated"):
        if str(document.get(key)) not in builds:
            raise HardwareError(f"{path}: '{key}' is {document.get(key)!r}, which is no build here")
    return Catalogue(builds, document["default"], document["simulated"])


@lru_cache(maxsize=1)
def shipped_builds() -> Catalogue:
    """The builds that ship, read once."""
    return load_builds()


def _table(document: dict[str, Any], key: str, where: str) -> dict[str, Any]:
    table = document.get(key, {})
    if not isinstance(table, dict):
        raise HardwareError(f"{where}: '{key}' must be a table, not {table!r}")
    return table


def _number(entry: dict[str, Any], key: str, where: str) -> float:
    value = entry.get(key, 0.0)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise HardwareError(f"{where}: '{key}' must be a number, not {value!r}")
    return float(value)


def _stations(entry: Any, where: str) -> dict[str, tuple[float, float]]:
    stations = {}
    for name, place in entry.items() if isinstance(entry, dict) else ():
        good = isinstance(place, list) and len(place) == 2
        if not good or not all(isinstance(v, int | float) and abs(v) <= 50 for v in place):
            raise HardwareError(f"{where}: station {name!r} must be [forward m, up m], -50 to 50")
        stations[name] = (float(place[0]), float(place[1]))
    if not stations:
        raise HardwareError(f"{where}: it has no stations")
    return stations


def _with_stations(hull: Hull, stations: dict[str, tuple[float, float]]) -> Hull:
    hull.stations.update(stations)
    return hull


def _build(
    entry: dict[str, Any],
    hulls: dict[str, Hull],
    days: dict[str, Conditions],
    parts: dict[str, Part],
    where: str,
) -> Build:
    known = ", ".join(_BUILD_KEYS)
    unknown = sorted(set(entry) - set(_BUILD_KEYS))
    if unknown:
        raise HardwareError(f"{where}: unknown key {unknown[0]!r} (known here: {known})")
    hull = hulls.get(str(entry.get("hull")))
    if hull is None:
        raise HardwareError(f"{where}: hull {entry.get('hull')!r}; there are: {', '.join(hulls)}")
    placed = []
    for station, ids in _table(entry, "parts", where).items():
        if not isinstance(ids, list):
            raise HardwareError(f"{where}: parts.{station} must be a list of ids, not {ids!r}")
        if station not in hull.stations:
            raise HardwareError(
                f"{where}: station {station!r}; the hull has: {', '.join(hull.stations)}"
            )
        for part_id in ids:
            if not isinstance(part_id, str) or part_id not in parts:
                raise HardwareError(f"{where}: part {part_id!r} is not in parts.toml")
            placed.append((parts[part_id], station))
    conditions = days.get(str(entry.get("conditions")))
    if conditions is None:
        day = entry.get("conditions")
        raise HardwareError(f"{where}: conditions {day!r}; there are: {', '.join(days)}")
    station = str(entry.get("ballast_station", ""))
    ballast = _number(entry, "ballast_g", where)
    bare = Build(str(entry.get("name", "")), str(entry.get("about", "")), hull, tuple(placed),
                 conditions)  # fmt: skip
    if "ballast_to_mass_g" in entry:
        ballast = _number(entry, "ballast_to_mass_g", where) - math.fsum(
            i.mass_g for i in bare.items
        )
    if ballast and station not in hull.stations:
        raise HardwareError(f"{where}: ballast_station {station!r} is not one of the hull's")
    return with_ballast(bare, checked("ballast_g", ballast), station)
