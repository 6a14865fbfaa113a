"""Parts of the card's builder alone: trees, accounts, presets, cpio, sparse files."""

from __future__ import annotations

import io
import subprocess
import tarfile
from pathlib import Path

import pytest
from card_parts import EPOCH, commit, git

from deploy.errors import DeployError
from deploy.image import __main__ as command
from deploy.image import card, initrd, release, sparse
from deploy.image.root import Accounts, apply_presets
from deploy.image.sparse import Range
from deploy.image.tree import Tree

CHECKOUT = Path(__file__).parents[3]
WANTED = "[Install]\nWantedBy=x.target\n"
ROOT = "etc/passwd", "root:x:0:0:root:/root:/bin/bash\n"


def tar_of(path: Path, name: str) -> Path:
    with tarfile.open(path, "w") as tar:
        tar.addfile(tarfile.TarInfo(name), io.BytesIO())
    return path


@pytest.mark.parametrize("name", ["../etc/passwd", "a/../../b", 'a"b', "a\nrm /etc"])
def test_a_tar_whose_names_leave_the_root_or_a_script_line_is_refused(tmp_path, name):
    with pytest.raises(DeployError):
        Tree.from_tar(tar_of(tmp_path / "x.tar", name))


def test_links_of_folders_are_followed_and_loops_end():
    tree = Tree()
    tree.link("lib", "usr/lib")
    tree.link("usr/lib/there", "/etc/../etc")
    tree.write("lib/there/file", "x")
    assert [path for path, entry in tree.items() if entry.kind == "file"] == ["etc/file"]
    tree.link("a", "b")
    tree.link("b", "a")
    with pytest.raises(DeployError, match="more than 40 links"):
        tree.write("a/file", "x")


def test_a_link_to_a_file_is_read_through():
    tree = Tree()
    tree.write("usr/lib/os-release", "trixie")
    tree.link("etc/os-release", "../usr/lib/os-release")
    assert tree.read("etc/os-release") == b"trixie"


def test_a_file_does_not_become_a_folder_nor_a_folder_a_file():
    tree = Tree()
    tree.write("a", "x")
    with pytest.raises(DeployError, match="a is no folder"):
        tree.write("a/b", "x")
    tree.folder("c")
    with pytest.raises(DeployError, match="a folder is there already"):
        tree.write("c", "x")


def test_a_folder_comes_before_its_contents_whatever_sorts_between():
    tree = Tree()
    tree.write("a/z", "")
    tree.write("a-b", "")
    assert [path for path, _ in tree.items()] == ["a", "a/z", "a-b"]


def test_the_digest_sees_owner_mode_time_and_content():
    def digest(**changes: int) -> bytes:
        tree = Tree()
        tree.write("a", "x")
        tree.replace("a", **changes)
        return tree.digest(100)

    others = [digest(), digest(mode=0o600), digest(uid=1), digest(gid=1), digest(mtime=5)]
    assert len(set(others)) == len(others)
    assert digest(mtime=200) == digest(mtime=100), "clamped"


def accounts(sysusers: str, passwd: str = ROOT[1]) -> Tree:
    tree = Tree()
    tree.write("etc/passwd", passwd)
    tree.write("etc/group", "root:x:0:\nvideo:x:44:root\n")
    tree.write("usr/lib/sysusers.d/x.conf", sysusers)
    made = Accounts(tree)
    made.apply("usr/lib/sysusers.d/x.conf")
    made.lock()
    made.write()
    return tree


def test_users_of_sysusers_get_their_fixed_numbers_and_no_password():
    tree = accounts('u blimp 901 "Blimp payload" /data /usr/sbin/nologin\nm blimp video # camera\n')
    last = tree.read("etc/passwd").decode().splitlines()[-1]
    assert last == "blimp:x:901:901:Blimp payload:/data:/usr/sbin/nologin"
    assert b"video:x:44:root,blimp\n" in tree.read("etc/group")
    assert tree.read("etc/shadow") == b"root:*::0:99999:7:::\nblimp:*::0:99999:7:::\n"
    assert tree["etc/shadow"].mode == 0o640


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("u blimp 0 x", "/etc/passwd: 0 is root's, blimp wants it"),
        ("u blimp - x", "blimp: '-' is no fixed number"),
        ("m root nobody", "no group 'nobody' for root"),
        ("r - 500-900", "not understood"),
    ],
)
def test_a_line_of_sysusers_that_cannot_be_kept_is_named(line, says):
    with pytest.raises(DeployError, match=says):
        accounts(line)


def test_presets_enable_aliases_companions_and_instances_and_leave_masks():
    tree = Tree()
    units = "usr/lib/systemd/system"
    tree.write(
        f"{units}/a.service", "[Install]\nWantedBy=x.target\nAlias=b.service\nAlso=c.socket\n"
    )
    tree.write(f"{units}/c.socket", "[Install]\nRequiredBy=sockets.target\n")
    tree.write(f"{units}/d@.service", f"{WANTED}DefaultInstance=one\n")
    tree.write(f"{units}/e@.service", WANTED)
    tree.write(f"{units}/masked.service", WANTED)
    tree.write(f"{units}/off.service", WANTED)
    tree.write(f"{units}/static.service", "[Service]\n")
    tree.link("etc/systemd/system/masked.service", "/dev/null")
    tree.link("etc/systemd/system/x.target.wants/off.service", f"/{units}/off.service")
    presets = "usr/lib/systemd/system-preset"
    tree.write(f"{presets}/50-x.preset", "# ours\ndisable c.socket\ndisable off*\nenable *\n")
    tree.write(f"{presets}/90-y.preset", "enable off.service\n")
    assert apply_presets(tree) == ["a.service", "c.socket", "d@.service", "e@.service"]
    links = {path: entry.target for path, entry in tree.below("etc") if entry.kind == "link"}
    assert links == {
        "etc/systemd/system/masked.service": "/dev/null",
        "etc/systemd/system/x.target.wants/a.service": f"/{units}/a.service",
        "etc/systemd/system/b.service": f"/{units}/a.service",
        "etc/systemd/system/sockets.target.requires/c.socket": f"/{units}/c.socket",
        "etc/systemd/system/x.target.wants/d@one.service": f"/{units}/d@.service",
    }


def test_the_cpio_archive_is_what_cpio_reads(tmp_path):
    tree = Tree()
    tree.write("bin/tool", b"abcde", 0o755)
    tree.link("bin/sh", "tool")
    tree.folder("dev", 0o700)
    archive = initrd.pack(tree)
    assert len(archive) % 4 == 0 and archive == initrd.pack(tree)
    folder = tmp_path / "out"
    folder.mkdir()
    subprocess.run(["cpio", "-id", "--quiet"], input=archive, cwd=folder, check=True)
    assert (folder / "bin/sh").readlink() == Path("tool")
    assert (folder / "bin/tool").read_bytes() == b"abcde"
    assert (folder / "bin/tool").stat().st_mode & 0o777 == 0o755
    assert (folder / "dev").stat().st_mode & 0o777 == 0o700


def test_a_release_tells_its_commit_and_what_was_changed_since(tmp_path):
    folder = tmp_path / "checkout"
    (folder / "pi_firmware").mkdir(parents=True)
    (folder / "tests").mkdir()
    (folder / "pyproject.toml").write_text('[project]\nversion = "1.2.3"\n')
    (folder / "pi_firmware/__main__.py").write_text("")
    (folder / "tests/test_x.py").write_text("")
    git(folder, "init", "-q")
    git(folder, "add", "-A")
    commit(folder)
    head = git(folder, "rev-parse", "HEAD").strip()
    assert release.version(folder) == f"1.2.3+git{head[:12]}"
    assert release.epoch(folder) == EPOCH
    (folder / "pi_firmware/untracked.py").write_text("")
    (folder / "tests/test_x.py").write_text("changed")
    assert release.revision(folder) == head, "neither is on a card"
    (folder / "pi_firmware/__main__.py").write_text("changed")
    assert release.version(folder) == f"1.2.3+git{head[:12]}.dirty"
    tree = release.build(folder, None, "aarch64", "3.13", EPOCH)
    assert [name for name, _ in tree.below("pi_firmware")] == ["pi_firmware/__main__.py"]
    assert b'"made": "2025-10-09T08:53:20Z"' in tree.read("release.json")


def test_ranges_are_widened_to_blocks_and_joined():
    ranges = [Range(9000, 9001), Range(0, 10), Range(4096, 4097), Range(20000, 20001)]
    assert sparse.merged(ranges, 4096, 20100) == [Range(0, 12288), Range(16384, 20100)]


def test_zeros_that_matter_are_written(tmp_path):
    source, target = tmp_path / "a", tmp_path / "b"
    source.write_bytes(bytes(8192))
    target.write_bytes(b"\xff" * 16384)
    sparse.copy_into(source, [Range(4096, 8192)], target, 4096)
    assert target.read_bytes() == b"\xff" * 8192 + bytes(4096) + b"\xff" * 4096


@pytest.mark.parametrize(
    ("board", "machine", "kernel"),
    [("zero2w", "aarch64", "kernel8.img"), ("zerow", "armv6l", "kernel.img")],
)
def test_a_real_boards_first_stages_get_its_kernel_and_leave_the_uart_alone(board, machine, kernel):
    files = Tree()
    files.write(kernel, "x")
    tree = card.boot_contents(board, kernel, machine, files, b"initrd", "UUID=1")
    config = tree.read("config.txt").decode().splitlines()
    assert f"kernel={kernel}" in config and "dtoverlay=disable-bt" in config
    assert ("arm_64bit=1" in config) == (machine == "aarch64")
    assert not any(line.startswith("device_tree=") for line in config)
    line = tree.read("cmdline.txt").decode()
    assert line.count("\n") == 1 and "vivid" not in line and "console=tty1" in line.split()
    assert all(len(row) <= 98 for row in config), "the first stages read no longer line"
    # Without this word a real board's kernel holds nobody to MemoryMax=.
    unit = CHECKOUT / "deploy/board/root/usr/lib/systemd/system/blimp-payload.service"
    assert "cgroup_enable=memory" in line.split() and "\nMemoryMax=" in unit.read_text()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--board", "zerow"), "--board zerow: needs --base: Raspberry Pi OS Lite"),
        (("--board", "qemu", "--base", "x.img"), "--board qemu: takes no --base"),
        (("--board", "qemu", "--archive", "debian"), "--archive debian: expected NAME="),
        (("--board", "qemu", "--archive", "nobody=http://x"), "no archive 'nobody'"),
    ],
)
def test_a_mistake_at_the_command_line_is_one_line_and_status_2(
    arguments, says, monkeypatch, capsys
):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1")
    assert command.main(arguments) == 2
    told = capsys.readouterr().err
    assert len(told.splitlines()) == 1 and says in told
