"""Densities of moist air and of lifting helium, by CoolProp; the standard atmosphere's pressure."""

from __future__ import annotations

import math

from hw.quantities import HardwareError

STANDARD_PRESSURE_HPA = 1013.25
_KELVIN = 273.15


def pressure_at_altitude(altitude_m: float) -> float:
    """Pressure in hPa at an altitude, -430 to 9000 m.

    The troposphere of the International Standard Atmosphere (ISO 2533, 1975): 288.15 K and
    1013.25 hPa at 0 m, 6.5 K less each km.
    """
    exponent = 9.80665 / (287.05287 * 0.0065)
    return float(STANDARD_PRESSURE_HPA * (1 - 0.0065 * altitude_m / 288.15) ** exponent)


def air_kg_m3(temperature_C: float, pressure_hPa: float, humidity_percent: float = 0.0) -> float:
    """Density of moist air, kg/m³; humidity is relative.

    CoolProp's HAPropsSI, after Herrmann, Kretzschmar and Gatley, 'Thermodynamic properties of real
    moist air', ASHRAE RP-1485, 2009. Raises `HardwareError` for a state that cannot be.
    """
    from CoolProp.CoolProp import HAPropsSI

    volume = HAPropsSI(
        "Vha", "T", temperature_C + _KELVIN, "P", 100 * pressure_hPa, "R", humidity_percent / 100
    )
    if not math.isfinite(volume) or volume <= 0:
        raise HardwareError(
            f"temperature_C {temperature_C:g}, pressure_hPa {pressure_hPa:g} and humidity_percent"
            f" {humidity_percent:g} together are no state of moist air"
        )
    return 1 / float(volume)


def helium_kg_m3(
    temperature_C: float,
    pressure_hPa: float,
    purity_percent: float = 100.0,
    superpressure_Pa: float = 0.0,
) -> float:
    """Density of helium in an envelope, kg/m³.

    Purity is helium's share of the volume, as on a cylinder; the rest is taken for dry air. Pure
    helium by CoolProp (Ortiz-Vega and others, J. Phys. Chem. Ref. Data 49, 2020); volumes of the
    two add (Amagat's law). Superpressure, above the air outside, compresses both.
    """
    from CoolProp.CoolProp import PropsSI

    state = ("T", temperature_C + _KELVIN, "P", 100 * pressure_hPa + superpressure_Pa)
    share = purity_percent / 100
    helium = float(PropsSI("D", *state, "Helium"))
    return share * helium + (1 - share) * float(PropsSI("D", *state, "Air"))
