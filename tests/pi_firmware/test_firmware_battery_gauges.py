"""The gauges' drivers against the datasheets' examples, and on a bus that fails or lies."""

import errno
from collections.abc import Callable

import pytest
import simulated_gauges as simulated

from pi_firmware import battery
from pi_firmware.battery.chip import Counts, GaugeError, WordBus, signed, swap
from pi_firmware.battery.chips import ina, max17048
from pi_firmware.battery.gauges import cell_of
from pi_firmware.settings import BatterySettings
from pi_firmware.wire.errors import SourceError

NOW = 10**18


class Recorder(simulated.FakeBus):
    """A fake bus that keeps what was written, as the chip sees it."""

    def __init__(self, chip: simulated.Chip, address: int) -> None:
        super().__init__(chip, address)
        self.written: list[tuple[int, int]] = []
        self.closed = 0

    def write_word_data(self, i2c_addr: int, register: int, value: int) -> None:
        super().write_word_data(i2c_addr, register, value)
        self.written.append((register, swap(value)))

    def close(self) -> None:
        self.closed += 1


def words(bus: simulated.FakeBus, counts: Counts, address: int = 0x40) -> WordBus:
    return WordBus(lambda: bus, address, "gauge", counts, sleep=lambda s: None)


def ina219(
    voltage: float, shunt_v: float, shunt: ina.Shunt
) -> tuple[ina.Ina219, simulated.Ina219Chip, Recorder]:
    chip, counts = simulated.Ina219Chip(), Counts()
    chip.voltage, chip.shunt_v = voltage, shunt_v
    bus = Recorder(chip, 0x40)
    return ina.Ina219(words(bus, counts), shunt, counts), chip, bus


def ina226(
    voltage: float, shunt_v: float, shunt: ina.Shunt
) -> tuple[ina.Ina226, simulated.Ina226Chip, Recorder]:
    chip, counts = simulated.Ina226Chip(), Counts()
    chip.voltage, chip.shunt_v = voltage, shunt_v
    bus = Recorder(chip, 0x40)
    return ina.Ina226(words(bus, counts), shunt, counts), chip, bus


def test_the_ina219_example_of_its_datasheet() -> None:
    """SBOS448G, table 8: 10 A through 2 milliohm at 12 V, 1 mA a bit."""
    chip = simulated.Ina219Chip()
    chip.voltage, chip.shunt_v = 11.98, 0.02
    chip.write(ina.CONFIGURATION, 0x019F)
    chip.write(ina.CALIBRATION, ina.ina219_calibration(1e-3, 0.002))
    assert chip.read(ina.CALIBRATION) == 0x5000
    assert chip.read(ina.SHUNT_VOLTAGE) == 0x07D0
    assert chip.read(ina.BUS_VOLTAGE) & 0xFFFC == 0x5D98
    assert ina.ina219_bus_voltage(0x5D98) == pytest.approx(11.98)
    assert chip.read(ina.CURRENT) == 0x2710
    assert chip.read(ina.POWER) == 0x1766


def test_the_ina226_example_of_its_datasheet() -> None:
    """SBOS547, table 1: 10 A through 2 milliohm at 12 V, 1 mA a bit."""
    chip = simulated.Ina226Chip()
    chip.voltage, chip.shunt_v = 11.98, 0.02
    chip.write(ina.CALIBRATION, ina.ina226_calibration(1e-3, 0.002))
    assert chip.read(ina.CONFIGURATION) == 0x4127
    assert chip.read(ina.CALIBRATION) == 0x0A00
    assert chip.read(ina.SHUNT_VOLTAGE) == 0x1F40
    assert chip.read(ina.BUS_VOLTAGE) == 0x2570
    assert ina.ina226_bus_voltage(0x2570) == pytest.approx(11.98)
    assert chip.read(ina.CURRENT) == 0x2710
    assert chip.read(ina.POWER) == 0x12B8


@pytest.mark.parametrize(("word", "value"), [(0x8300, -32000), (0xF060, -4000), (0x7D00, 32000)])
def test_a_negative_shunt_voltage_is_twos_complement(word: int, value: int) -> None:
    """SBOS448G, table 7: 320 mV is 7D00h, -320 mV 8300h and -40 mV F060h at 10 uV a bit."""
    assert signed(word) == value


def test_ina219_says_the_cells_voltage_and_a_discharge_as_negative() -> None:
    gauge, _, bus = ina219(3.7, 0.05, ina.Shunt(0.1, 1.6))  # 0.5 A leaves the cell
    reading = gauge.read(NOW)
    assert reading.voltage == pytest.approx(3.75, abs=0.004)  # before the shunt
    assert reading.current == pytest.approx(-0.5, abs=2e-4)
    assert (reading.time_ns, reading.power_supply_status) == (NOW, 2)
    # Reset; 16 V, gain 1/4 for 160 mV, 128 samples each, continuous; 0.04096 / (1.6/2^15 * 0.1).
    assert bus.written == [(0, 0x8000), (0, 0x17FF), (5, 8388)]


def test_ina226_wired_the_other_way_charges_when_the_shunt_is_positive() -> None:
    gauge, _, bus = ina226(4.0, 0.03, ina.Shunt(0.1, 0.8, discharge_positive=False))
    reading = gauge.read(NOW)
    assert reading.voltage == pytest.approx(4.0)
    assert reading.current == pytest.approx(0.3, abs=1e-4)
    assert reading.power_supply_status == 1
    assert bus.written == [(0, 0x8000), (0, 0x4527), (5, 2097)]


def test_max17048_registers_are_volts_and_shares() -> None:
    chip, counts = simulated.Max17048Chip(), Counts()
    chip.voltage, chip.share, chip.rate_per_h = 3.7, 0.5, -0.5
    bus = Recorder(chip, 0x36)
    gauge = max17048.Max17048(words(bus, counts, 0x36), counts, 0.6, temperature_c=10.0)
    reading = gauge.read(NOW)
    assert swap(bus.read_word_data(0x36, max17048.VCELL)) == 47360  # 3.7 V at 78.125 uV a bit
    assert swap(bus.read_word_data(0x36, max17048.SOC)) == 0x3200  # the high byte is percent
    assert signed(chip.read(max17048.CRATE)) == -240  # 50 % an hour at 0.208 % a bit
    assert reading.voltage == pytest.approx(3.7)
    assert reading.percentage == pytest.approx(0.5)
    assert reading.charge == pytest.approx(0.3)
    assert reading.time_left_s == pytest.approx(3600, rel=0.01)
    assert reading.current is None
    # RCOMP 97h, and 5 a degree more below 20 degrees; the reset indicator is taken back.
    assert bus.written == [(max17048.CONFIG, 0xC91C), (max17048.STATUS, 0)]


@pytest.mark.parametrize(("celsius", "byte"), [(20, 0x97), (30, 0x92), (10, 0xC9), (-40, 0xFF)])
def test_max17048_is_told_the_temperature(celsius: float, byte: int) -> None:
    assert max17048.compensation(celsius) == byte


def test_two_of_three_reads_good_are_enough_and_the_rest_is_counted() -> None:
    gauge, _, bus = ina219(3.7, 0.01, ina.Shunt())
    bus.faults.fail_every = 3
    for step in range(20):
        assert gauge.read(NOW + step).voltage == pytest.approx(3.71, abs=0.004)
    assert gauge.counts.errors == bus.reads // 3
    assert (gauge.counts.refused, gauge.counts.reopened, bus.closed) == (0, 0, 0)


def test_a_gauge_that_is_gone_is_said_after_a_bounded_time_and_comes_back() -> None:
    pauses: list[float] = []
    chip, counts = simulated.Ina226Chip(), Counts()
    chip.voltage = 3.9
    bus = Recorder(chip, 0x40)
    answering = WordBus(lambda: bus, 0x40, "ina226 on i2c-1", counts, pauses.append)
    gauge = ina.Ina226(answering, ina.Shunt(0.1, 0.8), counts)
    bus.faults.absent = True
    with pytest.raises(GaugeError, match="ina226 on i2c-1: does not answer: Remote I/O error"):
        gauge.read(NOW)
    assert sum(pauses) < 0.05
    assert (counts.errors, counts.reopened, bus.closed) == (8, 1, 2)
    bus.faults.absent = False
    assert gauge.read(NOW).voltage == pytest.approx(3.9)


def test_a_bus_that_is_held_low_is_asked_once_and_once_more_when_opened_again() -> None:
    """Each of its transfers costs a second: eight of them would hide the failure for long."""
    bus, counts = (
        simulated.FakeBus(simulated.Ina219Chip(), 0x40, simulated.Faults(stuck_s=0)),
        Counts(),
    )
    with pytest.raises(GaugeError, match="does not answer"):
        words(bus, counts).read(ina.BUS_VOLTAGE)
    assert (bus.timeouts, counts.errors, counts.reopened) == (2, 2, 1)
    bus.faults.stuck_s = None
    assert words(bus, counts).read(ina.CONFIGURATION) == 0x399F


def test_a_bus_that_cannot_be_opened_is_a_gauge_that_does_not_answer() -> None:
    def opened() -> simulated.FakeBus:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    counts = Counts()
    gauge = ina.Ina219(WordBus(opened, 0x40, "ina219", counts, lambda s: None), ina.Shunt(), counts)
    with pytest.raises(GaugeError, match="No such file"):
        gauge.read(NOW)


@pytest.mark.parametrize("make", [ina219, ina226])
def test_a_chip_that_lost_its_settings_never_says_zero_current(
    make: Callable[..., tuple[ina.Ina219, simulated.Ina219Chip, Recorder]],
) -> None:
    gauge, chip, _ = make(3.7, 0.05, ina.Shunt(0.1, 0.8))
    assert gauge.read(NOW).current == pytest.approx(-0.5, abs=1e-3)
    chip.reset()
    with pytest.raises(GaugeError, match="lost its settings"):
        gauge.read(NOW)
    assert gauge.read(NOW).current == pytest.approx(-0.5, abs=1e-3)
    assert (gauge.counts.resets, gauge.counts.refused) == (1, 1)


def test_a_current_beyond_the_range_is_refused() -> None:
    for make in (ina219, ina226):
        gauge, _, _ = make(3.7, 0.5, ina.Shunt(0.1, 0.8))
        with pytest.raises(GaugeError, match="beyond the range"):
            gauge.read(NOW)
        assert gauge.counts.refused == 1


def test_another_chip_at_the_address_is_named() -> None:
    counts = Counts()
    bus = simulated.FakeBus(simulated.Ina219Chip(), 0x40)
    with pytest.raises(GaugeError, match="another chip"):
        ina.Ina226(words(bus, counts), ina.Shunt(0.1, 0.8), counts).read(NOW)
    bus = simulated.FakeBus(simulated.Ina226Chip(), 0x40)
    with pytest.raises(GaugeError, match="another chip"):
        ina.Ina219(words(bus, counts), ina.Shunt(), counts).read(NOW)
    with pytest.raises(GaugeError, match="another chip"):
        max17048.Max17048(words(bus, counts), counts, 0.6, 20).read(NOW)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("i2c:ina219", "expected i2c:CHIP@BUS:ADDRESS"),
        ("i2c:ina219@1:64", "expected i2c:CHIP@BUS:ADDRESS"),
        ("i2c:ina219@1:0x39", "address 0x39; allowed for ina219: 0x40 to 0x4f"),
        ("i2c:max17048@1:0x40", "allowed for max17048: 0x36 to 0x36"),
        ("i2c:max17048@1:0x36?shunt_ohm=0.1", "unknown option 'shunt_ohm'"),
        ("i2c:ina219@1:0x40?percentage=0.5", "unknown option 'percentage'"),
        ("i2c:ina219@fake:0x40", "expected i2c:CHIP@BUS:ADDRESS"),
        ("i2c:ina219@1:0x40?shunt_ohm=0", "shunt_ohm is '0'"),
        ("i2c:ina226@1:0x40?max_A=2", "2 A through 0.1 ohm are 0.2 V; the chip measures up to"),
        ("i2c:ina219@1:0x40?discharge=up", "allowed: positive, negative"),
        ("i2c:bq27441@1:0x55", "expected i2c:CHIP@BUS:ADDRESS"),
        ("gauge:", "unknown scheme"),
        ("fake:1", "takes no path"),
        ("fake:?percentage=2", "percentage is '2'; allowed: 0 to 1"),
        ("fake:?a=1&a=" + "2" * 9000, "option 'a' is given twice"),
        ("fake:\n?x", "the options are not name=value"),
        ("fake:?a\n=1", "unknown option"),
    ],
)
def test_a_wrong_gauge_is_refused_in_one_line(text: str, named: str) -> None:
    with pytest.raises(SourceError) as caught:
        battery.open_gauge(text)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("name", "address"), [("ina219", 0x40), ("ina226", 0x41), ("max17048", 0x36)]
)
def test_the_drivers_run_on_the_bus_that_the_uri_names(
    name: str, address: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = BatterySettings(capacity_mAh=800)
    flying = simulated.flying_bus(name, address, cell_of(settings), charge=0.5, load_a=0.4)
    asked = []
    monkeypatch.setattr("smbus2.SMBus", lambda number: asked.append(number) or flying)
    gauge = battery.open_gauge(f"i2c:{name}@7:{address:#x}", settings)
    reading = gauge.read(NOW)
    assert asked == [7]
    assert 3.5 < reading.voltage < 3.9
    assert reading.percentage == pytest.approx(0.5, abs=0.01) or reading.current == pytest.approx(
        -0.4, abs=0.001
    )
    gauge.close()
