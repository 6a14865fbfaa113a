"""How a build hangs under its lift, climbs on a surplus of it, and is flown by the simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from hw.builds import Build, shipped_builds
from hw.buoyancy import margin_g
from hw.quantities import HardwareError

GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class Balance:
    """Centre of all mass but the helium, m forward and up of the centre of buoyancy.

    `pitch_deg` is nose down positive, None where the weight is not below: it turns over.
    """

    forward_m: float
    up_m: float
    pitch_deg: float | None


def balance_of(build: Build) -> Balance:
    """A build's balance. Helium and film act at the centre of buoyancy.

    At rest the weight hangs straight below the lift: tan pitch = forward / below. Rounded to
    0.1 mm, which is better than anybody places a part.
    """
    items = build.items
    mass = math.fsum(item.mass_g for item in items)
    if mass <= 0:
        raise HardwareError(f"build {build.name!r} has no mass; allowed: above 0 g")
    forward = round(math.fsum(i.mass_g * i.x_m for i in items) / mass, 4)
    up = round(math.fsum(i.mass_g * i.z_m for i in items) / mass, 4)
    pitch = math.degrees(math.atan2(forward, -up)) if up < 0 else None
    return Balance(forward, up, pitch)


def climb_s(
    height_m: float,
    free_lift_g: float,
    moving_kg: float,
    drag_coefficient: float,
    area_m2: float,
    air_kg_m3: float,
) -> float:
    """Seconds from rest to `height_m` with a surplus of lift, `free_lift_g` above 0.

    Buoyancy against drag, m v' = F − ½ρCA v², solved: h = m/k ln cosh(t √(Fk)/m). `moving_kg`
    holds the helium and the air that is carried along (added mass), too.
    """
    force = free_lift_g / 1000 * GRAVITY_M_S2
    k = 0.5 * air_kg_m3 * drag_coefficient * area_m2
    scale = moving_kg / math.sqrt(force * k)
    exponent = height_m * k / moving_kg
    # arcosh(e^x) = x + ln(1 + √(1 − e^(−2x))), which does not overflow
    return scale * (exponent + math.log1p(math.sqrt(-math.expm1(-2 * exponent))))


def climb_of(build: Build, height_m: float) -> float | None:
    """The same for a build with all its margin as free lift, s; None where it does not climb."""
    surplus = margin_g(build)
    if surplus <= 0:
        return None
    envelope, hull = build.hull.envelope, build.hull
    air, helium = build.conditions.densities_kg_m3
    moving = build.mass_g / 1000 + envelope.volume_m3 * (helium + hull.added_lateral * air)
    return climb_s(height_m, surplus, moving, hull.drag_lateral, envelope.plan_m2, air)


@dataclass(frozen=True)
class FlightModel:
    """A spheroid with what hangs under it, SI units; places are from its centre of buoyancy."""

    semi_length_m: float
    semi_width_m: float
    mass_kg: float
    """Hull, payload and trim, without the helium: neutral."""
    added_axial: float
    """Added mass over displaced mass along the nose."""
    added_lateral: float
    drag_axial: float
    """On the frontal area."""
    drag_lateral: float
    """On the side area."""
    weight_below_m: float
    """Centre of gravity below centre of buoyancy."""
    thrust_below_m: float
    """Propellers below the centre of buoyancy: thrust pitches the hull."""
    thrust_limit_N: float
    swing_damping: float
    """Damping ratio of pitch and roll."""
    air_kg_m3: float
    helium_kg_m3: float
    camera_forward_m: float
    camera_up_m: float
    camera_tilt_down_deg: float


@lru_cache
def flight_model(name: str | None = None) -> FlightModel:
    """The build of this name from `builds.toml`; None: the one that the simulator flies.

    Raises `HardwareError`: a hull that is no ellipsoid, no propulsion, no camera, or a weight that
    is not below.
    """
    catalogue = shipped_builds()
    build = catalogue.named(name or catalogue.simulated)
    hull, balance = build.hull, balance_of(build)
    if hull.shape != "ellipsoid":
        raise HardwareError(
            f"build {build.name!r}: its hull has shape {hull.shape!r}; allowed: 'ellipsoid'"
        )
    if balance.up_m >= 0:
        raise HardwareError(
            f"build {build.name!r} has its weight {balance.up_m:g} m above its lift"
        )
    arms = [place for part, place in build.placed if part.role == "mechanism"]
    propulsion = build.part("mechanism")
    cameras = [place for part, place in build.placed if part.role == "camera"]
    if propulsion is None or not cameras:
        raise HardwareError(f"build {build.name!r} lacks a camera or propulsion to fly with")
    air, helium = build.conditions.densities_kg_m3
    forward, up = hull.stations[cameras[0]]
    return FlightModel(
        semi_length_m=hull.length_m / 2,
        semi_width_m=hull.width_m / 2,
        mass_kg=build.mass_g / 1000,
        added_axial=hull.added_axial,
        added_lateral=hull.added_lateral,
        drag_axial=hull.drag_axial,
        drag_lateral=hull.drag_lateral,
        weight_below_m=-balance.up_m,
        thrust_below_m=-hull.stations[arms[0]][1],
        thrust_limit_N=propulsion.max_thrust_N,
        swing_damping=hull.swing_damping,
        air_kg_m3=air,
        helium_kg_m3=helium,
        camera_forward_m=forward,
        camera_up_m=up,
        camera_tilt_down_deg=hull.camera_tilt_down_deg,
    )
