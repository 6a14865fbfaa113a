"""Where the weight hangs under the lift: static pitch; and how a surplus of lift climbs."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hw.builds import Build
from hw.buoyancy import margin_g
from hw.quantities import HardwareError, checked

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
    """Seconds from rest to `height_m` with a surplus of lift; raises `HardwareError` without one.

    Buoyancy against drag, m v' = F − ½ρCA v², solved: h = m/k ln cosh(t √(Fk)/m). `moving_kg`
    holds the helium and the air that is carried along (added mass), too.
    """
    checked("height_m", height_m)
    checked("drag_coefficient", drag_coefficient)
    if not free_lift_g > 0:
        raise HardwareError(f"free_lift_g is {free_lift_g:g}; allowed: above 0")
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
