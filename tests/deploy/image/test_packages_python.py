"""The card's Python compiles the card's programs; a stand-in for its emulator runs this one."""

from __future__ import annotations

import dataclasses
import io
import os
import sys
import tarfile
from pathlib import Path

import pytest

from deploy.errors import DeployError
from deploy.image.packages.board import Board, load_board
from deploy.image.packages.python import byte_compile

_PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"
# Called as `qemu-aarch64-static -L ROOT ROOT/usr/bin/python ARGUMENTS`.
_EMULATOR = f"""#!/bin/sh
echo "$2" >>"$CALLED"
[ -e "$2/usr/lib/python{_PYTHON}/os.py" ] && [ -x "$3" ] || exit 3
shift 3
exec {sys.executable} "$@"
"""


@pytest.fixture
def board() -> Board:
    return dataclasses.replace(load_board("qemu"), python=_PYTHON)


@pytest.fixture
def rootfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "qemu-aarch64-static").write_text(_EMULATOR)
    (tools / "qemu-aarch64-static").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("CALLED", str(tmp_path / "called"))
    return _tar(tmp_path / "root.tar", f"./usr/lib/python{_PYTHON}/os.py")


def _tar(path: Path, *names: str) -> Path:
    with tarfile.open(path, "w") as tar:
        for name in (*names, f"./usr/bin/python{_PYTHON}", "./usr/share/other"):
            member = tarfile.TarInfo(name)
            member.mode = 0o755
            tar.addfile(member, io.BytesIO())
    return path


def _codes(tree: Path) -> dict[str, bytes]:
    return {path.relative_to(tree).as_posix(): path.read_bytes() for path in tree.rglob("*.pyc")}


def test_code_of_unchanged_files_is_kept_and_names_its_place_on_the_card(
    board: Board, rootfs: Path, tmp_path: Path
) -> None:
    tree, cache = tmp_path / "release", tmp_path / "cache"
    (tree / "inner").mkdir(parents=True)
    (tree / "a.py").write_text("A = {'x', 'y', 'z'}\n")
    (tree / "inner/b.py").write_text("def f():\n    raise ValueError\n")
    byte_compile(board, rootfs, tree, "/usr/lib/blimp/release", cache)
    first = _codes(tree)
    digits = _PYTHON.replace(".", "")
    assert sorted(first) == [
        f"__pycache__/a.cpython-{digits}.pyc",
        f"inner/__pycache__/b.cpython-{digits}.pyc",
    ]
    inner = first[f"inner/__pycache__/b.cpython-{digits}.pyc"]
    # PEP 552: flags 1 is a hash that nobody checks.
    assert inner[4:8] == (1).to_bytes(4, "little")
    assert b"/usr/lib/blimp/release/inner/b.py" in inner and str(tmp_path).encode() not in inner

    # The same again from the cache, without the emulator; then one file is new.
    for path in tree.rglob("*.pyc"):
        path.unlink()
    byte_compile(board, rootfs, tree, "/usr/lib/blimp/release", cache)
    assert _codes(tree) == first
    assert len((tmp_path / "called").read_text().splitlines()) == 1
    (tree / "a.py").write_text("A = 2\n")
    byte_compile(board, rootfs, tree, "/usr/lib/blimp/release", cache)
    second = _codes(tree)
    assert len((tmp_path / "called").read_text().splitlines()) == 2
    assert {name for name in first if first[name] != second[name]} == {
        f"__pycache__/a.cpython-{digits}.pyc"
    }
    # Elsewhere it is other code; nothing is compiled beside the cache, nothing left in the tree.
    byte_compile(board, rootfs, tree, "/data/releases/1", cache)
    assert _codes(tree) != second
    assert not (tree / "bytecode").exists()


def test_a_file_that_does_not_compile_is_one_line(
    board: Board, rootfs: Path, tmp_path: Path
) -> None:
    (tmp_path / "release").mkdir()
    (tmp_path / "release/bad.py").write_text("def\n")
    with pytest.raises(DeployError, match=f"byte code for Python {_PYTHON}: ") as caught:
        byte_compile(board, rootfs, tmp_path / "release", "/x", tmp_path / "cache")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "cache/bytecode").exists()


def test_a_root_without_that_python_is_refused(board: Board, rootfs: Path, tmp_path: Path) -> None:
    (tmp_path / "release").mkdir()
    (tmp_path / "release/a.py").touch()
    other = dataclasses.replace(board, python="3.99")
    with pytest.raises(DeployError, match=r"has no /usr/bin/python3\.99"):
        byte_compile(other, rootfs, tmp_path / "release", "/x")
