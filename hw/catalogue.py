"""The builds of `builds.toml`: read, checked and put together."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from hw.builds import Build, Conditions, Hull, with_ballast
from hw.parts import Part, entries_of, shipped_parts
from hw.quantities import HardwareError, checked
from pi_firmware.wire import config

BUILDS_FILE = Path(__file__).with_name("builds.toml")


@dataclass(frozen=True)
class _Entry:
    """A table [[build]] as the file has it."""

    name: str
    hull: str
    conditions: str
    about: str = ""
    parts: dict[str, list[str]] = field(default_factory=dict)
    ballast_g: float = 0.0
    ballast_station: str = ""
    ballast_to_mass_g: float | None = None


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
        hull = config.from_mapping(entry, Hull, where=f"{path}: hull {entry.get('id')!r}")
        hulls[hull.id] = hull
    tables = document.get("conditions", {})
    if not isinstance(tables, dict):
        raise HardwareError(f"{path}: 'conditions' must be a table, not {tables!r}")
    days = {
        name: config.from_mapping(entry, Conditions, where=f"{path}: conditions {name!r}")
        for name, entry in tables.items()
    }
    builds: dict[str, Build] = {}
    for entry in entries_of(document, "build", path):
        where = f"{path}: build {entry.get('name')!r}"
        build = _build(config.from_mapping(entry, _Entry, where=where), hulls, days, parts, where)
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


def _build(
    entry: _Entry,
    hulls: dict[str, Hull],
    days: dict[str, Conditions],
    parts: dict[str, Part],
    where: str,
) -> Build:
    hull, day = hulls.get(entry.hull), days.get(entry.conditions)
    if hull is None:
        raise HardwareError(f"{where}: hull {entry.hull!r}; there are: {', '.join(hulls)}")
    if day is None:
        raise HardwareError(
            f"{where}: conditions {entry.conditions!r}; there are: {', '.join(days)}"
        )
    placed = []
    for station, ids in entry.parts.items():
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
    bare = Build(entry.name, entry.about, hull, tuple(placed), day)
    ballast = entry.ballast_g
    if entry.ballast_to_mass_g is not None:
        ballast = entry.ballast_to_mass_g - math.fsum(i.mass_g for i in bare.items)
    if ballast and entry.ballast_station not in hull.stations:
        raise HardwareError(
            f"{where}: ballast_station {entry.ballast_station!r} is not one of the hull's"
        )
    return with_ballast(bare, checked("ballast_g", ballast), entry.ballast_station)
