"""INA219 and INA226, Texas Instruments' current and voltage monitors.

Registers, bits and equations are those of the datasheets SBOS448G (INA219) and SBOS547B (INA226).
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from pi_firmware.battery.chip import Chip, Counts, GaugeError, Shunt, WordBus, reading, signed
from pi_firmware.uri import Uri
from pi_firmware.wire.messages import Battery

CONFIGURATION, SHUNT_VOLTAGE, BUS_VOLTAGE, POWER, CURRENT, CALIBRATION = range(6)
MANUFACTURER_ID, DIE_ID = 0xFE, 0xFF
RESET = 0x8000
_INA219_RANGES_V = (0.04, 0.08, 0.16, 0.32)  # of the programmable gain 1, 1/2, 1/4, 1/8


class _Ina(ABC):
    """What both chips have: a bus, a shunt, and settings that are written before the first read."""

    FULL_SCALE_V: float
    _configuration: int
    _calibration: int

    def __init__(self, bus: WordBus, shunt: Shunt, counts: Counts) -> None:
        _check_range(shunt, self.FULL_SCALE_V)
        self._bus, self._shunt, self.counts = bus, shunt, counts
        self._ready = False

    def close(self) -> None:
        self._ready = False
        self._bus.close()

    @abstractmethod
    def _reset(self) -> None:
        """Resets the chip; raises `GaugeError` where it is another one."""

    def _words(self) -> tuple[int, int, int]:
        """Shunt voltage, bus voltage and current as the registers have them, the first and last
        signed; what a chip says that a dip of its supply has reset is refused.
        """
        if not self._ready:
            self._reset()
            self._bus.write(CONFIGURATION, self._configuration)
            self._bus.write(CALIBRATION, self._calibration)
            self._ready = True
        drop = signed(self._bus.read(SHUNT_VOLTAGE))
        bus = self._bus.read(BUS_VOLTAGE)
        current = signed(self._bus.read(CURRENT))
        settings = self._bus.read(CONFIGURATION), self._bus.read(CALIBRATION)
        if settings != (self._configuration, self._calibration):
            self._ready = False
            self.counts.resets += 1
            raise self.counts.refuse("the gauge has lost its settings; it is set up again")
        return drop, bus, current

    def _reading(self, time_ns: int, voltage: float, through_shunt_a: float) -> Battery:
        outwards = self._shunt.discharge_positive
        current = -through_shunt_a if outwards else through_shunt_a
        return reading(time_ns, voltage, charging=current > 0, current=current)


class Ina219(_Ina):
    """Voltage of the cell and its current, averaged over 128 samples (68 ms).

    Raises `ValueError` for a shunt that the chip cannot measure at `max_A`.
    """

    FULL_SCALE_V = 0.32
    AFTER_RESET = 0x399F

    def __init__(self, bus: WordBus, shunt: Shunt, counts: Counts) -> None:
        super().__init__(bus, shunt, counts)
        drop_v = shunt.max_A * shunt.resistance_ohm
        self._gain = next(i for i, v in enumerate(_INA219_RANGES_V) if drop_v <= v * (1 + 1e-9))
        # 16 V range; both converters 12 bit with 128 samples; continuous.
        self._configuration = self._gain << 11 | 0xF << 7 | 0xF << 3 | 0x7
        self._calibration = ina219_calibration(shunt.max_A / 2**15, shunt.resistance_ohm)
        self._lsb_a = 0.04096 / (self._calibration * shunt.resistance_ohm)

    def read(self, time_ns: int) -> Battery:
        """One reading; raises `GaugeError` when there is none that can be believed."""
        drop, bus, current = self._words()
        if bus & 0x1:
            raise self.counts.refuse("ina219: the current is beyond the calibrated range")
        if abs(drop) >= round(_INA219_RANGES_V[self._gain] / 10e-6):
            raise self.counts.refuse("ina219: the shunt's voltage is beyond the range")
        _check_agreement(self.counts, current, drop * self._calibration / 4096)
        # The chip measures at IN-, behind the shunt; the cell is before it while discharging.
        voltage = ina219_bus_voltage(bus)
        if self._shunt.discharge_positive:
            voltage += drop * 10e-6
        return self._reading(time_ns, voltage, current * self._lsb_a)

    def _reset(self) -> None:
        self._bus.write(CONFIGURATION, RESET)
        found = self._bus.read(CONFIGURATION)
        if found != self.AFTER_RESET:
            raise GaugeError(
                f"ina219: after a reset its configuration is {found:#06x},"
                f" not {self.AFTER_RESET:#06x}: another chip, or a disturbed bus"
            )


class Ina226(_Ina):
    """Voltage at the pin VBUS and the current, averaged over 16 samples (35 ms).

    Raises `ValueError` for a shunt that the chip cannot measure at `max_A`.
    """

    FULL_SCALE_V = 0.08192
    MANUFACTURER, DIE = 0x5449, 0x2260

    def __init__(self, bus: WordBus, shunt: Shunt, counts: Counts) -> None:
        super().__init__(bus, shunt, counts)
        self._configuration = 0x4127 | 0b010 << 9  # as after a reset, but 16 averages
        self._calibration = ina226_calibration(shunt.max_A / 2**15, shunt.resistance_ohm)
        self._lsb_a = 0.00512 / (self._calibration * shunt.resistance_ohm)

    def read(self, time_ns: int) -> Battery:
        """One reading; raises `GaugeError` when there is none that can be believed."""
        drop, bus, current = self._words()
        if drop in (-0x8000, 0x7FFF):
            raise self.counts.refuse("ina226: the shunt's voltage is beyond the range")
        _check_agreement(self.counts, current, drop * self._calibration / 2048)
        return self._reading(time_ns, ina226_bus_voltage(bus), current * self._lsb_a)

    def _reset(self) -> None:
        found = self._bus.read(MANUFACTURER_ID), self._bus.read(DIE_ID)
        if found != (self.MANUFACTURER, self.DIE):
            raise GaugeError(
                f"ina226: its identity is {found[0]:#06x} {found[1]:#06x},"
                f" not {self.MANUFACTURER:#06x} {self.DIE:#06x}: another chip"
            )
        self._bus.write(CONFIGURATION, RESET)


def ina219_calibration(current_lsb_a: float, resistance_ohm: float) -> int:
    """Equation 1 of SBOS448G: trunc(0.04096 / (Current_LSB · R)); bit 0 is always 0 in the chip."""
    return min(int(0.04096 / (current_lsb_a * resistance_ohm) + 1e-9), 0xFFFF) & 0xFFFE


def ina219_bus_voltage(register: int) -> float:
    """Volts of the INA219's bus voltage register: 4 mV a bit, in bits 3 to 15."""
    return (register >> 3) * 4e-3


def ina226_calibration(current_lsb_a: float, resistance_ohm: float) -> int:
    """Equation 1 of SBOS547B: trunc(0.00512 / (Current_LSB · R)), of 15 bits."""
    return min(int(0.00512 / (current_lsb_a * resistance_ohm) + 1e-9), 0x7FFF)


def ina226_bus_voltage(register: int) -> float:
    """Volts of the INA226's bus voltage register: 1.25 mV a bit, never negative."""
    return (register & 0x7FFF) * 1.25e-3


def _check_range(shunt: Shunt, full_scale_v: float) -> None:
    drop_v = shunt.max_A * shunt.resistance_ohm
    if drop_v > full_scale_v * (1 + 1e-9):
        raise ValueError(
            f"{shunt.max_A:g} A through {shunt.resistance_ohm:g} ohm are {drop_v:g} V;"
            f" the chip measures up to {full_scale_v:g} V"
        )


def _check_agreement(counts: Counts, current: int, expected: float) -> None:
    """Refuses a current that is not the shunt's voltage times the calibration.

    The chip computes the one from the other, so one of both was misread; or the load changed
    between the two reads, and the next reading is good.
    """
    if abs(current - expected) > max(0.1 * abs(expected), 64):
        raise counts.refuse("the current contradicts the shunt's voltage")


def _shunt(parsed: Uri, max_A: float) -> Shunt:
    """What the boards sold with these chips have is 0.1 ohm."""
    return Shunt(
        resistance_ohm=parsed.number("shunt_ohm", 0.1, 0.0005, 10.0),
        max_A=parsed.number("max_A", max_A, 0.01, 100.0),
        discharge_positive=parsed.choice("discharge", "positive", ("positive", "negative"))
        == "positive",
    )


CHIPS = {
    "ina219": Chip(
        range(0x40, 0x50),
        lambda bus, shunt, counts, _: Ina219(bus, shunt, counts),
        lambda parsed: _shunt(parsed, 3.0),
    ),
    "ina226": Chip(  # measures up to 82 mV only
        range(0x40, 0x50),
        lambda bus, shunt, counts, _: Ina226(bus, shunt, counts),
        lambda parsed: _shunt(parsed, 0.8),
    ),
}
