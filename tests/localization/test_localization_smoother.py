"""The fixed-lag smoother: against a Kalman filter and a batch, with white noise, at its limits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.localization import process
from ground_station.localization.kinematics import Kinematics, Solution
from ground_station.localization.settings import MotionSettings
from ground_station.localization.smoother import FixedLagSmoother
from ground_station.simulator.simulate import SimulationSettings, prepare_flight

FRAME_NS = 33_333_333
START = np.diag(np.r_[np.full(3, 0.02), np.full(3, 0.05), np.full(3, 0.1), np.full(3, 0.3)] ** 2)
SIGMA = np.r_[np.full(3, 0.01), np.full(3, 0.02)]
STEADY = MotionSettings(
    rotation_density_rad2_s3=0.05, translation_density_m2_s3=0.2, density_limit=1.0
)


def solve(predicted: Kinematics, measured: np.ndarray, sigma: np.ndarray = SIGMA) -> Solution:
    """What a solver makes of a prediction and a measured pose (4, 4): Gauss-Newton to the end."""
    weight, before = np.diag(sigma**-2.0), np.linalg.inv(predicted.covariance)
    state, information, gradient = predicted, np.zeros((12, 12)), np.zeros(12)
    for _ in range(5):
        error = process.difference(predicted, state)
        jacobian = np.eye(12)
        jacobian[:6, :6] = process.inverse_right_jacobian(error[:6])
        residual = poses.log(poses.inverse(measured) @ state.wTc)
        seen = process.inverse_right_jacobian(residual)
        information[:6, :6], gradient[:6] = seen.T @ weight @ seen, seen.T @ weight @ residual
        hessian = jacobian.T @ before @ jacobian + information
        step = -np.linalg.solve(hessian, jacobian.T @ before @ error + gradient)
        state = process.moved(state, step, np.linalg.inv(hessian))
    return Solution(state, information, gradient, np.zeros(0), np.zeros(0, bool))


@dataclass
class Run:
    """A drawn trajectory of the process itself, and what it looked like."""

    truth: dict[int, Kinematics]
    start: Kinematics
    measured: list[tuple[int, np.ndarray]]


def drawn(seed: int, count: int, settings: MotionSettings = STEADY) -> Run:
    rng, time_ns = np.random.default_rng(seed), 10**9
    density = process.Density(settings.rotation_density_rad2_s3, settings.translation_density_m2_s3)
    twist = np.array([0.1, -0.2, 0.1, 0.3, 0.1, 0.5])
    truth = Kinematics(time_ns, poses.exp([0.1, 0.2, 0.3, 1, 2, 1]), twist, START)
    start = process.moved(truth, rng.multivariate_normal(np.zeros(12), START), START)
    run = Run({time_ns: truth}, start, [])
    for _ in range(count):
        time_ns += FRAME_NS
        step = process.advance(truth, time_ns, settings, density)
        truth = process.moved(step.state, rng.multivariate_normal(np.zeros(12), step.noise), START)
        run.truth[time_ns] = truth
        run.measured.append((time_ns, truth.wTc @ poses.exp(rng.normal(size=6) * SIGMA)))
    return run


def through(smoother: FixedLagSmoother, run: Run) -> Iterator[tuple[Kinematics, list[Kinematics]]]:
    """The causal state of each frame and the smoothed ones that left with it."""
    smoother.begin(run.start)
    for time_ns, measured in run.measured:
        predicted = smoother.predict(time_ns)
        assert predicted is not None
        causal = smoother.update(solve(predicted, measured))
        yield causal, smoother.smoothed()


def squared(a: Kinematics, b: Kinematics, covariance: np.ndarray) -> float:
    """The Mahalanobis distance of two states, squared."""
    gap = process.difference(a, b)
    return float(gap @ np.linalg.solve(covariance, gap))


def nees(states: list[Kinematics], truth: dict[int, Kinematics]) -> list[float]:
    return [squared(state, truth[state.time_ns], state.covariance) for state in states]


def test_the_causal_state_is_that_of_an_extended_kalman_filter():
    run = drawn(1, 90)
    density = process.Density(0.05, 0.2)
    state = run.start
    for (time_ns, measured), (causal, _) in zip(
        run.measured, through(FixedLagSmoother(STEADY), run), strict=True
    ):
        predicted = process.advance(state, time_ns, STEADY, density).state
        state = solve(predicted, measured).state
        # In standard deviations: what differs is where the two are made linear.
        assert squared(state, causal, state.covariance) < 0.05**2
        sigma = np.sqrt(np.diag(state.covariance))
        assert np.sqrt(np.diag(causal.covariance)) == pytest.approx(sigma, rel=0.01)


def batch(run: Run, settings: MotionSettings) -> tuple[list[Kinematics], list[np.ndarray]]:
    """All states at once, by Gauss-Newton with numeric derivatives, and their covariances."""
    density = process.Density(settings.rotation_density_rad2_s3, settings.translation_density_m2_s3)
    states = [run.start]
    for time_ns, measured in run.measured:
        states.append(Kinematics(time_ns, measured, run.start.twist, START))

    def error(a: Kinematics, b: Kinematics) -> np.ndarray:
        step = process.advance(a, b.time_ns, settings, density)
        return np.linalg.inv(np.linalg.cholesky(step.noise)) @ process.difference(step.state, b)

    def derivative(function, state: Kinematics) -> np.ndarray:
        columns = [
            (function(process.moved(state, h, START)) - function(process.moved(state, -h, START)))
            / 2e-6
            for h in np.eye(12) * 1e-6
        ]
        return np.stack(columns, axis=1)

    def prior(state: Kinematics) -> np.ndarray:
        return np.linalg.inv(np.linalg.cholesky(START)) @ process.difference(run.start, state)

    n = 12 * len(states)
    for _ in range(4):
        H, g = np.zeros((n, n)), np.zeros(n)

        def add(at: list[int], blocks: list[np.ndarray], residual: np.ndarray, H=H, g=g) -> None:
            rows = np.concatenate([np.arange(12 * k, 12 * k + 12) for k in at])
            J = np.hstack(blocks)
            H[np.ix_(rows, rows)] += J.T @ J
            g[rows] += J.T @ residual

        add([0], [derivative(prior, states[0])], prior(states[0]))
        for k, (_, measured) in enumerate(run.measured, start=1):
            a, b = states[k - 1], states[k]
            by_a = derivative(lambda s, b=b: error(s, b), a)
            by_b = derivative(lambda s, a=a: error(a, s), b)
            add([k - 1, k], [by_a, by_b], error(a, b))

            def seen(state: Kinematics, z=measured) -> np.ndarray:
                return poses.log(poses.inverse(z) @ state.wTc) / SIGMA

            add([k], [derivative(seen, b)], seen(b))
        step = -np.linalg.solve(H, g)
        states = [process.moved(s, step[12 * k : 12 * k + 12], START) for k, s in enumerate(states)]
    inverse = np.linalg.inv(H)
    return states, [inverse[i : i + 12, i : i + 12] for i in range(0, n, 12)]


def test_the_states_of_the_lag_are_those_of_a_batch_of_all_frames():
    run, smoother = drawn(2, 20), FixedLagSmoother(replace(STEADY, smoother_lag_s=5.0))
    assert all(not left for _, left in through(smoother, run))
    states, covariances = batch(run, STEADY)
    ours = smoother.flush()
    assert [s.time_ns for s in ours] == [s.time_ns for s in states]
    for k, (smoothed, state, covariance) in enumerate(zip(ours, states, covariances, strict=True)):
        # The first two were far off when their factors were made linear.
        assert squared(state, smoothed, covariance) < (0.15 if k < 2 else 0.05) ** 2
        sigma = np.sqrt(np.diag(covariance))
        assert np.sqrt(np.diag(smoothed.covariance)) == pytest.approx(sigma, rel=0.02)
    assert smoother.latest is None and smoother.predict(10**12) is None


def test_with_white_noise_both_estimates_know_their_errors_and_the_later_one_has_less():
    causal, smoothed = [], []  # error and NEES of each state
    for seed in (3, 4):
        run = drawn(seed, 300)
        for state, left in through(FixedLagSmoother(STEADY), run):
            for told, states in ((causal, [state]), (smoothed, left)):
                errors = [process.difference(s, run.truth[s.time_ns]) for s in states]
                told += zip(errors, nees(states, run.truth), strict=True)
    rms = []
    for told in (causal, smoothed):
        errors, consistency = zip(*told, strict=True)
        # 12 degrees of freedom; neighbours in time are correlated: the mean strays by about one.
        assert 10.5 < np.mean(consistency) < 13.5
        rms.append(np.sqrt((np.array(errors).reshape(-1, 4, 3) ** 2).mean((0, 2))))
    assert (rms[1] < 0.75 * rms[0]).all()


def test_each_state_leaves_once_after_the_lag_and_used_later_frames():
    run, smoother = drawn(5, 100), FixedLagSmoother(STEADY)
    causal, left = {}, []
    for state, gone in through(smoother, run):
        causal[state.time_ns] = state
        for smoothed in gone:
            assert state.time_ns - smoothed.time_ns > 1e9
            assert state.time_ns - smoothed.time_ns <= 1e9 + FRAME_NS
        left += gone
    assert smoother.smoothed() == []
    left += smoother.flush()
    times = [run.start.time_ns, *causal]
    assert [s.time_ns for s in left] == times
    for smoothed in left[1:-40]:
        now = causal[smoothed.time_ns]
        assert (np.diag(smoothed.covariance) < np.diag(now.covariance)).all()
        assert np.abs(process.difference(now, smoothed)).max() > 1e-6
    # Of the newest frame nothing later is known.
    assert np.allclose(left[-1].wTc, causal[times[-1]].wTc, atol=1e-12)


def test_lost_frames_stretch_the_prediction_and_no_state_is_lost_in_a_gap():
    run, smoother = drawn(6, 160), FixedLagSmoother(replace(STEADY, coast_s=0.5))
    keep = [*run.measured[:40], *run.measured[52:70], *run.measured[130:]]  # 0.4 s and 2 s
    left, spans = [], []
    smoother.begin(run.start)
    for time_ns, measured in keep:
        predicted = smoother.predict(time_ns)
        spans.append(np.sqrt(np.diag(predicted.covariance)[3:6]).max())
        assert squared(predicted, run.truth[time_ns], predicted.covariance) < 50
        smoother.update(solve(predicted, measured))
        left += smoother.smoothed()
    assert spans[40] > 5 * spans[39]
    assert spans[58] > 5 * spans[40]
    left += smoother.flush()
    assert [s.time_ns for s in left] == [run.start.time_ns] + [t for t, _ in keep]
    assert np.mean(nees(left, run.truth)) < 18
    assert smoother.failures == 0


def after(seed: int, count: int) -> tuple[Run, FixedLagSmoother, Kinematics]:
    """A run, what has smoothed it, and what that predicts of the frame after it."""
    run, smoother = drawn(seed, count), FixedLagSmoother(STEADY)
    for _ in through(smoother, run):
        pass
    predicted = smoother.predict(run.measured[-1][0] + FRAME_NS)
    assert predicted is not None
    return run, smoother, predicted


NAN = np.full(12, np.nan)
HOSTILE = {
    "information is not a number": {"information": np.diag(NAN)},
    "information without end": {"information": np.diag(np.full(12, np.inf))},
    "information below zero": {"information": -1e9 * np.eye(12)},
    "information beyond numbers": {"information": np.diag(np.full(12, 1e305))},
    "gradient is not a number": {"gradient": NAN},
    "gradient beyond numbers": {"gradient": np.full(12, 1e300)},
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("covariance", [START, np.diag(NAN), np.zeros((12, 12)), -START])
def test_a_frame_that_no_filter_can_use_restarts_from_its_solution_and_says_so(name, covariance):
    run, smoother, predicted = after(7, 30)
    solution = solve(predicted, run.measured[-1][1])
    solution = replace(solution, state=replace(solution.state, covariance=covariance))
    given = solution.state
    state = smoother.update(replace(solution, **HOSTILE[name]))
    assert np.isfinite(state.wTc).all() and np.isfinite(state.covariance).all()
    np.linalg.cholesky(state.covariance)
    if name != "information beyond numbers":  # endless certainty is a certainty, too
        assert smoother.failures == 1
    assert np.allclose(state.wTc, given.wTc, atol=1e-6)
    # The states before were estimated before it came.
    for smoothed in smoother.smoothed():
        assert np.abs(process.difference(smoothed, run.truth[smoothed.time_ns])[:6]).max() < 0.2
    for k in range(1, 40):
        later_ns = predicted.time_ns + k * FRAME_NS
        truth = state.wTc @ poses.exp(state.twist * (k / 30))
        state_now = smoother.update(solve(smoother.predict(later_ns), truth))
    assert np.abs(poses.log(poses.inverse(truth) @ state_now.wTc)).max() < 0.05
    assert smoother.failures <= 1


@pytest.mark.parametrize("what", ["wTc", "twist"])
def test_a_solution_that_is_no_number_leaves_the_prediction(what):
    run, smoother, predicted = after(8, 30)
    solution = solve(predicted, run.measured[-1][1])
    bad = replace(solution.state, **{what: getattr(solution.state, what) * np.nan})
    state = smoother.update(replace(solution, state=bad))
    assert np.allclose(process.difference(predicted, state), 0, atol=1e-9)
    assert np.allclose(state.covariance, predicted.covariance)
    assert smoother.failures == 1


def test_a_frame_without_observations_says_what_the_prediction_says():
    _, smoother, predicted = after(9, 40)
    none = Solution(predicted, np.zeros((12, 12)), np.zeros(12), np.zeros(0), np.zeros(0, bool))
    state = smoother.update(none)
    assert np.allclose(process.difference(predicted, state), 0, atol=1e-9)
    assert np.allclose(state.covariance, predicted.covariance, rtol=1e-6)
    assert smoother.failures == 0


def test_time_does_not_go_back_and_nothing_is_known_before_a_start():
    run, smoother = drawn(10, 3), FixedLagSmoother(STEADY)
    assert smoother.latest is None and smoother.predict(0) is None and smoother.smoothed() == []
    assert smoother.flush() == []
    for _ in through(smoother, run):
        pass
    latest = smoother.latest
    solution = solve(smoother.predict(latest.time_ns + 1), latest.wTc)
    with pytest.raises(ValueError, match="before"):
        smoother.predict(latest.time_ns - 1)
    # The first solution is a start where none was given.
    fresh = FixedLagSmoother(STEADY)
    assert fresh.update(replace(solution, state=latest)).time_ns == latest.time_ns
    assert fresh.latest is not None and fresh.failures == 0
    # And so is one of the newest state's own time, as of a given pose's frame.
    again = replace(solution.state, time_ns=latest.time_ns)
    assert np.array_equal(smoother.update(replace(solution, state=again)).wTc, again.wTc)
    assert smoother.latest.time_ns == latest.time_ns and smoother.smoothed() == []


def test_frames_a_nanosecond_apart_do_no_harm():
    smoother, rng = FixedLagSmoother(STEADY), np.random.default_rng(11)
    truth = poses.exp([0.1, 0.2, 0.3, 1, 2, 1])
    smoother.begin(Kinematics(0, truth, np.zeros(6), START))
    for time_ns in range(1, 40):
        measured = truth @ poses.exp(rng.normal(size=6) * SIGMA)
        state = smoother.update(solve(smoother.predict(time_ns), measured))
    assert smoother.failures == 0
    assert np.abs(poses.log(poses.inverse(truth) @ state.wTc)).max() < 0.03


@pytest.mark.parametrize("density", [1e-5, 1e3])
@pytest.mark.parametrize("model", ["static", "constant_velocity", "blimp"])
def test_the_settings_limits_and_all_models_keep_the_graph_whole(model, density):
    settings = replace(
        STEADY, model=model, rotation_density_rad2_s3=density, translation_density_m2_s3=density
    )
    smoother = FixedLagSmoother(settings)
    states = [state for state, _ in through(smoother, drawn(12, 50))]
    assert smoother.failures == 0
    assert all(np.isfinite(state.covariance).all() for state in states)


def flown(plan: str, seed: int, settings: MotionSettings) -> tuple[list[float], FixedLagSmoother]:
    """Predictions' squared Mahalanobis distances from a simulated motion, 1/30 s to 0.5 s ahead."""
    flight = prepare_flight(
        SimulationSettings(out=Path("none"), plan=plan, seed=seed, duration_s=14.0)
    )
    times_s, rng = np.arange(3, 400) / 30, np.random.default_rng(seed)
    if plan == "fast":  # its run-up is over
        times_s = times_s[90:]
    wTc, before, behind = (flight.motion.wTc(times_s + h) for h in (0.0, -1e-3, 1e-3))
    sigma = np.r_[np.full(3, 0.002), np.full(3, 0.01)]
    smoother, distances = FixedLagSmoother(settings), []
    wide = np.diag(np.r_[np.full(3, 0.05), np.full(3, 0.1), np.full(3, 0.7), np.full(3, 1.5)] ** 2)
    times_ns = np.rint(times_s * 1e9).astype(np.int64).tolist()
    smoother.begin(Kinematics(times_ns[0], wTc[0], np.zeros(6), wide))
    for k in range(1, len(times_s) - 15):
        measured = wTc[k] @ poses.exp(rng.normal(size=6) * sigma)
        predicted = smoother.predict(times_ns[k])
        smoother.update(solve(predicted, measured, sigma))
        smoother.smoothed()
        if k > 90 and k % 4 == 0:
            for ahead in (1, 3, 6, 15):
                twist = poses.log(poses.inverse(before[k + ahead]) @ behind[k + ahead]) / 2e-3
                truth = Kinematics(times_ns[k + ahead], wTc[k + ahead], twist, wide)
                expected = smoother.predict(truth.time_ns)
                distances.append(squared(expected, truth, expected.covariance))
    return distances, smoother


def test_the_densities_follow_slow_and_fast_flights_so_that_predictions_know_their_errors():
    quiet, slow = flown("loop", 41, MotionSettings())
    shaken, fast = flown("fast", 42, MotionSettings())
    # 12 degrees of freedom. A slow flight may be doubted too much, not too little.
    assert 3 < np.mean(quiet) < 14
    assert 6 < np.mean(shaken) < 18
    assert fast.density(1 / 30).rotation > 100 * slow.density(1 / 30).rotation
    assert fast.density(1 / 30).translation > 30 * slow.density(1 / 30).translation
    # Without them the fast flight is far outside of what a quiet one expects.
    stiff, _ = flown("fast", 42, MotionSettings(density_limit=1.0))
    assert np.mean(stiff) > 100


def test_at_five_frames_a_second_a_prediction_does_not_hold_back_what_is_seen_alike_each_time():
    """Errors of a map are alike from frame to frame: nothing of them tells how a camera turns."""
    simulation = SimulationSettings(out=Path("none"), plan="loop", seed=41, duration_s=30.0)
    times_s, sigma = np.arange(1.0, 28.0, 0.2), np.r_[np.full(3, 0.002), np.full(3, 0.012)]
    wTcs = prepare_flight(simulation).motion.wTc(times_s)
    times_ns = np.rint(times_s * 1e9).astype(np.int64).tolist()
    smoother, late_m = FixedLagSmoother(MotionSettings()), []
    wide = np.diag(np.repeat([0.05, 0.1, 0.7, 1.5], 3) ** 2)
    smoother.begin(Kinematics(times_ns[0], wTcs[0], np.zeros(6), wide))
    for time_ns, wTc in zip(times_ns[1:], wTcs[1:], strict=True):
        state = smoother.update(solve(smoother.predict(time_ns), wTc, sigma))
        late_m.append(np.linalg.norm(state.wTc[:3, 3] - wTc[:3, 3]))
    assert np.sqrt(np.mean(np.square(late_m[10:]))) < 0.004  # 7 mm with one density for all steps
