"""The experiments made short: to see that all works, on the way to a change."""

from __future__ import annotations

from dataclasses import replace

from ground_station.experiments.declaration import Declaration, FlightDeclaration, MapSpec
from ground_station.recording.frames import FrameRange
from ground_station.recording.open import parse_range

FLIGHT_S = 5.0
"""Length of a flight."""
IMAGES = 100
"""Most images of a map, and all that is simulated of its flight."""


def shortened(declaration: Declaration) -> Declaration:
    """One seed, the first seconds of every flight, maps of few images; the rows stay as they are.

    Maps that differ in nothing else are then the same. Of cases whose maps are registered by hand,
    each of a building of its own, there is the first.
    """
    experiments = []
    for experiment in declaration.experiments:
        cases = [
            replace(case, flight=_first_seconds(case.flight), map=_thinned(case.map))
            for k, case in enumerate(experiment.cases)
            if k == 0 or not case.map.flight.clicked
        ]
        experiments.append(replace(experiment, cases=cases))
    return replace(declaration, seeds=declaration.seeds[:1], experiments=experiments)


def _first_seconds(flight: FlightDeclaration) -> FlightDeclaration:
    """Its first seconds; of real pictures as many as that is."""
    if flight.simulated:
        return replace(flight, duration_s=min(flight.duration_s, FLIGHT_S))
    wanted = parse_range(flight.range) if flight.range else FrameRange()
    stop = wanted.start + round(FLIGHT_S * flight.rate_hz) * wanted.step
    stop = stop if wanted.stop is None else min(stop, wanted.stop)
    return replace(flight, range=f"{wanted.start}:{stop}:{wanted.step}")


def _thinned(spec: MapSpec) -> MapSpec:
    """Of few images, and none is simulated that is not among them."""
    if not spec.flight.simulated or spec.flight.clicked:
        return spec
    images = min(spec.images or IMAGES, IMAGES)
    rate_hz = min(spec.flight.rate_hz, images / spec.flight.duration_s)
    return replace(spec, images=images, flight=replace(spec.flight, rate_hz=rate_hz))
