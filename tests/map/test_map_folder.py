"""A map's folder takes another's place whole, and only once all of it is on the disk."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ground_station.errors import MapError
from ground_station.map import folder as folders


def test_all_of_a_map_is_on_the_disk_before_it_takes_the_old_one_s_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, fsync, swap = tmp_path / "hall", os.fsync, folders._swap
    (target / "notes").mkdir(parents=True)
    for name in ("map.toml", "landmarks.safetensors", "flight.mcap", "notes/day.txt"):
        (target / name).write_text("old")
    (target / "gone").symlink_to("nowhere")
    synced: set[str] = set()

    def no_links(*_: object, **__: object) -> None:
        raise OSError("a file system without hard links")

    def note(descriptor: int) -> None:
        synced.add(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        fsync(descriptor)

    def look(part: Path, *others: Path) -> None:
        assert synced >= {p.name for p in (part, *part.rglob("*")) if not p.is_symlink()}
        swap(part, *others)

    monkeypatch.setattr(os, "link", no_links)
    monkeypatch.setattr(os, "fsync", note)
    monkeypatch.setattr(folders, "_swap", look)
    with folders.replacing(target) as part:
        (part / "sparse").mkdir()
        for name in ("map.toml", "sparse/points3D.bin"):
            (part / name).write_text("new")
    assert (target / "map.toml").read_text() == "new"
    assert (target / "flight.mcap").read_text() == (target / "notes/day.txt").read_text() == "old"
    assert (target / "gone").is_symlink()


def test_a_map_comes_into_a_folder_of_recordings_and_not_into_one_of_other_things(
    tmp_path: Path,
) -> None:
    sample = tmp_path / "sample"
    sample.mkdir()
    (sample / "flight.mcap").write_text("recording")
    with folders.replacing(sample) as part:
        (part / "map.toml").write_text("new")
    assert {p.name: p.read_text() for p in sample.iterdir()} == {
        "flight.mcap": "recording", "map.toml": "new",
    }  # fmt: skip
    (tmp_path / "mine" / "sparse").mkdir(parents=True)
    (tmp_path / "file").touch()
    for name, words in (("mine", "is not a map"), ("file", "not a folder")):
        with pytest.raises(MapError, match=words), folders.replacing(tmp_path / name):
            pass
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "mine", "sample"]


def test_two_programs_do_not_write_one_map(tmp_path: Path) -> None:
    target = tmp_path / "hall"
    part = tmp_path / "hall.part"
    (part / "sparse").mkdir(parents=True)  # of a program that was killed
    (part / "map.toml").write_text("half")
    with folders.replacing(target) as first:
        assert list(first.iterdir()) == []
        (first / "map.toml").write_text("first")
        with (
            pytest.raises(MapError, match="hall: another command is writing this map"),
            folders.replacing(target),
        ):
            pass
    assert (target / "map.toml").read_text() == "first" and not part.exists()


def test_what_lies_behind_a_link_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "letter").touch()
    (tmp_path / "hall.part").symlink_to(tmp_path / "home")
    with pytest.raises(MapError), folders.replacing(tmp_path / "hall"):
        pass
    assert (tmp_path / "home" / "letter").exists()
