"""The parts: what each weighs, draws and costs in certainty, read from `parts.toml`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hw.quantities import HardwareError
from pi_firmware.wire import config

PARTS_FILE = Path(__file__).with_name("parts.toml")
MIN_UNWEIGHED_SPREAD = 0.2
"""Smallest standard deviation of a part that is marked 'weigh it', as a share of its mass."""

ROLES = (
    "computer", "card", "camera", "cell", "boost", "gauge", "autopilot", "wiring", "mount",
    "fins", "mechanism", "fittings",
)  # fmt: skip
SOURCES = ("datasheet", "measured", "estimated")
_REQUIRED = ("id", "name", "role", "mass_g", "spread_g", "manufacturer", "part_number")


@dataclass(frozen=True)
class Part:
    """One part; masses in g with one standard deviation, currents at its supply's voltage."""

    id: str
    name: str
    role: str = config.key("", "what it is for", choices=ROLES)
    mass_g: float = config.key(0.0, "mass", unit="g", low=0.0, high=1e5)
    spread_g: float = config.key(0.0, "one standard deviation", unit="g", low=0.0, high=1e5)
    source: str = config.key("", "where the mass comes from", choices=SOURCES)
    citation: str = ""
    weigh_it: bool = False
    supply_V: float = config.key(0.0, "its rail", unit="V", low=0.0, high=60.0)
    idle_mA: float = config.key(0.0, "on and waiting", unit="mA", low=0.0, high=1e5)
    stream_mA: float = config.key(0.0, "filming and streaming", unit="mA", low=0.0, high=1e5)
    peak_mA: float = config.key(0.0, "the highest", unit="mA", low=0.0, high=1e5)
    power_citation: str = ""
    manufacturer: str = ""
    part_number: str = ""
    capacity_mAh: float = config.key(0.0, "a cell's", unit="mAh", low=0.0, high=1e6)
    max_discharge_A: float = config.key(0.0, "a cell's, lasting", unit="A", low=0.0, high=1e4)
    cutoff_V: float = config.key(0.0, "a cell's", unit="V", low=0.0, high=4.2)
    efficiency: list[list[float]] = config.key([], "a boost converter's, by input V")
    max_input_A: float = config.key(0.0, "a boost converter's", unit="A", low=0.0, high=1e3)
    series_ohm: float = config.key(0.0, "a gauge's shunt", unit="ohm", low=0.0, high=10.0)
    max_thrust_N: float = config.key(0.0, "propulsion's", unit="N", low=0.0, high=1e3)

    def __post_init__(self) -> None:
        if not self.citation.strip():
            raise ValueError("it has no citation; allowed: the page or reasoning of its mass")
        if max(self.idle_mA, self.stream_mA, self.peak_mA) > 0:
            if not self.power_citation.strip():
                raise ValueError("it draws current without a power_citation")
            if self.supply_V <= 0:
                raise ValueError("it draws current and has no supply_V")
        least = MIN_UNWEIGHED_SPREAD * self.mass_g
        if self.weigh_it and self.spread_g < least - 1e-9:
            raise ValueError(
                f"it is marked weigh_it with a spread of {self.spread_g:g} g;"
                f" allowed: {least:g} g and more, {MIN_UNWEIGHED_SPREAD:.0%} of its mass"
            )
        if self.source == "estimated" and not self.weigh_it:
            raise ValueError("its mass is estimated: it must be marked weigh_it")
        if self.role == "cell" and not (self.capacity_mAh and self.max_discharge_A):
            raise ValueError("a cell needs capacity_mAh and max_discharge_A")
        if self.role == "boost" and not self.efficiency:
            raise ValueError("a boost converter needs its efficiency")
        self._check_efficiency()

    def _check_efficiency(self) -> None:
        rows = self.efficiency
        if any(len(row) != 2 or not 0 < row[1] <= 1 for row in rows):
            raise ValueError("efficiency has rows other than [cell voltage, 0 to 1]")
        if any(a[0] >= b[0] for a, b in pairwise(rows)):
            raise ValueError("efficiency's voltages do not rise")

    @cached_property
    def _curve(self) -> tuple[Any, Any]:
        rows = np.asarray(self.efficiency, float)
        return rows[:, 0], rows[:, 1]

    def efficiency_at(self, cell_V: Any) -> Any:
        """A boost converter's efficiency at input voltages of any shape; held beyond its ends."""
        return np.interp(cell_V, *self._curve)


def load_parts(path: str | Path = PARTS_FILE) -> dict[str, Part]:
    """The parts of a file by id; raises a one-line error that names the part and the key."""
    document = config.read(path)
    unknown = sorted(set(document) - {"part"})
    if unknown:
        raise HardwareError(f"{path}: unknown key {unknown[0]!r} (known here: part)")
    parts: dict[str, Part] = {}
    for number, entry in enumerate(entries_of(document, "part", path), 1):
        name = entry.get("id")
        where = f"{path}: part {name!r:.60}" if isinstance(name, str) else f"{path}: part {number}"
        for name in _REQUIRED:
            if name not in entry:
                raise HardwareError(f"{where}: the key '{name}' is missing")
        if "source" not in entry:
            raise HardwareError(f"{where} has no source; allowed: {', '.join(SOURCES)}")
        part = config.from_mapping(entry, Part, where=where)
        if part.id in parts:
            raise HardwareError(f"{where} stands there twice")
        parts[part.id] = part
    return parts


def entries_of(document: dict[str, Any], key: str, path: str | Path) -> list[dict[str, Any]]:
    """The tables [[key]] of a file that was read; raises `HardwareError` for anything else."""
    entries = document.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise HardwareError(f"{path}: '{key}' must be tables, [[{key}]]")
    return entries


@lru_cache(maxsize=1)
def shipped_parts() -> dict[str, Part]:
    return load_parts()
