"""H.264 for the link: no B-frames, parameter sets with every IDR, a level that fits the size."""

from __future__ import annotations

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings, EncoderSettings
from pi_firmware.wire.errors import StreamError

# H.264, table A-1: level, macroblocks a second, macroblocks a frame. 3.0 is the least used here.
_LEVELS = (
    ("3", 40_500, 1_620),
    ("3.1", 108_000, 3_600),
    ("3.2", 216_000, 5_120),
    ("4", 245_760, 8_192),
    ("4.2", 522_240, 8_704),
    ("5.1", 983_040, 36_864),
)


def h264_level(width_px: int, height_px: int, rate_hz: float) -> str:
    """The lowest level from 3.0 on that fits size and rate (H.264, table A-1).

    Raises `StreamError` when none does.
    """
    frame = -(-width_px // 16) * -(-height_px // 16)
    for name, per_second, per_frame in _LEVELS:
        if frame <= per_frame and frame * rate_hz <= per_second:
            return name
    raise StreamError(f"{width_px}x{height_px} at {rate_hz:g} Hz fits no H.264 level up to 5.1")


def gop_frames(encoder: EncoderSettings, rate_hz: float) -> int:
    """Frames from IDR to IDR: as configured, but never more than a second's."""
    return max(1, min(encoder.gop_frames, int(rate_hz)))


def description(encoder: EncoderSettings, camera: CameraSettings, rate_hz: float) -> str:
    """The encoder's part of the pipeline, from raw I420 to whole access units in Annex B."""
    level = h264_level(camera.width_px, camera.height_px, rate_hz)
    gop = gop_frames(encoder, rate_hz)
    caps = f"video/x-h264,stream-format=byte-stream,alignment=au,profile=main,level=(string){level}"
    if encoder.name == "x264enc":
        element = (
            "x264enc name=encoder tune=zerolatency speed-preset=veryfast bframes=0 threads=1 "
            f"byte-stream=true aud=false key-int-max={gop} bitrate={encoder.bitrate_kbps}"
        )
    else:
        # The Pi's driver defaults to level 1.0, whose frames it then cannot fit: the caps say more.
        element = (
            'v4l2h264enc name=encoder extra-controls="controls,repeat_sequence_header=1,'
            f'h264_i_frame_period={gop},video_bitrate={encoder.bitrate_kbps * 1000}"'
        )
    return f"{element} ! {caps} ! h264parse config-interval=-1"


def require(encoder: EncoderSettings) -> None:
    """Raises `StreamError` naming the encoder and its package when it is not installed."""
    gstreamer.require((encoder.name, "h264parse"), f"encoder.name '{encoder.name}'")
