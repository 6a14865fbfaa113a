"""Poses along the direction that far landmarks leave open, judged by near ones.

Before a wall far off a turn is hard to tell from a step aside, and the shear of a rolling shutter
takes up what tells them apart. Such a pose hangs on the few near things in the picture: found where
they are, they hold it; a few pairs by chance hold a wrong one as well, and it seems sure.
"""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F64
from ground_station.geometry import poses

NEAR, FAR = 0.5, 0.8
"""Of the median depth: nearer landmarks tell a turn from a step aside, farther ones do not."""
MORE = 2.0
"""Deviations of a count by which another pose must show more near landmarks."""
SURE = 10.0
"""Deviations by which more near landmarks are seen than by chance where they hold a pose."""
TRIED = 3
"""Poses, those with the most near landmarks, that are solved."""
_OPENS, _OPEN = 3.0, 0.01
"""So many times the deviation of a place with near landmarks, and this share of their depth, make
the one without them open."""
_REACH = 6.0
"""Standard deviations of the far landmarks' solution that are looked through: a camera that speeds
up during the readout is further off than its covariance says."""
_MOST = 60
"""Poses at most."""


def opens(covariance: F64, without: F64, near: float) -> bool:
    """Whether a pose's covariance (6, 6) `without` near landmarks, at `near`, is much larger."""
    before, after = (float(np.sqrt(np.trace(each[3:6, 3:6]))) for each in (covariance, without))
    return after > max(_OPENS * before, _OPEN * near)


def weakest(covariance: F64, depth: float) -> F64:
    """The tangent step (6,) of one standard deviation in a pose's weakest direction.

    `covariance` (6, 6) of the right tangent; a turn counts as the step aside that it resembles at
    `depth`.
    """
    unit = np.repeat([depth, 1.0], 3)
    values, vectors = np.linalg.eigh(covariance * np.outer(unit, unit))
    return np.asarray(vectors[:, -1] * np.sqrt(max(values[-1], 0.0)) / unit)


def along(wTc: F64, step: F64, moved_px: float, radius_px: float) -> list[F64]:
    """`wTc` and poses (4, 4) to both its sides, the nearest first.

    `step` (6,) is one standard deviation, by which near landmarks move `moved_px` in the picture;
    from one pose to the next they move by a radius within which they are looked for.
    """
    count = min(int(np.ceil(_REACH * moved_px / radius_px)), _MOST // 2)
    shares = _REACH * np.arange(1, count + 1) / max(count, 1)
    return [wTc, *(wTc @ poses.exp(step * share) for each in shares for share in (each, -each))]
