"""A map's folder takes another's place whole, and only once all of it is on the disk."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

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
