"""A recorded flight through the real firmware, the real link and the localizer."""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tomli_w

from ground_station.errors import InputError
from ground_station.evaluation import ate
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory, read_tum, write_tum
from ground_station.localization import results
from ground_station.localization.settings import LocalizerSettings
from ground_station.map import store
from ground_station.progress import Progress
from ground_station.recording.flight import camera_of, trajectory_of
from ground_station.replay import live
from ground_station.replay.resources import Side, Watch
from ground_station.replay.rig import LOOPBACK, Rig
from ground_station.replay.station import station
from ground_station.service.localizing.maps import settings_of
from ground_station.service.settings import Run, StationSettings
from pi_firmware.wire import config
from pi_firmware.wire.recording import TRUTH_TOPIC, RecordingReader

_AHEAD = 4
"""Frames of a stepped flight that are on their way at a time: payload and localizer overlap."""


@dataclass(frozen=True)
class ReplaySettings:
    """What is replayed, and how."""

    recording: Path
    rate_hz: float
    preset: str
    init: str
    """`truth`: the recording's true pose of the first frame; `none`; or a TUM file."""
    start_s: float = 0.0
    duration_s: float = 0.0
    """0: to the end."""
    gate_min_entropy_bits: float | None = None
    """None: the payload's own default."""
    bitrate_kbps: int = 2000
    pictures: int = 4
    """How many frames are kept with their matches, for the report."""
    stepped: bool = False
    """Each frame as soon as there is room, and no clock decides what becomes of it: the same poses,
    bit for bit, however fast the machine. False: in real time, as the service takes them."""
    payload: tuple[str, ...] = ()
    """More of the firmware's settings, each "key=value" as `--set` takes them."""


_THESIS = {"rate_hz": 5.0, "init": "truth", "gate_min_entropy_bits": 7.0}
"""What the thesis's localizer can follow on two cores, a start that it needs, and its threshold."""


def settings_for(preset: str, recording: Path, **options: Any) -> ReplaySettings:
    """The settings of a replay; of `options` that are None the preset decides."""
    usual: dict[str, Any] = _THESIS if preset == "thesis" else {"rate_hz": 30.0, "init": "none"}
    given = {name: value for name, value in options.items() if value is not None}
    return ReplaySettings(recording=recording, preset=preset, **(usual | given))


@dataclass(frozen=True)
class ReplayResult:
    """The flight, what it took, and its errors against the recording's truth when it has one."""

    settings: ReplaySettings
    localizer: LocalizerSettings
    camera: Camera
    live: live.LiveResult
    truth: Trajectory | None
    evaluation: ate.Evaluation | None
    ground_side: Side
    payload_side: Side | None
    """None where the firmware ran on another machine."""

    def document(self) -> dict[str, Any]:
        """The result as results.json holds it."""
        latency = self.live.latency_ms()
        times = sorted(frame.estimate.time_ns for frame in self.live.frames)
        span_s = (times[-1] - times[0]) / 1e9 if len(times) > 1 else 0.0
        estimates = [frame.estimate for frame in self.live.frames]
        return {
            "recording": self.settings.recording.name,
            "preset": self.settings.preset,
            "init": self.settings.init,
            **results.summary(estimates, span_s, self.localizer),
            "frames": self.live.accounts(),
            "complete": self.live.complete,
            "ate": self.evaluation.ate() if self.evaluation else None,
            "shares": ate.shares(self.evaluation.errors["none"]) if self.evaluation else None,
            "latency_ms": results.percentiles(latency.tolist()),
            "clock_offset": self.live.clock,
            "rate_hz": (len(times) - 1) / span_s if span_s > 0 else 0.0,
            "stream": self.live.payload.stream,
        }


def replay(map_: store.Map, settings: ReplaySettings, rig: Rig = LOOPBACK) -> ReplayResult:
    """Starts the firmware on the recording, and the service's intake and localizer on its stream.

    All are processes of their own. The map is read from its folder. Raises a `BlimpError` with one
    line for a recording without a camera, a map that is not registered or of other features, a
    firmware that fails, or a stream that does not come.
    """
    reader = RecordingReader(settings.recording)
    camera = camera_of(reader)
    if camera is None:
        raise InputError(f"{settings.recording}: it carries no camera calibration")
    truth = trajectory_of(settings.recording) if TRUTH_TOPIC in reader.topics() else None
    start = first_pose(settings.init, truth)
    expected = _expected_frames(reader, settings)
    every = max(1, expected // settings.pictures)
    payload_side = None
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="blimp-replay-")))
        run = _run(settings, rig, map_, camera, start, folder)
        ground = stack.enter_context(station(run, rig.payload_id))
        inbox = live.Inbox(ground, rig.payload_id, lambda k: k % every == every // 2)
        port = stack.enter_context(rig.link(ground.video_port))
        config = _payload_config(settings, camera, port, ground.endpoints, rig.payload_id)
        firmware = stack.enter_context(rig.payload(config, folder))
        pid = firmware.pid()
        watch = None if pid is None else stack.enter_context(Watch(pid))
        progress = stack.enter_context(Progress("live, frames", expected))
        result = live.run(
            ground,
            inbox,
            firmware,
            start_timeout_s=rig.start_timeout_s,
            on_first_frame=rig.on_first_frame,
            on_frame=lambda: progress.step(),
        )
        ground_side, payload_side = ground.side(), watch.side() if watch else None
    for event in result.events:
        if event.source == "payload" and event.name not in ("started", "end-of-stream"):
            print(f"payload: {event.text}", file=sys.stderr)
    estimate = results.trajectory([frame.estimate for frame in result.frames])
    evaluation = None
    if truth is not None and len(estimate):
        evaluation = ate.evaluate(estimate, truth)
    return ReplayResult(
        settings, settings_of(run), camera, result, truth, evaluation, ground_side, payload_side
    )


def _run(
    settings: ReplaySettings,
    rig: Rig,
    map_: store.Map,
    camera: Camera,
    start: Trajectory | None,
    folder: Path,
) -> Run:
    """The service's settings for this flight; what it reads lies in `folder`."""
    if map_.folder is None:
        raise InputError(f"{map_.info.name}: the map lies in no folder that a process could read")
    camera_file, start_file = folder / "camera.toml", folder / "start.txt"
    camera_file.write_bytes(tomli_w.dumps(camera.as_dict()).encode())
    if start is not None:
        write_tum(start_file, start)
    # A replay writes no recording of the ground's: the flight is one already.
    station_ = {
        "map": {"folder": str(map_.folder.resolve()), "camera": str(camera_file)},
        "payloads": {"ids": [rig.payload_id]},
        "video": asdict(rig.video),
        "telemetry": asdict(rig.telemetry),
        "localizer": {"preset": settings.preset},
        "recording": {"folder": str(folder / "recordings")},
    }
    return Run(
        config.from_mapping(station_, StationSettings, where="replay"),
        started_ns=time.time_ns(),
        stepped=settings.stepped,
        start=str(start_file) if start is not None else "",
        landmarks=True,
    )


def first_pose(init: str, truth: Trajectory | None) -> Trajectory | None:
    """Where the first frame's pose comes from; None for `none`. Raises `InputError`."""
    if init == "none":
        return None
    if init != "truth":
        return read_tum(init)
    if truth is None:
        raise InputError("--init truth: the recording has no true poses; give a TUM file or none")
    return truth


def _expected_frames(reader: RecordingReader, settings: ReplaySettings) -> int:
    times = [sample.time_ns for sample in reader.video()]
    span_s = (times[-1] - times[0]) / 1e9 - settings.start_s if times else 0.0
    if settings.duration_s:
        span_s = min(span_s, settings.duration_s)
    return max(1, round(span_s * settings.rate_hz))


def _payload_config(
    settings: ReplaySettings,
    camera: Camera,
    port: int,
    endpoints: tuple[str, ...],
    payload_id: str,
) -> dict[str, Any]:
    options = [f"rate_hz={settings.rate_hz:g}"]
    if settings.start_s:
        options.append(f"start_s={settings.start_s:g}")
    if settings.duration_s:
        options.append(f"duration_s={settings.duration_s:g}")
    if settings.stepped:
        options += ["pace=stepped", "max_hz=1000", f"ahead={_AHEAD}"]
    path = settings.recording.resolve()
    gate: dict[str, float] = {}
    if settings.preset == "thesis":  # its gate knows entropy only
        gate = {"min_sharpness_ratio": 0.0, "min_difference": 0.0}
    if settings.gate_min_entropy_bits is not None:
        gate["min_entropy_bits"] = settings.gate_min_entropy_bits
    document: dict[str, Any] = {
        "payload_id": payload_id,
        "camera": {
            "uri": f"replay:{path}?{'&'.join(options)}",
            "width_px": camera.width_px,
            "height_px": camera.height_px,
        },
        "gate": gate,
        # Loopback loses nothing, and the round trips of a busy machine are no radio's.
        "encoder": {"bitrate_kbps": settings.bitrate_kbps, "adapt": False},
        "link": {"port": port},
        "telemetry": {"connect": list(endpoints)},
        # A busy machine is no hanging encoder, and its radio is not the payload's to restart.
        "supervision": {"frame_timeout_s": 14.0},
        "wifi": {"interface": ""},
    }
    for setting in settings.payload:
        config.apply_override(document, setting)
    return document
