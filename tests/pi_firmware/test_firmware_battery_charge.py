"""State of charge over simulated discharges of a cell that is not quite the model's.

The simulated cell has the structure of the model: these tests say how the filter bears wrong
capacity, resistance, curve, temperature and gauge, and not how well the model fits a cell of today.
"""

import dataclasses

import numpy as np
import pytest
import simulated_gauges as simulated

from pi_firmware.battery.cell import Cell, Polarization
from pi_firmware.battery.chip import Counts, WordBus
from pi_firmware.battery.chips import ina
from pi_firmware.battery.monitor import ChargeFilter

CAPACITY_AH = 0.6
SHUNT = ina.Shunt(0.1, 3.0)


@dataclasses.dataclass(frozen=True)
class OtherCell(Cell):
    """A cell whose curve lies higher and whose resistances are larger than the model's."""

    offset_v: float = 0.0
    factor: float = 1.0

    def rest_v(self, charge: float) -> float:
        return super().rest_v(charge) + self.offset_v

    def series_ohm(self, charge: float) -> float:
        return super().series_ohm(charge) * self.factor

    def polarization_ohm(self, charge: float) -> tuple[float, float]:
        fast, slow = super().polarization_ohm(charge)
        return fast * self.factor, slow * self.factor


POORER = {"capacity": 0.96, "factor": 1.2, "offset_v": 0.01, "gain": 1.015, "colder_c": 3.0}
BETTER = {"capacity": 1.04, "factor": 0.8, "offset_v": -0.01, "gain": 0.985, "colder_c": -3.0}


def discharge(
    rate: float, celsius: float, other: dict[str, float], start: float = 1.0
) -> tuple[np.ndarray, list[tuple[float, float]], float]:
    """Errors of the charge each second until 3.2 V, times left (truth, said), and the duration."""
    cell = simulated.SimulatedCell(
        OtherCell(
            CAPACITY_AH * other["capacity"],
            temperature_c=celsius - other["colder_c"],
            offset_v=other["offset_v"],
            factor=other["factor"],
        ),
        start,
    )
    chip, counts = simulated.Ina219Chip(), Counts()
    bus = simulated.FakeBus(chip, 0x40)
    gauge = ina.Ina219(WordBus(lambda: bus, 0x40, "gauge", counts), SHUNT, counts)
    charge = ChargeFilter(Cell(CAPACITY_AH, temperature_c=celsius))
    rng = np.random.default_rng(7)
    errors, left, now_s = [], [], 0
    while True:
        now_s += 1
        cell.draw(rate * CAPACITY_AH, 1.0)
        if cell.voltage <= 3.2:
            break
        simulated.connect(chip, cell, SHUNT)
        chip.voltage += rng.normal(0, 0.005)
        chip.shunt_v *= other["gain"]
        reading = gauge.read(now_s)
        assert reading.current is not None
        said = charge.update(float(now_s), reading.voltage, -reading.current)
        errors.append(said - cell.charge)
        if now_s % 300 == 0:
            said_s = charge.time_left_s(3.2)
            assert said_s is not None
            left.append((float(now_s), said_s))
    return np.array(errors), [(now_s - at, said) for at, said in left], now_s


@pytest.mark.parametrize("other", [POORER, BETTER], ids=["poorer", "better"])
@pytest.mark.parametrize("celsius", [5.0, 25.0])
@pytest.mark.parametrize("rate", [0.2, 1.0])
def test_the_charge_is_right_within_five_percent_over_a_whole_discharge(
    rate: float, celsius: float, other: dict[str, float]
) -> None:
    errors, left, duration_s = discharge(rate, celsius, other)
    assert np.abs(errors).max() <= 0.05
    assert abs(errors[-1]) <= 0.02
    for truth_s, said_s in left:
        assert abs(said_s - truth_s) <= 0.2 * duration_s


def test_counting_alone_would_not_do() -> None:
    """The voltage's part is seen where the capacity is wrong by a tenth."""
    worn = POORER | {"capacity": 0.9}
    errors, _, _ = discharge(0.2, 25.0, worn)
    counted = 0.9 - 1.015  # of the design capacity, at the end of a whole discharge
    assert np.abs(errors).max() < 0.05 < abs(counted)


def test_a_start_half_empty_is_right_within_five_percent_when_warm() -> None:
    for rate in (0.2, 1.0):
        errors, _, _ = discharge(rate, 25.0, POORER, start=0.6)
        assert np.abs(errors).max() <= 0.05


def test_the_curve_is_the_papers_and_reaches_the_charging_voltage() -> None:
    paper = Cell(0.85, full_v=3.685 + 0.2156 - 0.1178 + 0.3201)  # equation 2 at 1
    assert paper.stretch == pytest.approx(1.0, abs=1e-3)
    assert paper.rest_v(0.5) == pytest.approx(3.80336, abs=1e-3)
    assert Cell(0.6).rest_v(1.0) == pytest.approx(4.2, abs=1e-3)
    risen = [Cell(0.6).rest_v(charge) for charge in np.linspace(0, 1, 1001)]
    assert np.all(np.diff(risen) > 0)
    for share in (0.02, 0.3, 0.7, 0.99):
        cell = Cell(0.6)
        assert cell.charge_at(cell.rest_v(share)) == pytest.approx(share, abs=1e-3)
        numeric = (cell.rest_v(share + 1e-5) - cell.rest_v(share - 1e-5)) / 2e-5
        assert cell.slope_v(share) == pytest.approx(numeric, rel=1e-4)


def test_cold_cells_have_more_resistance_and_large_ones_less() -> None:
    room = Cell(0.85, temperature_c=25.0).series_ohm(0.8)
    assert room == pytest.approx(0.07446, rel=1e-3)
    assert Cell(0.85, temperature_c=5.0).series_ohm(0.8) > 1.5 * room
    assert Cell(1.7, temperature_c=25.0).series_ohm(0.8) == pytest.approx(room / 2)
    measured = Cell(1.7, resistance_ohm=0.2, temperature_c=25.0)
    assert measured.series_ohm(0.8) == pytest.approx(0.2, rel=1e-3)


def test_polarization_steps_of_any_length_end_alike() -> None:
    cell = Cell(0.6)
    fine, coarse = Polarization(cell), Polarization(cell)
    for _ in range(600):
        fine.step(0.5, 0.6, 1.0)
    coarse.step(0.5, 0.6, 600.0)
    assert fine.total_v == pytest.approx(coarse.total_v, rel=1e-9)
    settled = Polarization(cell)
    settled.settle(0.5, 0.6)
    assert 0.8 * settled.total_v < fine.total_v < settled.total_v


def test_time_left_at_a_light_load_is_the_charge_over_the_current() -> None:
    cell = Cell(0.6)
    mean_v = float(np.mean([cell.rest_v(charge) for charge in np.linspace(0, 0.5, 1001)]))
    power_w = 0.01 * mean_v
    assert cell.time_left_s(0.5, power_w, 2.5) == pytest.approx(0.5 * 0.6 / 0.01 * 3600, rel=0.02)
    assert cell.time_left_s(0.5, 1000.0, 3.0) == 0.0
    assert cell.time_left_s(0.0, power_w, 3.0) == 0.0


def test_odd_readings_are_borne() -> None:
    charge = ChargeFilter(Cell(0.6))
    assert charge.time_left_s(3.3) is None
    first = charge.update(10.0, 3.8, 0.3)
    assert charge.update(10.0, 4.1, 0.3) == charge.update(5.0, 3.2, 0.3) == first
    assert charge.update(11.0, 3.8, 0.3) == pytest.approx(first, abs=0.02)
    # After ten minutes without a reading, half of the charge may have gone.
    assert charge.update(700.0, 3.6, 0.3) < first - 0.2
