"""From pictures of the board to a camera: choose views, fit the lens, time the rows, fit again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ground_station.arrays import F64
from ground_station.calibration import lens, selection, verdict
from ground_station.calibration.detection import BoardFinder, Gathered
from ground_station.calibration.errors import CalibrationError
from ground_station.calibration.lens import Fit, Points
from ground_station.calibration.readout import Readout, readout_of
from ground_station.calibration.selection import CORNERS
from ground_station.calibration.views import View, views_of
from ground_station.errors import CameraError
from ground_station.geometry.camera import Camera

_ACROSS, _DOWN = 9, 7


def at_corners_px(fit: Fit, size_px: tuple[int, int]) -> dict[str, float]:
    """The standard deviation of where a ray is seen, by corner of the picture.

    Where a corner is beyond what is used of a fisheye, of the last ray on the way to it that is.

    Without what a turn of the whole camera would explain: it changes poses, and no place. The turn
    is the one that fits a grid over the picture best.
    """
    w, h = size_px
    u, v = np.meshgrid(np.linspace(0, w - 1, _ACROSS), np.linspace(0, h - 1, _DOWN))
    camera = fit.camera(size_px)
    points = camera.rays(camera.drawn_in(np.stack([u.ravel(), v.ravel()], axis=1)))
    _, by_pose, by_lens = lens.project(fit.theta, np.zeros(6), points)
    turn = by_pose[:, :3]
    left = by_lens - turn @ np.linalg.lstsq(turn, by_lens, rcond=None)[0]
    variance = np.einsum("ij,jk,ik->i", left, fit.covariance, left).reshape(_DOWN, _ACROSS, 2)
    deviation = np.sqrt(np.maximum(variance, 0).sum(axis=2))
    places = ((0, 0), (0, -1), (-1, 0), (-1, -1))
    return {name: float(deviation[at]) for name, at in zip(CORNERS, places, strict=True)}


MAX_VIEWS = 40
_POOR = 3.0
"""A view whose corners are off by so many times what is usual is left out."""
_BETTER = 0.8
"""Of the five parameters' misfit: a fisheye, which has a number less, does so by no chance."""
_TURNS = 2
"""Lens and readout, each with the other's: the second changes neither by a tenth of its sigma."""


@dataclass(frozen=True)
class Region:
    """A part of the picture: corners of the board in it, and how far they are off.

    `lens_px` is the deviation of where the lens sees its outermost pixel's ray, for a corner.
    """

    name: str
    corners: int
    rms_px: float
    lens_px: float | None = None


@dataclass
class Result:
    """A calibration. `views` are those that the `fit` is of, `seen` all that had the board."""

    camera: Camera
    fit: Fit
    views: list[View]
    seen: list[View]
    readout: Readout | None
    size_px: tuple[int, int]
    tilts_deg: F64
    distances_m: F64
    notes: list[str] = field(default_factory=list)

    @property
    def readout_known(self) -> bool:
        """Whether the camera's readout was measured."""
        r = self.readout
        return r is not None and r.determined and not r.backwards

    @property
    def corners(self) -> tuple[int, int]:
        """How many corners count, and how many were left out as wrong."""
        used = sum(int(np.count_nonzero(kept)) for kept in self.fit.used)
        return used, sum(len(kept) for kept in self.fit.used) - used

    def rows(self) -> list[tuple[View, float, float, float]]:
        """Each view with its RMS, px, and the board's tilt, degrees, and distance, metres."""
        tilts, distances = self.tilts_deg.tolist(), self.distances_m.tolist()
        return list(zip(self.views, self.fit.view_rms_px(), tilts, distances, strict=True))

    def residuals(self) -> tuple[F64, F64]:
        """Where corners that count were seen (N, 2), and from where the lens puts them, pixels."""
        of_each = zip(self.views, self.fit.residuals, self.fit.used, strict=True)
        seen, off = zip(*((v.seen.px[kept], r[kept]) for v, r, kept in of_each), strict=True)
        return np.concatenate(seen), np.concatenate(off)

    def regions(self) -> list[Region]:
        """The four corners of the picture, and the rest of it."""
        px, off = self.residuals()
        rest = np.ones(len(px), bool)
        found = []
        known = at_corners_px(self.fit, self.size_px)
        for name in selection.CORNERS:
            inside = selection.in_corner(px, self.size_px, name)
            rest &= ~inside
            found.append(Region(name, int(inside.sum()), lens.rms(off[inside]), known[name]))
        return [*found, Region("the rest", int(rest.sum()), lens.rms(off[rest]))]


def calibrate(
    gathered: Gathered,
    finder: BoardFinder,
    timed: list[bool],
    most_views: int = MAX_VIEWS,
    model: str = "opencv5",
) -> Result:
    """The camera by what was seen; raises `CalibrationError` naming what is missing.

    `timed` says of each input whether its frames' times can be trusted. Where the five parameters
    of the `model` misfit and a fisheye fits, a note or the refusal says so.
    """
    verdict.check_seen(gathered, finder)
    seen = views_of(gathered.observations, finder.points_m, timed)
    verdict.check_sharp(seen, selection.sharp(seen))
    try:
        result = _calibrated(seen, finder, gathered.size_px, most_views, model)
    except CalibrationError as error:
        if model == "fisheye":
            raise
        try:
            other = _calibrated(seen, finder, gathered.size_px, most_views, "fisheye")
        except (CalibrationError, CameraError):
            raise error from None
        raise CalibrationError(
            f"{error}; a fisheye fits these views, corners {other.fit.rms_px:.2f} px off (RMS): "
            "calibrate with --model fisheye"
        ) from None
    if model != "fisheye" and (rms := _rms_as_fisheye(result)) < _BETTER * result.fit.rms_px:
        result.notes.append(
            f"a fisheye fits these views better, corners {rms:.2f} px off instead of "
            f"{result.fit.rms_px:.2f}: calibrate with --model fisheye"
        )
    return result


def _calibrated(
    seen: list[View], finder: BoardFinder, size_px: tuple[int, int], most_views: int, model: str
) -> Result:
    """The camera of one lens model; raises `CalibrationError`."""
    height_px = size_px[1]
    middle_m = finder.points_m.mean(axis=0)
    usable = selection.sharp(seen)

    def fitted(theta: F64, readout_s: float | None) -> tuple[Fit, list[View], int]:
        """A lens fitted to the views that tell most, those, and how many fit it too badly."""
        points = [view.points(height_px, readout_s) for view in usable]
        located, poses = _located(theta, points)
        if len(located) < verdict.MIN_VIEWS:
            raise CalibrationError("the views fit no camera: is the board flat, its file right?")
        candidates, points = [usable[k] for k in located], [points[k] for k in located]
        outline_m = _outline_m(finder.points_m)
        chosen = selection.informative(
            candidates, points, theta, poses, size_px, outline_m, most_views
        )
        fit = lens.adjust([points[k] for k in chosen], theta, [poses[k] for k in chosen])
        return _without_poor(fit, [candidates[k] for k in chosen], height_px, readout_s)

    fit, views, left_out = fitted(_first(usable, size_px, finder.points_m, model), None)
    notes = []
    readout: Readout | None = None
    for _ in range(_TURNS):
        readout = readout_of(seen, fit.theta, height_px)
        if readout is None or not readout.determined:
            break
        # With the skew gone, views in motion tell as much as others.
        fit, views, left_out = fitted(fit.theta, readout.readout_s)
    verdict.check_determined(fit, usable, size_px, middle_m)
    if left_out:
        notes.append(f"{left_out} views left out: they fit the others' lens badly")
    known_s = _known_readout_s(readout, notes)
    return Result(
        camera=fit.camera(size_px, known_s),
        fit=fit,
        views=views,
        seen=seen,
        readout=readout,
        size_px=size_px,
        tilts_deg=verdict.tilts_deg(fit.poses),
        distances_m=verdict.distances_m(fit.poses, middle_m),
        notes=notes,
    )


def _rms_as_fisheye(result: Result) -> float:
    """How far the corners of a result's views are off as a fisheye sees them; inf where it runs."""
    height_px, readout_s = result.size_px[1], result.camera.readout_s or None
    points = [view.points(height_px, readout_s) for view in result.views]
    theta = lens.first_guess(points, result.size_px, "fisheye")
    located, poses = _located(theta, points)
    if len(located) < verdict.MIN_VIEWS:
        return np.inf
    try:
        return lens.adjust([points[k] for k in located], theta, poses).rms_px
    except CalibrationError:
        return np.inf


def _outline_m(points_m: F64) -> F64:
    """The board's outermost corners (4, 2), metres."""
    low, high = points_m[:, :2].min(axis=0), points_m[:, :2].max(axis=0)
    return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])


def _first(usable: Sequence[View], size_px: tuple[int, int], points_m: F64, model: str) -> F64:
    """A lens (D,) to choose views by: of a few that are unlike each other."""
    begin = selection.spread(usable, size_px, _outline_m(points_m))
    points = [usable[k].points(size_px[1], None) for k in begin]
    theta = lens.first_guess(points, size_px, model)
    few, poses = _located(theta, points)
    if len(few) < verdict.MIN_VIEWS:
        return theta
    prior = lens.weak_prior(size_px, model)
    return lens.adjust([points[k] for k in few], theta, poses, prior).theta


def _located(theta: F64, points: Sequence[Points]) -> tuple[list[int], list[F64]]:
    """Which views the board has a pose in, and these poses."""
    poses = [lens.locate(theta, one) for one in points]
    found = [(k, pose) for k, pose in enumerate(poses) if pose is not None]
    return [k for k, _ in found], [pose for _, pose in found]


def _without_poor(
    fit: Fit, views: list[View], height_px: int, readout_s: float | None
) -> tuple[Fit, list[View], int]:
    """The fit without views that hardly fit, or of which most corners do not count."""
    left_out = 0
    points = [view.points(height_px, readout_s) for view in views]
    while len(views) > verdict.MIN_VIEWS:
        sigma = np.array([one.sigma_px for one in points])
        off = np.nan_to_num(np.array(fit.view_rms_px()), nan=np.inf) / sigma
        share = np.array([np.mean(kept) for kept in fit.used])
        poor = (off > _POOR * np.median(off)) | (share < 0.5)
        # The worst alone first: it may be what the others do not fit to.
        worst = int(np.argmax(np.where(poor, off + 1e6 * (share < 0.5), -1.0)))
        if not poor[worst]:
            break
        del views[worst], points[worst]
        fit = lens.adjust(points, fit.theta, list(np.delete(fit.poses, worst, axis=0)))
        left_out += 1
    return fit, views, left_out


def _known_readout_s(readout: Readout | None, notes: list[str]) -> float:
    """The readout for the camera's file, 0 where it is not known; a note says why."""
    if readout is None or not readout.determined:
        return 0.0
    if readout.backwards:
        notes.append(
            f"the rows are read from the last to the first ({1e3 * readout.readout_s:.1f} ms): the "
            "pictures were turned by half after they were taken; readout_s is left out"
        )
        return 0.0
    return max(readout.readout_s, 0.0)
