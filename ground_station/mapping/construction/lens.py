"""The lens of a build: what is known of it, what the views say, and which one the map has.

Where nobody calibrated the camera, a rough lens is found by how many matches of neighbours agree
with one geometry; then, as with a calibrated one that misfits, images are placed with what is
known, the whole lens is adjusted with them, and the images are placed again, until the lens stands.
A lens is taken from the views only where they decide it. Where a calibrated one is far from what
they say, but its model may be bent by that, the other is tried, and must prove itself in its own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map.model import Model
from ground_station.mapping.construction.first_lens import LensPrior
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.lens_adjustment import (
    PARAMETERS,
    Adjusted,
    Prior,
    adjust,
    vector,
)
from ground_station.mapping.construction.matching import essential
from ground_station.mapping.construction.noise import matched_neighbours
from ground_station.mapping.refinement import shutter
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.models import among

_MODEL = "opencv5"
ROUNDS = 5
"""Models of one build, each with the lens that the one before found, at most."""
_OPEN_ROUNDS = 3
"""After so many a lens that is open still is given up."""
_OPEN = 0.01
"""A focal length whose standard deviation is a larger share of it is open: the error puts a camera
so much too near or too far, at a depth of 5 m by 5 cm, what the maps are judged by."""
_CALIBRATION = 0.002
"""Standard deviation of a focal length that somebody calibrated, as a share of it."""
_FAR = 4.0
"""A focal length that is so many standard deviations off the images' is worth a word. From round to
round of simulated walks it oscillated by 0.2 %, one of its own deviations being 0.05 %."""
_EXPLAINED, _SETTLED = 0.1, 0.003
"""A calibrated lens misfits only when another explains the first share of the residuals' variance:
over six simulated turning flights a focal length off by 1 % left 0.09 to 0.12, by 2 % 0.39 to 0.44.
One that was found stands when another explains less than the second."""
_FORETOLD = 0.07
"""Share of the variance of one half's residuals that the other half's lens must explain. In a real
kitchen lenses without their distortion or 3 % off had at least 0.10, in it and a real corridor
right ones and those 1 % off at most 0.04."""
_GROSS = 0.5
"""A lens that leaves more of each half's residuals than all else together misfits, whatever else
they find."""
_READOUT_S = 0.03
"""A camera whose readout nobody measured may have this one: a frame's time at 30 Hz. It looks like
a lens: of 523 px right ones, 40 frames of the kitchen found 504 ± 3 px, with the readout 522 ± 3.
"""
_AS_WELL = 1.05
"""A readout is possible that leaves so much more than the better one. Those of the kitchen, where
it is there, and of a real corridor, where it is not, differed by 1 to 5 %; in a simulated walk with
a headset without one, it left 1.9 times as much."""
_PROVEN = 0.2
"""A tried lens is so in both halves of its model: each one's leaves a smaller share of what the
known one leaves in the other. In three simulated walks with a lens 1 % off it was at most 0.15, in
40 frames of a real kitchen, whose rolling shutter looks like a lens 4 % off, 0.46 in one half and
0.05 in the other. How much more such a lens explains tells less: there 1.9 %, in walks 0.6 to 7 %.
"""
_FEWER = 0.9
"""A lens that more images have decided than the model by it has, by this share, stands. A simulated
walk of 195 images decided it to 0.04 %; the two thirds that held together by it left it open."""
_CHECKED_FOCAL = 0.1
"""A calibrated focal length may be off by this share when the views are asked."""
_ASPECT = {True: 0.0005, False: 0.002}
"""Of fy over fx, of a lens that is calibrated or not: pixels are square, and a calibration tells
how nearly. A rolling shutter looks like more: the simulated thesis camera's lens, which was right,
was denied by 2 % of fy, fx being found to 0.02 %."""
_CENTRE = {True: 0.005, False: 0.02}
"""Of the principal point, as a share of the width, of a lens that is calibrated or not."""
_TANGENTIAL = 0.005
_BENT = 0.5
"""Of each radial term: it moves an image's corner by so large a share of its distance."""
_PAIRS = 16
"""Of the search for a rough lens: compared pairs of images."""
_FOCALS, _BENDS = 13, (-0.5, -0.35, -0.2, -0.1, 0.0, 0.1)
_SEARCH_PX, _ROUGH_PX = 0.5, 4.0
"""Distance from the epipolar line in which a match agrees, at a width of 640 pixels: of the search,
and of the pairs of the first model, whose lens is still a rough one."""
_SEARCH_ITERATIONS = 300


def prior_of(known: LensPrior, checked: Camera) -> Prior:
    """The Gaussian that an adjustment takes the lens from: about the known camera, wide."""
    camera = known.camera if known.calibrated else checked
    focal = max(known.sigma_focal, _CHECKED_FOCAL)
    x, y = camera.width_px / 2 / camera.fx_px, camera.height_px / 2 / camera.fy_px
    corner = x * x + y * y
    centre = _CENTRE[known.calibrated] * camera.width_px
    bent = [_BENT / corner, _BENT / corner**2, _BENT / corner**3]
    sigma = np.array([0.0, 0.0, centre, centre, *bent[:2], _TANGENTIAL, _TANGENTIAL, bent[2]])
    lengths = np.array([camera.fx_px, camera.fy_px])
    covariance = np.diag(sigma**2)
    covariance[:2, :2] = focal**2 * np.outer(lengths, lengths)
    covariance[:2, :2] += 0.5 * _ASPECT[known.calibrated] ** 2 * np.diag(lengths**2)
    return Prior(vector(camera), covariance)


def with_lens(images: Images, camera: Camera) -> Images:
    """The images with their key points undistorted by another lens."""
    found = [camera.undistort_to_pinhole(features.keypoints_px) for features in images.features]
    return replace(images, pinhole_px=found)


class SelfCalibration:
    """One build's lens on its way from what is known to what the map is made with.

    `camera` is the lens to place the images with next; `go_on` says of a finished model whether
    its lens is not the map's yet. `rounds` counts the models.
    """

    def __init__(self, known: LensPrior, images: Images, settings: MappingSettings) -> None:
        """Raises `MapError` when nobody calibrated a lens of another model than the five-parameter
        one.
        """
        self.known = known
        self._follows = known.camera.model == _MODEL
        if not (self._follows or known.calibrated):
            raise MapError(
                f"the images find a lens of the model {_MODEL} only, not {known.camera.model}: "
                "calibrate it with 'blimp calibrate' and give the file with --camera"
            )
        ratio = settings.match.of(settings.features).ratio
        self.camera = known.camera if known.calibrated else rough_lens(images, known, ratio)
        self._gap_s = settings.refine.keyframe_gap_s if settings.sfm.rolling_shutter else 0.0
        self.rounds = 0
        self._found: Adjusted | None = None
        self._gross = False
        self._by = 0  # images that decided `camera`
        self._explained = 0  # observations of the given lens's model, where another is tried
        self._state = "given" if known.calibrated else "found"

    def settings(self, settings: MappingSettings) -> MappingSettings:
        """With limits in pixels that hold for a lens as rough as the present one."""
        if self.known.calibrated or self.rounds:
            return settings
        limit = _ROUGH_PX * self.camera.width_px / 640
        match = replace(settings.match, error_px=max(settings.match.error_px, limit))
        sfm = replace(settings.sfm, max_error_px=max(settings.sfm.max_error_px, limit))
        return replace(settings, match=match, sfm=sfm)

    def go_on(self, model: Model, images: Images) -> bool:
        """Whether images have to be placed again, by another lens, which is `camera` then.

        Where they have not, `camera` is the lens of this model or of the first: the known one. A
        calibrated lens of another model than the five-parameter one stays, unjudged. Raises
        `MapError` when the views leave a lens open that nobody calibrated, or that misfits by far.
        """
        if not self._follows:
            return False
        self.rounds += 1
        given, tried = self._state == "given", self._state == "tried"
        prior = prior_of(self.known, self.camera)
        still_view, rolling_view = self._views(model, images)
        fewer = len(model.names) < _FEWER * self._by
        still = None if fewer else adjust(still_view, self.camera, prior)
        if still is None:
            if tried:
                return self._back("kept")
            return False if given or fewer else self._give_up("the model is too small")
        if given and still.explained < _EXPLAINED and not _is_far(still, self.known.camera):
            self._found = still
            return False
        rolling = adjust(rolling_view, self.camera, prior) or still
        # A readout that is known is believed where it fits as well.
        known = _AS_WELL if self.camera.readout_s > 0 else 1.0
        found = rolling if rolling.sigma_px < known * still.sigma_px else still
        is_open = found.sigma_focal > _OPEN or not _folds_nowhere(found.camera)
        if tried:
            view = rolling_view if found is rolling else still_view
            if len(model.point) < self._explained or not self._proves(found, view, prior):
                return self._back("kept")
            self._state = "found"
        elif given:
            limit = _AS_WELL * min(still.sigma_px, rolling.sigma_px)
            misfit = min(
                self._misfit(each, view, prior)
                for each, view in ((still, still_view), (rolling, rolling_view))
                if each.sigma_px <= limit
            )
            if not misfit:
                self._found = found
                doubtful = found.explained > _GROSS or _is_far(found, self.known.camera)
                if is_open or not doubtful:
                    return self._back("kept" if doubtful else "given")
            self._state = "found" if misfit else "tried"
            self._gross, self._explained = misfit > _GROSS, len(model.point)
        self._found = found
        change = vector(found.camera) - vector(self.camera)
        distance = float(change @ np.linalg.solve(found.covariance, change))
        if not given:
            if distance < len(change) or found.explained < _SETTLED:
                return self._give_up(_open(found)) if is_open else False
            if is_open and self.rounds >= _OPEN_ROUNDS:
                return self._give_up(_open(found))
            if self.rounds >= ROUNDS:
                # It may oscillate with the points that each model happens to have.
                if not is_open and not _is_far(found, self.camera):
                    return False
                return self._give_up(f"after {self.rounds} rounds it has not settled")
        self.camera = found.camera
        self._by = 0 if is_open else len(model.names)
        return True

    def _views(self, model: Model, images: Images) -> list[Model]:
        """The model as seen by a camera without a readout, and by one with its own or a common one.

        Not even a known one is certain: stills have no velocity, and the model gives them one.
        """
        return [
            _as_seen(model, images, replace(self.camera, readout_s=readout_s), self._gap_s)
            for readout_s in (0.0, self.camera.readout_s or _READOUT_S)
        ]

    def _misfit(self, found: Adjusted, seen: Model, prior: Prior) -> float:
        """Share of the residuals' variance that goes with a better lens; 0 where that is doubtful.

        A wrong lens is so in all images: what one half of them finds fits the other better, too.
        What a few wrong places leave goes with how the camera moved.
        """
        halves = self._halves(seen, prior)
        if halves is None or found.explained < _EXPLAINED:
            return 0.0
        one, other = halves
        least = min(each.explained for each in (found, one, other))
        foretold = min(
            one.explained - one.left_by(other.camera), other.explained - other.left_by(one.camera)
        )
        return least if least > _GROSS or foretold > _FORETOLD else 0.0

    def _proves(self, found: Adjusted, seen: Model, prior: Prior) -> bool:
        """Whether by a tried lens's own model the known one is wrong, in each half of it."""
        halves, known = self._halves(seen, prior), self.known.camera
        if halves is None or not _is_far(found, self.known.camera):
            return False
        return all(
            one.left_by(other.camera) < _PROVEN * one.left_by(known)
            for one, other in (halves, halves[::-1])
        )

    def _halves(self, seen: Model, prior: Prior) -> tuple[Adjusted, Adjusted] | None:
        """The lenses by the earlier and the later images alone."""
        late = np.arange(len(seen.names)) >= len(seen.names) // 2
        one, other = (adjust(among(seen, half), self.camera, prior) for half in (late, ~late))
        return None if one is None or other is None else (one, other)

    def as_built(self) -> dict[str, Any]:
        """What map.toml says of the lens, beside the one that it holds."""
        found, notes = self._found, self.notes()
        result: dict[str, Any] = {
            "said": notes[0] if notes else "as given; the images do not deny it",
            "source": self.known.source,
            "state": self._state,
            "rounds": self.rounds,
            "given": _lens_of(self.known.camera),
        }
        if found is not None:
            result["found"] = _lens_of(found.camera)
            result["sigma"] = dict(zip(PARAMETERS, found.sigmas.round(8).tolist(), strict=True))
            result["explained"] = round(found.explained, 5)
        return result

    def notes(self) -> list[str]:
        """Lines for a person: what was done about the lens, and what to do."""
        found, given = self._found, self.known.camera
        if found is None or self._state == "given":
            return []
        used, focal, sigma = self.camera, _focal(self.camera), found.sigma_focal
        said = f"{focal:.1f} ± {focal * sigma:.1f} px ({100 * sigma:.2g} %)"
        if not self.known.calibrated:
            return [f"lens found by the images: focal length {said}; {_terms(used, found)}"]
        if self._state == "found":
            return [
                f"the given camera misfits: focal length {_focal(given):.1f} px, the images say "
                f"{said}; {_terms(used, found)}. The map is made with the lens found; if this is "
                "another camera than the file's, or another mode, calibrate it: blimp calibrate"
            ]
        if self._state == "kept":
            better = _focal(found.camera)
            return [
                f"the given camera's focal length of {_focal(given):.1f} px is kept: the images "
                f"fit {better:.1f} ± {better * sigma:.1f} px better, but so looks a rolling "
                "shutter or a part of them; if in doubt, calibrate it: blimp calibrate"
            ]
        return [
            "the given camera misfits, but the images do not decide on another: its focal length "
            f"of {_focal(given):.1f} px is kept, and the map may be bent; check that the file is "
            "this camera's, or calibrate it: blimp calibrate"
        ]

    def failed(self, error: MapError) -> None:
        """Of a lens by which there is no model: raises why, unless the known one has a model."""
        if self._state == "tried":
            self._back("kept")
        elif self._state == "found" and self.rounds:
            raise self._open("no model comes of the one that they found") from error
        else:
            raise error

    def _give_up(self, reason: str) -> bool:
        """Back to the calibrated lens, if there is one.

        Not to one that misfits by more than all else: a corridor's map was bent by metres by it.
        """
        if not self.known.calibrated or self._gross:
            raise self._open(reason)
        return self._back("open")

    def _back(self, state: str) -> bool:
        """The known lens stays: its model is the map's."""
        self._state, self.camera = state, self.known.camera
        return False

    def _open(self, reason: str) -> MapError:
        given = "the given camera is not this one's, and " if self._gross else ""
        return MapError(
            f"{given}the images leave the lens open: {reason}. A camera that flies straight on, or "
            "sees a flat wall only, does not show its lens: calibrate it with 'blimp calibrate' "
            "and give the file with --camera, or add a flight that turns"
        )


def rough_lens(images: Images, known: LensPrior, ratio: float) -> Camera:
    """The lens by which most matches of neighbouring images agree with one geometry each.

    The focal length is searched within twice its deviation around the known one, with the
    one-parameter division model for the lens (Fitzgibbon, CVPR 2001), which is the same at any
    focal length where it bends the image's corner by the same share. Without matches of neighbours
    it is the known one.
    """
    matched = matched_neighbours(images, ratio, _PAIRS)
    camera = known.camera
    if not matched:
        return camera
    reach = np.exp(np.linspace(-2, 2, _FOCALS) * known.sigma_focal)
    best, most = camera, -1
    for bend in _BENDS:
        for share in reach.tolist():
            tried = _divided(camera, share, bend)
            if tried is None:
                continue
            agree = sum(_agreeing(tried, first, second) for first, second in matched)
            if agree > most:
                best, most = tried, agree
    return best


def _agreeing(camera: Camera, first: F64, second: F64) -> int:
    p, q = camera.undistort_to_pinhole(first), camera.undistort_to_pinhole(second)
    limit = _SEARCH_PX * camera.width_px / 640
    found = essential(p, q, camera.matrix, limit, 0.999, _SEARCH_ITERATIONS)
    return 0 if found is None else int(np.count_nonzero(found[1]))


def _divided(camera: Camera, share: float, bend: float) -> Camera | None:
    """A camera of `share` of the focal lengths whose corner is bent outwards by 1 / (1 + bend).

    None where the five-parameter model cannot follow.
    """
    fx, fy = share * camera.fx_px, share * camera.fy_px
    half = np.array([camera.width_px / 2 / fx, camera.height_px / 2 / fy])
    radius = np.linspace(0.05, 1.0, 40) * np.linalg.norm(half)
    straight = radius / (1 + bend * (radius / radius[-1]) ** 2)
    # Distortion is linear in k1, k2 and k3.
    powers = np.stack([straight**3, straight**5, straight**7], axis=1)
    k1, k2, k3 = np.linalg.lstsq(powers, radius - straight, rcond=None)[0].tolist()
    tried = replace(camera, fx_px=fx, fy_px=fy, k1=k1, k2=k2, k3=k3, p1=0.0, p2=0.0)
    return tried if _folds_nowhere(tried) else None


def _folds_nowhere(camera: Camera) -> bool:
    """Whether undistorted corners of the image are distorted to where they were again."""
    w, h = camera.width_px - 1.0, camera.height_px - 1.0
    edge = np.array([[0, 0], [w, 0], [0, h], [w, h], [w / 2, 0], [0, h / 2]])
    return bool(np.abs(camera.distort(camera.undistort(edge)) - edge).max() < 0.5)


def _as_seen(model: Model, images: Images, camera: Camera, gap_s: float) -> Model:
    """The model with the key points as they were found, distorted, but for a known readout's shift.

    That is known where an image has neighbours within `gap_s`.
    """
    order = np.argsort(model.image, kind="stable")
    pixels = np.empty((len(order), 2))
    offset = np.searchsorted(model.image[order], np.arange(len(model.names) + 1))
    for k, image_id in enumerate(model.image_id.tolist()):
        rows = order[offset[k] : offset[k + 1]]
        pixels[rows] = images.features[image_id - 1].keypoints_px[model.feature[rows]]
    time_ns, points = images.time_ns[model.image_id - 1], model.position[model.point]
    shift, moved = shutter.shifts_px(time_ns, model.wTc, camera, gap_s, model.image, points, pixels)
    if moved:
        flat = camera.undistort(pixels) - shift / [camera.fx_px, camera.fy_px]
        pixels = camera.distort(flat)
    return replace(model, pixel_px=pixels)


def _open(found: Adjusted) -> str:
    if found.sigma_focal <= _OPEN:
        return "the one that fits them best folds the image's edge back"
    # No number: a model that a wrong lens bends is wrong in more than its deviations hold.
    return f"their focal length is uncertain by more than {100 * _OPEN:.2g} %"


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.fx_px * camera.fy_px))


def _is_far(found: Adjusted, camera: Camera) -> bool:
    """Whether a focal length is further off than its deviations and a calibration's hold."""
    off = abs(np.log(_focal(found.camera) / _focal(camera)))
    return bool(off > _FAR * np.hypot(found.sigma_focal, _CALIBRATION))


def _lens_of(camera: Camera) -> dict[str, float]:
    return dict(zip(PARAMETERS, vector(camera).round(8).tolist(), strict=True))


def _terms(camera: Camera, found: Adjusted) -> str:
    sigma = dict(zip(PARAMETERS, found.sigmas.tolist(), strict=True))
    return ", ".join(
        f"{name} {getattr(camera, name):.4f} ± {sigma[name]:.4f}" for name in ("k1", "k2", "k3")
    )
