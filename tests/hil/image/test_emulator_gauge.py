"""The emulated gauge says what was asked of it, through the driver that flies."""

from pathlib import Path

import emulator_gauge as gauge
import pytest

from pi_firmware.battery.chip import Counts, WordBus
from pi_firmware.battery.chips.max17048 import CONFIG, Max17048


class Eeprom:
    """smbus2's calls on a register file, as an EEPROM with one address byte answers them."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read_word_data(self, i2c_addr: int, register: int) -> int:
        assert i2c_addr == gauge.ADDRESS
        return int.from_bytes(self._path.read_bytes()[register : register + 2], "little")

    def write_word_data(self, i2c_addr: int, register: int, value: int) -> None:
        image = bytearray(self._path.read_bytes())
        image[register : register + 2] = value.to_bytes(2, "little")
        self._path.write_bytes(image)

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("volts", "percentage"), [(3.876, 0.675), (4.2, 1.0), (3.0, 0.0)])
def test_the_firmwares_driver_reads_what_was_written_and_sets_the_gauge_up(
    tmp_path: Path, volts: float, percentage: float
) -> None:
    path, counts = tmp_path / "regs", Counts()
    gauge.write(path, volts, percentage)
    assert path.stat().st_size == gauge.SIZE and gauge.was_reset(path.read_bytes())
    bus = WordBus(lambda: Eeprom(path), gauge.ADDRESS, "max17048", counts)
    reading = Max17048(bus, counts, 0.6, temperature_c=10.0).read(1)
    # Half a bit of each register, by the datasheet: 78.125 uV, 1/256 %.
    assert reading.voltage == pytest.approx(volts, abs=78.125e-6 / 2)
    assert reading.percentage == pytest.approx(percentage, abs=1 / 256 / 100 / 2)
    after = path.read_bytes()
    assert not gauge.was_reset(after)
    assert after[CONFIG] == 0x97 + 50  # 5 a degree below 20, by the datasheet
