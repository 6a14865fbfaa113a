"""A compressed map is a map: smaller, read, registered, refined and localized in as any other."""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from refining import SETTINGS
from safetensors.numpy import load_file, save_file

from ground_station.errors import BlimpError, MapError
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import load_preset
from ground_station.map import colmap, store
from ground_station.map.descriptors import CodedDescriptors
from ground_station.map.modes import Modes
from ground_station.map.sizes import sizes
from ground_station.map.summary import describe
from ground_station.map_update.compression import command
from ground_station.map_update.compression.compress import Compression, compress_map, subset
from ground_station.mapping.refinement.refine import refine_map
from ground_station.mapping.registration.register import register_map

ROOT = Path(__file__).parents[3]


@pytest.fixture
def small(built, tmp_path) -> tuple[store.Map, dict]:
    """Half the landmarks of the room that was built, with 16 of 32 bytes a descriptor."""
    return compress_map(built.folder, tmp_path / "small", Compression(descriptor_bytes=16))


def test_what_is_kept_is_what_it_was(built, small):
    map_, report = small
    old, new = built.map.landmarks, map_.landmarks
    assert len(new) == report["landmarks"] == round(0.5 * len(old))
    at = np.searchsorted(old.id, new.id)
    assert np.array_equal(old.id[at], new.id) and (np.diff(new.id) > 0).all()
    assert np.abs(new.position_m - old.position_m[at]).max() < 1e-5
    assert np.array_equal(new.observations, old.observations[at])
    assert np.allclose(np.trace(new.covariance_m2, axis1=1, axis2=2),
                       np.trace(old.covariance_m2[at], axis1=1, axis2=2), rtol=0.02)  # fmt: skip
    cosine = np.einsum("md,md->m", new.descriptor[:], old.descriptor[at])
    assert np.median(cosine) > 0.98
    kf, was = map_.keyframes, built.map.keyframes
    assert kf.names == was.names and np.array_equal(kf.wTc, was.wTc)
    for k in range(len(kf)):
        mine, before = (slice(t.offset[k], t.offset[k + 1]) for t in (kf, was))
        ids, ids_before = new.id[kf.landmark[mine]], old.id[was.landmark[before]]
        left = np.isin(ids_before, new.id)
        assert np.array_equal(ids, ids_before[left])
        assert np.abs(kf.pixel_px[mine] - was.pixel_px[before][left]).max() < 0.01


def test_it_says_what_was_done(built, small):
    map_, report = small
    said = map_.info.compressed
    assert said["map"] == built.map.info.name and said["method"] == "coverage"
    assert said["landmarks_before"] == len(built.map.landmarks)
    assert said["landmarks"] == len(map_.landmarks)
    assert (said["descriptor_bytes"], said["seed"]) == (16, 0)
    assert 0 < said["descriptor_error"] < 0.3
    assert report["bytes"] == sizes(map_.folder) and report["bytes_before"] == sizes(built.folder)
    assert report["bytes"]["total"] < 0.4 * report["bytes_before"]["total"]
    assert describe(map_)["landmarks"] == len(map_.landmarks)


def test_an_older_program_refuses_it_and_the_whole_map_stays_as_it_reads_it(built, small):
    """Its rule: format 1 and no other. The arrays it would look for are not there, either."""
    folder = small[0].folder
    assert tomllib.loads((folder / "map.toml").read_text())["format"] == 2
    assert "position_m" not in load_file(folder / "landmarks.safetensors")
    assert "pixel_px" not in load_file(folder / "keyframes.safetensors")
    whole = tomllib.loads((built.folder / "map.toml").read_text())
    assert whole["format"] == 1 and "compressed" not in whole


def test_colmap_opens_the_model_with_or_without_tracks(built, small, tmp_path):
    map_, _ = small
    model = colmap.read(map_.folder / "sparse")
    assert model.num_reg_images() == len(map_.keyframes)
    assert model.num_points3D() == len(map_.landmarks)
    assert model.compute_num_observations() == 0
    points = np.array([model.points3D[int(i)].xyz for i in map_.landmarks.id])
    assert np.abs(points - map_.landmarks.position_m).max() < 1e-5
    with_sights, _ = compress_map(
        built.folder, tmp_path / "tracks", Compression(descriptor_bytes=16, sights=True)
    )
    model = colmap.to_arrays(colmap.read(with_sights.folder / "sparse"))
    assert len(model.point) == len(with_sights.keyframes.landmark)


@pytest.fixture
def registered(built, tmp_path) -> Path:
    """The room that was built, in metres."""
    folder = tmp_path / "registered"
    shutil.copytree(built.folder, folder)
    truth = Trajectory.from_poses(built.map.keyframes.time_ns, built.scene.wTc)
    register_map(folder, trajectory=truth, source="truth")
    return folder


def test_frames_are_found_and_localized_in_it(built, registered, tmp_path):
    small, _ = compress_map(registered, tmp_path / "small", Compression(descriptor_bytes=16))

    class Extractor:
        name, sha256, dimension = "scene", "0" * 64, built.map.info.dimension
        distance_scale = 1.0

    for source, most_m in ((store.load(registered), 0.03), (small, 0.04)):
        localizer = Localizer(source, built.scene.camera, Extractor(), load_preset("default"))
        found = [
            localizer.process_features(10**9 + k * 100_000_000, features)
            for k, features in enumerate(built.scene.features)
        ]
        assert all(e.localized for e in found) and found[0].relocalized
        off = [
            np.linalg.norm(e.wTc[:3, 3] - T[:3, 3])
            for e, T in zip(found, built.scene.wTc, strict=True)
        ]
        assert np.sqrt(np.mean(np.square(off))) < most_m


def test_registering_it_keeps_it_compressed(built, small):
    map_, _ = small
    truth = Trajectory.from_poses(built.map.keyframes.time_ns, built.scene.wTc)
    moved, _ = register_map(map_.folder, trajectory=truth, source="truth")
    again = store.load(map_.folder)
    assert again.info.registered and again.info.format == store.COMPACT
    assert again.info.compressed == map_.info.compressed
    assert isinstance(again.landmarks.descriptor, CodedDescriptors)
    assert np.array_equal(again.landmarks.descriptor[:], map_.landmarks.descriptor[:])
    assert np.abs(again.landmarks.position_m - moved.landmarks.position_m).max() < 1e-5
    off = np.linalg.norm(again.keyframes.wTc[:, :3, 3] - built.scene.wTc[:, :3, 3], axis=1)
    assert np.median(off) < 0.02


def test_a_flight_that_was_localized_in_the_whole_map_refines_it(world, tmp_path):
    flight = world.flight()
    small, _ = compress_map(world.folder, tmp_path / "small", Compression(0.7, 16))
    refined, result = refine_map(small.folder, [flight], SETTINGS)
    assert result.report["flights"][0]["frames"] >= 5
    assert refined.info.format == store.COMPACT
    again = store.load(small.folder)
    assert np.isin(again.landmarks.id, world.map.landmarks.id).all()
    assert len(again.landmarks) == len(refined.landmarks)
    assert len(colmap.to_arrays(colmap.read(small.folder / "sparse")).point) > 0


def test_the_floor_plan_goes_along_and_recordings_do_not(world, tmp_path):
    (world.folder / "flight.mcap").write_bytes(b"of a flight")
    before = sizes(world.folder)
    small, _ = compress_map(world.folder, tmp_path / "small", Compression(0.5, 16))
    names = {path.name for path in small.folder.iterdir()}
    assert "floorplan.yaml" in names and "flight.mcap" not in names
    assert before["other"] < 10_000 and before["total"] == sum(list(before.values())[:-1])


def test_modes_of_what_is_kept_are_kept_with_the_same_words(world, tmp_path):
    rng = np.random.default_rng(2)
    count, dimension = len(world.map.landmarks), world.map.info.dimension
    landmark = np.sort(rng.permutation(count)[: count // 3]).astype(np.int32)
    rows = np.abs(rng.normal(size=(len(landmark), dimension))).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    world.map.modes = Modes(landmark, rows)
    store.save_tables(world.folder, world.map)
    small, report = compress_map(world.folder, tmp_path / "small", Compression(0.5, 16))
    ids = world.map.landmarks.id[landmark]
    left = np.isin(ids, small.landmarks.id)
    assert (report["modes_before"], report["modes"]) == (len(landmark), left.sum())
    assert np.array_equal(small.landmarks.id[small.modes.landmark], ids[left])
    assert np.einsum("nd,nd->n", small.modes.descriptor[:], rows[left]).min() > 0.95
    assert isinstance(small.modes.descriptor, CodedDescriptors)
    held = load_file(small.folder / "landmarks.safetensors")
    assert "mode_descriptor_codes" in held and "mode_descriptor_codebook" not in held
    store.save_tables(small.folder, small)  # and so they stay
    again = store.load(small.folder).modes
    assert np.array_equal(again.descriptor[:], small.modes.descriptor[:])


def test_it_can_be_compressed_once_more(small, tmp_path):
    again, report = compress_map(small[0].folder, tmp_path / "tiny", Compression(20, 8))
    assert len(again.landmarks) == 20 and report["landmarks_before"] == len(small[0].landmarks)
    assert np.isin(again.landmarks.id, small[0].landmarks.id).all()
    assert len(again.info.refined["landmarks_sha256"]) == 2


def test_a_subset_of_all_is_all(rooms):
    same = subset(rooms, np.arange(len(rooms.landmarks)))
    for name in ("id", "position_m", "spread", "descriptor"):
        assert np.array_equal(getattr(same.landmarks, name), getattr(rooms.landmarks, name))
    for name in ("offset", "landmark", "pixel_px"):
        assert np.array_equal(getattr(same.keyframes, name), getattr(rooms.keyframes, name))


def _edit(path: Path, **changes) -> None:
    arrays = load_file(path)
    with store.safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
    arrays |= {name: change(arrays[name].copy()) for name, change in changes.items()}
    save_file({name: np.ascontiguousarray(a) for name, a in arrays.items()}, path, metadata)


def _nan(array):
    array.flat[0] = np.nan
    return array


@pytest.mark.parametrize(
    ("file", "changes", "words"),
    [
        ("landmarks", {"covariance_root": _nan}, "'covariance_root'.*not finite"),
        ("landmarks", {"position_origin_m": _nan}, "'position_origin_m'.*not finite"),
        ("landmarks", {"position_origin_m": lambda a: a[:0]}, "has 0 rows, not 1"),
        ("landmarks", {"covariance_unit_m": lambda a: a + 1e200}, "not finite"),
        ("landmarks", {"id": lambda a: a.astype(np.int32)}, "'id' must be uint32 or int64"),
        ("landmarks", {"spread": lambda a: a[:-1]}, "differ in length"),
        ("landmarks", {"spread": lambda a: a.astype(np.float32)}, "'spread' must be float16"),
        ("landmarks", {"descriptor_codes": lambda a: a[:-1]}, "are no descriptors"),
        ("landmarks", {"descriptor_codebook": _nan}, "holds a value that is not finite"),
        ("keyframes", {"landmark": lambda a: a + np.uint16(60_000)}, "do not fit each other"),
        ("keyframes", {"landmark": lambda a: a.astype(np.uint32) + np.uint32(2**31)}, "do not fit"),
        ("keyframes", {"pixel_steps": lambda a: a[1:]}, "do not fit each other"),
        ("keyframes", {"pixel_step_px": _nan}, "'pixel_step_px'.*not finite"),
        ("keyframes", {"pixel_step_px": lambda a: np.repeat(a, 2)}, "has 2 rows, not 1"),
        ("keyframes", {"offset": lambda a: a[::-1]}, "do not fit each other"),
    ],
)
def test_a_damaged_one_is_refused_in_one_line(small, file, changes, words):
    path = small[0].folder / f"{file}.safetensors"
    _edit(path, **changes)
    with pytest.raises(MapError, match=words) as caught:
        store.load(small[0].folder)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_type_that_numpy_does_not_know_is_refused_in_one_line(small):
    path = small[0].folder / "landmarks.safetensors"
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    header["spread"]["dtype"] = "BF16"
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + length :])
    with pytest.raises(MapError, match="bfloat16") as caught:
        store.load(small[0].folder)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["landmarks.safetensors", "keyframes.safetensors"])
@pytest.mark.parametrize("left", [0.1, 0.6, 0.98])
def test_one_that_was_cut_is_refused_in_one_line(small, name, left):
    path = small[0].folder / name
    data = path.read_bytes()
    path.write_bytes(data[: int(left * len(data))])
    with pytest.raises(MapError, match=name) as caught:
        store.load(small[0].folder)
    assert "\n" not in str(caught.value)


def _run(*words: object) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(word) for word in words]))


def test_the_command_prints_what_became_smaller(built, tmp_path, capsys):
    out, told = tmp_path / "small", tmp_path / "told.json"
    words = ("--landmarks", "100", "--descriptor-bytes", "8", "--seed", "3", "--json", told)
    assert _run(built.folder, "--out", out, *words) == 0
    said = json.loads(told.read_text())
    assert (said["landmarks"], said["descriptor_bytes"], said["seed"]) == (100, 8, 3)
    printed = capsys.readouterr().out
    for part in (f"{len(built.map.landmarks)} -> 100", "fewest", "bytes sparse", "bytes total"):
        assert part in printed
    assert len(store.load(out).landmarks) == 100
    assert store.load(out).landmarks.descriptor.codes.shape == (100, 8)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--landmarks", "0"), "--landmarks is 0"),
        (("--landmarks", "nan"), "--landmarks is nan"),
        (("--landmarks", "-3"), "--landmarks is -3"),
        (("--landmarks", "2.5"), "--landmarks is 2.5; above 1 it is a number"),
        (("--landmarks", "100000"), "--landmarks is 100000; the map has "),
        (("--descriptor-bytes", "5"), "5 bytes a descriptor: of 32 numbers, allowed are 1, 2, 4"),
        (("--descriptor-bytes", "-1"), "--descriptor-bytes is -1"),
        (("--seed", "-1"), "--seed is -1"),
        (("--json", "nowhere/told.json"), "nowhere/told.json: its folder does not exist"),
        (("--out", "nowhere/small"), "nowhere/small: its folder does not exist"),
        (("--out", "{map}"), "is the map itself"),
        (("--out", "{taken}"), "is not a map"),
    ],
)
def test_what_cannot_be_is_one_line_and_leaves_nothing(built, tmp_path, words, said):
    taken = tmp_path / "taken"
    (taken / "sparse").mkdir(parents=True)
    words = [word.format(map=built.folder, taken=taken) for word in words]
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(BlimpError) as caught:
        _run(built.folder, "--out", tmp_path / "small", *words)
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_map_that_no_keyframe_saw_is_refused(rooms, tmp_path):
    none = subset(rooms, np.empty(0, np.intp))
    (tmp_path / "none").mkdir()
    store.save_tables(tmp_path / "none", none)
    with pytest.raises(MapError, match="no landmarks that a keyframe saw"):
        compress_map(tmp_path / "none", tmp_path / "small", Compression())


def test_help_shows_an_example_and_loads_nothing_heavy():
    script = (
        "import argparse, sys; from ground_station.commands import maps\n"
        "p = argparse.ArgumentParser(prog='blimp map'); maps.add_arguments(p)\n"
        "try: p.parse_args(['compress', '--help'])\n"
        "finally: print([m for m in ('numpy', 'cv2', 'pycolmap', 'scipy') if m in sys.modules])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert "blimp map compress maps/atrium" in done.stdout.split("example")[1]
    assert done.stdout.rstrip().endswith("[]")
