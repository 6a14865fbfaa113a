"""What experiments.toml may say, and what becomes of it."""

from __future__ import annotations

import pytest

from ground_station.errors import InputError
from ground_station.experiments import declaration
from pi_firmware.wire.errors import ConfigError

SMALL = """
seeds = [7, 8]
[default]
presets = ["thesis", "default"]
[default.flight]
rate_hz = 10.0
[default.map]
images = 50
[default.map.flight]
plan = "mapping"
[experiment.light]
title = "Light"
question = "Which?"
flight.scene = "office"
[experiment.light.case.noon]
thesis.position_m = 0.1
[experiment.light.case.sunset]
title = "at sunset"
flight.light = "sunset"
flight.bitrate_kbps = 300
presets = ["default"]
localizer.gate.min_entropy_bits = 7.0
map.flight.light = "cloudy"
"""


def load(tmp_path, text=SMALL, only=None):
    path = tmp_path / "e.toml"
    path.write_text(text)
    return declaration.load(path, only)


def test_a_case_is_the_default_with_its_experiments_and_its_own_words_on_top(tmp_path):
    declared = load(tmp_path)
    assert declared.seeds == (7, 8)
    (light,) = declared.experiments
    noon, sunset = light.cases
    assert (light.title, light.question) == ("Light", "Which?")
    assert (noon.title, noon.presets, noon.thesis.position_m) == (
        "noon",
        ["thesis", "default"],
        0.1,
    )
    assert (noon.flight.scene, noon.flight.light, noon.flight.rate_hz) == ("office", "noon", 10.0)
    assert (sunset.title, sunset.presets) == ("at sunset", ["default"])
    assert sunset.flight.light == "sunset" and sunset.thesis.position_m is None
    assert sunset.localizer == {"gate": {"min_entropy_bits": 7.0}} and noon.localizer == {}


def test_a_map_is_of_the_cases_place_but_not_of_its_light_rate_or_bit_rate(tmp_path):
    noon, sunset = load(tmp_path).experiments[0].cases
    assert noon.map.flight.scene == sunset.map.flight.scene == "office"
    assert noon.map.images == 50 and noon.map.flight.plan == "mapping"
    assert noon.map.flight.light == "noon" and sunset.map.flight.light == "cloudy"
    assert sunset.map.flight.bitrate_kbps == 0 and sunset.map.flight.rate_hz != 10.0


def test_the_shipped_file_holds_every_experiment_of_the_thesis():
    declared = declaration.load()
    names = [experiment.name for experiment in declared.experiments]
    assert names[:6] == ["pillars", "descriptor", "illumination", "viewpoint", "motion", "fast"]
    assert len(declared.seeds) >= 3
    by_name = {e.name: e for e in declared.experiments}
    lights = [case.flight.light for case in by_name["illumination"].cases]
    assert lights == ["noon", "cloudy", "evening", "sunset"]
    assert {case.map.flight.light for case in by_name["illumination"].cases} == {"noon"}
    assert [case.map.images for case in by_name["viewpoint"].cases] == [126, 513]
    models = [case.localizer["motion"]["model"] for case in by_name["motion"].cases]
    assert models == ["static", "constant_velocity", "blimp"] * 2
    kitchen = by_name["redkitchen"].cases[0]
    assert not kitchen.flight.simulated and not kitchen.map.flight.simulated
    assert kitchen.map.flight.range == "0:500:5" and kitchen.flight.range == "500:1000"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seeds = [7, 8]", "seeds = [7, 7]", "'seeds' must be a list of different whole numbers"),
        ("seeds = [7, 8]", "seeds = []", "'seeds' must be"),
        ("seeds = [7, 8]", "sides = [7]", "unknown key 'sides'"),
        ('title = "Light"', 'titel = "Light"', "experiment 'light': unknown key 'titel'"),
        (
            "flight.bitrate_kbps = 300",
            "flight.bitrate_kbps = -1",
            "bitrate_kbps' is -1; allowed",
        ),
        ("flight.bitrate_kbps = 300", "flight.rate_hz = nan", "finite"),
        (
            'presets = ["default"]',
            'presets = ["best"]',
            "'presets'.0. is 'best'; allowed: 'thesis'",
        ),
        ("images = 50", 'images = "many"', "'map.images' must be a whole number"),
        ("thesis.position_m = 0.1", "thesis = 3", "'thesis' must be a table"),
    ],
)
def test_what_is_wrong_is_refused_in_one_line_that_names_it(tmp_path, old, new, words):
    assert old in SMALL
    with pytest.raises(ConfigError, match=words) as caught:
        load(tmp_path, SMALL.replace(old, new))
    assert "\n" not in str(caught.value)


def test_an_unknown_experiment_is_refused_with_those_there_are(tmp_path):
    with pytest.raises(InputError, match=r"no experiment 'lihgt' \(there are: light\)"):
        load(tmp_path, only=["lihgt"])


REAL = ["redkitchen", "hallway"]


def test_real_pictures_that_are_not_there_leave_their_experiment_out(tmp_path):
    declared = declaration.load()
    kept, lines = declaration.without_missing(declared, tmp_path)
    assert [e.name for e in declared.experiments if e not in kept.experiments] == REAL
    assert len(lines) == 2 and all(name in line for name, line in zip(REAL, lines, strict=True))
    for name in REAL:
        (tmp_path / name / "frames").mkdir(parents=True)
    assert declaration.without_missing(declared, tmp_path) == (declared, [])


def test_settings_are_changed_through_the_checks_of_their_file():
    from ground_station.localization.settings import load_preset

    settings = load_preset("default")
    changed = declaration.changed(settings, {"gate": {"min_entropy_bits": 7}}, "here")
    assert changed.gate.min_entropy_bits == 7.0 and settings.gate.min_entropy_bits == 0.0
    assert changed.motion == settings.motion
    with pytest.raises(ConfigError, match=r"here: 'gate.min_entropy_bits' is 9"):
        declaration.changed(settings, {"gate": {"min_entropy_bits": 9}}, "here")
    with pytest.raises(ConfigError, match="unknown key 'gait'"):
        declaration.changed(settings, {"gait": {}}, "here")


def test_other_features_take_the_place_of_each_rows_own(tmp_path):
    text = (
        SMALL
        + """
[experiment.descriptor.case.sift]
title = "RootSIFT"
[experiment.descriptor.case.orb]
map.features = "orb"
"""
    )
    declared = declaration.with_features(load(tmp_path, text), ["wren", "orb"])
    light, descriptor = declared.experiments
    assert [(case.name, case.title, case.map.features) for case in light.cases] == [
        ("noon-wren", "noon, wren", "wren"),
        ("noon-orb", "noon, orb", "orb"),
        ("sunset-wren", "at sunset, wren", "wren"),
        ("sunset-orb", "at sunset, orb", "orb"),
    ]
    assert light.cases[0].thesis.position_m is None and not declared.claims
    assert [(case.title, case.map.features) for case in descriptor.cases] == [
        ("wren", "wren"), ("orb", "orb"),
    ]  # fmt: skip
