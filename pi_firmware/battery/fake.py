"""`fake:`, a one-cell LiPo that discharges evenly: what tests and demos have for a battery."""

from __future__ import annotations

import numpy as np

from pi_firmware.battery.bus import Counts
from pi_firmware.uri import Uri
from pi_firmware.wire.messages import Battery

# Rest voltage over charge of a typical LiPo cell; between the points it is a straight line.
_CHARGE = (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
_VOLTAGE_V = (3.27, 3.50, 3.61, 3.69, 3.77, 3.87, 4.02, 4.20)
_RESISTANCE_OHM = 0.08
_DISCHARGING, _GOOD, _LIPO = 2, 1, 3


class FakeGauge:
    """Starts at `percentage` (0 to 1) and would be empty from full after `minutes`."""

    def __init__(self, uri: Uri) -> None:
        uri.only("percentage", "minutes", "capacity_mAh")
        self.counts = Counts()
        if uri.path:
            raise uri.fail(f"takes no path, but options, not {uri.path!r}")
        self._start = uri.number("percentage", 1.0, 0.0, 1.0)
        self._full_s = 60 * uri.number("minutes", 120.0, 0.1, 10_000.0)
        self._capacity_ah = uri.number("capacity_mAh", 600.0, 10.0, 100_000.0) / 1000
        self._start_ns: int | None = None

    def read(self, time_ns: int) -> Battery:
        """The reading at `time_ns`, counted from the first one."""
        if self._start_ns is None:
            self._start_ns = time_ns
        elapsed_s = (time_ns - self._start_ns) / 1e9
        left = float(np.clip(self._start - elapsed_s / self._full_s, 0.0, 1.0))
        current_a = -self._capacity_ah * 3600 / self._full_s if left > 0 else 0.0
        rest_v = float(np.interp(left, _CHARGE, _VOLTAGE_V))
        return Battery(
            time_ns=time_ns,
            voltage=round(rest_v + current_a * _RESISTANCE_OHM, 4),
            percentage=left,
            current=current_a,
            charge=left * self._capacity_ah,
            capacity=self._capacity_ah,
            design_capacity=self._capacity_ah,
            power_supply_status=_DISCHARGING,
            power_supply_health=_GOOD,
            power_supply_technology=_LIPO,
            time_left_s=left * self._full_s,
        )

    def close(self) -> None:
        """Nothing to release."""
