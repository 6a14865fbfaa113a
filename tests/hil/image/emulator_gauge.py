"""A MAX17048's registers as the bytes of an EEPROM: what the emulated gauge answers on I2C.

The chip is read as 16-bit words, most significant byte first, at an 8-bit address that counts
bytes; an EEPROM with one address byte is read the same way. It answers and keeps what is written,
and that is all: nothing in it discharges. Registers and units are those of Maxim's datasheet
19-6171, revision 7.
"""

from __future__ import annotations

import struct
from pathlib import Path

from deploy.errors import DeployError

ADDRESS = 0x36
SIZE = 512  # bytes; QEMU takes a drive of whole sectors only

_VOLT = 78.125e-6  # V per bit of VCELL
_PERCENT = 1 / 256  # % per bit of SOC
_RATE = 0.208  # % per hour and bit of CRATE
_VCELL, _SOC, _MODE, _VERSION, _HIBRT, _CONFIG = 0x02, 0x04, 0x06, 0x08, 0x0A, 0x0C
_VALRT, _CRATE, _VRESET, _STATUS = 0x14, 0x16, 0x18, 0x1A
_RESET = 0x0100
_AFTER_POWER_UP = {
    _MODE: 0x0000,
    _VERSION: 0x0012,
    _HIBRT: 0x8030,
    _CONFIG: 0x971C,
    _VALRT: 0x00FF,
    _VRESET: 0x9600,
    _STATUS: _RESET,
}


def registers(volts: float, percentage: float, rate_per_h: float = 0.0) -> bytes:
    """The register file, 512 bytes, of a gauge that has just got power.

    Args:
        volts: the cell's voltage, V, 0 to 5.11.
        percentage: its state of charge as a share, 0 to 1, as in ROS's BatteryState.
        rate_per_h: the state of charge's change in an hour as a share, -1 to 1.

    Raises:
        DeployError: a value is outside its range, or no number.
    """
    for name, value, low, high in (
        ("volts", volts, 0.0, 5.11),
        ("percentage", percentage, 0.0, 1.0),
        ("rate_per_h", rate_per_h, -1.0, 1.0),
    ):
        if not low <= value <= high:
            raise DeployError(f"gauge: {name} {value:g} is not {low:g} to {high:g}")
    words = {
        **_AFTER_POWER_UP,
        _VCELL: round(volts / _VOLT),
        _SOC: round(100 * percentage / _PERCENT),
        _CRATE: round(100 * rate_per_h / _RATE) & 0xFFFF,
    }
    image = bytearray(SIZE)
    for register, word in words.items():
        struct.pack_into(">H", image, register, word)
    return bytes(image)


def word(image: bytes, register: int) -> int:
    """A register of a register file, 0 to 65535."""
    (value,) = struct.unpack_from(">H", image, register)
    return int(value)


def compensation(image: bytes) -> int:
    """The byte RCOMP, which a driver sets for the temperature."""
    return word(image, _CONFIG) >> 8


def was_reset(image: bytes) -> bool:
    """Whether the reset indicator stands that a driver clears once it has set the gauge up."""
    return bool(word(image, _STATUS) & _RESET)


def write(path: Path, volts: float, percentage: float, rate_per_h: float = 0.0) -> None:
    """Writes a register file again, as if the cell had been taken out and put in again."""
    path.write_bytes(registers(volts, percentage, rate_per_h))
