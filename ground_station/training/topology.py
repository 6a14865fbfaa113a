"""The networks' shapes, written once: torch trains them, ONNX carries them.

Each is a function over some `Operations`, which say what a convolution or a sum is to them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ground_station.training.errors import TrainingError

CELL_PX = 8
"""Of the descriptors' map; that of the details has half of it."""


@dataclass(frozen=True)
class Conv:
    """One convolution, with as many zeros around as keep the size at stride 1.

    `norm`: a batch normalisation follows, which the exported network has inside its weights.
    """

    name: str
    channels_in: int
    channels_out: int
    size: int = 3
    stride: int = 1
    norm: bool = True


class Operations:
    """What a network is made of. Tensors are whatever a child takes for them; here they stay as
    they are."""

    def conv(self, layer: Conv, x: Any) -> Any:
        """A convolution, normalised if its layer says so."""
        return x

    def relu(self, x: Any) -> Any:
        """max(x, 0)."""
        return x

    def add(self, first: Any, second: Any) -> Any:
        """The sum."""
        return first

    def double(self, x: Any) -> Any:
        """Twice the size, bilinear, pixel centres at half numbers."""
        return x

    def fold(self, x: Any, side: int) -> Any:
        """One channel's squares of `side` pixels as so many channels, row by row."""
        return x


@dataclass(frozen=True)
class Shape:
    """A network: image (N, 1, H, W) to what layout `blobs` has, in the order of `OUTPUTS`.

    H and W must be multiples of `multiple`.
    """

    name: str
    dimension: int
    details: int
    multiple: int
    build: Callable[[Operations, Any], tuple[Any, Any, Any]]


OUTPUTS = ("descriptors", "details", "worth")


_COARSE, _FINE = 40, 24
"""Numbers of a descriptor: what is around a point, and what it is itself."""


def _lark(o: Operations, image: Any) -> tuple[Any, Any, Any]:
    """The picture folded to a quarter of its size, residual blocks at 1/8 and 1/16, three heads.

    A convolution over a single channel costs as much as one over 32, whatever it computes with:
    nothing but the fold sees the picture at its own size. Context comes from 1/16; what tells a
    point from its neighbours is seen at 1/4.
    """

    def layer(name: str, x: Any, a: int, b: int, size: int = 3, stride: int = 1) -> Any:
        return o.relu(o.conv(Conv(name, a, b, size, stride), x))

    def residual(name: str, x: Any, width: int) -> Any:
        y = layer(f"{name}.1", x, width, width)
        return o.relu(o.add(x, o.conv(Conv(f"{name}.2", width, width), y)))

    def head(name: str, x: Any, width: int, channels: int) -> Any:
        return o.conv(Conv(name, width, channels, 1, norm=False), x)

    quarter = layer("quarter", layer("stem", o.fold(image, 4), 16, 32), 32, 32)
    eighth = residual("eighth", layer("to_eighth", quarter, 32, 64, stride=2), 64)
    x = layer("to_sixteenth", eighth, 64, 64, stride=2)
    x = residual("sixteenth.b", residual("sixteenth.a", x, 64), 64)
    x = layer("fuse", o.add(eighth, o.double(x)), 64, 64, size=1)
    wide = layer("descriptor.wide", x, 64, 96, size=1)
    fine = layer("details.wide", quarter, 32, 32)
    return (
        head("descriptor.out", wide, 96, _COARSE), head("details.out", fine, 32, _FINE),
        head("worth.out", wide, 96, 1),
    )  # fmt: skip


SHAPES = {"lark": Shape("lark", _COARSE + _FINE, _FINE, 16, _lark)}


def shape_of(size: str) -> Shape:
    """The network of that size; raises `TrainingError` naming those there are."""
    if size not in SHAPES:
        raise TrainingError(f"size is '{size:.40}'; there are: {', '.join(SHAPES)}")
    return SHAPES[size]


class _Listing(Operations):
    """Operations that only remember the layers."""

    def __init__(self) -> None:
        self.layers: list[Conv] = []

    def conv(self, layer: Conv, x: None) -> None:
        self.layers.append(layer)


def layers(shape: Shape) -> tuple[Conv, ...]:
    """The convolutions in the order in which they run."""
    listing = _Listing()
    shape.build(listing, None)
    return tuple(listing.layers)
