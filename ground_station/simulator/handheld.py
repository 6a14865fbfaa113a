"""A camera carried by hand at a run, worn on the head at a walk, or held still for a picture.

A runner's head and trunk bounce once a step and sway once in two (Pozzo, Berthoz and Lefort 1990
find rotations of a few degrees); a hand's tremble lies between 3 and 12 Hz. Who walks through rooms
looks about: the head turns against the way, slower than it steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ground_station.arrays import F64
from ground_station.simulator.motion import Motion, Mount
from ground_station.simulator.plans import Plan, Reference

STEP_S = 1 / 400


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
    look_deg: tuple[float, float] = (0.0, 0.0)
    """Deviations of the head's yaw and pitch from straight along the way."""
    look_Hz: tuple[float, float] = (0.05, 0.35)


WEARER = Runner(
    steps_Hz=1.7, bounce_m=0.018, sway_m=0.015, pitch_deg=0.9, yaw_deg=0.9, roll_deg=0.7,
    tremble_deg=0.05, tremble_m=0.001, look_deg=(32.0, 10.0),
)  # fmt: skip
"""One who walks with a camera on the head: at 0.8 m/s it turns some 8 degrees in 0.2 s (mean)."""

WALKER = replace(WEARER, look_deg=(6.0, 3.0), tremble_deg=0.15, tremble_m=0.002)
"""One who walks with a phone held in both hands, to show the rooms."""

HEAD = Mount(forward_m=0.1, up_m=0.05, tilt_down_deg=8.0)
"""A camera at the brow, that looks down a little as eyes do indoors."""

BEARERS: dict[str, tuple[Runner, Mount]] = {
    "runner": (Runner(), Mount(forward_m=0.3, up_m=0.0, tilt_down_deg=2.0)),
    "wearer": (WEARER, HEAD),
    "walker": (WALKER, Mount(forward_m=0.35, up_m=0.0, tilt_down_deg=0.0)),
}

_STILL_M, _STILL_DEG = (0.04, 0.04, 0.02), (2.0, 1.5, 1.0)
"""Deviations from where a picture was meant to be taken: x, y, z; yaw, pitch, roll."""


def band_noise(
    count: int, columns: int, band_Hz: tuple[float, float], rng: np.random.Generator
) -> F64:
    """Gaussian noise (count, columns) of unit deviation between two frequencies, falling as 1/f."""
    whole = max(count, math.ceil(1 / band_Hz[0] / STEP_S))  # a period of the slowest, at least
    f = np.fft.rfftfreq(whole, STEP_S)
    gain = np.where((f >= band_Hz[0]) & (f <= band_Hz[1]), 1 / np.maximum(f, 1e-3), 0.0)
    spectrum = np.fft.rfft(rng.standard_normal((whole, columns)), axis=0) * gain[:, None]
    noise = np.fft.irfft(spectrum, n=whole, axis=0)
    return np.asarray((noise / noise.std(axis=0))[:count])


def carry(
    reference: Reference,
    duration_s: float,
    rng: np.random.Generator,
    bearer: str = "runner",
) -> Motion:
    """Carries the camera along a plan as one of `BEARERS`; shakes grow with the speed."""
    r, mount = BEARERS[bearer]
    count = int(np.ceil((duration_s + 2.0) / STEP_S))
    times = np.arange(count) * STEP_S - 1.0
    position, yaw = reference.at(np.maximum(times, 0))
    speed = np.linalg.norm(np.gradient(position, STEP_S, axis=0), axis=1)
    vigour = 0.08 + 0.92 * np.clip(speed / max(float(speed.max()), 1e-9), 0, 1)
    # No two steps are equal: their phase wanders by some percent, their size as well.
    wander = np.cumsum(band_noise(count, 1, (0.1, 1.0), rng)[:, 0]) * STEP_S * 0.8
    phase = 2 * np.pi * r.steps_Hz * times + wander
    size = vigour * (1 + 0.2 * band_noise(count, 1, (0.2, 1.5), rng)[:, 0])
    # A step pushes harder than it lands: a second harmonic.
    step = np.sin(phase) + 0.3 * np.sin(2 * phase + 0.7)
    stride = np.sin(phase / 2) + 0.2 * np.sin(3 * phase / 2 + 0.4)
    tremble = band_noise(count, 6, r.tremble_Hz, rng) * (0.4 + 0.6 * vigour)[:, None]
    side = np.stack([-np.sin(yaw), np.cos(yaw), np.zeros(count)], axis=1)
    moved = position + r.tremble_m * tremble[:, :3] + (r.sway_m * size * stride)[:, None] * side
    moved[:, 2] += r.bounce_m * size * step
    swing = np.radians([r.yaw_deg, r.pitch_deg, r.roll_deg])
    cycle = np.stack([stride, np.sin(phase + 1.1), np.sin(phase / 2 + 0.5)], axis=1)
    angles = size[:, None] * swing * cycle + np.radians(r.tremble_deg) * tremble[:, 3:]
    angles[:, 0] += yaw
    if any(r.look_deg):
        angles[:, :2] += np.radians(r.look_deg) * band_noise(count, 2, r.look_Hz, rng)
    return Motion(times, moved, angles, mount)


def hold(plan: Plan, times_s: F64, rng: np.random.Generator) -> Motion:
    """Holds the camera still at a plan's stands, in random order, one at each time (N,)."""
    stands = rng.permutation(plan.stands)[: len(times_s)]
    position, yaw = plan.shape((stands + 0.5) / plan.stands)
    angles = np.radians(_STILL_DEG) * rng.standard_normal((len(stands), 3))
    angles[:, 0] += yaw
    moved = position + np.array(_STILL_M) * rng.standard_normal((len(stands), 3))
    return Motion(times_s, moved, angles, Mount(0.0, 0.0, 0.0), is_held=True)
