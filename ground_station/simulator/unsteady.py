"""What changes in pictures though nothing moves: exposure steps, lights that go off, flicker."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64
from ground_station.simulator.scene import SimulatorError

FLICKER_HZ = 100.0
"""Lamps on mains of 50 Hz are brightest at both of a period's peaks."""

_INSTANTS = 16
"""Of a row's exposure, over which the light is averaged: at 1/60 s a tenth of a period apart."""

_EV = (-6.0, 6.0)
_LIGHT = (0.0, 64.0)


@dataclass(frozen=True)
class Steps:
    """A value that holds from each time on, seconds after the first frame, until the next.

    Before the first it is `before`.
    """

    time_s: tuple[float, ...] = ()
    value: tuple[float, ...] = ()
    before: float = 0.0

    def at(self, times_s: npt.ArrayLike) -> F64:
        """The values at times of any shape."""
        values = np.array([self.before, *self.value])
        return values[np.searchsorted(self.time_s, times_s, side="right")]


@dataclass(frozen=True)
class Unsteady:
    """`exposure_ev` is by how much exposures are off what auto exposure asks for (1: twice as much
    light). `light` is the share of the scene's light that is on. `flicker` is the share by which
    it swings about its mean, `FLICKER_HZ` times a second.
    """

    exposure_ev: Steps = Steps()
    light: Steps = Steps(before=1.0)
    flicker: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.flicker <= 1:
            raise SimulatorError(f"flicker is {self.flicker:g}; allowed: 0 to 1")

    @property
    def lit_evenly(self) -> bool:
        """Whether no row is ever lit otherwise than the scene says."""
        return not self.light.time_s and self.flicker == 0

    def row_light(self, times_s: npt.ArrayLike, exposure_s: float) -> F64:
        """The mean light (H,) during the exposures of H rows, each about its time, seconds.

        An exposure of whole periods of the flicker has no bands.
        """
        part = (np.arange(_INSTANTS) + 0.5) / _INSTANTS - 0.5
        times = np.asarray(times_s, np.float64)[:, None] + part * exposure_s
        swing = 1 + self.flicker * np.sin(2 * math.pi * FLICKER_HZ * times)
        return np.asarray((self.light.at(times) * swing).mean(axis=1))


def unsteady(exposure_steps: str = "", light_steps: str = "", flicker: float = 0.0) -> Unsteady:
    """From what a person writes, as "5:1,10:-1"; raises `SimulatorError` naming what is wrong."""
    return Unsteady(
        _steps("exposure_steps", exposure_steps, _EV, 0.0),
        _steps("light_steps", light_steps, _LIGHT, 1.0),
        flicker,
    )


def _steps(name: str, text: str, limits: tuple[float, float], before: float) -> Steps:
    try:
        pairs = [tuple(map(float, step.split(":"))) for step in text.split(",")] if text else []
        times, values = zip(*pairs, strict=True) if pairs else ((), ())
    except ValueError:
        raise SimulatorError(f"{name} is '{text:.80}'; such as 5:1,10:0 is meant") from None
    low, high = limits
    if not all(low <= value <= high for value in values):
        raise SimulatorError(f"{name} is '{text:.80}'; allowed values: {low:g} to {high:g}")
    if not all(a < b for a, b in zip((-math.inf, *times), (*times, math.inf), strict=True)):
        raise SimulatorError(f"{name} is '{text:.80}'; its times must rise")
    return Steps(times, values, before)
