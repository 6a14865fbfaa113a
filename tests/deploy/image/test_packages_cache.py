"""What is made once is there whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from deploy.image.packages import cache


def test_what_was_made_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a power cut a name that holds nothing would be taken for what was made, for good."""
    target, steps = tmp_path / "wheels", []
    rename, fsync = Path.rename, os.fsync

    def note_rename(path: Path, to: Path) -> Path:
        steps.append("renamed")
        return rename(path, to)

    def note_fsync(descriptor: int) -> None:
        steps.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        fsync(descriptor)

    monkeypatch.setattr(os, "sync", lambda: steps.append("synced"))
    monkeypatch.setattr(Path, "rename", note_rename)
    monkeypatch.setattr(os, "fsync", note_fsync)
    with cache.made(target) as work:
        assert work is not None
        (work / target.name).mkdir()
    assert steps == ["synced", "renamed", tmp_path.name]
    with cache.made(target) as work:
        assert work is None


def test_nothing_is_left_of_what_failed(tmp_path: Path) -> None:
    target = tmp_path / "wheels"
    with pytest.raises(ValueError), cache.made(target) as work:
        assert work is not None
        (work / target.name).mkdir()
        raise ValueError
    assert [path.name for path in tmp_path.iterdir()] == [".wheels.lock"]
