"""Training pairs: two views of one place, each in its own light, and what is where in both.

A batch is a function of the places there are, seed and step alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ground_station.training.degradation import degraded
from ground_station.training.topology import CELL_PX
from ground_station.training.views import Chance, Size, Views, inside, pairs_of_views

_MARGIN_PX = 4.0
_FAVOUR = 1.0
"""Deviation of the logarithm by which fainter blobs come before others now and then."""


@dataclass(frozen=True)
class Places:
    """`pictures` (N, H, W) uint8; `lights` (P, 2): each place's two."""

    pictures: Tensor
    lights: Tensor


@dataclass(frozen=True)
class Batch:
    """As the losses take it, of B pairs: `images` (2B, 1, H, W); `known` (2B, H/8, W/8) bool, cells
    that lie in the picture; `points_px` (2B, P, 2), a pair's the same P points in both, of which
    `used` (B, P) are any; `favour` (2B, H, W), by which blobs are preferred; `views`."""

    images: Tensor
    known: Tensor
    points_px: Tensor
    used: Tensor
    favour: Tensor
    views: Views


def _known(views: Views, picture: Size) -> Tensor:
    """Cells (V, h, w) whose four corners lie well inside the picture."""
    rows, columns = views.size
    device = views.lens.device
    y, x = (torch.arange(0, n + 1, CELL_PX, device=device) - 0.5 for n in (rows, columns))
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=2)
    corners = views.onto_picture(grid.view(1, -1, 2).expand(len(views.lens), -1, -1))
    good = inside(corners, picture, _MARGIN_PX).unflatten(1, grid.shape[:2])
    return good[:, :-1, :-1] & good[:, 1:, :-1] & good[:, :-1, 1:] & good[:, 1:, 1:]


def make(
    places: Places, chance: Chance, pairs: int, size: Size, points: int, lens: bool = True
) -> Batch:
    """Pairs of views of (rows, columns), multiples of 16, with `points` pairs of points at most.

    The points are anywhere: descriptors are for everywhere. Without `lens` the two views of a pair
    differ by a homography.
    """
    picture = (places.pictures.shape[1], places.pictures.shape[2])
    chosen = chance.whole(len(places.lights), pairs)
    views = pairs_of_views(chance, pairs, picture, size, lens)
    lit = places.lights[chosen].gather(1, chance.whole(2, pairs, 2)).flatten()
    images = degraded(views.taken(places.pictures[lit].float() / 255), chance)

    sides = torch.tensor(size[::-1], device=images.device)
    first = _MARGIN_PX + chance.uniform(0, 1, pairs, 2 * points, 2) * (sides - 1 - 2 * _MARGIN_PX)
    second = views.across(first, 0)
    good = inside(second, size, _MARGIN_PX) & inside(
        views.every_other(0).onto_picture(first), picture, _MARGIN_PX
    )
    order = (~good).to(torch.uint8).argsort(dim=1, stable=True)[:, :points]
    used = good.gather(1, order)
    index = order[:, :, None].expand(-1, -1, 2)
    both_px = torch.stack([first.gather(1, index), second.gather(1, index)], dim=1)
    points_px = torch.where(used[:, None, :, None], both_px, 0).flatten(0, 1)
    favour = chance.normal(_FAVOUR, *images.shape).exp()
    return Batch(images[:, None], _known(views, picture), points_px, used, favour, views)
