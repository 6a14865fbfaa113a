"""Weights from files of torch and safetensors, without torch; nothing in a file is executed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load

from ground_station import bounded
from ground_station.arrays import F32
from ground_station.feature_models import torch_tensors
from ground_station.features.extractor import FeatureError
from ground_station.files import read_bytes
from pi_firmware.wire.text import printable

Shape = tuple[int, ...]

MOST_BYTES: Final = 512 << 20
"""Of a file; SuperPoint's has 5 MB."""
_SECONDS, _BYTES, _TIMES = 20, 1 << 30, 4
"""What reading a file of torch's may take, and `_TIMES` the file's bytes more."""


class WeightsError(FeatureError):
    """A weights file that is missing, cut, wrong or not what it should be; the text is one line."""


@dataclass(frozen=True)
class Weights:
    """The tensors of a file, by name, and its SHA-256."""

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


def read(path: str | Path) -> Weights:
    """The tensors of a PyTorch or safetensors file.

    Raises `WeightsError` with one line for a file that is missing, cut, damaged or of another kind,
    or that names anything besides tensors.
    """
    path = Path(path)
    data = read_bytes(path, MOST_BYTES, WeightsError)
    form = data if data[8:9] == b"{" else _converted(path, data)
    try:
        tensors = load(form)
    except (SafetensorError, KeyError, TypeError, ValueError) as error:  # types that numpy lacks
        raise WeightsError(f"{path}: a damaged safetensors file ({error!s:.60})") from None
    if not tensors:
        raise WeightsError(f"{path}: it holds no tensors by name")
    return Weights(path, tensors, hashlib.sha256(data).hexdigest())


def _converted(path: Path, data: bytes) -> bytes:
    """A file of torch's as safetensors."""
    limit = _BYTES + _TIMES * len(data)
    program = Path(torch_tensors.__file__)
    done = bounded.run(program, seconds=_SECONDS, memory_bytes=limit, data=data)
    if done.returncode == 0:
        return done.stdout
    lines = done.stderr.decode(errors="replace").strip().splitlines() or ["it takes too long"]
    raise WeightsError(
        f"{path}: no weights that torch or safetensors wrote: {printable(lines[-1], 150)}"
    )
