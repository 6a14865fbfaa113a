"""What the network is to learn: descriptors that find each other, and which blobs are worth it.

Key points are the views' own blobs (`features.blobs`). Of those that both views have, each is to
find its partner, in both directions, among all blobs of the other view and of another picture
(InfoNCE: van den Oord et al. 2018; both ways as the dual softmax of LoFTR, Sun et al., CVPR 2021);
so are points anywhere. The score is the chance that a blob has a partner and that its descriptor
finds it (the reliability of Revaud et al., "R2D2", NeurIPS 2019, as odds).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from ground_station.features.blobs import (
    BORDER_PX,
    FLAT,
    LEAST,
    SIGMAS_PX,
    BlobFeatures,
    kernel,
)
from ground_station.training.pairs import Batch
from ground_station.training.topology import CELL_PX
from ground_station.training.views import inside

_MOST = 320
"""Blobs of a view that are compared."""
_NEAR_PX = 1.5
"""Two blobs farther apart are two points."""
_FAR = -1e4
"""The logit of what is no choice."""

Outputs = tuple[Tensor, Tensor, Tensor]
"""Of the network; see `topology.OUTPUTS`."""


@dataclass(frozen=True)
class LossSettings:
    """Weights and temperatures."""

    anywhere: float = 0.5
    """Of the descriptors at points that are no blobs."""
    worth: float = 0.5
    temperature: float = 0.06
    apart_px: float = 2.5
    """A blob nearer than this to the right one is no wrong one."""
    apart_anywhere_px: float = 6.0


@dataclass(frozen=True)
class Losses:
    """Means over the batch; `total` is what is minimised, `right` the share of blobs with a
    partner whose nearest descriptor is that."""

    total: Tensor
    blobs: Tensor
    anywhere: Tensor
    worth: Tensor
    right: Tensor


def responses(images: Tensor) -> Tensor:
    """What `features.blobs.responses` are of pictures (N, 1, H, W), 0..1: (N, L, H, W)."""
    made = []
    for level, sigma in enumerate(SIGMAS_PX):
        row = torch.from_numpy(kernel(level)).to(images.device)
        pad = len(row) // 2
        x = functional.pad(images, [pad] * 4, mode="reflect")
        images = functional.conv2d(
            functional.conv2d(x, row.view(1, 1, 1, -1)), row.view(1, 1, -1, 1)
        )
        x = functional.pad(images, [1] * 4, mode="reflect")
        xx = x[:, 0, 1:-1, 2:] + x[:, 0, 1:-1, :-2] - 2 * images[:, 0]
        yy = x[:, 0, 2:, 1:-1] + x[:, 0, :-2, 1:-1] - 2 * images[:, 0]
        xy = (x[:, 0, 2:, 2:] + x[:, 0, :-2, :-2] - x[:, 0, :-2, 2:] - x[:, 0, 2:, :-2]) / 4
        determinant = (xx * yy - xy * xy).clamp(min=0)
        made.append(2 * (sigma / SIGMAS_PX[0]) ** 2 * determinant / ((xx + yy).abs() + FLAT))
    return torch.stack(made, dim=1)


def strongest(
    values: Tensor, radius_px: int, most: int, where: Tensor, favour: Tensor
) -> tuple[Tensor, Tensor]:
    """Places (N, most, 2), x then y, px, and heights (N, most), 0 where there are no more.

    Of responses (N, L, H, W), where `where` (N, H, W) says so, those that are highest times
    `favour` (N, H, W).
    """
    peak = values == functional.max_pool2d(values, 2 * radius_px + 1, 1, radius_px)
    beside = functional.max_pool2d(values, 3, 1, 1)
    peak[:, 1:] &= values[:, 1:] > beside[:, :-1]
    peak[:, :-1] &= values[:, :-1] >= beside[:, 1:]
    inner = torch.zeros_like(where)
    inner[:, BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    peak &= (values > LEAST) & (inner & where)[:, None]
    found = torch.where(peak, values * favour[:, None], 0)
    ranks, flat = found.flatten(1).topk(min(most, found[0].numel()), dim=1)
    rows, columns = values.shape[2:]
    level, x, y = flat // (rows * columns), flat % columns, flat // columns % rows
    around = values.flatten(1)

    def at(dx: int, dy: int) -> Tensor:
        place = (y + dy).clamp(0, rows - 1) * columns + (x + dx).clamp(0, columns - 1)
        return around.gather(1, level * rows * columns + place)

    here = {(dx, dy): at(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)}
    c = here[0, 0]
    xx, yy = here[-1, 0] + here[1, 0] - 2 * c, here[0, -1] + here[0, 1] - 2 * c
    xy = (here[-1, -1] + here[1, 1] - here[1, -1] - here[-1, 1]) / 4
    gx, gy = (here[1, 0] - here[-1, 0]) / 2, (here[0, 1] - here[0, -1]) / 2
    bent = (xx * yy - xy * xy).clamp(min=1e-12)
    moved = torch.stack([xy * gy - yy * gx, xy * gx - xx * gy], dim=2) / bent[:, :, None]
    good = (ranks > 0) & (moved.abs() < 1).all(dim=2)
    for before in ((-1, -1), (0, -1), (1, -1), (-1, 0)):  # of equal neighbours the first
        good &= c > here[before]
    places = torch.stack([x, y], dim=2) + torch.where(good[:, :, None], moved, 0)
    return places, torch.where(good, c, 0)


def _at(field: Tensor, points_px: Tensor, cell_px: int, mode: str) -> Tensor:
    """A map (N, D, h, w) of cells at points (N, P, 2), x then y, px: (N, P, D)."""
    h, w = field.shape[2:]
    size = torch.tensor([w, h], dtype=torch.float32, device=points_px.device) * cell_px
    grid = (points_px + 0.5) / size * 2 - 1
    taken = functional.grid_sample(
        field.float(), grid[:, None], mode=mode, padding_mode="border", align_corners=False
    )
    return taken[:, :, 0].transpose(1, 2)


def sampled(outputs: Outputs, points_px: Tensor) -> Tensor:
    """Unit descriptors (N, P, D) at points (N, P, 2), px, as the extractor samples them."""
    descriptors, details, _ = outputs
    both = (_at(descriptors, points_px, CELL_PX, "bicubic"),
            _at(details, points_px, CELL_PX // 2, "bicubic"))  # fmt: skip
    return functional.normalize(torch.cat(both, dim=2), dim=2)


def likeness(
    one: Tensor, other: Tensor, wanted_px: Tensor, at_px: Tensor, there: Tensor, target: Tensor,
    apart_px: float, temperature: float,
) -> Tensor:  # fmt: skip
    """Log chances (B, P, 2Q) that points are the other view's, the next picture's behind them.

    `one` (B, P, D), `other` (B, Q, D) unit; `wanted_px` (B, P, 2): where points of `one` are in
    the other view; `at_px` (B, Q, 2), `there` (B, Q): its points and which are any; `target` (B, P)
    is the right one: others so near it that they show the same are no choice.
    """
    near = torch.cdist(wanted_px, at_px) < apart_px
    barred = (near | ~there[:, None, :]).scatter(2, target[:, :, None], False)
    logits = (one @ other.transpose(1, 2) / temperature).masked_fill(barred, _FAR)
    if len(one) > 1:
        strangers = one @ other.roll(1, 0).transpose(1, 2) / temperature
        strangers = strangers.masked_fill(~there.roll(1, 0)[:, None, :], _FAR)
        logits = torch.cat([logits, strangers], dim=2)
    return functional.log_softmax(logits, dim=2)


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp(min=1e-6)


def anywhere_loss(outputs: Outputs, batch: Batch, settings: LossSettings) -> Tensor:
    """InfoNCE both ways at the pairs' points."""
    vectors = sampled(outputs, batch.points_px)
    count = vectors.shape[1]
    target = torch.arange(count, device=vectors.device).expand(len(batch.used), count)
    made = []
    for start in (0, 1):
        at = batch.points_px[1 - start :: 2]
        chances = likeness(
            vectors[start::2], vectors[1 - start :: 2], at, at, batch.used, target,
            settings.apart_anywhere_px, settings.temperature,
        )  # fmt: skip
        made.append(-_mean(chances.gather(2, target[:, :, None])[:, :, 0], batch.used.float()))
    return torch.stack(made).mean()


def blob_losses(
    outputs: Outputs, batch: Batch, settings: LossSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """InfoNCE of the blobs' descriptors, cross-entropy of their scores, the share that is right.

    Nought where no view has what the other has.
    """
    views = batch.views
    area = batch.known.repeat_interleave(CELL_PX, 1).repeat_interleave(CELL_PX, 2)
    with torch.no_grad():
        places, heights = strongest(
            responses(batch.images), BlobFeatures.NMS_PX, _MOST, area, batch.favour
        )
    vectors = sampled(outputs, places)
    odds = _at(outputs[2], places, CELL_PX, "bilinear")[:, :, 0] + heights.clamp(min=1e-9).log()
    found, worth, rights = [], [], []
    for start in (0, 1):
        good, there = heights[start::2] > 0, heights[1 - start :: 2] > 0
        wanted, other = views.across(places[start::2], start), places[1 - start :: 2]
        in_view = good & inside(wanted, views.size, CELL_PX)
        # Only where the other view knows something can it have a blob.
        at = wanted.round().long().clamp(min=0)
        x, y = at[:, :, 0].clamp(max=views.size[1] - 1), at[:, :, 1].clamp(max=views.size[0] - 1)
        in_view &= area[1 - start :: 2].flatten(1).gather(1, y * views.size[1] + x)
        gaps = torch.cdist(wanted, other)
        gaps = gaps.masked_fill(~in_view[:, :, None] | ~there[:, None, :], torch.inf)
        nearest, back = gaps.argmin(dim=2), gaps.argmin(dim=1)
        mutual = back.gather(1, nearest) == torch.arange(gaps.shape[1], device=gaps.device)
        pair = mutual & (gaps.amin(dim=2) < _NEAR_PX)
        chances = likeness(
            vectors[start::2], vectors[1 - start :: 2], wanted, other, there, nearest,
            settings.apart_px, settings.temperature,
        )  # fmt: skip
        right = pair & (chances.argmax(dim=2) == nearest)
        chance = chances.gather(2, nearest[:, :, None])[:, :, 0]
        found.append(-_mean(chance, pair.float()))
        worth.append(_mean(
            functional.binary_cross_entropy_with_logits(
                odds[start::2], right.float(), reduction="none"
            ), in_view.float(),
        ))  # fmt: skip
        rights.append(_mean(right.float(), pair.float()))
    return torch.stack(found).mean(), torch.stack(worth).mean(), torch.stack(rights).mean()


def losses(outputs: Outputs, batch: Batch, settings: LossSettings) -> Losses:
    """Of a batch."""
    blobs, worth, right = blob_losses(outputs, batch, settings)
    anywhere = anywhere_loss(outputs, batch, settings)
    total = blobs + settings.anywhere * anywhere + settings.worth * worth
    return Losses(total, blobs, anywhere, worth, right)
