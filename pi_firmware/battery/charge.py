"""State of charge from coulombs and open-circuit voltage together: a Kalman filter of two states.

After G. L. Plett, 'Extended Kalman filtering for battery management systems of LiPB-based HEV
battery packs', J. Power Sources 134, 2004. The states are the charge and a factor on the cell's
resistances: a wrong resistance is wrong for the whole flight, so that no averaging over time takes
its error out of the voltage. The polarizations are carried along instead of estimated. Counting
drifts with the errors of the gauge and of the capacity; the rest voltage is off its curve for
minutes on end, so its variance is that of one independent look in `_CORRELATION_S`.
"""

from __future__ import annotations

import math

from pi_firmware.battery.cell import Cell, Polarization

_REST_SIGMA_V = 0.025  # of the curve, from cell to cell
_CORRELATION_S = 300.0
_RESISTANCE_SIGMA = 0.2  # of the factor: cells, leads, temperature
_COUNT_SIGMA = 0.05  # of the charge counted: capacity and gauge
_POWER_S = 60.0
_GAP_S = 300.0  # after a longer silence the charge is taken from the voltage again
_MIN_POWER_W = 0.05


class ChargeFilter:
    """State of charge of one cell, fed with voltages and currents.

    `charge` is 0 to 1, None before the first reading; `resistance` is the factor on the model's.
    """

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.charge: float | None = None
        self.resistance = 1.0
        self._variance, self._covariance, self._of_resistance = 0.0, 0.0, 0.0
        self._polarization = Polarization(cell)
        self._last_s = 0.0
        self._last_a = 0.0
        self._power_w = 0.0

    @property
    def sigma(self) -> float | None:
        """The charge's standard deviation."""
        return None if self.charge is None else math.sqrt(self._variance)

    def update(self, now_s: float, voltage: float, discharge_a: float) -> float:
        """The state of charge after a reading; `now_s` is of a clock that never steps.

        A reading that is not later than the one before changes nothing. Its numbers are finite: the
        monitor believes no others.
        """
        dt_s = now_s - self._last_s
        if self.charge is None or dt_s > _GAP_S:
            return self._begin(now_s, voltage, discharge_a)
        if dt_s <= 0:
            return self.charge
        mean_a = (self._last_a + discharge_a) / 2
        counted = mean_a * dt_s / 3600 / self.cell.capacity_ah
        charge = _inside(self.charge - counted)
        variance = self._variance + _COUNT_SIGMA**2 * abs(counted)
        self._polarization.step(charge, mean_a, dt_s)
        across_v = self.cell.series_ohm(charge) * discharge_a + self._polarization.total_v
        innovation = voltage - (self.cell.rest_v(charge) - self.resistance * across_v)
        # Next to empty the resistances rise, too: the load's part falls with the charge.
        steep = (self.cell.total_ohm(charge + 1e-3) - self.cell.total_ohm(charge)) / 1e-3
        slope = self.cell.slope_v(charge) - self.resistance * steep * discharge_a
        noise = _REST_SIGMA_V**2 * max(_CORRELATION_S / dt_s, 1.0)
        # The voltage's covariance with either state, and what share of the surprise each takes.
        with_charge = slope * variance - across_v * self._covariance
        with_resistance = slope * self._covariance - across_v * self._of_resistance
        seen = slope * with_charge - across_v * with_resistance + noise
        of_charge, of_resistance = with_charge / seen, with_resistance / seen
        self.charge = _inside(charge + of_charge * innovation)
        self.resistance = min(max(self.resistance + of_resistance * innovation, 0.3), 3.0)
        self._variance = variance - of_charge * with_charge
        self._covariance -= of_charge * with_resistance
        self._of_resistance -= of_resistance * with_resistance
        share = 1 - math.exp(-dt_s / _POWER_S)
        self._power_w += share * (voltage * discharge_a - self._power_w)
        self._last_s, self._last_a = now_s, discharge_a
        return self.charge

    def time_left_s(self, empty_v: float) -> float | None:
        """Seconds until `empty_v` at the power of the last minute; None when next to none flows."""
        if self.charge is None or self._power_w < _MIN_POWER_W:
            return None
        return self.cell.time_left_s(self.charge, self._power_w, empty_v, self.resistance)

    def _begin(self, now_s: float, voltage: float, discharge_a: float) -> float:
        """Takes the charge from the voltage, the load's part of it estimated.

        A payload that is switched on has a rested cell; after a gap the load has gone on. A program
        that starts again in flight takes the cell for rested, too, and its charge for too low.
        """
        loaded = self.charge is not None
        self.resistance = 1.0
        charge, across_v = self.cell.charge_at(voltage), 0.0
        for _ in range(8):
            self._polarization.settle(charge, discharge_a if loaded else 0.0)
            across_v = self.cell.series_ohm(charge) * discharge_a
            across_v += self._polarization.total_v
            charge = self.cell.charge_at(voltage + across_v)
        slope = self.cell.slope_v(charge)
        with_resistance = across_v / slope  # the same resistance is behind both errors
        self._of_resistance = _RESISTANCE_SIGMA**2
        self._covariance = with_resistance * self._of_resistance
        self._variance = (_REST_SIGMA_V / slope) ** 2 + with_resistance * self._covariance
        self.charge, self._power_w = charge, voltage * discharge_a
        self._last_s, self._last_a = now_s, discharge_a
        return charge


def _inside(charge: float) -> float:
    return min(max(charge, 0.0), 1.0)
