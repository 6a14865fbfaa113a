"""Maps over HTTP: the sample's, those on the shelf, and that no name leads elsewhere."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import web_station as station

from ground_station.map.store import load_info
from ground_station.service.settings import MapSettings
from ground_station.service.web import maps
from pi_firmware.wire.errors import BlimpError


def test_the_sample_map(unchanged):
    client = unchanged[0]
    assert [item["name"] for item in client.get("/api/maps").json()] == ["atrium"]
    details = client.get("/api/maps/atrium").json()
    plan = details["floorplan"]
    picture = client.get(plan["url"])
    assert picture.headers["content-type"] == "image/png"
    width, height = struct.unpack(">II", picture.content[16:24])
    assert (width, height) == (plan["width_px"], plan["height_px"])
    points = np.frombuffer(client.get("/api/maps/atrium/landmarks").content, "<f4").reshape(-1, 3)
    assert len(points) == details["landmarks"]
    assert np.allclose(points.min(axis=0), details["bounds"]["min"], atol=1e-3)
    assert np.allclose(np.ptp(points, axis=0), details["extent_m"], atol=2e-3)
    own = load_info(station.ATRIUM).camera
    told = details["camera"]
    assert (told["width_px"], told["height_px"]) == (own.width_px, own.height_px)
    assert told["K"] == own.matrix.tolist() and told["distortion"] == own.distortion.tolist()
    assert told["model"] == "opencv5"


def test_a_configured_camera_takes_the_place_of_the_maps(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text(
        "width_px = 320\nheight_px = 240\nfx_px = 250.0\nfy_px = 251.0\ncx_px = 160.0\n"
        "cy_px = 120.0\nk1 = 0.1\n"
    )
    shelf = maps.Maps(MapSettings(folder=str(station.ATRIUM), camera=str(path)))
    camera = shelf.details("atrium")["camera"]
    assert camera["K"][0] == [250.0, 0.0, 160.0] and camera["distortion"][0] == 0.1
    assert (camera["width_px"], camera["height_px"]) == (320, 240)


def test_what_is_the_same_is_not_sent_again(unchanged):
    client = unchanged[0]
    first = client.get("/api/maps/atrium/landmarks")
    again = client.get(
        "/api/maps/atrium/landmarks", headers={"if-none-match": first.headers["etag"]}
    )
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize("name", ["nope", "..", "...", "%2e%2e", "..%2fatrium", ".hidden", "a%00b"])
@pytest.mark.parametrize("rest", ["", "/landmarks", "/floorplan.png"])
def test_maps_are_asked_for_by_name_only(unchanged, name, rest):
    assert unchanged[0].get(f"/api/maps/{name}{rest}").status_code in (404, 422)


def save_map(folder, positions, plan=b""):
    from safetensors.numpy import save

    folder.mkdir(parents=True)
    text = (station.ATRIUM / "map.toml").read_text()
    (folder / "map.toml").write_text(text)
    (folder / "landmarks.safetensors").write_bytes(save({"position_m": positions}))
    if plan:
        (folder / "floorplan.yaml").write_bytes(plan)


def shelf_of(tmp_path):
    return maps.Maps(MapSettings(folder=str(station.ATRIUM), shelf=str(tmp_path / "shelf")))


def test_a_large_map_is_drawn_evenly(tmp_path):
    positions = np.column_stack([np.arange(50_000.0)] * 3)
    save_map(tmp_path / "shelf" / "large", positions)
    drawn = np.frombuffer(shelf_of(tmp_path).landmarks("large"), "<f4").reshape(-1, 3)
    assert len(drawn) == maps.LANDMARKS
    steps = np.diff(drawn[:, 0])
    assert steps.min() >= 2 and steps.max() <= 3


def test_maps_that_cannot_be_read_are_left_out_and_refused_by_name(tmp_path):
    shelf = tmp_path / "shelf"
    save_map(shelf / "good", np.zeros((3, 3)), b"image: ../../secret.png\nresolution: 1")
    save_map(shelf / "nan", np.full((3, 3), np.nan))
    save_map(shelf / "flat", np.zeros((3, 2)))
    save_map(shelf / "cut", np.zeros((3, 3)))
    (shelf / "cut" / "landmarks.safetensors").write_bytes(b"\xff" * 40)
    (shelf / "no-map").mkdir()
    (shelf / "link").symlink_to(station.ATRIUM)
    found = shelf_of(tmp_path)
    assert {item["name"] for item in found.list()} == {"good", "atrium"}
    assert found.details("good")["floorplan"] is None
    for name in ("nan", "flat", "cut", "link", "no-map"):
        with pytest.raises(BlimpError):
            found.details(name)


def test_a_map_that_is_made_anew_is_read_anew(tmp_path):
    folder = tmp_path / "shelf" / "one"
    save_map(folder, np.zeros((3, 3)))
    found = shelf_of(tmp_path)
    assert found.details("one")["landmarks"] == 3
    (folder / "map.toml").unlink()
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    save_map(folder, np.zeros((5, 3)))
    assert found.details("one")["landmarks"] == 5
