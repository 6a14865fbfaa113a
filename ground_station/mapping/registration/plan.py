"""A floor plan that picks are made on: its picture, and where its pixels lie in the world."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, U8
from ground_station.errors import MapError

_LEAST_M, _MOST_M = 1e-4, 10.0
_LEAST_APART_PX = 5.0


@dataclass(frozen=True)
class PlanScale:
    """Metres a pixel, and the world pose x, y (metres), yaw (rad) of the lower left corner.

    As ROS's map_server has it; pixels count from the centre of the top left one, `height_px` rows
    of them.
    """

    height_px: int
    resolution_m: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        # Compared this way round, what is not a number fails, too.
        if not _LEAST_M <= self.resolution_m <= _MOST_M:
            raise MapError(
                f"floor plan: its resolution is {self.resolution_m} m a pixel; allowed: "
                f"{_LEAST_M} to {_MOST_M:g}"
            )
        if not all(math.isfinite(x) and abs(x) < 1e6 for x in self.origin):
            raise MapError(f"floor plan: its origin is {list(self.origin)}; finite numbers needed")

    @property
    def _turn(self) -> F64:
        """The rotation (2, 2) from the plan's axes, x right and y up, to the world's."""
        cosine, sine = math.cos(self.origin[2]), math.sin(self.origin[2])
        return np.array([[cosine, -sine], [sine, cosine]])

    def to_world(self, pixels: npt.ArrayLike) -> F64:
        """Pixels (N, 2) to x, y in the world (N, 2), metres."""
        uv = np.asarray(pixels, np.float64).reshape(-1, 2)
        local = np.stack([uv[:, 0] + 0.5, self.height_px - 0.5 - uv[:, 1]], axis=1)
        return np.asarray(self.resolution_m * local @ self._turn.T + self.origin[:2])

    def to_pixels(self, places: npt.ArrayLike) -> F64:
        """x, y in the world (N, 2), metres, to pixels (N, 2)."""
        xy = np.asarray(places, np.float64).reshape(-1, 2) - self.origin[:2]
        local = xy @ self._turn / self.resolution_m
        return np.stack([local[:, 0] - 0.5, self.height_px - 0.5 - local[:, 1]], axis=1)


@dataclass(frozen=True)
class Plan:
    """`image` (H, W) uint8 of a floor plan; `scale` is None until somebody says it."""

    name: str
    image: U8
    scale: PlanScale | None

    @property
    def sha256(self) -> str:
        """Of its pixels: a plan is the same under another name or in another file format."""
        shape = f"{self.image.shape[0]}x{self.image.shape[1]} ".encode()
        return hashlib.sha256(shape + self.image.tobytes()).hexdigest()

    def with_distance(self, one_px: F64, other_px: F64, length_m: float) -> Plan:
        """The plan with the scale that makes two of its pixels (2,) `length_m` apart.

        Raises `MapError` for pixels too near to each other to tell, and lengths that cannot be.
        """
        apart = float(np.linalg.norm(one_px - other_px))
        if not apart >= _LEAST_APART_PX:
            raise MapError(
                f"floor plan: the two points are {apart:.1f} px apart; at least "
                f"{_LEAST_APART_PX:g} are needed, better half the plan"
            )
        if not (math.isfinite(length_m) and length_m > 0):
            raise MapError(f"floor plan: the distance is {length_m} m; allowed: above 0")
        origin = self.scale.origin if self.scale else (0.0, 0.0, 0.0)
        return replace(self, scale=PlanScale(len(self.image), length_m / apart, origin))


def load_plan(folder: Path, path: str | None, resolution_m: float | None) -> Plan:
    """The floor plan for a map's folder: `floorplan.yaml` in it, or a picture or YAML file given.

    Raises `BlimpError` with one line where there is none, or where two things say its scale.
    """
    from ground_station.map.floorplan import load_floorplan
    from ground_station.recording.folder import read_grey

    file = Path(path) if path is not None else folder / "floorplan.yaml"
    if path is None and not file.is_file():
        raise MapError(f"{folder}: there is no floorplan.yaml in it; give a plan with --plan")
    if file.suffix.lower() in (".yaml", ".yml"):
        if resolution_m is not None:
            raise MapError(f"{file}: says its scale itself; --plan-resolution-m is for a picture")
        read = load_floorplan(file)
        scale = PlanScale(len(read.image), read.resolution_m, read.origin)
        return Plan(file.name, read.image, scale)
    image = read_grey(file)
    known = PlanScale(len(image), resolution_m) if resolution_m is not None else None
    return Plan(file.name, image, known)


def keep_plan(folder: Path, plan: Plan) -> None:
    """Writes `floorplan.png` and `floorplan.yaml` into a map's folder that has none yet."""
    import cv2
    import yaml

    from ground_station.files import write_bytes

    if plan.scale is None or (folder / "floorplan.yaml").exists():
        return
    done, png = cv2.imencode(".png", plan.image)
    if not done:
        raise MapError(f"{plan.name}: cannot be written as PNG")
    document = {
        "image": "floorplan.png",
        "resolution": plan.scale.resolution_m,
        "origin": list(plan.scale.origin),
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    write_bytes(folder / "floorplan.png", png.tobytes())
    write_bytes(folder / "floorplan.yaml", yaml.safe_dump(document, sort_keys=False).encode())
