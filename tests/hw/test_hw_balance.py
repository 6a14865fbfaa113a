"""How it hangs and how it climbs."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from hw.builds import Build, Conditions, Hull, shipped_builds, with_ballast
from hw.flight import GRAVITY_M_S2, balance_of, climb_of, climb_s
from hw.parts import load_parts
from hw.quantities import HardwareError


def build_of(*placed: tuple[str, tuple[float, float]]) -> Build:
    stations = {f"s{k}": place for k, (_, place) in enumerate(placed)}
    hull = Hull("h", "h", shape="sphere", diameter_m=0.7, film_g_m2=1.0, film_citation="test",
                stations=stations)  # fmt: skip
    parts = load_parts()
    pairs = tuple((parts[name], f"s{k}") for k, (name, _) in enumerate(placed))
    return Build("b", "", hull, pairs, Conditions(air_kg_m3=1.2, helium_kg_m3=0.2))


def test_the_centre_of_mass_is_the_mean_of_places_by_mass() -> None:
    build = build_of(("lipo-1300", (0.2, -0.4)), ("camera-v2", (-0.1, -0.1)))
    film = build.items[0].mass_g
    balance = balance_of(build)
    mass = film + 25 + 3
    assert balance.forward_m == pytest.approx((25 * 0.2 - 3 * 0.1) / mass, abs=6e-5)
    assert balance.up_m == pytest.approx(-(25 * 0.4 + 3 * 0.1) / mass, abs=6e-5)
    assert balance.pitch_deg is not None
    assert math.tan(math.radians(balance.pitch_deg)) == pytest.approx(
        balance.forward_m / -balance.up_m
    )


def test_weight_ahead_hangs_the_nose_down_and_weight_behind_up() -> None:
    ahead = balance_of(build_of(("lipo-1300", (0.1, -0.3)))).pitch_deg
    behind = balance_of(build_of(("lipo-1300", (-0.1, -0.3)))).pitch_deg
    assert ahead is not None and behind is not None
    assert ahead > 0 > behind and ahead == -behind


def test_weight_above_the_lift_turns_it_over() -> None:
    assert balance_of(build_of(("lipo-1300", (0.0, 0.2)))).pitch_deg is None


def test_every_build_hangs_nearly_level() -> None:
    for name, build in shipped_builds().builds.items():
        pitch = balance_of(build).pitch_deg
        assert pitch is not None and abs(pitch) < 5, name


@pytest.mark.parametrize("free_lift_g", [0.5, 5, 50])
def test_the_climb_is_the_equation_of_motion(free_lift_g: float) -> None:
    height_m, moving_kg, drag, area_m2, air = 3.0, 0.45, 1.0, 0.53, 1.2
    said = climb_s(height_m, free_lift_g, moving_kg, drag, area_m2, air)
    speed = climbed = time_s = 0.0
    step_s = 1e-3
    while climbed < height_m:
        force = free_lift_g / 1000 * GRAVITY_M_S2 - 0.5 * air * drag * area_m2 * speed**2
        speed += force / moving_kg * step_s
        climbed += speed * step_s
        time_s += step_s
    assert said == pytest.approx(time_s, rel=2e-3)


def test_a_high_climb_is_at_the_terminal_speed() -> None:
    terminal = math.sqrt(0.005 * GRAVITY_M_S2 / (0.5 * 1.2 * 1.0 * 0.5))
    said = climb_s(1000, 5, 0.4, 1.0, 0.5, 1.2) - climb_s(900, 5, 0.4, 1.0, 0.5, 1.2)
    assert said == pytest.approx(100 / terminal, rel=1e-6)


def test_more_lift_climbs_faster_and_none_does_not() -> None:
    build = shipped_builds().named(None)
    light, trimmed = climb_of(build, 3.0), climb_of(with_ballast(build, 30), 3.0)
    assert light is not None and trimmed is not None and light < trimmed
    assert climb_of(with_ballast(build, 100), 3.0) is None
    with pytest.raises(HardwareError, match="has no mass"):
        balance_of(replace(build, placed=(), hull=replace(build.hull, free_lift_g=100.0)))
