"""A similarity between two sets of points, some of which do not belong together."""

from __future__ import annotations

from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.geometry.alignment import Alignment
from ground_station.map.colmap import pycolmap


def similarity(source: F64, target: F64, error: float, seed: int) -> Alignment | None:
    """The similarity by which most of source (N, 3) reach target (N, 3) within `error`, or None.

    LO-RANSAC: Chum, Matas and Kittler, "Locally optimized RANSAC", DAGM 2003.
    """
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = error, seed
    found: Any = pycolmap.estimate_sim3d_robust(source, target, options)  # a dict, or None
    if found is None:
        return None
    motion = found["tgt_from_src"]
    return Alignment(motion.rotation.matrix(), np.array(motion.translation), float(motion.scale))
