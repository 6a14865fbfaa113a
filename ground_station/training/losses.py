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

from ground_station.training.places import place_loss
from ground_station.training.topology import CELL_PX

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
