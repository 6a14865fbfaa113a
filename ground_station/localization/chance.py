"""Which pairs of descriptors chance may have made: told by pairs that only chance can have made.

The target-decoy method of mass spectrometry (Elias and Gygi, Nature Methods 2007): what is found
where nothing is to be found says how much of what is found is wrong.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def count_beyond_chance(
    distance: npt.NDArray[np.floating], by_chance: npt.NDArray[np.floating], share: float
) -> int:
    """How many of N pairs, the nearest first, chance can have made at most a `share` of.

    `distance` (N,), ascending, are of the descriptors of each pair; `by_chance` (M,), in any order,
    of the pairs that as many tries found of what is not there.
    """
    wrong = np.searchsorted(np.sort(by_chance), distance, side="right")
    kept = np.flatnonzero(wrong <= share * np.arange(1, len(distance) + 1))
    return int(kept[-1]) + 1 if len(kept) else 0
