"""How a state moves on between frames, with what is not known of it: the process models.

All are pure functions on `Kinematics`. The tangent of a state has twelve axes: the pose's right
tangent (rotation, translation), then the twist's.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.localization.kinematics import Kinematics
from ground_station.localization.settings import MotionSettings

_SHORTEST_S = 2e-3
"""Frames that are nearer count as this far apart: no noise becomes too small for a graph."""

_ZERO, _ONE = np.zeros((6, 6)), np.eye(6)
_POSE, _TWIST = np.arange(6), np.arange(6, 12)


@dataclass(frozen=True)
class Step:
    """A step of a process from one state to a later time.

    `state` is the mean with its covariance, transition·P·transitionᵀ + noise; `transition` (12, 12)
    takes tangent steps of the state before to those of the predicted one; `noise` (12, 12) is what
    the process itself does not know, never singular.
    """

    state: Kinematics
    transition: F64
    noise: F64


@dataclass(frozen=True)
class Density:
    """Spectral densities of the white acceleration: rad²/s³ and m²/s³ along each axis."""

    rotation: float
    translation: float

    def diagonal(self) -> F64:
        """(6,), rotation first."""
        return np.array([self.rotation] * 3 + [self.translation] * 3)


def right_jacobian(xi: F64) -> F64:
    """(6, 6) J of exp(ξ + δ) ≈ exp(ξ)·exp(J·δ). Barfoot 2017, section 7.1.5."""
    return np.asarray(gtsam.Pose3.ExpmapDerivative(xi))


def inverse_right_jacobian(xi: F64) -> F64:
    """(6, 6) J⁻¹ of log(exp(ξ)·exp(δ)) ≈ ξ + J⁻¹·δ."""
    return np.asarray(gtsam.Pose3.LogmapDerivative(gtsam.Pose3.Expmap(xi)))


def difference(a: Kinematics, b: Kinematics) -> F64:
    """The tangent step (12,) from state a to state b."""
    return np.concatenate([poses.log(poses.inverse(a.wTc) @ b.wTc), b.twist - a.twist])


def moved(state: Kinematics, step: F64, covariance: F64) -> Kinematics:
    """The state a tangent step (12,) away, with this covariance (12, 12)."""
    wTc = _rotation_again(state.wTc @ poses.exp(step[:6]))
    return Kinematics(state.time_ns, wTc, state.twist + step[6:], covariance)


def advance(
    state: Kinematics,
    time_ns: int,
    settings: MotionSettings,
    density: Density,
    rest_up: F64 | None = None,
) -> Step:
    """The step of the settings' process from a state to a later time.

    `density` is that of the velocity's white noise; the static process has its own settings.
    `rest_up` (3,), a unit vector, is where "up" lies in the camera's axes at rest, for the blimp;
    without it today's is taken. The velocity is carried on for `coast_s`. After that the pose is
    held and the velocity expected to be 0, and what was dropped of the mean counts as one standard
    deviation more. Raises `ValueError` when the time is before the state's.
    """
    if time_ns < state.time_ns:
        raise ValueError(f"time {time_ns} ns is before the state's, {state.time_ns} ns")
    dt_s = max((time_ns - state.time_ns) / 1e9, _SHORTEST_S)
    carried_s = min(dt_s, max(settings.coast_s, _SHORTEST_S))
    if settings.model == "static":
        wTc, twist, transition, noise = _static(state, dt_s, settings)
        carried_s = dt_s
    elif settings.model == "blimp":
        up = state.wTc[2, :3] if rest_up is None else rest_up
        wTc, twist, transition, noise = _blimp(state, carried_s, settings, density, up)
    else:
        wTc, twist, transition, noise = _constant_velocity(state, carried_s, density)
    if dt_s > carried_s:
        held_s = dt_s - carried_s
        hold = np.block([[_ONE, held_s * _ONE], [_ZERO, _ONE]])
        dropped = np.concatenate([twist * held_s, twist])
        transition = hold @ transition
        noise = hold @ noise @ hold.T + _integrated(density, held_s) + np.outer(dropped, dropped)
        twist = np.zeros(6)
    covariance = transition @ state.covariance @ transition.T + noise
    covariance = (covariance + covariance.T) / 2
    return Step(Kinematics(time_ns, _rotation_again(wTc), twist, covariance), transition, noise)


def _static(state: Kinematics, dt_s: float, settings: MotionSettings) -> tuple[F64, F64, F64, F64]:
    # A velocity that is drawn again each time: over one step its variance is walk/dt, so that the
    # pose walks at random, and nothing of the old one is kept.
    walk = np.array([settings.walk_rotation_rad2_s] * 3 + [settings.walk_translation_m2_s] * 3)
    transition = np.zeros((12, 12))
    transition[:6, :6] = _ONE
    return state.wTc, np.zeros(6), transition, np.diag(np.concatenate([walk * dt_s, walk / dt_s]))


def _constant_velocity(
    state: Kinematics, dt_s: float, density: Density
) -> tuple[F64, F64, F64, F64]:
    """White noise on acceleration: Anderson and Barfoot, IROS 2015, in right tangents."""
    step = state.twist * dt_s
    transition = _transition(step, dt_s * _ONE)
    return state.wTc @ poses.exp(step), state.twist, transition, _integrated(density, dt_s)


def _transition(step: F64, by_twist: F64) -> F64:
    """(12, 12) of wTc·exp(step) when a twist's step δ changes the tangent `step` by by_twist·δ."""
    result = np.eye(12)
    result[:6, :6] = poses.adjoint(poses.exp(-step))
    result[:6, 6:] = right_jacobian(step) @ by_twist
    return result


def _integrated(density: Density, dt_s: float) -> F64:
    """(12, 12): the white acceleration of `dt_s` in pose and twist. Barfoot 2017, eq. 3.129."""
    q = density.diagonal()
    result = np.zeros((12, 12))
    result[_POSE, _POSE] = q * (dt_s**3 / 3)
    result[_POSE, _TWIST] = result[_TWIST, _POSE] = q * (dt_s**2 / 2)
    result[_TWIST, _TWIST] = q * dt_s
    return result


def _blimp(
    state: Kinematics, dt_s: float, settings: MotionSettings, density: Density, rest_up: F64
) -> tuple[F64, F64, F64, F64]:
    """Drag, and pitch and roll as damped pendulums about the hull's turning point above the camera.

    All is linear in (tilt, rates, speed) at the turning point; a constant adjoint takes tangents
    of the camera there and back.

    Over 0.5 s of simulated motion it misses a blimp that drifts with its motors off by 7 mm and
    0.2°, constant velocity by 21 mm and 2.5° (seeds 21 to 24); but one that a pilot steers round a
    loop by 15 mm and 1.0° where constant velocity misses by 10 mm and 0.2° (seeds 31 and 32),
    because there the thrust tilts the hull, not the swing.
    """
    arm = np.eye(4)
    arm[:3, 3] = -settings.swing_arm_m * rest_up
    to_point, to_camera = poses.adjoint(arm), poses.adjoint(poses.inverse(arm))
    basis = _swing_axes(rest_up)
    twist = to_point @ state.twist
    w, v = basis.T @ twist[:3], twist[3:]
    up = state.wTc[2, :3]
    tilt = basis.T @ np.cross(up, rest_up)
    tilt[2] = 0.0
    spring = _oscillators(settings, np.array([dt_s]))[:, :, :, 0]
    angle = np.einsum("aij,aj->ai", spring, np.stack([tilt, w], axis=1))
    fade = np.exp(-dt_s / settings.drag_time_s)
    reach_s = settings.drag_time_s * (1 - fade)
    step = np.concatenate([basis @ (angle[:, 0] - tilt), v * reach_s])
    moved_twist = np.concatenate([basis @ angle[:, 1], v * fade])
    # The tangent: its pose part enters by the tilt, its twist part by rates and speed.
    by_turn = basis.T @ ((up @ rest_up) * np.eye(3) - np.outer(up, rest_up))
    tilts = np.array([1.0, 1.0, 0.0])
    by_pose, by_twist = np.zeros((6, 6)), np.zeros((6, 6))
    by_pose[:3, :3] = basis @ np.diag(tilts * (spring[:, 0, 0] - 1)) @ by_turn
    by_twist[:3, :3] = basis @ np.diag(spring[:, 0, 1]) @ basis.T
    by_twist[3:, 3:] = reach_s * np.eye(3)
    transition = _transition(step, by_twist)
    transition[:6, :6] += right_jacobian(step) @ by_pose
    transition[6:9, :3] = basis @ np.diag(tilts * spring[:, 1, 0]) @ by_turn
    transition[6:9, 6:9] = basis @ np.diag(spring[:, 1, 1]) @ basis.T
    transition[9:, 9:] = fade * np.eye(3)
    noise = _swing_noise(settings, density, dt_s, basis)
    there, back = np.kron(np.eye(2), to_point), np.kron(np.eye(2), to_camera)
    point = poses.inverse(arm)
    wTc = state.wTc @ point @ poses.exp(step) @ arm
    return wTc, to_camera @ moved_twist, back @ transition @ there, back @ noise @ back.T


def _swing_axes(rest_up: F64) -> F64:
    """(3, 3), columns: the axes of pitch and roll in the camera's axes, and up.

    Pitch is about the camera's x axis as far as that is level; a camera that looks along its
    nose is meant. One on its side takes its z axis instead.
    """
    side = np.array([1.0, 0.0, 0.0]) if abs(rest_up[0]) < 0.7 else np.array([0.0, 0.0, 1.0])
    pitch = side - rest_up * (side @ rest_up)
    pitch /= np.linalg.norm(pitch)
    return np.stack([pitch, np.cross(rest_up, pitch), rest_up], axis=1)


def _oscillators(settings: MotionSettings, after_s: F64) -> F64:
    """(3, 2, 2, N): what becomes of angle and rate of pitch, roll and yaw after N times.

    Damped oscillators for pitch and roll; yaw keeps its rate.
    """
    result = np.zeros((3, 2, 2, len(after_s)))
    result[2] = [[np.ones_like(after_s), after_s], [np.zeros_like(after_s), np.ones_like(after_s)]]
    zeta = settings.swing_damping
    for axis, period_s in enumerate((settings.pitch_period_s, settings.roll_period_s)):
        free = 2 * np.pi / period_s
        damped = free * np.sqrt(1 - zeta**2)
        fade = np.exp(-zeta * free * after_s)
        c, s = fade * np.cos(damped * after_s), fade * np.sin(damped * after_s) / damped
        result[axis] = [[c + zeta * free * s, s], [-(free**2) * s, c - zeta * free * s]]
    return result


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


def _swing_noise(settings: MotionSettings, density: Density, dt_s: float, basis: F64) -> F64:
    """(12, 12) at the turning point: each axis's answer to white acceleration, by quadrature."""
    after_s = (_NODES + 1) * dt_s / 2
    fade = np.exp(-after_s / settings.drag_time_s)
    along = np.stack([settings.drag_time_s * (1 - fade), fade])
    turning = _oscillators(settings, after_s)[:, :, 1, :]
    answer = np.concatenate([turning, np.broadcast_to(along, (3, 2, len(after_s)))])
    weights = _WEIGHTS * dt_s / 2
    each = np.einsum("ain,ajn,n->aij", answer, answer, weights) * density.diagonal()[:, None, None]
    turn = np.eye(6)
    turn[:3, :3] = basis
    noise = np.zeros((12, 12))
    for i in range(2):
        for j in range(2):
            noise[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = turn @ np.diag(each[:, i, j]) @ turn.T
    return noise


def _rotation_again(wTc: F64) -> F64:
    # Products of products grow their rounding error, as in `estimator.constant_velocity`. A step of
    # Newton and Schulz's iteration for the polar factor (Higham 1986) squares what is wrong.
    R = wTc[:3, :3]
    return poses.pose(R @ (1.5 * np.eye(3) - 0.5 * R.T @ R), wTc[:3, 3])
