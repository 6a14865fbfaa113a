"""Shapes against integrals taken numerically, and against an envelope that was built."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from hw.buoyancy import gross_lift_g
from hw.envelopes import SHAPES, ellipsoid, of_shape, of_volume, pillow, sphere
from hw.gases import air_kg_m3, helium_kg_m3
from hw.quantities import HardwareError


def surface_of_revolution(a: float, b: float) -> float:
    """Of the spheroid x²/a² + r²/b² = 1 about x: ∫ 2π r √(1 + r'²) dx, with x = a cos t."""
    ring = lambda t: (  # noqa: E731
        2 * math.pi * b * math.sin(t) * math.hypot(a * math.sin(t), b * math.cos(t))
    )
    return quad(ring, 0, math.pi)[0]


@pytest.mark.parametrize(("length_m", "width_m"), [(1.7, 0.62), (0.5, 0.8), (0.7, 0.70001)])
def test_a_spheroids_volume_and_surface(length_m: float, width_m: float) -> None:
    shape = ellipsoid(length_m, width_m)
    assert shape.volume_m3 == pytest.approx(math.pi / 6 * length_m * width_m**2)
    surface = surface_of_revolution(length_m / 2, width_m / 2)
    assert shape.film_m2 == pytest.approx(surface, rel=1e-6)


def test_a_sphere_is_the_round_spheroid() -> None:
    a, b = sphere(0.7), ellipsoid(0.7, 0.7)
    assert (a.volume_m3, a.film_m2) == pytest.approx((b.volume_m3, b.film_m2))


def test_a_pillow_is_paulsens_mylar_balloon() -> None:
    """Its profile z' = −x²/√(r⁴ − x⁴), integrated: arc, thickness and volume."""
    shape = pillow(1.0)
    r = shape.width_m / 2
    # x = r √(sin t) takes the root at the rim away.
    arc = quad(lambda t: r / 2 / math.sqrt(math.sin(t)), 0, math.pi / 2)[0]
    assert arc == pytest.approx(0.5, rel=1e-6)  # film that does not stretch
    half = quad(lambda t: r / 2 * math.sqrt(math.sin(t)), 0, math.pi / 2)[0]
    assert shape.height_m / 2 == pytest.approx(half, rel=1e-6)
    # Shells: V = 2 ∫ π x² (−z') dx = 2 π ∫ x⁴/√(r⁴ − x⁴) dx.
    volume = quad(lambda t: math.pi * r**3 * math.sin(t) ** 1.5, 0, math.pi / 2)[0]
    assert shape.volume_m3 == pytest.approx(volume, rel=1e-6)
    assert shape.film_m2 == pytest.approx(2 * math.pi * 0.25)


def test_a_pillow_that_was_built() -> None:
    """Two discs of 0.965 m were reported to be 0.75 m wide and to lift 93 g net of their foil."""
    shape = pillow(0.965)
    assert shape.width_m == pytest.approx(0.75, abs=0.02)
    gross = gross_lift_g(shape.volume_m3, air_kg_m3(20, 1013.25), helium_kg_m3(20, 1013.25, 93))
    assert 20 < (gross - 93) / shape.film_m2 < 35  # g/m², as such foil weighs


@pytest.mark.parametrize("shape", SHAPES)
def test_the_shape_of_a_volume_has_that_volume(shape: str) -> None:
    for volume_m3 in np.geomspace(0.01, 10, 5):
        assert of_volume(shape, float(volume_m3)).volume_m3 == pytest.approx(volume_m3)


def test_an_unknown_shape_and_a_length_that_cannot_be_are_refused() -> None:
    with pytest.raises(HardwareError, match=r"shape is 'cube'; allowed: ellipsoid, sphere, pillow"):
        of_shape("cube", 1, 1, 1)
    with pytest.raises(HardwareError, match=r"diameter_m is 0; allowed: 0\.05 to 20 m"):
        pillow(0)
