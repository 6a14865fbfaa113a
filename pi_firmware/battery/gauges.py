"""Opens gauges by URI: `i2c:CHIP@BUS:ADDRESS?options`, `fake:`."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Callable

from pi_firmware import uri
from pi_firmware.battery import chips
from pi_firmware.battery.bus import Counts, Smbus, WordBus
from pi_firmware.battery.cell import Cell
from pi_firmware.battery.chip import Chip, Gauge, Shunt
from pi_firmware.battery.fake import FakeGauge
from pi_firmware.settings import BatterySettings

WHAT = "battery.uri"
_PATH = re.compile(r"([a-z0-9]+)@(\d{1,3}):(0x[0-9a-fA-F]{1,2})")
_SHUNT = ("shunt_ohm", "max_A", "discharge")


def chips_known() -> dict[str, Chip]:
    """The chips that the files in `chips` declare, by name."""
    names = [f"{chips.__name__}.{module.name}" for module in pkgutil.iter_modules(chips.__path__)]
    return {n: c for name in names for n, c in importlib.import_module(name).CHIPS.items()}


def cell_of(settings: BatterySettings) -> Cell:
    """The cell that the settings describe."""
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
