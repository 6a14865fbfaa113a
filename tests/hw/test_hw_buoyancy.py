"""Lift and margin: numbers by hand, which way each input pulls, and their uncertainty."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hw.builds import Build, Conditions, Hull, shipped_builds
from hw.buoyancy import gross_lift_g, gross_of, lift_in, margin_g, margin_of
from hw.quantities import RANGES

THESIS_M3 = 0.1905


def default() -> Build:
    return shipped_builds().named(None)


def test_the_thesiss_product_is_201_3_grams() -> None:
    assert gross_lift_g(THESIS_M3, 1.2260, 0.1693) == pytest.approx(201.3, abs=0.05)


def test_the_same_envelope_indoors_lifts_191_to_192_grams() -> None:
    lift = lift_in(Conditions(temperature_C=20, purity_percent=97), THESIS_M3)
    assert 191 < lift < 192
    # By hand, both ideal gases: p/(RT) = 101325 / (8.314463 × 293.15) = 41.571 mol/m³.
    by_hand = THESIS_M3 * 41.571 * 0.97 * (28.9655 - 4.0026)
    assert lift == pytest.approx(by_hand, rel=1e-3)


days = st.builds(
    Conditions,
    temperature_C=st.floats(-20, 40),
    pressure_hPa=st.floats(700, 1050),
    humidity_percent=st.floats(0, 90),
    purity_percent=st.floats(60, 99),
    superpressure_Pa=st.floats(0, 1000),
)


@settings(max_examples=40, deadline=None)
@given(days, st.floats(0.05, 5), st.floats(0.5, 10))
def test_which_way_each_input_pulls(day: Conditions, volume: float, step: float) -> None:
    lift = lift_in(day, volume)
    assert lift > 0
    assert lift_in(replace(day, temperature_C=day.temperature_C + step), volume) < lift
    assert lift_in(replace(day, pressure_hPa=day.pressure_hPa + step), volume) > lift
    assert lift_in(replace(day, humidity_percent=day.humidity_percent + step), volume) < lift
    assert lift_in(replace(day, purity_percent=day.purity_percent + 0.1 * step), volume) > lift
    assert lift_in(replace(day, superpressure_Pa=day.superpressure_Pa + 10 * step), volume) < lift
    assert lift_in(day, volume * (1 + step / 100)) > lift
    leaky = replace(day, leak_percent_per_day=step, days=1.0)
    assert lift_in(leaky, volume) == pytest.approx(lift * (1 - step / 100))


@settings(max_examples=20, deadline=None)
@given(st.floats(0, 3000), st.floats(1, 500), st.floats(-10, 40))
def test_lift_falls_with_altitude(altitude_m: float, step_m: float, temperature_C: float) -> None:
    low = Conditions(temperature_C=temperature_C, altitude_m=altitude_m)
    high = replace(low, altitude_m=altitude_m + step_m)
    assert lift_in(high, 1.0) < lift_in(low, 1.0)


def test_the_margin_is_lift_less_every_part() -> None:
    build = default()
    by_hand = gross_of(build) - math.fsum(item.mass_g for item in build.items)
    assert margin_g(build) == pytest.approx(by_hand, abs=1e-5)
    roles = {item.role for item in build.items}
    assert {"envelope", "fins", "mechanism", "computer", "camera", "cell"} <= roles


def test_a_measured_free_lift_takes_the_place_of_film_and_gas() -> None:
    build = default()
    lift, film = gross_of(build), build.items[0]
    assert film.role == "envelope"
    hull = replace(build.hull, free_lift_g=lift - film.mass_g, free_lift_spread_g=0.5)
    measured = replace(build, hull=hull)
    assert margin_g(measured) == pytest.approx(margin_g(build), abs=1e-5)
    assert margin_of(measured).sigma_g < margin_of(build).sigma_g
    assert "temperature_C" not in margin_of(measured).parts_sigma_g


def test_drawn_and_propagated_uncertainty_agree() -> None:
    build, rng = default(), np.random.default_rng(3)
    day, hull = build.conditions, build.hull
    names = ("temperature_C", "pressure_hPa", "humidity_percent", "purity_percent",
             "superpressure_Pa", "leak_percent_per_day")  # fmt: skip
    drawn = []
    for _ in range(2500):
        state = {
            name: float(np.clip(rng.normal(getattr(day, name), day.sigma_of(name)), *RANGES[name]))
            for name in names
        }
        volume = hull.envelope.volume_m3 * rng.normal(1.0, hull.volume_sigma_percent / 100)
        mass = math.fsum(rng.normal(item.mass_g, item.spread_g) for item in build.items)
        drawn.append(lift_in(replace(day, **state), volume) - mass)
    margin = margin_of(build)
    # 2500 draws know a standard deviation to 1.4 %, a mean to 2 % of it.
    assert np.std(drawn) == pytest.approx(margin.sigma_g, rel=0.05)
    assert np.mean(drawn) == pytest.approx(margin.margin_g, abs=0.08 * margin.sigma_g)
    low, high = np.percentile(drawn, [5, 95])
    assert (margin.low_g, margin.high_g) == pytest.approx((low, high), abs=0.15 * margin.sigma_g)
    assert margin.positive_share == pytest.approx(np.mean(np.array(drawn) > 0), abs=0.01)


def test_a_linear_input_propagates_exactly() -> None:
    day = Conditions(air_kg_m3=1.2, helium_kg_m3=0.2)
    hull = Hull("h", "h", shape="sphere", diameter_m=0.7, volume_sigma_percent=2, film_g_m2=20,
                film_citation="test", stations={"gondola": (0.0, -0.3)})  # fmt: skip
    build = Build("b", "", hull, (), day)
    margin = margin_of(build)
    assert margin.sigma_g == pytest.approx(0.02 * margin.gross_g)
    assert list(margin.parts_sigma_g) == ["volume"]


def test_all_builds_that_are_offered_fly() -> None:
    for name, build in shipped_builds().builds.items():
        assert margin_g(build) > 0, name
