"""The two lens models: what a lens does between the plane z = 1 and its pixels.

Both take rays on the plane z = 1 to *bent* coordinates, of which the focal lengths and the
principal point make pixels: Brown and Conrady's five parameters, and the fisheye of Kannala and
Brandt (PAMI 2006, eq. 6), as OpenCV's modules `calib3d` and `fisheye` have them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ground_station.arrays import F64, Bools

WIDEST = math.radians(65.0)
"""From the optical axis, the largest angle at which a fisheye's key points are used.

The rest of the program lives on the plane z = 1, which ends at 90°. Towards its rim a pixel covers
more and more of it, along the radius by about 1/cos²: 2 at 45°, 5.6 at 65°, 8.5 at 70°, 15 at 75°.
With COLMAP's adjustment on the plane, in two simulated rooms a 150° lens made maps
whose centres were off by 0.98 and 2.37 mm (RMS) at 55°, 0.51 and 1.24 at 65°, 0.40 and 1.42 at 70°,
0.42 and 0.67 at 75°: beyond 65° the two do not agree, and a board to calibrate with is hardly
ever seen farther out. The web page's frustum (view_rays.js) has the same number.
"""


@dataclass(frozen=True)
class BrownConrady:
    """OpenCV's five parameters. Radial terms are polynomials of tan: for lenses up to about 110°.

    Every pixel is used.
    """

    k1: float
    k2: float
    p1: float
    p2: float
    k3: float

    NAMES: ClassVar = ("k1", "k2", "p1", "p2", "k3")
    FOXGLOVE: ClassVar = "plumb_bob"
    reach: ClassVar = math.inf
    """The largest tangent that is used."""

    @property
    def is_none(self) -> bool:
        """Whether the camera is a pinhole."""
        return not any((self.k1, self.k2, self.p1, self.p2, self.k3))

    def bend(self, xy: F64) -> F64:
        """Rays on the plane z = 1 (N, 2) to bent coordinates (N, 2)."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        xd = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([xd, yd], axis=1)

    def bend_points(self, points: F64) -> F64:
        """Points (N, 3) to bent coordinates (N, 2); NaN for those with z <= 0."""
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        return self.bend(points[:, :2] / z[:, None])

    def unbend(self, pixels: F64, matrix: F64) -> F64:
        """Pixels (N, 2) of a camera with K (3, 3) to rays on the plane z = 1 (N, 2)."""
        import cv2  # a tenth of a second for a process that only passes the numbers on

        numbers = np.array([self.k1, self.k2, self.p1, self.p2, self.k3])
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 1e-12)
        uv = np.ascontiguousarray(pixels.reshape(-1, 1, 2))
        found = cv2.undistortPointsIter(uv, matrix, numbers, np.eye(3), np.eye(3), criteria)
        xy = np.asarray(found, np.float64).reshape(-1, 2)
        # OpenCV's fixed point is reached slowly where the lens bends much: Newton's method ends it.
        bent = _unscaled(pixels, matrix)
        off = self.bend(xy) - bent
        for _ in range(_POLISHING):
            if np.abs(off).max(initial=0.0) < _CONVERGED:
                break
            xx, both, yy = self._derivative(xy)
            area = xx * yy - both * both
            area = np.where(np.abs(area) > _FOLDED, area, np.inf)
            step = np.stack([yy * off[:, 0] - both * off[:, 1], xx * off[:, 1] - both * off[:, 0]])
            new = xy - (step / area).T
            left = self.bend(new) - bent
            nearer = np.abs(left).max(axis=1) < np.abs(off).max(axis=1)
            xy, off = np.where(nearer[:, None], new, xy), np.where(nearer[:, None], left, off)
        return xy

    def rays(self, pixels: F64, matrix: F64) -> F64:
        """Pixels (N, 2) to directions (N, 3) of any length."""
        return np.column_stack([self.unbend(pixels, matrix), np.ones(len(pixels))])

    def uses(self, pixels: F64, matrix: F64) -> Bools:
        """Whether what is seen at pixels (N, 2) is used (N,): all of it."""
        return np.ones(len(pixels), bool)

    def drawn_in(self, bent: F64) -> F64:
        """Bent coordinates (N, 2), nearer to the axis where they are not used: all are."""
        return bent

    def stretch(self, xy: F64) -> F64:
        """How much longer a pixel's noise is on the plane than on a pinhole's (N,), RMS.

        Of the inverse of `bend`'s derivative.
        """
        xx, both, yy = self._derivative(xy)
        area = np.maximum(np.abs(xx * yy - both * both), _FOLDED)
        return np.asarray(np.sqrt(0.5 * (xx * xx + yy * yy) + both * both) / area)

    def _derivative(self, xy: F64) -> tuple[F64, F64, F64]:
        """Of `bend`, a symmetric matrix at each of (N, 2): its xx, xy and yy (N,)."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2 * (self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3))
        xx = radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x
        yy = radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x
        return xx, slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y, yy


@dataclass(frozen=True)
class KannalaBrandt:
    """OpenCV's fisheye: bent radius d(θ) = θ·(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ + k4·θ⁸), θ from the axis.

    Directions are known up to where d turns back or to 180°; `WIDEST` bounds those that are used
    on the plane z = 1.
    """

    k1: float
    k2: float
    k3: float
    k4: float

    NAMES: ClassVar = ("k1", "k2", "k3", "k4")
    FOXGLOVE: ClassVar = "kannala_brandt"
    is_none: ClassVar = False

    @cached_property
    def fold(self) -> float:
        """The angle at which the polynomial turns back, radians; π where it does not."""
        slope = [9 * self.k4, 0, 7 * self.k3, 0, 5 * self.k2, 0, 3 * self.k1, 0, 1]
        roots = np.roots(slope)
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        return float(real.min(initial=math.pi))

    @property
    def reach(self) -> float:
        """The largest tangent that is used."""
        return math.tan(min(WIDEST, self.fold))

    def radius(self, angle: F64) -> F64:
        """d(θ) of angles (N,), radians."""
        t = angle * angle
        return angle * (1 + t * (self.k1 + t * (self.k2 + t * (self.k3 + t * self.k4))))

    def slope(self, angle: F64) -> F64:
        """d'(θ) of angles (N,), radians."""
        t = angle * angle
        return 1 + t * (3 * self.k1 + t * (5 * self.k2 + t * (7 * self.k3 + t * 9 * self.k4)))

    def bend(self, xy: F64) -> F64:
        """Rays on the plane z = 1 (N, 2) to bent coordinates (N, 2); NaN beyond the fold."""
        r = np.hypot(xy[:, 0], xy[:, 1])
        return xy * self._over(r, np.arctan(r))[:, None]

    def bend_points(self, points: F64) -> F64:
        """Points (N, 3) to bent coordinates (N, 2), also of z <= 0; NaN beyond the fold."""
        r = np.hypot(points[:, 0], points[:, 1])
        return points[:, :2] * self._over(r, np.arctan2(r, points[:, 2]))[:, None]

    def _over(self, r: F64, angle: F64) -> F64:
        """d(θ)/r (N,), at the axis as a pinhole's; NaN beyond the fold, and opposite the axis."""
        bent = np.where(angle < self.fold, self.radius(angle), np.nan)
        near = r < 1e-12
        return np.where(near, np.where(angle < 1, 1.0, np.nan), bent / np.where(near, 1.0, r))

    def unbend(self, pixels: F64, matrix: F64) -> F64:
        """Pixels (N, 2) of a camera with K (3, 3) to rays on the plane z = 1 (N, 2).

        NaN for those that are farther from the axis than `WIDEST` or the fold.
        """
        bent, r, angle = self._angles(pixels, matrix)
        tangent = np.tan(np.where(angle <= WIDEST, angle, np.nan))
        return bent * np.where(r > 1e-12, tangent / np.maximum(r, 1e-12), tangent + 1)[:, None]

    def rays(self, pixels: F64, matrix: F64) -> F64:
        """Pixels (N, 2) to directions (N, 3) of length 1; NaN where no direction is seen."""
        bent, r, angle = self._angles(pixels, matrix)
        aside = bent * (np.sin(angle) / np.maximum(r, 1e-12))[:, None]
        return np.column_stack([aside, np.cos(angle)])

    def uses(self, pixels: F64, matrix: F64) -> Bools:
        """Whether what is seen at pixels (N, 2) is used (N,): up to `WIDEST` from the axis."""
        bent = _unscaled(pixels, matrix)
        return np.asarray(np.hypot(bent[:, 0], bent[:, 1]) < self._widest)

    @cached_property
    def _widest(self) -> float:
        """The bent radius that is used; not at the very limit, where a last bit would decide."""
        return (1 - 1e-9) * float(self.radius(np.array(min(WIDEST, self.fold))))

    def drawn_in(self, bent: F64) -> F64:
        """Bent coordinates (N, 2), nearer to the axis where they are not used."""
        r = np.hypot(bent[:, 0], bent[:, 1])
        return bent * np.minimum(1.0, (1 - 1e-9) * self._widest / np.maximum(r, 1e-12))[:, None]

    def stretch(self, xy: F64) -> F64:
        """How much longer a pixel's noise is on the plane than on a pinhole's (N,), RMS.

        Along the radius 1/(d'(θ)·cos²θ), the inverse of d(θ)'s derivative by tan θ, and across it
        tan θ/d(θ).
        """
        r = np.hypot(xy[:, 0], xy[:, 1])
        along = (1 + r * r) / self.slope(angle := np.arctan(r))
        across = np.where(r > 1e-6, r / np.maximum(self.radius(angle), 1e-12), 1.0)
        return np.asarray(np.sqrt(0.5 * (along * along + across * across)))

    def _angles(self, pixels: F64, matrix: F64) -> tuple[F64, F64, F64]:
        """Bent coordinates (N, 2), their length (N,), and θ (N,) by Newton's method.

        NaN where the lens turns back before. The start is never beyond: d' only has to stay
        positive on the way, which it is below the fold.
        """
        bent = _unscaled(pixels, matrix)
        r = np.hypot(bent[:, 0], bent[:, 1])
        fold = self.fold
        seen = r < self.radius(np.array(fold))
        wanted = np.where(seen, r, 0.0)
        low, high = np.zeros_like(r), np.full_like(r, fold)
        angle = np.minimum(wanted, 0.9 * fold)
        for _ in range(_STEPS):
            off = self.radius(angle) - wanted
            low, high = np.where(off > 0, low, angle), np.where(off > 0, angle, high)
            step = angle - off / np.maximum(self.slope(angle), 1e-9)
            # Newton's where it stays between what is known to bracket the angle, else the middle.
            new = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
            if np.abs(new - angle).max(initial=0.0) < _CONVERGED:
                angle = new
                break
            angle = new
        return bent, r, np.where(seen, angle, np.nan)


LensModel = BrownConrady | KannalaBrandt
MODELS: dict[str, type[BrownConrady] | type[KannalaBrandt]] = {
    "opencv5": BrownConrady,
    "fisheye": KannalaBrandt,
}
"""By the name in a camera's file."""

_STEPS = 60
"""Bisection alone, which Newton's method falls back to, halves π to 1e-12 in 42."""
_CONVERGED = 1e-12
_POLISHING = 5
"""Steps of Newton's method after OpenCV's: each doubles the digits that are right."""
_FOLDED = 0.05
"""Of an area on the plane, the least share that its picture is taken for: beyond where the
five-parameter polynomial turns back nothing is known."""


def _unscaled(pixels: F64, matrix: F64) -> F64:
    """Pixels (N, 2) to bent coordinates (N, 2)."""
    return np.asarray((pixels - matrix[:2, 2]) / [matrix[0, 0], matrix[1, 1]])
