"""From ideal pictures to what the payload's camera would have taken.

Rows are exposed one after another and each for a while. Every output pixel's ray, at every instant
it is exposed, is followed into the nearest of a few rendered pictures with the help of their
depth: the reprojection of image-based rendering (McMillan and Bishop 1995), backwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, F64, U8
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.simulator import processing
from ground_station.simulator.motion import Motion
from ground_station.simulator.rendering import Pinhole, SceneRenderer

# Beyond the lens's field on each side (tangent), for what turns into view during a frame.
_MARGIN = 0.05
_MAX_SAMPLES = 12
# Of a fisheye: the circle of its picture, as one plane is rendered. Tangent of 80°.
_RIM = math.tan(math.radians(80.0))
# Saturation of the sensor over the level of white: headroom for the tone curve.
_OVERRANGE = 4.0
_CONTRAST = 0.8
_GREY = 0.18


@dataclass(frozen=True)
class Sensor:
    """What the sensor and its control loop do; levels are relative to white."""

    full_well_e: float = 11000.0
    """Electrons at white and gain 1: a 1.12 µm pixel's 4,700, 2x2 binned and then scaled."""
    read_noise_e: float = 5.0
    sensitivity: float = 230.0
    """Level per second of exposure and unit of radiance, at gain 1."""
    gain_limits: tuple[float, float] = (1.0, 16.0)
    exposure_limits_s: tuple[float, float] = (1e-4, 1 / 60)
    target_level: float = 0.44
    """Mean of the gamma-coded picture that auto exposure aims at."""
    lag_s: float = 0.35
    """Time constant of auto exposure."""
    vignetting: float = 0.22
    """Light lost in the picture's corners."""


def row_offsets_s(camera: Camera) -> F64:
    """When each row (H,) is exposed after the middle one: the readout spans first to last row."""
    v = np.arange(camera.height_px)
    return (v - (camera.height_px - 1) / 2) / (camera.height_px - 1) * camera.readout_s


def covering_pinhole(camera: Camera, supersampling: float) -> Pinhole:
    """An ideal camera that sees all that the lens does, and a little more."""
    u, v = np.arange(camera.width_px), np.arange(camera.height_px)
    edge = np.concatenate([
        np.stack([u, np.zeros_like(u)], 1), np.stack([u, np.full_like(u, v[-1])], 1),
        np.stack([np.zeros_like(v), v], 1), np.stack([np.full_like(v, u[-1]), v], 1),
    ])  # fmt: skip
    sides = _flat(camera, edge)
    if camera.model == "fisheye":  # whose rim may lie within the picture
        sides = np.concatenate([sides, _flat(camera, _rim(camera))])
    reach = np.nanmax(np.abs(sides), axis=0) + _MARGIN
    focal = supersampling * 0.5 * (camera.fx_px + camera.fy_px)
    width, height = (int(math.ceil(2 * r * focal / 8) * 8) for r in reach)
    return Pinhole(width, height, focal)


def _flat(camera: Camera, pixels: npt.ArrayLike) -> F64:
    """Pixels (N, 2) on the plane z = 1 (N, 2), NaN beyond the rim."""
    rays = camera.rays(pixels)
    flat = rays[:, :2] / np.where(rays[:, 2] > 0, rays[:, 2], np.nan)[:, None]
    flat[~(np.hypot(flat[:, 0], flat[:, 1]) <= _RIM)] = np.nan
    return flat


def _rim(camera: Camera) -> F64:
    """Pixels (M, 2) of the picture just within the rim, where it is in the picture at all."""
    turn = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    pixels = camera.distort(0.9999 * _RIM * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    size = [camera.width_px - 1, camera.height_px - 1]
    with np.errstate(invalid="ignore"):
        return pixels[((pixels >= 0) & (pixels <= size)).all(axis=1)]


class FrameMaker:
    """Takes frames of a lit scene with a camera in motion; deterministic but for `rng`'s noise.

    `processed` says what becomes of what the sensor takes, one of `PROCESSINGS`.
    """

    def __init__(
        self,
        renderer: SceneRenderer,
        decoder: F32,
        camera: Camera,
        pinhole: Pinhole,
        *,
        sensor: Sensor | None = None,
        renders: int = 2,
        processed: str = "none",
    ) -> None:
        self.camera, self.pinhole, self.renders = camera, pinhole, renders
        self.sensor = sensor or Sensor()
        self._renderer, self._decoder = renderer, np.asarray(decoder, np.float32)
        h, w = camera.height_px, camera.width_px
        grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).reshape(-1, 2)
        flat = _flat(camera, grid).reshape(h, w, 2)
        seen = np.isfinite(flat[..., 0])
        rays = np.nan_to_num(flat).astype(np.float32)
        self._x, self._y = np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
        r2 = self._x**2 + self._y**2
        if camera.model == "fisheye":  # on the plane nearly all light would be of the rim
            r2 = np.arctan(np.sqrt(r2)) ** 2
        self._vignette = 1 - np.float32(self.sensor.vignetting) * (r2 / r2.max())
        self._vignette[~seen] = 0
        self._rows_s = row_offsets_s(camera)
        codes = np.arange(16384) / 16383.0
        # Gamma with a soft shoulder (Reinhard et al. 2002, eq. 4), so that highlights fade into
        # white, and the S of a camera's contrast setting.
        level = _OVERRANGE * codes
        curve = level * (1 + level / _OVERRANGE**2) / (1 + level)
        coded = curve ** (1 / 2.2)
        coded += _CONTRAST * (coded * coded * (3 - 2 * coded) - coded)
        self._tone = np.rint(255 * coded).astype(np.uint8)
        self._codes_per_level = 255 * float(np.interp(_GREY, level, np.gradient(coded, level)))
        self._balance: F32 | np.float32 = np.float32(1)
        self._by_mosaic = processed == "camera"
        if self._by_mosaic:
            gains = np.asarray(processing.WHITE_BALANCE, np.float32)
            self._balance = processing.mosaic(np.broadcast_to(gains, (h, w, 3)))

    def radiance(self, motion: Motion, time_s: float, exposure_s: float) -> F32:
        """Mean radiance (H, W, 3) that each pixel collects in the frame at `time_s`.

        `time_s` is the middle of the middle row's exposure.
        """
        span = self.camera.readout_s + exposure_s
        k = self.renders
        shots = time_s + ((np.arange(k) + 0.5) / k - 0.5) * span
        wTk = motion.wTc(shots)
        pictures = []
        for T, shot_s in zip(wTk, shots.tolist(), strict=True):
            self._renderer.at(shot_s)
            codes, depth = self._renderer.image_and_depth(T, self.pinhole)
            pictures.append((cv2.LUT(codes, self._decoder), depth))
        near = float(np.percentile(pictures[0][1][::8, ::8], 5))
        count = self._sample_count(motion, time_s, exposure_s, near)
        total = np.zeros((self.camera.height_px, self.camera.width_px, 3), np.float32)
        for offset in ((np.arange(count) + 0.5) / count - 0.5) * exposure_s:
            times = time_s + self._rows_s + offset
            wTr = motion.wTc(times)
            nearest = np.abs(times[:, None] - shots[None, :]).argmin(axis=1)
            for index in np.unique(nearest):
                rows = np.flatnonzero(nearest == index)
                block = slice(int(rows[0]), int(rows[-1]) + 1)
                image, depth = pictures[index]
                total[block] += self._warp(
                    image, depth, poses.inverse(wTk[index]) @ wTr[block], block
                )
        return total / np.float32(count)

    def _sample_count(self, motion: Motion, time_s: float, exposure_s: float, near_m: float) -> int:
        """Enough instants that neighbours lie at most about a pixel apart."""
        speed, turn = motion.speed([time_s])
        flow = self.camera.fx_px * (1.3 * float(turn[0]) + float(speed[0]) / max(near_m, 0.3))
        return int(np.clip(math.ceil(flow * exposure_s / 0.9), 1, _MAX_SAMPLES))

    def _warp(self, image: F32, depth: F32, kTr: F64, rows: slice) -> F32:
        """Rows of the output seen in one rendered picture, the pose of each row in its camera."""
        x, y = self._x[rows], self._y[rows]
        R, a = kTr[:, :3, :3].astype(np.float32), kTr[:, :3, 3].astype(np.float32)
        d = [R[:, i, 0, None] * x + R[:, i, 1, None] * y + R[:, i, 2, None] for i in range(3)]
        f, (cx, cy) = np.float32(self.pinhole.focal_px), self.pinhole.centre_px
        u, v = f * d[0] / d[2] + np.float32(cx), f * d[1] / d[2] + np.float32(cy)
        # Where the ray meets the surface depends on the depth found there: two rounds suffice for
        # centimetres of motion.
        for _ in range(2):
            z = cv2.remap(depth, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
            w = d[2] / (z - a[:, 2, None])  # inverse depth along the ray
            scale = f / (d[2] + a[:, 2, None] * w)
            u = (d[0] + a[:, 0, None] * w) * scale + np.float32(cx)
            v = (d[1] + a[:, 1, None] * w) * scale + np.float32(cy)
        return np.asarray(
            cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
        )

    def expose(
        self, radiance: F32, exposure_s: float, gain: float, rng: np.random.Generator | None
    ) -> U8:
        """The 8-bit picture (H, W, 3) RGB: shot and read noise, saturation, gamma 1/2.2.

        Without `rng`, no noise. What the camera does beyond that is done to it.
        """
        s = self.sensor
        level = radiance * (
            self._vignette[..., None] * np.float32(s.sensitivity * exposure_s * gain)
        )
        level = np.minimum(level, _OVERRANGE)
        if self._by_mosaic:
            level = processing.mosaic(level)
        per_level = gain / s.full_well_e
        if rng is not None:
            # Electrons e = level·W/g; the level's deviation is g/W·√(e + r²).
            deviation = np.sqrt(
                level * np.float32(per_level) * self._balance
                + np.float32((s.read_noise_e * per_level) ** 2) * self._balance**2
            )
            level += deviation * rng.standard_normal(level.shape, dtype=np.float32)
        codes = np.clip(level / np.float32(_OVERRANGE), 0, 1) * np.float32(16383) + np.float32(0.5)
        if not self._by_mosaic:
            return np.asarray(self._tone[codes.astype(np.uint16)])
        picture = self._tone[processing.demosaiced(codes.astype(np.uint16))]
        noise = math.sqrt(_GREY * per_level + (s.read_noise_e * per_level) ** 2)
        return processing.finished(picture, noise * self._codes_per_level)


class AutoExposure:
    """Follows the mean level with a lag: first longer exposures, then gain."""

    def __init__(self, sensor: Sensor, first_radiance: F32) -> None:
        self._sensor = sensor
        self.off_ev = 0.0
        """By how many doublings exposures are more than the light asks for."""
        self._log_product = math.log(1e-3)
        for _ in range(20):
            self._log_product += self._error(first_radiance, math.exp(self._log_product))

    @property
    def settings(self) -> tuple[float, float]:
        """Exposure time, seconds, and gain."""
        s, product = self._sensor, math.exp(self._log_product) * 2**self.off_ev
        exposure = min(max(product, s.exposure_limits_s[0]), s.exposure_limits_s[1])
        gain = min(max(product / exposure, s.gain_limits[0]), s.gain_limits[1])
        return exposure, gain

    def update(self, radiance: F32, dt_s: float) -> None:
        """Learns from the frame just taken, `dt_s` before the next."""
        error = self._error(radiance, math.exp(self._log_product))
        self._log_product += (1 - math.exp(-dt_s / self._sensor.lag_s)) * error

    def _error(self, radiance: F32, product: float) -> float:
        s = self._sensor
        level = radiance[::8, ::8] * np.float32(s.sensitivity * product)
        mean = float(np.mean((level / (1 + level)) ** np.float32(1 / 2.2)))
        error = 2.2 * math.log(s.target_level / max(mean, 1e-4))
        span = math.log(s.exposure_limits_s[0]), math.log(s.exposure_limits_s[1] * s.gain_limits[1])
        return min(max(self._log_product + error, span[0]), span[1]) - self._log_product
