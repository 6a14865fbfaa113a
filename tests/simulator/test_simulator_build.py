"""The simulator flies what hw/ says, and that is what the shipped flights were flown with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground_station.simulator import scenes
from ground_station.simulator.dynamics import Blimp, fly
from ground_station.simulator.plans import Reference, plan_named
from ground_station.simulator.scene import SimulatorError
from ground_station.simulator.simulate import SimulationSettings, prepare_flight
from hw.builds import shipped_builds
from hw.flight import flight_model
from hw.quantities import HardwareError

FLOWN = {
    "semi_length_m": 0.85, "semi_width_m": 0.31, "mass_kg": 0.352, "added_axial": 0.14,
    "added_lateral": 0.78, "drag_axial": 0.30, "drag_lateral": 0.90, "weight_below_m": 0.10,
    "thrust_below_m": 0.10, "thrust_limit_N": 0.40, "swing_damping": 0.12, "air_kg_m3": 1.204,
    "helium_kg_m3": 0.170, "camera_forward_m": 0.12, "camera_up_m": -0.42,
    "camera_tilt_down_deg": 7.0,
}  # fmt: skip
"""As written down when the sample's flights were recorded. Not to be renewed with `builds.toml`:
where they differ the sample is of another vehicle, and has to be made again."""


def test_the_build_gives_the_flown_numbers_to_the_last_bit() -> None:
    assert {name: getattr(flight_model(), name) for name in FLOWN} == FLOWN
    assert {name: getattr(Blimp.of_build(), name) for name in FLOWN} == FLOWN


def test_a_flight_with_the_build_is_the_flight_with_the_flown_numbers() -> None:
    plan = plan_named("loop", scenes.build("atrium", 10), np.random.default_rng(1))
    reference = Reference(plan, 0.3)
    times = np.linspace(0, 3, 31)
    built = fly(reference, 3.0, np.random.default_rng(2)).wTc(times)
    flown = fly(reference, 3.0, np.random.default_rng(2), Blimp(**FLOWN)).wTc(times)
    assert np.array_equal(built, flown)


def test_the_builds_parts_make_its_mass_and_hang_where_it_was_flown() -> None:
    build = shipped_builds().named("atrium")
    assert build.ballast_g > 0
    assert sum(item.mass_g for item in build.items) == pytest.approx(352, abs=1e-6)
    moment = sum(item.mass_g * item.z_m for item in build.items)
    assert moment / 352 == pytest.approx(-0.10, abs=1e-4)


def test_another_build_flies_otherwise_or_is_refused_by_name(tmp_path: Path) -> None:
    assert Blimp.of_build("atrium") == Blimp.of_build()
    with pytest.raises(HardwareError, match=r"its hull has shape 'pillow'; allowed: 'ellipsoid'"):
        Blimp.of_build("zero-w-ina219")
    with pytest.raises(HardwareError, match=r"build 'nope' is unknown; there are: zero-w-ina219"):
        Blimp.of_build("nope")
    by_hand = SimulationSettings(out=tmp_path / "f.mcap", plan="fast", build="atrium")
    with pytest.raises(SimulatorError, match=r"build is 'atrium'; plan 'fast' flies none"):
        prepare_flight(by_hand)
