"""The payload's configuration; `payload.toml` beside this file is its commented form."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pi_firmware.wire import video
from pi_firmware.wire.config import apply_override, from_mapping, key, read, table
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.keys import check_payload_id
from pi_firmware.wire.telemetry import LOCAL_ENDPOINT, check_endpoint

WHITE_BALANCES = ("auto", "incandescent", "fluorescent", "daylight", "cloudy")
ENCODERS = ("x264enc", "v4l2h264enc")


@dataclass(frozen=True)
class CameraSettings:
    """Where frames come from."""

    uri: str = key("test:")
    width_px: int = key(640, unit="px", low=64, high=1920)
    height_px: int = key(480, unit="px", low=64, high=1088)
    rate_hz: float = key(30.0, unit="Hz", low=1, high=120)
    exposure_s: float = key(0.0, unit="s", low=0, high=1)
    gain: float = key(0.0, low=0, high=1000)
    white_balance: str = key("auto", choices=WHITE_BALANCES)
    focus_m: float = key(0.0, unit="m", low=0, high=1000)

    def __post_init__(self) -> None:
        for name in ("width_px", "height_px"):
            if getattr(self, name) % 2:
                raise ValueError(f"'camera.{name}' is {getattr(self, name)}; it must be even")


@dataclass(frozen=True)
class GateSettings:
    """Which frames are worth sending."""

    enabled: bool = key(True)
    min_entropy_bits: float = key(5.0, unit="bit", low=0, high=8)
    hysteresis_bits: float = key(0.2, unit="bit", low=0, high=2)
    min_sharpness_ratio: float = key(0.3, low=0, high=1)
    min_difference: float = key(0.5, unit="grey levels", low=0, high=255)
    heartbeat_s: float = key(1.0, unit="s", low=0, high=10)
    idr_after_s: float = key(0.5, unit="s", low=0, high=1)


@dataclass(frozen=True)
class EncoderSettings:
    """How frames become H.264."""

    name: str = key("x264enc", choices=ENCODERS)
    bitrate_kbps: int = key(2000, unit="kbit/s", low=100, high=20_000)
    min_bitrate_kbps: int = key(300, unit="kbit/s", low=50, high=20_000)
    adapt: bool = key(True)
    max_queue_s: float = key(0.06, unit="s", low=0.01, high=5)
    max_round_trip_s: float = key(0.3, unit="s", low=0.01, high=10)
    gop_frames: int = key(15, unit="frames", low=1, high=120)
    min_gop_frames: int = key(10, unit="frames", low=1, high=120)

    def __post_init__(self) -> None:
        if self.min_bitrate_kbps > self.bitrate_kbps:
            raise ValueError(
                f"'encoder.min_bitrate_kbps' is {self.min_bitrate_kbps}; it must not be above"
                f" 'encoder.bitrate_kbps', {self.bitrate_kbps}"
            )


@dataclass(frozen=True)
class LinkSettings:
    """Where the video goes."""

    host: str = key("127.0.0.1")
    port: int = key(video.PORT, low=1, high=65535)
    ssrc: int = key(0, low=0, high=0xFFFFFFFF)
    mtu_bytes: int = key(1400, unit="bytes", low=200, high=8900)
    history_s: float = key(1.5, unit="s", low=0, high=5)
    correction: float = key(1.0, low=0, high=1)
    assumed_loss: float = key(0.0, low=0, high=0.5)
    encrypted: bool = key(True)


@dataclass(frozen=True)
class BatterySettings:
    """The gauge."""

    uri: str = key("fake:")
    period_s: float = key(1.0, unit="s", low=0.1, high=60)
    capacity_mAh: float = key(600.0, unit="mAh", low=50, high=20_000)
    full_V: float = key(4.2, unit="V", low=4.0, high=4.45)
    resistance_mohm: float = key(0.0, unit="mohm", low=0, high=2000)
    temperature_C: float = key(20.0, unit="C", low=-20, high=60)
    low_percentage: float = key(0.25, low=0, high=1)
    low_bitrate_kbps: int = key(600, unit="kbit/s", low=100, high=20_000)
    critical_percentage: float = key(0.05, low=0, high=0.5)
    critical_V: float = key(3.3, unit="V", low=2.8, high=3.8)
    confirm_readings: int = key(3, low=1, high=60)
    shutdown_command: list[str] = key([])

    def __post_init__(self) -> None:
        if self.critical_percentage >= self.low_percentage:
            raise ValueError(
                f"'battery.critical_percentage' is {self.critical_percentage:g}; it must be below"
                f" 'battery.low_percentage', {self.low_percentage:g}"
            )


@dataclass(frozen=True)
class AutopilotSettings:
    """Who is told the poses, and how the camera sits."""

    uri: str = key("off:")
    period_s: float = key(1.0, unit="s", low=0.1, high=60)
    max_age_s: float = key(0.5, unit="s", low=0.05, high=5)
    world_heading_deg: float = key(0.0, unit="degrees", low=-360, high=360)
    mount_roll_deg: float = key(0.0, unit="degrees", low=-180, high=180)
    mount_pitch_deg: float = key(0.0, unit="degrees", low=-180, high=180)
    mount_yaw_deg: float = key(0.0, unit="degrees", low=-180, high=180)
    mount_m: list[float] = key([0.0, 0.0, 0.0], unit="m")
    jump_m: float = key(0.5, unit="m", low=0.01, high=100)
    jump_deg: float = key(20.0, unit="degrees", low=1, high=180)

    def __post_init__(self) -> None:
        if len(self.mount_m) != 3 or max(map(abs, self.mount_m)) > 10:
            raise ValueError(
                f"'autopilot.mount_m' is {self.mount_m}; expected three numbers of -10 to 10 m"
            )


@dataclass(frozen=True)
class RecordingSettings:
    """What stays on the payload's own card."""

    folder: str = key("")
    at_start: bool = key(False)
    max_file_MB: int = key(512, unit="MB", low=1, high=4000)
    max_total_MB: int = key(4096, unit="MB", low=1, high=1_000_000)
    min_free_MB: int = key(512, unit="MB", low=0, high=1_000_000)
    sync_s: float = key(1.0, unit="s", low=0.1, high=60)


@dataclass(frozen=True)
class WifiSettings:
    """The radio."""

    interface: str = key("")
    restart_after_s: float = key(20.0, unit="s", low=0, high=3600)


@dataclass(frozen=True)
class SupervisionSettings:
    """What happens when frames stop coming."""

    period_s: float = key(1.0, unit="s", low=0.2, high=60)
    frame_timeout_s: float = key(2.0, unit="s", low=0.5, high=14)
    restarts: int = key(5, low=1, high=100)
    process_restarts: int = key(3, low=1, high=100)
    state: str = key("")
    reboot_command: list[str] = key([])


@dataclass(frozen=True)
class TelemetrySettings:
    """Zenoh."""

    enabled: bool = key(True)
    connect: list[str] = key([LOCAL_ENDPOINT])
    listen: list[str] = key([])
    certificates: str = key("")
    discover: str = key("")

    def __post_init__(self) -> None:
        for name in ("connect", "listen"):
            for endpoint in getattr(self, name):
                try:
                    check_endpoint(endpoint, certified=bool(self.certificates))
                except TelemetryError as error:
                    raise ValueError(f"'telemetry.{name}': {error}") from None


@dataclass(frozen=True)
class Settings:
    """All of `payload.toml`."""

    payload_id: str = key("blimp-1")
    camera: CameraSettings = table(CameraSettings)
    gate: GateSettings = table(GateSettings)
    encoder: EncoderSettings = table(EncoderSettings)
    link: LinkSettings = table(LinkSettings)
    battery: BatterySettings = table(BatterySettings)
    autopilot: AutopilotSettings = table(AutopilotSettings)
    recording: RecordingSettings = table(RecordingSettings)
    wifi: WifiSettings = table(WifiSettings)
    supervision: SupervisionSettings = table(SupervisionSettings)
    telemetry: TelemetrySettings = table(TelemetrySettings)

    def __post_init__(self) -> None:
        try:
            check_payload_id(self.payload_id)
        except TelemetryError as error:
            raise ValueError(str(error)) from None


def load(path: Path | None, overrides: Iterable[str] = ()) -> Settings:
    """The settings from a file (the defaults without one) with `key.sub=value` on top of it.

    Raises `ConfigError` with one line.
    """
    document = {} if path is None else read(path)
    for override in overrides:
        apply_override(document, override, Settings)
    return from_mapping(document, Settings, where=str(path or "defaults"))
