"""Parts and builds: nothing without a source, nothing unknown, every refusal names its part."""

from __future__ import annotations

from pathlib import Path

import pytest

from hw.builds import BUILDS_FILE, load_builds
from hw.parts import load_parts
from pi_firmware.wire.errors import BlimpError

GOOD = """
[[part]]
id = "brick"
name = "Brick"
role = "mount"
mass_g = 10.0
spread_g = 3.0
source = "estimated"
citation = "by eye"
weigh_it = true
manufacturer = "any"
part_number = "red"
"""


def refusal(tmp_path: Path, text: str) -> str:
    path = tmp_path / "parts.toml"
    path.write_text(text)
    with pytest.raises(BlimpError) as caught:
        load_parts(path)
    line = str(caught.value)
    assert "\n" not in line
    return line


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('source = "estimated"', "", "has no source; allowed: datasheet, measured, estimated"),
        ('source = "estimated"', 'source = "hearsay"', "'source' is 'hearsay'; allowed:"),
        ('citation = "by eye"', 'citation = " "', "it has no citation"),
        ("spread_g = 3.0", "spread_g = 1.0", "a spread of 1 g; allowed: 2 g and more"),
        ("weigh_it = true", "weigh_it = false", "must be marked weigh_it"),
        ("mass_g = 10.0", "mass_g = -10.0", "'mass_g' is -10.0; allowed: 0.0 to"),
        ("mass_g = 10.0", "mass_g = nan", "'mass_g' must be a finite number"),
        ("mass_g = 10.0", "mass = 10.0", "the key 'mass_g' is missing"),
        ("mass_g = 10.0", "mass_g = 10.0\nmass = 1", "unknown key 'mass'"),
        ("mass_g = 10.0", "mass_g = 10.0\nstream_mA = 5.0", "without a power_citation"),
        ('role = "mount"', 'role = "cell"', "a cell needs capacity_mAh"),
        ('role = "mount"', 'role = "boost"', "needs its efficiency"),
        ("mass_g = 10.0", "mass_g = 10.0\nefficiency = [[3.0, 1.2]]", "0 to 1"),
        ("mass_g = 10.0", "mass_g = 10.0\nefficiency = [[4.0, 0.9], [3.0, 0.9]]", "do not rise"),
    ],
)
def test_a_part_that_cannot_be_is_refused_by_name(
    tmp_path: Path, old: str, new: str, says: str
) -> None:
    line = refusal(tmp_path, GOOD.replace(old, new))
    assert "brick" in line and says in line


def test_a_part_whose_id_is_no_text_is_refused_by_its_place(tmp_path: Path) -> None:
    line = refusal(tmp_path, GOOD.replace('id = "brick"', f"id = [0x{'f' * 5000}]"))
    assert "part 1: 'id' must be a string, not a list" in line


def test_one_part_twice_is_refused(tmp_path: Path) -> None:
    assert "'brick' stands there twice" in refusal(tmp_path, GOOD + GOOD)


def test_the_builds_are_those_that_are_promised() -> None:
    catalogue = load_builds()
    promised = {
        f"{board}-{gauge}{pilot}"
        for board in ("zero-w", "zero-2-w")
        for gauge in ("ina219", "max17048")
        for pilot in ("", "-autopilot")
    }
    assert promised < set(catalogue.builds)
    for name in promised:
        build = catalogue.named(name)
        assert build.part("computer").id == ("pi-zero-w" if "zero-w" in name else "pi-zero-2-w")
        assert build.part("gauge").id.removeprefix("gauge-") in name
        assert (build.part("autopilot") is not None) == name.endswith("-autopilot")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"micro-sd"', '"floppy"', "part 'floppy' is not in parts.toml"),
        ("temperature_C = 22.0", "temperature_C = 500.0", "temperature_C is 500; allowed: -40 to"),
        ("temperature_C = 22.0", "temperature = 22.0", "unknown key 'temperature'"),
        ("purity_percent = 97.0", "purity_percent = 0.97", "purity_percent is 0.97; allowed: 50"),
        ('hull = "foil-0.19"', 'hull = "zeppelin"', "hull 'zeppelin'; there are:"),
        ('tail = ["fins"]', 'nose = ["fins"]', "station 'nose'; the hull has:"),
        ('default = "zero-2-w-max17048"', 'default = "x"', "'default' is 'x', which is no build"),
        ("ballast_to_mass_g = 352.0", "ballast_to_mass_g = 100.0", "ballast_g is -16"),
        ('camera = ["camera-v2"]', "camera = 5", "parts.camera must be a list of ids, not 5"),
        ('camera = ["camera-v2"]', 'camera = [["camera-v2"]]', "is not in parts.toml"),
        ('hull = "foil-0.19"', "hull = []", "'hull' must be a string, not []"),
        ('conditions = "hall"', "conditions = 5", "'conditions' must be a string, not 5"),
        ("[conditions.hall]", "[conditions.hall.x]", "unknown key 'x'"),
        ("ballast_to_mass_g = 352.0", 'ballast_to_mass_g = "all"', "must be a number, not 'all'"),
        ("gondola = [0.03, -0.28]", "gondola = [0.03]", "station 'gondola' must be"),
        ("diameter_m = 1.0775", "diameter_m = -1.0", "diameter_m is -1; allowed:"),
        ("film_g_m2 = 27.0", "film_g_m2 = 0.0", "film_g_m2 is 0; allowed:"),
    ],
)
def test_a_build_that_cannot_be_is_refused_by_name(
    tmp_path: Path, old: str, new: str, says: str
) -> None:
    text = BUILDS_FILE.read_text()
    assert old in text
    path = tmp_path / "builds.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(BlimpError) as caught:
        load_builds(path)
    assert says in str(caught.value) and "\n" not in str(caught.value)
