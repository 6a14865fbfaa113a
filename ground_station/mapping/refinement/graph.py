"""The graph of `blimp map refine`: a map's keyframes, flights' frames and what they all saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ground_station.arrays import F64, I64, Bools
from ground_station.map import colmap, landmarks
from ground_station.map.model import Model, model_of
from ground_station.map.store import Map
from ground_station.mapping.refinement import shutter
from ground_station.mapping.refinement.chosen import Chosen
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import adjustment, models

_ROUND_STEPS, _MOST_ROUNDS = 10, 10
"""Steps of the adjustment between two signs of life, and how often."""

_MAD_TO_SIGMA = 1.4826
"""The median of a normal distribution's absolute values, to its standard deviation."""

_LEAST_SIGMA_PX = 0.05
"""No group of observations is believed to be better than this."""


@dataclass(frozen=True)
class Graph:
    """What is adjusted: `model`, whose images are the keyframes and then the flights' frames.

    `group` (K,) of each image, 0 for the keyframes that the map was built of and 1, 2, … for the
    flights; `time_ns` (K,); `sigma_px` (groups,), the standard deviation that an observation counts
    with."""

    model: Model
    group: I64
    time_ns: I64
    sigma_px: F64

    def error_px(self) -> F64:
        """Reprojection errors of all observations (O,), picture pixels; inf behind the camera."""
        return np.asarray(np.linalg.norm(landmarks.residuals_px(self.model), axis=1))

    def group_of_observations(self) -> I64:
        """The group of each observation (O,)."""
        return np.asarray(self.group[self.model.image])


def build_graph(map_: Map, pixel_px: F64, group: I64, flights: Sequence[Chosen]) -> Graph:
    """The graph of a map and flights.

    The map's observations are at `pixel_px` (O, 2), undistorted, and its K keyframes belong to
    `group` (K,); every flight becomes a group of its own."""
    own, kf = model_of(map_), map_.keyframes
    starts = len(kf) + np.concatenate([[0], np.cumsum([len(f) for f in flights])]).astype(np.int64)
    names = [f"{f.name}/{time_ns}" for f in flights for time_ns in f.time_ns.tolist()]
    frames = [f.frame + start for f, start in zip(flights, starts, strict=False)]
    image = np.concatenate([own.image, *frames])
    model = replace(
        own,
        names=own.names + names,
        image_id=np.arange(len(own.names) + len(names)) + 1,
        wTc=np.concatenate([own.wTc, *(f.wTc for f in flights)]),
        image=image,
        feature=np.zeros(len(image), np.int64),
        point=np.concatenate([own.point, *(f.landmark for f in flights)]),
        pixel_px=np.concatenate([pixel_px, *(f.pixel_px for f in flights)]),
    )
    first = int(group.max(initial=0)) + 1
    groups = [group, *(np.full(len(f), first + k) for k, f in enumerate(flights))]
    times = [kf.time_ns, *(f.time_ns for f in flights)]
    return Graph(
        model, np.concatenate(groups), np.concatenate(times), np.ones(first + len(flights))
    )


def keyframe_pixels(map_: Map, gap_s: float) -> tuple[F64, int]:
    """A map's observations without the readout's shift (O, 2), and how many keyframes that
    concerns, as `shutter.shifts_px`.
    """
    own, kf = model_of(map_), map_.keyframes
    points, seen_px = own.position[own.point], kf.pixel_px.astype(np.float64)
    shift, count = shutter.shifts_px(
        kf.time_ns, kf.wTc, own.camera, gap_s, own.image, points, seen_px
    )
    return own.pixel_px - shift, count


def drop(graph: Graph, bad: Bools) -> Graph:
    """The graph without some observations (O,)."""
    return replace(graph, model=models.without_observations(graph.model, bad))


def drop_points(graph: Graph, bad: Bools) -> Graph:
    """The graph without some points (M,) and their observations."""
    return replace(graph, model=models.without_points(graph.model, bad))


def drop_images(graph: Graph, bad: Bools) -> Graph:
    """The graph without some images (K,) and their observations."""
    model = models.without_images(graph.model, bad)
    return replace(graph, group=graph.group[~bad], time_ns=graph.time_ns[~bad], model=model)


def spread_px(graph: Graph) -> F64:
    """A robust standard deviation of a pixel coordinate in each group (groups,).

    By the median absolute deviation; NaN for a group without observations.
    """
    size, group = np.abs(landmarks.residuals_px(graph.model)), graph.group_of_observations()
    found = [size[group == g] for g in range(len(graph.sigma_px))]
    median = [np.median(values) if len(values) else np.nan for values in found]
    return np.maximum(_MAD_TO_SIGMA * np.array(median), _LEAST_SIGMA_PX)


def solve(graph: Graph, settings: MappingSettings, on_round: Callable[[], None]) -> Graph:
    """The graph with all poses and points at the optimum, in free gauge.

    A Cauchy loss, whose scale is in pixels of the first group; the other groups' weigh by their
    standard deviations. `on_round` is called every few steps, between which Ctrl-C can stop it.
    """
    weight = graph.sigma_px[0] / graph.sigma_px[graph.group]
    reconstruction = colmap.from_arrays(graph.model, graph.model.camera, weight)
    for _ in range(_MOST_ROUNDS):
        done = adjustment.adjust(
            reconstruction,
            loss_px=settings.sfm.loss_px,
            threads=settings.threads,
            max_iterations=_ROUND_STEPS,
        )
        on_round()
        if done:
            break
    wTc, position = colmap.positions(reconstruction, graph.model)
    return replace(graph, model=replace(graph.model, wTc=wTc, position=position))
