"""How far a feature's descriptor may be from each landmark's, learned from what was seen."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ground_station.localization.settings import AssociationSettings

F32 = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.intp]

# Measured with RootSIFT on flights in other light than the map's (atrium: cloudy, evening, sunset).
_FLOOR = 0.2
"""RMS distance of one more observation of a landmark that the map's frames saw without spread."""
_PRIOR = 2.0
"""Observations that a landmark's spread in the map counts for, and its first odds as well."""
_MEMORY = 20.0
"""Observations of a landmark after which an old one weighs a third."""
_PER_RMS = 0.25
"""Of a landmark's RMS distance, how much its limit grows with it."""
_PER_LOG_ODDS = 0.06
"""How much the limit grows with the logarithm of its odds: right matches over wrong ones."""
_MARGIN = 0.05
"""Pairs this near to their limit tell whether all limits should move."""
_RIGHT_SHARE = 0.2
"""Of the pairs near their limits: with a larger share of right ones the limits grow. A larger value
costs fast flights, which have few pairs, more than it gains."""
RIGHT_PX = 3.0
"""A pair of a smaller residual is right: a solver's inliers are many by chance among the near."""
_STEP, _MOST = 0.002, 0.02
"""A pair's and a frame's weight in moving all limits."""
_LOWEST = 0.3
"""Even the least distinct landmark may be this far."""


class DescriptorThresholds:
    """One limit of L2 descriptor distance for each of M landmarks.

    limit = common + 0.25·RMS + 0.06·log odds, within 0.3 and `max_descriptor_distance`. The RMS of
    a landmark's distances begins with its `spread` in the map and goes on with its right pairs; its
    odds are right pairs over wrong ones. The common part follows light: it grows while enough of
    the pairs at the limits are right and falls when they are not.
    """

    def __init__(self, spread: F32, settings: AssociationSettings) -> None:
        """`spread` (M,) is the landmarks' in the map, in the unit of all other distances."""
        self._spread = spread
        self._highest = settings.max_descriptor_distance
        # Pages of zeros cost memory only where a landmark has been seen.
        self._square = np.zeros(len(spread), np.float32)
        self._right = np.zeros(len(spread), np.float32)
        self._wrong = np.zeros(len(spread), np.float32)
        self.common = self._highest - _PER_RMS * _FLOOR

    def limits(self, index: Indices) -> F32:
        """The limits of landmarks `index` (N,): (N,)."""
        right, wrong = self._right[index], self._wrong[index]
        prior = _FLOOR**2 + self._spread[index].astype(np.float32) ** 2
        rms = np.sqrt((_PRIOR * prior + self._square[index]) / (_PRIOR + right))
        odds = np.log((_PRIOR + right) / (_PRIOR + wrong))
        limit = self.common + _PER_RMS * rms + _PER_LOG_ODDS * odds
        lowest = min(_LOWEST, self._highest)
        return np.asarray(np.clip(limit, lowest, self._highest), np.float32)

    def learn(self, index: Indices, distance: F32, right: Flags) -> None:
        """Takes a solved frame's pairs: landmarks (N,), each once, distances (N,), right ones (N,).

        What is not a number is left out.
        """
        known = np.isfinite(distance)
        index, distance, right = index[known], distance[known], right[known]
        marginal = right[distance > self.limits(index) - _MARGIN]
        step = _STEP * float(marginal.sum() - _RIGHT_SHARE * len(marginal))
        lowest = _LOWEST - self._highest
        self.common += float(np.clip(step, -_MOST, _MOST))
        self.common = float(np.clip(self.common, lowest, self._highest))
        kept = np.float32(1 - 1 / _MEMORY)
        for total, new in (
            (self._square, np.where(right, distance**2, 0)),
            (self._right, right),
            (self._wrong, ~right),
        ):
            total[index] = kept * total[index] + new
