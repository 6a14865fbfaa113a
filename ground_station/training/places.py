"""Where between the pixels a key point is: two views must agree on it.

Cross-entropy tells the detector which pixel a point is nearest to, and no more. Here its peaks are
taken and refined as extraction does, and what is left between a view's refined point and the other
view's, carried over by the pair's truth, is a loss: the reprojection loss of Zhao et al., "ALIKE",
IEEE T-MM 2022, section III-D, on a cell detector's chances.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from ground_station.training.export import NMS_PX, SUBPIXEL_PX
from ground_station.training.topology import CELL_PX

_MOST = 160
"""Peaks of a view that are compared, the strongest."""
_LEAST_SCORE = 0.01
_NEAR_PX = 3.0
"""Two peaks farther apart are two points."""


def scores_of(logits: Tensor) -> Tensor:
    """Chances (N, 8h, 8w) of the pixels from logits (N, 65, h, w), as extraction takes them."""
    chances = functional.softmax(logits.float(), dim=1)[:, :-1]
    return functional.pixel_shuffle(chances, CELL_PX)[:, 0]


def peaks(scores: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """The strongest peaks (N, P, 2), x then y, px, and which of them are any (N, P).

    Peaks are the highest of their window in known cells (N, h, w), so far from the edge that the
    window for their place is whole. Carries no gradient.
    """
    scores = scores.detach()
    highest = scores[:, None]
    for axis in ((1, 0), (0, 1)):  # one after the other: a third of the square's time
        size = [2 * NMS_PX * k + 1 for k in axis]
        padding = [NMS_PX * k for k in axis]
        highest = functional.max_pool2d(highest, size, stride=1, padding=padding)
    highest = highest[:, 0]
    area = known.repeat_interleave(CELL_PX, 1).repeat_interleave(CELL_PX, 2) > 0
    inside = torch.zeros_like(area)
    edge = SUBPIXEL_PX
    inside[:, edge:-edge, edge:-edge] = True
    found = torch.where((scores == highest) & area & inside & (scores > _LEAST_SCORE), scores, 0)
    values, flat = found.flatten(1).topk(min(_MOST, found[0].numel()), dim=1)
    columns = scores.shape[2]
    return torch.stack([flat % columns, flat // columns], dim=2), values > 0


def refined(scores: Tensor, pixels: Tensor) -> Tensor:
    """Places (N, P, 2), px, of peaks at `pixels`: each the mean of its window's scores.

    What `detection.refined` does without a temperature, with a gradient.
    """
    count, _, columns = scores.shape
    step = torch.arange(-SUBPIXEL_PX, SUBPIXEL_PX + 1, device=scores.device)
    dy, dx = (axis.flatten() for axis in torch.meshgrid(step, step, indexing="ij"))
    x, y = pixels[:, :, :1].clamp(min=0) + dx, pixels[:, :, 1:].clamp(min=0) + dy
    at = (y * columns + x).clamp(0, scores[0].numel() - 1)
    weight = scores.flatten(1).gather(1, at.flatten(1)).view(count, -1, len(step) ** 2)
    weight = weight / weight.sum(dim=2, keepdim=True).clamp(min=1e-12)
    moved = torch.stack([(weight * dx).sum(dim=2), (weight * dy).sum(dim=2)], dim=2)
    return pixels + moved


def place_loss(logits: Tensor, known: Tensor, second_from_first: Tensor) -> Tensor:
    """The mean distance, px, of key points that are each other's nearest, in the second view.

    Views are in rows 2b and 2b + 1 of `logits` (2B, 65, h, w) and `known` (2B, h, w);
    `second_from_first` (B, 3, 3). Nought where no point is near another.
    """
    scores = scores_of(logits)
    pixels, good = peaks(scores, known)
    places = refined(scores, pixels).unflatten(0, (-1, 2))
    good = good.unflatten(0, (-1, 2))
    first, second = places[:, 0], places[:, 1]
    ones = torch.ones_like(first[:, :, :1])
    carried = torch.cat([first, ones], dim=2) @ second_from_first.transpose(1, 2)
    ahead = carried[:, :, 2] > 1e-6
    carried = carried[:, :, :2] / carried[:, :, 2:].clamp(min=1e-6)
    with torch.no_grad():
        gaps = torch.cdist(carried, second)
        barred = ~(good[:, 0] & ahead)[:, :, None] | ~good[:, 1][:, None, :]
        gaps = gaps.masked_fill(barred, torch.inf)
        nearest, back = gaps.argmin(dim=2), gaps.argmin(dim=1)
        mutual = back.gather(1, nearest) == torch.arange(first.shape[1], device=first.device)
        counts = (mutual & (gaps.amin(dim=2) < _NEAR_PX)).float()
    other = second.gather(1, nearest[:, :, None].expand(-1, -1, 2))
    # Rounded at nought, where a distance has no direction.
    distance = ((carried - other).square().sum(dim=2) + 1e-4).sqrt()
    return (distance * counts).sum() / counts.sum().clamp(min=1)
