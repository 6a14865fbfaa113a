"""Stands before the package smbus2 on PYTHONPATH: the program that flies, on simulated gauges.

The number of the bus says which chip answers there and what goes wrong: `i2c:ina219@91:0x40`.
"""

from simulated_gauges import Faults, FlyingBus, flying_bus

from pi_firmware.battery.gauges import cell_of
from pi_firmware.settings import BatterySettings

CELL = cell_of(BatterySettings())
BUSES = {
    90: ("ina219", 0x40, Faults()),
    91: ("ina219", 0x40, Faults(absent=True)),
    92: ("ina219", 0x40, Faults(fail_every=3)),
    93: ("ina219", 0x40, Faults(nonsense_every=3)),
    94: ("ina219", 0x40, Faults(nonsense_every=7)),
    95: ("ina219", 0x40, Faults(nonsense_every=9, nonsense=0)),
    96: ("ina226", 0x40, Faults(nonsense_every=11)),
    97: ("max17048", 0x36, Faults(nonsense_every=5)),
    98: ("max17048", 0x36, Faults(nonsense_every=2)),
    99: ("ina219", 0x40, Faults(stuck_s=1.0)),
}
_FLYING: dict[int, FlyingBus] = {}
"""Opened again, a bus has the same chip and cell."""


def SMBus(bus: int) -> FlyingBus:
    """A bus by its number, with a full cell from the first time on."""
    if bus not in _FLYING:
        chip, address, faults = BUSES[bus]
        _FLYING[bus] = flying_bus(chip, address, CELL, load_a=0.5 * CELL.capacity_ah, faults=faults)
    return _FLYING[bus]
