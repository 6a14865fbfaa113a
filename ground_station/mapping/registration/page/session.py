"""What is on the page: a map, a plan, the vertical and the picks; and what they make together."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64, I64
from ground_station.errors import MapError
from ground_station.map.store import Map
from ground_station.map.uncertainty import describe
from ground_station.mapping.registration import picks as files
from ground_station.mapping.registration import upright as vertical
from ground_station.mapping.registration.distances import Distances
from ground_station.mapping.registration.page.clusters import (
    Offer,
    anchors_at,
    offer_at,
    shown,
    wall_picks,
)
from ground_station.mapping.registration.picks import Pick, Picks
from ground_station.mapping.registration.plan import Plan, keep_plan
from ground_station.mapping.registration.register import find_similarity, register_map
from ground_station.mapping.registration.registration import Registration
from ground_station.mapping.registration.walls import WallFit, fit_walls
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.text import printable

_SHOWN = 60_000
_MOST_TILT_DEG = 45.0


@dataclass
class Pending:
    """A pick that is being made; `pick` is None until its place in the map is known."""

    name: str
    pick: Pick | None = None
    offer: Offer | None = None
    heights: tuple[float, float] = (0.0, 0.0)


class RegistrationSession:
    """State of the page. Safe from any thread; a change that is refused leaves it as it was."""

    def __init__(
        self, folder: Path, map_: Map, plan: Plan, distances: Distances | None, seed: int
    ) -> None:
        self.folder, self.map, self.plan = folder, map_, plan
        self.found: Registration | None = None
        self._distances, self._seed = distances, seed
        self._lock = threading.RLock()
        self._up = vertical.find_up(map_)
        self._sources = {self._up.source: self._up}
        self._quarters = 0
        self._view = self._top_view()
        self._tilt_deg = (0.0, 0.0)
        self._picks: list[Pick] = []
        self._pending: Pending | None = None
        self._proposal: tuple[WallFit, I64] | None = None
        self._revision = 0
        self.notes = self._resume()

    def picture(self) -> bytes:
        """The floor plan as PNG."""
        done, png = cv2.imencode(".png", self.plan.image)
        if not done:
            raise MapError(f"{self.plan.name}: its picture cannot be shown")
        return png.tobytes()

    def points(self) -> bytes:
        """x, y, z of at most 60,000 landmarks with z up, float32, little-endian."""
        with self._lock:
            positions = self._turned(self.map.landmarks.position_m)
        if len(positions) > _SHOWN:
            positions = positions[np.arange(_SHOWN) * len(positions) // _SHOWN]
        return positions.astype("<f4").tobytes()

    def click(self, at: F64, radius: float, low: float, high: float, offers: bool) -> None:
        """The place in the map of the pick that is being made: a click (2,) in the top view.

        It stays where it was clicked; a corner or pillar within `radius` is offered beside it.
        """
        with self._changing():
            if not radius > 0:
                raise MapError(f"the radius of a pick is {radius}; allowed: above 0")
            name = self._pending.name if self._pending else self._free_name()
            pick = self._pick_at(name, at, low, high)
            turned = self._turned(self.map.landmarks.position_m)
            offer = offer_at(turned, at, radius, low, high) if offers else None
            self._pending = Pending(name, pick, offer, (low, high))

    def snap(self) -> None:
        """Takes the offer: the pick that is being made moves to it."""
        with self._changing():
            pending = self._pending
            if pending is None or pending.offer is None:
                raise MapError("there is no corner or pillar on offer")
            pick = self._pick_at(pending.name, pending.offer.place, *pending.heights)
            self._pending = Pending(pending.name, pick)

    def _pick_at(self, name: str, at: F64, low: float, high: float) -> Pick:
        turned = self._turned(self.map.landmarks.position_m)
        rows = anchors_at(turned, at, low, high)
        middle = turned[rows].mean(axis=0)
        offset = (np.array([*at, middle[2]]) - middle) @ self._view
        place = self.map.landmarks.position_m[rows].mean(axis=0) + offset
        return Pick(name, self.map.landmarks.id[rows], place, np.zeros(2), offset)

    def place(self, pixel: F64) -> None:
        """The place on the plan, pixels (2,), of the pick that is being made; which then is."""
        with self._changing():
            if self._pending is None or self._pending.pick is None:
                raise MapError("click the place in the map first, then on the plan")
            height, width = self.plan.image.shape
            if not (-0.5 <= pixel[0] <= width - 0.5 and -0.5 <= pixel[1] <= height - 0.5):
                raise MapError("the click is beside the plan")
            if len(self._picks) >= files.MOST_PICKS:
                raise MapError(f"there are {files.MOST_PICKS} picks; no more are taken")
            pick = replace(self._pending.pick, plan_px=pixel)
            for other in self._picks:
                same = np.allclose(other.place, pick.place)
                if same or np.linalg.norm(other.plan_px - pixel) < 1:
                    where = "in the map" if same else "on the plan"
                    raise MapError(f"'{other.name}' and '{pick.name}' are the same place {where}")
            self._picks = sorted([*self._picks, pick], key=_order)
            self._pending = self._proposal = None
            self._draft()

    def propose(self, low: float, high: float) -> None:
        """Fits landmarks between two heights to the plan's walls, from the picks as they are."""
        with self._changing():
            turned = self._turned(self.map.landmarks.position_m)
            rows = np.flatnonzero((turned[:, 2] >= low) & (turned[:, 2] <= high))
            cameras = self._turned(self.map.keyframes.wTc[:, :3, 3])[:, :2]
            place = np.array([pick.place for pick in self._picks]).reshape(-1, 3)
            pixel = np.array([pick.plan_px for pick in self._picks]).reshape(-1, 2)
            fit = fit_walls(turned[rows, :2], cameras, self._turned(place)[:, :2], pixel, self.plan)
            self._proposal = fit, rows

    def decide(self, accept: bool) -> None:
        """Accepts the fit to the walls, which then stands in place of the picks, or drops it."""
        with self._changing():
            if self._proposal is None:
                raise MapError("there is no fit to the walls to decide on")
            fit, rows = self._proposal
            if accept:
                if fit.ambiguous:
                    raise MapError(f"the fit to the walls is not taken: {fit.ambiguous}")
                landmarks = self.map.landmarks
                flat = self._turned(landmarks.position_m[rows])[:, :2]
                self._picks = wall_picks(fit, rows, flat, landmarks.position_m, landmarks.id)
                self._pending = None
                self._draft()
            self._proposal = None

    def redo(self, name: str) -> None:
        """Takes a pick away to make it again under its name."""
        with self._lock:
            self.delete(name)
            self._pending = Pending(name)

    def delete(self, name: str) -> None:
        """Takes a pick away, or ends the one that is being made."""
        with self._changing():
            if self._pending is not None and self._pending.name == name:
                self._pending = None
                return
            left = [pick for pick in self._picks if pick.name != name]
            if len(left) == len(self._picks):
                raise MapError(f"there is no pick '{printable(name, 40)}'")
            self._picks, self._proposal = left, None
            self._draft()

    def scale(self, one: F64, other: F64, length_m: float) -> None:
        """The plan's scale: two of its pixels (2,) are so far apart."""
        with self._changing():
            self.plan = self.plan.with_distance(one, other, length_m)
            self._proposal = None

    def turn(self) -> None:
        """The top view a quarter turn further, so that it lies as the plan does."""
        with self._changing():
            self._quarters = (self._quarters + 1) % 4
            self._view, self._proposal = self._top_view(), None
            self._revision += 1

    def upright(
        self, source: str, tilt_deg: tuple[float, float], level: float | None, height_m: float
    ) -> None:
        """The vertical by a source, tilted further by hand, and the height of a level along it."""
        with self._changing():
            if source not in vertical.SOURCES:
                raise MapError(f"up from '{printable(source, 20)}'; allowed: {vertical.SOURCES}")
            if not max(map(abs, tilt_deg)) <= _MOST_TILT_DEG:
                raise MapError(f"the tilt is {tilt_deg}; allowed: up to {_MOST_TILT_DEG:g} deg")
            if not abs(height_m) <= 1000:
                raise MapError(f"the level's height is {height_m} m; allowed: up to 1000 m")
            if source not in self._sources:
                self._sources[source] = vertical.find_up(self.map, source)
            found = self._sources[source]
            if any(tilt_deg) or level is not None:
                turn = vertical.upright_rotation(found.upright.direction)
                tilt = Rotation.from_euler("xy", tilt_deg, degrees=True).as_matrix()
                up = turn.T @ tilt @ [0.0, 0.0, 1.0]
                sigma_deg = float(np.degrees(found.upright.sigma_rad))
                found = vertical.with_up(self.map, up, sigma_deg, found.source, level)
            self._up = replace(found, upright=replace(found.upright, height_m=height_m))
            self._view, self._proposal = self._top_view(), None
            self._tilt_deg = tilt_deg
            self._revision += 1

    def save(self) -> None:
        """Keeps the picks in the map's folder and registers the map by them."""
        with self._changing():
            picks = self._all()
            find_similarity(self.map, picks=picks, distances=self._distances, seed=self._seed)
            files.write_picks(self.folder / files.FILE, picks)
            (self.folder / files.DRAFT).unlink(missing_ok=True)
            keep_plan(self.folder, self.plan)
            _, self.found = register_map(
                self.folder,
                picks=picks,
                distances=self._distances,
                source=files.FILE,
                seed=self._seed,
            )
            self._pending = None

    def state(self) -> dict[str, Any]:
        """All that the page shows, as plain values."""
        with self._lock:
            up, info, scale = self._up, self.map.info, self.plan.scale
            height, width = self.plan.image.shape
            document: dict[str, Any] = {
                "map": {
                    "name": printable(info.name, 80),
                    "metric": info.units == "m",
                    "registered": info.registered,
                    "landmarks": len(self.map.landmarks),
                },
                "plan": {
                    "name": printable(self.plan.name, 80),
                    "width_px": width,
                    "height_px": height,
                    "resolution_m": scale.resolution_m if scale else None,
                },
                "up": {
                    "source": up.source,
                    "sources": list(vertical.SOURCES),
                    "direction": up.upright.direction.tolist(),
                    "tilt_deg": list(self._tilt_deg),
                    "sigma_deg": float(np.degrees(up.upright.sigma_rad)),
                    "level": up.upright.level,
                    "height_m": up.upright.height_m,
                    "ceiling": up.ceiling,
                    "low": up.low,
                    "high": up.high,
                    "heights": up.heights,
                },
                "cameras": self._turned(self.map.keyframes.wTc[:, :3, 3])[:, :2].tolist(),
                "revision": self._revision,
                "pending": self._shown_pending(),
                "walls": None if self._proposal is None else shown(self._proposal[0]),
                "picks": [self._shown(pick) for pick in self._picks],
                "notes": list(self.notes),
                "fit": None,
                "problem": "",
                "saved": self.found is not None,
            }
            try:
                self._add_fit(document)
            except BlimpError as error:
                document["problem"] = str(error).removeprefix("registration: ")
            return document

    def _add_fit(self, document: dict[str, Any]) -> None:
        picks = self._all()
        found = find_similarity(self.map, picks=picks, distances=self._distances, seed=self._seed)
        report = found.report
        positions = found.fit.apply(self.map.landmarks.position_m)
        report = report | describe(found.uncertainty, positions)
        held = report.get("point_held_out_m", [])
        used = {name: k for k, name in enumerate(report["point_names"])}
        placed = found.fit.apply(np.array([pick.place for pick in picks.picks]))[:, :2]
        target = picks.scale.to_world(np.array([pick.plan_px for pick in picks.picks]))
        off = np.linalg.norm(placed - target, axis=1)
        for row, pick, far in zip(document["picks"], picks.picks, off, strict=True):
            k = used.get(pick.name)
            row["used"] = k is not None
            row["residual_m"] = float(far)
            row["held_out_m"] = held[k] if k is not None and held else None
            row["disagrees_most"] = pick.name == report.get("disagrees_most")
        keys = (
            "points", "points_given", "residual_rms_m", "residual_max_m", "held_out_rms_m",
            "scale", "scale_sigma_percent", "point_sigma_m", "degrees_of_freedom",
            "centre_sigma_m", "centre_90_percent_m", "corner_sigma_m", "corner_90_percent_m",
        )  # fmt: skip
        document["fit"] = {key: report[key] for key in keys if key in report} | {
            "to_plan": self._to_plan(found, picks),
            "notes": list(found.notes),
        }

    def _to_plan(self, found: Registration, picks: Picks) -> list[float]:
        """a b c d e f of u = a x + c y + e, v = b x + d y + f, from the top view to the plan."""
        z = float(np.median(self.map.landmarks.position_m @ self._view[2]))
        corners = np.array([[0.0, 0.0, z], [1.0, 0.0, z], [0.0, 1.0, z]]) @ self._view
        o, x, y = picks.scale.to_pixels(found.fit.apply(corners)[:, :2])
        return [float(value) for value in (*(x - o), *(y - o), *o)]

    def _all(self) -> Picks:
        if self.plan.scale is None:
            raise MapError(
                "the floor plan has no scale: click two points of it and type their distance"
            )
        plan, up = self.plan, self._up.upright
        return Picks(list(self._picks), self.plan.scale, up, plan.name, plan.sha256)

    def _resume(self) -> list[str]:
        """Begins with the picks of an earlier time, where they are of this map and plan."""
        there = (self.folder / name for name in (files.DRAFT, files.FILE))
        path = next((file for file in there if file.is_file()), None)
        if path is None:
            return []
        try:
            kept = files.read_picks(path)
            if kept.plan_sha256 != self.plan.sha256:
                return [f"{path.name} is of another plan ('{printable(kept.plan, 40)}')"]
            landmarks = self.map.landmarks
            now = kept if files.unmoved(kept, landmarks) else files.at_present(kept, landmarks)
        except BlimpError as error:
            return [f"{path.name} is left alone: {printable(str(error), 200)}"]
        self._picks = sorted(now.picks, key=_order)
        if self.plan.scale is None:
            self.plan = replace(self.plan, scale=kept.scale)
        return [f"{len(now.picks)} picks of {path.name}"]

    def _draft(self) -> None:
        """Keeps what was picked so far; that it cannot is said, and no reason to lose a pick."""
        if self.plan.scale is None:
            return
        try:
            files.write_picks(self.folder / files.DRAFT, self._all())
        except BlimpError as error:
            self.notes = [printable(str(error), 200)]

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Alone, and not after the map was saved."""
        with self._lock:
            if self.found is not None:
                raise MapError("the map is registered; the page is done")
            yield

    def _turned(self, positions: F64) -> F64:
        return np.asarray(positions @ self._view.T)

    def _top_view(self) -> F64:
        """The rotation (3, 3) to the top view: z up, and walls along its sides."""
        turn = vertical.upright_rotation(self._up.upright.direction)
        if not self.map.info.registered:
            turn = vertical.along_walls(self.map.landmarks.position_m @ turn.T) @ turn
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(np.linalg.matrix_power(quarter, self._quarters) @ turn)

    def _free_name(self) -> str:
        taken = {pick.name for pick in self._picks}
        return next(str(k) for k in range(1, len(taken) + 2) if str(k) not in taken)

    def _shown(self, pick: Pick) -> dict[str, Any]:
        return {
            "name": printable(pick.name, 40),
            "map": self._turned(pick.place[None])[0].tolist(),
            "plan_px": pick.plan_px.tolist(),
            "landmarks": len(pick.landmarks),
            "used": True,
            "residual_m": None,
            "held_out_m": None,
            "disagrees_most": False,
        }

    def _shown_pending(self) -> dict[str, Any] | None:
        if self._pending is None:
            return None
        pick, offer = self._pending.pick, self._pending.offer
        return {
            "name": printable(self._pending.name, 40),
            "map": self._turned(pick.place[None])[0].tolist() if pick else None,
            "offer": {"what": offer.what, "map": offer.place.tolist()} if offer else None,
        }


def _order(pick: Pick) -> tuple[int, str]:
    """By number, then by name."""
    return (int(pick.name), "") if pick.name.isdecimal() else (1 << 30, pick.name)
