"""Lift and margin with their uncertainty, propagated linearly."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import NormalDist

from hw.builds import UNCERTAIN, Build, Conditions
from hw.quantities import RANGES, checked

THESIS_GROSS_G = 202.1
"""What the thesis prints for 0.1905 m³, 1.2260 and 0.1693 kg/m³; the product is 201.3 g."""


def gross_lift_g(volume_m3: float, air_kg_m3: float, helium_kg_m3: float) -> float:
    """Mass that a volume of helium lifts in air, g: Archimedes, less the helium's own mass."""
    checked("volume_m3", volume_m3)
    return 1000 * volume_m3 * (air_kg_m3 - helium_kg_m3)


def lift_in(conditions: Conditions, volume_m3: float) -> float:
    """Gross lift, g, of an envelope that held `volume_m3` when it was filled.

    A foil envelope that has leaked hangs slack: what is left keeps its density and fills less.
    """
    air, helium = conditions.densities_kg_m3
    return gross_lift_g(volume_m3, air, helium) * conditions.gas_left


def gross_of(build: Build) -> float:
    """A build's gross lift, g; with a measured free lift, that, to which the film is no weight."""
    if build.hull.free_lift_g is not None:
        return build.hull.free_lift_g
    return lift_in(build.conditions, build.hull.envelope.volume_m3)


def margin_g(build: Build) -> float:
    """Gross lift less everything that flies, g: what is left to carry, or missing."""
    return gross_of(build) - build.mass_g


@dataclass(frozen=True)
class Margin:
    """A build's margin, g, and how sure it is.

    `parts_sigma_g` is what each uncertain input adds to `sigma_g` (their squares sum to its
    square), largest first. `low_g`, `high_g` hold 90 % of builds and days, `positive_share` of them
    fly, if the margin is normal.
    """

    gross_g: float
    mass_g: float
    margin_g: float
    sigma_g: float
    parts_sigma_g: dict[str, float]
    low_g: float
    high_g: float
    positive_share: float


def sigmas(build: Build) -> dict[str, float]:
    """What each uncertain input adds to the margin's standard deviation, g: |∂margin| σ.

    Derivatives by central differences over one σ, one-sided at the end of an input's range.
    """
    result: dict[str, float] = {}
    hull, day = build.hull, build.conditions
    if hull.free_lift_g is not None:
        result["free lift, measured"] = hull.free_lift_spread_g
    else:
        volume = hull.envelope.volume_m3
        result["volume"] = abs(lift_in(day, volume)) * hull.volume_sigma_percent / 100
        for name in _sigmas_that_act(day):
            sigma, value = day.sigma_of(name), getattr(day, name)
            low, high = max(value - sigma, RANGES[name][0]), min(value + sigma, RANGES[name][1])
            up = lift_in(replace(day, **{name: high}), volume)
            down = lift_in(replace(day, **{name: low}), volume)
            result[name] = abs(up - down) / (high - low) * sigma
    for item_name, spread in _mass_spreads(build).items():
        result[item_name] = spread
    return dict(sorted(result.items(), key=lambda pair: -pair[1]))


def _sigmas_that_act(day: Conditions) -> list[str]:
    """Inputs with a spread that densities follow: none of those that are given themselves."""
    dead: set[str] = set()
    if day.air_kg_m3 is not None:
        dead |= {"humidity_percent"}
    if day.helium_kg_m3 is not None:
        dead |= {"purity_percent", "superpressure_Pa"}
    if dead >= {"humidity_percent", "purity_percent"}:
        dead |= {"temperature_C", "pressure_hPa"}
    if day.altitude_m is not None:
        dead |= {"pressure_hPa"}
    return [n for n in UNCERTAIN if n not in dead and day.sigma_of(n) > 0]


def _mass_spreads(build: Build) -> dict[str, float]:
    """Spread by name; two of one part are equally wrong, so theirs add straight."""
    spreads: dict[str, float] = {}
    for item in build.items:
        if item.spread_g > 0:
            spreads[item.name] = spreads.get(item.name, 0.0) + item.spread_g
    return spreads


def margin_of(build: Build) -> Margin:
    """Everything about a build's margin."""
    parts, margin = sigmas(build), margin_g(build)
    sigma = math.hypot(*parts.values())
    spread = NormalDist(margin, max(sigma, 1e-9))
    return Margin(
        gross_of(build), build.mass_g, margin, sigma, parts, spread.inv_cdf(0.05),
        spread.inv_cdf(0.95), 1 - spread.cdf(0),
    )  # fmt: skip
