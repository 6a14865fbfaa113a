"""The networks in torch; only training needs this module."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from torch import Tensor, nn
from torch.nn import functional

from ground_station.training.export import EPSILON, Weights
from ground_station.training.topology import Conv, Operations, Shape, layers

_TERMS = {"weight": "weight", "bias": "bias", "mean": "running_mean", "var": "running_var"}
"""Of a batch normalisation: our names and torch's."""


class FeatureNetwork(nn.Module):
    """A shape with weights: image (N, 1, H, W) to its outputs, see `topology`."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.shape = shape
        self.layers = nn.ModuleDict()
        for layer in layers(shape):
            self.layers[_key(layer.name)] = _module(layer)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Descriptors (N, D - d, H/8, W/8), details (N, d, H/4, W/4), worth (N, 1, H/8, W/8)."""
        descriptors, details, worth = self.shape.build(_TorchOperations(self.layers), image)
        return descriptors, details, worth


class _TorchOperations(Operations):
    def __init__(self, modules: nn.ModuleDict) -> None:
        self._modules = modules

    def conv(self, layer: Conv, x: Tensor) -> Tensor:
        made: Tensor = self._modules[_key(layer.name)](x)
        return made

    def relu(self, x: Tensor) -> Tensor:
        return functional.relu(x)

    def add(self, first: Tensor, second: Tensor) -> Tensor:
        return first + second

    def double(self, x: Tensor) -> Tensor:
        return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)

    def fold(self, x: Tensor, side: int) -> Tensor:
        return functional.pixel_unshuffle(x, side)


def _key(name: str) -> str:
    """torch's names of modules have no dots."""
    return name.replace(".", "_")


def _module(layer: Conv) -> nn.Sequential:
    conv = nn.Conv2d(
        layer.channels_in, layer.channels_out, layer.size, layer.stride,
        padding=layer.size // 2, bias=not layer.norm,
    )  # fmt: skip
    nn.init.kaiming_normal_(conv.weight, nonlinearity="relu" if layer.norm else "linear")
    parts = nn.Sequential(conv)
    if layer.norm:
        parts.append(nn.BatchNorm2d(layer.channels_out, eps=EPSILON))
    elif conv.bias is not None:
        nn.init.zeros_(conv.bias)
    return parts


def exported(shape: Shape, state: Mapping[str, Tensor]) -> Weights:
    """A network's `state_dict` under the names that `export` knows."""
    result: dict[str, np.ndarray] = {}
    for layer in layers(shape):
        key = f"layers.{_key(layer.name)}"
        names = {"weight": "0.weight"}
        if layer.norm:
            names |= {f"norm.{ours}": f"1.{torchs}" for ours, torchs in _TERMS.items()}
        else:
            names["bias"] = "0.bias"
        for ours, torchs in names.items():
            tensor = state[f"{key}.{torchs}"]
            result[f"{layer.name}.{ours}"] = tensor.detach().float().cpu().contiguous().numpy()
    return result
