"""A MAX17048's registers as the bytes of an EEPROM: what the emulated gauge answers on I2C.

The chip is read as 16-bit words, most significant byte first, at an 8-bit address that counts
bytes; an EEPROM with one address byte is read the same way. It answers and keeps what is written,
and that is all: nothing in it discharges.
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path

from pi_firmware.battery.chips.max17048 import RESET_INDICATOR, STATUS

sys.path.append(str(Path(__file__).resolve().parents[2] / "i2c"))
from simulated_gauges import Max17048Chip

ADDRESS = 0x36
SIZE = 512  # bytes; QEMU takes a drive of whole sectors only
_REGISTERS = range(0, 0x20, 2)


def write(path: Path, volts: float, percentage: float) -> None:
    """Writes the registers of a gauge that has just got power, as if its cell was put in anew.

    `percentage` is the cell's state of charge as a share, 0 to 1, as in ROS's BatteryState.
    """
    chip = Max17048Chip()
    chip.voltage, chip.share = volts, percentage
    words = (chip.read(register) for register in _REGISTERS)
    path.write_bytes(struct.pack(f">{len(_REGISTERS)}H", *words).ljust(SIZE, b"\0"))


def was_reset(image: bytes) -> bool:
    """Whether the reset indicator stands that a driver clears once it has set the gauge up."""
    return bool(int.from_bytes(image[STATUS : STATUS + 2], "big") & RESET_INDICATOR)
