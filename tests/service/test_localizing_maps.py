"""Maps are chosen by name from the shelf and from nowhere else."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from localizing_stand import SAMPLE, copy_map
from waiting import eventually

from ground_station.errors import MapError
from ground_station.localization.settings import load_preset
from ground_station.service.localizing import maps
from ground_station.service.localizing.maps import Loader, prepare, settings_of
from ground_station.service.settings import Run, StationSettings
from pi_firmware.wire.config import from_mapping
from pi_firmware.wire.errors import BlimpError, ConfigError


def station(folder: Path, shelf: Path, **values: Any) -> StationSettings:
    chosen = {"folder": str(folder), "shelf": str(shelf)}
    return from_mapping({"map": chosen, **values}, StationSettings, where="test")


@pytest.fixture
def shelf(tmp_path: Path) -> Path:
    shelf = tmp_path / "shelf"
    for folder in (shelf / "hall", tmp_path / "secret"):
        folder.mkdir(parents=True)
        (folder / "map.toml").write_text("")
    (shelf / "link").symlink_to(tmp_path / "secret")
    (shelf / "file").write_text("")
    return shelf


def test_a_map_on_the_shelf_is_found(shelf: Path) -> None:
    assert station(SAMPLE, shelf).map.folder_of("hall") == shelf / "hall"


def test_the_configured_map_is_found_wherever_it_lies(shelf: Path) -> None:
    assert station(SAMPLE, shelf).map.folder_of("atrium") == SAMPLE


@pytest.mark.parametrize(
    "name",
    [
        "", ".", "..", "../secret", "hall/../../secret", "/etc", "link", "file", "absent", "hall/",
        "hall\0", "hall\n", "~", "a" * 65, ".hidden", None, 3, ["hall"], {"name": "hall"},
    ],
)  # fmt: skip
def test_no_name_leaves_the_shelf(shelf: Path, name: object) -> None:
    assert station(SAMPLE, shelf).map.folder_of(name) is None


def test_a_service_finds_its_first_pose_itself_whatever_the_preset(shelf: Path) -> None:
    """The thesis's preset is told one elsewhere; nobody tells a service."""
    assert not load_preset("thesis").recovery.relocalize
    chosen = station(SAMPLE, shelf, localizer={"preset": "thesis"})
    localizer = prepare(SAMPLE, Run(chosen))
    assert localizer.settings.recovery.relocalize
    assert localizer.settings.tracking.features_lag_s == 0
    assert localizer.camera == localizer.map.info.camera


def test_a_replay_may_tell_the_first_pose_and_no_clock_decides_where_it_is_stepped() -> None:
    thesis, default = (
        from_mapping({"localizer": {"preset": name}}, StationSettings, where="test")
        for name in ("thesis", "default")
    )
    assert not settings_of(Run(thesis, start="start.txt")).recovery.relocalize
    assert settings_of(Run(default, stepped=True)) == load_preset("default")


def test_a_preset_is_one_that_ships_or_a_file(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text("seed = 7\n")
    settings = from_mapping({"localizer": {"preset": str(own)}}, StationSettings, where="test")
    assert settings_of(Run(settings)).seed == 7
    with pytest.raises(ConfigError, match=r"known: default, thesis, or a \.toml file"):
        from_mapping({"localizer": {"preset": "fast"}}, StationSettings, where="test")


def test_a_camera_of_the_settings_comes_before_the_maps(shelf: Path, tmp_path: Path) -> None:
    file = tmp_path / "camera.toml"
    file.write_text(
        "width_px = 320\nheight_px = 240\nfx_px = 250\nfy_px = 250\ncx_px = 160\ncy_px = 120\n"
    )
    settings = from_mapping(
        {"map": {"folder": str(SAMPLE), "camera": str(file)}}, StationSettings, where="test"
    )
    assert prepare(SAMPLE, Run(settings)).camera.width_px == 320


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("frame", "sfm", "it is not registered"),
        ("format", 99, "format 99; this program reads 1"),
        ("features.name", "superpoint", "was built with 'superpoint'"),
    ],
)
def test_a_map_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, key: str, value: Any, reason: str
) -> None:
    folder = copy_map(tmp_path / "other", **{key: value})
    with pytest.raises(BlimpError, match=reason) as refused:
        prepare(folder, Run(station(folder, tmp_path)))
    assert "\n" not in str(refused.value)


def test_one_map_is_loaded_at_a_time(shelf: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()

    def slow(folder: Path, run: Run) -> Any:
        release.wait(60)
        raise MemoryError("no room")

    monkeypatch.setattr(maps, "prepare", slow)
    loader = Loader(Run(station(SAMPLE, shelf)))
    loading = loader.begin(shelf / "hall")
    with pytest.raises(MapError, match="the map 'hall' is being loaded"):
        loader.begin(SAMPLE)
    assert loader.landed() is None
    release.set()
    eventually(loading.ready.is_set)
    assert loader.landed() is loading and loader.landed() is None
    assert loading.localizer is None
    assert loading.refused == f"{shelf / 'hall'}: MemoryError: no room"
    loader.begin(SAMPLE)  # the next may come
