"""What the two heads are to learn.

Detector: cross-entropy with the teacher's soft cells (DeTone et al., "SuperPoint", CVPR-W 2018,
eq. 2, with distributions for labels); its peaks, refined as extraction does, are to be found again
exactly where the other view has them (the reprojection loss of Zhao et al., "ALIKE", IEEE T-MM
2022, section III-D) and to be worth it: a score that is high where the other view has no peak, or
where descriptors take another point for it, costs (their reliability loss, section III-D, on a cell
detector's chances). Descriptors: in both directions, of all points in the other view the right one
(InfoNCE: van den Oord et al. 2018; both ways as the dual softmax of LoFTR, Sun et al., CVPR 2021),
points of another picture beside them; at the pairs' points, and at the peaks as they are found.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from ground_station.training.export import NMS_PX, SUBPIXEL_PX
from ground_station.training.pairs import Batch
from ground_station.training.peaks import highest, refined
from ground_station.training.topology import CELL_PX
from ground_station.training.views import Views, inside

_MOST = 256
"""Peaks of a view that are compared, the strongest."""
_LEAST_SCORE = 0.01
_NEAR_PX = 3.0
"""Two peaks farther apart are two points."""
_FAR = -1e4
"""The logit of what is no choice."""


@dataclass(frozen=True)
class LossSettings:
    """Weights and temperatures."""

    descriptor: float = 1.0
    found: float = 1.0
    """Of the descriptors at peaks."""
    place: float = 2.0
    """A pixel."""
    reliability: float = 1.0
    temperature: float = 0.06
    apart_px: float = 8.0
    """A point nearer than this to the right one is no wrong one."""


@dataclass(frozen=True)
class Losses:
    """Means over the batch; `total` is what is minimised, `right` the share of nearest points."""

    total: Tensor
    detector: Tensor
    descriptor: Tensor
    found: Tensor
    place: Tensor
    reliability: Tensor
    right: Tensor


def scores_of(logits: Tensor) -> Tensor:
    """Chances (N, 8h, 8w) of the pixels from logits (N, 65, h, w), as extraction takes them."""
    chances = functional.softmax(logits.float(), dim=1)[:, :-1]
    return functional.pixel_shuffle(chances, CELL_PX)[:, 0]


def detector_loss(logits: Tensor, labels: Tensor, known: Tensor) -> Tensor:
    """Cross-entropy (N, 65, h, w) with soft labels, mean over the known cells (N, h, w), nats."""
    per_cell = -(labels * functional.log_softmax(logits.float(), dim=1)).sum(dim=1)
    return (per_cell * known).sum() / known.sum().clamp(min=1)


def sampled(descriptors: Tensor, points_px: Tensor) -> Tensor:
    """Unit descriptors (N, P, D) at points (N, P, 2), x then y, px, as an extractor samples them:
    cell k's centre is at 8k + 3.5, cubic between the centres."""
    h, w = descriptors.shape[2:]
    size = torch.tensor([w, h], dtype=torch.float32, device=points_px.device) * CELL_PX
    grid = (points_px + 0.5) / size * 2 - 1
    taken = functional.grid_sample(
        descriptors.float(), grid[:, None], mode="bicubic", padding_mode="border",
        align_corners=False,
    )  # fmt: skip
    return functional.normalize(taken[:, :, 0].transpose(1, 2), dim=2)


def likeness(
    one: Tensor, other: Tensor, wanted_px: Tensor, at_px: Tensor, there: Tensor, target: Tensor,
    settings: LossSettings,
) -> Tensor:  # fmt: skip
    """Log chances (B, P, 2Q) that points are the other view's, the next picture's behind them.

    `one` (B, P, D), `other` (B, Q, D) unit; `wanted_px` (B, P, 2): where points of `one` are in
    the other view; `at_px` (B, Q, 2), `there` (B, Q): its points and which are any; `target` (B, P)
    is the right one: others so near it that they show the same are no choice.
    """
    near = torch.cdist(wanted_px, at_px) < settings.apart_px
    barred = (near | ~there[:, None, :]).scatter(2, target[:, :, None], False)
    logits = (one @ other.transpose(1, 2) / settings.temperature).masked_fill(barred, _FAR)
    if len(one) > 1:
        strangers = one @ other.roll(1, 0).transpose(1, 2) / settings.temperature
        strangers = strangers.masked_fill(~there.roll(1, 0)[:, None, :], _FAR)
        logits = torch.cat([logits, strangers], dim=2)
    return functional.log_softmax(logits, dim=2)


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp(min=1e-6)


def descriptor_loss(
    descriptors: Tensor, batch: Batch, settings: LossSettings
) -> tuple[Tensor, Tensor]:
    """InfoNCE both ways at the pairs' points, and the share of them that find theirs."""
    vectors = sampled(descriptors, batch.points_px)
    count = vectors.shape[1]
    target = torch.arange(count, device=vectors.device).expand(len(batch.used), count)
    losses, rights = [], []
    for start in (0, 1):
        at = batch.points_px[1 - start :: 2]
        chances = likeness(
            vectors[start::2], vectors[1 - start :: 2], at, at, batch.used, target, settings
        )
        right = chances[:, :, :count].argmax(dim=2) == target
        losses.append(-_mean(chances.gather(2, target[:, :, None])[:, :, 0], batch.used.float()))
        rights.append(_mean(right.float(), batch.used.float()))
    return torch.stack(losses).mean(), torch.stack(rights).mean()


def peak_losses(
    logits: Tensor, descriptors: Tensor, known: Tensor, views: Views, settings: LossSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """Of the peaks: InfoNCE of the descriptors, the mean distance, px, of those that are each
    other's nearest, and the chance, weighted by score, that a peak is of no use.

    Logits (2B, 65, h, w) and `known` (2B, h, w); nought where no point is near another.
    """
    scores = scores_of(logits)
    area = known.repeat_interleave(CELL_PX, 1).repeat_interleave(CELL_PX, 2)
    pixels, values = highest(scores, NMS_PX, SUBPIXEL_PX, _LEAST_SCORE, _MOST, area)
    places = refined(scores, pixels, SUBPIXEL_PX)
    # The whole window's chance: where between the pixels a point is must not cost its score.
    mass = functional.avg_pool2d(scores[:, None], 2 * SUBPIXEL_PX + 1, 1, SUBPIXEL_PX)[:, 0]
    mass = mass * (2 * SUBPIXEL_PX + 1) ** 2
    flat = pixels[:, :, 1] * scores.shape[2] + pixels[:, :, 0]
    strength = mass.flatten(1).gather(1, flat).clamp(max=1)
    vectors = sampled(descriptors, places.detach())
    found, apart, useless = [], [], []
    for start in (0, 1):
        good, there = values[start::2] > 0, values[1 - start :: 2] > 0
        carried = views.across(places[start::2], start)
        other = places[1 - start :: 2]
        in_view = good & inside(carried.detach(), views.size, 2 * NMS_PX)
        # Only where the other view knows something can it have a peak.
        at = carried.detach().round().long().clamp(min=0)
        x, y = at[:, :, 0].clamp(max=views.size[1] - 1), at[:, :, 1].clamp(max=views.size[0] - 1)
        in_view &= area[1 - start :: 2].flatten(1).gather(1, y * views.size[1] + x)
        with torch.no_grad():
            gaps = torch.cdist(carried, other)
            gaps = gaps.masked_fill(~in_view[:, :, None] | ~there[:, None, :], torch.inf)
            nearest, back = gaps.argmin(dim=2), gaps.argmin(dim=1)
            mutual = back.gather(1, nearest) == torch.arange(gaps.shape[1], device=gaps.device)
            pair = (mutual & (gaps.amin(dim=2) < _NEAR_PX)).float()
        to = other.gather(1, nearest[:, :, None].expand(-1, -1, 2))
        # Rounded at nought, where a distance has no direction.
        apart.append(_mean(((carried - to).square().sum(dim=2) + 1e-4).sqrt(), pair))
        chances = likeness(
            vectors[start::2], vectors[1 - start :: 2], carried.detach(), other.detach(), there,
            nearest, settings,
        ).gather(2, nearest[:, :, None])[:, :, 0]  # fmt: skip
        found.append(-_mean(chances, pair))
        use = (chances.exp() * pair).detach()
        useless.append(_mean((1 - use) * in_view, strength[start::2] * in_view))
    return torch.stack(found).mean(), torch.stack(apart).mean(), torch.stack(useless).mean()


def losses(
    logits: Tensor, descriptors: Tensor, batch: Batch, placed: bool, settings: LossSettings
) -> Losses:
    """Of a batch; `placed`: whether the detector's own peaks count by now."""
    detector = detector_loss(logits, batch.labels, batch.known)
    descriptor, right = descriptor_loss(descriptors, batch, settings)
    total = detector + settings.descriptor * descriptor
    found = place = reliability = torch.zeros((), device=logits.device)
    if placed:
        found, place, reliability = peak_losses(
            logits, descriptors, batch.known, batch.views, settings
        )
        total = (
            total + settings.found * found + settings.place * place
            + settings.reliability * reliability
        )  # fmt: skip
    return Losses(total, detector, descriptor, found, place, reliability, right)
