"""What two images show of their geometry, as structure from motion takes it."""

from __future__ import annotations

from dataclasses import dataclass

from ground_station.arrays import F64, I32


@dataclass(frozen=True)
class TwoView:
    """The verified geometry of a pair.

    `matches` (K, 2), the inliers' key points; `essential` (3, 3) with x₂ᵀ E x₁ = 0 for coordinates
    on the plane z = 1; `homography` (3, 3) of undistorted pixels or None; `degenerate`: the scene
    is a plane or the camera only turned, so the pair gives no baseline.
    """

    matches: I32
    essential: F64
    homography: F64 | None
    degenerate: bool
