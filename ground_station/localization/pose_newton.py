"""Damped Gauss-Newton on one frame's observations, their landmarks marginalised.

What `solve_rolling` descends by. The objective is that of a graph with a variable for
each landmark: Huber's loss of each whitened pixel residual, and each landmark's Gaussian prior. A
landmark is eliminated in closed form: with pixel residual r, S its position's covariance seen in
the image and y = (t·sigma²·I + S)⁻¹ r, its best move leaves the residual t·sigma²·y, where t = 1
within Huber's reach (sigma·|y| <= k) and beyond it the t that makes sigma·|y| = k. The one over
t is the weight that reweighting would give, and t·sigma²·I + S the covariance it whitens with
(Schur's complement of the landmark; Triggs et al., Bundle Adjustment, 2000).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from ground_station.arrays import F64, Bools
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.kinematics import LandmarkObservations
from ground_station.localization.row_motion import RowMotion

NEAREST_M = 1e-3
"""A point nearer than this, or behind, has no projection."""

_BEHIND_COST = 1e6
"""What such a point costs, so that no step gains by turning away from it."""

_NEAR = 20.0
"""Newton's decrement (a step's squared length in standard deviations of the solution) from which
on the landmarks are moved along: costs on two of their linearisations do not compare, and so near
no step needs the comparison."""

_ROUGH = 300.0
"""Newton's decrement of the last step of a rough descent: what is left after it is far less."""

_CONVERGED = 1e-4
"""Newton's decrement of the last step: a hundredth of a standard deviation."""


@dataclass(frozen=True)
class Prior:
    """A Gaussian of pose and twist: means, and the information (12, 12) of their right tangent."""

    cTw: F64
    twist: F64
    information: F64

    def apart(self, wTc: F64, twist: F64) -> F64:
        """The tangent step (12,) from the mean to a pose (4, 4) and twist (6,)."""
        return np.concatenate([poses.log(self.cTw @ wTc), twist - self.twist])

    def at(self, wTc: F64, twist: F64) -> tuple[F64, F64, float]:
        """Information (12, 12), gradient (12,) and cost for steps from a pose and twist."""
        step = self.apart(wTc, twist)
        ad = gtsam.Pose3.adjointMap(step[:6])
        J = np.eye(12)
        # Of log(exp(step)·exp(ξ)); Barfoot 2017, eq. 7.82, for the right tangent.
        J[:6, :6] += 0.5 * ad + ad @ ad / 12
        weighted = J.T @ self.information
        return weighted @ J, weighted @ step, 0.5 * float(step @ self.information @ step)


@dataclass(frozen=True)
class Linear:
    """The observations' cost near a pose and twist, to second order, and their landmarks' best
    moves.

    `information` (12, 12), `gradient` (12,) for steps of pose and twist; `moved_m` (3, N) in the
    world; `spread_px2` (3, N), the landmarks' covariances in the
    image (uu, uv, vv), and `reach` (2, 3, N) what moves them: their covariance by each coordinate.
    `rows` (2, 3, N) are ∂pixel/∂landmark once these are moved along. `excess` (N,) is the variance,
    px², that reweighting adds beyond Huber's reach. `bent_px` (2, N) is how the landmarks' pixels
    follow the share by which the map's focal length is longer, and `by_focal` (12, 2) the steps'
    mixed second derivative with that share of the frame's and of the map's.
    """

    information: F64
    gradient: F64
    cost: float
    moved_m: F64
    spread_px2: F64
    reach: F64
    rows: F64 | None
    excess: F64
    bent_px: F64
    by_focal: F64


@dataclass(frozen=True)
class Reprojection:
    """The robust reprojection cost of N landmarks in one frame; arrays with N last.

    `offset_px` (2, N) is from the principal point to the undistorted pixel of each observation.
    `row_s` (N,) is when its row is exposed after the frame's time. `by_focal_m` (3, N) is how
    landmarks follow the map's focal length.
    """

    points_m: F64
    offset_px: F64
    covariance_m2: F64
    variance_px2: F64
    row_s: F64
    camera: Camera
    huber_k: float
    by_focal_m: F64

    @classmethod
    def of(cls, seen: LandmarkObservations, camera: Camera, huber_k: float) -> Reprojection:
        """Of what a frame's observations say, which have N first."""
        return cls(
            points_m=np.ascontiguousarray(seen.points_m.T, np.float64),
            offset_px=np.ascontiguousarray((seen.pinhole_px - [camera.cx_px, camera.cy_px]).T),
            covariance_m2=np.ascontiguousarray(seen.covariance_m2.transpose(1, 2, 0), np.float64),
            variance_px2=np.square(seen.sigma_px, dtype=np.float64),
            row_s=np.asarray(seen.row_s, np.float64),
            camera=camera,
            huber_k=huber_k,
            by_focal_m=seen.by_focal_m.T,
        )

    @property
    def count(self) -> int:
        """The number of observations."""
        return int(self.points_m.shape[1])

    def where(self, keep: Bools) -> Reprojection:
        """Of those observations alone."""
        return replace(
            self,
            points_m=self.points_m[:, keep],
            offset_px=self.offset_px[:, keep],
            covariance_m2=self.covariance_m2[:, :, keep],
            variance_px2=self.variance_px2[keep],
            row_s=self.row_s[keep],
            by_focal_m=self.by_focal_m[:, keep],
        )

    def view(self, wTc: F64, twist: F64, moved_m: F64 | None = None) -> View:
        """What a pose (4, 4) and twist (6,) have the camera see, landmarks moved by `moved_m`."""
        world = self.points_m if moved_m is None else self.points_m + moved_m
        motion = RowMotion(self.row_s, twist)
        points = motion.forward(wTc[:3, :3].T @ (world - wTc[:3, 3:]))
        z = points[2]
        front = z > NEAREST_M
        all_front = bool(front.all())
        inverse_z = 1.0 / (z if all_front else np.where(front, z, 1.0))
        uv = points[:2] * inverse_z
        camera = self.camera
        residual = uv * np.array([[camera.fx_px], [camera.fy_px]])
        residual -= self.offset_px
        return View(camera, wTc[:3, :3], motion, uv, inverse_z, residual, front, all_front)

    def reach(self, view: View) -> tuple[F64, F64, F64, F64]:
        """Rows ∂pixel/∂landmark in world axes (2, 3, N), their products with the landmarks'
        covariances (2, 3, N), these in the image, px² (3, N): uu, uv, vv; and `bent_px` (2, N)."""
        rows = view.rows()
        reach = np.einsum("ijn,ajn->ain", self.covariance_m2, rows)
        spread = np.empty((3, self.count))
        for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            np.einsum("in,in->n", rows[i], reach[j], out=spread[k])
        return rows, reach, spread, np.einsum("ain,in->an", rows, self.by_focal_m)

    def linearize(
        self,
        wTc: F64,
        twist: F64,
        last: Linear | None = None,
        *,
        move: bool = False,
        sharp: bool = False,
    ) -> Linear:
        """The cost at a pose (4, 4) and twist (6,).

        After the `last` one, landmarks' covariances in the image stay what they were there, so that
        both costs compare; with `move` they are linearised again where `last` moved the landmarks.
        With `sharp` the information is the cost's second derivative, which is less than that of the
        reweighted observations beyond Huber's reach and makes for longer steps.
        """
        moved = last.moved_m if move and last is not None else None
        view = self.view(wTc, twist, moved)
        r = view.residual_px
        rows = None
        if last is None or (move and last.rows is None):
            rows, reach, spread, bent = self.reach(view)
        else:  # so near another step hardly turns them
            rows, reach, spread, bent = last.rows, last.reach, last.spread_px2, last.bent_px
        if moved is not None and rows is not None:
            r = r - np.einsum("ain,in->an", rows, moved)
        y, excess, factor = self._whiten(r, spread, None if last is None else last.excess, sharp)
        if not view.all_front:
            y, factor = y * view.front, factor * view.front
        cost = 0.5 * float(np.vdot(y, r) + excess @ (y[0] * y[0] + y[1] * y[1]))
        cost += _BEHIND_COST * (self.count - np.count_nonzero(view.front))
        J = view.jacobian()
        gradient = J.reshape(len(J), -1) @ y.reshape(-1)
        # Times the transposed factor of each observation's information.
        J[:, 0] *= factor[0]
        J[:, 0] += factor[1] * J[:, 1]
        J[:, 1] *= factor[2]
        flat = J.reshape(len(J), -1)
        # A longer focal length puts an observation nearer to the middle, by its distance.
        u, v = np.stack([self.offset_px, bent], axis=1)  # (2, N) each
        longer = np.concatenate([factor[0] * u + factor[1] * v, factor[2] * v], axis=1)
        best = reach[0] * y[0]
        best += reach[1] * y[1]
        return Linear(
            flat @ flat.T, gradient, cost, -best, spread, reach, rows if move else None, excess,
            bent, flat @ longer.T,
        )  # fmt: skip

    def _whiten(self, r: F64, spread: F64, excess: F64 | None, sharp: bool) -> tuple[F64, F64, F64]:
        """y (2, N) of the module's text, (t − 1)·sigma² (N,), and L's uu, vu, vv (3, N).

        L Lᵀ is (t·sigma²·I + S)⁻¹ or, with `sharp`, ∂y/∂r; S is `spread` (3, N). `excess` is what
        another pose near had of the second.
        """
        variance = self.variance_px2
        y, inverse, uu, vv = solve2(variance, spread, r)
        far = np.flatnonzero(variance * (y[0] * y[0] + y[1] * y[1]) > self.huber_k**2)
        start, excess = excess, np.zeros_like(variance)
        if len(far):
            total = variance[far] if start is None else variance[far] + start[far]
            total = self._newton(total, r[:, far], spread[:, far], variance[far])
            excess[far] = total - variance[far]
            y, inverse, uu, vv = solve2(variance + excess, spread, r)
        factor = np.empty((3, len(variance)))
        np.sqrt(vv * inverse, out=factor[0])
        np.divide(factor[0] * spread[1], -vv, out=factor[1])
        np.divide(1.0, np.sqrt(vv), out=factor[2])
        if sharp and len(far):
            # M⁻¹ − z zᵀ/(y·z) with z = M⁻¹ y: nothing along y, where the force stays the same.
            (a, b), inverse, uu, vv = y[:, far], inverse[far], uu[far], vv[far]
            uv = spread[1, far]
            z0, z1 = (vv * a - uv * b) * inverse, (uu * b - uv * a) * inverse
            rest = (uu + vv) * inverse - (z0 * z0 + z1 * z1) / (a * z0 + b * z1)
            rest = np.sqrt(np.maximum(rest, 0) / (a * a + b * b))
            factor[0, far], factor[1, far], factor[2, far] = -rest * b, rest * a, 0.0
        return y, excess, factor

    def _newton(self, total: F64, r: F64, spread: F64, variance: F64) -> F64:
        """A t·sigma² (N,) nearer to sigma·‖y‖ = k: one step of Newton's on the inverse of both.

        Moré and Sorensen's iteration for the same equation in a trust region. One step is exact
        from anywhere where S is the same in all directions.
        """
        y, inverse, uu, vv = solve2(total, spread, r)
        square = y[0] * y[0] + y[1] * y[1]
        curved = (vv * y[0] - 2 * spread[1] * y[1]) * y[0] + uu * y[1] * y[1]
        over = np.sqrt(square * variance) / self.huber_k - 1
        return np.asarray(np.maximum(total + square * over / (curved * inverse), variance))


def solve2(variance: F64 | float, spread: F64, r: F64) -> tuple[F64, F64, F64, F64]:
    """(variance·I + S)⁻¹ r (2, N); one over that matrix's determinant, and its diagonal (N,)."""
    uu, vv, uv = variance + spread[0], variance + spread[2], spread[1]
    inverse = 1.0 / (uu * vv - uv * uv)
    y = np.empty_like(r)
    y[0] = (vv * r[0] - uv * r[1]) * inverse
    y[1] = (uu * r[1] - uv * r[0]) * inverse
    return y, inverse, uu, vv


@dataclass(frozen=True)
class View:
    """N landmarks before a camera: `uv` (2, N) on the plane z = 1, the observations' `residual_px`
    (2, N) and which are in `front` (N,) of it; those behind have numbers that mean nothing."""

    camera: Camera
    wRc: F64
    motion: RowMotion
    uv: F64
    inverse_z: F64
    residual_px: F64
    front: Bools
    all_front: bool

    def rows(self) -> F64:
        """∂pixel/∂landmark (2, 3, N) in world axes."""
        (u, v), camera = self.uv, self.camera
        rows = np.zeros((2, 3, len(u)))
        np.multiply(camera.fx_px, self.inverse_z, out=rows[0, 0])
        np.multiply(camera.fy_px, self.inverse_z, out=rows[1, 1])
        np.multiply(-rows[0, 0], u, out=rows[0, 2])
        np.multiply(-rows[1, 1], v, out=rows[1, 2])
        return self.wRc @ self.motion.turned_back(rows)

    def jacobian(self) -> F64:
        """∂pixel/∂(pose, twist) (12, 2, N).

        Right tangent: the pinhole's derivative times ∂p_c/∂ξ = [hat(p_c), −I].
        """
        (u, v), fx, fy = self.uv, self.camera.fx_px, self.camera.fy_px
        J = np.zeros((6, 2, len(u)))
        product = u * v
        np.multiply(fx, product, out=J[0, 0])
        np.multiply(-fx, 1 + u * u, out=J[1, 0])
        np.multiply(fx, v, out=J[2, 0])
        np.multiply(-fx, self.inverse_z, out=J[3, 0])
        np.multiply(-J[3, 0], u, out=J[5, 0])
        np.multiply(fy, 1 + v * v, out=J[0, 1])
        np.multiply(-fy, product, out=J[1, 1])
        np.multiply(-fy, u, out=J[2, 1])
        np.multiply(-fy, self.inverse_z, out=J[4, 1])
        np.multiply(-J[4, 1], v, out=J[5, 1])
        return self.motion.jacobian(J)


@dataclass(frozen=True)
class Descent:
    """Where a descent ended; `linear` is of the observations alone. `reason`: why there is none."""

    wTc: F64
    twist: F64
    linear: Linear
    iterations: int
    reason: str = ""


def descend(
    observations: Reprojection,
    wTc: F64,
    twist: F64,
    prior: Prior,
    max_iterations: int,
    rough: bool = False,
) -> Descent:
    """The minimum of the observations' cost and the prior's, from a pose (4, 4) and twist (6,).

    Gauss-Newton on reweighted observations, with Levenberg's damping when a step would raise the
    cost; near the minimum Newton's, the landmarks linearised again at each step. A rough one ends
    before that, and its `linear` is of the step before."""
    damping, before = 0.0, math.inf
    sharp, sharpen = False, True
    linear = observations.linearize(wTc, twist)
    information, gradient, cost = _with(prior, linear, wTc, twist)
    for iteration in range(1, max_iterations + 1):
        scale = information.diagonal()
        if not (scale > 0).all():  # also when it is not a number
            return Descent(wTc, twist, linear, iteration, "singular")
        scale = 1.0 / np.sqrt(scale)
        scaled = information * scale * scale[:, None]
        if damping:
            scaled.flat[:: len(scaled) + 1] += damping
        try:
            step = -scale * np.linalg.solve(scaled, scale * gradient)
        except np.linalg.LinAlgError:
            return Descent(wTc, twist, linear, iteration, "singular")
        if not np.isfinite(step).all():
            return Descent(wTc, twist, linear, iteration, "not finite")
        decrement = -float(step @ gradient)
        candidate = wTc @ poses.exp(step[:6])
        speed = twist + step[6:]
        if damping == 0 and not sharp and decrement < (_ROUGH if rough else _CONVERGED):
            # So short a step changes nothing but the gradient.
            left = linear.gradient + linear.information @ step
            return Descent(candidate, speed, replace(linear, gradient=left), iteration)
        near = damping == 0 and decrement < _NEAR
        # Every other one, as the last's information is to be that of the reweighted observations;
        # and no more once it has led astray, as it can where few observations are within Huber's
        # reach.
        sharpen &= decrement <= before
        before = decrement
        sharp = near and sharpen and not sharp
        trial = observations.linearize(candidate, speed, linear, move=near, sharp=sharp)
        model = _with(prior, trial, candidate, speed)
        if not near and not model[2] <= cost * (1 + 1e-12):
            damping = max(10 * damping, 1e-4)
            if damping > 1e8:
                return Descent(wTc, twist, linear, iteration, "diverged")
            continue
        damping = damping / 100 if damping > 1e-4 else 0.0
        wTc, twist, linear = candidate, speed, trial
        information, gradient, cost = model
    reason = f"not converged in {max_iterations} iterations"
    return Descent(wTc, twist, linear, max_iterations, reason)


def _with(prior: Prior, linear: Linear, wTc: F64, twist: F64) -> tuple[F64, F64, float]:
    information, gradient, cost = prior.at(wTc, twist)
    return information + linear.information, gradient + linear.gradient, cost + linear.cost
