"""One HTML file that shows a map: what it holds, how good it is, where one gets lost in it."""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from ground_station import presentation
from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.inspection import tables
from ground_station.inspection.localizability import LocalizabilityMap
from ground_station.inspection.prediction import NEEDED
from ground_station.map.floorplan import FloorPlan
from ground_station.map.store import Map
from ground_station.map.summary import describe, figures, sigma
from ground_station.presentation.pages import data_uri, write_page

# The views share their modules with the dashboard: the same orbit, gestures and shaders.

_OWN = Path(__file__).parent / "web"
_SHARED = Path(presentation.__file__).parent / "web" / "js"
_IMPORT = re.compile(r'^import \{([^}]*)\} from "\./(\w+)\.js";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:class|const|function) (\w+))", re.MULTILINE)


def bundle(entry: str) -> str:
    """The module `entry` after all that it imports, each in a scope of its own.

    Understood is what these modules use: named imports on one line and named exports.
    """
    done: list[str] = []
    parts = ['"use strict";']

    def add(name: str) -> None:
        if name in done:
            return
        path = next(p for p in (_OWN / f"{name}.js", _SHARED / f"{name}.js") if p.is_file())
        text = path.read_text(encoding="utf-8")
        for _, needed in _IMPORT.findall(text):
            add(needed)
        done.append(name)
        exported = ", ".join(_EXPORT.findall(text))
        text = _EXPORT.sub("", _IMPORT.sub(r"const {\1} = module_\2;", text))
        parts.append(f"const module_{name} = (() => {{\n{text}\nreturn {{ {exported} }};\n}})();")

    add(entry)
    return "\n".join(parts)


def policy(script: str) -> str:
    """The Content-Security-Policy source that allows this one script."""
    digest = hashlib.sha256(script.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


MOST_POINTS, MOST_CAMERAS = 150_000, 4_000
"""Of more, one in so many is drawn: a browser's graphics memory, and the file's size."""

_TEMPLATE = Path(__file__).parent / "web" / "map.html"
_COLOURS = 64
_LONGEST_PX = 2000
"""A larger floor plan's picture is made smaller."""
_EASY = (3.0, 250.0)
"""A map whose longer side is not of so many units is drawn in others."""
_DRAWN = 24.0


@dataclass(frozen=True)
class Array:
    """An array as the page holds it: base64 of little-endian numbers."""

    name: str
    kind: str
    text: Markup

    @classmethod
    def of(cls, name: str, values: npt.ArrayLike) -> Array:
        """As int32 where the values are whole numbers, else as float32."""
        array = np.asarray(values)
        kind = "int32" if array.dtype.kind in "iu" else "float32"
        data = np.ascontiguousarray(array, "<i4" if kind == "int32" else "<f4").tobytes()
        return cls(name, kind, Markup(base64.b64encode(data).decode("ascii")))


def write(path: str | Path, map_: Map, plan: FloorPlan | None, found: LocalizabilityMap) -> None:
    """Writes the page of a map whose z is up; raises `GroundStationError` when the disk refuses."""
    document = describe(map_)
    step = {
        "landmarks": _step(len(map_.landmarks), MOST_POINTS),
        "keyframes": _step(len(map_.keyframes), MOST_CAMERAS),
    }
    bounds = _bounds(map_, plan)
    scale = _scale(*bounds)
    script = bundle("main")
    write_page(
        path,
        _TEMPLATE,
        title=f"Map {map_.info.name}",
        map=document,
        info=map_.info,
        script=Markup(script),
        policy=policy(script),
        figures=_figures(map_, plan, found, bounds, scale),
        arrays=_arrays(map_, found, step, scale),
        plan_picture=_picture(plan) if plan is not None else None,
        headings=[round(value) for value in found.heading_deg.tolist()],
        thinned=tables.thinned(step),
        found=found,
        lost=tables.lost(found, map_.info.registered),
        structure=tables.structure(figures(map_), map_.info.registered),
        about=tables.about(document, map_),
        registration=tables.registration(map_.info),
        built=tables.built(map_.info),
    )


def _step(count: int, most: int) -> int:
    return max(1, -(-count // most))


def _scale(low: F64, high: F64) -> float:
    """What lengths are multiplied by in the page: 1 unless the map is tiny or huge in its units."""
    side = float((high - low).max())
    return 1.0 if _EASY[0] <= side <= _EASY[1] else _DRAWN / max(side, 1e-12)


def _bounds(map_: Map, plan: FloorPlan | None) -> tuple[F64, F64]:
    """The box that is shown: all keyframes and 98 % of the landmarks, or those within the plan.

    What is seen through a window may lie far outside of the building.
    """
    position, flown = map_.landmarks.position_m, map_.keyframes.wTc[:, :3, 3]
    low, high = np.percentile(position, (1, 99), axis=0)
    if plan is not None:
        corners = np.array(_placed(plan, 1.0)["corners"])[:, :2]
        low[:2] = np.maximum(low[:2], corners.min(axis=0))
        high[:2] = np.minimum(high[:2], corners.max(axis=0))
    return np.minimum(low, flown.min(axis=0)), np.maximum(high, flown.max(axis=0))


def _figures(
    map_: Map,
    plan: FloorPlan | None,
    found: LocalizabilityMap,
    bounds: tuple[F64, F64],
    scale: float,
) -> dict[str, Any]:
    low, high = (scale * bound for bound in bounds)
    grid = scale * np.array(found.origin)
    cells = scale * found.cell_m * found.cell
    area = np.array([low[:2], high[:2]])
    if len(cells):
        area[0] = np.minimum(area[0], grid + cells.min(axis=0))
        area[1] = np.maximum(area[1], grid + cells.max(axis=0) + scale * found.cell_m)
    return {
        "units": map_.info.units,
        "scale": scale,
        "bounds": {"min": low.tolist(), "max": high.tolist()},
        "area": {"min": area[0].tolist(), "max": area[1].tolist()},
        "camera": map_.info.camera.as_page(),
        "plan": _placed(plan, scale) if plan is not None else None,
        "grid": {
            "origin": grid.tolist(),
            "cell": scale * found.cell_m,
            "heading_deg": found.heading_deg.tolist(),
            "needed": NEEDED,
        },
        # Cividis was made to look the same with every kind of colour vision (Nuñez et al. 2018).
        "ramp": _ramp("cividis", 0.0, 1.0),
        "vivid": _ramp("viridis", 0.25, 1.0),
    }


def _ramp(name: str, low: float, high: float) -> list[list[float]]:
    colours = matplotlib.colormaps[name](np.linspace(low, high, _COLOURS))
    return [[round(float(value), 4) for value in colour[:3]] for colour in colours]


def _placed(plan: FloorPlan, scale: float) -> dict[str, Any]:
    """Where the plan's picture lies; its corners from the lower left one, against the clock."""
    width, height = (scale * side for side in plan.size_m)
    x, y, yaw = plan.origin
    c, s = np.cos(yaw), np.sin(yaw)
    corners = [
        [scale * x + c * a - s * b, scale * y + s * a + c * b, 0.0]
        for a, b in ((0, 0), (width, 0), (width, height), (0, height))
    ]
    return {"origin": [scale * x, scale * y, yaw], "width": width, "corners": corners}


def _picture(plan: FloorPlan) -> str:
    image: npt.NDArray[Any] = plan.image
    shrink = min(1.0, _LONGEST_PX / max(image.shape))
    if shrink < 1:
        image = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return data_uri("png", cv2.imencode(".png", image)[1].tobytes())


def _arrays(map_: Map, found: LocalizabilityMap, step: dict[str, int], scale: float) -> list[Array]:
    lm = map_.landmarks
    wTc = map_.keyframes.wTc[:: step["keyframes"]]
    some = slice(None, None, step["landmarks"])
    p = found.prediction
    arrays: dict[str, npt.ArrayLike] = {
        "point": scale * lm.position_m[some],
        "point-observations": lm.observations[some].astype(np.float32),
        "point-sigma": scale * sigma(map_)[some],
        "camera-place": scale * wTc[:, :3, 3],
        "camera-turn": poses.to_quaternion(wTc),
        "camera-heading": np.arctan2(wTc[:, 1, 2], wTc[:, 0, 2]),
        "cell": found.cell,
        "cell-height": scale * found.place[:, 2],
        "cell-count": p.count,
        "cell-sigma": scale * p.sigma_m,
        "cell-turn": p.sigma_deg,
    }
    return [Array.of(name, values) for name, values in arrays.items()]
