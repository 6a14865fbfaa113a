"""What a refinement refuses: observations of other maps, files that are cut, foreign or hostile."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hand_made import NO_KEYFRAMES
from refining import SETTINGS

from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.map import store
from ground_station.map.observations import landmarks_sha256, load_observations, save_observations
from ground_station.mapping.refinement.refine import refine_map


def test_observations_of_another_map_are_refused_by_name(world):
    flight = dataclasses.replace(world.flight(), landmarks_sha256="1" * 64, map="cellar")
    with pytest.raises(MapError, match=r"'flight' was localized in another map \('cellar'\)"):
        refine_map(world.folder, [flight], SETTINGS)
    assert [p.name for p in world.folder.parent.iterdir()] == ["room"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: {"wTc": f.wTc @ poses.exp([0, 0.3, 0, 0, 0, 0])}, "misfit: 22"),
        (lambda f: {"wTc": _far(f.wTc)}, "few observations: 24"),
        (lambda f: {"landmark": f.landmark + 100_000}, "few observations: 24"),
        (lambda f: {"time_ns": f.time_ns * 100}, "no velocity: 24"),
    ],
)
def test_a_flight_that_does_not_fit_is_refused_with_the_reason(world, change, words):
    flight = world.flight()
    camera = dataclasses.replace(flight.camera, readout_s=0.02)
    flight = dataclasses.replace(flight, camera=camera, **change(flight))
    with pytest.raises(MapError, match=words) as caught:
        refine_map(world.folder, [flight], SETTINGS)
    assert "\n" not in str(caught.value) and "'flight'" in str(caught.value)


def _far(wTc):
    moved = wTc.copy()
    moved[:, :3, 3] = 1e300
    return moved


def test_an_empty_flight_and_a_map_without_observations_are_refused(world):
    empty = dataclasses.replace(
        world.flight(),
        time_ns=np.empty(0, np.int64),
        wTc=np.empty((0, 4, 4)),
        offset=np.zeros(1, np.int64),
        landmark=np.empty(0, np.int64),
        pixel_px=np.empty((0, 2), np.float32),
    )
    save_observations(world.folder.with_name("empty"), empty)
    empty = load_observations(world.folder.with_name("empty"))
    with pytest.raises(MapError, match="no frame that could be added"):
        refine_map(world.folder, [empty], SETTINGS)
    store.save_tables(world.folder, dataclasses.replace(world.map, keyframes=NO_KEYFRAMES))
    with pytest.raises(MapError, match="no keyframes' observations"):
        refine_map(world.folder, [], SETTINGS)


@pytest.mark.parametrize(
    "table",
    [
        {"flights": [{"name": "x", "frames": 99}]},
        {"flights": [{"name": "x", "frames": -1}]},
        {"flights": [{"name": 3, "frames": 1}]},
        {"flights": "many"},
        {"runs": "one"},
        {"pixels_at": "noon"},
        {"landmarks_sha256": 3},
    ],
)
def test_a_map_whose_table_is_wrong_is_refused(world, table):
    store.save_tables(
        world.folder,
        dataclasses.replace(world.map, info=dataclasses.replace(world.map.info, refined=table)),
    )
    with pytest.raises(MapError, match="the table 'refined'"):
        refine_map(world.folder, [], SETTINGS)


def test_observations_come_back_as_they_were(world, tmp_path):
    flight = world.flight()
    save_observations(tmp_path / "f.safetensors", flight)
    again = load_observations(tmp_path / "f.safetensors")
    for field in dataclasses.fields(flight):
        assert np.array_equal(getattr(again, field.name), getattr(flight, field.name))
    moved = dataclasses.replace(
        world.map.landmarks, position_m=world.map.landmarks.position_m + 1.0
    )
    assert landmarks_sha256(moved) == flight.landmarks_sha256
    other = dataclasses.replace(world.map.landmarks, id=world.map.landmarks.id + 1)
    assert landmarks_sha256(other) != flight.landmarks_sha256


def test_a_file_cut_anywhere_is_refused(world, tmp_path):
    path = tmp_path / "f.safetensors"
    save_observations(path, world.flight())
    whole = path.read_bytes()
    for length in [0, 1, 7, 8, 9, 100, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(MapError, match="no whole file of observations") as caught:
            load_observations(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: {"time_ns": f.time_ns[::-1].copy()}, "not in order of time"),
        (lambda f: {"time_ns": f.time_ns[:-1]}, "do not fit each other"),
        (lambda f: {"time_ns": f.time_ns + 2**62}, "out of range"),
        (lambda f: {"time_ns": f.time_ns.astype(np.float64)}, "'time_ns' must be int64"),
        (lambda f: {"wTc": f.wTc * np.nan}, "not finite"),
        (lambda f: {"wTc": f.wTc * 1.1}, "no rigid motion"),
        (lambda f: {"wTc": f.wTc[:, :3]}, r"'wTc' must be float64 \(N, 4, 4\)"),
        (lambda f: {"offset": f.offset[::-1].copy()}, "do not fit each other"),
        (lambda f: {"offset": f.offset - 1}, "do not fit each other"),
        (lambda f: {"pixel_px": f.pixel_px + 700}, "outside of the camera's 640x480"),
        (lambda f: {"pixel_px": f.pixel_px[:-1]}, "do not fit each other"),
        (lambda f: {"name": "two\nlines"}, "printable"),
        (lambda f: {"name": ""}, "printable"),
    ],
)
def test_hostile_files_are_refused_with_one_line(world, tmp_path, change, words):
    flight = world.flight()
    save_observations(tmp_path / "f.safetensors", dataclasses.replace(flight, **change(flight)))
    with pytest.raises(MapError, match=words) as caught:
        load_observations(tmp_path / "f.safetensors")
    assert "\n" not in str(caught.value) and "f.safetensors" in str(caught.value)


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({"format": "2"}, "format '2'; this program reads 1"),
        ({"kind": "other"}, "no whole file of observations"),
        ({"camera": "{"}, "camera in its metadata"),
        ({"camera": "[1]"}, "camera"),
        ({"camera": '{"fx_px": -1}'}, "fx_px"),
        ({"camera": '{"surprise": 1}'}, "surprise"),
    ],
)
def test_hostile_metadata_is_refused_with_one_line(world, tmp_path, metadata, words):
    from safetensors import safe_open
    from safetensors.numpy import save

    path = tmp_path / "f.safetensors"
    save_observations(path, world.flight())
    with safe_open(path, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        told = dict(file.metadata())
    path.write_bytes(save(arrays, told | metadata))
    with pytest.raises(MapError, match=words) as caught:
        load_observations(path)
    assert "\n" not in str(caught.value)


def test_a_trajectory_given_by_mistake_gets_one_line_that_says_what_to_do(world, tmp_path, capsys):
    from ground_station import cli

    (tmp_path / "est.txt").write_text("# timestamp tx ty tz qx qy qz qw\n0.0 0 0 0 0 0 0 1\n")
    assert cli.main(["map", "refine", str(world.folder), str(tmp_path / "est.txt")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and "est.txt" in lines[0] and "--observations" in lines[0]


def test_the_command_tells_what_it_did(world, tmp_path, capsys):
    from ground_station import cli

    save_observations(tmp_path / "f.safetensors", world.flight())
    args = ["map", "refine", str(world.folder), str(tmp_path / "f.safetensors")]
    assert cli.main([*args, "--json", str(tmp_path / "r.json")]) == 0
    shown, report = capsys.readouterr().out, json.loads((tmp_path / "r.json").read_text())
    assert "flight flight" in shown and "room.before" in shown and "registering again" in shown
    flight = report["flights"][0]
    assert flight["median_px"] < flight["median_before_px"] and report["observations_dropped"] >= 0
    assert cli.main(["map", "info", str(world.folder)]) == 0
    assert f"flight ({flight['frames']} frames)" in capsys.readouterr().out
    for out in (world.folder, tmp_path / "absent" / "new"):
        assert cli.main([*args, "--out", str(out)]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
