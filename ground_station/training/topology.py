"""The networks' shapes, written once: torch trains them, ONNX carries them.

Each is a function over some `Operations`, which say what a convolution or a sum is to them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from ground_station.training.errors import TrainingError

CELL_PX = 8
LOGITS = CELL_PX * CELL_PX + 1
"""A cell's pixels and "none", as SuperPoint's detector has them."""


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


class Operations(Protocol):
    """What a network is made of. Tensors are whatever the implementation takes for them."""

    def conv(self, layer: Conv, x: Any) -> Any:
        """A convolution, normalised if its layer says so."""

    def relu(self, x: Any) -> Any:
        """max(x, 0)."""

    def add(self, first: Any, second: Any) -> Any:
        """The sum."""

    def concat(self, first: Any, second: Any) -> Any:
        """Channels after channels."""

    def double(self, x: Any) -> Any:
        """Twice the size, bilinear, pixel centres at half numbers."""

    def fold(self, x: Any, side: int) -> Any:
        """One channel's squares of `side` pixels as so many channels, row by row."""


@dataclass(frozen=True)
class Shape:
    """A network: image (N, 1, H, W) to logits (N, 65, H/8, W/8) and descriptors (N, D, ...).

    H and W must be multiples of `multiple`.
    """

    name: str
    dimension: int
    multiple: int
    build: Callable[[Operations, Any], tuple[Any, Any]]


def _parts(o: Operations) -> tuple[Callable[..., Any], Callable[[str, Any, int], Any]]:
    """A convolution with what follows it, and two of them that the input goes around."""

    def layer(name: str, x: Any, a: int, b: int, size: int = 3, stride: int = 1) -> Any:
        return o.relu(o.conv(Conv(name, a, b, size, stride), x))

    def residual(name: str, x: Any, width: int) -> Any:
        y = layer(f"{name}.1", x, width, width)
        return o.relu(o.add(x, o.conv(Conv(f"{name}.2", width, width), y)))

    return layer, residual


def _wren(o: Operations, image: Any) -> tuple[Any, Any]:
    """Strided stem to a quarter of the size, residual blocks at 1/8 and 1/16, two heads.

    Context comes from 1/16; where a point is to a fraction of a pixel, the detector sees at 1/4.
    """

    layer, residual = _parts(o)
    x = layer("stem.1", image, 1, 16, stride=2)
    x = layer("stem.2", x, 16, 32, stride=2)
    quarter = layer("quarter", x, 32, 32)
    eighth = residual("eighth", layer("to_eighth", quarter, 32, 64, stride=2), 64)
    x = layer("to_sixteenth", eighth, 64, 64, stride=2)
    x = residual("sixteenth.b", residual("sixteenth.a", x, 64), 64)
    x = layer("fuse", o.add(eighth, o.double(x)), 64, 64, size=1)
    fine = layer("detector.fine", quarter, 32, 64, stride=2)
    y = layer("detector.both", o.concat(fine, x), 128, 64, size=1)
    logits = o.conv(Conv("detector.logits", 64, LOGITS, 1, norm=False), y)
    y = layer("descriptor.wide", x, 64, 128, size=1)
    return logits, o.conv(Conv("descriptor.out", 128, 64, 1, norm=False), y)


def _swift(o: Operations, image: Any) -> tuple[Any, Any]:
    """The picture folded to a quarter of its size, residual blocks at 1/16, two heads at 1/8.

    A convolution over a single channel costs as much as one over 32, whatever it computes with:
    nothing but the fold sees the picture at its own size. Context comes from 1/16; where a point is
    to a fraction of a pixel, the detector sees at 1/4 and in the 64 pixels of its cell.
    """

    layer, residual = _parts(o)
    x = layer("stem", o.fold(image, 4), 16, 32)
    quarter = layer("quarter", x, 32, 32)
    eighth = layer("to_eighth", quarter, 32, 64, stride=2)
    x = layer("to_sixteenth", eighth, 64, 64, stride=2)
    for name in "abc":
        x = residual(f"sixteenth.{name}", x, 64)
    x = layer("fuse", o.add(eighth, o.double(x)), 64, 64, size=1)
    y = layer("descriptor.wide", x, 64, 128, size=1)
    descriptors = o.conv(Conv("descriptor.out", 128, 64, 1, norm=False), y)
    fine = layer("detector.fine", quarter, 32, 64, stride=2)
    pixels = layer("detector.pixels", o.fold(image, CELL_PX), 64, 64, size=1)
    y = layer("detector.all", o.concat(o.concat(fine, pixels), x), 192, 96, size=1)
    y = layer("detector.wide", y, 96, 96, size=1)
    return o.conv(Conv("detector.logits", 96, LOGITS, 1, norm=False), y), descriptors


SHAPES = {
    "wren": Shape("wren", 64, 16, _wren),
    "swift": Shape("swift", 64, 16, _swift),
}


def shape_of(size: str) -> Shape:
    """The network of that size; raises `TrainingError` naming those there are."""
    if size not in SHAPES:
        raise TrainingError(f"size is '{size:.40}'; there are: {', '.join(SHAPES)}")
    return SHAPES[size]


class _Listing:
    """Operations that only remember the layers."""

    def __init__(self) -> None:
        self.layers: list[Conv] = []

    def conv(self, layer: Conv, x: None) -> None:
        self.layers.append(layer)

    def relu(self, x: None) -> None:
        return None

    def add(self, first: None, second: None) -> None:
        return None

    def concat(self, first: None, second: None) -> None:
        return None

    def double(self, x: None) -> None:
        return None

    def fold(self, x: None, side: int) -> None:
        return None


def layers(shape: Shape) -> tuple[Conv, ...]:
    """The convolutions in the order in which they run."""
    listing = _Listing()
    shape.build(listing, None)
    return tuple(listing.layers)
