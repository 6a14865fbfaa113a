"""A camera carried by hand at a run: steps, sway, and the hand's tremble.

A runner's head and trunk bounce once a step and sway once in two (Pozzo, Berthoz and Lefort 1990
find rotations of a few degrees); a hand's tremble lies between 3 and 12 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.simulator.motion import Motion, Mount
from ground_station.simulator.plans import Reference

Array = npt.NDArray[np.float64]

_STEP_S = 1 / 400


@dataclass(frozen=True)
class Runner:
    """Amplitudes at full speed; deviations for what is random."""

    steps_Hz: float = 2.7
    bounce_m: float = 0.035
    sway_m: float = 0.025
    pitch_deg: float = 1.6
    yaw_deg: float = 1.8
    roll_deg: float = 1.5
    tremble_deg: float = 0.35
    tremble_m: float = 0.004
    tremble_Hz: tuple[float, float] = (3.0, 12.0)


def _band_noise(
    count: int, columns: int, band_Hz: tuple[float, float], rng: np.random.Generator
) -> Array:
    """Gaussian noise (count, columns) of unit deviation between two frequencies, falling as 1/f."""
    f = np.fft.rfftfreq(count, _STEP_S)
    gain = np.where((f >= band_Hz[0]) & (f <= band_Hz[1]), 1 / np.maximum(f, 1e-3), 0.0)
    spectrum = np.fft.rfft(rng.standard_normal((count, columns)), axis=0) * gain[:, None]
    noise = np.fft.irfft(spectrum, n=count, axis=0)
    return noise / noise.std(axis=0)


def carry(
    reference: Reference,
    duration_s: float,
    rng: np.random.Generator,
    runner: Runner | None = None,
    mount: Mount | None = None,
) -> Motion:
    """Carries the camera along a plan; shakes grow with the speed of the run."""
    r = runner or Runner()
    count = int(np.ceil((duration_s + 2.0) / _STEP_S))
    times = np.arange(count) * _STEP_S - 1.0
    position, yaw = reference.at(np.maximum(times, 0))
    speed = np.linalg.norm(np.gradient(position, _STEP_S, axis=0), axis=1)
    vigour = 0.08 + 0.92 * np.clip(speed / max(float(speed.max()), 1e-9), 0, 1)
    # No two steps are equal: their phase wanders by some percent, their size as well.
    wander = np.cumsum(_band_noise(count, 1, (0.1, 1.0), rng)[:, 0]) * _STEP_S * 0.8
    phase = 2 * np.pi * r.steps_Hz * times + wander
    size = vigour * (1 + 0.2 * _band_noise(count, 1, (0.2, 1.5), rng)[:, 0])
    # A step pushes harder than it lands: a second harmonic.
    step = np.sin(phase) + 0.3 * np.sin(2 * phase + 0.7)
    stride = np.sin(phase / 2) + 0.2 * np.sin(3 * phase / 2 + 0.4)
    tremble = _band_noise(count, 6, r.tremble_Hz, rng) * (0.4 + 0.6 * vigour)[:, None]
    side = np.stack([-np.sin(yaw), np.cos(yaw), np.zeros(count)], axis=1)
    moved = position + r.tremble_m * tremble[:, :3] + (r.sway_m * size * stride)[:, None] * side
    moved[:, 2] += r.bounce_m * size * step
    swing = np.radians([r.yaw_deg, r.pitch_deg, r.roll_deg])
    cycle = np.stack([stride, np.sin(phase + 1.1), np.sin(phase / 2 + 0.5)], axis=1)
    angles = size[:, None] * swing * cycle + np.radians(r.tremble_deg) * tremble[:, 3:]
    angles[:, 0] += yaw
    held = mount or Mount(forward_m=0.3, up_m=0.0, tilt_down_deg=2.0)
    return Motion(times, moved, angles, held)
