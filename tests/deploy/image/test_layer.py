"""A layer holds what changed in a folder, and nothing else of a tree is touched by it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from card_parts import CAPABILITY

from deploy.image.packages import base
from deploy.image.packages.base import leave_out
from deploy.image.packages.board import Group
from deploy.image.tree import Content, Entry, Tree


def _nothing(path: str) -> bool:
    return False


def _write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "root"
    _write(
        folder,
        {
            "etc/kept": "a",
            "etc/edited": "b",
            "etc/gone": "c",
            "usr/old/x": "d",
            "usr/swapped": "e",
            "var/shared/y": "f",
            "tmp/z": "g",
        },
    )
    (folder / "etc/link").symlink_to("kept")
    return folder


def _tree(root: Path) -> Tree:
    """The base's tree as a file system that is read gives it: owners and all, without content."""
    tree = Tree()
    for path, state in base.snapshot(root, _nothing).items():
        place = root / path
        kind = "link" if place.is_symlink() else "folder" if place.is_dir() else "file"
        content = Content.at(place) if kind == "file" else Content()
        tree.put(path, Entry(kind, state[0] & 0o7777, *state[1:3], content=content))
    return tree


def _laid(root: Path, before: dict[str, base.State], tree: Tree, tmp_path: Path) -> Tree:
    base.write(root, before, base.snapshot(root, _nothing), tmp_path / "layer.tar")
    over = Tree.from_tar(tmp_path / "layer.tar")
    result = Tree()
    for path, entry in tree.items():
        result.put(path, entry)
    base.lay_over(result, over)
    return result


def test_what_changed_is_taken_and_the_rest_stays_the_very_entry(root: Path, tmp_path: Path):
    before, tree = base.snapshot(root, _nothing), _tree(root)
    _write(
        root, {"etc/new": "new", "usr/lib/deep/file": "deep", "etc/edited": "longer than before"}
    )
    (root / "etc/gone").unlink()
    (root / "usr/old/x").unlink()
    (root / "usr/old").rmdir()
    (root / "usr/swapped").unlink()
    _write(root, {"usr/swapped/now": "a folder"})
    (root / "etc/kept").chmod(0o600)
    (root / "var/shared").chmod(0o2775)
    (root / "etc/link").unlink()
    (root / "etc/link").symlink_to("new")
    result = _laid(root, before, tree, tmp_path)
    assert result.read("etc/new") == b"new" and result.read("usr/lib/deep/file") == b"deep"
    assert result.read("etc/edited") == b"longer than before"
    assert "etc/gone" not in result and "usr/old" not in result
    assert result["usr/swapped"].kind == "folder" and result.read("usr/swapped/now")
    assert result["etc/kept"].mode == 0o600 and result["etc/link"].target == "new"
    assert result["var/shared"].mode == 0o2775 and result["var/shared"].uid == os.getuid()
    untouched = {"etc", "usr", "var", "var/shared/y", "tmp", "tmp/z"}
    assert {path for path, entry in result.items() if tree._entries.get(path) is entry} == untouched
    assert not [path for path, _ in result.items() if ".wh." in path]


def test_nothing_changed_is_nothing(root: Path, tmp_path: Path):
    before, tree = base.snapshot(root, _nothing), _tree(root)
    # A second name that comes and goes, as dpkg's backups do, is no change.
    os.link(root / "etc/kept", root / "etc/kept.backup")
    (root / "etc/kept.backup").unlink()
    result = _laid(root, before, tree, tmp_path)
    assert list(Tree.from_tar(tmp_path / "layer.tar").items()) == []
    assert len(result.changed(tree)) == 0 and len(result) == len(tree)


def test_what_is_ignored_is_in_no_layer(root: Path, tmp_path: Path):
    def ignored(path: str) -> bool:
        return path == "tmp"

    before = base.snapshot(root, ignored)
    assert "tmp" not in before and "tmp/z" not in before
    _write(root, {"tmp/other": "h", "etc/new": "i"})
    base.write(root, before, base.snapshot(root, ignored), tmp_path / "layer.tar")
    assert [path for path, _ in Tree.from_tar(tmp_path / "layer.tar").items()] == ["etc", "etc/new"]


def test_byte_code_in_a_layer_asks_for_no_source(root: Path, tmp_path: Path):
    before = base.snapshot(root, _nothing)
    place = root / "usr/lib/__pycache__/x.cpython-313.pyc"
    place.parent.mkdir(parents=True)
    place.write_bytes(b"\xf3\r\r\n" + bytes(4) + b"time" + b"size" + b"code")
    result = _laid(root, before, Tree(), tmp_path)
    # PEP 552: flags 1, an unchecked hash.
    wanted = b"\xf3\r\r\n" + b"\1\0\0\0" + bytes(8) + b"code"
    assert result.read(str(place.relative_to(root))) == wanted


@pytest.mark.skipif(os.geteuid() != 0, reason="owners and capabilities are root's to give")
def test_owners_set_bits_capabilities_and_second_names_are_kept(root: Path, tmp_path: Path):
    before = base.snapshot(root, _nothing)
    _write(root, {"usr/bin/a": "program"})
    program = root / "usr/bin/a"
    os.chown(program, 3, 44)
    program.chmod(0o4755)
    os.setxattr(program, "security.capability", CAPABILITY)
    os.link(program, root / "usr/bin/b")
    result = _laid(root, before, Tree(), tmp_path)
    for name in ("usr/bin/a", "usr/bin/b"):
        entry = result[name]
        assert (entry.uid, entry.gid, entry.mode) == (3, 44, 0o4755)
        assert entry.xattrs == (("security.capability", CAPABILITY),)
        assert entry.content.read() == b"program"


def test_only_what_is_new_is_left_out(root: Path):
    _write(root, {"usr/share/doc/base/README": "the base's"})
    before = base.snapshot(root, _nothing)
    _write(
        root,
        {
            "usr/share/doc/base/README": "the base's, upgraded",
            "usr/share/doc/a/README": "no",
            "usr/share/doc/a/copyright": "yes",
            "usr/share/doc/b/x": "no",
            "usr/lib/c": "yes",
        },
    )
    rules = [Group("documents", ("/usr/share/doc/*", "!/usr/share/doc/*/copyright"))]
    leave_out(root, before, rules)
    left = {str(path.relative_to(root)) for path in (root / "usr").rglob("*") if path.is_file()}
    assert left == {"usr/old/x", "usr/swapped", "usr/lib/c", "usr/share/doc/base/README",
                    "usr/share/doc/a/copyright"}  # fmt: skip
    assert not (root / "usr/share/doc/b").exists()
