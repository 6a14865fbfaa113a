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

    uri: str = key("test:", "source: libcamera:, v4l2:DEVICE, replay:FLIGHT.mcap, test:")
    width_px: int = key(640, "picture width", unit="px", low=64, high=1920)
    height_px: int = key(480, "picture height", unit="px", low=64, high=1088)
    rate_hz: float = key(30.0, "frames captured a second", unit="Hz", low=1, high=120)
    exposure_s: float = key(0.0, "fixed exposure; 0: automatic", unit="s", low=0, high=1)
    gain: float = key(0.0, "fixed gain; 0: automatic", low=0, high=1000)
    white_balance: str = key("auto", "for which light", choices=WHITE_BALANCES)
    focus_m: float = key(0.0, "fixed focus; 0: the camera's", unit="m", low=0, high=1000)

    def __post_init__(self) -> None:
        for name in ("width_px", "height_px"):
            if getattr(self, name) % 2:
                raise ValueError(f"'camera.{name}' is {getattr(self, name)}; it must be even")


@dataclass(frozen=True)
class GateSettings:
    """Which frames are worth sending."""

    enabled: bool = key(True, "false sends every frame, measured all the same")
    min_entropy_bits: float = key(
        5.0, "frames with less entropy in their luma are not sent", unit="bit", low=0, high=8
    )
    hysteresis_bits: float = key(
        0.2, "a gated stretch ends this much above the threshold", unit="bit", low=0, high=2
    )
    min_sharpness_ratio: float = key(
        0.3, "gated below this share of the last 2 s' gradient energy; 0: none", low=0, high=1
    )
    min_difference: float = key(
        0.5, "gated when closer to the last one sent; 0: none", unit="grey levels", low=0, high=255
    )
    heartbeat_s: float = key(
        1.0, "while all is gated, one frame is sent this often; 0: none", unit="s", low=0, high=10
    )
    idr_after_s: float = key(
        0.5, "after a gap this long an IDR comes first", unit="s", low=0, high=1
    )


@dataclass(frozen=True)
class EncoderSettings:
    """How frames become H.264."""

    name: str = key("x264enc", "GStreamer's encoder element", choices=ENCODERS)
    bitrate_kbps: int = key(2000, "target bit rate", unit="kbit/s", low=100, high=20_000)
    min_bitrate_kbps: int = key(300, "the least it adapts to", unit="kbit/s", low=50, high=20_000)
    adapt: bool = key(True, "bit rate and IDR interval follow what the ground reports")
    max_queue_s: float = key(
        0.06, "a longer queue on the link lowers the bit rate", unit="s", low=0.01, high=5
    )
    max_round_trip_s: float = key(
        0.3, "so does this round trip, where no queue is told", unit="s", low=0.01, high=10
    )
    gop_frames: int = key(15, "frames from IDR to IDR, at most 1 s", unit="frames", low=1, high=120)
    min_gop_frames: int = key(10, "the same at 5 % loss and more", unit="frames", low=1, high=120)

    def __post_init__(self) -> None:
        if self.min_bitrate_kbps > self.bitrate_kbps:
            raise ValueError(
                f"'encoder.min_bitrate_kbps' is {self.min_bitrate_kbps}; it must not be above"
                f" 'encoder.bitrate_kbps', {self.bitrate_kbps}"
            )


@dataclass(frozen=True)
class LinkSettings:
    """Where the video goes."""

    host: str = key("127.0.0.1", "the ground station's address; auto: the one telemetry found")
    port: int = key(video.PORT, "its UDP port", low=1, high=65535)
    ssrc: int = key(0, "RTP stream id; 0 draws one at random", low=0, high=0xFFFFFFFF)
    mtu_bytes: int = key(1400, "largest RTP packet", unit="bytes", low=200, high=8900)
    history_s: float = key(
        1.5, "how long a packet can be sent again, as lost; 0: never", unit="s", low=0, high=5
    )
    correction: float = key(
        1.0, "packets of forward correction for each of the video, at most; 0: none", low=0, high=1
    )
    assumed_loss: float = key(
        0.0, "lost packets it reckons with at least, as where nothing is reported", low=0, high=0.5
    )
    encrypted: bool = key(True, "SRTP with the key of telemetry.certificates, or loopback only")


@dataclass(frozen=True)
class BatterySettings:
    """The gauge."""

    uri: str = key("fake:", "gauge: i2c:CHIP@BUS:ADDRESS, fake:")
    period_s: float = key(1.0, "time between readings", unit="s", low=0.1, high=60)
    capacity_mAh: float = key(600.0, "the cell's capacity", unit="mAh", low=50, high=20_000)
    full_V: float = key(4.2, "its voltage when full", unit="V", low=4.0, high=4.45)
    resistance_mohm: float = key(
        0.0, "its series resistance at 25 degrees; 0: typical", unit="mohm", low=0, high=2000
    )
    temperature_C: float = key(20.0, "expected temperature of the cell", unit="C", low=-20, high=60)
    low_percentage: float = key(0.25, "state of charge of the low alarm", low=0, high=1)
    low_bitrate_kbps: int = key(600, "bit rate from then on", unit="kbit/s", low=100, high=20_000)
    critical_percentage: float = key(0.05, "state of charge of the shutdown", low=0, high=0.5)
    critical_V: float = key(3.3, "voltage under load of it", unit="V", low=2.8, high=3.8)
    confirm_readings: int = key(3, "readings in a row before an alarm", low=1, high=60)
    shutdown_command: list[str] = key([], "what to run after an orderly end")

    def __post_init__(self) -> None:
        if self.critical_percentage >= self.low_percentage:
            raise ValueError(
                f"'battery.critical_percentage' is {self.critical_percentage:g}; it must be below"
                f" 'battery.low_percentage', {self.low_percentage:g}"
            )


@dataclass(frozen=True)
class AutopilotSettings:
    """Who is told the poses, and how the camera sits."""

    uri: str = key("off:", "autopilot: serial:TTY, off:")
    period_s: float = key(1.0, "time between its states in telemetry", unit="s", low=0.1, high=60)
    max_age_s: float = key(0.5, "older poses are not sent", unit="s", low=0.05, high=5)
    world_heading_deg: float = key(
        0.0, "compass heading of the map's x axis", unit="degrees", low=-360, high=360
    )
    mount_roll_deg: float = key(0.0, "the camera's turn", unit="degrees", low=-180, high=180)
    mount_pitch_deg: float = key(0.0, "the camera's turn", unit="degrees", low=-180, high=180)
    mount_yaw_deg: float = key(0.0, "the camera's turn", unit="degrees", low=-180, high=180)
    mount_m: list[float] = key([0.0, 0.0, 0.0], "the camera's place in the vehicle", unit="m")
    jump_m: float = key(0.5, "a jump that is a reset", unit="m", low=0.01, high=100)
    jump_deg: float = key(20.0, "a turn that is a reset", unit="degrees", low=1, high=180)

    def __post_init__(self) -> None:
        if len(self.mount_m) != 3 or max(map(abs, self.mount_m)) > 10:
            raise ValueError(
                f"'autopilot.mount_m' is {self.mount_m}; expected three numbers of -10 to 10 m"
            )


@dataclass(frozen=True)
class RecordingSettings:
    """What stays on the payload's own card."""

    folder: str = key("", "where recordings go; empty: none are made")
    at_start: bool = key(False, "records from the start; otherwise on command")
    max_file_MB: int = key(512, "a file ends at this size", unit="MB", low=1, high=4000)
    max_total_MB: int = key(4096, "oldest are deleted beyond", unit="MB", low=1, high=1_000_000)
    min_free_MB: int = key(512, "left free on the card", unit="MB", low=0, high=1_000_000)
    sync_s: float = key(1.0, "the most that a power cut costs", unit="s", low=0.1, high=60)


@dataclass(frozen=True)
class WifiSettings:
    """The radio."""

    interface: str = key("", "as wlan0; auto: the first one; empty: left alone")
    restart_after_s: float = key(
        20.0, "restarted when the ground is silent so long; 0: never", unit="s", low=0, high=3600
    )


@dataclass(frozen=True)
class SupervisionSettings:
    """What happens when frames stop coming."""

    period_s: float = key(1.0, "time between health messages", unit="s", low=0.2, high=60)
    frame_timeout_s: float = key(
        2.0, "camera or encoder restarted without a frame for", unit="s", low=0.5, high=14
    )
    restarts: int = key(5, "of camera or encoder in a row; then the process", low=1, high=100)
    process_restarts: int = key(3, "without a frame in a row; then the board", low=1, high=100)
    state: str = key("", "file that counts them across restarts; empty: not counted")
    reboot_command: list[str] = key([], "what reboots the board; empty: nothing does")


@dataclass(frozen=True)
class TelemetrySettings:
    """Zenoh."""

    enabled: bool = key(True, "false sends no telemetry")
    connect: list[str] = key([LOCAL_ENDPOINT], "endpoints to connect to, tcp/ or tls/HOST:PORT")
    listen: list[str] = key([], "endpoints to listen on; port 0: any free one")
    certificates: str = key("", "folder that `blimp keys payload` wrote; empty: loopback only")
    discover: str = key("", "interface to find the ground station on, by scouting; empty: none")

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

    payload_id: str = key("blimp-1", "this payload's name in telemetry")
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
