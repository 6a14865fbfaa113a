"""Register-exact gauges on a simulated cell, behind the calls of `smbus2.SMBus`.

What runs on top of them is the driver that flies. Registers, resets and conversions are those of
the datasheets named in the firmware's `ina` and `max17048`; words come as SMBus gives them, low
byte first.
"""

from __future__ import annotations

import errno
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pi_firmware.battery.cell import Cell, Polarization
from pi_firmware.battery.chip import Shunt, swap
from pi_firmware.battery.chips import ina, max17048


class SimulatedCell:
    """A cell under a load, advanced by `draw`; `charge` is the truth, 0 to 1."""

    def __init__(self, cell: Cell, charge: float = 1.0) -> None:
        self.cell, self.charge = cell, charge
        self.discharge_a = 0.0
        self._polarization = Polarization(cell)

    @property
    def voltage(self) -> float:
        """At the terminals, under the load."""
        series_v = self.cell.series_ohm(self.charge) * self.discharge_a
        return max(self.cell.rest_v(self.charge) - series_v - self._polarization.total_v, 0.0)

    def draw(self, discharge_a: float, dt_s: float) -> None:
        """Lets a constant current flow for `dt_s`; an empty cell gives none."""
        self.discharge_a = discharge_a if self.charge > 0 else 0.0
        counted = self.discharge_a * dt_s / 3600 / self.cell.capacity_ah
        self.charge = min(max(self.charge - counted, 0.0), 1.0)
        self._polarization.step(self.charge, self.discharge_a, dt_s)


class Chip(Protocol):
    """Registers, most significant byte first."""

    def read(self, register: int) -> int: ...

    def write(self, register: int, value: int) -> None: ...


class _InaChip:
    """What both chips have: `voltage`, V, and `shunt_v` from IN+ to IN- are what they measure."""

    AFTER_RESET: int
    """The configuration after power-on; which of its bits can be set, which are always."""
    SETTABLE: int
    FIXED = 0
    CALIBRATION_BITS: int

    def __init__(self) -> None:
        self.voltage, self.shunt_v = 0.0, 0.0
        self.reset()

    def reset(self) -> None:
        """As after power-on."""
        self._configuration, self._calibration = self.AFTER_RESET, 0

    def write(self, register: int, value: int) -> None:
        """Sets a register; the others are read-only."""
        if register == ina.CONFIGURATION and value & ina.RESET:
            self.reset()
        elif register == ina.CONFIGURATION:
            self._configuration = value & self.SETTABLE | self.FIXED
        elif register == ina.CALIBRATION:
            self._calibration = value & self.CALIBRATION_BITS


class Ina219Chip(_InaChip):
    """Its `voltage` is at IN-."""

    AFTER_RESET, SETTABLE, CALIBRATION_BITS = 0x399F, 0x3FFF, 0xFFFE

    def read(self, register: int) -> int:
        """A register's value."""
        full = round((0.04, 0.08, 0.16, 0.32)[self._configuration >> 11 & 3] / 10e-6)
        shunt = _clip(round(self.shunt_v / 10e-6), -full, full)
        top = 8000 if self._configuration & 0x2000 else 4000  # 32 V or 16 V
        bus = _clip(round(self.voltage / 4e-3), 0, top)
        current = shunt * self._calibration // 4096 if shunt >= 0 else (
            -(-shunt * self._calibration // 4096)
        )  # fmt: skip
        overflow = not -0x8000 <= current <= 0x7FFF
        values = {
            ina.CONFIGURATION: self._configuration,
            ina.SHUNT_VOLTAGE: shunt,
            ina.BUS_VOLTAGE: bus << 3 | 0x2 | overflow,
            ina.POWER: abs(current) * bus // 5000,
            ina.CURRENT: current,
            ina.CALIBRATION: self._calibration,
        }
        return values.get(register, 0) & 0xFFFF


class Ina226Chip(_InaChip):
    """Its `voltage` is at VBUS."""

    AFTER_RESET, SETTABLE, FIXED, CALIBRATION_BITS = 0x4127, 0x0FFF, 0x4000, 0x7FFF

    def read(self, register: int) -> int:
        """A register's value."""
        shunt = _clip(round(self.shunt_v / 2.5e-6), -0x8000, 0x7FFF)
        bus = _clip(round(self.voltage / 1.25e-3), 0, 0x7FFF)
        current = _clip(int(shunt * self._calibration / 2048), -0x8000, 0x7FFF)
        values = {
            ina.CONFIGURATION: self._configuration,
            ina.SHUNT_VOLTAGE: shunt,
            ina.BUS_VOLTAGE: bus,
            ina.POWER: abs(current) * bus // 20000,
            ina.CURRENT: current,
            ina.CALIBRATION: self._calibration,
            ina.MANUFACTURER_ID: 0x5449,
            ina.DIE_ID: 0x2260,
        }
        return values.get(register, 0) & 0xFFFF


class Max17048Chip:
    """`voltage`, V, `share`, 0 to 1, and `rate_per_h` are what it says."""

    def __init__(self) -> None:
        self.voltage, self.share, self.rate_per_h = 0.0, 1.0, 0.0
        self.reset()

    def reset(self) -> None:
        """As after power-on."""
        self._config, self._status = 0x971C, max17048.RESET_INDICATOR

    def read(self, register: int) -> int:
        """A register's value."""
        values = {
            max17048.VCELL: _clip(round(self.voltage / 78.125e-6), 0, 0xFFFF),
            max17048.SOC: _clip(round(self.share * 100 * 256), 0, 0xFFFF),
            max17048.VERSION: 0x0012,
            max17048.CONFIG: self._config,
            max17048.CRATE: round(self.rate_per_h * 100 / 0.208),
            max17048.STATUS: self._status,
        }
        return values.get(register, 0) & 0xFFFF

    def write(self, register: int, value: int) -> None:
        """Sets a register; the others are read-only."""
        if register == max17048.CONFIG:
            self._config = value
        elif register == max17048.STATUS:
            self._status = value


@dataclass
class Faults:
    """What goes wrong: every n-th read fails with errno 121 or gives `nonsense`; 0: never.

    With SDA held low each transfer ends with errno 110 after `stuck_s`; the kernel waits for 1 s.
    """

    absent: bool = False
    fail_every: int = 0
    nonsense_every: int = 0
    nonsense: int = 0xFFFF
    stuck_s: float | None = None


class FakeBus:
    """One chip at one address; elsewhere nobody answers (errno 121)."""

    def __init__(self, chip: Chip, address: int, faults: Faults | None = None) -> None:
        self._chip, self._address = chip, address
        self.faults = faults or Faults()
        self.reads = self.timeouts = 0

    def read_word_data(self, i2c_addr: int, register: int) -> int:
        """As `smbus2.SMBus.read_word_data`."""
        self._acknowledge(i2c_addr)
        self.reads += 1
        faults = self.faults
        if faults.fail_every and self.reads % faults.fail_every == 0:
            raise OSError(errno.EREMOTEIO, "Remote I/O error")
        if faults.nonsense_every and self.reads % faults.nonsense_every == 0:
            return faults.nonsense
        return swap(self._chip.read(register))

    def write_word_data(self, i2c_addr: int, register: int, value: int) -> None:
        """As `smbus2.SMBus.write_word_data`."""
        self._acknowledge(i2c_addr)
        self._chip.write(register, swap(value))

    def close(self) -> None:
        """Nothing to release."""

    def _acknowledge(self, address: int) -> None:
        if self.faults.stuck_s is not None:
            self.timeouts += 1
            time.sleep(self.faults.stuck_s)
            raise OSError(errno.ETIMEDOUT, "Connection timed out")
        if self.faults.absent or address != self._address:
            raise OSError(errno.EREMOTEIO, "Remote I/O error")


class FlyingBus(FakeBus):
    """A fake bus whose chip sits on a cell that discharges with a clock, seconds."""

    def __init__(
        self,
        chip: Ina219Chip | Ina226Chip | Max17048Chip,
        address: int,
        faults: Faults,
        *,
        cell: SimulatedCell,
        discharge_a: float,
        shunt: Shunt,
        clock: Callable[[], float],
    ) -> None:
        super().__init__(chip, address, faults)
        self._gauge, self._cell, self._shunt = chip, cell, shunt
        self._discharge_a, self._clock = discharge_a, clock
        self._last_s = clock()

    def read_word_data(self, i2c_addr: int, register: int) -> int:
        """Lets the cell discharge up to now, then reads."""
        now_s = self._clock()
        self._cell.draw(self._discharge_a, now_s - self._last_s)
        self._last_s = now_s
        connect(self._gauge, self._cell, self._shunt)
        return super().read_word_data(i2c_addr, register)


def connect(
    chip: Ina219Chip | Ina226Chip | Max17048Chip, cell: SimulatedCell, shunt: Shunt
) -> None:
    """Puts a cell's voltage and current before a chip."""
    chip.voltage = cell.voltage
    if isinstance(chip, Max17048Chip):
        chip.share, chip.rate_per_h = cell.charge, -cell.discharge_a / cell.cell.capacity_ah
        return
    through_a = cell.discharge_a if shunt.discharge_positive else -cell.discharge_a
    chip.shunt_v = through_a * shunt.resistance_ohm
    if isinstance(chip, Ina219Chip) and shunt.discharge_positive:
        chip.voltage -= chip.shunt_v


CHIPS: dict[str, Callable[[], Ina219Chip | Ina226Chip | Max17048Chip]] = {
    "ina219": Ina219Chip,
    "ina226": Ina226Chip,
    "max17048": Max17048Chip,
}


def flying_bus(
    name: str,
    address: int,
    cell: Cell,
    *,
    charge: float = 1.0,
    load_a: float,
    faults: Faults | None = None,
) -> FlyingBus:
    """A bus with the chip of this name, on a cell that discharges from now on."""
    return FlyingBus(
        CHIPS[name](),
        address,
        faults or Faults(),
        cell=SimulatedCell(cell, charge),
        discharge_a=load_a,
        shunt=Shunt(),
        clock=time.monotonic,
    )


def _clip(value: int, low: int, high: int) -> int:
    return max(low, min(high, value))
