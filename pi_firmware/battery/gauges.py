"""Opens gauges by URI: `i2c:CHIP@BUS:ADDRESS?options`, `fake:`."""

from __future__ import annotations

import importlib
import pkgutil
import re
from bisect import bisect
from collections.abc import Callable

from pi_firmware import uri
from pi_firmware.battery import chips
from pi_firmware.battery.cell import Cell
from pi_firmware.battery.chip import Chip, Counts, Gauge, Shunt, Smbus, WordBus, reading
from pi_firmware.settings import BatterySettings
from pi_firmware.uri import Uri
from pi_firmware.wire.messages import Battery

# Rest voltage over charge of a typical LiPo cell; between the points it is a straight line.
_CHARGE = (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
_VOLTAGE_V = (3.27, 3.50, 3.61, 3.69, 3.77, 3.87, 4.02, 4.20)
_RESISTANCE_OHM = 0.08


class FakeGauge:
    """Starts at `percentage` (0 to 1) and would be empty from full after `minutes`."""

    def __init__(self, uri: Uri) -> None:
        uri.only("percentage", "minutes", "capacity_mAh")
        self.counts = Counts()
        if uri.path:
            raise uri.fail(f"takes no path, but options, not {uri.path!r}")
        self._start = uri.number("percentage", 1.0, 0.0, 1.0)
        self._full_s = 60 * uri.number("minutes", 120.0, 0.1, 10_000.0)
        self._capacity_ah = uri.number("capacity_mAh", 600.0, 10.0, 100_000.0) / 1000
        self._start_ns: int | None = None

    def read(self, time_ns: int) -> Battery:
        """The reading at `time_ns`, counted from the first one."""
        if self._start_ns is None:
            self._start_ns = time_ns
        elapsed_s = (time_ns - self._start_ns) / 1e9
        left = min(max(self._start - elapsed_s / self._full_s, 0.0), 1.0)
        current_a = -self._capacity_ah * 3600 / self._full_s if left > 0 else 0.0
        at = min(bisect(_CHARGE, left), len(_CHARGE) - 1)
        beyond = (left - _CHARGE[at - 1]) / (_CHARGE[at] - _CHARGE[at - 1])
        rest_v = _VOLTAGE_V[at - 1] + beyond * (_VOLTAGE_V[at] - _VOLTAGE_V[at - 1])
        return reading(
            time_ns,
            round(rest_v + current_a * _RESISTANCE_OHM, 4),
            charging=False,
            percentage=left,
            current=current_a,
            charge=left * self._capacity_ah,
            capacity=self._capacity_ah,
            design_capacity=self._capacity_ah,
            time_left_s=left * self._full_s,
        )

    def close(self) -> None:
        """Nothing to release."""


WHAT = "battery.uri"
_PATH = re.compile(r"([a-z0-9]+)@(\d{1,3}):(0x[0-9a-fA-F]{1,2})")
_SHUNT = ("shunt_ohm", "max_A", "discharge")


def chips_known() -> dict[str, Chip]:
    """The chips that the files in `chips` declare, by name."""
    names = [f"{chips.__name__}.{module.name}" for module in pkgutil.iter_modules(chips.__path__)]
    return {n: c for name in names for n, c in importlib.import_module(name).CHIPS.items()}


def cell_of(settings: BatterySettings) -> Cell:
    return Cell(
        capacity_ah=settings.capacity_mAh / 1000,
        full_v=settings.full_V,
        resistance_ohm=settings.resistance_mohm / 1000 or None,
        temperature_c=settings.temperature_C,
    )


def open_gauge(text: str, settings: BatterySettings | None = None) -> Gauge:
    """The gauge that a URI names, on the cell of the settings.

    Raises `SourceError` with one line. A chip that does not answer is no error here: it may come
    back, and the flight goes on without it.
    """
    parsed = uri.parse(text, WHAT)
    if parsed.scheme == "fake":
        return FakeGauge(parsed)
    if parsed.scheme == "i2c":
        return _open_i2c(parsed, settings or BatterySettings())
    raise parsed.fail("unknown scheme (available: i2c:, fake:)")


def _open_i2c(parsed: uri.Uri, settings: BatterySettings) -> Gauge:
    known = chips_known()
    match = _PATH.fullmatch(parsed.path)
    if match is None or match[1] not in known:
        raise parsed.fail(
            f"expected i2c:CHIP@BUS:ADDRESS as i2c:ina219@1:0x40 (chips: {', '.join(known)})"
        )
    name, bus, address = match[1], int(match[2]), int(match[3], 16)
    chip = known[name]
    allowed = chip.addresses
    if address not in allowed:
        raise parsed.fail(
            f"address {address:#04x}; allowed for {name}: {allowed[0]:#04x} to {allowed[-1]:#04x}"
        )
    parsed.only(*(_SHUNT if chip.shunt else ()))
    shunt = chip.shunt(parsed) if chip.shunt else Shunt()
    counts = Counts()
    words = WordBus(_opener(parsed, bus), address, f"{name} on i2c-{bus}", counts)
    try:
        return chip.open(words, shunt, counts, settings)
    except ValueError as error:
        raise parsed.fail(str(error)) from None


def _opener(parsed: uri.Uri, number: int) -> Callable[[], Smbus]:
    """Imports smbus2 only now: boards with another gauge need not have it."""
    try:
        import smbus2
    except ImportError:
        raise parsed.fail("needs the Python package smbus2, which is not installed") from None
    return lambda: smbus2.SMBus(number)
