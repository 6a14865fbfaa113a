"""The questions backwards: an answer put forwards again gives what was asked for."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hw.builds import Build, shipped_builds, with_ballast
from hw.buoyancy import margin_g
from hw.endurance import fly
from hw.inverse import ballast_to_neutral, most_battery, payload_cell, smallest_envelope, with_cell
from hw.quantities import HardwareError

BUILDS = tuple(shipped_builds().builds)


def resized(build: Build, factor: float) -> Build:
    hull = build.hull
    return replace(build, hull=replace(
        hull, diameter_m=hull.diameter_m * factor, length_m=hull.length_m * factor,
        width_m=hull.width_m * factor,
    ))  # fmt: skip


@settings(max_examples=10, deadline=None)
@given(st.sampled_from(BUILDS), st.floats(-20, 60))
def test_the_smallest_envelope_leaves_what_was_required(name: str, required_g: float) -> None:
    build = shipped_builds().named(name)
    size = smallest_envelope(build, required_g)
    again = resized(build, size.length_m / build.hull.envelope.length_m)
    assert again.hull.envelope.volume_m3 == pytest.approx(size.volume_m3)
    assert margin_g(again) == pytest.approx(required_g, abs=1e-4)
    assert margin_g(resized(again, 0.99)) < required_g


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(BUILDS), st.floats(-10, 20))
def test_the_most_battery_leaves_what_was_required(name: str, required_g: float) -> None:
    build = shipped_builds().named(name)
    cell = most_battery(build, required_g)
    grown = with_cell(build, cell)
    assert margin_g(grown) == pytest.approx(required_g, abs=1e-4)
    # and back: the grown build's most battery for the margin of the first is the first's cell
    assert most_battery(grown, margin_g(build)).capacity_mAh == pytest.approx(
        payload_cell(build).capacity_mAh
    )


def test_another_payload_cell_leaves_the_motors_cell_alone() -> None:
    build = shipped_builds().named(None)
    grown = with_cell(build, most_battery(build))
    cells = [part.capacity_mAh for part, _ in grown.placed if part.role == "cell"]
    assert len(cells) == 2 and 500 in cells
    assert fly(grown).minutes > fly(build).minutes


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(BUILDS), st.floats(0, 30))
def test_ballast_to_neutral_is_neutral(name: str, before_g: float) -> None:
    build = with_ballast(shipped_builds().named(name), before_g)
    ballast = ballast_to_neutral(build)
    assert margin_g(with_ballast(build, ballast)) == pytest.approx(0, abs=1e-4)


def test_what_has_no_answer_is_refused() -> None:
    build = shipped_builds().named(None)
    with pytest.raises(HardwareError, match=r"leaves -\d+\.\d g for the cell; allowed: above 0"):
        most_battery(build, 100)
    heavy = resized(build, 0.8)
    with pytest.raises(HardwareError, match=r"is \d+\.\d g too heavy"):
        ballast_to_neutral(heavy)
    measured = replace(build, hull=replace(build.hull, free_lift_g=120.0))
    with pytest.raises(HardwareError, match="measured free_lift_g"):
        smallest_envelope(measured)
    bare = replace(build, placed=())
    with pytest.raises(HardwareError, match="no cell in its gondola"):
        most_battery(bare)
