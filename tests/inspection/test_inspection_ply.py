"""PLY out: read again by a reader that knows the format and nothing of the writer."""

from __future__ import annotations

import numpy as np
import pytest
from hand_made import run
from rooms_map import SIGMA_M, two_rooms

from ground_station.errors import GroundStationError
from ground_station.inspection import export_command
from ground_station.inspection.ply import ply, write_ply

SCALARS = {"float": "<f4", "double": "<f8", "int": "<i4", "uint": "<u4", "uchar": "u1"}


def read_ply(data: bytes) -> tuple[list[str], np.ndarray]:
    """Comments and vertices of a binary little-endian file with scalar properties only."""
    head, mark, body = data.partition(b"end_header\n")
    assert mark
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    comments = [line[8:] for line in lines if line.startswith("comment ")]
    elements = [line.split() for line in lines if line.startswith("element")]
    assert len(elements) == 1 and elements[0][1] == "vertex"
    fields = [line.split()[1:] for line in lines if line.startswith("property")]
    kind = np.dtype([(name, SCALARS[scalar]) for scalar, name in fields])
    count = int(elements[0][2])
    assert len(body) == count * kind.itemsize  # nothing follows, nothing is missing
    return comments, np.frombuffer(body, kind, count)


@pytest.mark.parametrize("registered", [True, False])
def test_what_is_written_is_read(tmp_path, registered):
    map_ = two_rooms(50, registered)
    write_ply(tmp_path / "rooms.ply", map_)
    comments, vertices = read_ply((tmp_path / "rooms.ply").read_bytes())
    lm = map_.landmarks
    assert np.allclose(np.stack([vertices[a] for a in "xyz"], axis=1), lm.position_m, atol=1e-6)
    normals = np.stack([vertices[a] for a in ("nx", "ny", "nz")], axis=1)
    assert np.array_equal(normals, lm.view_direction)
    assert np.array_equal(vertices["observations"], lm.observations)
    assert np.allclose(vertices["sigma"], SIGMA_M * np.sqrt(3))
    assert np.allclose(np.cos(np.deg2rad(vertices["view_angle_deg"])), lm.view_cos, atol=1e-5)
    assert np.array_equal(vertices["farthest"], lm.distance_m[:, 1])
    assert ("'m'" in comments[0]) is registered and ("'arbitrary'" in comments[0]) is not registered


def test_a_hostile_name_stays_in_its_comment():
    map_ = two_rooms(5)
    map_.info.name = "x\nelement vertex 99\nend_header\n\u202e\udcff"
    map_.info.units = "m\nend_header"
    comments, vertices = read_ply(ply(map_))
    assert len(comments) == 1 and len(vertices) == 10


def test_a_map_without_landmarks_is_a_file_without_points():
    map_ = two_rooms(5)
    lm = map_.landmarks
    for name in vars(lm):
        setattr(lm, name, getattr(lm, name)[:0])
    assert len(read_ply(ply(map_))[1]) == 0


def test_a_folder_that_is_not_there_is_said(tmp_path):
    with pytest.raises(GroundStationError, match=r"rooms\.ply: No such file") as caught:
        write_ply(tmp_path / "absent" / "rooms.ply", two_rooms(5))
    assert "\n" not in str(caught.value)


def test_the_command_writes_a_built_map(built, tmp_path, capsys):
    out = tmp_path / "room.ply"
    assert run(export_command, built.folder, "--ply", out) == 0
    assert len(read_ply(out.read_bytes())[1]) == len(built.map.landmarks)
    assert "arbitrary units" in capsys.readouterr().out


def test_the_command_writes_a_picture_and_asks_what_is_to_be_written(built, tmp_path, capsys):
    out = tmp_path / "room.png"
    assert run(export_command, built.folder, "--png", out) == 0
    assert out.read_bytes().startswith(b"\x89PNG") and "arbitrary" in capsys.readouterr().out
    with pytest.raises(GroundStationError, match="--ply or --png is needed"):
        run(export_command, built.folder)
