"""A recorded flight through the real firmware, the real link and the localizer."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2

from ground_station.errors import InputError
from ground_station.evaluation import ate
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization import results
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import LocalizerSettings, for_live
from ground_station.map import store
from ground_station.progress import Progress
from ground_station.recording.flight import camera_of, trajectory_of
from ground_station.replay import live
from ground_station.replay.rig import LOOPBACK, Rig
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
    queue_frames: int = 4
    """Frames that may wait for the localizer before the oldest is dropped and counted."""
    pictures: int = 4
    """How many frames are kept with their matches, for the report."""
    stepped: bool = False
    """Each frame as soon as there is room, and no clock decides what becomes of it: the same poses,
    bit for bit, however fast the machine. False: in real time."""
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
    """The session, and its errors against the recording's truth when it has one."""

    settings: ReplaySettings
    localizer: LocalizerSettings
    camera: Camera
    live: live.LiveResult
    truth: Trajectory | None
    evaluation: ate.Evaluation | None

    @property
    def estimate(self) -> Trajectory:
        """The localized frames' poses, by capture time."""
        return results.trajectory([frame.estimate for frame in self.live.frames])

    def document(self) -> dict[str, Any]:
        """The result as results.json holds it."""
        latency = self.live.latency_ms()
        times = sorted(frame.estimate.time_ns for frame in self.live.frames)
        span_s = (times[-1] - times[0]) / 1e9 if len(times) > 1 else 0.0
        within = None
        if self.evaluation is not None and "none" in self.evaluation.errors:
            shares = ate.shares(self.evaluation.errors["none"])
            within = [
                {"position_m": m, "rotation_deg": deg, "share": share}
                for (m, deg), share in zip(ate.THRESHOLDS, shares, strict=True)
            ]
        estimates = [frame.estimate for frame in self.live.frames]
        return {
            "recording": self.settings.recording.name,
            "preset": self.settings.preset,
            "init": self.settings.init,
            **results.summary(estimates, span_s, self.localizer),
            "frames": self.live.accounts(),
            "complete": self.live.complete,
            "ate": self.evaluation.ate() if self.evaluation else None,
            "shares": within,
            "latency_ms": results.percentiles(latency.tolist()),
            "clock_offset": self.live.clock_offset(),
            "rate_hz": (len(times) - 1) / span_s if span_s > 0 else 0.0,
            "stream": asdict(self.live.stream),
        }


def replay(
    map_: store.Map,
    localizer_settings: LocalizerSettings,
    settings: ReplaySettings,
    stand: Rig = LOOPBACK,
) -> ReplayResult:
    """Starts the firmware on the recording as its own process and localizes what it streams.

    Raises a `BlimpError` with one line for a recording without a camera, a map
    of other features, a firmware that fails, or a stream that does not come.
    """
    reader = RecordingReader(settings.recording)
    camera = camera_of(reader)
    if camera is None:
        raise InputError(f"{settings.recording}: it carries no camera calibration")
    extract = extractor_for(map_.info, localizer_settings.features)
    if not settings.stepped:
        localizer_settings = for_live(localizer_settings)
    localizer = Localizer(map_, camera, extract, localizer_settings)
    truth = None
    if TRUTH_TOPIC in reader.topics():
        truth = trajectory_of(settings.recording)
    start = first_pose(settings.init, truth)
    expected = _expected_frames(reader, settings)
    every = max(1, expected // settings.pictures)

    def set_start(time_ns: int) -> None:
        if start is not None:
            localizer.set_initial_pose(start.at(time_ns), time_ns)

    with (
        _threads_as_in_the_service(),
        tempfile.TemporaryDirectory(prefix="blimp-replay-") as folder,
        stand.receiver(_AHEAD + 2 if settings.stepped else settings.queue_frames) as receiver,
        stand.telemetry() as telemetry,
        stand.link(receiver.port) as port,
        stand.payload(
            _payload_config(settings, camera, port, telemetry.endpoints, stand.payload_id),
            Path(folder),
        ) as firmware,
        Progress("live, frames", expected) as progress,
    ):
        result = live.run(
            receiver,
            telemetry,
            stand.payload_id,
            localizer,
            check=firmware.check,
            running=firmware.running,
            start_timeout_s=stand.start_timeout_s,
            on_start=set_start,
            keep_picture=lambda frame: frame.sequence % every == every // 2,
            on_frame=lambda frame: progress.step(),
            repeat=settings.stepped,
        )
    for event in result.events:
        if event.name not in ("started", "end-of-stream"):
            print(f"payload: {event.text}", file=sys.stderr)
    done = ReplayResult(settings, localizer_settings, camera, result, truth, None)
    evaluation = None
    if truth is not None and map_.info.registered and len(done.estimate):
        evaluation = ate.evaluate(done.estimate, truth)
    return ReplayResult(settings, localizer_settings, camera, result, truth, evaluation)


@contextlib.contextmanager
def _threads_as_in_the_service() -> Iterator[None]:
    """OpenCV's own threads would wait for the core on which the keyframes are described."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def first_pose(init: str, truth: Trajectory | None) -> Trajectory | None:
    """Where the first frame's pose comes from; None for `none`. Raises `InputError`."""
    from ground_station.geometry.trajectory import read_tum

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
