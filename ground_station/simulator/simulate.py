"""A simulated flight: from its settings to a recording with the true pose of every frame."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, F64, I64
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory, write_tum
from ground_station.progress import stop_noted
from ground_station.recording.flight import write_camera
from ground_station.recording.h264 import H264Encoder
from ground_station.simulator import board, dynamics, handheld, people, scenes
from ground_station.simulator.imaging import (
    AutoExposure,
    FrameMaker,
    Sensor,
    covering_pinhole,
    row_offsets_s,
)
from ground_station.simulator.known_points import choose_observations, write_pairs
from ground_station.simulator.lighting import light_named, lit_scene
from ground_station.simulator.motion import Motion
from ground_station.simulator.plans import Plan, Reference, plan_named
from ground_station.simulator.processing import PROCESSINGS
from ground_station.simulator.rendering import SceneRenderer
from ground_station.simulator.scene import Scene, SimulatorError
from ground_station.simulator.unsteady import unsteady
from pi_firmware.wire import files
from pi_firmware.wire.errors import os_errors_as
from pi_firmware.wire.recording import FRAME_INFO_TOPIC, TRUTH_TOPIC, RecordingWriter

FIRST_FRAME_S = 1.0
"""Capture time of the first frame, seconds after the payload's (simulated) boot at 0."""

_RUN_UP_S = 3.0  # a runner's way from rest to full speed

_UNSTEADY = ("exposure_steps", "light_steps", "flicker", "longest_exposure_s")

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SimulationSettings:
    """What to fly. `bitrate_kbps` replaces `crf`; what is None is the plan's own.

    `camera` takes the pictures; the recording carries one whose focal lengths are off by the share
    `lens_error`, as a calibration of another day is.

    `build` is one of `hw/builds.toml`; None: the one that `simulated` there names. `draught_m_s` is
    the deviation of the air's speed along each axis; None: that of a quiet hall.

    `exposure_steps`, `light_steps` and `flicker` are as `unsteady` reads them; with a
    `longest_exposure_s` gain does what time may not, as against motion blur. So many `people` walk
    back and forth.

    `processing` is what the camera does to its pictures: "none", a perfect sensor's but for noise,
    or "camera", a mosaic of colours that is demosaiced, denoised and sharpened.
    """

    out: Path
    scene: str = "atrium"
    plan: str = "loop"
    light: str = "noon"
    seed: int = 0
    duration_s: float | None = None
    rate_hz: float | None = None
    crf: float = 20.0
    bitrate_kbps: int | None = None
    truth: Path | None = None
    points: Path | None = None
    texels_per_m: float = 150.0
    supersampling: float = 1.25
    renders: int = 2
    camera: Camera | None = None
    lens_error: float = 0.0
    build: str | None = None
    draught_m_s: float | None = None
    exposure_steps: str = ""
    light_steps: str = ""
    flicker: float = 0.0
    longest_exposure_s: float | None = None
    people: int = 0
    processing: str = "none"

    def __post_init__(self) -> None:
        limits = {
            "seed": (0, 2**63 - 1),
            "rate_hz": (0.1, 120.0),
            "crf": (0.0, 51.0),
            "supersampling": (0.25, 3.0),
            "renders": (1, 8),
            "lens_error": (-0.2, 0.2),
            "longest_exposure_s": (2e-4, 1 / 60),
            "draught_m_s": (0.0, 2.0),
            "bitrate_kbps": (10, 100_000),
            "people": (0, people.MOST),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise SimulatorError(f"{name} is {value}; allowed: {low:g} to {high:g}")
        light_named(self.light)
        if self.processing not in PROCESSINGS:
            known = ", ".join(PROCESSINGS)
            raise SimulatorError(f"processing '{self.processing}' is unknown; there are: {known}")
        if self.duration_s is not None and not 0 < self.duration_s <= 3600:
            raise SimulatorError(f"duration_s is {self.duration_s:g}; allowed: above 0 to 3600")
        unsteady(self.exposure_steps, self.light_steps, self.flicker)


@dataclass(frozen=True)
class SimulationResult:
    """What was written. `frame_s` is the mean time a frame took to make and encode, seconds."""

    out: str
    scene: str
    plan: str
    light: str
    seed: int
    frames: int
    duration_s: float
    rate_hz: float
    bytes: int
    setup_s: float
    frame_s: float
    interrupted: bool
    observations: int
    max_speed_m_s: float
    max_turn_deg_s: float


@dataclass(frozen=True)
class SimulatedFlight:
    """A plan in motion and the times of its frames, seconds on the motion's clock.

    `camera` takes the frames, `carried` is the one that the recording names.
    """

    scene: Scene
    plan: Plan
    motion: Motion
    rate_hz: float
    camera: Camera
    carried: Camera
    times_s: F64
    noise: np.random.Generator
    clicks: np.random.Generator
    crowd: np.random.Generator


def prepare_flight(settings: SimulationSettings) -> SimulatedFlight:
    """Scene, plan and motion from the settings and their seed; raises `SimulatorError`."""
    scene = scenes.build(settings.scene, settings.texels_per_m)
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(settings.seed).spawn(5)]
    path, air, noise, clicks, crowd = streams
    plan = plan_named(settings.plan, scene, path)
    duration = settings.duration_s or plan.default_duration_s
    rate_hz = settings.rate_hz or plan.rate_hz
    count = max(1, round(duration * rate_hz))
    if plan.stands:  # none is taken twice; all of them, at whatever rate, unless some are asked for
        count = min(count, plan.stands) if settings.duration_s else plan.stands
    times_s = np.arange(count) / rate_hz
    phase = float(path.random())
    camera = settings.camera or plan.camera
    if plan.by_hand:
        if settings.build is not None:
            raise SimulatorError(f"build is {settings.build!r}; plan {settings.plan!r} flies none")
        if settings.draught_m_s is not None:
            raise SimulatorError(f"draught_m_s is for a blimp; plan {settings.plan!r} is by hand")
        if plan.stands:
            motion = handheld.hold(plan, times_s, air)
        elif plan.name == "board":
            motion = board.carry_about(camera, duration, air)
        else:
            reference = Reference(plan, phase, _RUN_UP_S)
            motion = handheld.carry(reference, duration, air, plan.bearer)
    else:
        blimp = dynamics.Blimp.of_build(settings.build)
        if settings.draught_m_s is not None:
            blimp = replace(blimp, draught_m_s=settings.draught_m_s)
        motion = dynamics.fly(Reference(plan, phase), duration, air, blimp)
    wrong = 1 + settings.lens_error
    carried = replace(camera, fx_px=camera.fx_px * wrong, fy_px=camera.fy_px * wrong)
    return SimulatedFlight(
        scene, plan, motion, rate_hz, camera, carried, times_s, noise, clicks, crowd
    )


def time_ns_of(times_s: npt.ArrayLike) -> I64:
    """Capture times of frames from the motion's clock, integer nanoseconds."""
    return np.rint((np.asarray(times_s) + FIRST_FRAME_S) * 1e9).astype(np.int64)


@contextmanager
def _recording(path: Path) -> Iterator[RecordingWriter]:
    """A recording written beside and renamed when it is closed properly."""
    with os_errors_as(path.parent, SimulatorError):
        path.parent.mkdir(parents=True, exist_ok=True)
    with files.replacing(path) as part, RecordingWriter(part) as writer:
        yield writer


def simulate(settings: SimulationSettings, progress: Progress | None = None) -> SimulationResult:
    """Flies, takes the frames and writes the recording; `progress` gets (frames done, all).

    An interrupt (Ctrl-C) ends the flight early: what was taken until then is written whole, and
    the result says so. Raises `SimulatorError`.
    """
    started = time.monotonic()
    flight = prepare_flight(settings)
    camera, sensor = flight.camera, Sensor()
    if settings.longest_exposure_s is not None:
        limits_s = (sensor.exposure_limits_s[0], settings.longest_exposure_s)
        sensor = replace(sensor, exposure_limits_s=limits_s)
    _, lit = lit_scene(settings.scene, settings.texels_per_m, settings.light)
    pinhole = covering_pinhole(camera, settings.supersampling)
    buffer = (pinhole.width_px, pinhole.height_px)
    level = float(np.median([np.median(texture) for texture in lit.textures]))
    walkers = people.walkers(flight.scene, settings.people, level, flight.crowd)
    surfaces = flight.scene.surfaces
    with SceneRenderer(surfaces, lit.textures, buffer, walkers=walkers) as renderer:
        maker = FrameMaker(
            renderer, lit.decoder(), camera, pinhole, sensor=sensor, renders=settings.renders,
            processed=settings.processing,
        )  # fmt: skip
        setup_s = time.monotonic() - started
        taken, interrupted = _record(settings, flight, maker, progress)
        frame_s = (time.monotonic() - started - setup_s) / max(taken, 1)
        times = flight.times_s[:taken]
        observations = []
        if settings.points is not None:
            observations = choose_observations(
                renderer, pinhole, camera, flight.motion, times, flight.scene.known_points,
                flight.clicks,
            )  # fmt: skip
            write_pairs(settings.points, observations)
    if settings.truth is not None:
        wTc = flight.motion.wTc(times)
        write_tum(settings.truth, Trajectory.from_poses(time_ns_of(times), wTc))
    speed, turn = flight.motion.speed(times)
    return SimulationResult(
        out=str(settings.out), scene=settings.scene, plan=settings.plan, light=settings.light,
        seed=settings.seed, frames=taken, duration_s=round(taken / flight.rate_hz, 6),
        rate_hz=flight.rate_hz, bytes=settings.out.stat().st_size, setup_s=round(setup_s, 3),
        frame_s=round(frame_s, 4), interrupted=interrupted, observations=len(observations),
        max_speed_m_s=round(float(speed.max(initial=0)), 3),
        max_turn_deg_s=round(math.degrees(float(turn.max(initial=0))), 2),
    )  # fmt: skip


def _record(
    settings: SimulationSettings,
    flight: SimulatedFlight,
    maker: FrameMaker,
    progress: Progress | None,
) -> tuple[int, bool]:
    """Takes and writes all frames; returns their number and whether it was interrupted."""
    camera, motion, times = flight.camera, flight.motion, flight.times_s
    stamps = time_ns_of(times).tolist()
    encoder = H264Encoder(
        camera.width_px, camera.height_px, flight.rate_hz,
        crf=settings.crf, bitrate_kbps=settings.bitrate_kbps,
    )  # fmt: skip
    changes = unsteady(settings.exposure_steps, settings.light_steps, settings.flicker)
    rows_s = row_offsets_s(camera)

    def seen(t: float, exposure_s: float) -> F32:
        radiance = maker.radiance(motion, t, exposure_s)
        if not changes.lit_evenly:
            light = changes.row_light(t + rows_s, exposure_s)
            radiance *= light.astype(np.float32)[:, None, None]
        return radiance

    taken = 0
    with _recording(settings.out) as writer, stop_noted(signal.SIGINT) as interrupted:
        _write_head(writer, settings, flight, stamps[0])
        exposure = AutoExposure(maker.sensor, seen(float(times[0]), 0.0))
        for k, t in enumerate(times.tolist()):
            if flight.plan.stands:  # held until the exposure has settled
                exposure = AutoExposure(maker.sensor, seen(t, 0.0))
            exposure.off_ev = float(changes.exposure_ev.at(t))
            exposure_s, gain = exposure.settings
            radiance = seen(t, exposure_s)
            picture = maker.expose(radiance, exposure_s, gain, flight.noise)
            exposure.update(radiance, 1 / flight.rate_hz)
            pose = motion.wTc([t])[0]
            writer.write_pose(
                stamps[k], pose[:3, 3].tolist(), poses.to_quaternion(pose).tolist(),
                topic=TRUTH_TOPIC,
            )  # fmt: skip
            info = {"sequence": k, "exposure_s": exposure_s, "gain": gain}
            writer.write_json(FRAME_INFO_TOPIC, stamps[k], info, schema_name="blimp.Frame")
            for index, data in encoder.encode(picture):
                writer.write_video(stamps[index], data)
            taken = k + 1
            if progress is not None:
                progress(taken, len(times))
            if interrupted[0]:
                break
        for index, data in encoder.finish():
            writer.write_video(stamps[index], data)
        end = {"frames": str(taken), "interrupted": str(interrupted[0]).lower()}
        writer.write_metadata("simulation_end", end)
    return taken, interrupted[0]


def _write_head(
    writer: RecordingWriter, settings: SimulationSettings, flight: SimulatedFlight, first_ns: int
) -> None:
    camera = flight.carried
    write_camera(writer, camera, first_ns)
    writer.write_metadata(
        "simulation",
        {
            "seed": str(settings.seed),
            "scene": settings.scene,
            "plan": settings.plan,
            "light": settings.light,
            "rate_hz": f"{flight.rate_hz:g}",
            "duration_s": f"{len(flight.times_s) / flight.rate_hz:g}",
            "version": metadata.version("blimp-localization"),
            # The one that is flown without being asked for is not named, as ever.
            **({"build": settings.build} if settings.build else {}),
            **(
                {"draught_m_s": f"{settings.draught_m_s:g}"}
                if settings.draught_m_s is not None
                else {}
            ),
            **({"people": str(settings.people)} if settings.people else {}),
            **({"processing": settings.processing} if settings.processing != "none" else {}),
            **({"lens_error": f"{settings.lens_error:g}"} if settings.lens_error else {}),
            **{name: str(value) for name in _UNSTEADY if (value := getattr(settings, name))},
        },
    )
    if settings.lens_error:
        taken_with = {k: str(v) for k, v in flight.camera.as_dict().items()}
        writer.write_metadata("true_camera", taken_with)
