"""Pairs of views of pictures: a plane seen by two cameras, each with a lens of its own.

A view is a homography (turned, tilted, nearer or farther, its rows sheared as by a rolling shutter)
behind an equidistant lens of some strength. Pixels are x then y, centre of the top-left one at
(0, 0); batches of B pairs are tensors whose views are in rows 2b and 2b + 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

Size = tuple[int, int]

_FOCAL = 1.2
"""Of the view's camera, in its widths: at a tilt of 50° the horizon stays out of the picture."""
_ROLL_DEG, _ANY_ROLL = 30.0, 0.12
"""Most views are rolled by so much at most, this share of them by any angle."""
_TILT_DEG = 50.0
_SCALE = 0.6, 1.5
"""Picture pixels a view's pixel."""
_SHEAR = 0.03
"""Of a rolling shutter: the columns by which a row runs ahead of the one below it, deviation."""
_LENS, _STRAIGHT = 0.8, 0.5
"""The strongest lens, in radians a half width (a view of 120° on its diagonal), and the share of
pairs whose lens is none."""
_STRENGTHS, _SHARES = (0.1, 0.5, 1.0), (0.15, 0.35, 0.5)
"""Some pairs differ in little but light, as frames of a hovering blimp do."""


@dataclass(frozen=True)
class Views:
    """`to_picture`, `from_picture` (V, 3, 3) behind the lenses `lens` (V,), of `size` (H, W)."""

    to_picture: Tensor
    from_picture: Tensor
    lens: Tensor
    size: Size

    def _pixels(self) -> Tensor:
        """All pixels (V, H W, 2) of each view."""
        y, x = (torch.arange(n, device=self.lens.device, dtype=torch.float32) for n in self.size)
        grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=2).flatten(0, 1)
        return grid.expand(len(self.lens), -1, -1)

    def onto_picture(self, points_px: Tensor) -> Tensor:
        """Points (V, N, 2) of the views in their pictures, far off on or behind the horizon."""
        return _apply(self.to_picture, _bent(points_px, self.lens, self.size, straight=True))

    def of_picture(self, points_px: Tensor) -> Tensor:
        """Points (V, N, 2) of the pictures in the views."""
        return _bent(_apply(self.from_picture, points_px), self.lens, self.size, straight=False)

    def every_other(self, first: int) -> Views:
        """The first views of the pairs, or the second."""
        return Views(self.to_picture[first::2], self.from_picture[first::2], self.lens[first::2],
                     self.size)  # fmt: skip

    def across(self, points_px: Tensor, start: int) -> Tensor:
        """Points (B, N, 2) of the pairs' views `start`, 0 or 1, in their other views."""
        return self.every_other(1 - start).of_picture(
            self.every_other(start).onto_picture(points_px)
        )

    def taken(self, pictures: Tensor) -> Tensor:
        """The views (V, H, W) of pictures (V, H', W'), 0..1, by the mean where they shrink."""
        at = self.onto_picture(self._pixels()).clamp(-1e4, 1e4).unflatten(1, self.size)
        half = functional.avg_pool2d(pictures[:, None], 2)
        side = torch.tensor(pictures.shape[:0:-1], device=at.device, dtype=torch.float32)
        place = (at + 0.5) / side * 2 - 1
        large, small = (
            functional.grid_sample(source, place, "bilinear", "reflection", align_corners=False)
            for source in (pictures[:, None], half)
        )
        # As between two levels of a pyramid, by the scale in each pixel's neighbourhood.
        step = (at[:, 1:, :-1] - at[:, :-1, :-1]).norm(dim=3)
        step = functional.pad(step[:, None], (0, 1, 0, 1), mode="replicate")[:, 0]
        share = (torch.log2(step.clamp(1, 2)))[:, None]
        return (large * (1 - share) + small * share)[:, 0]


def _apply(matrix: Tensor, points_px: Tensor) -> Tensor:
    made = points_px @ matrix[:, :, :2].transpose(1, 2) + matrix[:, None, :, 2]
    return made[:, :, :2] / made[:, :, 2:].clamp(min=1e-6)


def _bent(points_px: Tensor, lens: Tensor, size: Size, straight: bool) -> Tensor:
    """Points through lenses r = atan(k r') / k, radii in half widths, or back again."""
    centre = torch.tensor([size[1] - 1, size[0] - 1], device=lens.device) / 2
    away = (points_px - centre) / (size[1] / 2)
    k = lens.clamp(min=1e-3)[:, None, None]
    radius = away.norm(dim=2, keepdim=True).clamp(min=1e-6)
    other = (k * radius).clamp(max=1.5).tan() / k if straight else (k * radius).atan() / k
    return (
        torch.where(lens[:, None, None] > 1e-3, away * (other / radius), away) * (size[1] / 2)
        + centre
    )


def inside(points_px: Tensor, size: Size, margin_px: float = 0.0) -> Tensor:
    """Which points (…, 2) lie in a picture of (rows, columns), `margin_px` from its edge."""
    high = torch.tensor([size[1] - 1, size[0] - 1], device=points_px.device) - margin_px
    return ((points_px >= margin_px) & (points_px <= high)).all(dim=-1)


class Chance:
    """Random numbers of one seed on one device."""

    def __init__(self, device: torch.device, *seed: int) -> None:
        self.generator = torch.Generator(device)
        mixed = 0
        for part in seed:
            mixed = (mixed * 1_000_003 + part) % 2**62
        self.generator.manual_seed(mixed)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Numbers between two."""
        device = self.generator.device
        return low + (high - low) * torch.rand(shape, generator=self.generator, device=device)

    def normal(self, deviation: float, *shape: int) -> Tensor:
        """Numbers about nought."""
        device = self.generator.device
        return deviation * torch.randn(shape, generator=self.generator, device=device)

    def whole(self, high: int, *shape: int) -> Tensor:
        """Whole numbers below `high`."""
        device = self.generator.device
        return torch.randint(high, shape, generator=self.generator, device=device)

    def happens(self, share: float, *shape: int) -> Tensor:
        """True as often as `share`."""
        return self.uniform(0, 1, *shape) < share


def of_planes(
    picture: Size, view: Size, centre_px: Tensor, scale: Tensor, roll_deg: Tensor,
    tilt_deg: Tensor, axis_deg: Tensor, shear: Tensor,
) -> Tensor:  # fmt: skip
    """From views' pixels to those of pictures that hang before cameras as planes: (V, 3, 3).

    A view's middle sees `centre_px` (V, 2), `scale` (V,) pixels of the picture a pixel of the view
    there; the plane is tilted about an axis in it, and the camera rolled.
    """
    rows, columns = view
    count, focal = len(scale), _FOCAL * columns
    one, nought = torch.ones_like(scale), torch.zeros_like(scale)

    def stacked(*values: Tensor) -> Tensor:
        return torch.stack(values, dim=1).view(count, 3, 3)

    to_rays = stacked(
        one / focal, nought, -one * (columns - 1) / 2 / focal,
        nought, one / focal, -one * (rows - 1) / 2 / focal, nought, nought, one,
    )  # fmt: skip
    rolling = stacked(one, shear, -shear * (rows - 1) / 2, nought, one, nought, nought, nought, one)
    a, t, r = (torch.deg2rad(angle) for angle in (axis_deg, tilt_deg, roll_deg))
    x, y, c, s = a.cos(), a.sin(), t.cos(), t.sin()
    tilt = stacked(  # Rodrigues' formula about (x, y, 0)
        c + x * x * (1 - c), x * y * (1 - c), y * s,
        x * y * (1 - c), c + y * y * (1 - c), -x * s, -y * s, x * s, c,
    )  # fmt: skip
    turned = stacked(r.cos(), -r.sin(), nought, r.sin(), r.cos(), nought, nought, nought, one)
    R = tilt @ turned
    # The camera is so far from the plane along its own axis, which meets it at the centre: a ray d
    # from the eye meets z = 0 at eye + t R d with t = -eye_z / (R d)_z.
    eye = -(focal * scale)[:, None] * R[:, :, 2]
    to_plane = torch.stack(
        [eye[:, :1] * R[:, 2] - eye[:, 2:] * R[:, 0], eye[:, 1:2] * R[:, 2] - eye[:, 2:] * R[:, 1],
         R[:, 2]], dim=1,
    )  # fmt: skip
    shift = stacked(one, nought, centre_px[:, 0], nought, one, centre_px[:, 1], nought, nought, one)
    made = shift @ to_plane @ to_rays @ rolling
    return made / made[:, 2:, 2:]


def pairs_of_views(chance: Chance, pairs: int, picture: Size, view: Size, lens: bool) -> Views:
    """For each pair two views of one part of a picture."""
    count = 2 * pairs
    device = chance.generator.device
    kinds = torch.multinomial(
        torch.tensor(_SHARES, device=device), pairs, True, generator=chance.generator
    )
    strength = torch.tensor(_STRENGTHS, device=device)[kinds].repeat_interleave(2)
    sides = torch.tensor(picture[::-1], device=device, dtype=torch.float32)
    centre = (chance.uniform(0.25, 0.75, pairs, 2) * sides).repeat_interleave(2, 0)
    low, high = (float(torch.tensor(limit).log()) for limit in _SCALE)
    common = chance.uniform(low, high, pairs).repeat_interleave(2)
    scale = (common + chance.normal(0.28, count) * strength).clamp(low, high).exp()
    roll = chance.uniform(-_ROLL_DEG, _ROLL_DEG, count) * strength
    any_roll = chance.uniform(0, 1, count) < _ANY_ROLL * strength
    roll = torch.where(any_roll, chance.uniform(-180, 180, count), roll)
    reach = torch.tensor(view[::-1], device=device) * (scale * strength)[:, None]
    lenses = chance.uniform(0.1, _LENS, pairs) * ~chance.happens(_STRAIGHT, pairs)
    to_picture = of_planes(
        picture, view, centre + chance.uniform(-0.18, 0.18, count, 2) * reach, scale, roll,
        _TILT_DEG * strength * chance.uniform(0, 1, count) ** 1.5,
        chance.uniform(0, 360, count), chance.normal(_SHEAR, count),
    )  # fmt: skip
    # One camera takes both.
    of_lens = lenses.repeat_interleave(2) if lens else torch.zeros(count, device=device)
    return Views(to_picture, torch.linalg.inv(to_picture), of_lens, view)
