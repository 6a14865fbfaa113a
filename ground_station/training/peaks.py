"""Key points of many score maps at once, as extraction takes them; their places have a gradient."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def highest(
    scores: Tensor, radius_px: int, border_px: int, least: float, most: int,
    where: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Pixels (N, most, 2), x then y, and scores (N, most) of the strongest peaks of (N, H, W).

    Peaks are the highest of their window, above `least`, off the border, and where `where` (N, H,
    W) says; a score is 0 where there are no more. Carries no gradient.
    """
    scores = scores.detach()
    top = scores[:, None]
    for axis in ((1, 0), (0, 1)):  # one after the other: a third of the square's time
        size = [2 * radius_px * k + 1 for k in axis]
        top = functional.max_pool2d(top, size, stride=1, padding=[radius_px * k for k in axis])
    peak = (scores == top[:, 0]) & (scores > least)
    inner = torch.zeros_like(peak)
    inner[:, border_px:-border_px, border_px:-border_px] = True
    peak &= inner if where is None else inner & where
    found = torch.where(peak, scores, 0)
    values, flat = found.flatten(1).topk(min(most, found[0].numel()), dim=1)
    columns = scores.shape[2]
    return torch.stack([flat % columns, flat // columns], dim=2), values


def refined(
    scores: Tensor, pixels: Tensor, radius_px: int, temperature: float | None = None
) -> Tensor:
    """Places (N, P, 2), px, of peaks at `pixels`, which must lie so far from the edge.

    What `features.detection.refined` does.
    """
    count, _, columns = scores.shape
    step = torch.arange(-radius_px, radius_px + 1, device=scores.device)
    dy, dx = (axis.flatten() for axis in torch.meshgrid(step, step, indexing="ij"))
    at = (pixels[:, :, 1:] + dy) * columns + pixels[:, :, :1] + dx
    at = at.clamp(0, scores[0].numel() - 1)
    weight = scores.flatten(1).gather(1, at.flatten(1)).view(count, -1, len(dx))
    if temperature is None:
        weight = weight / weight.sum(dim=2, keepdim=True).clamp(min=1e-12)
    else:
        weight = functional.softmax(weight / temperature, dim=2)
    moved = torch.stack([(weight * dx).sum(dim=2), (weight * dy).sum(dim=2)], dim=2)
    return pixels + moved
