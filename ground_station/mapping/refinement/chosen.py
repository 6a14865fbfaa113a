"""Which frames of a flight tell a map something, and what they saw at their frame's time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ground_station.arrays import F32, F64, I64, Bools
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.map.observations import FlightObservations
from ground_station.map.store import Map
from ground_station.mapping.refinement import shutter
from ground_station.mapping.settings import RefineSettings

_SAME_RAY_PX = 0.1
"""An observation that another camera's lens sees and the map's cannot express is left out."""


@dataclass(frozen=True)
class Chosen:
    """F of a flight's frames, as the map's camera would have seen them with a global shutter.

    `time_ns` (F,), `wTc` (F, 4, 4); observation o is of frame `frame[o]` and landmark
    `landmark[o]`, an index into the map's, at `pixel_px[o]` (O, 2), undistorted pixels of the map's
    camera. `left` counts frames by why they were left out."""

    name: str
    time_ns: I64
    wTc: F64
    frame: I64
    landmark: I64
    pixel_px: F64
    left: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def observations_per_landmark(self) -> float:
        """The mean over the landmarks that were seen at all."""
        seen = np.unique(self.landmark)
        return len(self.landmark) / max(len(seen), 1)


def choose_frames(seen: FlightObservations, map_: Map, settings: RefineSettings) -> Chosen:
    """The frames that are worth adding, in order of time.

    At 30 Hz neighbouring frames see the same from the same place, and points followed from one
    keyframe share its errors: a frame is taken when the view has changed enough since the last one
    taken. Left out are also frames too fast for the readout to be undone, and those whose
    observations do not fit the map from the pose they came with."""
    camera = map_.info.camera
    focal, centre = np.array([camera.fx_px, camera.fy_px]), [camera.cx_px, camera.cy_px]
    landmarks, points_c, pixel_px, usable = _against(seen, map_)
    twist = shutter.twists(seen.time_ns, seen.wTc, settings.twist_reach_s, settings.twist_gap_s)
    if seen.camera.readout_s == 0:
        twist[:] = 0.0
    row_s = shutter.row_times_s(seen.pixel_px[:, 1], seen.camera)
    left = dict.fromkeys(
        ("view unchanged", "few observations", "no velocity", "too fast", "misfit"), 0
    )
    taken: list[tuple[int, I64, F64]] = []
    for k in range(len(seen)):
        rows = np.arange(seen.offset[k], seen.offset[k + 1])
        rows = rows[usable[rows]]
        X = points_c[rows]
        if len(rows) < settings.min_observations:
            left["few observations"] += 1
            continue
        if taken and not _view_changed(seen, taken[-1][0], k, X, settings):
            left["view unchanged"] += 1
            continue
        if not np.isfinite(twist[k]).all():
            left["no velocity"] += 1
            continue
        shift = shutter.shift_px(X, np.tile(twist[k], (len(rows), 1)), row_s[rows], camera)
        moved = np.linalg.norm(shift, axis=1)
        if not np.percentile(moved, 90) <= settings.max_shift_px:  # nor where it is NaN
            left["too fast"] += 1
            continue
        pixel = pixel_px[rows] - shift
        off = np.linalg.norm(pixel - (X[:, :2] / X[:, 2:] * focal + centre), axis=1)
        if np.median(off) > settings.max_misfit_px:
            left["misfit"] += 1
            continue
        # A landmark that is there twice counts where it fits best.
        order = np.argsort(off, kind="stable")
        landmark, first = np.unique(landmarks[rows[order]], return_index=True)
        taken.append((k, landmark, pixel[order[first]]))
    frames = np.array([k for k, _, _ in taken], np.int64)
    return Chosen(
        name=seen.name,
        time_ns=seen.time_ns[frames],
        wTc=seen.wTc[frames],
        frame=np.repeat(np.arange(len(taken)), [len(rows) for _, rows, _ in taken]),
        landmark=np.concatenate([rows for _, rows, _ in taken] or [np.empty(0, np.int64)]),
        pixel_px=np.concatenate([pixel for _, _, pixel in taken] or [np.empty((0, 2))]),
        left=left,
    )


def _against(seen: FlightObservations, map_: Map) -> tuple[I64, F64, F64, Bools]:
    """A flight's observations against a map: landmarks' indices (O,), where they are in the frame's
    axes (O, 3), undistorted pixels (O, 2), and which of them can be used (O,).
    """
    camera, lm = map_.info.camera, map_.landmarks
    order = np.argsort(lm.id)
    place = np.searchsorted(lm.id[order], seen.landmark)
    landmark = order[np.minimum(place, len(order) - 1)]
    pixel_px, usable = by_lens(seen.pixel_px, seen.camera, camera)
    with np.errstate(invalid="ignore", over="ignore"):
        frame = np.repeat(np.arange(len(seen)), np.diff(seen.offset))
        X = poses.in_each(seen.wTc[frame], lm.position_m[landmark])
    usable &= (lm.id[landmark] == seen.landmark) & np.isfinite(X).all(axis=1) & (X[:, 2] > 0)
    return landmark, X, pixel_px, usable


def by_lens(pixel_px: F32, camera: Camera, of_map: Camera) -> tuple[F64, Bools]:
    """A camera's pixels (N, 2) as undistorted ones of the map's, and which its lens can express."""
    focal, centre = np.array([of_map.fx_px, of_map.fy_px]), [of_map.cx_px, of_map.cy_px]
    with np.errstate(invalid="ignore", over="ignore"):
        ray = camera.undistort(pixel_px)
        again = of_map.undistort(of_map.distort(ray))
        known = np.linalg.norm((again - ray) * focal, axis=1) < _SAME_RAY_PX
    return ray * focal + centre, np.asarray(known)


def _view_changed(
    seen: FlightObservations, last: int, k: int, points_c: F64, settings: RefineSettings
) -> bool:
    """Whether frame k looks from elsewhere than frame `last`, at points (N, 3) in its own axes."""
    if (seen.time_ns[k] - seen.time_ns[last]) / 1e9 < settings.min_interval_s:
        return False
    step = poses.inverse(seen.wTc[last]) @ seen.wTc[k]
    depth = float(np.median(np.linalg.norm(points_c, axis=1)))
    parallax = np.degrees(np.arctan2(np.linalg.norm(step[:3, 3]), depth))
    turn = np.degrees(poses.rotation_angle(step[:3, :3]))
    return bool(parallax >= settings.min_parallax_deg or turn >= settings.min_turn_deg)


def thin(flights: list[Chosen], most: int) -> list[Chosen]:
    """The same flights with at most `most` frames in all, taken evenly; at least one of each."""
    total = sum(map(len, flights))
    return flights if total <= most else [_thin(f, most * len(f) // total) for f in flights]


def _thin(flight: Chosen, most: int) -> Chosen:
    kept = np.linspace(0, len(flight) - 1, max(1, min(most, len(flight)))).round().astype(np.int64)
    new = np.full(len(flight), -1)
    new[kept] = np.arange(len(kept))
    rows = new[flight.frame] >= 0
    return replace(
        flight,
        time_ns=flight.time_ns[kept],
        wTc=flight.wTc[kept],
        frame=new[flight.frame[rows]],
        landmark=flight.landmark[rows],
        pixel_px=flight.pixel_px[rows],
        left=flight.left | {"above max_frames": len(flight) - len(kept)},
    )
