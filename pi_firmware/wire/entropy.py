"""How much a picture says: Shannon's entropy of its luma, measured alike on both sides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def entropy_bits(luma: NDArray[np.uint8]) -> float:
    """Shannon entropy of the 256-bin histogram of `luma` (any shape, uint8), bits, 0 to 8.

    -sum(p log2 p); Shannon, Bell System Technical Journal 27, 1948.
    """
    return of_counts(np.bincount(luma.ravel(), minlength=256))


def of_counts(counts: NDArray[np.int64]) -> float:
    """The same of a histogram (256,), however it was counted."""
    p = counts[counts > 0] / counts.sum()
    return max(0.0, -float(p.dot(np.log2(p))))
