"""A lithium-polymer cell as a circuit: rest voltage, series resistance and two polarizations.

M. Chen and G. A. Rincón-Mora, 'Accurate Electrical Battery Model Capable of Predicting Runtime and
I-V Performance', IEEE Trans. Energy Conversion 21(2), 2006: equations 2 to 6, measured there on
850 mAh polymer cells charged to 4.1 V. What we add: the state of charge is stretched so that the
curve reaches the charging voltage of the cell at hand (at 4.2 V by 1.095), resistances go with one
over the capacity, and with temperature by Arrhenius' law. Its activation energy is an assumption,
as the paper measured at room temperature only.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

_PAPER_CAPACITY_AH = 0.85
_PAPER_TEMPERATURE_K = 298.15
_ACTIVATION_J_PER_MOL = 20_000.0
_GAS_J_PER_MOL_K = 8.314
_PAPER_SERIES_OHM = 0.07446  # away from the empty end
_STEPS = 100  # of the charge, until it is used up


@dataclass(frozen=True)
class Cell:
    """One cell; `resistance_ohm` is its series resistance at 25 °C with its leads, None: typical.

    States of charge are 0 to 1.
    """

    capacity_ah: float
    full_v: float = 4.2
    resistance_ohm: float | None = None
    temperature_c: float = 20.0

    @cached_property
    def stretch(self) -> float:
        """The paper's state of charge at which its curve reaches `full_v`."""
        return _inverse(_paper_rest_v, self.full_v, 0.5, 1.6)

    @cached_property
    def warmth(self) -> float:
        """The factor on resistances at this temperature, 1 at 25 °C and larger in the cold."""
        inverse = 1 / (self.temperature_c + 273.15) - 1 / _PAPER_TEMPERATURE_K
        return math.exp(_ACTIVATION_J_PER_MOL / _GAS_J_PER_MOL_K * inverse)

    def rest_v(self, charge: float) -> float:
        """Open-circuit voltage, V; rises strictly with the state of charge."""
        return _paper_rest_v(charge * self.stretch)

    def slope_v(self, charge: float) -> float:
        """Its derivative, V for the whole charge."""
        s = charge * self.stretch
        return self.stretch * (35 * 1.031 * math.exp(-35 * s) + 0.2156 - 0.2356 * s + 0.9603 * s**2)

    def charge_at(self, rest_v: float) -> float:
        """The state of charge with this open-circuit voltage, 0 to 1."""
        return _inverse(self.rest_v, rest_v, 0.0, 1.0)

    def series_ohm(self, charge: float) -> float:
        """Resistance that acts at once."""
        typical = 0.1562 * math.exp(-24.37 * charge * self.stretch) + _PAPER_SERIES_OHM
        scale = self._scale
        if self.resistance_ohm is not None:
            scale = self.resistance_ohm / _PAPER_SERIES_OHM
        return typical * scale * self.warmth

    def polarization_ohm(self, charge: float) -> tuple[float, float]:
        """Resistances of the polarization of seconds and of that of minutes."""
        s = charge * self.stretch
        factor = self._scale * self.warmth
        fast = 0.3208 * math.exp(-29.14 * s) + 0.04669
        slow = 6.603 * math.exp(-155.2 * s) + 0.04984
        return fast * factor, slow * factor

    def time_constants_s(self, charge: float) -> tuple[float, float]:
        """Time constants of both polarizations; the capacitances do not go with temperature."""
        s = max(charge * self.stretch, 0.01)
        fast_f = max(-752.9 * math.exp(-13.51 * s) + 703.6, 50.0)
        slow_f = max(-6056 * math.exp(-27.12 * s) + 4475, 200.0)
        fast, slow = self.polarization_ohm(charge)
        return fast * fast_f / self._scale, slow * slow_f / self._scale

    def total_ohm(self, charge: float) -> float:
        """Resistance to a lasting current: voltage falls by this much an ampere."""
        fast, slow = self.polarization_ohm(charge)
        return self.series_ohm(charge) + fast + slow

    def time_left_s(
        self, charge: float, power_w: float, empty_v: float, resistance: float = 1.0
    ) -> float:
        """Seconds until the voltage under a constant power falls to `empty_v`; 0 when it has.

        At each state of charge the voltage v solves v = rest - R·P/v; the time is the sum of the
        charge between times v / P. A power that the cell cannot give ends the time.
        `resistance` is a factor on the model's.
        """
        voltages = []
        for step in range(_STEPS + 1):
            left = charge * (1 - step / _STEPS)
            rest = self.rest_v(left)
            inside = rest**2 - 4 * resistance * self.total_ohm(left) * power_w
            voltage = (rest + math.sqrt(max(inside, 0.0))) / 2
            if inside <= 0 or voltage <= empty_v:
                break
            voltages.append(voltage)
        return sum(voltages[:-1]) * 3600 * self.capacity_ah * charge / _STEPS / power_w

    @cached_property
    def _scale(self) -> float:
        return _PAPER_CAPACITY_AH / self.capacity_ah


class Polarization:
    """Both polarization voltages of a cell, carried along with the current."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self.fast_v = self.slow_v = 0.0

    @property
    def total_v(self) -> float:
        """By how much they lower the voltage of a discharging cell."""
        return self.fast_v + self.slow_v

    def settle(self, charge: float, discharge_a: float) -> None:
        """Sets both to what a lasting current makes of them."""
        fast, slow = self._cell.polarization_ohm(charge)
        self.fast_v, self.slow_v = fast * discharge_a, slow * discharge_a

    def step(self, charge: float, discharge_a: float, dt_s: float) -> None:
        """Carries them over `dt_s` of a constant current, exactly."""
        ohms = self._cell.polarization_ohm(charge)
        times = self._cell.time_constants_s(charge)
        fast, slow = (math.exp(-dt_s / tau) for tau in times)
        self.fast_v = fast * self.fast_v + (1 - fast) * ohms[0] * discharge_a
        self.slow_v = slow * self.slow_v + (1 - slow) * ohms[1] * discharge_a


def _paper_rest_v(s: float) -> float:
    """Equation 2 of the paper, V."""
    return -1.031 * math.exp(-35 * s) + 3.685 + 0.2156 * s - 0.1178 * s**2 + 0.3201 * s**3


def _inverse(rising: Callable[[float], float], value: float, low: float, high: float) -> float:
    """Where a function that rises from `low` to `high` has this value, to a millionth of them."""
    grid, step = 1 << 20, (high - low) / (1 << 20)
    return low + step * bisect_left(range(grid), value, key=lambda k: rising(low + step * k))
