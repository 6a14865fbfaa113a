"""Blobs of many views at once, as `features.blobs` finds them in one."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from ground_station.features.blobs import BORDER_PX, FLAT, KERNEL_PX, LEAST, SIGMA_PX


def response(images: Tensor) -> Tensor:
    """What `features.blobs.response` is of pictures (N, 1, H, W), 0..1: (N, H, W)."""
    step = torch.arange(KERNEL_PX, device=images.device) - KERNEL_PX // 2
    row = (-(step**2) / (2 * SIGMA_PX**2)).exp()
    row = row / row.sum()
    pad = KERNEL_PX // 2
    x = functional.pad(images, [pad] * 4, mode="reflect")
    x = functional.conv2d(functional.conv2d(x, row.view(1, 1, 1, -1)), row.view(1, 1, -1, 1))
    x = functional.pad(x, [1] * 4, mode="reflect")
    middle = x[:, 0, 1:-1, 1:-1]
    xx = x[:, 0, 1:-1, 2:] + x[:, 0, 1:-1, :-2] - 2 * middle
    yy = x[:, 0, 2:, 1:-1] + x[:, 0, :-2, 1:-1] - 2 * middle
    xy = (x[:, 0, 2:, 2:] + x[:, 0, :-2, :-2] - x[:, 0, :-2, 2:] - x[:, 0, 2:, :-2]) / 4
    return 2 * (xx * yy - xy * xy).clamp(min=0) / ((xx + yy).abs() + FLAT)


def strongest(
    values: Tensor, radius_px: int, most: int, where: Tensor, favour: Tensor
) -> tuple[Tensor, Tensor]:
    """Places (N, most, 2), x then y, px, and heights (N, most), 0 where there are no more.

    Of responses (N, H, W), where `where` says so, those that are highest times `favour` (N, H, W).
    """
    size, pad = 2 * radius_px + 1, radius_px
    top = functional.max_pool2d(values[:, None], size, 1, pad)[:, 0]
    peak = (values == top) & (values > LEAST) & where
    inner = torch.zeros_like(peak)
    inner[:, BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    found = torch.where(peak & inner, values * favour, 0)
    ranks, flat = found.flatten(1).topk(min(most, found[0].numel()), dim=1)
    columns = values.shape[2]
    x, y = flat % columns, flat // columns
    around = values.flatten(1)

    def at(dx: int, dy: int) -> Tensor:
        place = (y + dy).clamp(0, values.shape[1] - 1) * columns + (x + dx).clamp(0, columns - 1)
        return around.gather(1, place)

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
