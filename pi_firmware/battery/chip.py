"""What a file in `chips` declares of a gauge on I2C."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pi_firmware.battery.bus import Counts, WordBus
from pi_firmware.settings import BatterySettings
from pi_firmware.uri import Uri
from pi_firmware.wire.messages import Battery

CHARGING, DISCHARGING, GOOD, LIPO = 1, 2, 1, 3
"""Of a battery's `power_supply_status`, `_health` and `_technology`."""


class Gauge(Protocol):
    """Anything that can say how much charge is left, or voltage and current to find it from."""

    counts: Counts

    def read(self, time_ns: int) -> Battery:
        """One reading, stamped with the payload's clock; raises `GaugeError` without one."""
        ...

    def close(self) -> None:
        """Releases the device; the next reading opens it again."""
        ...


@dataclass(frozen=True)
class Shunt:
    """The resistor and the largest current expected through it.

    `discharge_positive`: a discharging current flows from IN+ to IN-.
    """

    resistance_ohm: float = 0.1
    max_A: float = 3.0
    discharge_positive: bool = True


@dataclass(frozen=True)
class Chip:
    """The addresses that it can have, and what makes a gauge of a bus to one.

    `shunt` reads the options of `battery.uri` that say what current flows through which resistor;
    None for a chip that measures none. `open` raises `ValueError` for a shunt that it cannot use.
    """

    addresses: range
    open: Callable[[WordBus, Shunt, Counts, BatterySettings], Gauge]
    shunt: Callable[[Uri], Shunt] | None = None
