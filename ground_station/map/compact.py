"""The tables of a compressed map: `store`'s numbers in less than half of the bytes.

Floating point is kept in half precision, a two-thousandth of each number, where that is far below
what the number is known to: spreads, cones, distances, and the roots of covariances, which stay
covariances however they are rounded. Positions are offsets from their middle, pixels whole steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Arrays = dict[str, npt.NDArray[Any]]
Layout = dict[str, tuple[str, tuple[int, ...]]]
"""Of each array the types it may have, between bars, and its shape after the first axis."""

LANDMARKS: Layout = {
    "id": ("uint32|int64", ()),
    "position_offset_m": ("float32", (3,)),
    "covariance_root": ("float16", (6,)),
    "spread": ("float16", ()),
    "view_direction": ("float16", (3,)),
    "view_cos": ("float16", ()),
    "distance_m": ("float16", (2,)),
    "observations": ("uint16", ()),
}
"""A row a landmark; `covariance_root` is the lower Cholesky factor's six numbers, row by row."""
LANDMARK_UNITS: Layout = {
    "position_origin_m": ("float64", (3,)),
    "covariance_unit_m": ("float64", ()),
}
"""One row: where offsets count from, and what the roots count in."""
KEYFRAMES: Layout = {
    "time_ns": ("int64", ()),
    "wTc": ("float64", (4, 4)),
    "offset": ("int64", ()),
    "landmark": ("uint16|uint32", ()),
    "pixel_steps": ("uint16", (2,)),
}
KEYFRAME_UNITS: Layout = {
    "pixel_origin_px": ("float64", (2,)),
    "pixel_step_px": ("float64", ()),
}

_STEP_PX = 1 / 64
"""Of a pixel, which rounds by 0.005 px in the mean; coarser where an image is wider than 1,023."""
_LOWER = np.tril_indices(3)
_LARGEST = float(np.finfo(np.float16).max)
_FLATTEST = 1e-7
"""Of a covariance's largest deviation: a smaller one is not told from none."""


def pack_landmarks(plain: Arrays) -> Arrays:
    """The arrays of `LANDMARKS` and `LANDMARK_UNITS` from `store`'s of M landmarks."""
    position = plain["position_m"]
    origin = np.zeros(3)
    if len(position):
        origin = 0.5 * (position.min(axis=0) + position.max(axis=0))
    root = _roots(plain["covariance_m2"])
    sizes = np.abs(root[:, [0, 2, 5]])
    unit = float(np.median(sizes[sizes > 0])) if (sizes > 0).any() else 1.0
    return {
        "id": _narrow(plain["id"], np.uint32, np.int64),
        "position_offset_m": (position - origin).astype(np.float32),
        "covariance_root": _half(root / unit),
        "spread": _half(plain["spread"]),
        "view_direction": _half(plain["view_direction"]),
        "view_cos": _half(plain["view_cos"]),
        "distance_m": _half(plain["distance_m"]),
        "observations": np.clip(plain["observations"], 0, 65535).astype(np.uint16),
        "position_origin_m": origin[None],
        "covariance_unit_m": np.array([unit]),
    }


def unpack_landmarks(packed: Arrays) -> Arrays:
    """`store`'s arrays again; raises `ValueError` where numbers go beyond what is finite."""
    origin = _row(packed, "position_origin_m")
    unit = _row(packed, "covariance_unit_m")
    root = np.zeros((len(packed["covariance_root"]), 3, 3))
    with np.errstate(over="ignore", invalid="ignore"):
        root[:, *_LOWER] = packed["covariance_root"].astype(np.float64) * unit
        covariance = (root @ np.swapaxes(root, 1, 2)).astype(np.float32)
        position = packed["position_offset_m"].astype(np.float64) + origin
    if not (np.isfinite(covariance).all() and np.isfinite(position).all()):
        raise ValueError("its units make numbers that are not finite")
    return {
        "id": packed["id"].astype(np.int64),
        "position_m": position,
        "covariance_m2": covariance,
        "spread": packed["spread"].astype(np.float32),
        "view_direction": packed["view_direction"].astype(np.float32),
        "view_cos": packed["view_cos"].astype(np.float32),
        "distance_m": packed["distance_m"].astype(np.float32),
        "observations": packed["observations"].astype(np.int32),
    }


def pack_keyframes(plain: Arrays) -> Arrays:
    """The arrays of `KEYFRAMES` and `KEYFRAME_UNITS` from `store`'s."""
    pixel = plain["pixel_px"].astype(np.float64)
    origin, step = np.zeros(2), _STEP_PX
    if len(pixel):
        origin = np.floor(pixel.min(axis=0))
        while (pixel - origin).max() / step > 65535:
            step *= 2
    return {
        "time_ns": plain["time_ns"],
        "wTc": plain["wTc"],
        "offset": plain["offset"],
        "landmark": _narrow(plain["landmark"], np.uint16, np.uint32),
        "pixel_steps": np.round((pixel - origin) / step).astype(np.uint16),
        "pixel_origin_px": origin[None],
        "pixel_step_px": np.array([step]),
    }


def unpack_keyframes(packed: Arrays) -> Arrays:
    """`store`'s arrays again; raises `ValueError` where numbers go beyond what is finite."""
    origin, step = _row(packed, "pixel_origin_px"), _row(packed, "pixel_step_px")
    with np.errstate(over="ignore", invalid="ignore"):
        pixel = (origin + packed["pixel_steps"] * step).astype(np.float32)
    if not np.isfinite(pixel).all():
        raise ValueError("its units make numbers that are not finite")
    return {
        "time_ns": packed["time_ns"],
        "wTc": packed["wTc"],
        "offset": packed["offset"],
        "landmark": packed["landmark"].astype(np.int32),
        "pixel_px": pixel,
    }


def _row(packed: Arrays, name: str) -> npt.NDArray[np.float64]:
    if len(packed[name]) != 1:
        raise ValueError(f"'{name}' has {len(packed[name])} rows, not 1")
    return np.asarray(packed[name][0], np.float64)


def _roots(covariance: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Cholesky factors' lower triangles (M, 6), of what is no covariance those of the nearest.

    From the eigenvalues' roots by QR: unlike the factorisation it bears what is singular.
    """
    symmetric = covariance.astype(np.float64)
    symmetric = 0.5 * (symmetric + np.swapaxes(symmetric, 1, 2))
    values, vectors = np.linalg.eigh(symmetric)
    deviation = np.sqrt(np.maximum(values, 0.0))
    deviation = np.maximum(deviation, _FLATTEST * deviation.max(axis=1, initial=0, keepdims=True))
    _, upper = np.linalg.qr(deviation[:, :, None] * np.swapaxes(vectors, 1, 2))
    lower = np.swapaxes(upper, 1, 2)
    return np.asarray(lower[:, *_LOWER], np.float64)


def _half(values: npt.NDArray[Any]) -> npt.NDArray[np.float16]:
    return np.clip(values, -_LARGEST, _LARGEST).astype(np.float16)


def _narrow(values: npt.NDArray[Any], narrow: type, wide: type) -> npt.NDArray[Any]:
    """Whole numbers in the narrow type where all fit."""
    limits = np.iinfo(narrow)
    fits = not len(values) or (values.min() >= limits.min and values.max() <= limits.max)
    return np.asarray(values, narrow if fits else wide)
