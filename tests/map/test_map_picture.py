"""The picture of a map shows its way from above, and where images are missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ground_station.map.levelling import levelled
from ground_station.map.picture import from_above
from ground_station.presentation.theme import LIGHT, write_png


def texts(figure):
    return [text.get_text() for text in figure.axes[0].texts]


def test_cameras_stand_where_the_levelled_map_has_them(built) -> None:
    axes = from_above(built.map, [], "title", LIGHT).axes[0]
    drawn = next(line for line in axes.lines if "cameras" in str(line.get_label()))
    kf = levelled(built.map).keyframes
    order = np.argsort(kf.names)
    np.testing.assert_allclose(np.stack(drawn.get_data(), axis=1), kf.wTc[order, :2, 3])
    for point in kf.wTc[:, :2, 3]:
        assert axes.get_xlim()[0] < point[0] < axes.get_xlim()[1]
        assert axes.get_ylim()[0] < point[1] < axes.get_ylim()[1]
    assert axes.get_aspect() == 1.0 and axes.get_title("left") == "title"
    assert not [line for line in axes.lines if line.get_linestyle() == "--"]


def test_a_stretch_without_images_is_dashed_and_counted_and_so_are_the_ends(built) -> None:
    names = sorted(built.map.keyframes.names)
    missing = [names[4] + "a", names[4] + "b", names[4] + "c", names[-1] + "x", "!first"]
    figure = from_above(built.map, missing, "title", LIGHT)
    dashed = [line for line in figure.axes[0].lines if line.get_linestyle() == "--"]
    way = [line for line in dashed if len(line.get_xdata())]
    kf = levelled(built.map).keyframes
    ends = [kf.wTc[kf.names.index(name), :2, 3] for name in names[4:6]]
    assert len(way) == 1
    np.testing.assert_allclose(np.stack(way[0].get_data(), axis=1), ends)
    assert texts(figure) == ["3", "start (1 missing before it)", "end (1 missing after it)"]


@pytest.mark.parametrize(("display_deg", "quarters"), [(90, 1), (180, 2), (270, 3)])
def test_a_camera_that_was_held_turned_is_upright_as_displays_show_its_pictures(
    built, display_deg: int, quarters: int
) -> None:
    """A quarter clockwise takes a stored ray (x, y) to the shown one (-y, x)."""
    quarter = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    held = built.map.keyframes.wTc @ np.linalg.matrix_power(quarter, quarters)
    turned = replace(
        built.map,
        keyframes=replace(built.map.keyframes, wTc=held),
        info=replace(built.map.info, built=built.map.info.built | {"display_deg": display_deg}),
    )
    found, wanted = levelled(turned), levelled(built.map)
    np.testing.assert_allclose(found.landmarks.position_m, wanted.landmarks.position_m, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2])
def test_a_map_of_hardly_anything_is_drawn_too(built, tmp_path: Path, count: int) -> None:
    kf = built.map.keyframes
    few = replace(
        kf, names=kf.names[:count], time_ns=kf.time_ns[:count], wTc=kf.wTc[:count],
        offset=kf.offset[: count + 1], landmark=kf.landmark[: kf.offset[count]],
        pixel_px=kf.pixel_px[: kf.offset[count]],
    )  # fmt: skip
    out = tmp_path / "map.png"
    write_png(from_above(replace(built.map, keyframes=few), ["zz"], "title", LIGHT), out)
    assert out.read_bytes()[:4] == b"\x89PNG" and out.stat().st_size < 1_000_000
