"""Wheels come by the lock's hashes only, and unpack to the same folder each time."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
import zipfile
from pathlib import Path

import pytest

from deploy.errors import DeployError
from deploy.image.packages.board import Board, Wheel, load_board
from deploy.image.packages.wheels import fetch_wheels, requirement, unpack

_LOCK = Path(__file__).parents[3] / "requirements.lock"


def _wheel(folder: Path, files: dict[str, bytes], name: str = "thing-1.0-py3-none-any") -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.whl"
    distribution = "-".join(name.split("-")[:2])
    with zipfile.ZipFile(path, "w") as archive:
        for place, data in files.items():
            archive.writestr(place, data)
        metadata = "Metadata-Version: 2.1\nName: thing\nVersion: 1.0\n"
        archive.writestr(f"{distribution}.dist-info/METADATA", metadata)
        tags = "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        archive.writestr(f"{distribution}.dist-info/WHEEL", tags)
    return path


def _lock(folder: Path, wheel: Path) -> Path:
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    lock = folder / "requirements.lock"
    lock.write_text(
        "other==2.0 \\\n    --hash=sha256:" + "0" * 64 + "\n"
        f"thing==1.0 ; python_version < '4' \\\n    --hash=sha256:{'1' * 64} \\\n"
        f"    --hash=sha256:{digest}\n"
    )
    return lock


@pytest.fixture
def board() -> Board:
    return dataclasses.replace(load_board("qemu"), wheels=(Wheel("Thing"),))


@pytest.fixture
def index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is all that pip looks at."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "index"))
    return tmp_path / "index"


def test_a_wheel_of_the_lock_s_hash_is_unpacked_once(
    tmp_path: Path, index: Path, board: Board
) -> None:
    wheel = _wheel(index, {"thing/b.py": b"B = 1\n", "thing/__init__.py": b"", "thing/c.so": b"x"})
    lock = _lock(tmp_path, wheel)
    site = fetch_wheels(board, tmp_path / "cache", lock)
    names = sorted(p.relative_to(site).as_posix() for p in site.rglob("*") if p.is_file())
    assert names == [
        "thing-1.0.dist-info/METADATA",
        "thing-1.0.dist-info/WHEEL",
        "thing/__init__.py",
        "thing/b.py",
        "thing/c.so",
    ]
    assert len({path.stat().st_mtime for path in (site, *site.rglob("*"))}) == 1
    assert {path.stat().st_mode & 0o777 for path in site.rglob("*.py")} == {0o644}
    # What is there needs no index any more.
    shutil.rmtree(index)
    assert fetch_wheels(board, tmp_path / "cache", lock) == site
    assert sorted(p.name for p in (tmp_path / "cache").iterdir() if ".part" in p.name) == []


def test_a_wheel_of_another_hash_is_refused_in_one_line(
    tmp_path: Path, index: Path, board: Board
) -> None:
    lock = _lock(tmp_path, _wheel(index, {"thing/__init__.py": b""}))
    _wheel(index, {"thing/__init__.py": b"import os; os.system('true')\n"})
    with pytest.raises(DeployError) as caught:
        fetch_wheels(board, tmp_path / "cache", lock)
    assert str(caught.value).startswith("wheel thing==1.0 for aarch64: ")
    assert "\n" not in str(caught.value)
    assert [p for p in (tmp_path / "cache").iterdir() if not p.name.endswith(".lock")] == []


def test_a_wheel_that_does_not_exist_for_the_board_is_refused(
    tmp_path: Path, index: Path, board: Board
) -> None:
    wheel = _wheel(index, {"thing/__init__.py": b""}, "thing-1.0-cp313-cp313-win_amd64")
    with pytest.raises(DeployError, match=r"wheel thing==1\.0 for aarch64"):
        fetch_wheels(board, tmp_path / "cache", _lock(tmp_path, wheel))


def test_every_board_s_wheels_stand_in_the_lock_with_hashes() -> None:
    for name in ("qemu", "zero2w", "zerow"):
        for wheel in load_board(name).wheels:
            lines = requirement(_LOCK, wheel.name).splitlines()
            assert "==" in lines[0] and ";" not in lines[0]
            assert len(lines) > 1 and all("--hash=sha256:" in line for line in lines[1:])


def test_a_lock_without_the_wheel_or_its_hash_is_refused(tmp_path: Path) -> None:
    lock = tmp_path / "requirements.lock"
    lock.write_text("thing==1.0\nother==1.0 \\\n    --hash=md5:00\n")
    with pytest.raises(DeployError, match="has no zenoh"):
        requirement(lock, "zenoh")
    for name in ("thing", "other"):
        with pytest.raises(DeployError, match=f"{name} has no hashes"):
            requirement(lock, name)


@pytest.mark.parametrize(
    ("path", "complaint"),
    [
        ("thing-1.0.data/scripts/evil", "wants an installer"),
        ("here.py", "is there from another wheel"),
    ],
)
def test_a_wheel_that_is_not_just_unpacked_is_refused(
    tmp_path: Path, path: str, complaint: str
) -> None:
    site = tmp_path / "site"
    site.mkdir()
    (site / "here.py").touch()
    with pytest.raises(DeployError, match=complaint):
        unpack(_wheel(tmp_path / "w", {path: b"x"}), site, Wheel("thing"))
    unpack(_wheel(tmp_path / "w", {"../out.py": b"x"}), site, Wheel("thing"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["site", "w"]
    assert (site / "here.py").read_bytes() == b""


def test_portable_code_only_where_only_that_was_asked_for(tmp_path: Path) -> None:
    wheel = _wheel(tmp_path / "w", {"thing/a.py": b"", "thing/fast.so": b"", "thing/b/x.py": b""})
    (tmp_path / "one").mkdir()
    unpack(wheel, tmp_path / "one", Wheel("thing", keep=("thing/a.py",), portable=True))
    assert [p.name for p in (tmp_path / "one/thing").iterdir()] == ["a.py"]
    (tmp_path / "two").mkdir()
    with pytest.raises(DeployError, match=r"fast\.so is compiled"):
        unpack(wheel, tmp_path / "two", Wheel("thing", portable=True))


def test_a_cut_wheel_is_refused(tmp_path: Path) -> None:
    wheel = _wheel(tmp_path / "w", {"thing/a.py": b"x" * 4000})
    wheel.write_bytes(wheel.read_bytes()[:-60])
    with pytest.raises(DeployError, match="no wheel, or cut"):
        unpack(wheel, tmp_path / "site", Wheel("thing"))
