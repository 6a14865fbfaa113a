"""Known distances between points that the map's images show: they give the scale and no more."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ground_station.arrays import F64
from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment
from ground_station.map.store import Map
from ground_station.map.uncertainty import Uncertainty
from ground_station.mapping.registration.adjustment import moved
from ground_station.mapping.registration.observations import (
    PointObservations,
    numbers,
    read_rows,
    sigma_px,
    triangulate_observations,
    word,
)
from ground_station.mapping.registration.registration import Registration

COLUMNS = ("distance", "end", "image", "u_px", "v_px", "length_m")
_SIGMA_M = 0.01
"""Of a length whose row does not say: two ends found with a tape."""
_MIN_LENGTH_M, _MAX_LENGTH_M = 0.01, 10_000.0
_GATE = 3.0
"""Standard deviations; a length this far from the median is another one's."""


@dataclass(frozen=True)
class Distances:
    """D distances: `names`, `length_m` (D,), `sigma_m` (D,), and the observations of their 2 D
    ends.

    Ends 2 d and 2 d + 1 of `ends` belong to distance d.
    """

    names: list[str]
    length_m: F64
    sigma_m: F64
    ends: PointObservations


@dataclass(frozen=True)
class MeasuredScale:
    """Metres per unit of a map, `sigma` as a share of it, from `count` distances."""

    scale: float
    sigma: float
    count: int
    notes: list[str]


def read_distances(path: str | Path) -> Distances:
    """Reads `distance,end,image,u_px,v_px,length_m[,sigma_m]`, a line for each observation of an
    end.

    `end` is `a` or `b`. Raises `MapError` naming the line.
    """
    lengths: dict[str, tuple[float, float]] = {}
    observations: dict[tuple[str, str, str], tuple[float, float]] = {}
    for where, row in read_rows(path, COLUMNS, "observation"):
        u, v, length = numbers(row, COLUMNS[3:], where)
        sigma = numbers(row, ["sigma_m"], where)[0] if row.get("sigma_m") else _SIGMA_M
        name, end, image = (word(row, key, where) for key in COLUMNS[:3])
        if end not in ("a", "b"):
            raise MapError(f"{where}: end is '{end:.20}'; allowed: a, b")
        if not _MIN_LENGTH_M <= length <= _MAX_LENGTH_M:
            raise MapError(
                f"{where}: length_m is {length:g}; allowed: {_MIN_LENGTH_M} to {_MAX_LENGTH_M:g}"
            )
        if not 1e-6 <= sigma < length:
            raise MapError(f"{where}: sigma_m is {sigma:g}; allowed: 1e-06 to below the length")
        if lengths.setdefault(name, (length, sigma)) != (length, sigma):
            raise MapError(f"{where}: the distance '{name}' was {lengths[name][0]:g} m before")
        if (name, end, image) in observations:
            raise MapError(f"{where}: end {end} of '{name}' was seen in '{image}' before")
        observations[name, end, image] = u, v
    if not lengths:
        raise MapError(f"{path}: it holds no distances")
    place = {name: 2 * d for d, name in enumerate(lengths)}
    length_m, sigma_m = np.array(list(lengths.values())).T
    ends = PointObservations(
        points=[f"{name} {end}" for name, end in itertools.product(lengths, "ab")],
        world_m=np.zeros((2 * len(lengths), 3)),
        point=np.array([place[name] + (end == "b") for name, end, _ in observations], np.int64),
        image=[image for _, _, image in observations],
        pixel_px=np.array(list(observations.values())),
    )
    return Distances(list(lengths), length_m, sigma_m, ends)


def measure_scale(map_: Map, distances: Distances) -> MeasuredScale:
    """Metres per unit of the map, from the distances between ends triangulated with its poses.

    The weighted mean of the logarithms of the ratios, those far from their weighted median left out
    where there are three or more. Where they scatter more than they should, the deviation grows by
    Birge's ratio (R. T. Birge, Physical Review 40, 1932). Raises `MapError` where none is left.
    """
    kf = map_.keyframes
    found, notes = triangulate_observations(distances.ends, kf.names, kf.wTc, map_.info.camera)
    place = {point.name: point for point in found}
    sigma = sigma_px(found) if found else 1.0
    used, ratio, deviation = [], [], []
    for d, name in enumerate(distances.names):
        a, b = (place.get(end) for end in distances.ends.points[2 * d : 2 * d + 2])
        if a is None or b is None:
            continue  # the triangulation's note says why
        between = b.position - a.position
        length = float(np.linalg.norm(between))
        if length == 0.0:
            notes.append(f"distance '{name}' left out: its ends are one place of the map")
            continue
        across = between / length
        own = sigma**2 * float(across @ (a.covariance + b.covariance) @ across)
        used.append(name)
        ratio.append(float(np.log(distances.length_m[d] / length)))
        stated = distances.sigma_m[d] / distances.length_m[d]
        deviation.append(float(np.sqrt(stated**2 + own / length**2)))
    if not used:
        raise MapError(
            "registration: none of the distances can be measured in the map"
            + (f" ({notes[0]})" if notes else "")
        )
    values, sigmas = np.array(ratio), np.array(deviation)
    good = np.ones(len(values), dtype=bool)
    if len(values) >= 3:
        middle = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - middle)))
        good = np.abs(values - middle) <= _GATE * np.maximum(spread, sigmas)
        for name, value in zip(np.array(used)[~good], values[~good], strict=True):
            off = 100 * (np.exp(value - middle) - 1)
            notes.append(f"distance '{name}' left out: {off:+.1f} % off what the others say")
    values, weights = values[good], sigmas[good] ** -2.0
    mean = float(weights @ values / weights.sum())
    squares = float(weights @ (values - mean) ** 2)
    birge = max(1.0, float(np.sqrt(squares / max(len(values) - 1, 1))))
    if birge > _GATE:
        notes.append(f"the distances contradict each other: {birge:.0f} times what they should")
    return MeasuredScale(
        float(np.exp(mean)), birge / float(np.sqrt(weights.sum())), len(values), notes
    )


def by_distances(map_: Map, distances: Distances) -> Registration:
    """A map in metres whose origin and axes stay the model's own: `frame` stays `sfm`.

    Raises `MapError` for a map that is registered already: its place would be lost.
    """
    if map_.info.registered:
        raise MapError(
            "registration: the map is in the world already, and distances alone know nothing of "
            "its place there; give them together with --pairs, --tags, --picks or --trajectory"
        )
    found = measure_scale(map_, distances)
    covariance = np.zeros((7, 7))
    covariance[6, 6] = found.sigma**2
    notes = [
        *found.notes,
        "distances give the scale only: the map is in metres, its origin and axes are arbitrary",
    ]
    fit = Alignment(np.eye(3), np.zeros(3), found.scale)
    report = {"method": "distances", **_report(found), "scale": found.scale}
    known = Uncertainty(covariance, np.zeros(3), max(found.count - 1, 1))
    return Registration(fit, report, known, notes, frame="sfm")


def with_distances(found: Registration, map_: Map, distances: Distances) -> Registration:
    """A registration with the distances as further measurements of its scale.

    A Kalman update with one number: what the registration knows of its other parameters together
    with the scale follows.
    """
    measured = measure_scale(map_, distances)
    known = found.uncertainty
    C, centre = known.covariance, known.centre
    off = float(np.log(measured.scale / found.fit.scale))
    expected = float(np.sqrt(C[6, 6] + measured.sigma**2))
    notes = [*found.notes, *measured.notes]
    if abs(off) > _GATE * expected:
        notes.append(
            f"the distances say a scale {100 * off:+.2f} % off the one without them, "
            f"{abs(off) / expected:.0f} times what both should differ"
        )
    gain = C[:, 6] / (C[6, 6] + measured.sigma**2)
    fit = moved(found.fit, centre, gain * off)
    updated = Uncertainty(C - np.outer(gain, C[6]), centre, known.freedom)
    report = found.report | {
        **_report(measured),
        "scale": fit.scale,
        "rotation": fit.rotation.tolist(),
        "translation_m": fit.translation.tolist(),
    }
    return replace(found, fit=fit, report=report, uncertainty=updated, notes=notes)


def _report(found: MeasuredScale) -> dict[str, object]:
    return {
        "distances": found.count,
        "distances_scale": found.scale,
        "distances_sigma_percent": 100 * found.sigma,
    }
