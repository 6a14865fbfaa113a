"""Process models: tangents, noise, coasting, and what each expects of simulated flights."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.localization import process
from ground_station.localization.estimator import constant_velocity
from ground_station.localization.kinematics import Kinematics
from ground_station.localization.settings import MotionSettings
from ground_station.simulator import dynamics
from ground_station.simulator.motion import Motion, Mount
from ground_station.simulator.simulate import SimulationSettings, prepare_flight

DENSITY = process.Density(0.02, 0.05)
UP = np.array([0.05, -0.99, -0.12]) / np.linalg.norm([0.05, -0.99, -0.12])
MODELS = ("static", "constant_velocity", "blimp")


def swinging() -> Kinematics:
    """A camera that looks along the world's x, leans a little, moves and turns."""
    level = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    wTc = poses.pose(level, [1.0, 2.0, 1.5]) @ poses.exp([0.1, 0.3, -0.06, 0, 0, 0])
    twist = np.array([0.12, -0.25, 0.08, 0.2, -0.1, 0.6])
    return Kinematics(10**9, wTc, twist, np.diag(np.r_[np.full(6, 1e-4), np.full(6, 1e-2)]))


def after(state: Kinematics, dt_s: float) -> int:
    return state.time_ns + round(dt_s * 1e9)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("dt_s", [1 / 30, 0.4, 0.9])
def test_the_transition_is_the_derivative_of_the_mean(model, dt_s):
    settings, state = MotionSettings(model=model, coast_s=0.5), swinging()
    step = process.advance(state, after(state, dt_s), settings, DENSITY, UP)
    numeric = np.empty((12, 12))
    for i in range(12):
        push = np.zeros(12)
        push[i] = 1e-5
        ends = [
            process.advance(
                process.moved(state, sign * push, state.covariance),
                after(state, dt_s), settings, DENSITY, UP,
            ).state
            for sign in (-1, 1)
        ]  # fmt: skip
        numeric[:, i] = process.difference(*ends) / 2e-5
    if dt_s > settings.coast_s and model != "static":
        # The mean is held and its twist 0, while the covariance still moves on with the twist's
        # error: the tangent is that of a velocity that goes on.
        numeric[6:] = step.transition[6:]
        numeric[:6, :] += 0.4 * step.transition[6:, :]
    assert np.abs(step.transition - numeric).max() < 1e-6


@pytest.mark.parametrize("model", ["constant_velocity", "blimp"])
def test_two_half_steps_know_as_much_as_a_whole_one(model):
    settings, state = MotionSettings(model=model), swinging()
    state = dataclasses.replace(state, twist=state.twist * 0.3)
    up = state.wTc[2, :3]  # at rest: with a tilt the swing's axes would turn on the way
    whole = process.advance(state, after(state, 0.4), settings, DENSITY, up)
    half = process.advance(state, after(state, 0.2), settings, DENSITY, up)
    rest = process.advance(half.state, after(state, 0.4), settings, DENSITY, up)
    gap = process.difference(whole.state, rest.state)
    assert np.abs(gap[:3]).max() < 2e-3
    assert np.abs(gap[3:6]).max() < 2e-3
    whitened = np.linalg.inv(np.linalg.cholesky(whole.state.covariance))
    ratio = np.linalg.eigvalsh(whitened @ rest.state.covariance @ whitened.T)
    assert np.all((ratio > 0.9) & (ratio < 1.1))


def test_constant_velocity_makes_the_last_step_once_more_and_knows_its_noise():
    state, dt_s = swinging(), 0.1
    step = process.advance(state, after(state, dt_s), MotionSettings(), DENSITY)
    before = state.after(-dt_s)
    assert np.allclose(step.state.wTc, constant_velocity(before, state.wTc, 1.0), atol=1e-12)
    assert np.array_equal(step.state.twist, state.twist)
    # White acceleration of density q: q t³/3 and q t, correlated by √3/2.
    assert step.noise[0, 0] == pytest.approx(0.02 * dt_s**3 / 3)
    assert step.noise[9, 9] == pytest.approx(0.05 * dt_s)
    correlation = step.noise[4, 10] / np.sqrt(step.noise[4, 4] * step.noise[10, 10])
    assert correlation == pytest.approx(np.sqrt(3) / 2)


def test_a_static_pose_walks_at_random_and_forgets_its_velocity():
    settings, state = MotionSettings(model="static"), swinging()
    steps = [process.advance(state, after(state, dt), settings, DENSITY) for dt in (0.1, 0.2, 2.0)]
    for step in steps:
        assert np.allclose(step.state.wTc, state.wTc)
        assert not step.state.twist.any()
    grown = [step.state.covariance[3, 3] - state.covariance[3, 3] for step in steps]
    assert grown == pytest.approx([0.1 * settings.walk_translation_m2_s * k for k in (1, 2, 20)])


@pytest.mark.parametrize("model", ["constant_velocity", "blimp"])
def test_beyond_the_coast_the_pose_is_held_and_doubt_grows_over_what_was_dropped(model):
    settings, state = MotionSettings(model=model, coast_s=0.3), swinging()

    def to(dt_s: float) -> Kinematics:
        return process.advance(state, after(state, dt_s), settings, DENSITY, UP).state

    held = to(0.3)
    for dt_s in (0.31, 0.5, 2.0, 60.0):
        late = to(dt_s)
        assert np.allclose(late.wTc, held.wTc, atol=1e-9)
        assert not late.twist.any()
        # A camera that went on as before is no surprise.
        went_on = Kinematics(late.time_ns, held.after(dt_s - 0.3), held.twist, late.covariance)
        gap = process.difference(late, went_on)
        assert gap @ np.linalg.solve(late.covariance, gap) < 1.0
    sizes = [np.linalg.eigvalsh(to(dt).covariance[:6, :6]) for dt in (0.1, 0.29, 0.31, 0.5, 2, 60)]
    assert all((b > a).all() for a, b in itertools.pairwise(sizes))


@pytest.mark.parametrize("model", MODELS)
def test_no_step_is_too_short_to_invert_and_none_goes_back(model):
    settings, state = MotionSettings(model=model), swinging()
    for later_ns in (0, 1, 1000):
        noise = process.advance(state, state.time_ns + later_ns, settings, DENSITY, UP).noise
        np.linalg.cholesky(noise)
    with pytest.raises(ValueError, match="before the state's"):
        process.advance(state, state.time_ns - 1, settings, DENSITY, UP)


def test_moved_and_difference_are_each_others_inverse_and_poses_stay_rotations():
    state, rng = swinging(), np.random.default_rng(4)
    for _ in range(500):
        step = rng.normal(size=12) * 0.3
        end = process.moved(state, step, state.covariance)
        assert np.allclose(process.difference(state, end), step, atol=1e-9)
        state = end
    R = state.wTc[:3, :3]
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-12


def truth_of(motion: Motion, times_s: np.ndarray) -> list[Kinematics]:
    """True poses and twists, the latter by differences over 2 ms."""
    wTc, before, behind = (motion.wTc(times_s + h) for h in (0.0, -1e-3, 1e-3))
    return [
        Kinematics(
            round((t + 100) * 1e9), wTc[k],
            poses.log(poses.inverse(before[k]) @ behind[k]) / 2e-3, np.eye(12) * 1e-8,
        )
        for k, t in enumerate(times_s.tolist())
    ]  # fmt: skip


def rms_error(
    tracks: list[list[Kinematics]], model: str, gap: int, every: int = 11
) -> tuple[float, float]:
    """Of predictions over `gap` frames from true states: metres, radians. Up at rest: the mean."""
    settings, errors = MotionSettings(model=model, coast_s=5.0), []
    for track in tracks:
        up = np.mean([state.wTc[2, :3] for state in track], axis=0)
        up /= np.linalg.norm(up)
        for k in range(0, len(track) - gap, every):
            end = track[k + gap]
            step = process.advance(track[k], end.time_ns, settings, DENSITY, up)
            errors.append(process.difference(step.state, end)[:6])
    squares = np.array(errors) ** 2
    return float(np.sqrt(squares[:, 3:].sum(1).mean())), float(
        np.sqrt(squares[:, :3].sum(1).mean())
    )


def drifting(seed: int, duration_s: float = 7.0) -> list[Kinematics]:
    """The simulator's blimp with its motors off: it swings freely and slows down in the draught."""
    rng, blimp, step_s = np.random.default_rng(seed), dynamics.Blimp.of_build(), 1 / 200
    state = dynamics.BlimpState(
        [0.0, 0.0, 2.0], rng.normal(0, [0.5, 0.1, 0.1]).tolist(),
        [rng.uniform(-3, 3), *rng.normal(0, 0.06, 2)], rng.normal(0, [0.15, 0.08, 0.15]).tolist(),
    )  # fmt: skip
    rows, wind = np.empty((round(duration_s / step_s), 6)), np.zeros(3)
    decay = np.exp(-step_s / blimp.draught_time_s)
    for k in range(len(rows)):
        rows[k] = (*state.position_m, *state.angles_rad)
        wind = decay * wind + rng.normal(size=3) * blimp.draught_m_s * np.sqrt(1 - decay**2)
        dynamics.step(blimp, state, (0.0, 0.0, 0.0), 0.0, tuple(wind), step_s)
    motion = Motion(np.arange(len(rows)) * step_s, rows[:, :3], rows[:, 3:], Mount())
    return truth_of(motion, np.arange(15, 30 * (duration_s - 0.5)) / 30)


def test_the_blimp_model_expects_a_free_swing_best():
    tracks = [drifting(seed) for seed in (21, 22, 23, 24)]
    for gap in (9, 15, 30):  # 0.3 s to 1 s
        still, steady, blimp = (rms_error(tracks, model, gap) for model in MODELS)
        assert steady[0] < 0.3 * still[0]
        assert blimp[0] < 0.9 * steady[0]
        assert blimp[1] < 0.2 * steady[1]


def test_a_piloted_blimp_goes_on_as_it_went():
    # Thrust, not the swing, tilts a piloted blimp: constant velocity is the better guess there,
    # and why it is the default. The blimp model must still be far better than none.
    tracks = []
    for seed in (31, 32):
        settings = SimulationSettings(out=Path("none"), plan="loop", seed=seed, duration_s=20)
        motion = prepare_flight(settings).motion
        tracks.append(truth_of(motion, np.arange(15, 585) / 30))
    for gap in (9, 15, 30):
        still, steady, blimp = (rms_error(tracks, model, gap) for model in MODELS)
        assert steady[0] < 0.1 * still[0]
        assert steady[1] < 0.15 * still[1]
        assert blimp[0] < 0.15 * still[0]
        assert blimp[1] < 0.5 * still[1]
