"""Files are there whole or as they were, and on the disk before they have their name."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pi_firmware.wire import files


@pytest.fixture
def calls(monkeypatch) -> list[tuple[str, str]]:
    """What is synced and renamed, in order, by name."""
    seen: list[tuple[str, str]] = []
    fsync, rename = os.fsync, os.replace

    def synced(descriptor: int) -> None:
        seen.append(("sync", Path(f"/proc/self/fd/{descriptor}").readlink().name))
        fsync(descriptor)

    def renamed(path: Path, target: Path) -> Path:
        seen.append(("rename", target.name))
        rename(path, target)
        return target

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", renamed)
    return seen


def test_a_file_is_synced_then_renamed_then_its_folder_is_synced(tmp_path, calls):
    files.write(tmp_path / "state.json", b"1")
    files.write(tmp_path / "state.json", b"2")
    assert (tmp_path / "state.json").read_bytes() == b"2"
    one = [("sync", "state.json.part"), ("rename", "state.json"), ("sync", tmp_path.name)]
    assert calls == 2 * one
    assert [p.name for p in tmp_path.iterdir()] == ["state.json"]


def test_all_of_a_folder_is_synced_before_it_is_renamed(tmp_path, calls):
    (tmp_path / "new/in").mkdir(parents=True)
    (tmp_path / "new/in/points.bin").write_bytes(b"1")
    (tmp_path / "new/gone").symlink_to("nowhere")
    files.replace(tmp_path / "new", tmp_path / "model")
    synced = calls[: calls.index(("rename", "model"))]
    assert {name for _, name in synced} == {"points.bin", "in", "new"}


def test_what_fails_leaves_the_old_file_and_nothing_beside_it(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text("old")

    def broken() -> None:
        with files.replacing(path) as part:
            part.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        broken()
    assert path.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["map.toml"]
    with pytest.raises(OSError):
        files.write(tmp_path / "no folder" / "file", b"")


def test_what_a_killed_program_left_beside_it_is_written_over_and_its_link_not_followed(tmp_path):
    path, other = tmp_path / "key.pem", tmp_path / "other"
    other.write_text("another's")
    (tmp_path / "key.pem.part").symlink_to(other)
    files.write(path, b"secret", 0o600)
    assert path.read_bytes() == b"secret" and path.stat().st_mode & 0o777 == 0o600
    assert other.read_text() == "another's" and not path.is_symlink()
