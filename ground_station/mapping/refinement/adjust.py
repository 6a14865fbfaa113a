"""The adjustment of `blimp map refine`: a graph's poses and landmarks together.

Bundle adjustment (Triggs et al. 1999) of the observations of a map's keyframes and of flights'
frames. What is decided here and not by the solver:

- Gauge. Pixels fix a model up to a similarity. The adjustment is free, as in the build, and its
  result is laid onto the landmarks as they were by the similarity that fits them best: the datum of
  a free network (Baarda 1973). So a registration stays where it was and bends nothing. Priors on
  the old poses would bend: they hold the old map's errors, from observations that are in the graph.
- Weights. What one flight saw of a landmark is not independent: the same light, the same
  side, points followed from the same keyframe. A flight's standard deviation, estimated from its
  residuals, grows by the root of the design effect 1 + (n - 1) · correlation (Kish 1965), where n
  is the mean number of its observations of a landmark.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ground_station.arrays import F64, I64, Bools
from ground_station.errors import GeometryError, MapError
from ground_station.geometry.alignment import Alignment, align
from ground_station.map import landmarks
from ground_station.map.store import Map
from ground_station.mapping.refinement import graph as graphs
from ground_station.mapping.refinement.graph import Graph
from ground_station.mapping.settings import MappingSettings

_DATUM_ROUNDS = 20
"""Of the datum's reweighting."""

_MOST_LOST = 0.5
"""A frame that loses a larger share of its observations to the gate was not where it said."""

_FLIGHT_GATE = 3.5
"""Deviations of a pixel above which a flight's observation goes: no geometry verified it."""

_LEAST_ANGLE_DEG = 0.05
"""Rays nearer to parallel than this give no depth, and no covariance that could be inverted."""


def adjust(
    graph: Graph,
    map_: Map,
    settings: MappingSettings,
    on_round: Callable[[], None],
) -> Graph:
    """The graph at its optimum, in the datum of the map, without what does not fit.

    Solved, gated and solved again with the deviations found: observations above `max_error_px` go,
    flights' frames that lose most of theirs, and landmarks that have too few left where they had
    enough. Raises `MapError` when nothing is left.
    """
    sfm = settings.sfm
    weak_before, observations_before = _weak(graph, settings), _observations(graph)

    def solve(graph: Graph) -> Graph:
        weighted = _weighted(graph, settings.refine.correlation)
        return graphs.solve(weighted, settings, on_round)

    graph = solve(_without_hopeless(graph))
    graph = graphs.drop(graph, graph.error_px() > _gate_px(graph, sfm.max_error_px))
    least = np.maximum((1 - _MOST_LOST) * observations_before, settings.refine.min_observations)
    graph = graphs.drop_images(graph, (graph.group > 0) & (_observations(graph) < least))
    graph = _without_hopeless(graph)
    graph = solve(graph)
    weak = _weak(graph, settings)
    weak_before = weak_before[np.isin(map_.landmarks.id, graph.model.point_id)]
    graph = _without_hopeless(graphs.drop_points(graph, weak & ~weak_before))
    return in_datum(graph, map_)


def _gate_px(graph: Graph, max_error_px: float) -> F64:
    """The largest error of each observation (O,): the build's or, of a flight, a few deviations."""
    gate = np.minimum(_FLIGHT_GATE * graphs.spread_px(graph), max_error_px)
    gate[0] = max_error_px
    return np.asarray(gate[graph.group_of_observations()])


def _observations(graph: Graph) -> I64:
    return np.bincount(graph.model.image, minlength=len(graph.group))


def _weighted(graph: Graph, correlation: float) -> Graph:
    """The graph with each group's deviation from its residuals, and from how often it looks."""
    sigma, group = graphs.spread_px(graph), graph.group_of_observations()
    for g in range(1, len(sigma)):
        points = graph.model.point[group == g]
        n = len(points) / max(len(np.unique(points)), 1)
        sigma[g] *= np.sqrt(1 + max(n - 1, 0) * correlation)
    return replace(graph, sigma_px=np.where(np.isfinite(sigma), sigma, 1.0))


def _weak(graph: Graph, settings: MappingSettings) -> Bools:
    """Points (M,) that the build would not have kept."""
    model, sfm = graph.model, settings.sfm
    few = np.bincount(model.point, minlength=len(model.position)) < sfm.min_track
    return np.asarray(few | (landmarks.largest_angles_deg(model) < sfm.min_tri_angle_deg))


def _without_hopeless(graph: Graph) -> Graph:
    """The graph without points that two observations do not fix, and observations from behind."""
    graph = graphs.drop(graph, ~np.isfinite(graph.error_px()))
    graph = graphs.drop_points(graph, landmarks.largest_angles_deg(graph.model) < _LEAST_ANGLE_DEG)
    if not len(graph.model.point_id):
        raise MapError("no landmark of the map keeps two observations that agree")
    return graph


def in_datum(graph: Graph, map_: Map) -> Graph:
    """The graph where its landmarks are nearest to the map's, by a similarity.

    Weighted by the landmarks' covariances; those that moved further than half of them do count for
    less (Huber), so that a few that were wrong do not pull the rest. Raises `MapError` when they
    are on one line.
    """
    model, old = graph.model, map_.landmarks
    kept = np.isin(old.id, model.point_id)
    variance = np.trace(old.covariance_m2[kept], axis1=1, axis2=2).astype(np.float64)
    floor = float(np.median(variance)) / 100
    weight = 1 / np.maximum(variance, max(floor, 1e-18))
    fit, robust = Alignment(np.eye(3), np.zeros(3), 1.0), np.ones(len(weight))
    try:
        for _ in range(_DATUM_ROUNDS):
            fit = align(model.position, old.position_m[kept], True, weight * robust)
            moved = np.linalg.norm(fit.apply(model.position) - old.position_m[kept], axis=1)
            moved *= np.sqrt(weight)
            robust = np.minimum(1, np.median(moved) / np.maximum(moved, 1e-12))
    except GeometryError as error:
        raise MapError(f"the landmarks give no datum: {error}") from None
    return replace(
        graph,
        model=replace(model, wTc=fit.apply_poses(model.wTc), position=fit.apply(model.position)),
    )
