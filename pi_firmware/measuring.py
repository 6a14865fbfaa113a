"""The gate's branch of the pipeline: the luma, scaled by GStreamer, is all that Python sees.

Nearest neighbour picks pixels and so keeps the histogram's shape, which averaging would narrow. On
four simulated flights at 640x480 the entropy of the 160x120 picked pixels lies between 0.018 bit
below and 0.006 bit above that of the whole picture; of averaged ones, up to 0.078 bit below. So a
threshold in bits means the same at both sizes, and the scaling costs a hundredth of a millisecond.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pi_firmware import gstreamer
from pi_firmware.settings import CameraSettings

LOW_RESOLUTION_PX = 160
"""Columns of the scaled luma: a whole fraction of the picture's, at least this many."""

Measured = Callable[[NDArray[np.uint8], int], None]


def low_resolution_px(camera: CameraSettings) -> tuple[int, int]:
    """Width and height of the scaled luma; the width is a multiple of 4, as its rows lie."""
    step = max(1, camera.width_px // LOW_RESOLUTION_PX)
    return camera.width_px // step // 4 * 4, max(4, camera.height_px // step)


def description(camera: CameraSettings) -> str:
    """The tee behind the source and the branch that measures.

    A tee without queues serves its branches in turn and in one thread, in the order of their links:
    this branch has been measured before the frame goes on to the encoder. Grey levels stay as they
    are, whatever range the camera's colorimetry says.
    """
    width_px, height_px = low_resolution_px(camera)
    return (
        "tee name=split split. ! videoconvertscale name=scale method=nearest-neighbour "
        "matrix-mode=none add-borders=false n-threads=1 "
        f"! video/x-raw,format=GRAY8,pixel-aspect-ratio=1/1,width={width_px},height={height_px} "
        "! fakesink name=luma sync=false async=false split."
    )


def attach(pipeline: Any, camera: CameraSettings, measured: Measured) -> Callable[[], None]:
    """Has `measured` called with each frame's scaled luma (H, W) and its running time, ns.

    What it gives ends that, and lets go of `measured`.
    """
    gst = gstreamer.load()
    width_px, height_px = low_resolution_px(camera)
    size = width_px * height_px

    def on_luma(pad: Any, probe: Any) -> Any:
        buffer = probe.get_buffer()
        plane = np.frombuffer(buffer.extract_dup(0, size), np.uint8).reshape(height_px, width_px)
        measured(plane, running_ns(gst, pad, buffer))
        return gst.PadProbeReturn.OK

    pad = pipeline.get_by_name("luma").get_static_pad("sink")
    number = pad.add_probe(gst.PadProbeType.BUFFER, on_luma)
    return lambda: pad.remove_probe(number)


def running_ns(gst: Any, pad: Any, buffer: Any) -> int:
    """The running time of a buffer that passes a pad, whatever the pad's segment is."""
    event = pad.get_sticky_event(gst.EventType.SEGMENT, 0)
    return int(event.parse_segment().to_running_time(gst.Format.TIME, buffer.pts))
