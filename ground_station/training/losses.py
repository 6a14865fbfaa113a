"""What the two heads are to learn.

Detector: cross-entropy with the teacher's soft cells (DeTone et al., "SuperPoint", CVPR-W 2018,
eq. 2, with distributions for labels). Descriptors: in both directions, of all points in the other
view the right one (InfoNCE: van den Oord et al. 2018; both ways as the dual softmax of LoFTR, Sun
et al., CVPR 2021), points of another picture beside them; and the likeness among a view's points as
the teacher sees it (relational distillation: Park et al., CVPR 2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from ground_station.training.export import NMS_PX, SUBPIXEL_PX
from ground_station.training.topology import CELL_PX

# Cross-entropy tells the detector which pixel a point is nearest to, and no more. Here its peaks
# are taken and refined as extraction does, and what is left between a view's refined point and the
# other view's, carried over by the pair's truth, is a loss: the reprojection loss of Zhao et al.,
# "ALIKE", IEEE T-MM 2022, section III-D, on a cell detector's chances.

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


_FAR = -1e4
"""The logit of what is no choice."""


@dataclass(frozen=True)
class LossSettings:
    """Weights and temperatures."""

    descriptor: float = 1.0
    distillation: float = 0.5
    place: float = 1.0
    """A pixel."""
    temperature: float = 0.06
    teacher_temperature: float = 0.10
    apart_px: float = 8.0
    """A point nearer than this to the right one is no wrong one."""
    described_px: float = 16.0
    """Likeness is distilled between points farther apart than this: nearer ones share pixels."""


@dataclass(frozen=True)
class Losses:
    """Means over the batch; `total` is what is minimised, `right` the share of nearest points."""

    total: Tensor
    detector: Tensor
    descriptor: Tensor
    distillation: Tensor
    place: Tensor
    right: Tensor


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


def descriptor_loss(
    first: Tensor, second: Tensor, points_px: Tensor, used: Tensor, settings: LossSettings
) -> tuple[Tensor, Tensor]:
    """InfoNCE both ways and the share of points that find theirs.

    `first`, `second` (B, P, D) unit; `points_px` (B, 2, P, 2); `used` (B, P).
    """
    count = first.shape[1]
    eye = torch.eye(count, dtype=torch.bool, device=first.device)
    losses, rights = [], []
    for one, other, view in ((first, second, 1), (second, first, 0)):
        at = points_px[:, view]
        near = torch.cdist(at, at) < settings.apart_px
        barred = (near | ~used[:, None, :]) & ~eye
        inner = (one @ other.transpose(1, 2) / settings.temperature).masked_fill(barred, _FAR)
        logits = inner
        if len(first) > 1:  # points of the next picture in the batch
            strangers = one @ other.roll(1, 0).transpose(1, 2) / settings.temperature
            logits = torch.cat(
                [inner, strangers.masked_fill(~used.roll(1, 0)[:, None, :], _FAR)], dim=2
            )
        target = torch.arange(count, device=first.device).expand(len(first), count)
        per_point = functional.cross_entropy(
            logits.flatten(0, 1), target.flatten(), reduction="none"
        )
        weight = used.flatten().float()
        losses.append((per_point * weight).sum() / weight.sum().clamp(min=1))
        rights.append(((inner.argmax(dim=2) == target) & used).sum() / used.sum().clamp(min=1))
    return torch.stack(losses).mean(), torch.stack(rights).float().mean()


def distillation_loss(
    first: Tensor, second: Tensor, teacher: Tensor, points_px: Tensor, used: Tensor,
    settings: LossSettings,
) -> Tensor:  # fmt: skip
    """KL divergence of the likeness of one view's points to the other's from the teacher's.

    `teacher` (B, P, T) unit, nought where it said nothing.
    """
    spoken = used & (teacher.abs().sum(dim=2) > 0)
    likeness = teacher @ teacher.transpose(1, 2) / settings.teacher_temperature
    ours = first @ second.transpose(1, 2) / settings.temperature
    apart = torch.cdist(points_px[:, 0], points_px[:, 0]) > settings.described_px
    barred = ~(apart & spoken[:, None, :])
    wanted = functional.log_softmax(likeness.masked_fill(barred, _FAR), dim=2)
    said = functional.log_softmax(ours.masked_fill(barred, _FAR), dim=2)
    per_point = (wanted.exp() * (wanted - said)).masked_fill(barred, 0).sum(dim=2)
    weight = (spoken & (~barred).any(dim=2)).float()
    return (per_point * weight).sum() / weight.sum().clamp(min=1)


def losses(
    logits: Tensor, descriptors: Tensor, labels: Tensor, known: Tensor, points_px: Tensor,
    used: Tensor, teacher: Tensor, second_from_first: Tensor, placed: bool, settings: LossSettings,
) -> Losses:  # fmt: skip
    """Of a batch of B pairs. Views are in rows 2b and 2b + 1 of `logits` and `descriptors`.

    `labels` (2B, 65, h, w), `known` (2B, h, w), `points_px` (B, 2, P, 2), `used` (B, P), `teacher`
    (B, P, T), `second_from_first` (B, 3, 3); `placed`: whether key points' places count by now.
    """
    detector = detector_loss(logits, labels, known)
    at = sampled(descriptors, points_px.flatten(0, 1)).unflatten(0, (-1, 2))
    first, second = at[:, 0], at[:, 1]
    descriptor, right = descriptor_loss(first, second, points_px, used, settings)
    distilled = distillation_loss(first, second, teacher, points_px, used, settings)
    total = detector + settings.descriptor * descriptor + settings.distillation * distilled
    place = torch.zeros((), device=logits.device)
    if placed:
        place = place_loss(logits, known, second_from_first)
        total = total + settings.place * place
    return Losses(total, detector, descriptor, distilled, place, right)
