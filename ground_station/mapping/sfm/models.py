"""Parts of a model: without some of its observations, points or images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ground_station.arrays import Bools
from ground_station.map.model import Model


def without_observations(model: Model, bad: Bools) -> Model:
    """The model without some observations (O,)."""
    keep = ~bad
    rows = {name: getattr(model, name)[keep] for name in ("image", "feature", "point", "pixel_px")}
    return replace(model, **rows)


def without_points(model: Model, bad: Bools) -> Model:
    """The model without some points (M,) and their observations."""
    model, kept = without_observations(model, bad[model.point]), ~bad
    new = np.cumsum(kept) - 1
    return replace(
        model,
        point_id=model.point_id[kept],
        position=model.position[kept],
        point=new[model.point],
    )


def among(model: Model, kept: Bools) -> Model:
    """The model with some images (K,) only, and the points that two of them see."""
    model = without_images(model, ~kept)
    return without_points(model, np.bincount(model.point, minlength=len(model.position)) < 2)


def without_images(model: Model, bad: Bools) -> Model:
    """The model without some images (K,) and their observations."""
    model, kept = without_observations(model, bad[model.image]), ~bad
    new = np.cumsum(kept) - 1
    return replace(
        model,
        names=[name for name, gone in zip(model.names, bad.tolist(), strict=True) if not gone],
        image_id=model.image_id[kept],
        wTc=model.wTc[kept],
        image=new[model.image],
    )
