"""From a map of scores to key points: threshold, non-maximum suppression, border, the strongest."""

from __future__ import annotations

import cv2
import numpy as np

from ground_station.arrays import F32, Bools, Indices

_FEW = 2000
"""Points that are sooner gone through one by one than by another pass over the picture."""
_PASSES = 8


def cell_scores(logits: F32) -> F32:
    """The detector head's logits (65, h, w) as scores (8h, 8w): a softmax over each cell.

    DeTone et al., "SuperPoint", CVPR-W 2018, section 3.2: channel 64 is "none" and is left out.
    Cells whose logits are not finite score 0.
    """
    cells = logits.reshape(65, -1)
    with np.errstate(invalid="ignore", over="ignore"):
        scores = cells - cells.max(axis=0)
        np.exp(scores, out=scores)
        total = scores.sum(axis=0)
        scores *= 1 / total
    bad = ~np.isfinite(total)
    if bad.any():
        scores[:, bad] = 0
    h, w = logits.shape[1:]
    return np.ascontiguousarray(
        scores[:64].reshape(8, 8, h, w).transpose(2, 0, 3, 1).reshape(8 * h, 8 * w)
    )


def strongest(
    scores: F32, *, radius_px: int, threshold: float, border_px: int, most: int
) -> tuple[Indices, Indices]:
    """Rows (N,) and columns (N,) of the key points of scores (H, W), strongest first.

    Greedy non-maximum suppression, as SuperPoint's: of the points above `threshold`, the strongest
    is taken and all within `radius_px` of it, along rows and columns, are dropped, and so on; then
    those nearer than `border_px` to the picture's edge go. Of neighbours with the same score either
    may be taken, always the same one. Scores must be finite.

    A point that is the only highest of its window is taken in any order, so most are found by
    one maximum filter; only what these do not cover is gone through point by point.
    """
    shape = scores.shape
    flat = np.ascontiguousarray(scores).ravel()
    above = cv2.threshold(flat.reshape(shape), threshold, 0, cv2.THRESH_TOZERO)[1]
    left = np.asarray(above, np.float32)
    window = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
    taken: list[Indices] = []
    inside = np.empty(0, np.float32)  # scores of those taken that lie off the border
    for _ in range(_PASSES):
        peaks = (left == cv2.dilate(left, window)) & (left > 0)
        marks = peaks.view(np.uint8)
        neighbours = cv2.boxFilter(
            marks, cv2.CV_16U, window.shape, normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        alone = np.flatnonzero(peaks & (neighbours == 1))
        if not len(alone):
            break
        taken.append(alone)
        only = np.zeros(shape, np.uint8)
        only.ravel()[alone] = 1
        left[cv2.dilate(only, window) != 0] = 0
        inside = np.concatenate([inside, flat[alone[_off_border(alone, shape, border_px)]]])
        if len(inside) >= most:
            # What is weaker than enough others cannot come back.
            last = np.partition(inside, len(inside) - most)[len(inside) - most]
            left[left < last] = 0
        if np.count_nonzero(left > 0) <= _FEW:
            break
    found = np.concatenate([*taken, _one_by_one(left, radius_px, border_px, most)])
    found = found[_off_border(found, shape, border_px)]
    # By score, then in reading order, so that the same picture gives the same list.
    order = np.lexsort((found, -flat[found]))[:most]
    rows, columns = np.divmod(found[order], shape[1])
    return rows, columns


def _one_by_one(scores: F32, radius_px: int, border_px: int, most: int) -> Indices:
    """Greedy suppression of the points above 0; stops after `most` that lie off the border."""
    flat = scores.ravel()
    places = np.flatnonzero(flat > 0)
    places = places[np.argsort(-flat[places], kind="stable")]
    free = np.ones(scores.shape, bool)
    found: list[int] = []
    count = 0
    for block in np.array_split(places, max(1, len(places) // 1000)):
        rows, columns = np.divmod(block, scores.shape[1])
        off = _off_border(block, scores.shape, border_px)
        for place, row, column, counts in zip(
            block.tolist(), rows.tolist(), columns.tolist(), off.tolist(), strict=True
        ):
            if not free[row, column]:
                continue
            free[
                max(0, row - radius_px) : row + radius_px + 1,
                max(0, column - radius_px) : column + radius_px + 1,
            ] = False
            found.append(place)
            count += counts
            if count >= most:
                return np.array(found, np.intp)
    return np.array(found, np.intp)


def _off_border(places: Indices, shape: tuple[int, ...], border_px: int) -> Bools:
    rows, columns = np.divmod(places, shape[1])
    return np.asarray(
        (rows >= border_px)
        & (rows < shape[0] - border_px)
        & (columns >= border_px)
        & (columns < shape[1] - border_px)
    )


def refined(
    scores: F32,
    rows: Indices,
    columns: Indices,
    *,
    radius_px: int,
    temperature: float | None = None,
) -> F32:
    """Key points (N, 2), x then y, px, each moved to the mean of its window's scores.

    With a temperature T the weights are exp((s - s_max) / T): the soft-argmax of Zhao et al.,
    "ALIKE", IEEE T-MM 2022, section III-B. Without, they are the scores themselves: the cells'
    scores are chances, and the mean is where the point is to be expected. Windows end at the
    picture's edge; with radius 0 nothing moves. Scores must be finite and, without T, not negative.
    """
    points = np.stack([columns, rows], axis=1).astype(np.float32)
    if radius_px == 0 or not len(points):
        return points
    step = np.arange(-radius_px, radius_px + 1)
    dy, dx = (axis.ravel() for axis in np.meshgrid(step, step, indexing="ij"))
    y, x = rows[:, None] + dy, columns[:, None] + dx
    inside = (y >= 0) & (y < scores.shape[0]) & (x >= 0) & (x < scores.shape[1])
    patch = scores[y.clip(0, scores.shape[0] - 1), x.clip(0, scores.shape[1] - 1)]
    if temperature is None:
        weight = patch * inside
    else:
        weight = np.exp((patch - patch.max(axis=1, keepdims=True)) / temperature) * inside
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), np.float32(1e-12))
    return points + np.stack([weight @ dx, weight @ dy], axis=1).astype(np.float32)
