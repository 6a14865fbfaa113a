"""Bundle adjustment with a free lens: poses, points and five-parameter camera, with its covariance.

COLMAP's adjustment knows no priors on intrinsics and gives no covariance of them beside robust
weights, so the few steps that a lens takes are Gauss–Newton's here, with the points and then the
poses eliminated by the Schur complement (Triggs et al., "Bundle adjustment: a modern synthesis",
Vision Algorithms 1999, section 6). Key points are the distorted ones, as they were found.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve
from scipy.sparse import bsr_array, csr_array
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64, I64
from ground_station.geometry.camera import Camera
from ground_station.geometry.lens_models import BrownConrady
from ground_station.map.landmarks import in_cameras
from ground_station.map.model import Model
from ground_station.mapping.sfm.models import among, without_points

PARAMETERS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
"""The order of a lens as a vector."""
_MOST_STEPS = 30
_FEWEST_OBSERVATIONS = 12
"""An image with fewer has a pose of its own making."""
_SETTLED = 1e-3, 3e-5
"""A step that lowers the cost by a smaller share is the last: with the first loss, the second."""
_MOST_IMAGES, _MOST_OBSERVATIONS = 160, 20_000
"""What decides nine numbers well enough: with more, what residuals have in common is what limits
the lens, not their count."""
_GROUPS = 10
"""Stretches of images whose residuals count as independent of each other's."""
_NEAREST = 0.01
"""Of an image's median depth: a point that is nearer is at the camera's centre, where it fits
whatever pixel. Where a camera turned on the spot each feature had 3 to 62 such points of some
10,000, the nearest at 1e-8; of 30 maps of walks and flights none had one."""
_CELLS = 4, 3
"""Parts of the image, across and down, that count as independent, too."""
_CAUCHY = 2.385
"""Scale of Cauchy's loss in standard deviations: 95 % as efficient as least squares on normal
residuals (Rey, "Introduction to robust and quasi-robust statistical methods", 1983)."""


@dataclass(frozen=True)
class Prior:
    """What is believed of a lens before: `mean` (9,) and `covariance` (9, 9) of `PARAMETERS`."""

    mean: F64
    covariance: F64


@dataclass(frozen=True)
class Adjusted:
    """The lens at the optimum, its covariance (9, 9), and what it explains.

    `sigma_px` is the robust standard deviation of a pixel coordinate. `curvature` (9, 9) is of the
    residuals' variance over the lens, as a share of it. `before` is the lens that the search began
    with.
    """

    camera: Camera
    covariance: F64
    sigma_px: float
    curvature: F64
    before: Camera

    @property
    def sigmas(self) -> F64:
        """Standard deviations (9,), in the order of `PARAMETERS`."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def sigma_focal(self) -> float:
        """Of the geometric mean of both focal lengths, as a share of it."""
        share = np.array([0.5 / self.camera.fx_px, 0.5 / self.camera.fy_px])
        return float(np.sqrt(share @ self.covariance[:2, :2] @ share))

    @property
    def explained(self) -> float:
        """Share of the residuals' variance that went with the change of the lens."""
        return self.left_by(self.before)

    def left_by(self, camera: Camera) -> float:
        """What another lens leaves more, as a share of the residuals' variance.

        The sum of squares is larger by it with that lens and the poses and points that are best for
        it, to second order.
        """
        off = vector(self.camera) - vector(camera)
        return float(off @ self.curvature @ off)


def vector(camera: Camera) -> F64:
    """A lens as a vector (9,), in the order of `PARAMETERS`."""
    return np.array([getattr(camera, name) for name in PARAMETERS])


def adjust(model: Model, camera: Camera, prior: Prior) -> Adjusted | None:
    """The lens by which a model fits best; poses and points move with it.

    `model.pixel_px` are distorted pixels; `camera` is where the search begins. A point that one
    image sees twice counts once there. None when a model is too small to say anything of a lens.
    """
    model = _thinned(_apart(_once(model)))
    freedom = 2 * len(model.image) - 3 * len(model.position) - 6 * len(model.names) + 7
    if len(model.names) < 3 or freedom <= len(PARAMETERS):
        return None
    problem = _Problem(model, prior)
    cTw = np.asarray(np.linalg.inv(model.wTc)[:, :3], np.float64)
    state = _State(vector(camera), cTw, model.position)
    for settled in _SETTLED:  # the loss follows the residuals, which the lens makes smaller
        scale = _CAUCHY * _robust_sigma(problem.residuals(state))
        state = problem.minimise(state, scale, settled)
    covariance, curvature = problem.covariance(state, scale)
    found = replace(camera, **dict(zip(PARAMETERS, state.lens.tolist(), strict=True)))
    sigma_px = _robust_sigma(problem.residuals(state))
    return Adjusted(found, covariance, sigma_px, curvature, camera)


@dataclass(frozen=True)
class _State:
    """Lens (9,), camera-from-world (K, 3, 4) and points (M, 3)."""

    lens: F64
    cTw: F64
    points: F64


@dataclass(frozen=True)
class _Normal:
    """The normal equations without the points, and what gives the points back.

    `S` (P + 9, P + 9) and `g` (P + 9,), P free pose parameters; `V_inv` (M, 3, 3); `W`
    (6 K, 3 M), of all poses' parameters, and `L` (3 M, 9) are the blocks between points and these;
    `g_points` (M, 3).
    """

    S: F64
    g: F64
    V_inv: F64
    W: bsr_array
    L: F64
    g_points: F64


class _Problem:
    """One model's observations, and the steps over them."""

    def __init__(self, model: Model, prior: Prior) -> None:
        self._image, self._point, self._pixel = model.image, model.point, model.pixel_px
        self._images, self._points = len(model.names), len(model.position)
        observations = np.arange(len(model.image))
        ones = np.ones(len(observations))
        self._by_point = csr_array(
            (ones, (model.point, observations)), (self._points, len(observations))
        )
        self._rows = np.searchsorted(model.image, np.arange(self._images + 1))  # in order, by _once
        self._prior_mean = prior.mean
        self._prior_information = np.linalg.inv(prior.covariance)
        # The first pose, and one coordinate of the one furthest from it, are the gauge.
        offset = model.wTc[:, :3, 3] - model.wTc[0, :3, 3]
        cTw = np.linalg.inv(model.wTc)[:, :3, 3]
        far = int(np.argmax(np.linalg.norm(offset, axis=1)))
        free = np.ones((self._images, 6), dtype=bool)
        free[0] = False
        free[far, 3 + int(np.argmax(np.abs(cTw[far] - cTw[0])))] = False
        self._free = np.flatnonzero(free.ravel())

    def residuals(self, state: _State) -> F64:
        """Projection less key point (O, 2), pixels; inf behind the camera."""
        X = self._in_camera(state)
        with np.errstate(all="ignore"):
            projected = _project(state.lens, X[:, :2] / X[:, 2:])
        return np.where(X[:, 2:] > 0, projected - self._pixel, np.inf)

    def minimise(self, state: _State, scale_px: float, share: float) -> _State:
        """Levenberg and Marquardt's steps with Cauchy's loss of that scale.

        They end with one that lowers the cost by less than `share` of it.
        """
        tried, damping, cost = state, 1e-6, self._cost(state, scale_px)
        for _ in range(_MOST_STEPS):
            try:
                tried = self._step(state, self._equations(state, scale_px, damping))
                new = self._cost(tried, scale_px)
            except LinAlgError:  # not positive definite: a longer step than the model bears
                new = np.inf
            if new < cost:
                settled = cost - new < share * cost
                state, cost, damping = tried, new, max(damping / 10, 1e-9)
                if settled:
                    break
            elif damping > 1e6:
                break
            else:
                damping *= 10
        return state

    def covariance(self, state: _State, scale_px: float) -> tuple[F64, F64]:
        """Of the lens (9, 9), poses and points marginalised; and the `curvature` (9, 9) there.

        Residuals of one stretch of the flight have much in common, and so have those of one part of
        the image, where no five-parameter lens follows the real one. The inverse of the normal
        equations does not know. So a parameter's variance is that one's, scaled by the residuals'
        variance, or the sum of two jackknives', if that is larger: the lens without each stretch,
        and without each part, to first order (MacKinnon and White, Journal of Econometrics 1985;
        by clusters, Bell and McCaffrey, Survey Methodology 2002). Over 24 simulated turning flights
        the nine parameters' errors were 0.74 to 1.05 of their deviations, root mean square.
        """
        equations = self._equations(state, scale_px, 0.0)
        P = len(self._free)
        nuisance = np.linalg.solve(equations.S[:P, :P], equations.S[:P, P:])
        marginal = equations.S[P:, P:] - equations.S[P:, :P] @ nuisance
        r, weight, Jl, Jp, Jx = self._linear(state, scale_px)
        full = np.zeros((self._images * 6, 9))
        full[self._free] = nuisance
        lens_point = equations.L - equations.W.T @ full
        B = equations.V_inv @ lens_point.reshape(-1, 3, 9)
        pull = Jl - Jp @ full.reshape(-1, 6, 9)[self._image] - Jx @ B[self._point]
        score = np.einsum("o,oki,ok->oi", weight, pull, r)
        # The variance of what a robust estimate's equations are made of (Huber 1964).
        freedom = max(2 * len(r) - 3 * self._points - P - 9, 1)
        variance = float(np.sum((weight[:, None] * r) ** 2)) / freedom
        information = marginal - self._variance(scale_px) * self._prior_information
        inverse = np.linalg.inv(information / variance + self._prior_information)
        spread = np.zeros(9)
        total = np.linalg.inv(inverse)
        own = np.einsum("o,oki,okj->oij", weight, pull, pull).reshape(-1, 81) / variance
        for group in self._clusters():
            observations = np.arange(len(group))
            member = csr_array((np.ones(len(group)), (group, observations)))
            pulls, held = (member @ score) / variance, (member @ own).reshape(-1, 9, 9)
            without = np.linalg.solve(total - held, pulls[:, :, None])[:, :, 0]
            spread += np.sum(without**2, axis=0) * (1 - 1 / len(pulls))
        inflation = np.sqrt(np.maximum(spread / np.diag(inverse), 1.0))
        inverse *= np.outer(inflation, inflation)
        return inverse, np.asarray(information / variance / freedom)

    def _clusters(self) -> tuple[I64, I64]:
        """The stretch of images and the part of the image that each observation belongs to."""
        stretch = self._image * _GROUPS // max(self._images, _GROUPS)
        low, high = self._pixel.min(axis=0), self._pixel.max(axis=0)
        place = (self._pixel - low) / np.maximum(high - low, 1.0) * _CELLS
        column, row = np.minimum(place.astype(np.int64), np.array(_CELLS) - 1).T
        return stretch, np.unique(row * _CELLS[0] + column, return_inverse=True)[1].ravel()

    def _in_camera(self, state: _State) -> F64:
        T = state.cTw[self._image]
        return np.asarray(
            np.einsum("oij,oj->oi", T[:, :, :3], state.points[self._point]) + T[:, :, 3]
        )

    def _cost(self, state: _State, scale_px: float) -> float:
        square = np.sum(self.residuals(state) ** 2, axis=1)
        off = state.lens - self._prior_mean
        loss = scale_px**2 * float(np.sum(np.log1p(square / scale_px**2)))
        return loss + self._variance(scale_px) * float(off @ self._prior_information @ off)

    @staticmethod
    def _variance(scale_px: float) -> float:
        return (scale_px / _CAUCHY) ** 2

    def _linear(self, state: _State, scale_px: float) -> tuple[F64, F64, F64, F64, F64]:
        """Residuals, weights and the derivatives by lens, pose (rotation first) and point."""
        X = self._in_camera(state)
        xy = X[:, :2] / X[:, 2:]
        r = _project(state.lens, xy) - self._pixel
        by_lens, by_xy = _derivatives(state.lens, xy)
        by_X = np.zeros((len(X), 2, 3))
        by_X[:, :, :2] = by_xy / X[:, 2:, None]
        by_X[:, :, 2] = -np.einsum("oij,oj->oi", by_xy, xy) / X[:, 2:]
        R = state.cTw[self._image, :, :3]
        turned = X - state.cTw[self._image, :, 3]
        # X' = exp(w) R x + t + dt, so dX/dw = −[R x]×.
        by_pose = np.concatenate([np.cross(turned[:, None], by_X), by_X], axis=2)
        weight = 1 / (1 + np.sum(r * r, axis=1) / scale_px**2)
        return r, weight, by_lens, by_pose, by_X @ R

    def _equations(self, state: _State, scale_px: float, damping: float) -> _Normal:
        r, weight, Jl, Jp, Jx = self._linear(state, scale_px)
        K, M = self._images, self._points
        shared = np.concatenate([Jl, r[:, :, None]], axis=2)
        J = np.concatenate([Jp, shared], axis=2).reshape(-1, 16)
        wJ, wJx = J * np.repeat(weight, 2)[:, None], Jx * weight[:, None, None]
        images = np.array([wJ[i:j].T @ J[i:j] for i, j in itertools.pairwise(2 * self._rows)])
        blocks = np.einsum("oki,okj->oij", wJx, np.concatenate([Jx, shared], axis=2))
        points = np.asarray(self._by_point @ blocks.reshape(-1, 39)).reshape(M, 3, 13)
        U, V, corner = images[:, :6, :6], points[:, :, :3], images[:, 6:15, 6:15].sum(axis=0)
        for block in (U, V, corner[None]):
            diagonal = np.arange(block.shape[1])
            block[:, diagonal, diagonal] *= 1 + damping
        V[:, range(3), range(3)] += 1e-12 * np.trace(V, axis1=1, axis2=2)[:, None]
        V_inv = np.asarray(np.linalg.inv(V), np.float64)
        blocks = np.einsum("oki,okj->oij", wJ[:, :6].reshape(-1, 2, 6), Jx)
        W, WV = (
            bsr_array((one, self._point, self._rows), shape=(6 * K, 3 * M))
            for one in (blocks, blocks @ V_inv[self._point])
        )
        L, g_points = points[:, :, 3:12].reshape(3 * M, 9), points[:, :, 12]
        VL = (V_inv @ points[:, :, 3:12]).reshape(3 * M, 9)
        information = self._variance(scale_px) * self._prior_information
        S = np.empty((6 * K + 9, 6 * K + 9))
        S[:-9, :-9] = block_diag(*U) - (WV @ W.T).toarray()
        S[:-9, -9:] = images[:, :6, 6:15].reshape(6 * K, 9) - W @ VL
        S[-9:, :-9], S[-9:, -9:] = S[:-9, -9:].T, corner + information - L.T @ VL
        g_lens = images[:, 6:15, 15].sum(axis=0) + information @ (state.lens - self._prior_mean)
        g = np.append(images[:, :6, 15], g_lens) - np.append(
            WV @ g_points.ravel(), g_points.ravel() @ VL
        )
        kept = np.append(self._free, np.arange(6 * K, 6 * K + 9))
        return _Normal(S[np.ix_(kept, kept)], g[kept], V_inv, W, L, g_points)

    def _step(self, state: _State, equations: _Normal) -> _State:
        step = -cho_solve(cho_factor(equations.S), equations.g)
        motion = np.zeros(6 * self._images)
        motion[self._free] = step[:-9]
        pulled = equations.W.T @ motion + equations.L @ step[-9:]
        left = equations.g_points + pulled.reshape(-1, 3)
        points = state.points - np.einsum("mij,mj->mi", equations.V_inv, left)
        w, t = motion.reshape(-1, 6)[:, :3], motion.reshape(-1, 6)[:, 3:]
        cTw = state.cTw.copy()
        cTw[:, :, :3] = Rotation.from_rotvec(w).as_matrix() @ cTw[:, :, :3]
        cTw[:, :, 3] += t
        return _State(state.lens + step[-9:], cTw, points)


def _once(model: Model) -> Model:
    """The model with its observations in order of image, each point at most once in each."""
    keys = model.image * len(model.position) + model.point
    first = np.unique(keys, return_index=True)[1]
    rows = {name: getattr(model, name)[first] for name in ("image", "feature", "point", "pixel_px")}
    return replace(model, **rows)


def _apart(model: Model) -> Model:
    """The model without points at a camera's centre; its observations are in order of image."""
    depth = in_cameras(model)[:, 2]
    parts = np.split(depth, np.searchsorted(model.image, np.arange(1, len(model.names))))
    typical = np.array([np.median(part) if len(part) else 0.0 for part in parts])
    near = model.point[depth < _NEAREST * typical[model.image]]
    dropped = np.zeros(len(model.position), dtype=bool)
    dropped[near] = True
    return without_points(model, dropped) if len(near) else model


def _thinned(model: Model) -> Model:
    """At most so many images, in stretches, and points, evenly, as the lens needs."""
    K = len(model.names)
    if K > _MOST_IMAGES:
        length = _MOST_IMAGES // _GROUPS
        begins = np.linspace(0, K - length, _GROUPS).astype(np.int64)
        kept = np.isin(np.arange(K), begins[:, None] + np.arange(length))
        model = among(model, kept)
    if len(model.image) > _MOST_OBSERVATIONS:
        every = len(model.image) / _MOST_OBSERVATIONS
        kept = np.zeros(len(model.position), dtype=bool)
        kept[np.arange(0, len(kept), every).astype(np.int64)] = True
        model = without_points(model, ~kept)
    while True:  # points go with an image, and another may have held by these
        enough = np.bincount(model.image, minlength=len(model.names)) >= _FEWEST_OBSERVATIONS
        if enough.all():
            return model
        model = among(model, enough)


def _robust_sigma(residuals: F64) -> float:
    """Of a coordinate, from the median length of residuals (O, 2), which is Rayleigh's."""
    return float(np.median(np.linalg.norm(residuals, axis=1)) / np.sqrt(2 * np.log(2)))


def _project(lens: F64, xy: F64) -> F64:
    """Coordinates on the plane z = 1 (N, 2) to distorted pixels, as `Camera.distort`."""
    return np.asarray(BrownConrady(*lens[4:]).bend(xy) * lens[:2] + lens[2:4])


def _derivatives(lens: F64, xy: F64) -> tuple[F64, F64]:
    """Of `_project` by the lens (N, 2, 9) and by the coordinates (N, 2, 2)."""
    fx, fy, _, _, k1, k2, p1, p2, k3 = lens
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + 3 * r2 * k3)
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_xy = np.empty((len(x), 2, 2))
    by_xy[:, 0, 0] = fx * (radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x)
    by_xy[:, 0, 1], by_xy[:, 1, 0] = fx * cross, fy * cross
    by_xy[:, 1, 1] = fy * (radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x)
    by_lens = np.zeros((len(x), 2, 9))
    u, v = by_lens[:, 0], by_lens[:, 1]
    for k, power in ((4, r2), (5, r2**2), (8, r2**3)):
        u[:, k], v[:, k] = fx * x * power, fy * y * power
    u[:, 6], v[:, 6] = fx * 2 * x * y, fy * (r2 + 2 * y * y)
    u[:, 7], v[:, 7] = fx * (r2 + 2 * x * x), fy * 2 * x * y
    u[:, 0] = x * radial + u[:, 6] / fx * p1 + u[:, 7] / fx * p2
    v[:, 1] = y * radial + v[:, 6] / fy * p1 + v[:, 7] / fy * p2
    u[:, 2] = v[:, 3] = 1
    return by_lens, by_xy
