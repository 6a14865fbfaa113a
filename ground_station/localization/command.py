"""`blimp localize`: poses of a recording, video or folder of images in a map."""

from __future__ import annotations

import argparse
import sys
from time import monotonic
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ground_station.localization.estimate import PoseEstimate
    from ground_station.localization.kinematics import Kinematics
    from ground_station.localization.localizer import Localizer
    from ground_station.localization.settings import LocalizerSettings
    from ground_station.recording.frames import FrameSource

_FAR_INIT_S = 0.1
"""A first pose taken further from the first frame than this is worth a line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments; imports nothing heavy."""
    parser.set_defaults(next="blimp evaluate {out} TRUTH.txt    (where you have the truth)")
    parser.add_argument("input", metavar="INPUT", help="recording, video file or image folder")
    parser.add_argument("--map", required=True, metavar="MAP", help="folder of the map")
    parser.add_argument("--out", required=True, metavar="EST.txt", help="trajectory, TUM format")
    parser.add_argument("--range", metavar="A:B[:S]", help="frames A to B-1, every S-th")
    parser.add_argument(
        "--init",
        default="none",
        metavar="TUM.txt|none",
        help="trajectory whose pose nearest in time to the first frame starts the localizer; "
        "none (default): found from the map alone",
    )
    parser.add_argument(
        "--preset", default="default", metavar="NAME|FILE.toml",
        help="settings: a preset's, or a file of your own (default)",
    )  # fmt: skip
    parser.add_argument(
        "--min-entropy-bits", type=float, metavar="B", help="skip frames of less entropy, 0 to 8"
    )
    parser.add_argument(
        "--camera", metavar="CAMERA.toml", help="default: the input's own, else the map's"
    )
    parser.add_argument(
        "--rate-hz",
        type=float,
        metavar="R",
        help="of a folder of images (times that they are named by, or 30)",
    )
    parser.add_argument(
        "--smoothed", metavar="SMOOTHED.txt",
        help="also write the poses that the frames of the second after each helped to estimate",
    )  # fmt: skip
    parser.add_argument("--json", metavar="F", help="write figures to this file")
    parser.add_argument(
        "--observations",
        metavar="F",
        help="write which landmarks each frame saw where, for 'blimp map refine'",
    )
    parser.epilog = (
        "Example:\n"
        "  blimp localize flight.mcap --map maps/atrium --out out/est.txt --json out/est.json"
    )


def load_settings(args: argparse.Namespace) -> LocalizerSettings:
    """The settings the arguments ask for; raises `BlimpError` with one line."""
    from dataclasses import replace

    from ground_station.errors import check_options
    from ground_station.localization.settings import load_preset

    check_options(args, min_entropy_bits=(0, 8))
    settings = load_preset(args.preset)
    if args.min_entropy_bits is not None:
        gate = replace(settings.gate, min_entropy_bits=args.min_entropy_bits)
        settings = replace(settings, gate=gate)
    return settings


def run(args: argparse.Namespace) -> int:
    """Localizes every frame; 0, or 1 when none could be, or 130 after Ctrl-C (results written)."""
    from pathlib import Path

    from ground_station.errors import InputError
    from ground_station.files import check_outputs, write_json
    from ground_station.geometry.camera import load_camera
    from ground_station.geometry.resizing import for_pictures
    from ground_station.geometry.trajectory import read_tum
    from ground_station.localization.extraction import extractor_for
    from ground_station.localization.localizer import LocalizationError, Localizer
    from ground_station.localization.results import (
        flight_observations,
        summary,
        write_estimates,
        write_smoothed,
    )
    from ground_station.map import store
    from ground_station.map.observations import save_observations
    from ground_station.recording.look import look
    from ground_station.recording.open import open_input, parse_range

    settings = load_settings(args)
    initial = None if args.init == "none" else read_tum(args.init)
    if initial is None and not settings.recovery.relocalize:
        raise LocalizationError(
            f"the preset '{args.preset}' cannot find its first pose: --init TUM.txt is needed"
        )
    if args.smoothed and settings.pose.solver != "rolling":
        raise LocalizationError("--smoothed: only the solver 'rolling' has a smoother")
    check_outputs(args.out, args.json, args.observations, args.smoothed)
    source = open_input(args.input, args.rate_hz, parse_range(args.range) if args.range else None)
    map_ = store.load(args.map)
    if not map_.info.registered:
        _log(f"the map '{map_.info.name}' is not registered: poses are in its own frame and scale")
    camera = load_camera(args.camera) if args.camera else source.camera or map_.info.camera
    if args.camera or source.camera is None:
        first = look(source)
        camera, said = for_pictures(camera, first.size_px, first.display_deg, str(args.input))
        if said:
            _log(said)
    extractor = extractor_for(map_.info, settings.features)
    localizer = Localizer(map_, camera, extractor, settings, smoothing=bool(args.smoothed))
    if localizer.camera != camera:
        _log("the map's pictures denied this camera's lens: the one that they found is used")
        camera = localizer.camera
    estimates: list[PoseEstimate] = []
    smoothed: list[Kinematics] = []
    start_s = monotonic()
    interrupted = False
    try:
        _process(source, localizer, initial, estimates, smoothed)
    except KeyboardInterrupt:
        interrupted = True
    elapsed_s = monotonic() - start_s
    if not estimates and not interrupted:
        raise InputError(f"{args.input}: no frames in the range {args.range or ':'}")
    for note in source.notes:
        _log(note)
    write_estimates(args.out, estimates)
    if args.smoothed:
        write_smoothed(args.smoothed, smoothed + localizer.finish())
    if args.observations:
        seen = flight_observations(estimates, Path(args.input).resolve().stem, map_, camera)
        save_observations(args.observations, seen)
    if args.json:
        about = {
            "input": str(args.input),
            "map": map_.info.name,
            "frame": map_.info.frame,
            "preset": args.preset,
            "interrupted": interrupted,
        }
        write_json(args.json, about | summary(estimates, elapsed_s, settings))
    localized = sum(estimate.localized for estimate in estimates)
    gated = sum(estimate.gated for estimate in estimates)
    print(
        f"{len(estimates)} frames, {gated} gated, {localized} localized "
        f"({len(estimates) / max(elapsed_s, 1e-9):.1f} frames/s) -> {args.out}"
    )
    if interrupted:
        return 130
    return 0 if localized else 1


def _process(
    source: FrameSource,
    localizer: Localizer,
    initial: Any,
    estimates: list[PoseEstimate],
    smoothed: list[Kinematics],
) -> None:
    from ground_station.progress import Progress

    with Progress("localize", source.count()) as progress:
        for frame in source:
            if not estimates and initial is not None:
                nearest = initial.nearest(frame.time_ns)
                apart_s = abs(int(initial.time_ns[nearest]) - frame.time_ns) / 1e9
                if apart_s > _FAR_INIT_S:
                    _log(f"the first pose was taken {apart_s:.2f} s apart from the first frame")
                localizer.set_initial_pose(initial.wTc[nearest], frame.time_ns)
            estimates.append(
                localizer.process(frame.time_ns, frame.image, frame.index, frame.exposure_s)
            )
            smoothed += localizer.smoothed()
            progress.step()


def _log(text: str) -> None:
    print(f"blimp localize: {text}", file=sys.stderr)
