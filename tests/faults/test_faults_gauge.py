"""A gauge that is absent, fails or talks nonsense: the stream goes on, no wrong figure is told."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest
from flight import Account, Flight
from ground import Ground
from simulated_gauges import SimulatedCell

from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.battery.gauges import cell_of
from pi_firmware.settings import BatterySettings
from pi_firmware.wire import messages

PERIOD_S, FLIGHT_S = 0.1, 5.0
READS = 5  # registers that an INA219 is asked for each time, after one at the start
SMALL = ("camera.width_px=160", "camera.height_px=120", "camera.rate_hz=10")
SETTINGS = BatterySettings()
LOAD_A = 0.5 * SETTINGS.capacity_mAh / 1000  # of each of the simulated buses
GAUGES = {
    "good": "i2c:ina219@90:0x40",
    "absent": "i2c:ina219@91:0x40",
    "failing": "i2c:ina219@92:0x40",
    "ina219-nonsense": "i2c:ina219@94:0x40",
    "ina219-zeros": "i2c:ina219@95:0x40",
    "ina226-nonsense": "i2c:ina226@96:0x40",
    "max17048-nonsense": "i2c:max17048@97:0x36",
}


@dataclass(frozen=True)
class Flown:
    """The flight's account, all battery messages, and the events' names."""

    account: Account
    readings: list[messages.Battery]
    events: list[str]


def fly(folder: Path, name: str) -> Flown:
    """A short flight with this gauge, read ten times a second."""
    with (
        Ground(numbered=False) as ground,
        Flight(
            folder, ground, None, *SMALL, f"battery.uri={GAUGES[name]}",
            f"battery.period_s={PERIOD_S}", camera="test:", payload_id=name,
        ) as flight,
    ):  # fmt: skip
        flight.wait_streaming(30)
        readings = listen(ground.listener, name, time.monotonic() + FLIGHT_S)
        flight.wait_streaming()
        account = flight.finish()
        state = ground.listener.state(name)
    assert state is not None
    return Flown(account, readings, [event.name for event in state.events])


def listen(listener: TelemetryListener, name: str, until_s: float) -> list[messages.Battery]:
    """The battery's messages up to a time of the monotonic clock."""
    readings: list[messages.Battery] = []

    while (left_s := until_s - time.monotonic()) > 0:
        last_ns = readings[-1].time_ns if readings else 0
        state = listener.wait(
            name, lambda s, ns=last_ns: s.battery is not None and s.battery.time_ns != ns, left_s
        )
        if state is not None and state.battery is not None:
            readings.append(state.battery)
    return readings


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Flown]:
    """All of them at once: what they do is wait."""
    folder = tmp_path_factory.mktemp("gauges")
    with ThreadPoolExecutor(len(GAUGES)) as pool:
        return dict(zip(GAUGES, pool.map(lambda n: fly(folder / n, n), GAUGES), strict=True))


@pytest.mark.parametrize("name", GAUGES)
def test_the_stream_is_undisturbed_and_no_figure_is_wrong(
    flown: dict[str, Flown], name: str
) -> None:
    flown[name].account.assert_exact()
    assert len(flown[name].account.seen) == len(flown[name].account.left)
    fresh, used = SimulatedCell(cell_of(SETTINGS)), SimulatedCell(cell_of(SETTINGS))
    fresh.draw(0, 0)
    for _ in range(60):  # longer than any of these flights
        used.draw(LOAD_A, 1.0)
    for reading in flown[name].readings:
        assert used.voltage - 0.02 < reading.voltage < fresh.voltage + 0.02
        if reading.current is not None:
            assert reading.current == pytest.approx(-LOAD_A, rel=0.02)
        assert reading.percentage is not None and 0.9 < reading.percentage <= 1.0
        assert reading.alarm == messages.ALARM_NONE


def test_a_gauge_that_is_absent_says_nothing_and_is_called_so(flown: dict[str, Flown]) -> None:
    assert flown["absent"].readings == []
    assert flown["absent"].events.count(messages.EVENT_GAUGE_FAILED) == 1


def test_one_transfer_of_three_that_fails_costs_no_reading(flown: dict[str, Flown]) -> None:
    good, failing = flown["good"].readings, flown["failing"].readings
    assert len(good) > 20 < len(failing)
    assert all(reading.read_errors == 0 for reading in good)
    # Each third transfer fails: before the s-th success there were (s - 1) // 2 failures.
    possible = [READS * n // 2 for n in range(1, 500)]
    counted = [reading.read_errors for reading in failing]
    assert set(counted) <= set(possible) and counted == sorted(set(counted))
    for name in ("good", "failing"):
        assert all(r.refused == r.reopened == r.resets == 0 for r in flown[name].readings)
        assert messages.EVENT_GAUGE_FAILED not in flown[name].events


@pytest.mark.parametrize("name", [name for name in GAUGES if "-" in name])
def test_nonsense_is_refused_and_counted(flown: dict[str, Flown], name: str) -> None:
    """Some readings are whole between two pieces of nonsense, and they count the others."""
    readings = flown[name].readings
    assert readings, flown[name].events
    assert readings[-1].refused > 3
