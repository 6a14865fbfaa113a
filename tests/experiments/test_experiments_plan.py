"""Jobs: shared where they are the same, others where what they depend on differs; made short."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from ground_station.errors import InputError
from ground_station.experiments import declaration, plan
from ground_station.experiments.alter import Alteration
from ground_station.experiments.declaration import FLIGHT_S, IMAGES, FlightDeclaration, shortened
from ground_station.experiments.maps import evenly
from ground_station.experiments.plan import FlightJob, LensJob, MapJob, RunJob
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.mapping.settings import MappingSettings
from ground_station.simulator.plans import PHONE_CAMERA
from ground_station.simulator.unsteady import unsteady

TEXT = """
seeds = [1, 2]
[experiment.light]
[experiment.light.case.noon]
[experiment.light.case.sunset]
flight.light = "sunset"
[experiment.again]
[experiment.again.case.noon]
"""


@pytest.fixture
def declared(tmp_path):
    path = tmp_path / "e.toml"
    path.write_text(TEXT)
    return declaration.load(path)


def of(planned, kind):
    return [job for job in planned.jobs.values() if isinstance(job, kind)]


def test_what_is_the_same_is_made_once(declared):
    planned = plan.make(declared, MappingSettings(), Path("none"))
    # Two lights with two seeds, and the map's; the second experiment adds nothing.
    assert len(of(planned, FlightJob)) == 5
    assert len(of(planned, MapJob)) == 1
    assert len(of(planned, RunJob)) == 2 * 2 * 3
    assert planned.runs["light", "noon"] == planned.runs["again", "noon"]
    assert {len(keys) for case in planned.runs.values() for keys in case.values()} == {2}
    assert len({job.name for job in of(planned, FlightJob)}) == 5


def test_every_job_comes_after_what_it_needs(declared):
    planned = plan.make(declared, MappingSettings(), Path("none"))
    before: set[str] = set()
    for key in planned.jobs:
        assert set(planned.needs[key]) <= before
        before.add(key)
    run = of(planned, RunJob)[0]
    kinds = {type(planned.jobs[key]) for key in planned.needs[run.key]}
    assert kinds == {MapJob, FlightJob}


def test_a_changed_setting_makes_only_what_it_touches_anew(declared):
    first = plan.make(declared, MappingSettings(), Path("none"))
    second = plan.make(declared, MappingSettings(seed=5), Path("none"))

    def keys(planned, kind):
        return {job.key for job in of(planned, kind)}

    assert keys(first, FlightJob) == keys(second, FlightJob)
    assert not keys(first, MapJob) & keys(second, MapJob)
    assert not keys(first, RunJob) & keys(second, RunJob)
    darker = [replace(c, alter={**c.alter, "blur_px": 1.0}) for c in declared.experiments[0].cases]
    blurred = replace(declared, experiments=[replace(declared.experiments[0], cases=darker)])
    third = plan.make(blurred, MappingSettings(), Path("none"))
    assert keys(first, MapJob) == keys(third, MapJob)
    assert keys(first, FlightJob) == keys(third, FlightJob)
    assert not keys(first, RunJob) & keys(third, RunJob)


def test_a_camera_is_calibrated_once_a_seed_and_flown_once_whatever_is_known_of_it(declared):
    (noon, sunset) = declared.experiments[0].cases

    def known(case, **flight):
        walked = replace(case.map, flight=replace(case.map.flight, plan="walk", calibrated=True))
        return replace(case, flight=replace(case.flight, calibrated=True, **flight), map=walked)

    cases = [known(noon), known(sunset), known(noon, processing="camera")]
    film = replace(declared, experiments=[replace(declared.experiments[0], cases=cases)])
    planned = plan.make(film, MappingSettings(), Path("none"))
    lenses = of(planned, LensJob)
    # The payload's by two seeds, processed or not, whatever the light; the walk's by its own.
    assert len(lenses) == len({job.name for job in lenses}) == 5
    assert {job.camera for job in lenses} == {THESIS_CAMERA, PHONE_CAMERA}
    named = {job.name: job for job in lenses}
    for job in of(planned, RunJob):
        lens = named[job.lens]
        assert (lens.camera, lens.seed) == (THESIS_CAMERA, job.seed)
        assert lens.processing == job.flight.processing
        assert lens.key in planned.needs[job.key]
    (mapped,) = of(planned, MapJob)
    assert named[mapped.lens].camera == PHONE_CAMERA and named[mapped.lens].seed == 101
    assert named[mapped.lens].key in planned.needs[mapped.key]
    plain = plan.make(declared, MappingSettings(), Path("none"))
    flown = {job.name for job in of(plain, FlightJob)}
    assert {job.recording for job in of(planned, RunJob) if job.flight == cases[0].flight} <= flown
    assert {job.lens for job in of(plain, RunJob) + of(plain, MapJob)} == {None}
    assert not {j.key for j in of(plain, RunJob)} & {j.key for j in of(planned, RunJob)}


def test_unknown_features_are_refused_before_anything_is_flown(declared):
    case = declared.experiments[0].cases[0]
    wrong = replace(case, map=replace(case.map, features="wings"))
    broken = replace(declared, experiments=[replace(declared.experiments[0], cases=[wrong])])
    with pytest.raises(InputError, match=r"case 'noon': there is no extractor 'wings'"):
        plan.make(broken, MappingSettings(), Path("none"))


def test_real_pictures_that_are_not_there_are_refused_by_name(declared, tmp_path):
    case = declared.experiments[0].cases[0]
    real = replace(case.flight, folder="kitchen", truth="t.txt", camera="c.toml")
    wrong = replace(case, flight=real)
    broken = replace(declared, experiments=[replace(declared.experiments[0], cases=[wrong])])
    with pytest.raises(InputError, match="kitchen: there is no such folder"):
        plan.make(broken, MappingSettings(), tmp_path)


def test_comments_and_docstrings_do_not_make_another_program():
    plain = plan._meaning("def f(a):\n    return a + 1\n")
    told = plan._meaning('"""Room."""\n\n\ndef f(a):\n    """Adds."""\n    return a + 1  # why\n')
    other = plan._meaning("def f(a):\n    return a + 2\n")
    assert plain == told != other
    assert len({plan.code_sha256(kind) for kind in plan.ROOMS}) == len(plan.ROOMS)


@pytest.mark.parametrize("total", [600, 500, 250, 138, 137])
def test_a_map_has_the_images_asked_for_from_the_first_to_the_last(total):
    chosen = sorted(evenly(total, 137))
    assert len(chosen) == 137 and chosen[0] == 0 and chosen[-1] == total - 1
    steps = {b - a for a, b in pairwise(chosen)}
    assert max(steps) - min(steps) <= 1
    assert evenly(total, 0) == evenly(total, total + 1) == set(range(total))
    assert evenly(total, 1) == {0}


def test_rooms_of_the_program_are_there():
    for room in {room for rooms in plan.ROOMS.values() for room in rooms}:
        assert (plan._ROOT / room).exists(), room


def test_quick_has_one_seed_short_flights_and_maps_of_which_nothing_is_flown_in_vain(declared):
    experiment = declared.experiments[0]
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
    assert {job.flight.rate_hz for job in of(made, RunJob)} == {
        case.flight.rate_hz / 2 for case in large
    }
    (mapped,) = of(made, MapJob)
    assert mapped.spec.images == IMAGES
    flown = mapped.spec.flight
    assert flown.duration_s == 50.0
    assert flown.duration_s * flown.rate_hz == pytest.approx(IMAGES)


def test_quick_flies_the_ends_of_each_table():
    whole = declaration.load()
    for long, short in zip(whole.experiments, shortened(whole).experiments, strict=True):
        names = [case.name for case in long.cases]
        ends = names[:1] if long.cases[0].map.flight.clicked else [names[0], *names[1:][-1:]]
        assert [case.name for case in short.cases] == ends


def test_quick_takes_the_first_seconds_of_real_pictures(declared, tmp_path):
    folder = tmp_path / "hall"
    folder.mkdir()
    (tmp_path / "t.txt").touch()
    (tmp_path / "c.toml").touch()
    case = declared.experiments[0].cases[0]
    for given, taken in (("500:1000", "500:650:2"), ("500:600:2", "500:600:4"), ("", "0:150:2")):
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
            end_s = Alteration.of(case.alter, case.name).blind_until_s
            assert end_s is None or case.flight.duration_s >= end_s + 1.0
            changes = unsteady(case.flight.exposure_steps, case.flight.light_steps)
            for steps in (changes.exposure_ev, changes.light):
                assert all(case.flight.duration_s > at_s + 0.9 for at_s in steps.time_s[:2])
