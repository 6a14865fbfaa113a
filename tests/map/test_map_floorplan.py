"""A floor plan's picture lies in its folder, wherever a stranger's map points."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ground_station.errors import InputError
from ground_station.map.floorplan import load_floorplan


@pytest.mark.parametrize("name", ["../plan.png", "{0}/plan.png", "linked.png", "circle"])
def test_a_picture_outside_of_the_map_is_refused(tmp_path: Path, name: str) -> None:
    picture, folder = cv2.imencode(".png", np.zeros((4, 5), np.uint8))[1], tmp_path / "hall"
    (folder / "in").mkdir(parents=True)
    for place in (tmp_path, folder / "in"):
        (place / "plan.png").write_bytes(picture.tobytes())
    (folder / "linked.png").symlink_to("../plan.png")
    (folder / "circle").symlink_to("circle")
    path = folder / "floorplan.yaml"
    text = "image: {}\nresolution: 0.1\norigin: [0, 0, 0]\n"
    path.write_text(text.format("in/plan.png"))
    assert load_floorplan(path).image.shape == (4, 5)
    path.write_text(text.format(name.format(tmp_path)))
    with pytest.raises(InputError, match="must lie beside the file"):
        load_floorplan(path)
