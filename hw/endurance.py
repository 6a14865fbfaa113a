"""How long the payload's cell lasts, by mode, and whether it can give the current at all.

The cell is the firmware's own model (Chen and Rincón-Mora 2006), so that the budget and the
payload's estimate in flight agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.builds import Build
from hw.inverse import payload_cell
from hw.parts import Part
from hw.quantities import HardwareError, checked
from pi_firmware.battery.cell import Cell

MODES = ("idle", "stream", "peak")
_STEPS = 400


@dataclass(frozen=True)
class Wear:
    """The cell's state and where its use ends.

    `health_percent` is the capacity that is left of the label's; resistance rises as it falls.
    `cutoff_V` under load and `reserve_percent` of charge end the flight, whichever is first: the
    payload's defaults (`critical_V`, `critical_percentage`).
    """

    health_percent: float = 80.0
    cutoff_V: float = 3.3
    reserve_percent: float = 5.0
    temperature_C: float = 20.0

    def __post_init__(self) -> None:
        for name in ("health_percent", "cutoff_V", "reserve_percent", "temperature_C"):
            checked(name, getattr(self, name))


@dataclass(frozen=True)
class Endurance:
    """One mode's flight. Currents are the cell's: full, and at the end, where it is highest.

    `rating_A` is the smaller of what the cell may give for long and the boost converter may take;
    `verdict` is "ok", "warn" above 80 % of it, "refuse" above it, or "none" when no minute is left.
    """

    mode: str
    load_W: float
    minutes: float
    full_A: float
    end_A: float
    end_V: float
    rating_A: float
    c_rate: float
    verdict: str


def load_of(build: Build, mode: str) -> tuple[float, float]:
    """Power of the payload behind the boost converter, and from the cell beside it, W.

    5 V parts draw their current at the converter's own voltage (linear regulators follow). A
    3.3 V part hangs on the Pi's regulator, so its current counts at the converter's voltage, too.
    The converter's own idle current is the cell's.
    """
    boost = _boost(build)
    behind = beside = 0.0
    for part in build.payload:
        amperes = getattr(part, f"{mode}_mA") / 1000
        if part is boost:
            beside += amperes * boost.supply_V
        else:
            behind += amperes * boost.supply_V
    return behind, beside


def fly(build: Build, mode: str = "stream", wear: Wear | None = None) -> Endurance:
    """Flies the payload's cell empty; raises `HardwareError` for a build without cell or boost."""
    wear, cell_part, boost = wear or Wear(), payload_cell(build), _boost(build)
    behind, beside = load_of(build, mode)
    series = sum(part.series_ohm for part in build.payload)
    return drain(cell_part, boost, behind, beside, series, wear, mode)


def drain(
    part: Part, boost: Part, behind_W: float, beside_W: float, series_ohm: float, wear: Wear,
    mode: str = "stream",
) -> Endurance:  # fmt: skip
    """One cell under a constant power behind a boost converter.

    At each state of charge the voltage at the converter solves v = rest − R·P(v)/v by fixed-point
    steps, P(v) = behind/efficiency(v) + beside; the time is the sum of the charge between over the
    current.
    """
    capacity_ah = part.capacity_mAh / 1000 * wear.health_percent / 100
    cell = Cell(capacity_ah, temperature_c=wear.temperature_C)
    reserve = wear.reserve_percent / 100
    charge = np.linspace(1.0, reserve, _STEPS + 1)
    rest = np.array([cell.rest_v(one) for one in charge.tolist()])
    ohms = np.array([cell.total_ohm(one) for one in charge.tolist()]) + series_ohm
    volts = rest.copy()
    alive = np.ones_like(rest, dtype=bool)
    for _ in range(50):
        watts = behind_W / boost.efficiency_at(volts) + beside_W
        inside = rest**2 - 4 * ohms * watts
        alive = inside > 0
        volts = (rest + np.sqrt(np.maximum(inside, 0.0))) / 2
    amperes = (behind_W / boost.efficiency_at(volts) + beside_W) / volts
    alive &= volts > max(wear.cutoff_V, part.cutoff_V)
    count = len(charge) if alive.all() else int(np.argmin(alive))
    rating = min(part.max_discharge_A, boost.max_input_A or part.max_discharge_A)
    last = max(count - 1, 0)
    mean = (amperes[:last] + amperes[1 : last + 1]) / 2
    step_ah = capacity_ah * (1 - reserve) / _STEPS
    minutes = 60 * float(np.sum(step_ah / mean))
    end = float(amperes[last])
    verdict = "refuse" if end > rating else "warn" if end > 0.8 * rating else "ok"
    return Endurance(
        mode, behind_W, minutes, float(amperes[0]), end, float(volts[last]), rating,
        end / part.capacity_mAh * 1000, verdict if count else "none",
    )  # fmt: skip


def _boost(build: Build) -> Part:
    boost = build.part("boost")
    if boost is None:
        raise HardwareError(f"build {build.name!r} has no boost converter")
    return boost
