"""Minutes of the cell: the firmware's own model, energy by hand, and the current's rating."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from hw.builds import Build, shipped_builds
from hw.endurance import MODES, Wear, drain, fly, load_of
from hw.inverse import cell_of, with_cell
from hw.parts import load_parts
from hw.quantities import HardwareError
from pi_firmware.battery.cell import Cell
from pi_firmware.wire import config

ROOT = Path(__file__).parents[2]
PARTS = load_parts()
CELL, BOOST = PARTS["lipo-1300"], PARTS["boost-tps61090"]
FRESH = Wear(health_percent=100, cutoff_V=3.0, reserve_percent=0)


def default() -> Build:
    return shipped_builds().named(None)


@pytest.mark.parametrize("watts", [1.0, 3.0])
def test_with_a_constant_efficiency_it_is_the_payloads_own_estimate(watts: float) -> None:
    boost = replace(BOOST, efficiency=[[3.0, 0.9], [4.2, 0.9]])
    flown = drain(CELL, boost, watts, 0.0, 0.0, FRESH)
    own_s = Cell(1.3).time_left_s(1.0, watts / 0.9, 3.0)
    assert 60 * flown.minutes == pytest.approx(own_s, rel=0.02)


def test_it_is_less_than_the_label_and_more_than_half_of_it() -> None:
    flown = drain(CELL, BOOST, 1.0, 0.0, 0.0, FRESH)
    label_min = 60 * 1.3 * 3.7 / 1.0  # Wh over W
    assert 0.5 * label_min < flown.minutes < label_min


def test_load_is_the_sum_of_the_currents_at_the_converters_voltage() -> None:
    behind, beside = load_of(default(), "stream")
    assert behind == pytest.approx(5.2 * (0.350 + 0.250 + 0.000023))
    assert beside == pytest.approx(5.2 * 0.005)


def test_harder_work_an_older_or_a_colder_cell_and_a_higher_cut_off_end_it_earlier() -> None:
    build = default()
    minutes = [fly(build, mode).minutes for mode in MODES]
    assert minutes[0] > minutes[1] > minutes[2] > 0
    base = fly(build).minutes
    for worse in (
        Wear(health_percent=60),
        Wear(cutoff_V=3.5),
        Wear(reserve_percent=20),
        Wear(temperature_C=0),
    ):
        assert fly(build, wear=worse).minutes < base, worse
    assert fly(build, wear=Wear(health_percent=100)).minutes > base


def test_the_limits_are_those_of_the_payloads_shipped_file() -> None:
    battery = config.read(ROOT / "pi_firmware" / "payload.toml")["battery"]
    assert Wear().cutoff_V == battery["critical_V"]
    assert Wear().reserve_percent == 100 * battery["critical_percentage"]


def test_the_shunt_in_series_costs_minutes() -> None:
    catalogue = shipped_builds()
    shunt, across = (catalogue.named(f"zero-2-w-{g}") for g in ("ina219", "max17048"))
    assert fly(shunt).minutes < fly(across).minutes


def test_current_rises_as_the_cell_empties_and_the_end_is_above_the_cut_off() -> None:
    flown = fly(default())
    assert flown.end_A > flown.full_A
    assert flown.end_V > Wear().cutoff_V
    assert flown.end_A * flown.end_V > flown.load_W  # the converter's loss


def test_current_is_judged_by_the_smaller_of_the_cells_and_the_converters_rating() -> None:
    build = default()
    flown = fly(build)
    assert flown.rating_A == min(CELL.max_discharge_A, BOOST.max_input_A) == 2.0
    for share, verdict in ((1.5, "ok"), (1.1, "warn"), (0.9, "refuse")):
        weak = replace(CELL, max_discharge_A=share * flown.end_A)
        assert fly(with_cell(build, weak)).verdict == verdict
    assert fly(with_cell(build, cell_of(build, 500))).verdict == "refuse"


def test_a_cell_that_cannot_hold_the_voltage_gives_no_minute() -> None:
    flown = drain(replace(CELL, capacity_mAh=60.0), BOOST, 5.0, 0.0, 0.0, Wear())
    assert flown.minutes == 0 and flown.verdict == "none"


def test_converters_efficiency_is_read_between_its_rows_and_held_beyond() -> None:
    assert BOOST.efficiency_at(3.6) == pytest.approx(0.903)
    assert BOOST.efficiency_at(3.45) == pytest.approx((0.866 + 0.903) / 2)
    assert BOOST.efficiency_at(2.0) == pytest.approx(0.834)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: Wear(health_percent=0.8), "health_percent is 0.8; allowed: 10 to 100 %"),
        (lambda: Wear(cutoff_V=5), "cutoff_V is 5; allowed: 2.5 to 4 V"),
        (lambda: fly(replace(default(), placed=())), "has no cell"),
    ],
)
def test_what_cannot_be_is_refused_by_name(call: object, says: str) -> None:
    with pytest.raises(HardwareError) as caught:
        call()  # type: ignore[operator]
    assert says in str(caught.value)
