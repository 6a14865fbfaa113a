"""The experiments made short: rows stay, flights and maps shrink."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from ground_station.experiments import declaration, plan
from ground_station.experiments.declaration import FlightDeclaration
from ground_station.experiments.plan import MapJob, RunJob
from ground_station.experiments.quick import FLIGHT_S, IMAGES, shortened
from ground_station.mapping.settings import MappingSettings

TEXT = """
seeds = [1, 2]
[experiment.light]
[experiment.light.case.noon]
[experiment.light.case.sunset]
flight.light = "sunset"
"""


@pytest.fixture
def declared(tmp_path):
    path = tmp_path / "e.toml"
    path.write_text(TEXT)
    return declaration.load(path)


def of(planned, kind):
    return [job for job in planned.jobs.values() if isinstance(job, kind)]


def test_quick_has_one_seed_short_flights_and_maps_of_which_nothing_is_flown_in_vain(declared):
    (experiment,) = declared.experiments
    large = [
        replace(
            case,
            map=replace(
                case.map, images=513, flight=FlightDeclaration(duration_s=50.0, rate_hz=12.0)
            ),
        )
        for case in experiment.cases
    ]
    declared = replace(declared, experiments=[replace(experiment, cases=large)])
    made = plan.make(shortened(declared), MappingSettings(), Path("none"))
    assert {job.seed for job in of(made, RunJob)} == {1}
    assert {job.flight.duration_s for job in of(made, RunJob)} == {FLIGHT_S}
    (mapped,) = of(made, MapJob)
    assert mapped.spec.images == IMAGES
    flown = mapped.spec.flight
    assert flown.duration_s == 50.0
    assert flown.duration_s * flown.rate_hz == pytest.approx(IMAGES)


def test_quick_takes_the_first_seconds_of_real_pictures(declared, tmp_path):
    folder = tmp_path / "hall"
    folder.mkdir()
    (tmp_path / "t.txt").touch()
    (tmp_path / "c.toml").touch()
    case = declared.experiments[0].cases[0]
    for given, taken in (("500:1000", "500:650:1"), ("500:600:2", "500:600:2"), ("", "0:150:1")):
        real = FlightDeclaration(
            folder="hall", truth="t.txt", camera="c.toml", range=given, rate_hz=30.0
        )
        one = replace(case, flight=real, map=replace(case.map, flight=real, images=0))
        only = replace(declared, experiments=[replace(declared.experiments[0], cases=[one])])
        made = plan.make(shortened(only), MappingSettings(), tmp_path)
        assert {job.flight.range for job in of(made, RunJob)} == {taken}
        assert {job.spec.flight.range for job in of(made, MapJob)} == {given}


def test_the_shipped_flights_are_long_enough_for_what_happens_in_them():
    short = shortened(declaration.load())
    for experiment in short.experiments:
        for case in experiment.cases:
            end_s = case.alter.dark_from_s + case.alter.dark_s
            assert case.flight.duration_s >= end_s + (1.0 if case.alter.dark_s else 0.0)
