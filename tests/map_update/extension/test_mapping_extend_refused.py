"""What cannot join a map is one line, and whatever happens the old map is whole."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from corridor_light import RATE_HZ, SETTINGS
from hand_made import NO_KEYFRAMES, content, run

from ground_station.commands import maps
from ground_station.errors import InputError, MapError
from ground_station.features.extractor import FeatureError
from ground_station.map import store
from ground_station.map_update.extension import extend, localizing
from ground_station.map_update.extension.extend import extend_map
from ground_station.mapping.settings import MappingSettings
from ground_station.recording.folder import ImageFolder

HERE = Path(__file__).parent
ROOT = HERE.parents[2]


def _extend(world, out, *inputs, **more):
    return extend_map(world.folder, inputs, SETTINGS, out=out, rate_hz=RATE_HZ, **more)


@pytest.fixture
def folder(corridor_world, tmp_path) -> Path:
    """A copy of the corridor's map."""
    return shutil.copytree(corridor_world.folder, tmp_path / "map")


def _pictures(folder: Path, size=(480, 640), number=255, count=4) -> Path:
    folder.mkdir()
    image = np.zeros(size, np.uint8)
    image[0, 0] = number
    for k in range(count):
        cv2.imwrite(str(folder / f"{k:03d}.png"), image)
    return folder


def test_an_input_that_cannot_join_is_one_line(corridor_world, tmp_path):
    world, out = corridor_world, tmp_path / "out"
    before = content(world.folder)
    sunset, elsewhere = world.flights["sunset"], tmp_path / "elsewhere"
    elsewhere.mkdir()
    for path in sorted(world.flights["elsewhere"].iterdir())[-3:]:
        shutil.copy(path, elsewhere / path.name)
    copied = tmp_path / "other" / "sunset"
    shutil.copytree(sunset, copied)
    cases = [
        ([elsewhere], MapError, "none of its 3 frames could be localized in the map 'corridor'"),
        ([_pictures(tmp_path / "small", (240, 320))], MapError, "have 320x240 px.*640x480"),
        ([sunset, copied], MapError, "two inputs are named 'sunset'"),
        ([tmp_path / "nowhere.mcap"], InputError, "nowhere.mcap"),
    ]
    for inputs, kind, words in cases:
        with pytest.raises(kind, match=words) as caught:
            _extend(world, out, *inputs)
        assert "\n" not in str(caught.value)
    assert not out.exists() and content(world.folder) == before


def test_another_camera_is_refused_by_its_size_before_a_frame_is_read(corridor_world, tmp_path):
    other = dataclasses.replace(store.load(corridor_world.folder).info.camera, width_px=320)
    with pytest.raises(MapError, match="320x480 px"):
        _extend(corridor_world, tmp_path / "out", corridor_world.flights["sunset"], camera=other)


def test_a_map_of_features_that_are_not_here_is_refused_by_name(folder, short_flight):
    toml = folder / "map.toml"
    text = toml.read_text()
    toml.write_text(text.replace('name = "corridor"\nsha256', 'name = "superglue"\nsha256'))
    with pytest.raises(MapError, match=r"'superglue'.*not here"):
        extend_map(folder, [short_flight], SETTINGS, rate_hz=RATE_HZ)
    toml.write_text(text.replace("c" * 64, "d" * 64))
    with pytest.raises((MapError, FeatureError), match=r"d{12}"):
        extend_map(folder, [short_flight], SETTINGS, rate_hz=RATE_HZ)


def test_a_map_without_keyframes_is_refused(folder, short_flight):
    store.save_tables(folder, dataclasses.replace(store.load(folder), keyframes=NO_KEYFRAMES))
    with pytest.raises(MapError, match="holds no keyframes"):
        extend_map(folder, [short_flight], SETTINGS, rate_hz=RATE_HZ)


def test_the_command_prints_before_and_after_and_refuses_the_same_flight(
    folder, short_flight, tmp_path, capsys
):
    before = content(folder)
    settings = tmp_path / "settings.toml"
    settings.write_text("threads = 1\n[extend]\nmin_track = 3\n")
    words = [maps, "extend", folder, short_flight, "--rate-hz", RATE_HZ, "--settings", settings]
    assert run(*words, "--json", tmp_path / "extend.json") == 0
    printed, report = capsys.readouterr().out, json.loads((tmp_path / "extend.json").read_text())
    for name in ("keyframes", "landmarks", "modes", "bytes"):
        assert f"{report[name][0]} -> {report[name][1]}" in printed
        assert report[name][1] > report[name][0]
    kept = tmp_path / "map.before"
    assert content(kept) == before and str(kept) in printed
    assert len(store.load(folder).keyframes) == report["keyframes"][1]
    after = content(folder)
    with pytest.raises(MapError, match="the flight 'short' is in the map already"):
        run(*words)
    assert content(folder) == after
    with pytest.raises(MapError, match="is the map itself"):
        run(*words, "--out", folder)
    with pytest.raises(InputError, match="its folder does not exist"):
        run(*words, "--json", tmp_path / "none" / "f.json")


@pytest.mark.parametrize("moment", ["describe", "save_info"])
def test_stopped_at_any_moment_it_leaves_the_old_map(
    folder, short_flight, tmp_path, monkeypatch, moment
):
    map_ = store.load(folder)
    map_.info.built["noise_px"] = 0.3
    store.save_tables(folder, map_)
    before = content(folder)

    losses = []

    def stop(*given, **__):
        losses.extend(one.sfm.loss_px for one in given if isinstance(one, MappingSettings))
        raise KeyboardInterrupt

    monkeypatch.setattr(extend if moment == "describe" else extend.store, moment, stop)
    with pytest.raises(KeyboardInterrupt):
        extend_map(folder, [short_flight], SETTINGS, rate_hz=RATE_HZ)
    assert content(folder) == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["map", "short"]
    # What is new is adjusted with a loss as wide as the noise that the map's build found.
    assert losses == ([0.3] if moment == "describe" else [])


def test_killed_while_it_writes_it_leaves_the_old_map(
    corridor_world, folder, short_flight, tmp_path
):
    before = content(folder)
    pictures = corridor_world.corridor.pictures[:9]
    arrays = {
        f"{name}{k}": getattr(picture, name)
        for k, picture in enumerate(pictures)
        for name in ("keypoints_px", "descriptors")
    }
    np.savez(tmp_path / "pictures.npz", **arrays)
    script = (
        "import os, signal, sys\n"
        "import numpy as np\n"
        "from corridor_light import RATE_HZ, SETTINGS, Corridor, extractors\n"
        "from ground_station.features.extractor import Features\n"
        "from ground_station.map_update.extension import extend\n"
        "kept = np.load(sys.argv[3])\n"
        "rows = [(kept[f'keypoints_px{k}'], kept[f'descriptors{k}']) for k in range(9)]\n"
        "pictures = [Features(p, np.ones(len(p), np.float32), d) for p, d in rows]\n"
        "world = Corridor(None, None, None, None, None, pictures)\n"
        "extractors.METHODS['corridor'] = lambda _: world\n"
        "write = extend.store.save_tables\n"
        "def killed(*words, **more):\n"
        "    write(*words, **more)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "extend.store.save_tables = killed\n"
        "extend.extend_map(sys.argv[1], [sys.argv[2]], SETTINGS, rate_hz=RATE_HZ)\n"
    )
    path = os.pathsep.join(map(str, (HERE, ROOT / "tests/mapping", ROOT)))
    words = [str(folder), str(short_flight), str(tmp_path / "pictures.npz")]
    done = subprocess.run(
        [sys.executable, "-c", script, *words],
        env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert content(folder) == before
    # What it left beside is in nobody's way.
    extend_map(folder, [short_flight], SETTINGS, rate_hz=RATE_HZ)
    assert len(store.load(folder).keyframes) > 25
    assert sorted(p.name for p in tmp_path.iterdir() if "map" in p.name) == ["map", "map.before"]


def test_an_input_that_is_cut_is_used_as_far_as_it_goes_and_said(
    corridor_world, short_flight, tmp_path, monkeypatch
):
    class Cut(ImageFolder):
        """As a recording that ends in the middle: whole frames, then a note."""

        def __iter__(self):
            self.notes.clear()
            yield from super().__iter__()
            self.notes.append(f"{short_flight}: cut (end of file); 9 frames read")

    monkeypatch.setattr(
        localizing, "open_input", lambda path, rate_hz, wanted: Cut(Path(path), rate_hz)
    )
    _, result = _extend(corridor_world, tmp_path / "out", short_flight)
    assert result.notes == [f"{short_flight}: cut (end of file); 9 frames read"]
    assert result.report["flights"][0]["frames_read"] == 9
