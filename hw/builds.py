"""Builds: a hull, the parts that hang under it and where, and the day on which it flies.

Those that ship are read from `builds.toml`, checked and put together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

from hw import envelopes, gases
from hw.envelopes import Envelope
from hw.parts import SOURCES, Part, entries_of, shipped_parts
from hw.quantities import HardwareError, checked
from pi_firmware.wire import config

UNCERTAIN = ("temperature_C", "pressure_hPa", "humidity_percent", "purity_percent",
             "superpressure_Pa", "leak_percent_per_day")  # fmt: skip


@dataclass(frozen=True)
class Conditions:
    """Air and gas on the day; or both densities themselves, which then have no spread.

    Every `x_sigma_unit` is one standard deviation. `altitude_m` takes the standard atmosphere's
    pressure there. Raises `HardwareError` for what is outside its range.
    """

    temperature_C: float = 20.0
    temperature_sigma_C: float = 0.0
    pressure_hPa: float = gases.STANDARD_PRESSURE_HPA
    pressure_sigma_hPa: float = 0.0
    altitude_m: float | None = None
    humidity_percent: float = 0.0
    humidity_sigma_percent: float = 0.0
    purity_percent: float = 97.0
    purity_sigma_percent: float = 0.0
    superpressure_Pa: float = 0.0
    superpressure_sigma_Pa: float = 0.0
    leak_percent_per_day: float = 0.0
    leak_sigma_percent_per_day: float = 0.0
    days: float = 0.0
    air_kg_m3: float | None = None
    helium_kg_m3: float | None = None

    def __post_init__(self) -> None:
        for name in (*UNCERTAIN, "days"):
            checked(name, getattr(self, name))
        for name in ("altitude_m", "air_kg_m3", "helium_kg_m3"):
            if getattr(self, name) is not None:
                checked(name, getattr(self, name))
        for name in UNCERTAIN:
            sigma = self.sigma_of(name)
            if not (math.isfinite(sigma) and sigma >= 0):
                raise HardwareError(f"the sigma of {name} is {sigma:g}; allowed: 0 and more")

    @property
    def outside_hPa(self) -> float:
        """The air's pressure: the altitude's where one is given."""
        if self.altitude_m is not None:
            return gases.pressure_at_altitude(self.altitude_m)
        return self.pressure_hPa

    def sigma_of(self, name: str) -> float:
        """The standard deviation of an input that has one."""
        stem, _, unit = name.partition("_")
        return float(getattr(self, f"{stem}_sigma_{unit}"))

    @property
    def densities_kg_m3(self) -> tuple[float, float]:
        """Of the air and of what is in the envelope."""
        air, helium = self.air_kg_m3, self.helium_kg_m3
        t, p = self.temperature_C, self.outside_hPa
        if air is None:
            air = gases.air_kg_m3(t, p, self.humidity_percent)
        if helium is None:
            helium = gases.helium_kg_m3(t, p, self.purity_percent, self.superpressure_Pa)
        return air, helium

    @property
    def gas_left(self) -> float:
        """The share of the filling that is still there: the leak compounds day by day."""
        return float((1 - self.leak_percent_per_day / 100) ** self.days)


@dataclass(frozen=True)
class Hull:
    """An envelope with its film, what the air does to it, and places on it.

    A measured `free_lift_g` (filled envelope alone, by a scale) replaces volume, gas and film.
    """

    id: str
    name: str
    shape: str = config.key("", "form", choices=envelopes.SHAPES)
    length_m: float = 0.0
    width_m: float = 0.0
    diameter_m: float = 0.0
    volume_sigma_percent: float = 0.0
    film_g_m2: float = 0.0
    film_spread_g_m2: float = 0.0
    film_source: str = config.key("", "where it comes from", choices=SOURCES)
    film_citation: str = ""
    free_lift_g: float | None = None
    free_lift_spread_g: float = 0.0
    drag_axial: float = config.key(1.0, "on the frontal area", low=0.01, high=10)
    drag_lateral: float = config.key(1.0, "on the side area", low=0.01, high=10)
    added_axial: float = config.key(0.5, "added over displaced mass", low=0, high=5)
    added_lateral: float = config.key(0.5, "added over displaced mass", low=0, high=5)
    swing_damping: float = config.key(0.1, "damping ratio", low=0, high=1)
    dynamics_citation: str = ""
    camera_tilt_down_deg: float = config.key(0.0, "camera", unit="deg", low=-90, high=90)
    stations: dict[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checked("film_g_m2", self.film_g_m2)
        checked("volume_sigma_percent", self.volume_sigma_percent)
        if not self.film_citation.strip():
            raise ValueError("its film has no citation; allowed: the page or reasoning")
        if not math.isfinite(self.film_spread_g_m2) or self.film_spread_g_m2 < 0:
            raise ValueError(f"film_spread_g_m2 is {self.film_spread_g_m2:g}; allowed: 0 and more")
        if self.free_lift_g is not None:
            checked("free_lift_g", self.free_lift_g)
        for name, place in self.stations.items():
            good = isinstance(place, list | tuple) and len(place) == 2
            if not good or not all(isinstance(v, int | float) and abs(v) <= 50 for v in place):
                raise ValueError(f"station {name!r} must be [forward m, up m], -50 to 50")
            self.stations[name] = (float(place[0]), float(place[1]))
        _ = self.envelope  # refused now, not when it is first asked for

    @property
    def envelope(self) -> Envelope:
        """Its filled shape."""
        return envelopes.of_shape(self.shape, self.length_m, self.width_m, self.diameter_m)


@dataclass(frozen=True)
class Item:
    """One line of the mass budget; where it sits, forward and up of the centre of buoyancy."""

    name: str
    role: str
    mass_g: float
    spread_g: float
    source: str
    x_m: float
    z_m: float


@dataclass(frozen=True)
class Build:
    """Everything that flies, as one."""

    name: str
    about: str
    hull: Hull
    placed: tuple[tuple[Part, str], ...]
    """Each part with the name of its station, as often as it is there."""
    conditions: Conditions
    ballast_g: float = 0.0
    ballast_station: str = ""

    def part(self, role: str, station: str | None = None) -> Part | None:
        """The first part of a role, at a station or anywhere; None without one."""
        for part, place in self.placed:
            if part.role == role and station in (None, place):
                return part
        return None

    @property
    def payload(self) -> tuple[Part, ...]:
        """The parts in gondola and camera bracket: what the payload's own cell feeds."""
        return tuple(part for part, place in self.placed if place in ("gondola", "camera"))

    @property
    def items(self) -> tuple[Item, ...]:
        """The mass budget: film first, then each part, then the ballast; helium is not in it.

        The film's weight is at the centre of buoyancy. With a measured free lift it is in that.
        """
        hull, items = self.hull, []
        if hull.free_lift_g is None:
            m2 = hull.envelope.film_m2
            items.append(
                Item("envelope film", "envelope", m2 * hull.film_g_m2, m2 * hull.film_spread_g_m2,
                     hull.film_source, 0.0, 0.0)
            )  # fmt: skip
        for part, place in self.placed:
            x, z = hull.stations[place]
            items.append(Item(part.name, part.role, part.mass_g, part.spread_g, part.source, x, z))
        if self.ballast_g:
            x, z = hull.stations[self.ballast_station]
            items.append(Item("ballast", "ballast", self.ballast_g, 0.0, "measured", x, z))
        return tuple(items)

    @property
    def mass_g(self) -> float:
        """All of it but the helium; rounded to a microgram, so that no binary dust is flown."""
        return round(math.fsum(item.mass_g for item in self.items), 6)


def with_ballast(build: Build, ballast_g: float, station: str = "") -> Build:
    """The same build with this ballast; at the gondola where no station is said."""
    where = station or build.ballast_station or "gondola"
    return replace(build, ballast_g=ballast_g, ballast_station=where)


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
