"""AprilTags of known place, drawn into the map's images, put the map into the world."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from built_scene import look_at
from hand_made import keyframes_of
from known_places import in_map, similarity

from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.map import store
from ground_station.mapping.registration import command, tags
from ground_station.mapping.registration.register import by_observations
from ground_station.mapping.registration.tags import FAMILIES, find_tags, read_tags
from ground_station.recording.frames import Frame

CAMERA = THESIS_CAMERA
SIZE_M = 0.40
TRUTH = similarity(3)
TOML = f"""family = "36h11"
size_m = {SIZE_M}
[[tag]]
id = 3
centre_m = [6.0, 2.6, 1.7]
facing_deg = 180.0
[[tag]]
id = 11
corners_m = [[4.4, 5.0, 1.2], [4.8, 5.0, 1.2], [4.8, 5.0, 0.8], [4.4, 5.0, 0.8]]
[[tag]]
id = 7
centre_m = [6.0, 4.4, 1.0]
facing_deg = 180.0
[[tag]]
id = 20
centre_m = [3.4, 5.0, 1.9]
"""
CENTRE_ONLY = np.array([[3.2, 5.0, 2.1], [3.6, 5.0, 2.1], [3.6, 5.0, 1.7], [3.2, 5.0, 1.7]])


def draw(image, rays, wTc, corners, number: int) -> None:
    """Draws a tag with corners (4, 3) in the world, from the top left, clockwise, and a margin."""
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES["36h11"])
    cells = dictionary.markerSize + 2
    # OpenCV 4 draws them half a turn off AprilTag's own pictures, which are what people print.
    marker = np.rot90(cv2.aruco.generateImageMarker(dictionary, number, 16 * cells), 2)
    margin = 16
    pattern = cv2.copyMakeBorder(
        marker, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255
    )
    origin, right, down = corners[0], corners[1] - corners[0], corners[3] - corners[0]
    local = poses.inverse(wTc)
    o = poses.transform(local, origin[None])[0]
    r, d = local[:3, :3] @ right, local[:3, :3] @ down
    # ray * z = o + a r + b d, for each pixel
    inverse = np.linalg.inv(np.column_stack([r, d, o]))
    a, b, w = np.moveaxis(
        np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1) @ inverse.T, -1, 0
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = a / w, b / w
    front = (o @ np.cross(r, d) > 0) & (w > 0)
    side = len(marker)
    u, v = (np.where(front, c, -9) * side + margin - 0.5 for c in (a, b))
    drawn = cv2.remap(
        pattern, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderValue=128
    )
    inside = (u > 0) & (v > 0) & (u < len(pattern) - 1) & (v < len(pattern) - 1)
    image[inside] = drawn[inside]


@pytest.fixture(scope="module")
def flight():
    """Six images of a wall and another with four tags, and the map that was made of them."""
    centres = [
        [1.5 + 0.35 * k, 1.6 + 0.25 * np.cos(k), 1.3 + 0.25 * np.sin(2 * k)] for k in range(6)
    ]
    wTc = np.array([look_at(c, [5.0, 4.2, 1.3]) for c in centres])
    grid = np.stack(np.meshgrid(np.arange(640), np.arange(480)), axis=-1).reshape(-1, 2)
    rays = CAMERA.undistort(grid).reshape(480, 640, 2)
    rng = np.random.default_rng(0)
    frames = []
    # What is drawn is the truth; TOML must mean the same.
    facing_x = np.array([[0, 0.2, 0.2], [0, -0.2, 0.2], [0, -0.2, -0.2], [0, 0.2, -0.2]])
    places = {
        3: np.array([6.0, 2.6, 1.7]) + facing_x,
        7: np.array([6.0, 4.4, 1.0]) + facing_x,
        11: np.array([[4.4, 5, 1.2], [4.8, 5, 1.2], [4.8, 5, 0.8], [4.4, 5, 0.8]]),
        20: CENTRE_ONLY,
    }
    for k, T in enumerate(wTc):
        image = np.full((480, 640), 128, np.uint8)
        for number, corners in places.items():
            draw(image, rays, T, corners, number)
        image = cv2.GaussianBlur(image, (0, 0), 0.7)
        noisy = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        frames.append(Frame(k, f"frame-{k:06d}", k * 10**8, noisy))
    own = wTc.copy()
    own[:, :3, :3] = TRUTH.rotation.T @ wTc[:, :3, :3]
    own[:, :3, 3] = in_map(TRUTH, wTc[:, :3, 3])
    info = SimpleNamespace(camera=CAMERA, built={"rate_hz": 5.0})
    map_ = SimpleNamespace(info=info, keyframes=keyframes_of(own, 10**8))
    return SimpleNamespace(map=map_, frames=frames, wTc=wTc, rays=rays)


@pytest.fixture
def listed(tmp_path: Path):
    path = tmp_path / "TAGS.toml"
    path.write_text(TOML)
    return read_tags(path)


def off_m(fit, flight) -> np.ndarray:
    centres = in_map(TRUTH, flight.wTc[:, :3, 3])
    return np.linalg.norm(fit.apply(centres) - flight.wTc[:, :3, 3], axis=1)


def test_tags_put_the_map_into_the_world(flight, listed):
    seen = find_tags(flight.map, listed, flight.frames)
    assert not seen.notes
    assert (
        len(seen.observations.points) == 3 * 4 + 1
        and len(set(seen.observations.group.tolist())) == 4
    )
    found = by_observations(flight.map, seen.observations, 0)
    assert off_m(found.fit, flight).max() < 0.02, found.report
    assert found.report["points"] == 13 and found.report["reprojection_rms_px"] < 0.5
    assert found.uncertainty.freedom == 3 * 4 - 7  # tags, not corners
    assert max(found.report["point_held_out_m"]) < 0.05
    assert found.report["point_names"][0] == "tag 3, top left"


def test_a_tag_that_was_hung_elsewhere_is_found_and_named(flight, listed):
    places = dict(listed.places)
    places[7] = places[7] + [0, 0, 1.0]
    seen = find_tags(flight.map, dataclasses.replace(listed, places=places), flight.frames)
    found = by_observations(flight.map, seen.observations, 0)
    assert off_m(found.fit, flight).max() < 0.03
    assert found.report["points"] == 9
    assert {note.split(",")[0] for note in found.notes} == {"point 'tag 7"}


def test_tags_that_are_printed_turned_are_known_by_turn(flight, listed):
    """A quarter turn to the right: the list's top left is the print's bottom left."""
    places = {k: np.roll(p, 1, axis=0) if len(p) == 4 else p for k, p in listed.places.items()}
    turned = dataclasses.replace(listed, places=places, turn=1)
    found = by_observations(
        flight.map, find_tags(flight.map, turned, flight.frames).observations, 0
    )
    assert off_m(found.fit, flight).max() < 0.02


FIRST = {"16h5": 0x231B, "25h9": 0x155CBF1, "36h11": 0xD5D628584}
"""The bits of each family's tag 0, row by row from the top left, as AprilTag's own images show it.
OpenCV 4 has them all turned by half a turn, OpenCV 5 has not."""


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_tags_lie_as_in_apriltags_own_pictures(family):
    """Tag 0 of each family, drawn from the bits that AprilTag publishes."""
    side = {"16h5": 4, "25h9": 5}.get(family, 6)
    bits = np.array([int(b) for b in f"{FIRST[family]:0{side * side}b}"])
    picture = np.zeros((side + 2, side + 2), np.uint8)
    picture[1:-1, 1:-1] = 255 * bits.reshape(side, side)
    large = cv2.copyMakeBorder(
        np.kron(picture, np.ones((20, 20), np.uint8)), *[40] * 4, 0, value=255
    )
    ((number, corners),) = tags.detect(large, family)
    end = 40 + 20 * (side + 2) - 0.5
    assert number == 0
    assert np.allclose(corners, [[39.5, 39.5], [end, 39.5], [end, end], [39.5, end]], atol=0.6)


def test_what_is_not_seen_seen_once_or_not_listed_is_noted(flight, listed):
    places = {k: v for k, v in listed.places.items() if k != 20} | {55: np.zeros((1, 3))}
    frames = [dataclasses.replace(f, image=f.image.copy()) for f in flight.frames]
    for frame in frames[1:]:
        cover(frame.image, flight, frame.index, listed.places[3])
    seen = find_tags(flight.map, dataclasses.replace(listed, places=places), frames)
    notes = "; ".join(seen.notes)
    assert "tag 3 left out: it is seen in one image; two are needed" in notes
    assert "tag 55 left out: it is not seen in 6 images" in notes
    assert "tags that nobody listed are seen: 20" in notes
    assert len(seen.observations.points) == 8


def cover(image: np.ndarray, flight, k: int, corners: np.ndarray) -> None:
    """Paints over a tag."""
    local = poses.transform(poses.inverse(flight.wTc[k]), corners)
    cv2.fillConvexPoly(image, CAMERA.project(local).round().astype(np.int32), 128)


def test_two_tags_with_one_number_are_left_out(flight, listed):
    both = [dataclasses.replace(f, image=f.image.copy()) for f in flight.frames]
    for frame in both:  # number 11 hangs where 7 did, too
        draw(frame.image, flight.rays, flight.wTc[frame.index], listed.places[7], 11)
    seen = find_tags(flight.map, listed, both)
    assert "tag 11 left out: two of it are seen in one image" in seen.notes
    apart = [dataclasses.replace(f, image=f.image.copy()) for f in flight.frames]
    for frame in apart:
        k = frame.index
        cover(frame.image, flight, k, listed.places[11] if k < 3 else listed.places[7])
        if k < 3:
            draw(frame.image, flight.rays, flight.wTc[k], listed.places[7], 11)
    seen = find_tags(flight.map, listed, apart)
    assert any("tag 11 left out: its observations do not meet" in note for note in seen.notes)


def test_the_wrong_family_frames_or_size_are_refused(flight, listed):
    wrong = dataclasses.replace(listed, family="25h9")
    with pytest.raises(
        MapError, match=r"no tag of the family 25h9 .* \(other families: 16h5, 36h11"
    ):
        find_tags(flight.map, wrong, flight.frames)
    others = [dataclasses.replace(f, name=f"other-{f.index}") for f in flight.frames]
    with pytest.raises(MapError, match=r"none of the 6 frames is an image of the map .*'other-0'"):
        find_tags(flight.map, listed, others)
    small = [dataclasses.replace(f, image=f.image[:400]) for f in flight.frames]
    with pytest.raises(MapError, match=r"has 640x400 px, the map's camera 640x480 px"):
        find_tags(flight.map, listed, small)


def named(map_: SimpleNamespace, form: str) -> SimpleNamespace:
    """The map whose images are called otherwise."""
    names = [form.format(name) for name in map_.keyframes.names]
    keyframes = dataclasses.replace(map_.keyframes, names=names)
    return SimpleNamespace(info=map_.info, keyframes=keyframes)


def test_images_of_a_map_of_several_inputs_have_the_inputs_name(flight, listed):
    map_ = named(flight.map, "walk/{}")
    seen = find_tags(map_, listed, flight.frames[:3], ["walk"])
    assert seen.observations.image[0] == "walk/frame-000000"


def test_a_folder_of_frames_is_looked_through(flight, tmp_path, monkeypatch, capsys):
    """As the command does it: what the map was built from, by the names of its images."""
    folder = tmp_path / "walk"
    folder.mkdir()
    for frame in flight.frames[:4]:
        cv2.imwrite(str(folder / f"{frame.name}.png"), frame.image)
    (tmp_path / "TAGS.toml").write_text(TOML)
    map_ = named(flight.map, "{}.png")
    monkeypatch.setattr(store, "load", lambda _: map_)
    args = argparse.Namespace(map="m", tags=tmp_path / "TAGS.toml", frames=[str(folder)])
    seen = command._seen_tags(args)
    assert set(seen.observations.image) == set(map_.keyframes.names[:4]) and not seen.notes


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"36h11"', '"36h12"', "'family' is '36h12'; allowed: '16h5', '25h9', '36h11'"),
        ('family = "36h11"\n', "", "the key 'family' is missing"),
        ("size_m = 0.4", "size_m = nan", "'size_m' must be a finite number"),
        ("id = 3", "id = 600", "tag 1: id is 600; 36h11 has 0 to 586"),
        ("id = 11", "id = 3", "tag 2: the id 3 is there twice"),
        ("[6.0, 2.6, 1.7]", "[6.0, 2.6]", "tag 1: centre_m has three numbers"),
        ("[6.0, 2.6, 1.7]", "[6.0, 2.6, 1e9]", "tag 1: a coordinate is above 1e\\+06 m"),
        ("[4.8, 5.0, 1.2]", "[4.9, 5.0, 1.2]", "tag 2: its corners are no square of 0.4 m"),
        ("facing_deg = 180.0", "corners_m = []", None),
        ("centre_m = [6.0, 2.6, 1.7]\n", "", "tag 1: needs either centre_m or corners_m"),
        ("facing_deg", "facing", "tag 1: unknown key 'facing'"),
        ("[[tag]]", "[tagg]", "not valid TOML|unknown key"),
    ],
)
def test_a_list_of_tags_that_is_wrong_is_refused_by_name(tmp_path, old, new, words):
    path = tmp_path / "TAGS.toml"
    assert old in TOML
    path.write_text(TOML.replace(old, new, 1))
    if words is None:
        assert len(read_tags(path).places) == 4
        return
    with pytest.raises(MapError, match=words) as caught:
        read_tags(path)
    assert "\n" not in str(caught.value)


def test_a_facing_tag_is_a_square_on_its_wall(tmp_path):
    path = tmp_path / "TAGS.toml"
    path.write_text(TOML)
    corners = read_tags(path).places[3]
    assert np.allclose(corners[:, 0], 6.0) and np.allclose(corners.mean(axis=0), [6.0, 2.6, 1.7])
    # Who looks along x, at a tag that looks back, has the left at greater y.
    assert np.allclose(corners[0], [6.0, 2.8, 1.9]) and np.allclose(corners[2], [6.0, 2.4, 1.5])
    assert tags.detect(np.zeros((480, 640), np.uint8), "36h11") == []
