"""Jobs: shared where they are the same, others where what they depend on differs."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from ground_station.errors import InputError
from ground_station.experiments import declaration, plan, program
from ground_station.experiments.maps import evenly
from ground_station.experiments.plan import FlightJob, MapJob, RunJob
from ground_station.mapping.settings import MappingSettings

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
    assert len(of(planned, RunJob)) == 2 * 2 * 2
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
    darker = [
        replace(c, alter=replace(c.alter, blur_px=1.0)) for c in declared.experiments[0].cases
    ]
    blurred = replace(declared, experiments=[replace(declared.experiments[0], cases=darker)])
    third = plan.make(blurred, MappingSettings(), Path("none"))
    assert keys(first, MapJob) == keys(third, MapJob)
    assert keys(first, FlightJob) == keys(third, FlightJob)
    assert not keys(first, RunJob) & keys(third, RunJob)


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
    plain = program._meaning("def f(a):\n    return a + 1\n")
    told = program._meaning(
        '"""Room."""\n\n\ndef f(a):\n    """Adds."""\n    return a + 1  # why\n'
    )
    other = program._meaning("def f(a):\n    return a + 2\n")
    assert plain == told != other
    assert len({program.code_sha256(kind) for kind in program.ROOMS}) == 3


@pytest.mark.parametrize("total", [600, 500, 250, 138, 137])
def test_a_map_has_the_images_asked_for_from_the_first_to_the_last(total):
    chosen = sorted(evenly(total, 137))
    assert len(chosen) == 137 and chosen[0] == 0 and chosen[-1] == total - 1
    steps = {b - a for a, b in pairwise(chosen)}
    assert max(steps) - min(steps) <= 1
    assert evenly(total, 0) == evenly(total, total + 1) == set(range(total))
    assert evenly(total, 1) == {0}


def test_rooms_of_the_program_are_there():
    for room in {room for rooms in program.ROOMS.values() for room in rooms}:
        assert (program._ROOT / room).exists(), room
