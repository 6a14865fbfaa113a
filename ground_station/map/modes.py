"""More than one descriptor for a landmark: what it looks like in another light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F32, I32, I64, Bools, Indices
from ground_station.map.descriptors import Descriptors, joined, rows_of

MOST = 8
"""Modes that one landmark may have: a file that claims more is refused."""


@dataclass(frozen=True)
class Modes:
    """Further descriptors of some landmarks.

    `landmark` (N,), their indices in ascending order, each as often as it has modes; `descriptor`
    (N, D), unit rows: an array or, from a file, `Descriptors`. They take part wherever the
    landmarks' own descriptors do, and two of one landmark are never rivals.
    """

    landmark: I32
    descriptor: F32 | Descriptors

    def __len__(self) -> int:
        return len(self.landmark)

    def of(self, index: Indices) -> tuple[Indices, Indices]:
        """The modes of landmarks `index` (P,): rows (Q,), and the place in `index` of each (Q,).

        Places ascend.
        """
        first = np.searchsorted(self.landmark, index)
        count = np.searchsorted(self.landmark, index, side="right") - first
        place = np.repeat(np.arange(len(index)), count)
        shift = first - (np.cumsum(count) - count)
        return np.arange(len(place)) + shift[place], place

    def among(self, kept: Bools) -> Modes | None:
        """Those of the landmarks that are kept of all M, (M,), which are counted again."""
        rows = np.flatnonzero(kept[self.landmark])
        landmark = (np.cumsum(kept) - 1)[self.landmark[rows]]
        return (
            Modes(landmark.astype(np.int32), rows_of(self.descriptor, rows)) if len(rows) else None
        )


def with_modes(modes: Modes | None, landmark: I64, descriptor: F32) -> Modes:
    """The modes and further ones of landmarks (N,), unit rows (N, D), in any order."""
    rows: F32 | Descriptors = descriptor
    if modes is not None:
        landmark = np.concatenate([modes.landmark, landmark])
        rows = joined(modes.descriptor, descriptor)
    order = np.argsort(landmark, kind="stable")
    return Modes(landmark[order].astype(np.int32), rows_of(rows, order))


def described(
    descriptors: F32 | Descriptors, modes: Modes | None, index: Indices
) -> tuple[F32, Indices | None]:
    """Unit rows of landmarks `index` (P,), then those of their modes: (P + Q, D).

    And the place in `index` of each mode (Q,), ascending; None where they have none.
    """
    rows = descriptors[index]
    if modes is None:
        return rows, None
    row, place = modes.of(index)
    if not len(place):
        return rows, None
    return np.concatenate([rows, modes.descriptor[row]]), place
