"""Shapes of envelopes: volume, surface of the film, areas against the air."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scipy.special import ellipe, ellipk

from hw.quantities import HardwareError, checked

SHAPES = ("ellipsoid", "sphere", "pillow")


@dataclass(frozen=True)
class Envelope:
    """A filled envelope. Lengths in m: along its axis of flight, across, and upwards.

    `film_m2` is the film that it is cut from, which for a pillow is more than its surface.
    """

    shape: str
    length_m: float
    width_m: float
    height_m: float
    volume_m3: float
    film_m2: float

    @property
    def plan_m2(self) -> float:
        """Area seen from above, which the air meets when it climbs."""
        return math.pi * self.length_m * self.width_m / 4

    def scaled(self, factor: float) -> Envelope:
        """The same shape with every length times `factor`."""
        return Envelope(
            self.shape, self.length_m * factor, self.width_m * factor, self.height_m * factor,
            self.volume_m3 * factor**3, self.film_m2 * factor**2,
        )  # fmt: skip


def ellipsoid(length_m: float, width_m: float) -> Envelope:
    """A spheroid around its length; surface of the prolate or oblate spheroid in closed form."""
    checked("length_m", length_m)
    checked("width_m", width_m)
    a, b = length_m / 2, width_m / 2
    if math.isclose(a, b, rel_tol=1e-6):  # at the sphere the closed forms are 0 / 0
        surface = 4 * math.pi * b * b
    elif a > b:
        e = math.sqrt(1 - (b / a) ** 2)
        surface = 2 * math.pi * b * b * (1 + a / (b * e) * math.asin(e))
    else:
        e = math.sqrt(1 - (a / b) ** 2)
        surface = 2 * math.pi * b * b * (1 + (1 - e * e) / e * math.atanh(e))
    volume = 4 / 3 * math.pi * a * b**2
    return Envelope("ellipsoid", length_m, width_m, width_m, volume, surface)


def sphere(diameter_m: float) -> Envelope:
    checked("diameter_m", diameter_m)
    r = diameter_m / 2
    volume, surface = 4 / 3 * math.pi * r**3, 4 * math.pi * r * r
    return Envelope("sphere", diameter_m, diameter_m, diameter_m, volume, surface)


def pillow(diameter_m: float) -> Envelope:
    """Two flat discs of this diameter sealed at their rim and filled, lying flat: a foil balloon.

    W. H. Paulsen, 'What is the shape of a Mylar balloon?', Amer. Math. Monthly 101(10), 1994: with
    discs of radius a the filled radius is r = a/A, the thickness 2 B r and the volume 2/3 π a r²,
    where A = K(1/√2)/√2 = 1.3110 and B = π/(4A) = 0.5991 are the lemniscate constants. Film that
    does not stretch.
    """
    checked("diameter_m", diameter_m)
    a = diameter_m / 2
    first = float(ellipk(0.5)) / math.sqrt(2)
    second = math.sqrt(2) * (float(ellipe(0.5)) - float(ellipk(0.5)) / 2)
    r = a / first
    volume = 2 / 3 * math.pi * a * r * r
    return Envelope("pillow", 2 * r, 2 * r, 2 * second * r, volume, 2 * math.pi * a * a)


def of_shape(shape: str, length_m: float, width_m: float, diameter_m: float) -> Envelope:
    """An envelope from a file's or a command's words; raises `HardwareError` with one line."""
    if shape == "ellipsoid":
        return ellipsoid(length_m, width_m)
    if shape in ("sphere", "pillow"):
        return sphere(diameter_m) if shape == "sphere" else pillow(diameter_m)
    raise HardwareError(f"shape is {shape!r}; allowed: {', '.join(SHAPES)}")


def of_volume(shape: str, volume_m3: float) -> Envelope:
    """The envelope of a shape that holds a volume; an ellipsoid's length is two widths."""
    one = ellipsoid(2.0, 1.0) if shape == "ellipsoid" else of_shape(shape, 1.0, 1.0, 1.0)
    return one.scaled(float((volume_m3 / one.volume_m3) ** (1 / 3)))
