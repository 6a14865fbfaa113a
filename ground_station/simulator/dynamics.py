"""The blimp: buoyancy, drag, added mass, swing, draughts, and a pilot that follows a plan.

A rigid ellipsoid with its weight below its centre of buoyancy. Added mass after Lamb
(Hydrodynamics, 1932, §114) as tabulated for prolate spheroids; drag as ½ρ C A v|v| along each body
axis; draughts as an Ornstein–Uhlenbeck process. The pilot is a PD controller with limited thrust.
Masses, sizes and coefficients are a build's, from `hw/builds.toml`.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from ground_station.simulator.motion import Motion, Mount
from ground_station.simulator.plans import Reference
from hw.flight import FlightModel, flight_model

GRAVITY_M_S2 = 9.81
_STEP_S = 1 / 200


@dataclass(frozen=True)
class Blimp(FlightModel):
    """A build in its air: a hull with semi-axes a, b, b, and what hangs under it."""

    draught_m_s: float = 0.05
    """Deviation of the air's speed along each axis; ASHRAE 55 allows 0.2 m/s where people sit."""
    draught_time_s: float = 4.0

    @classmethod
    def of_build(cls, name: str | None = None) -> Blimp:
        """A build of `hw/builds.toml`; None: the one that the simulator flies.

        Raises `HardwareError` with one line.
        """
        return cls(**asdict(flight_model(name)))

    @property
    def mount(self) -> Mount:
        """Where the build has its camera."""
        return Mount(self.camera_forward_m, self.camera_up_m, self.camera_tilt_down_deg)

    @property
    def volume_m3(self) -> float:
        """Of the ellipsoid."""
        return 4 / 3 * math.pi * self.semi_length_m * self.semi_width_m**2

    @property
    def net_lift_N(self) -> float:
        """Buoyancy less all weight."""
        return (self.volume_m3 * (self.air_kg_m3 - self.helium_kg_m3) - self.mass_kg) * GRAVITY_M_S2

    @property
    def inertial_mass_kg(self) -> tuple[float, float, float]:
        """Mass, helium and added mass along body x, y, z."""
        own = self.mass_kg + self.volume_m3 * self.helium_kg_m3
        air = self.volume_m3 * self.air_kg_m3
        return (
            own + self.added_axial * air,
            own + self.added_lateral * air,
            own + self.added_lateral * air,
        )

    @property
    def drag_N_per_m2_s2(self) -> tuple[float, float, float]:
        """½ρCA along body x, y, z."""
        front = math.pi * self.semi_width_m**2
        side = math.pi * self.semi_length_m * self.semi_width_m
        return (
            0.5 * self.air_kg_m3 * self.drag_axial * front,
            0.5 * self.air_kg_m3 * self.drag_lateral * side,
            0.5 * self.air_kg_m3 * self.drag_lateral * side,
        )

    @property
    def swing_rate_rad_s(self) -> tuple[float, float]:
        """Undamped frequencies of pitch and roll: √(m g h / I), I of the air moved included."""
        a, b = self.semi_length_m, self.semi_width_m
        hull = self.mass_kg + self.volume_m3 * self.helium_kg_m3
        air = self.volume_m3 * self.air_kg_m3
        pitch = (hull + 0.5 * air) * (a * a + b * b) / 5 + self.mass_kg * self.weight_below_m**2
        roll = hull * 2 * b * b / 5 + self.mass_kg * self.weight_below_m**2
        moment = self.mass_kg * GRAVITY_M_S2 * self.weight_below_m
        return math.sqrt(moment / pitch), math.sqrt(moment / roll)


@dataclass
class BlimpState:
    """Position and velocity in world axes, angles (yaw, pitch, roll) and their rates."""

    position_m: list[float]
    velocity_m_s: list[float]
    angles_rad: list[float]
    rates_rad_s: list[float]


def step(
    blimp: Blimp,
    state: BlimpState,
    thrust_N: tuple[float, float, float],
    yaw_acceleration_rad_s2: float,
    wind_m_s: tuple[float, float, float],
    dt_s: float,
) -> None:
    """One semi-implicit Euler step in place; thrust in (yawed) body axes, wind in the world's."""
    yaw = state.angles_rad[0]
    c, s = math.cos(yaw), math.sin(yaw)
    v, w = state.velocity_m_s, wind_m_s
    air = (v[0] - w[0], v[1] - w[1], v[2] - w[2])
    relative = (c * air[0] + s * air[1], -s * air[0] + c * air[1], air[2])
    mass, drag = blimp.inertial_mass_kg, blimp.drag_N_per_m2_s2
    a = [(thrust_N[i] - drag[i] * relative[i] * abs(relative[i])) / mass[i] for i in range(3)]
    a[2] += blimp.net_lift_N / mass[2]
    world = (c * a[0] - s * a[1], s * a[0] + c * a[1], a[2])
    for i in range(3):
        v[i] += world[i] * dt_s
        state.position_m[i] += v[i] * dt_s
    # Nose down positive: thrust below the hull lifts the nose, drag's moment is left out.
    wp, wr = blimp.swing_rate_rad_s
    arm = blimp.thrust_below_m / (blimp.mass_kg * GRAVITY_M_S2 * blimp.weight_below_m)
    forced = (yaw_acceleration_rad_s2, -wp * wp * arm * thrust_N[0], wr * wr * arm * thrust_N[1])
    free = (0.0, wp, wr)
    for i in range(3):
        rate, angle = state.rates_rad_s[i], state.angles_rad[i]
        spring = -(free[i] ** 2) * angle - 2 * blimp.swing_damping * free[i] * rate
        state.rates_rad_s[i] = rate + (forced[i] + spring) * dt_s
        state.angles_rad[i] = angle + state.rates_rad_s[i] * dt_s


def fly(
    reference: Reference,
    duration_s: float,
    rng: np.random.Generator,
    blimp: Blimp | None = None,
) -> Motion:
    """Flies a plan to its end, from 8 s before time 0, so that the start's swing has settled."""
    blimp = blimp or Blimp.of_build()
    lead_s = 8.0
    count = math.ceil((lead_s + duration_s + 0.5) / _STEP_S)
    times = np.arange(count) * _STEP_S - lead_s
    position, yaw = reference.at(times)
    speed = np.gradient(position, _STEP_S, axis=0)
    turn = np.gradient(yaw, _STEP_S)
    decay = math.exp(-_STEP_S / blimp.draught_time_s)
    kicks = rng.standard_normal((count, 3)) * blimp.draught_m_s * math.sqrt(1 - decay**2)
    wind = [0.0, 0.0, 0.0]
    state = BlimpState(
        position[0].tolist(),
        speed[0].tolist(),
        [float(yaw[0]), 0.0, 0.0],
        [float(turn[0]), 0.0, 0.0],
    )
    limit, mass = blimp.thrust_limit_N, blimp.inertial_mass_kg
    drag = blimp.drag_N_per_m2_s2
    rows = np.empty((count, 6))
    want, want_speed, want_yaw, want_turn, kick = (
        x.tolist() for x in (position, speed, yaw, turn, kicks)
    )
    for k in range(count):
        rows[k] = (*state.position_m, *state.angles_rad)
        wind = [decay * wind[i] + kick[k][i] for i in range(3)]
        c, s = math.cos(state.angles_rad[0]), math.sin(state.angles_rad[0])
        # Position and speed errors ask for an acceleration; the drag at the wanted speed is known.
        ask = [
            0.6 * (want[k][i] - state.position_m[i])
            + 1.3 * (want_speed[k][i] - state.velocity_m_s[i])
            for i in range(3)
        ]
        body = (c * ask[0] + s * ask[1], -s * ask[0] + c * ask[1], ask[2])
        ws = want_speed[k]
        along = (c * ws[0] + s * ws[1], -s * ws[0] + c * ws[1], ws[2])
        thrust = tuple(
            max(-limit, min(limit, mass[i] * body[i] + drag[i] * along[i] * abs(along[i])))
            for i in range(3)
        )
        spin = 1.0 * (want_yaw[k] - state.angles_rad[0]) + 1.6 * (
            want_turn[k] - state.rates_rad_s[0]
        )
        step(blimp, state, thrust, spin, (wind[0], wind[1], wind[2]), _STEP_S)
    return Motion(times, rows[:, :3], rows[:, 3:], blimp.mount)
