"""Watches the battery on a thread of its own: charge, time left, alarms, orderly shutdown.

State of charge from coulombs and open-circuit voltage together: a Kalman filter of two states.
After G. L. Plett, 'Extended Kalman filtering for battery management systems of LiPB-based HEV
battery packs', J. Power Sources 134, 2004. The states are the charge and a factor on the cell's
resistances: a wrong resistance is wrong for the whole flight, so that no averaging over time takes
its error out of the voltage. The polarizations are carried along instead of estimated. Counting
drifts with the errors of the gauge and of the capacity; the rest voltage is off its curve for
minutes on end, so its variance is that of one independent look in `_CORRELATION_S`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Callable

from pi_firmware.battery.cell import Cell, Polarization
from pi_firmware.battery.chip import CHARGING, Gauge, GaugeError
from pi_firmware.battery.gauges import cell_of
from pi_firmware.settings import BatterySettings
from pi_firmware.wire import messages
from pi_firmware.wire.messages import Battery

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


LOWEST_V, HIGHEST_V = 2.5, 4.6  # no lithium cell that still runs a computer is outside
_LARGEST_A = 100.0
_LOW_ENDS = 0.05  # above the threshold by this much the alarm is over
_SILENT_AFTER = 3  # failed readings in a row before it is said
_LONGEST_PAUSE_S = 30.0
_JOIN_LIMIT_S = 2.0


class Monitor:
    """Reads a gauge every `period_s` and says what follows from it.

    `publish` gets each believable reading, completed with state of charge and time left, and never
    another; `announce` gets events. `on_low` is called once with the bit rate in kbit/s to go down
    to, `on_critical` once: recordings must end, then the payload. Both are called on the monitor's
    thread. A gauge that is absent or fails is tried again, ever more seldom, and stops nothing.
    """

    def __init__(
        self,
        settings: BatterySettings,
        gauge: Gauge,
        *,
        publish: Callable[[Battery], None],
        announce: Callable[[str, str], None],
        on_low: Callable[[int], object] = lambda kbps: None,
        on_critical: Callable[[], object] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.alarm = messages.ALARM_NONE
        self._settings = settings
        self._gauge = gauge
        self._publish, self._announce = publish, announce
        self._on_low, self._on_critical = on_low, on_critical
        self._clock = clock
        self._filter = ChargeFilter(cell_of(settings))
        self._low_readings = self._critical_readings = self._failures = 0
        self._silent = False
        self._end = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Starts the thread; a second call does nothing."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="battery", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Ends the thread and releases the gauge; waits no longer than a hung bus is worth.

        A second call does nothing: a thread that hangs keeps its gauge.
        """
        if self._end.is_set():
            return
        self._end.set()
        thread, self._thread = self._thread, None
        if thread is None:
            self._gauge.close()
        elif thread is not threading.current_thread():
            thread.join(_JOIN_LIMIT_S)

    def step(self, time_ns: int) -> float:
        """One reading, stamped `time_ns`; returns the seconds until the next is due."""
        try:
            reading = self._believable(self._gauge.read(time_ns))
        except GaugeError as error:
            return self._failed(str(error))
        if self._silent:
            self._announce(messages.EVENT_GAUGE_BACK, "the battery gauge answers again")
        self._failures, self._silent = 0, False
        completed = self._complete(reading)
        if self._judge(completed):
            self._alarm(completed)
        self._publish(dataclasses.replace(completed, alarm=self.alarm))
        return self._settings.period_s

    def _run(self) -> None:
        pause_s = 0.0
        while not self._end.wait(pause_s):
            try:
                pause_s = self.step(time.time_ns())
            except Exception as error:  # whatever it is, a flight does not end for a gauge
                pause_s = self._settings.period_s
                with contextlib.suppress(Exception):  # telling of it may fail, too
                    pause_s = self._failed(f"{type(error).__name__}: {error}")
        self._gauge.close()

    def _believable(self, reading: Battery) -> Battery:
        current, share = reading.current, reading.percentage
        reason = ""
        if not LOWEST_V <= reading.voltage <= HIGHEST_V:  # false for NaN, too
            reason = f"{reading.voltage:g} V is no voltage of a cell"
        elif current is not None and not abs(current) <= _LARGEST_A:
            reason = f"{current:g} A is no current of a cell"
        elif share is not None and not 0 <= share <= 1:
            reason = f"{share:g} is no state of charge"
        if reason:
            raise self._gauge.counts.refuse(f"battery gauge: {reason}")
        return reading

    def _failed(self, reason: str) -> float:
        self._failures += 1
        if self._failures >= _SILENT_AFTER and not self._silent:
            self._silent = True
            self._announce(messages.EVENT_GAUGE_FAILED, reason)
        longer = 2.0 ** min(max(self._failures - _SILENT_AFTER, 0), 10)
        return min(self._settings.period_s * longer, max(_LONGEST_PAUSE_S, self._settings.period_s))

    def _complete(self, reading: Battery) -> Battery:
        """The reading with state of charge, time left and the counters."""
        capacity_ah = self._settings.capacity_mAh / 1000
        share, left_s = reading.percentage, reading.time_left_s
        if share is None and reading.current is not None:
            share = self._filter.update(self._clock(), reading.voltage, -reading.current)
            left_s = self._filter.time_left_s(self._settings.critical_V)
        counts = self._gauge.counts
        return dataclasses.replace(
            reading,
            percentage=share,
            charge=None if share is None else share * (reading.capacity or capacity_ah),
            design_capacity=reading.design_capacity or capacity_ah,
            time_left_s=left_s if left_s is not None and math.isfinite(left_s) else None,
            read_errors=counts.errors,
            refused=counts.refused,
            reopened=counts.reopened,
            resets=counts.resets,
        )

    def _judge(self, reading: Battery) -> bool:
        """Sets the alarm; whether it has just been raised."""
        settings, share = self._settings, reading.percentage
        charging = reading.power_supply_status == CHARGING
        empty = reading.voltage <= settings.critical_V or (
            share is not None and share <= settings.critical_percentage
        )
        low = empty or (share is not None and share <= settings.low_percentage)
        self._critical_readings = self._critical_readings + 1 if empty and not charging else 0
        self._low_readings = self._low_readings + 1 if low and not charging else 0
        before = self.alarm
        if before == messages.ALARM_CRITICAL:
            return False
        if self._critical_readings >= settings.confirm_readings:
            self.alarm = messages.ALARM_CRITICAL
        elif self._low_readings >= settings.confirm_readings:
            self.alarm = messages.ALARM_LOW
        elif not low and (share is None or share > settings.low_percentage + _LOW_ENDS):
            self.alarm = messages.ALARM_NONE
        return self.alarm not in (before, messages.ALARM_NONE)

    def _alarm(self, reading: Battery) -> None:
        """Acts first and says it then: a link that hangs must not hold up a shutdown."""
        left = "" if reading.percentage is None else f", {100 * reading.percentage:.0f} % left"
        text = f"{reading.voltage:.2f} V{left}"
        if self.alarm == messages.ALARM_CRITICAL:
            self._on_critical()
            self._announce(messages.EVENT_BATTERY_CRITICAL, f"{text}: shutting down")
        else:
            kbps = self._settings.low_bitrate_kbps
            self._on_low(kbps)
            self._announce(messages.EVENT_BATTERY_LOW, f"{text}: {kbps} kbit/s asked for")
