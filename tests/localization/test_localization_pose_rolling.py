"""Pose and velocity by rows: against truth, finite differences, chi-square and GTSAM's graph."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA as CAMERA
from ground_station.localization import pose_rolling
from ground_station.localization.kinematics import Kinematics, LandmarkObservations, Solution
from ground_station.localization.pose_newton import Prior, Reprojection
from ground_station.localization.pose_rolling import solve_rolling
from ground_station.localization.settings import PoseSettings

TRUE = poses.exp([0.1, -0.4, 0.2, 1.0, 2.0, 3.0])
TWIST = np.array([0.2, -0.7, 0.3, 1.5, -0.5, 3.5])
SIGMA = np.repeat([0.02, 0.05, 0.3, 0.8], 3)
SETTINGS = PoseSettings(inlier_px=4.0, reject_outliers=True, min_inliers=6)


def _row_s(flat: np.ndarray) -> np.ndarray:
    middle = 0.5 * (CAMERA.height_px - 1)
    return CAMERA.readout_s * (CAMERA.distort(flat)[:, 1] - middle) / (2 * middle)


def _scene(
    rng: np.random.Generator,
    *,
    count: int = 300,
    noise_px: float = 1.0,
    landmark_m: float = 0.0,
    outliers: float = 0.0,
    twist: np.ndarray = TWIST,
    sigma: np.ndarray = SIGMA,
) -> tuple[Kinematics, LandmarkObservations, np.ndarray]:
    """A prediction and observations with exactly the errors they state, and which are wrong.

    Landmarks' covariances are four times as long along one random axis as across.
    """
    depth = rng.uniform(2, 8, count)
    flat = rng.uniform([-0.55, -0.42], [0.55, 0.42], (count, 2))
    row_s = _row_s(flat)
    points_c = np.c_[flat, np.ones(count)] * depth[:, None]
    points = np.stack(
        [
            poses.transform(TRUE @ poses.exp(twist * t), point[None])[0]
            for t, point in zip(row_s, points_c, strict=True)
        ]
    )
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    root = landmark_m * (np.eye(3) + 3 * axis[:, :, None] * axis[:, None, :])
    points = points + np.einsum("nij,nj->ni", root, rng.normal(size=(count, 3)))
    pixels = flat * [CAMERA.fx_px, CAMERA.fy_px] + [CAMERA.cx_px, CAMERA.cy_px]
    pixels = pixels + rng.normal(0, noise_px, (count, 2))
    wrong = np.zeros(count, bool)
    wrong[rng.permutation(count)[: round(outliers * count)]] = True
    pixels[wrong] += rng.uniform(-40, 40, (int(wrong.sum()), 2))
    error = sigma * rng.normal(size=12)
    predicted = Kinematics(
        5, TRUE @ poses.inverse(poses.exp(error[:6])), twist - error[6:], np.diag(sigma**2)
    )
    sigma, even = np.full(count, noise_px), np.ones(count)
    still = np.zeros_like(points)
    seen = LandmarkObservations(points, pixels, row_s, sigma, root @ root, even, still)
    return predicted, seen, wrong


def _error(state: Kinematics, twist: np.ndarray = TWIST) -> np.ndarray:
    """From an estimate to the truth (12,): right tangent of the pose, then of the twist."""
    return np.concatenate([poses.log(poses.inverse(state.wTc) @ TRUE), twist - state.twist])


def test_pose_and_velocity_are_recovered_among_a_fifth_of_outliers():
    predicted, observations, wrong = _scene(np.random.default_rng(1), outliers=0.2, noise_px=0.3)
    solution = solve_rolling(predicted, observations, CAMERA, SETTINGS)
    assert solution.state is not None, solution.reason
    error = _error(solution.state)
    assert np.linalg.norm(error[:3]) < np.deg2rad(0.02) and np.linalg.norm(error[3:6]) < 0.002
    assert np.linalg.norm(error[6:9]) < 0.1 and np.linalg.norm(error[9:]) < 0.3
    assert solution.state.time_ns == predicted.time_ns
    assert solution.inlier[~wrong].all() and solution.inlier[wrong].mean() < 0.1
    assert np.median(solution.residual_px[~wrong]) < 0.5
    assert solution.iterations < 10 and 0 < solution.innovation < 40


@pytest.mark.parametrize(
    ("aside_px", "constant", "blunt"),
    [(1.5, "_LEAST_MISS", 1.0), (3.5, "_FAR", 100.0)],  # as their sigma says; all inliers count
)
def test_pairs_that_are_a_little_wrong_do_not_turn_the_pose_where_the_others_fit(
    monkeypatch: pytest.MonkeyPatch, aside_px: float, constant: str, blunt: float
):
    def off(seed: int) -> float:
        """Of pictures that fit to 0.2 px and are said to fit to 2, with a sixth a bit aside."""
        predicted, observations, _ = _scene(np.random.default_rng(seed), noise_px=0.2)
        observations.pinhole_px[::6, 0] += aside_px
        told = dataclasses.replace(observations, sigma_px=np.full(len(observations), 2.0))
        state = solve_rolling(predicted, told, CAMERA, SETTINGS).state
        assert state is not None
        return float(np.linalg.norm(_error(state)[:3]))

    follows = [off(seed) for seed in range(5)]
    monkeypatch.setattr(pose_rolling, constant, blunt)
    assert np.mean(follows) < 0.6 * np.mean([off(seed) for seed in range(5)])


@pytest.mark.parametrize("noise_px", [0.2, 1.0, 1.6])
@pytest.mark.parametrize("told_px", [0.5, 2.0])
def test_the_noise_told_is_what_the_residuals_show_whatever_was_claimed(noise_px, told_px):
    settings = dataclasses.replace(SETTINGS, huber_k=100.0, inlier_px=50.0)
    predicted, observations, _ = _scene(np.random.default_rng(3), noise_px=noise_px)
    true = solve_rolling(
        predicted, observations, CAMERA, dataclasses.replace(settings, reject_outliers=False)
    )
    assert true.noise == 1.0
    told = dataclasses.replace(observations, sigma_px=np.full(len(observations), told_px))
    found = solve_rolling(predicted, told, CAMERA, settings)
    ratio = found.noise * np.linalg.inv(found.information) @ true.information
    np.testing.assert_allclose(np.trace(ratio) / 12, pose_rolling._NOISE_OF_MISS, rtol=0.3)


def test_without_the_rows_the_pose_is_many_times_worse():
    predicted, observations, _ = _scene(np.random.default_rng(2), noise_px=0.3)
    still = dataclasses.replace(observations, row_s=np.zeros(len(observations)))
    by_rows, at_once = (
        solve_rolling(predicted, s, CAMERA, dataclasses.replace(SETTINGS, inlier_px=20.0)).state
        for s in (observations, still)
    )
    near, far = (np.linalg.norm(_error(state)[3:6]) for state in (by_rows, at_once))
    assert far > 5 * near


@pytest.mark.parametrize("landmark_m", [0.0, 0.01])
def test_errors_are_as_large_as_the_covariance_says(landmark_m):
    """The mean of NEES over its degrees of freedom, within four of its own standard deviations.

    Huber's loss is kept out of reach, as its reweighting is no likelihood.
    """
    settings = dataclasses.replace(SETTINGS, huber_k=100.0, inlier_px=50.0)
    nees, innovations = [], []
    for seed in range(200):
        rng = np.random.default_rng(100 + seed)
        twist = TWIST * rng.normal(size=6)
        predicted, observations, _ = _scene(rng, count=80, landmark_m=landmark_m, twist=twist)
        solution = solve_rolling(predicted, observations, CAMERA, settings)
        error = _error(solution.state, twist)
        nees.append(error @ np.linalg.solve(solution.state.covariance, error))
        innovations.append(solution.innovation)
    spread = np.sqrt(2 * 12 / len(nees))
    assert abs(np.mean(nees) - 12) < 4 * spread
    # The solution lies nearer to the prediction than the truth, which is 12 away.
    assert 6 < np.mean(innovations) < 12


@pytest.mark.parametrize("twist", [TWIST, np.zeros(6)])
def test_the_jacobian_is_that_of_finite_differences(twist):
    observations = _scene(np.random.default_rng(3), count=40, twist=twist)[1]
    cost = Reprojection.of(observations, CAMERA, 1.345)
    J = cost.view(TRUE, twist).jacobian()
    step = 1e-6
    for k in range(12):
        move = np.eye(12)[k] * step
        there, here = (
            cost.view(TRUE @ poses.exp(sign * move[:6]), twist + sign * move[6:]).residual_px
            for sign in (1, -1)
        )
        numeric = (there - here) / (2 * step)
        # The motion during the readout enters to first order; its square is left out.
        assert np.abs(J[k] - numeric).max() < 2e-3 * np.abs(numeric).max() + 1e-4


def test_gradient_and_landmarks_jacobian_are_those_of_finite_differences():
    rng = np.random.default_rng(4)
    predicted, observations, _ = _scene(rng, count=60, landmark_m=0.01, outliers=0.3)
    cost = Reprojection.of(observations, CAMERA, 1.345)
    start = cost.linearize(predicted.wTc, predicted.twist)
    for _ in range(3):  # the weights of outliers take a few rounds where landmarks are elongated
        start = cost.linearize(predicted.wTc, predicted.twist, start)
    prior = Prior(poses.inverse(TRUE), TWIST, np.linalg.inv(predicted.covariance))
    both = [start.gradient, prior.at(predicted.wTc, predicted.twist)[1]]
    step = 1e-6
    for k in range(12):
        move = np.eye(12)[k] * step
        ends = [(predicted.wTc @ poses.exp(s * move[:6]), predicted.twist + s * move[6:])
                for s in (1, -1)]  # fmt: skip
        frozen = [cost.linearize(*end, start).cost for end in ends]
        far = [prior.at(*end)[2] for end in ends]
        for analytic, (there, here) in zip(both, (frozen, far), strict=True):
            scale = np.abs(analytic).max()
            assert abs(analytic[k] - (there - here) / (2 * step)) < 2e-3 * scale
    view = cost.view(predicted.wTc, predicted.twist)
    for axis in range(3):
        moved = np.zeros((3, 60))
        moved[axis] = step
        numeric = (
            cost.view(predicted.wTc, predicted.twist, moved).residual_px - view.residual_px
        ) / step
        assert np.allclose(view.rows()[:, axis], numeric, rtol=1e-4, atol=1e-2)


def _graph(predicted: Kinematics, observations: LandmarkObservations, k: float) -> np.ndarray:
    """The same objective with a variable for each landmark, by GTSAM to convergence; no rows."""
    calibration = gtsam.Cal3_S2(CAMERA.fx_px, CAMERA.fy_px, 0.0, CAMERA.cx_px, CAMERA.cy_px)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start = gtsam.Pose3(predicted.wTc)
    values.insert(X(0), start)
    pose_noise = gtsam.noiseModel.Gaussian.Covariance(predicted.covariance[:6, :6])
    graph.add(gtsam.PriorFactorPose3(X(0), start, pose_noise))
    for i, point in enumerate(observations.points_m):
        noise = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Huber.Create(k),
            gtsam.noiseModel.Isotropic.Sigma(2, observations.sigma_px[i]),
        )
        values.insert(L(i), point)
        pixel = observations.pinhole_px[i]
        graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel, noise, X(0), L(i), calibration))
        model = gtsam.noiseModel.Gaussian.Covariance(observations.covariance_m2[i])
        graph.add(gtsam.PriorFactorPoint3(L(i), point, model))
    params = gtsam.GaussNewtonParams()
    params.setMaxIterations(200)
    params.setRelativeErrorTol(1e-13)
    params.setAbsoluteErrorTol(1e-13)
    result = gtsam.GaussNewtonOptimizer(graph, values, params).optimize()
    return result.atPose3(X(0)).matrix()


@pytest.mark.parametrize("seed", range(30, 33))
def test_the_optimum_is_the_graphs_with_elongated_landmarks(seed):
    rng = np.random.default_rng(seed)
    still = np.zeros(6)
    predicted, observations, _ = _scene(
        rng, count=400, landmark_m=0.008, outliers=0.2, twist=still, noise_px=2.0
    )
    observations = dataclasses.replace(observations, row_s=np.zeros(len(observations)))
    settings = dataclasses.replace(SETTINGS, reject_outliers=False)
    state = solve_rolling(predicted, observations, CAMERA, settings).state
    apart = poses.log(poses.inverse(_graph(predicted, observations, settings.huber_k)) @ state.wTc)
    assert np.abs(apart).max() < 1e-5


def test_a_global_shutter_leaves_the_velocity_as_predicted():
    rng = np.random.default_rng(5)
    predicted, observations, _ = _scene(rng, twist=np.zeros(6))
    observations = dataclasses.replace(observations, row_s=np.zeros(len(observations)))
    solution = solve_rolling(predicted, observations, CAMERA, SETTINGS)
    assert np.allclose(solution.state.twist, predicted.twist, atol=1e-12)
    assert np.allclose(solution.state.covariance[6:, 6:], predicted.covariance[6:, 6:])
    assert not solution.information[6:].any() and not solution.gradient[6:].any()


def test_two_observations_do_beside_a_prediction():
    rng = np.random.default_rng(7)
    predicted, observations, _ = _scene(rng, count=2)
    solution = solve_rolling(
        predicted, observations, CAMERA, dataclasses.replace(SETTINGS, min_inliers=2)
    )
    assert solution.state is not None, solution.reason
    before, after = np.diag(predicted.covariance), np.diag(solution.state.covariance)
    assert (after < before * (1 + 1e-9)).all() and after[:2].max() < 0.5 * before[0]


def test_the_observations_alone_are_told_for_a_smoother():
    """Their information and the prior's make up the posterior, and their gradients cancel."""
    predicted, observations, _ = _scene(np.random.default_rng(8), landmark_m=0.01)
    solution = solve_rolling(predicted, observations, CAMERA, SETTINGS)
    state = solution.state
    prior = Prior(
        poses.inverse(predicted.wTc), predicted.twist, np.linalg.inv(predicted.covariance)
    )
    information, gradient, _ = prior.at(state.wTc, state.twist)
    total = information + solution.information
    assert np.allclose(np.linalg.inv(total), state.covariance, rtol=1e-6, atol=1e-12)
    left = gradient + solution.gradient
    assert left @ state.covariance @ left < 1e-3
    assert gradient @ state.covariance @ gradient > 0.1


def test_points_behind_reward_no_step():
    """A third of the landmarks is behind: they are no inliers, and the others' pose is found."""
    predicted, observations, _ = _scene(np.random.default_rng(9), count=90)
    points = observations.points_m.copy()
    away = poses.transform(poses.inverse(TRUE), points[:30])
    points[:30] = poses.transform(TRUE, away * [1, 1, -1])
    solution = solve_rolling(
        predicted, dataclasses.replace(observations, points_m=points), CAMERA, SETTINGS
    )
    assert solution.state is not None, solution.reason
    assert not solution.inlier[:30].any() and solution.inlier[30:].all()
    assert np.isinf(solution.residual_px[:30]).all()
    assert np.linalg.norm(_error(solution.state)[3:6]) < 0.01
    none = dataclasses.replace(observations, points_m=np.tile(points[:1], (90, 1)))
    failed = solve_rolling(predicted, none, CAMERA, SETTINGS)
    assert failed.state is None and failed.reason


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("points_m", np.nan, "points_m is not finite"),
        ("pinhole_px", np.inf, "pinhole_px is not finite"),
        ("row_s", np.nan, "row_s is not finite"),
        ("covariance_m2", np.nan, "covariance_m2 is not finite"),
        ("sigma_px", 0.0, "sigma_px is not positive"),
    ],
)
def test_observations_that_cannot_be_used_are_named(field, value, said):
    predicted, observations, _ = _scene(np.random.default_rng(10), count=20)
    values = getattr(observations, field).copy()
    values[3] = value
    solution = solve_rolling(
        predicted, dataclasses.replace(observations, **{field: values}), CAMERA, SETTINGS
    )
    assert solution.state is None and solution.reason == said
    assert len(solution.inlier) == len(solution.residual_px) == 20 and not solution.inlier.any()


def test_a_prediction_that_cannot_be_used_is_named():
    predicted, observations, _ = _scene(np.random.default_rng(11), count=20)
    few = dataclasses.replace(
        observations, **{name: values[:3] for name, values in vars(observations).items()}
    )
    none = dataclasses.replace(
        observations, **{name: values[:0] for name, values in vars(observations).items()}
    )
    assert solve_rolling(predicted, few, CAMERA, SETTINGS).reason == "3 inliers"
    assert solve_rolling(predicted, none, CAMERA, SETTINGS).reason == "0 inliers"
    negative = predicted.covariance.copy()
    negative[0, 3] = negative[3, 0] = 1.0
    for covariance, said in (
        (negative, "the prediction's covariance is not positive definite"),
        (np.full((12, 12), np.nan), "the prediction's covariance is not finite"),
    ):
        bad = dataclasses.replace(predicted, covariance=covariance)
        assert solve_rolling(bad, observations, CAMERA, SETTINGS).reason == said
    certain = dataclasses.replace(predicted, covariance=np.zeros((12, 12)))
    state = solve_rolling(
        certain, observations, CAMERA, dataclasses.replace(SETTINGS, inlier_px=90.0)
    )
    assert np.allclose(state.state.wTc, predicted.wTc, atol=1e-6)
    stopped = dataclasses.replace(SETTINGS, max_iterations=1)
    assert "not converged" in solve_rolling(predicted, observations, CAMERA, stopped).reason


def test_no_cycle_where_half_of_few_observations_are_wrong():
    """Newton's steps on Huber's loss can go round in circles there."""
    sigma = np.repeat([0.1, 0.25, 0.3, 0.8], 3)
    for seed in range(670, 690):  # 678 did
        rng = np.random.default_rng(seed)
        predicted, observations, _ = _scene(
            rng, count=30, landmark_m=0.005, outliers=0.5, sigma=sigma
        )
        solution = solve_rolling(predicted, observations, CAMERA, SETTINGS)
        assert "converged" not in solution.reason, seed


def test_it_says_how_the_pose_follows_the_focal_length():
    rng = np.random.default_rng(5)
    predicted, seen, _ = _scene(rng, noise_px=0.3)
    loose = np.r_[np.full(6, 1e4), np.ones(6)]  # of the pose the observations alone shall say
    predicted = dataclasses.replace(predicted, covariance=predicted.covariance * np.diag(loose))
    centre, share = np.array([CAMERA.cx_px, CAMERA.cy_px]), 1e-3

    # A map that its lens bends: along, and round a corner.
    x, y, z = seen.points_m.T
    bend = np.stack([2 + 0.1 * z * z, 0 * y, 1.5 * x], axis=1)

    def solved(frames: float, maps: float) -> Solution:
        observations = dataclasses.replace(
            seen,
            pinhole_px=centre + (seen.pinhole_px - centre) / (1 + frames),
            points_m=seen.points_m + maps * bend,
            by_focal_m=bend,
        )
        found = solve_rolling(predicted, observations, CAMERA, SETTINGS)
        assert found.state is not None
        return found

    told = solved(0, 0).pose_by_focal
    assert told is not None
    for follows, step in zip(told.T, np.diag([share, share]), strict=True):
        a, b = solved(*-step).state, solved(*step).state
        assert a is not None and b is not None
        moved = poses.log(poses.inverse(a.wTc) @ b.wTc) / (2 * share)
        assert np.linalg.norm(moved[3:]) > 1  # metres for the whole of a focal length
        assert np.allclose(follows, moved, atol=0.05 * np.abs(moved).max())
