"""What a small camera makes of the light on its sensor: mosaic, demosaicing, denoising, sharpening.

The order is that of common image pipelines (Ramanath, Snyder, Yoo and Drew 2005).
"""

from __future__ import annotations

import cv2
import numpy as np

from ground_station.arrays import F32, U8, U16

PROCESSINGS = ("none", "camera")

WHITE_BALANCE = (1.75, 1.0, 1.43)
"""Gains of red, green and blue in daylight, 5,700 K: libcamera's `imx219.json` for the payload's
camera. Red and blue sites take so many times fewer electrons for the same level."""

_DENOISE = 3.0
"""Differences of up to so many deviations of the noise count as noise: all but 0.3 % of it are."""
_DENOISE_PX, _CHROMA_PX = 1.5, 2.0
"""Deviations of what luma is denoised by, and chroma, which H.264 halves next and eyes miss."""
_SHARPEN, _SHARPEN_PX = 0.8, 1.0
"""Share and deviation of the unsharp mask: a sharp edge overshoots by up to a tenth of its step,
which looks crisp and not yet like a halo."""


def mosaic(channels: F32) -> F32:
    """What an RGGB sensor's sites (H, W), one a pixel, take of three channels (H, W, 3)."""
    sites = channels[..., 1].copy()
    sites[::2, ::2] = channels[::2, ::2, 0]
    sites[1::2, 1::2] = channels[1::2, 1::2, 2]
    return sites


def demosaiced(sites: U16) -> U16:
    """Three channels (H, W, 3) RGB of sites (H, W), interpolated along edges."""
    return np.asarray(cv2.cvtColor(sites, cv2.COLOR_BayerRGGB2RGB_EA), np.uint16)


def finished(picture: U8, noise: float) -> U8:
    """An 8-bit picture (H, W, 3) RGB denoised and sharpened.

    `noise` is its deviation in mid-grey, of 255, which a camera knows from its gain.
    """
    luma, *chroma = cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb))
    luma = cv2.bilateralFilter(luma, 5, _DENOISE * noise, _DENOISE_PX)
    blurred = cv2.GaussianBlur(luma, (0, 0), _SHARPEN_PX)
    luma = cv2.addWeighted(luma, 1 + _SHARPEN, blurred, -_SHARPEN, 0)
    chroma = [cv2.GaussianBlur(one, (0, 0), _CHROMA_PX) for one in chroma]
    return np.asarray(cv2.cvtColor(cv2.merge([luma, *chroma]), cv2.COLOR_YCrCb2RGB), np.uint8)
