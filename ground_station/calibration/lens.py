"""The lens from views of the board: weighted, robust bundle adjustment with poses eliminated.

Zhang's method (PAMI 2000): OpenCV's closed form begins, then all views' poses and the numbers of
the lens are adjusted together (Levenberg–Marquardt): nine of the five-parameter model, eight of
the fisheye, and how many there are says which it is. A fisheye begins as an equidistant lens. Poses
are eliminated by the Schur complement (Triggs et al. 2000, section 6.1), so that what is left is
the lens's own information: its inverse is the covariance that says whether the views determine it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ground_station.arrays import F64, Bools
from ground_station.calibration.errors import CalibrationError
from ground_station.geometry.camera import Camera
from ground_station.geometry.lens_models import MODELS, KannalaBrandt

NAMES = {model: ("fx_px", "fy_px", "cx_px", "cy_px", *kind.NAMES) for model, kind in MODELS.items()}
"""Each model's numbers, in the order of OpenCV's Jacobian."""
_MODEL = {len(names): model for model, names in NAMES.items()}
_ACROSS_DEG = (90, 110, 130, 150, 170, 190)
"""Fields of view across the picture that a fisheye is begun with."""
_STEEPEST = math.tan(math.radians(80.0))
"""On the plane z = 1, corners farther out have no useful place to find a pose by."""

_HUBER = 2.0
"""Deviations from which a corner counts less."""
_GROSS = 5.0
"""Deviations from which a corner does not count."""
_LEAST_SIGMA_PX = 0.02
_ROUNDS, _STEPS = 3, 40
_CONVERGED = 1e-7
"""Of the cost, in one step: far below what a deviation would change it by."""


@dataclass(frozen=True)
class Points:
    """A view as the adjustment takes it: board points (N, 3), metres, pixels (N, 2), deviation."""

    points_m: F64
    px: F64
    sigma_px: float


@dataclass
class Fit:
    """An adjusted lens.

    `theta` (D,) as in `names`, `poses` (V, 6) rotation vectors and translations cTb, `residuals`
    V times (N, 2) seen minus projected, pixels, `used` V times (N,). `information` (D, D) of the
    lens at unit variance, `covariance` (D, D), `sigma` the deviation of a corner by that of its
    view (1 where views' deviations were right).
    """

    theta: F64
    poses: F64
    residuals: list[F64]
    used: list[Bools]
    information: F64
    covariance: F64
    sigma: float

    @property
    def model(self) -> str:
        """As in the camera's file."""
        return model_of(self.theta)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the numbers."""
        return NAMES[self.model]

    @property
    def deviations(self) -> dict[str, float]:
        """The standard deviation of each number; infinite where nothing determines it."""
        with np.errstate(invalid="ignore"):
            values = np.sqrt(np.diag(self.covariance))
        values = np.nan_to_num(values, nan=np.inf)
        return {name: float(value) for name, value in zip(self.names, values, strict=True)}

    @property
    def rms_px(self) -> float:
        """Of the corners that count."""
        kept = [r[u] for r, u in zip(self.residuals, self.used, strict=True)]
        return rms(np.concatenate(kept))

    def view_rms_px(self) -> list[float]:
        """Of each view's corners that count."""
        return [rms(r[u]) for r, u in zip(self.residuals, self.used, strict=True)]

    def camera(self, size_px: tuple[int, int], readout_s: float = 0.0) -> Camera:
        """As the camera's file has it; raises `CameraError` for numbers that are none."""
        values: dict[str, Any] = dict(zip(self.names, map(float, self.theta), strict=True))
        values |= {"width_px": size_px[0], "height_px": size_px[1], "model": self.model}
        return Camera(readout_s=readout_s, **values)


def model_of(theta: F64) -> str:
    """The model of a lens (D,), as in the camera's file."""
    return _MODEL[len(theta)]


def rms(residuals: F64) -> float:
    """The root of the mean square of (N, 2) residuals' lengths; NaN of none."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else math.nan


def matrix(theta: F64) -> F64:
    """K (3, 3)."""
    fx, fy, cx, cy = theta[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def project(theta: F64, pose: F64, points_m: F64) -> tuple[F64, F64, F64]:
    """Pixels (N, 2) of board points, and their derivatives by pose (2N, 6) and lens (2N, D)."""
    if model_of(theta) == "fisheye":
        px, jacobian = cv2.fisheye.projectPoints(
            points_m.reshape(-1, 1, 3), pose[:3], pose[3:], matrix(theta), theta[4:]
        )
        J = np.asarray(jacobian, np.float64)
        return np.asarray(px, np.float64).reshape(-1, 2), J[:, 8:14], J[:, :8]
    px, jacobian = cv2.projectPoints(points_m, pose[:3], pose[3:], matrix(theta), theta[4:])
    J = np.asarray(jacobian, np.float64)
    return np.asarray(px, np.float64).reshape(-1, 2), J[:, :6], J[:, 6:15]


def locate(theta: F64, view: Points) -> F64 | None:
    """The board's pose (6,) in a view, None where there is none in front of the camera."""
    points, px, K, numbers = view.points_m, view.px, matrix(theta), theta[4:]
    if model_of(theta) == "fisheye":
        rays = KannalaBrandt(*numbers).rays(px, K)
        steep = np.hypot(rays[:, 0], rays[:, 1]) > _STEEPEST * rays[:, 2]
        kept = np.isfinite(rays[:, 2]) & ~steep
        points, px = points[kept], rays[kept, :2] / rays[kept, 2:]
        K, numbers = np.eye(3), np.zeros(5)
    try:
        ok, rvec, tvec = cv2.solvePnP(points, px, K, numbers)
    except cv2.error:
        return None
    pose = np.concatenate([rvec.ravel(), tvec.ravel()]) if ok else np.full(6, np.nan)
    return pose if np.isfinite(pose).all() and pose[5] > 0 else None


def information(theta: F64, pose: F64, view: Points) -> F64:
    """What one view tells of the lens (D, D) when its pose is not known."""
    _, Jp, Jl = project(theta, pose, view.points_m)
    U, C, V = Jp.T @ Jp, Jp.T @ Jl, Jl.T @ Jl
    return np.asarray((V - C.T @ np.linalg.lstsq(U, C, rcond=None)[0]) / view.sigma_px**2)


def first_guess(views: Sequence[Points], size_px: tuple[int, int], model: str = "opencv5") -> F64:
    """A lens (D,) to begin with: Zhang's closed form for the focal length, no distortion.

    Of a fisheye that closed form knows nothing: of equidistant lenses, the one that fits best.
    """
    centre = [(size_px[0] - 1) / 2, (size_px[1] - 1) / 2]
    if model == "fisheye":
        lenses = [
            np.array([f, f, *centre, 0, 0, 0, 0])
            for f in size_px[0] / np.radians(np.array(_ACROSS_DEG, np.float64))
        ]
        return min(lenses, key=lambda theta: _misfit_px(theta, views))
    points = [view.points_m.astype(np.float32) for view in views]
    px = [view.px.astype(np.float32) for view in views]
    focal = float(size_px[0])
    try:
        K = cv2.initCameraMatrix2D(points, px, size_px, 1.0)
        if np.isfinite(K).all() and 0.2 * size_px[0] < K[0, 0] < 10 * size_px[0]:
            focal = float(K[0, 0])
    except cv2.error:
        pass
    return np.array([focal, focal, *centre, 0, 0, 0, 0, 0])


def _misfit_px(theta: F64, views: Sequence[Points]) -> float:
    """How far corners are off in the middle one of views, each at its own pose; inf without any."""
    off = [math.inf]
    for view in views:
        if (pose := locate(theta, view)) is not None:
            off.append(rms(view.px - project(theta, pose, view.points_m)[0]))
        else:
            off.append(math.inf)
    return float(np.median(off))


def weak_prior(size_px: tuple[int, int], model: str = "opencv5") -> F64:
    """Information (D,) of what any lens is like, which keeps a first adjustment from running off.

    Principal point within a tenth of the width, mild distortion.
    """
    w = size_px[0]
    mild = [0.2] * 4 if model == "fisheye" else [0.5, 0.5, 0.01, 0.01, 0.5]
    return np.asarray(1 / np.array([10 * w, 10 * w, 0.1 * w, 0.1 * w, *mild]) ** 2)


def adjust(
    views: Sequence[Points], theta: F64, poses: Sequence[F64], prior: F64 | None = None
) -> Fit:
    """The lens and poses of least robust squares from a beginning; gross corners do not count.

    `prior` (D,) is information about `theta`'s beginning, None for none. Raises `CalibrationError`
    when it runs off.
    """
    problem = _Problem(views, theta, np.zeros(len(theta)) if prior is None else prior)
    state = theta.copy(), np.array(poses, np.float64)
    used = [np.ones(len(view.px), bool) for view in views]
    for _ in range(_ROUNDS):
        state = problem.minimise(state, used)
        residuals = problem.residuals(state)
        sigma = _spread(residuals, views)
        now = [
            np.linalg.norm(r, axis=1) <= _GROSS * math.sqrt(2) * sigma * view.sigma_px
            for r, view in zip(residuals, views, strict=True)
        ]
        if all((a == b).all() for a, b in zip(used, now, strict=True)):
            break
        used = now
    return problem.fit(state, used)


def _spread(residuals: Sequence[F64], views: Sequence[Points]) -> float:
    """A corner's deviation over its view's, by the median: wrong corners do not change it."""
    scaled = [np.abs(r).ravel() / v.sigma_px for r, v in zip(residuals, views, strict=True)]
    least = _LEAST_SIGMA_PX / min(view.sigma_px for view in views)
    return max(1.4826 * float(np.median(np.concatenate(scaled))), least)


class _Problem:
    """The equations of an adjustment."""

    def __init__(self, views: Sequence[Points], theta0: F64, prior: F64) -> None:
        self.views, self.theta0, self.prior = views, theta0, prior

    def residuals(self, state: tuple[F64, F64]) -> list[F64]:
        theta, poses = state
        return [
            view.px - project(theta, pose, view.points_m)[0]
            for view, pose in zip(self.views, poses, strict=True)
        ]

    def minimise(self, state: tuple[F64, F64], used: Sequence[Bools]) -> tuple[F64, F64]:
        """Levenberg–Marquardt with Huber's weights, reweighted each step (IRLS)."""
        damping = 1e-3
        scale = _spread(self.residuals(state), self.views)
        cost, parts = self._linearise(state, used, scale)
        for _ in range(_STEPS):
            trial = self._step(state, parts, damping)
            try:
                new_cost, new_parts = self._linearise(trial, used, scale)
            except cv2.error:
                new_cost = math.inf
            if new_cost < cost:
                gain = (cost - new_cost) / max(cost, 1e-12)
                state, cost, parts = trial, new_cost, new_parts
                damping = max(damping / 5, 1e-9)
                if gain < _CONVERGED:
                    break
                scale_now = _spread(self.residuals(state), self.views)
                if abs(scale_now - scale) > 0.02 * scale:
                    scale = scale_now
                    cost, parts = self._linearise(state, used, scale)
            else:
                damping *= 8
                if damping > 1e9:
                    break
        if not (np.isfinite(state[0]).all() and np.isfinite(state[1]).all()):
            raise CalibrationError("the calibration runs off: these views fit no camera")
        return state

    def _linearise(
        self, state: tuple[F64, F64], used: Sequence[Bools], scale: float
    ) -> tuple[float, list[tuple[F64, ...]]]:
        theta, poses = state
        off = theta - self.theta0
        cost = float(self.prior @ off**2)
        parts: list[tuple[F64, ...]] = []
        for view, pose, kept in zip(self.views, poses, used, strict=True):
            px, Jp, Jl = project(theta, pose, view.points_m)
            r = view.px - px
            norm = np.linalg.norm(r, axis=1) / (scale * view.sigma_px)
            weight = np.where(norm <= _HUBER, 1.0, _HUBER / np.maximum(norm, 1e-9)) * kept
            square = np.where(norm <= _HUBER, norm**2, 2 * _HUBER * norm - _HUBER**2)
            cost += float(square @ kept)
            w = np.repeat(weight, 2)[:, None] / (scale * view.sigma_px) ** 2
            WJp, WJl, flat = w * Jp, w * Jl, r.ravel()
            parts.append((Jp.T @ WJp, Jp.T @ WJl, Jl.T @ WJl, WJp.T @ flat, WJl.T @ flat))
        return (cost if math.isfinite(cost) else math.inf), parts

    def _step(
        self, state: tuple[F64, F64], parts: Sequence[tuple[F64, ...]], damping: float
    ) -> tuple[F64, F64]:
        theta, poses = state
        S = np.diag(self.prior)
        g = self.prior * (self.theta0 - theta)
        solved, count = [], len(theta)
        for U, C, V, gp, gl in parts:
            # A view of which no corner counts any more has no pose: its own stays.
            damped = U + damping * np.diag(np.diag(U)) + (1e-12 * np.trace(U) + 1e-9) * np.eye(6)
            both = np.linalg.solve(damped, np.column_stack([C, gp]))
            solved.append(both)
            S = S + V - C.T @ both[:, :count]
            g = g + gl - C.T @ both[:, count]
        unit = 1 / np.sqrt(np.maximum(np.diag(S), 1e-30))
        scaled = S * np.outer(unit, unit) + damping * np.eye(count)
        d_theta = unit * np.linalg.lstsq(scaled, unit * g, rcond=1e-14)[0]
        d_poses = np.array([both[:, count] - both[:, :count] @ d_theta for both in solved])
        return theta + d_theta, poses + d_poses

    def fit(self, state: tuple[F64, F64], used: list[Bools]) -> Fit:
        """The result with its covariance: of the corners' noise, or of the views' scatter.

        Corners of one view may err alike (a bent board, a shutter that rolls): each view's own
        gradient then tells the truth about the covariance (White 1980, Liang and Zeger 1986). The
        larger of the two stands.
        """
        theta, poses = state
        A = np.zeros((len(theta), len(theta)))
        scatter = np.zeros_like(A)
        residuals = self.residuals(state)
        squares, count = 0.0, 0
        for view, pose, kept, r in zip(self.views, poses, used, residuals, strict=True):
            keep = np.repeat(kept, 2)
            _, Jp, Jl = project(theta, pose, view.points_m)
            Jp, Jl = Jp[keep] / view.sigma_px, Jl[keep] / view.sigma_px
            flat = r[kept].ravel() / view.sigma_px
            own = Jl - Jp @ np.linalg.lstsq(Jp, Jl, rcond=None)[0]
            A += own.T @ own
            gradient = own.T @ flat
            scatter += np.outer(gradient, gradient)
            squares, count = squares + float(flat @ flat), count + len(flat)
        free = max(count - 6 * len(self.views) - len(theta), 1)
        variance = squares / free
        unit = 1 / np.sqrt(np.maximum(np.diag(A), 1e-30))
        values, vectors = np.linalg.eigh(A * np.outer(unit, unit))
        # What no view tells of at all must not look certain: a floor for the smallest eigenvalues.
        inverse = (vectors / np.maximum(values, 1e-14)) @ vectors.T
        inverse = inverse * np.outer(unit, unit)
        white = inverse * variance
        few = len(self.views) / max(len(self.views) - 1, 1)
        grouped = inverse @ scatter @ inverse * few
        stretch = np.sqrt(np.maximum(np.diag(grouped) / np.maximum(np.diag(white), 1e-300), 1.0))
        covariance = white * np.outer(stretch, stretch)
        return Fit(theta, poses, residuals, used, A, covariance, math.sqrt(variance))
