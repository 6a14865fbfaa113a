"""Damped Gauss-Newton on one frame's sights, their landmarks marginalised.

What `solve_direct` and `solve_rolling` share. The objective is that of a graph with a variable for
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

import numpy as np
import numpy.typing as npt

from ground_station.geometry import poses
from ground_station.geometry.camera import Camera

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

NEAREST_M = 1e-3
"""A point nearer than this, or behind, has no projection."""

_BEHIND_COST = 1e6
"""What such a point costs, so that no step gains by turning away from it."""

_NEAR = 0.5
"""Newton's decrement (a step's squared length in standard deviations of the solution) from which
on the landmarks are moved along: costs on two of their linearisations do not compare, and so near
no step needs the comparison."""

_NOTHING = 1e-15
"""A decrement of rounding errors only."""

_CONVERGED = 1e-6
"""Newton's decrement of the last step: a thousandth of a standard deviation."""


@dataclass(frozen=True)
class Prior:
    """A Gaussian of pose and twist: means, and the information (12, 12) of their right tangent."""

    cTw: Array
    twist: Array
    information: Array

    def apart(self, wTc: Array, twist: Array) -> Array:
        """The tangent step (12,) from the mean to a pose (4, 4) and twist (6,)."""
        return np.concatenate([poses.log(self.cTw @ wTc), twist - self.twist])

    def at(self, wTc: Array, twist: Array) -> tuple[Array, Array, float]:
        """Information (12, 12), gradient (12,) and cost for steps from a pose and twist."""
        step = self.apart(wTc, twist)
        ad = adjoint(step[:6])
        J = np.eye(12)
        # Of log(exp(step)·exp(ξ)); Barfoot 2017, eq. 7.82, for the right tangent.
        J[:6, :6] += 0.5 * ad + ad @ ad / 12
        weighted = J.T @ self.information
        return weighted @ J, weighted @ step, 0.5 * float(step @ self.information @ step)


def adjoint(xi: Array) -> Array:
    """The 6×6 matrix of the Lie bracket [xi, ·] of se(3), rotation first; Barfoot, eq. 7.32."""
    a, b, c, x, y, z = xi.tolist()
    return np.array(
        [
            [0, -c, b, 0, 0, 0],
            [c, 0, -a, 0, 0, 0],
            [-b, a, 0, 0, 0, 0],
            [0, -z, y, 0, -c, b],
            [z, 0, -x, c, 0, -a],
            [-y, x, 0, -b, a, 0],
        ]
    )


@dataclass(frozen=True)
class Linear:
    """The sights' cost near a pose and twist, to second order, and their landmarks' best moves.

    `information` (D, D), `gradient` (D,) for steps of pose and twist (D = 12) or of the pose alone
    (D = 6); `moved_m` (3, N) in the world; `spread_px2` (3, N), the landmarks' covariances in the
    image (uu, uv, vv), and `reach` (2, 3, N) what moves them: their covariance by each coordinate.
    """

    information: Array
    gradient: Array
    cost: float
    moved_m: Array
    spread_px2: Array
    reach: Array


@dataclass(frozen=True)
class Reprojection:
    """The robust reprojection cost of N landmarks in one frame; arrays with N last.

    `row_s` (N,) is None for a global shutter: then the pose is all that is asked for.
    """

    points_m: Array
    pinhole_px: Array
    covariance_m2: Array
    variance_px2: Array
    row_s: Array | None
    camera: Camera
    huber_k: float

    @property
    def count(self) -> int:
        """The number of sights."""
        return self.points_m.shape[1]

    def where(self, keep: Flags) -> Reprojection:
        """Of those sights alone."""
        return replace(
            self,
            points_m=self.points_m[:, keep],
            pinhole_px=self.pinhole_px[:, keep],
            covariance_m2=self.covariance_m2[:, :, keep],
            variance_px2=self.variance_px2[keep],
            row_s=None if self.row_s is None else self.row_s[keep],
        )

    def view(self, wTc: Array, twist: Array, moved_m: Array | None = None) -> View:
        """What a pose (4, 4) and twist (6,) have the camera see, landmarks moved by `moved_m`."""
        world = self.points_m if moved_m is None else self.points_m + moved_m
        points = wTc[:3, :3].T @ (world - wTc[:3, 3:])
        motion = None if self.row_s is None else _Motion(self.row_s, twist)
        if motion is not None:
            points = motion.forward(points)
        z = points[2]
        front = z > NEAREST_M
        all_front = bool(front.all())
        inverse_z = 1.0 / (z if all_front else np.where(front, z, 1.0))
        uv = points[:2] * inverse_z
        camera, residual = self.camera, np.empty_like(uv)
        residual[0] = camera.fx_px * uv[0] + (camera.cx_px - self.pinhole_px[0])
        residual[1] = camera.fy_px * uv[1] + (camera.cy_px - self.pinhole_px[1])
        return View(camera, wTc[:3, :3], motion, uv, inverse_z, residual, front, all_front)

    def reach(self, view: View) -> tuple[Array, Array, Array]:
        """Rows ∂pixel/∂landmark in world axes (2, 3, N), their products with the landmarks'
        covariances (2, 3, N), and these in the image, px² (3, N): uu, uv, vv."""
        rows = view.rows()
        reach = np.einsum("ijn,ajn->ain", self.covariance_m2, rows)
        spread = np.empty((3, self.count))
        for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            np.einsum("in,in->n", rows[i], reach[j], out=spread[k])
        return rows, reach, spread

    def uncertainty(self, view: View, covariance: Array) -> Array:
        """Covariance in the image (3, N), px² (uu, uv, vv), of landmarks and of the pose or the
        pose and twist, given theirs (D, D)."""
        J = view.jacobian()
        spread = self.reach(view)[2]
        weighted = (covariance @ J.reshape(len(J), -1)).reshape(J.shape)
        for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            spread[k] += np.einsum("dn,dn->n", J[:, i], weighted[:, j])
        return spread

    def linearize(
        self, wTc: Array, twist: Array, moved_m: Array | None, frozen: Linear | None = None
    ) -> Linear:
        """The cost at a pose (4, 4) and twist (6,), landmarks linearised where `moved_m` has them.

        With `frozen` their covariances in the image stay what they were there, so that both costs
        compare.
        """
        view = self.view(wTc, twist, moved_m)
        r = view.residual_px
        if frozen is None:
            rows, reach, spread = self.reach(view)
            if moved_m is not None:
                r = r - np.einsum("ain,in->an", rows, moved_m)
        else:
            reach, spread = frozen.reach, frozen.spread_px2
        y, excess, factor = self._whiten(r, spread)
        if not view.all_front:
            y, factor = y * view.front, factor * view.front
        cost = 0.5 * float((y * r).sum() + excess @ (y * y).sum(axis=0))
        cost += _BEHIND_COST * (self.count - np.count_nonzero(view.front))
        J = view.jacobian()
        # Whitened by the transposed Cholesky factor of each sight's information.
        J[:, 0] *= factor[0]
        J[:, 0] += factor[1] * J[:, 1]
        J[:, 1] *= factor[2]
        flat = J.reshape(len(J), -1)
        whitened = np.concatenate([factor[0] * r[0] + factor[1] * r[1], factor[2] * r[1]])
        moved = -(reach[0] * y[0] + reach[1] * y[1])
        return Linear(flat @ flat.T, flat @ whitened, cost, moved, spread, reach)

    def _whiten(self, r: Array, spread: Array) -> tuple[Array, Array, Array]:
        """y (2, N) of the module's text, (t − 1)·sigma² (N,), and L's ll, lu, uu.

        L Lᵀ is (t·sigma²·I + S)⁻¹; S is `spread` (3, N).
        """
        variance = self.variance_px2
        y, inverse, uu, vv = solve2(variance, spread, r)
        far = np.flatnonzero(variance * (y * y).sum(axis=0) > self.huber_k**2)
        excess = np.zeros_like(variance)
        if len(far):
            excess[far] = self._excess(r[:, far], spread[:, far], variance[far])
            y, inverse, uu, vv = solve2(variance + excess, spread, r)
        factor = np.empty((3, len(variance)))
        factor[0] = np.sqrt(vv * inverse)
        factor[1] = factor[0] * spread[1] / -vv
        factor[2] = 1.0 / np.sqrt(vv)
        return y, excess, factor

    def _excess(self, r: Array, spread: Array, variance: Array) -> Array:
        """(t − 1)·sigma² (N,) of sights beyond Huber's reach: Newton on 1/‖y‖ = sigma/k.

        Moré and Sorensen's iteration for the same equation in a trust region; nearly linear in t.
        """
        square = (r * r).sum(axis=0)
        limit = self.huber_k / np.sqrt(variance)
        # As if S were in all directions what it is along r.
        along = (spread[0] * r[0] + 2 * spread[1] * r[1]) * r[0] + spread[2] * r[1] * r[1]
        total = np.maximum(np.sqrt(square) / limit - along / square, variance)
        for _ in range(2):
            y, inverse, uu, vv = solve2(total, spread, r)
            square = (y * y).sum(axis=0)
            curved = (vv * y[0] - 2 * spread[1] * y[1]) * y[0] + uu * y[1] * y[1]
            total += square * (np.sqrt(square) / limit - 1) / (curved * inverse)
            np.maximum(total, variance, out=total)
        return total - variance


def solve2(variance: Array | float, spread: Array, r: Array) -> tuple[Array, Array, Array, Array]:
    """(variance·I + S)⁻¹ r (2, N); one over that matrix's determinant, and its diagonal (N,)."""
    uu, vv, uv = variance + spread[0], variance + spread[2], spread[1]
    inverse = 1.0 / (uu * vv - uv * uv)
    y = np.empty_like(r)
    y[0] = (vv * r[0] - uv * r[1]) * inverse
    y[1] = (uu * r[1] - uv * r[0]) * inverse
    return y, inverse, uu, vv


@dataclass(frozen=True)
class View:
    """N landmarks before a camera: `uv` (2, N) on the plane z = 1, the sights' `residual_px` (2, N)
    and which are in `front` (N,) of it; those behind have numbers that mean nothing."""

    camera: Camera
    wRc: Array
    motion: _Motion | None
    uv: Array
    inverse_z: Array
    residual_px: Array
    front: Flags
    all_front: bool

    def rows(self) -> Array:
        """∂pixel/∂landmark (2, 3, N) in world axes."""
        (u, v), camera = self.uv, self.camera
        rows = np.zeros((2, 3, len(u)))
        np.multiply(camera.fx_px, self.inverse_z, out=rows[0, 0])
        np.multiply(camera.fy_px, self.inverse_z, out=rows[1, 1])
        np.multiply(-rows[0, 0], u, out=rows[0, 2])
        np.multiply(-rows[1, 1], v, out=rows[1, 2])
        if self.motion is not None:
            rows = self.motion.turned_back(rows)
        return self.wRc @ rows

    def jacobian(self) -> Array:
        """∂pixel/∂(pose, twist) (12, 2, N), or ∂pixel/∂pose (6, 2, N) without a motion.

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
        return J if self.motion is None else self.motion.jacobian(J)


class _Motion:
    """From the camera at the frame's time to the camera at each of N rows' times."""

    def __init__(self, row_s: Array, twist: Array) -> None:
        self.row_s, self.ad = row_s, adjoint(twist)
        self.hat, velocity = self.ad[:3, :3], twist[3:]
        self.square = self.hat @ self.hat
        rate = math.sqrt(float(twist[:3] @ twist[:3]))
        # Rodrigues' formula of exp(∓twist·row_s), with the row's time in its coefficients.
        if rate > 1e-6:
            angle = rate * row_s
            self.first = np.sin(angle) / rate
            self.second = 2 * np.square(np.sin(0.5 * angle) / rate)
            third = (row_s - self.first) / rate**2
        else:
            self.first, self.second = row_s, 0.5 * row_s * row_s
            third = self.second * row_s / 3
        drift = np.stack([velocity, self.hat @ velocity, self.square @ velocity], axis=1)
        self.drift = drift @ np.stack([-row_s, self.second, -third])

    def forward(self, points: Array) -> Array:
        """Points (3, N) of the frame's camera in those of the rows: exp(−twist·row_s)·p."""
        turned = self.second * (self.square @ points) - self.first * (self.hat @ points)
        return points + turned + self.drift

    def turned_back(self, directions: Array) -> Array:
        """Directions (A, 3, N) of the rows' cameras in the frame's."""
        turn = self.second * (self.square @ directions) + self.first * (self.hat @ directions)
        return directions + turn

    def jacobian(self, J: Array) -> Array:
        """Columns (6, 2, N) for steps of the rows' poses to (12, 2, N) for pose and twist.

        Right tangents, to first order in the motion between the frame's time and the row's.
        """
        bracket = (self.ad.T @ J.reshape(6, -1)).reshape(J.shape)
        bracket *= self.row_s
        result = np.empty((12, *J.shape[1:]))
        np.subtract(J, bracket, out=result[:6])
        bracket *= -0.5
        bracket += J
        np.multiply(bracket, self.row_s, out=result[6:])
        return result


@dataclass(frozen=True)
class Descent:
    """Where a descent ended; `linear` is of the sights alone. `reason` says why there is none."""

    wTc: Array
    twist: Array
    linear: Linear
    iterations: int
    reason: str = ""


def descend(
    sights: Reprojection,
    wTc: Array,
    twist: Array,
    prior: Prior | None,
    max_iterations: int,
    rough: bool = False,
) -> Descent:
    """The minimum of the sights' cost and the prior's, from a pose (4, 4) and twist (6,).

    Gauss-Newton, with Levenberg's damping when a step would raise the cost; near the minimum the
    landmarks are linearised anew at each step. A rough one ends there.
    """
    damping = 0.0
    linear = sights.linearize(wTc, twist, None)
    information, gradient, cost = _with(prior, linear, wTc, twist)
    near = False
    for iteration in range(1, max_iterations + 1):
        scale = np.diag(information).copy()
        if not (scale > 0).all():  # also when it is not a number
            return Descent(wTc, twist, linear, iteration, "singular")
        scale = 1.0 / np.sqrt(scale)
        scaled = information * scale * scale[:, None]
        scaled.flat[:: len(scaled) + 1] += damping
        try:
            step = -scale * np.linalg.solve(scaled, scale * gradient)
        except np.linalg.LinAlgError:
            return Descent(wTc, twist, linear, iteration, "singular")
        if not np.isfinite(step).all():
            return Descent(wTc, twist, linear, iteration, "not finite")
        decrement = -float(step @ gradient)
        if decrement < _NOTHING:
            # Nothing left to gain but rounding, which a cost cannot tell from a rise.
            return Descent(wTc, twist, linear, iteration)
        candidate = wTc @ poses.exp(step[:6])
        speed = twist + step[6:] if len(step) > 6 else twist
        if near:
            trial = sights.linearize(candidate, speed, linear.moved_m)
        else:
            trial = sights.linearize(candidate, speed, None, linear)
        information_, gradient_, cost_ = _with(prior, trial, candidate, speed)
        if not near and not cost_ <= cost * (1 + 1e-12):
            damping = max(10 * damping, 1e-4)
            if damping > 1e8:
                return Descent(wTc, twist, linear, iteration, "diverged")
            continue
        damping = damping / 10 if damping > 1e-6 else 0.0
        wTc, twist, linear = candidate, speed, trial
        information, gradient, cost = information_, gradient_, cost_
        if damping == 0.0 and decrement < _NEAR:
            if rough or (near and decrement < _CONVERGED):
                return Descent(wTc, twist, linear, iteration)
            near = True
    reason = f"not converged in {max_iterations} iterations"
    return Descent(wTc, twist, linear, max_iterations, reason)


def _with(
    prior: Prior | None, linear: Linear, wTc: Array, twist: Array
) -> tuple[Array, Array, float]:
    if prior is None:
        return linear.information, linear.gradient, linear.cost
    information, gradient, cost = prior.at(wTc, twist)
    return information + linear.information, gradient + linear.gradient, cost + linear.cost
