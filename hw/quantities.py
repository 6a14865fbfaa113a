"""Every physical input: its name with the unit in it, its range, and one way to refuse it."""

from __future__ import annotations

import math

from pi_firmware.wire.errors import BlimpError


class HardwareError(BlimpError):
    """A part, build or physical input that cannot be; one line that names value and limit."""


RANGES: dict[str, tuple[float, float]] = {
    "temperature_C": (-40.0, 60.0),
    "pressure_hPa": (300.0, 1100.0),
    "altitude_m": (-430.0, 9000.0),
    "humidity_percent": (0.0, 100.0),
    "purity_percent": (50.0, 100.0),
    "superpressure_Pa": (0.0, 5000.0),
    "leak_percent_per_day": (0.0, 50.0),
    "days": (0.0, 365.0),
    "air_kg_m3": (0.3, 2.0),
    "helium_kg_m3": (0.05, 1.5),
    "volume_m3": (1e-4, 1000.0),
    "volume_sigma_percent": (0.0, 50.0),
    "diameter_m": (0.05, 20.0),
    "length_m": (0.05, 40.0),
    "width_m": (0.05, 20.0),
    "free_lift_g": (-1e6, 1e6),
    "envelope_g": (0.0, 1e6),
    "fins_g": (0.0, 1e6),
    "mechanism_g": (0.0, 1e6),
    "payload_g": (0.0, 1e6),
    "ballast_g": (0.0, 1e6),
    "film_g_m2": (1.0, 1000.0),
    "required_g": (-1e6, 1e6),
    "capacity_mAh": (50.0, 20000.0),
    "cutoff_V": (2.5, 4.0),
    "health_percent": (10.0, 100.0),
    "reserve_percent": (0.0, 90.0),
}
"""Smallest and largest value that is taken, both included."""

_UNITS = {
    "temperature_C": "°C", "pressure_hPa": "hPa", "humidity_percent": "%", "purity_percent": "%",
    "superpressure_Pa": "Pa", "leak_percent_per_day": "% a day", "air_kg_m3": "kg/m³",
    "helium_kg_m3": "kg/m³", "volume_m3": "m³", "volume_sigma_percent": "%",
    "film_g_m2": "g/m²", "capacity_mAh": "mAh", "health_percent": "%", "reserve_percent": "%",
}  # fmt: skip


def unit_of(name: str) -> str:
    """The unit that the name of an input carries, as it is printed; "" for a pure number."""
    if name in _UNITS:
        return _UNITS[name]
    return {"m": "m", "g": "g", "V": "V"}.get(name.rsplit("_", 1)[-1], "")


def checked(name: str, value: float) -> float:
    """The value, when it is finite and inside `RANGES[name]`; else a `HardwareError` by name."""
    low, high = RANGES[name]
    if not (math.isfinite(value) and low <= value <= high):
        unit = unit_of(name)
        raise HardwareError(
            f"{name} is {value:g}; allowed: {low:g} to {high:g}{' ' + unit if unit else ''}"
        )
    return value
