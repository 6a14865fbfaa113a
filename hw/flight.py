"""A build as the simulator flies it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from hw.balance import balance_of
from hw.catalogue import shipped_builds
from hw.quantities import HardwareError


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
