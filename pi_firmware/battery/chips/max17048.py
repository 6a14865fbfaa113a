"""MAX17048, a fuel gauge that models one lithium cell from its voltage alone.

Registers and units are those of Maxim's datasheet 19-6171, revision 7.
"""

from __future__ import annotations

from pi_firmware.battery.chip import Chip, Counts, GaugeError, WordBus, reading, signed
from pi_firmware.wire.messages import Battery

VCELL, SOC, VERSION, CONFIG, CRATE, STATUS = 0x02, 0x04, 0x08, 0x0C, 0x16, 0x1A
RESET_INDICATOR = 0x0100
_RCOMP_AT_20_C = 0x97
_HIGHEST_SHARE = 1.1  # the register may pass 100 % a little; far beyond it is no state of charge
_MIN_RATE_PER_H = 0.005


class Max17048:
    """The cell's voltage, and the chip's own state of charge; it measures no current."""

    def __init__(
        self, bus: WordBus, counts: Counts, capacity_ah: float, temperature_c: float
    ) -> None:
        self._bus, self.counts = bus, counts
        self._capacity_ah = capacity_ah
        self._rcomp = compensation(temperature_c)
        self._ready = False

    def read(self, time_ns: int) -> Battery:
        """One reading; raises `GaugeError` when there is none that can be believed."""
        self._prepare()
        voltage = self._bus.read(VCELL) * 78.125e-6
        share = self._bus.read(SOC) / 256 / 100
        rate_per_h = signed(self._bus.read(CRATE)) * 0.208 / 100
        if self._bus.read(STATUS) & RESET_INDICATOR:
            self._ready = False
            self.counts.resets += 1
            raise self.counts.refuse("max17048: the gauge was reset; it is set up again")
        if share > _HIGHEST_SHARE:
            raise self.counts.refuse(f"max17048: {100 * share:.0f} % is no state of charge")
        share = min(share, 1.0)
        return reading(
            time_ns,
            voltage,
            charging=rate_per_h > _MIN_RATE_PER_H,
            percentage=share,
            charge=share * self._capacity_ah,
            time_left_s=3600 * share / -rate_per_h if rate_per_h <= -_MIN_RATE_PER_H else None,
        )

    def close(self) -> None:
        self._ready = False
        self._bus.close()

    def _prepare(self) -> None:
        if self._ready:
            return
        version = self._bus.read(VERSION)
        if version & 0xFFF0 != 0x0010:
            raise GaugeError(f"max17048: its version is {version:#06x}, not 0x001_: another chip")
        self._bus.write(CONFIG, self._rcomp << 8 | self._bus.read(CONFIG) & 0xFF)
        self._bus.write(STATUS, self._bus.read(STATUS) & ~RESET_INDICATOR)
        self._ready = True


def compensation(temperature_c: float) -> int:
    """The byte RCOMP for a temperature: 0x97 at 20 °C, -0.5 a degree above it, -5 a degree below.

    The datasheet's typical cell: colder ones get a larger value.
    """
    slope = -0.5 if temperature_c > 20 else -5.0
    return max(0, min(255, round(_RCOMP_AT_20_C + (temperature_c - 20) * slope)))


CHIPS = {
    "max17048": Chip(
        range(0x36, 0x37),
        lambda bus, _, counts, battery: Max17048(
            bus, counts, battery.capacity_mAh / 1000, battery.temperature_C
        ),
    )
}
