"""A map of some features, and how well a localizer does in it: only the features are swapped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.evaluation import ate
from ground_station.features.settings import OF_THE_MAP
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization import results
from ground_station.localization.estimate import PoseEstimate
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import LocalizerSettings
from ground_station.map.store import Map
from ground_station.mapping.construction.build import build_map
from ground_station.mapping.registration.register import register_map
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress
from ground_station.recording.frames import FrameSource

_SAME_NS = 5_000_000
"""A frame is judged by a true pose within this time of its own."""


def registered_map(
    source: FrameSource,
    camera: Camera,
    settings: MappingSettings,
    folder: Path,
    *,
    trajectory: Trajectory,
) -> Map:
    """A map of all frames of the source, registered by their true poses, as `blimp map` does it."""
    build_map(source, camera, settings, folder, total=source.count())
    return register_map(folder, trajectory=trajectory, source="truth")[0]


def localized(
    map_: Map,
    source: FrameSource,
    camera: Camera,
    settings: LocalizerSettings,
    truth: Trajectory,
    *,
    told: bool,
) -> dict[str, Any]:
    """The figures of a localizer with the map's features, judged by the true poses.

    `told` says whether it is given the true pose nearest to the first frame.
    """
    features = replace(settings.features, extractor=OF_THE_MAP)
    settings = replace(settings, features=features)
    localizer = Localizer(map_, camera, extractor_for(map_.info, features), settings)
    estimates: list[PoseEstimate] = []
    with Progress(f"localize in {map_.info.features}, frames", source.count()) as progress:
        for frame in source:
            if told and not estimates:
                nearest = truth.nearest(frame.time_ns)
                localizer.set_initial_pose(truth.wTc[nearest], frame.time_ns)
            estimates.append(
                localizer.process(frame.time_ns, frame.image, frame.index, frame.exposure_s)
            )
            progress.step()
    return figures(estimates, truth)


def figures(estimates: Sequence[PoseEstimate], truth: Trajectory) -> dict[str, Any]:
    """Errors, unaligned, over the frames that have a true pose and were localized.

    `within` has the shares of all judged frames within each of `ate.THRESHOLDS`. Errors are NaN
    when no judged frame was localized.
    """
    times = np.array([estimate.time_ns for estimate in estimates], np.int64)
    judged = _judged(times, truth)
    wanted = set(times[judged].tolist())
    solved = [e for e in estimates if e.wTc is not None and e.time_ns in wanted]
    result: dict[str, Any] = {"frames": len(estimates), "judged": len(wanted)}
    result["localized"] = len(solved)
    if not solved:
        nothing = dict.fromkeys(("median_m", "rmse_m", "median_deg", "rmse_deg"), float("nan"))
        return result | nothing | {"within": [0.0] * len(ate.THRESHOLDS)}
    pair = ate.synchronize(results.trajectory(solved), truth, 1e-9 * _SAME_NS)
    errors = ate.errors(*pair)
    metres, degrees = (ate.Statistics.of(e) for e in (errors.position_m, errors.rotation_deg))
    return result | {
        "median_m": metres.median,
        "rmse_m": metres.rmse,
        "median_deg": degrees.median,
        "rmse_deg": degrees.rmse,
        "within": ate.shares(errors, frames=len(wanted)),
    }


def _judged(times: npt.NDArray[np.int64], truth: Trajectory) -> npt.NDArray[np.bool_]:
    nearest = np.array([truth.nearest(int(t)) for t in times], np.intp)
    return np.asarray(np.abs(truth.time_ns[nearest] - times) <= _SAME_NS)
