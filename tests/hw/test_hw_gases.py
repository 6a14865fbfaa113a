"""Densities against check values, the ideal gas and numbers reckoned by hand."""

from __future__ import annotations

import math

import pytest

from hw.builds import Conditions
from hw.gases import air_kg_m3, helium_kg_m3, pressure_at_altitude
from hw.quantities import HardwareError

R = 8.314462618  # J/(mol K), exact
AIR_KG_MOL, HELIUM_KG_MOL, WATER_KG_MOL = 0.0289655, 0.0040026, 0.0180153


def ideal(molar_kg: float, temperature_C: float, pressure_hPa: float) -> float:
    return 100 * pressure_hPa * molar_kg / (R * (temperature_C + 273.15))


def test_the_check_values_at_15_degrees_and_one_atmosphere() -> None:
    assert air_kg_m3(15, 1013.25) == pytest.approx(1.2250, rel=1e-3)
    assert helium_kg_m3(15, 1013.25) == pytest.approx(0.1693, rel=1e-3)


@pytest.mark.parametrize("temperature_C", [-10, 0, 20, 40])
@pytest.mark.parametrize("pressure_hPa", [700, 1013.25])
def test_dry_air_and_helium_are_ideal_gases_to_a_thousandth(
    temperature_C: float, pressure_hPa: float
) -> None:
    state = temperature_C, pressure_hPa
    assert air_kg_m3(*state) == pytest.approx(ideal(AIR_KG_MOL, *state), rel=1e-3)
    assert helium_kg_m3(*state) == pytest.approx(ideal(HELIUM_KG_MOL, *state), rel=1e-3)


def test_moist_air_is_dry_air_with_vapour_in_its_place() -> None:
    # Vapour pressure at 20 degrees: 23.39 hPa (IAPWS). Half of it, Dalton's law.
    vapour_hPa = 0.5 * 23.39
    share = vapour_hPa / 1013.25
    molar = (1 - share) * AIR_KG_MOL + share * WATER_KG_MOL
    assert air_kg_m3(20, 1013.25, 50) == pytest.approx(ideal(molar, 20, 1013.25), rel=1e-3)


def test_impure_helium_is_the_share_of_each_by_volume() -> None:
    pure, air = helium_kg_m3(20, 1013.25), air_kg_m3(20, 1013.25)
    assert helium_kg_m3(20, 1013.25, 97) == pytest.approx(0.97 * pure + 0.03 * air, rel=1e-4)


def test_superpressure_makes_the_gas_denser_in_proportion() -> None:
    denser = helium_kg_m3(20, 1000, 100, superpressure_Pa=1000)
    assert denser / helium_kg_m3(20, 1000) == pytest.approx(1.01, rel=1e-4)


def test_pressure_follows_the_standard_atmosphere() -> None:
    assert pressure_at_altitude(0) == 1013.25
    assert pressure_at_altitude(1000) == pytest.approx(898.75, abs=0.01)  # ISO 2533's table
    assert pressure_at_altitude(5000) == pytest.approx(540.20, abs=0.01)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"temperature_C": 500}, "temperature_C is 500; allowed: -40 to 60 °C"),
        ({"temperature_C": math.nan}, "temperature_C is nan"),
        ({"pressure_hPa": 1.013}, "pressure_hPa is 1.013; allowed: 300 to 1100 hPa"),
        ({"humidity_percent": 101}, "humidity_percent is 101; allowed: 0 to 100 %"),
        ({"purity_percent": 0.97}, "purity_percent is 0.97; allowed: 50 to 100 %"),
        ({"superpressure_Pa": -1}, "superpressure_Pa is -1"),
        ({"altitude_m": math.inf}, "altitude_m is inf"),
    ],
)
def test_what_cannot_be_is_refused_by_name(given: dict[str, float], says: str) -> None:
    with pytest.raises(HardwareError) as caught:
        Conditions(**given)
    assert says in str(caught.value)
