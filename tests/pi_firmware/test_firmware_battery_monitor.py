"""What the payload says and does about its battery: alarms, silence, an orderly end."""

import threading
from typing import Any

import pytest
import simulated_gauges as simulated
from waiting import eventually

from pi_firmware import battery
from pi_firmware.battery.cell import Cell
from pi_firmware.battery.chip import Counts, GaugeError, WordBus
from pi_firmware.battery.chips import ina
from pi_firmware.battery.gauges import cell_of
from pi_firmware.settings import BatterySettings
from pi_firmware.wire import messages
from pi_firmware.wire.messages import Battery

S = 10**9


class Script:
    """A gauge that gives what it is told to."""

    def __init__(self, *readings: Any) -> None:
        self.counts, self.readings, self.closed = Counts(), list(readings), False

    def read(self, time_ns: int) -> Battery:
        reading = self.readings.pop(0) if len(self.readings) > 1 else self.readings[0]
        if isinstance(reading, Exception):
            raise reading
        values = {"percentage": 0.8, "power_supply_status": 2} | reading
        return Battery(time_ns=time_ns, **values)

    def close(self) -> None:
        self.closed = True


class Watched(battery.Monitor):
    """A monitor whose words and deeds are kept."""

    def __init__(self, gauge: Any, settings: BatterySettings | None = None) -> None:
        self.said: list[Battery] = []
        self.events: list[str] = []
        self.done: list[Any] = []
        self.now_s = 0.0
        super().__init__(
            settings or BatterySettings(),
            gauge,
            publish=self.said.append,
            announce=lambda name, text: self.events.append(name),
            on_low=self.done.append,
            on_critical=lambda: self.done.append("end"),
            clock=lambda: self.now_s,
        )

    def steps(self, count: int) -> list[float]:
        pauses = []
        for _ in range(count):
            self.now_s += 1.0
            pauses.append(self.step(int(self.now_s) * S))
        return pauses


def test_low_then_critical_each_said_and_done_once() -> None:
    gauge = Script(
        *[{"voltage": 3.8, "percentage": 0.4}] * 2,
        *[{"voltage": 3.7, "percentage": 0.2}] * 5,
        *[{"voltage": 3.5, "percentage": 0.04}] * 5,
    )
    watched = Watched(gauge)
    watched.steps(20)
    assert watched.events == [messages.EVENT_BATTERY_LOW, messages.EVENT_BATTERY_CRITICAL]
    assert watched.done == [600, "end"]
    assert [r.alarm for r in watched.said[:11]] == [""] * 4 + ["low"] * 5 + ["critical"] * 2


def test_a_sag_of_a_moment_is_no_alarm_and_a_lasting_one_ends_the_flight_above_3_2_volts() -> None:
    sag = Watched(Script({"voltage": 3.25}, {"voltage": 3.28}, {"voltage": 3.6}))
    sag.steps(10)
    assert sag.events == [] and sag.alarm == ""
    lasting = Watched(Script({"voltage": 3.29}))
    lasting.steps(3)
    assert lasting.done == ["end"]


def test_shutdown_comes_before_3_2_volts_under_load() -> None:
    for celsius in (5.0, 25.0):
        cell = simulated.SimulatedCell(Cell(0.55, temperature_c=celsius - 3), 0.3)
        chip, counts, shunt = simulated.Ina226Chip(), Counts(), ina.Shunt(0.1, 0.8)
        bus = simulated.FakeBus(chip, 0x40)
        gauge = ina.Ina226(WordBus(lambda b=bus: b, 0x40, "g", counts), shunt, counts)
        watched = Watched(gauge, BatterySettings(temperature_C=celsius))
        while "end" not in watched.done:
            cell.draw(0.6, 1.0)
            assert cell.voltage > 3.2
            simulated.connect(chip, cell, shunt)
            watched.steps(1)
        assert watched.said[-1].alarm == "critical"
        assert cell.charge < 0.2  # and not long before it had to be


def test_a_battery_on_the_charger_does_not_end_anything() -> None:
    watched = Watched(Script({"voltage": 3.1, "percentage": 0.01, "power_supply_status": 1}))
    watched.steps(10)
    assert watched.done == [] and watched.alarm == ""


def test_the_low_alarm_ends_with_hysteresis() -> None:
    gauge = Script(
        *[{"voltage": 3.7, "percentage": 0.24}] * 3,
        {"voltage": 3.7, "percentage": 0.27},
        {"voltage": 3.8, "percentage": 0.31},
    )
    watched = Watched(gauge)
    watched.steps(5)
    assert [r.alarm for r in watched.said] == ["", "", "low", "low", ""]


@pytest.mark.parametrize(
    "nonsense",
    [
        {"voltage": float("nan")},
        {"voltage": 0.0},
        {"voltage": 32.76},
        {"voltage": 3.8, "current": float("inf")},
        {"voltage": 3.8, "percentage": 1.5},
        {"voltage": 3.8, "percentage": float("nan")},
    ],
)
def test_what_cannot_be_is_never_sent(nonsense: dict[str, float]) -> None:
    watched = Watched(Script(nonsense, nonsense, {"voltage": 3.8}))
    watched.steps(3)
    assert [r.voltage for r in watched.said] == [3.8]
    assert watched.said[0].refused == 2
    messages.encode(watched.said[0])


def test_a_silent_gauge_is_said_once_asked_ever_more_seldom_and_welcomed_back() -> None:
    gone = GaugeError("ina219: does not answer")
    watched = Watched(Script(*[gone] * 12, {"voltage": 3.8}))
    pauses = watched.steps(13)
    assert watched.events == [messages.EVENT_GAUGE_FAILED, messages.EVENT_GAUGE_BACK]
    assert pauses[:4] == [1.0, 1.0, 1.0, 2.0] and max(pauses) == 30.0 and pauses[-1] == 1.0
    assert len(watched.said) == 1


def test_charge_and_time_left_come_from_voltage_and_current() -> None:
    watched = Watched(Script({"voltage": 3.82, "percentage": None, "current": -0.3}))
    watched.steps(5)
    last = watched.said[-1]
    assert last.percentage is not None and 0.4 < last.percentage < 0.7
    assert last.charge == pytest.approx(last.percentage * 0.6)
    assert last.time_left_s is not None and 1500 < last.time_left_s < 5000


@pytest.mark.parametrize(
    "fault",
    [
        simulated.Faults(fail_every=3),
        simulated.Faults(nonsense_every=7),
        simulated.Faults(absent=True),
    ],
)
def test_a_faulty_gauge_by_uri_never_lies(
    fault: simulated.Faults, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = BatterySettings(uri="i2c:ina219@1:0x40")
    cell = cell_of(settings)
    flying = simulated.flying_bus("ina219", 0x40, cell, charge=0.6, load_a=0.3, faults=fault)
    monkeypatch.setattr("smbus2.SMBus", lambda number: flying)
    watched = Watched(battery.open_gauge(settings.uri, settings), settings)
    watched.steps(30)
    assert all(3.6 < r.voltage < 3.9 and 0.4 < r.percentage < 0.8 for r in watched.said)
    if fault.fail_every:
        assert len(watched.said) == 30 and watched.said[-1].read_errors > 10
    elif fault.nonsense_every:
        assert watched.said and watched.said[-1].refused > 0
    else:
        assert not watched.said and watched.events == [messages.EVENT_GAUGE_FAILED]


def test_the_thread_outlives_whatever_a_gauge_throws() -> None:
    gauge = Script(ZeroDivisionError("odd"), {"voltage": 3.8})
    got = threading.Event()
    settings = BatterySettings(period_s=0.1)
    monitor = battery.Monitor(
        settings, gauge, publish=lambda m: got.set(), announce=lambda n, t: None
    )
    monitor.start()
    assert got.wait(10)
    monitor.stop()
    assert gauge.closed
    unused = Script({"voltage": 3.8})
    battery.Monitor(settings, unused, publish=lambda m: None, announce=lambda n, t: None).stop()
    assert unused.closed


def test_a_link_that_fails_does_not_hold_up_the_end() -> None:
    ended = threading.Event()

    def broken(*_: Any) -> None:
        raise RuntimeError("the link hangs")

    monitor = battery.Monitor(
        BatterySettings(confirm_readings=1, period_s=0.1),
        Script({"voltage": 3.2}),
        publish=broken,
        announce=broken,
        on_critical=ended.set,
    )
    monitor.start()
    assert ended.wait(10)
    monitor.stop()
    failing = battery.Monitor(
        BatterySettings(period_s=0.1),
        silent := Script(*[GaugeError("gone")] * 6, {"voltage": 3.8}),
        publish=broken,
        announce=broken,
    )
    failing.start()
    eventually(lambda: len(silent.readings) == 1)
    failing.stop()
