"""Blobs of many views at once, as `features.blobs` finds them in one."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from ground_station.features.blobs import BORDER_PX, FLAT, LEAST, SIGMAS_PX, kernel


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
