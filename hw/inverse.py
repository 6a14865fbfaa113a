"""The questions backwards: the smallest envelope, the most battery, the ballast to neutral."""

from __future__ import annotations

from dataclasses import replace

from scipy.optimize import brentq

from hw.builds import Build, with_ballast
from hw.buoyancy import lift_in, margin_g
from hw.envelopes import Envelope
from hw.parts import Part
from hw.quantities import HardwareError

_SCALES = (0.05, 20.0)


def smallest_envelope(build: Build, required_g: float = 0.0) -> Envelope:
    """The hull's shape at the size that leaves exactly `required_g` of margin.

    Its film grows with the square of its lengths and its lift with the cube, so there is one size.
    Raises `HardwareError` for a hull known by its free lift, or where no size does.
    """
    hull, day = build.hull, build.conditions
    if hull.free_lift_g is not None:
        raise HardwareError(f"hull {hull.id!r} has a measured free_lift_g: its size is not known")
    rest = build.mass_g - hull.envelope.film_m2 * hull.film_g_m2 + required_g
    per_m3 = lift_in(day, 1.0)

    def surplus(factor: float) -> float:
        size = hull.envelope.scaled(factor)
        return size.volume_m3 * per_m3 - size.film_m2 * hull.film_g_m2 - rest

    low, high = _SCALES
    # Film beats lift in a very small hull: from the size where their difference is least it rises.
    low = max(low, 2 * hull.film_g_m2 * hull.envelope.film_m2
              / (3 * per_m3 * hull.envelope.volume_m3))  # fmt: skip
    if not (surplus(low) < 0 < surplus(high)):
        raise HardwareError(
            f"no size from {low:.3g} to {high:g} of the hull's has {required_g:g} g of margin"
        )
    return hull.envelope.scaled(float(brentq(surplus, low, high, xtol=1e-12)))


def most_battery(build: Build, required_g: float = 0.0) -> Part:
    """The payload's cell, grown until exactly `required_g` of margin are left.

    Capacity, mass and discharge current go together, as with cells of one kind. Raises
    `HardwareError` where there is no cell or not even an empty place for one.
    """
    cell = payload_cell(build)
    mass = cell.mass_g + margin_g(build) - required_g
    if mass <= 0:
        raise HardwareError(
            f"the margin of build {build.name!r} leaves {mass:.1f} g for the cell; allowed: above 0"
        )
    return cell_of(build, cell.capacity_mAh * mass / cell.mass_g)


def cell_of(build: Build, capacity_mAh: float) -> Part:
    """A cell of the payload's kind with another capacity: mass and rating go with it."""
    cell = payload_cell(build)
    factor = capacity_mAh / cell.capacity_mAh
    return replace(
        cell, mass_g=cell.mass_g * factor, spread_g=cell.spread_g * factor,
        capacity_mAh=capacity_mAh, max_discharge_A=cell.max_discharge_A * factor,
    )  # fmt: skip


def with_cell(build: Build, cell: Part) -> Build:
    old = payload_cell(build)
    placed = tuple(
        (cell, place) if part is old and place == "gondola" else (part, place)
        for part, place in build.placed
    )
    return replace(build, placed=placed)


def ballast_to_neutral(build: Build) -> float:
    """Grams to add so that it neither climbs nor sinks, the build's own ballast not counted.

    Raises `HardwareError` where it is too heavy already.
    """
    bare = with_ballast(build, 0.0)
    spare = margin_g(bare)
    if spare < 0:
        raise HardwareError(
            f"build {build.name!r} is {-spare:.1f} g too heavy; allowed: a margin of 0 g and more"
        )
    return spare


def payload_cell(build: Build) -> Part:
    """The cell in the gondola; raises `HardwareError` without one."""
    cell = build.part("cell", "gondola")
    if cell is None:
        raise HardwareError(f"build {build.name!r} has no cell in its gondola")
    return cell
