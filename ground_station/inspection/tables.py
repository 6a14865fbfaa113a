"""The tables of a map's page: names and values, in words and with units."""

from __future__ import annotations

from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.inspection.localizability import LocalizabilityMap
from ground_station.map.store import Map, MapInfo
from ground_station.presentation.text import flat

Rows = list[tuple[str, str]]

_STRUCTURE = {
    "track": ("observations of a landmark", ""),
    "angle_deg": ("largest angle between two of its observations", "°"),
    "landmark_sigma": ("standard deviation of a landmark, its poses taken as known", "length"),
    "error_px": ("reprojection error of an observation", " px"),
    "in_keyframe": ("landmarks that a keyframe saw", ""),
}
_QUANTILES = (5, 50, 95)


def length(value: float, registered: bool) -> str:
    """A length with three digits and its unit, or without one where it has none."""
    if not registered:
        return f"{value:.3g}"
    if abs(value) < 0.01:
        return f"{1e3 * value:.3g} mm"
    return f"{100 * value:.3g} cm" if abs(value) < 1 else f"{value:.3g} m"


def structure(figures: dict[str, F64], registered: bool) -> list[tuple[str, list[str]]]:
    """A row for each figure: 5th, 50th and 95th percentile."""
    rows = []
    for name, (words, unit) in _STRUCTURE.items():
        values = figures.get(name, np.empty(0))
        if not len(values):
            continue
        found = [float(np.percentile(values, q)) for q in _QUANTILES]
        rows.append(
            (
                words,
                [length(v, registered) if unit == "length" else f"{v:.3g}{unit}" for v in found],
            )
        )
    return rows


def about(document: dict[str, Any], map_: Map) -> Rows:
    """What the map is."""
    registered = map_.info.registered
    unit = " m" if registered else ""
    rows = [
        ("frame", f"{document['frame']}, units: {document['units']}"),
        ("landmarks", f"{document['landmarks']}"),
        ("keyframes", f"{document['images']} of {document['images_given']} images given"),
        ("models", _plain(document["model_sizes"])),
        ("features", f"{document['features']} ({document['features_sha256'][:12]})"),
        ("camera", document["camera"]),
    ]
    if "extent" in document:
        sides = " × ".join(f"{side:g}" for side in document["extent"])
        area = f"{document['covered_area']:g}" + (" m²" if registered else "")
        rows.append(("extent of 98 % of the landmarks", sides + unit))
        rows.append(("area that they cover, from above", area))
        rows.append(("way of the keyframes", f"{document['keyframes_path']:g}{unit}"))
    if document["refined"]:
        rows.append(("flights that joined", ", ".join(document["refined"])))
    rows.append(("size on disk", f"{document['size_mb']:g} MB"))
    return rows


def registration(info: MapInfo) -> tuple[Rows, list[tuple[str, str, str]]]:
    """How it came to the world, and each known point with its residual and its held-out one."""
    table = info.registration
    if not table:
        return [], []
    rows = [
        _with_unit(name, value)
        for name, value in table.items()
        if not isinstance(value, list | dict)
    ]
    names = _list(table, "point_names")
    residual = _list(table, "point_residual_m")
    held_out = _list(table, "point_held_out_m")
    points = [
        (
            str(name),
            length(residual[k], True) if k < len(residual) else "–",
            length(held_out[k], True) if k < len(held_out) else "–",
        )
        for k, name in enumerate(names)
    ]
    return rows, points


def _with_unit(name: str, value: Any) -> tuple[str, str]:
    """A row whose name ends in its unit, as those of map.toml do, with the unit at the value."""
    if not isinstance(value, float):
        return name.replace("_", " "), _plain(value)
    for end, words in (("_m", None), ("_px", " px"), ("_percent", " %"), ("_deg", "°")):
        if name.endswith(end):
            shown = length(value, True) if words is None else _plain(value) + words
            return name.removesuffix(end).replace("_", " "), shown
    return name.replace("_", " "), _plain(value)


def _list(table: dict[str, Any], name: str) -> list[Any]:
    """A list of a file's table; anything else that stands there is none."""
    values = table.get(name, [])
    if not isinstance(values, list):
        return []
    if name == "point_names":
        return values
    return values if all(isinstance(value, int | float) for value in values) else []


def built(info: MapInfo) -> Rows:
    """Inputs, times and settings of the build, nested names joined by dots."""
    return [(name, _plain(value)) for name, value in flat(info.built).items()]


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(map(_plain, value)) or "none"
    return str(value)


def thinned(step: dict[str, int]) -> list[str]:
    """What is not all drawn, in words."""
    return [
        f"One in {count} {name} is drawn, evenly by their order in the map; figures are of all."
        for name, count in step.items()
        if count > 1
    ]


def lost(found: LocalizabilityMap, registered: bool) -> Rows:
    """The localizability map in figures."""
    s = found.summary()
    sigma = s["median_sigma_m"]
    elsewhere = "–" if sigma is None else length(sigma, registered)
    return [
        ("places", f"{s['places']}, every {length(s['cell_m'], registered)}"),
        ("headings at each", f"{s['headings']}, pitched {found.pitch_deg:.0f}°"),
        ("views in which it would be lost", f"{100 * s['share_lost']:.1f} %"),
        ("places lost in some heading", f"{100 * s['places_lost_in_some_heading']:.1f} %"),
        ("places lost in every heading", f"{100 * s['places_lost_in_every_heading']:.1f} %"),
        ("standard deviation elsewhere, median", elsewhere),
    ]
