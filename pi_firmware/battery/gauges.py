"""Opens gauges by URI: `i2c:CHIP@BUS:ADDRESS?options`, `fake:`."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Protocol

from pi_firmware import uri
from pi_firmware.battery import simulated
from pi_firmware.battery.bus import Counts, Smbus, WordBus
from pi_firmware.battery.cell import Cell
from pi_firmware.battery.fake import FakeGauge
from pi_firmware.battery.ina import Ina219, Ina226, Shunt
from pi_firmware.battery.max17048 import Max17048
from pi_firmware.settings import BatterySettings
from pi_firmware.wire.messages import Battery

WHAT = "battery.uri"
_PATH = re.compile(r"(ina219|ina226|max17048)@(\d{1,3}|fake):(0x[0-9a-fA-F]{1,2})")
_ADDRESSES = {
    "ina219": range(0x40, 0x50),
    "ina226": range(0x40, 0x50),
    "max17048": range(0x36, 0x37),
}
_SHUNT = ("shunt_ohm", "max_A", "discharge")
# What the boards sold with these chips have: 0.1 ohm. The INA226 measures up to 82 mV only.
_MAX_A = {"ina219": 3.0, "ina226": 0.8}
_FAULTS = ("percentage", "load_A", "absent", "fail_every", "nonsense_every", "nonsense")


class Gauge(Protocol):
    """Anything that can say how much charge is left, or voltage and current to find it from."""

    counts: Counts

    def read(self, time_ns: int) -> Battery:
        """One reading, stamped with the payload's clock; raises `GaugeError` without one."""
        ...

    def close(self) -> None:
        """Releases the device; the next reading opens it again."""
        ...


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
    match = _PATH.fullmatch(parsed.path)
    if match is None:
        raise parsed.fail(
            "expected i2c:CHIP@BUS:ADDRESS as i2c:ina219@1:0x40 (chips: ina219, ina226, max17048)"
        )
    chip, bus, address = match[1], match[2], int(match[3], 16)
    allowed = _ADDRESSES[chip]
    if address not in allowed:
        raise parsed.fail(
            f"address {address:#04x}; allowed for {chip}: {allowed[0]:#04x} to {allowed[-1]:#04x}"
        )
    shunted = chip != "max17048"
    parsed.only(*(_SHUNT if shunted else ()), *(_FAULTS if bus == "fake" else ()))
    shunt = _shunt(parsed, chip) if shunted else Shunt()
    counts = Counts()
    if bus == "fake":
        fake = _fake_bus(parsed, chip, address, shunt, cell_of(settings))
        words = WordBus(lambda: fake, address, chip, counts)
    else:
        words = WordBus(_opener(parsed, int(bus)), address, f"{chip} on i2c-{bus}", counts)
    if chip == "max17048":
        return Max17048(words, counts, settings.capacity_mAh / 1000, settings.temperature_C)
    try:
        return (Ina219 if chip == "ina219" else Ina226)(words, shunt, counts)
    except ValueError as error:
        raise parsed.fail(str(error)) from None


def _shunt(parsed: uri.Uri, chip: str) -> Shunt:
    return Shunt(
        resistance_ohm=parsed.number("shunt_ohm", 0.1, 0.0005, 10.0),
        max_A=parsed.number("max_A", _MAX_A[chip], 0.01, 100.0),
        discharge_positive=parsed.choice("discharge", "positive", ("positive", "negative"))
        == "positive",
    )


def _opener(parsed: uri.Uri, number: int) -> Callable[[], Smbus]:
    """Imports smbus2 only now: boards with another gauge need not have it."""
    try:
        import smbus2
    except ImportError:
        raise parsed.fail("needs the Python package smbus2, which is not installed") from None
    return lambda: smbus2.SMBus(number)


def _fake_bus(
    parsed: uri.Uri, chip: str, address: int, shunt: Shunt, cell: Cell
) -> simulated.FlyingBus:
    faults = simulated.Faults(
        absent=bool(parsed.number("absent", 0, 0, 1)),
        fail_every=int(parsed.number("fail_every", 0, 0, 1e6)),
        nonsense_every=int(parsed.number("nonsense_every", 0, 0, 1e6)),
        nonsense=int(parsed.number("nonsense", 0xFFFF, 0, 0xFFFF)),
    )
    return simulated.FlyingBus(
        simulated.CHIPS[chip](),
        address,
        faults,
        cell=simulated.SimulatedCell(cell, parsed.number("percentage", 1.0, 0.0, 1.0)),
        discharge_a=parsed.number("load_A", 0.5 * cell.capacity_ah, 0.0, 100.0),
        shunt=shunt,
        clock=time.monotonic,
    )
