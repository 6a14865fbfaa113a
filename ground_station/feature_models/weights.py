"""Weights of a network by name, from the file that a user brings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32
from ground_station.features.extractor import FeatureError

Shape = tuple[int, ...]


class WeightsError(FeatureError):
    """A weights file that is missing, cut, wrong or not what it should be; the text is one line."""


@dataclass(frozen=True)
class Weights:
    """The tensors of a file; they are views of its bytes, so that a file claims no memory."""

    path: Path
    tensors: Mapping[str, npt.NDArray[Any]]
    sha256: str = ""

    def has(self, name: str) -> bool:
        """Whether there is a tensor of that name."""
        return name in self.tensors

    def shape(self, name: str) -> Shape:
        """The shape of a tensor; raises `WeightsError` when it is missing."""
        if name not in self.tensors:
            raise WeightsError(f"{self.path}: the tensor {name} is missing")
        return self.tensors[name].shape

    def take(self, name: str, shape: Shape) -> F32:
        """A tensor of exactly that shape, finite, float32; raises `WeightsError` naming it."""
        found = self.shape(name)
        if found != shape:
            raise WeightsError(
                f"{self.path}: the tensor {name} is {_by(found)}; it should be {_by(shape)}"
            )
        tensor = self.tensors[name]
        if tensor.dtype.kind != "f":
            raise WeightsError(f"{self.path}: the tensor {name} holds {tensor.dtype}, no weights")
        # Doubles beyond the range of floats become infinite, and are refused below.
        with np.errstate(over="ignore"):
            values = np.ascontiguousarray(tensor, dtype=np.float32)
        if not np.isfinite(values).all():
            raise WeightsError(f"{self.path}: the tensor {name} has values that are not finite")
        return values

    def batch_norm(self, name: str, channels: int) -> tuple[F32, F32, F32, F32]:
        """Scale, shift, mean and variance of torch's BatchNorm2d, each (channels,)."""
        parts = ("weight", "bias", "running_mean", "running_var")
        scale, shift, mean, variance = (self.take(f"{name}.{part}", (channels,)) for part in parts)
        if (variance < 0).any():
            raise WeightsError(f"{self.path}: the tensor {name}.running_var has negative values")
        return scale, shift, mean, variance


def _by(shape: Shape) -> str:
    return "x".join(map(str, shape[:8])) + ("…" if len(shape) > 8 else "") if shape else "a number"
