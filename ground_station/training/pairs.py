"""Training pairs: two views of one place, each in its own light, and what is where in both.

A batch is a function of the places there are, seed and step alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from ground_station.training.degradation import degraded
from ground_station.training.topology import CELL_PX
from ground_station.training.views import Chance, Size, Views, inside, pairs_of_views

# SuperPoint (DeTone et al., CVPR-W 2018, section 3.4) labels one pixel of a cell; here a point's
# weight is shared among the four pixels around it, so that its fraction of a pixel can be learned.

_CHANCE_SCORES = (0.05, 0.35)
"""Average teacher scores at which a point counts nothing and wholly."""
_APART_PX = 3.0
"""In a view, a point nearer than this to a stronger one is none."""
_MARGIN_PX = 4.0
_JITTER_PX = 0.3


@dataclass(frozen=True)
class Places:
    """`pictures` (N, H, W) uint8; `lights` (P, 2): each place's two; `points_px` (P, K, 2),
    strongest first, and `scores` (P, K) of the teacher, 0 where there is no point."""

    pictures: Tensor
    lights: Tensor
    points_px: Tensor
    scores: Tensor


@dataclass(frozen=True)
class Batch:
    """As the losses take it, of B pairs: `images` (2B, 1, H, W), `labels` (2B, 65, H/8, W/8),
    `known` (2B, H/8, W/8) bool, cells that lie in the picture; `points_px` (2B, P, 2), a pair's the
    same P points in both, of which `used` (B, P) are any; `views`."""

    images: Tensor
    labels: Tensor
    known: Tensor
    points_px: Tensor
    used: Tensor
    views: Views


def soft_cells(points_px: Tensor, chances: Tensor, size: Size) -> Tensor:
    """Labels (V, 65, H/8, W/8) of points (V, K, 2), px, for views of `size` (H, W).

    Channel k < 64 is pixel (k // 8, k % 8) of the cell, 64 is "none"; each cell sums to 1. Weight
    that falls on pixels beyond the edge is lost.
    """
    rows, columns = size
    mass = torch.zeros(len(points_px), rows * columns, device=points_px.device)
    base = points_px.floor()
    part = points_px - base
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = base[:, :, 0] + dx, base[:, :, 1] + dy
            good = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            share = (part[:, :, 0] if dx else 1 - part[:, :, 0]) * (
                part[:, :, 1] if dy else 1 - part[:, :, 1]
            )
            at = torch.where(good, y * columns + x, 0).long()
            mass.scatter_add_(1, at, torch.where(good, share * chances, 0))
    cells = functional.pixel_unshuffle(mass.view(-1, 1, rows, columns), CELL_PX)
    total = cells.sum(dim=1, keepdim=True)
    return torch.cat([cells / total.clamp(min=1), (1 - total).clamp(min=0)], dim=1)


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

    Half of the points are the teacher's where it has so many, the others anywhere: descriptors are
    for everywhere. Without `lens` the two views of a pair differ by a homography.
    """
    picture = (places.pictures.shape[1], places.pictures.shape[2])
    chosen = chance.whole(len(places.lights), pairs)
    views = pairs_of_views(chance, pairs, picture, size, lens)
    lit = places.lights[chosen].gather(1, chance.whole(2, pairs, 2)).flatten()
    images = degraded(views.taken(places.pictures[lit].float() / 255), chance)

    of_place = places.points_px[chosen]
    at = views.of_picture(of_place.repeat_interleave(2, 0))
    low, high = _CHANCE_SCORES
    chances = ((places.scores[chosen] - low) / (high - low)).clamp(0, 1).repeat_interleave(2, 0)
    seen = inside(at, size, -0.5) & (chances > 0)
    near = torch.cdist(at, at) < _APART_PX
    covered = (near.tril(-1) & seen[:, None, :]).any(dim=2)
    labels = soft_cells(at, chances * (seen & ~covered), size)

    both = (inside(at, size, _MARGIN_PX) & (chances > 0)).unflatten(0, (-1, 2)).all(dim=1)
    first = at[::2] + chance.normal(_JITTER_PX, *at[::2].shape)
    sides = torch.tensor(size[::-1], device=at.device)
    anywhere = _MARGIN_PX + chance.uniform(0, 1, pairs, 2 * points, 2) * (
        sides - 1 - 2 * _MARGIN_PX
    )
    wanted = torch.where(both, chance.uniform(0, 1, *both.shape), -1)
    picked = wanted.topk(points // 2, dim=1)
    first = torch.cat(
        [first.gather(1, picked.indices[:, :, None].expand(-1, -1, 2)), anywhere], dim=1
    )
    second = views.across(first, 0)
    good = inside(second, size, _MARGIN_PX) & inside(
        views.every_other(0).onto_picture(first), picture, _MARGIN_PX
    )
    good[:, : points // 2] &= picked.values >= 0
    order = (~good).to(torch.uint8).argsort(dim=1, stable=True)[:, :points]
    used = good.gather(1, order)
    index = order[:, :, None].expand(-1, -1, 2)
    both_px = torch.stack([first.gather(1, index), second.gather(1, index)], dim=1)
    points_px = torch.where(used[:, None, :, None], both_px, 0).flatten(0, 1)
    return Batch(images[:, None], labels, _known(views, picture), points_px, used, views)
