"""The emulated gauge says what was asked of it, through the driver that flies."""

from pathlib import Path

import emulator_gauge as gauge
import pytest

from deploy.errors import DeployError
from pi_firmware.battery.chip import Counts, WordBus
from pi_firmware.battery.chips.max17048 import Max17048


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


def driver(path: Path, temperature_c: float = 20.0) -> Max17048:
    counts = Counts()
    bus = WordBus(lambda: Eeprom(path), gauge.ADDRESS, "max17048", counts)
    return Max17048(bus, counts, 0.6, temperature_c)


@pytest.mark.parametrize(
    ("volts", "percentage", "rate_per_h"),
    [(3.876, 0.675, 0.0), (4.2, 1.0, -0.5), (3.301, 0.04, -1.0), (3.0, 0.0, 0.25)],
)
def test_the_firmwares_driver_reads_what_was_written(
    tmp_path: Path, volts: float, percentage: float, rate_per_h: float
) -> None:
    gauge.write(tmp_path / "regs", volts, percentage, rate_per_h)
    reading = driver(tmp_path / "regs").read(1)
    # Half a bit of each register, by the datasheet: 78.125 uV, 1/256 %, 0.208 % an hour.
    assert reading.voltage == pytest.approx(volts, abs=78.125e-6 / 2)
    assert reading.percentage == pytest.approx(percentage, abs=1 / 256 / 100 / 2)
    if rate_per_h < 0:
        assert reading.time_left_s is not None
        # A bit's half of a rate r moves the time by 1/r of itself.
        relative = 0.00208 / 2 / -rate_per_h
        expected_s = 3600 * percentage / -rate_per_h
        assert reading.time_left_s == pytest.approx(expected_s, rel=2 * relative, abs=1.0)


def test_registers_by_the_datasheets_formulas() -> None:
    image = gauge.registers(3.876, 0.675, -0.1)
    assert len(image) == gauge.SIZE
    assert gauge.word(image, 0x02) == 49613  # 3.876 V / 78.125 uV
    assert gauge.word(image, 0x04) == 17280  # 67.5 % * 256
    assert gauge.word(image, 0x16) == 0x10000 - 48  # -10 % an hour / 0.208
    assert gauge.word(image, 0x08) & 0xFFF0 == 0x0010
    assert gauge.word(image, 0x0C) == 0x971C


def test_a_driver_that_sets_the_gauge_up_shows_in_the_file(tmp_path: Path) -> None:
    path, reset = tmp_path / "regs", 0x0100
    gauge.write(path, 3.9, 0.7)
    assert gauge.word(path.read_bytes(), 0x1A) & reset
    driver(path, temperature_c=10.0).read(1)
    after = path.read_bytes()
    assert not gauge.word(after, 0x1A) & reset
    assert gauge.compensation(after) == 0x97 + 50  # 5 a degree below 20, by the datasheet


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ((5.2, 0.5, 0.0), "volts 5.2"),
        ((-0.1, 0.5, 0.0), "volts -0.1"),
        ((3.9, 1.01, 0.0), "percentage 1.01"),
        ((3.9, float("nan"), 0.0), "percentage nan"),
        ((3.9, 0.5, -1.5), "rate_per_h -1.5"),
    ],
)
def test_what_no_register_holds_is_refused(values: tuple[float, float, float], named: str) -> None:
    with pytest.raises(DeployError, match=named):
        gauge.registers(*values)
