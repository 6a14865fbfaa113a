"""Simulated flights, each made once and kept under a name that tells it."""

from __future__ import annotations

from pathlib import Path

from ground_station.experiments.declaration import FlightDeclaration
from ground_station.simulator.simulate import SimulationSettings, simulate


def stem(flight: FlightDeclaration, seed: int) -> str:
    """How a simulated flight is called; its job's key tells the rest."""
    rate = f"-{flight.bitrate_kbps}kbps" if flight.bitrate_kbps else ""
    air = "" if flight.draught_m_s is None else f"-{flight.draught_m_s:g}ms"
    crowd = f"-{flight.people}people" if flight.people else ""
    processed = "" if flight.processing == "none" else f"-{flight.processing}-processing"
    stepped = "-stepped" if flight.exposure_steps or flight.light_steps else ""
    lamps = f"-{flight.flicker:g}flicker" if flight.flicker else ""
    return (
        f"{flight.scene}-{flight.plan}-{flight.light}-{seed}"
        f"-{flight.duration_s:g}s-{flight.rate_hz:g}Hz{rate}{air}{crowd}{stepped}{lamps}"
        f"{processed}"
    )


def points_of(recording: Path) -> Path:
    """Where the observations of surveyed points in a recording lie."""
    return recording.with_suffix(".csv")


def fly(flight: FlightDeclaration, seed: int, path: Path) -> None:
    """Simulates a flight into a recording, written whole or not at all."""
    settings = SimulationSettings(
        out=path,
        scene=flight.scene,
        plan=flight.plan,
        light=flight.light,
        seed=seed,
        duration_s=flight.duration_s,
        rate_hz=flight.rate_hz,
        bitrate_kbps=flight.bitrate_kbps or None,
        draught_m_s=flight.draught_m_s,
        people=flight.people,
        exposure_steps=flight.exposure_steps,
        light_steps=flight.light_steps,
        flicker=flight.flicker,
        processing=flight.processing,
        points=points_of(path) if flight.clicked else None,
    )
    if simulate(settings).interrupted:
        path.unlink(missing_ok=True)
        raise KeyboardInterrupt
