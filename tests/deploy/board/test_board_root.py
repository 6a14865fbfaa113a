"""The tree that goes onto a card: systemd, sshd and sudo take it, and nothing else runs there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.image.packages.board import BOARDS_FOLDER
from deploy.run import find

ROOT = Path(__file__).parents[3]
TREE = ROOT / "deploy/board/root"
UNITS = TREE / "usr/lib/systemd/system"
OURS = sorted(path.name for path in UNITS.glob("blimp-*") if path.is_file())
SYSTEM_UNITS = next(
    (
        p
        for p in map(Path, ("/usr/lib/systemd/system", "/lib/systemd/system"))
        if (p / "multi-user.target").exists()
    ),
    None,
)
GENERATOR = Path("/usr/lib/systemd/system-generators/systemd-fstab-generator")

analyze = pytest.mark.skipif(
    find("systemd-analyze") is None or SYSTEM_UNITS is None or not GENERATOR.exists(),
    reason="systemd is not installed",
)


def run(*words: object, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in words],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={**os.environ, "LC_ALL": "C", **variables},
    )


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ours over this system's units, the mounts that its fstab gives, and programs to be found."""
    assert SYSTEM_UNITS is not None
    root = tmp_path_factory.mktemp("card")
    units = root / "usr/lib/systemd/system"
    shutil.copytree(SYSTEM_UNITS, units, symlinks=True)
    shutil.copytree(TREE, root, symlinks=True, dirs_exist_ok=True)
    (root / "lib").symlink_to("usr/lib")
    early, late = root / "early", root / "late"
    for folder in (early, late):
        folder.mkdir()
    made = run(GENERATOR, units, early, late, SYSTEMD_FSTAB=str(TREE / "etc/fstab"))
    assert made.returncode == 0, made.stderr
    programs = {
        w
        for text in map(Path.read_text, UNITS.glob("blimp-*.service"))
        for w in re.findall(r"^Exec\w+=(\S+)", text, re.MULTILINE)
    }
    for program in programs:
        path = root / program.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("#!/bin/sh\n")
        path.chmod(0o755)
    return root


@analyze
def test_systemd_finds_nothing_wrong_with_our_units_and_mounts(card: Path) -> None:
    mounts = ("data.mount", "boot-firmware.mount", "var-log-journal.mount")
    told = run("systemd-analyze", "verify", "--man=no", f"--root={card}", *OURS, *mounts)
    wrong = [line for line in told.stderr.splitlines() if "blimp" in line or "mount" in line]
    assert not wrong and told.returncode == 0, told.stderr


@analyze
def test_a_unit_that_is_wrong_is_found(card: Path, tmp_path: Path) -> None:
    """So that the test above says something."""
    shutil.copytree(card, tmp_path / "card", symlinks=True)
    unit = tmp_path / "card/usr/lib/systemd/system/blimp-light.service"
    unit.write_text(unit.read_text().replace("/usr/bin/python3", "/usr/bin/no-such"))
    told = run("systemd-analyze", "verify", "--man=no", f"--root={tmp_path}/card", unit.name)
    assert told.returncode != 0 and "no-such" in told.stderr


@analyze
def test_the_boot_has_no_ordering_cycle(card: Path) -> None:
    linked = run("systemctl", f"--root={card}", "preset-all")
    assert linked.returncode == 0, linked.stderr
    for unit in ("blimp-payload.service", "blimp-light.service", "blimp-ssh.service"):
        assert (card / "etc/systemd/system/multi-user.target.wants" / unit).is_symlink()
    told = run("systemd-analyze", "verify", "--man=no", f"--root={card}", "multi-user.target")
    assert "cycle" not in told.stderr, told.stderr


@analyze
def test_the_firmware_is_held_on_a_short_lead(card: Path) -> None:
    """Exposure as systemd reckons it, 0 to 10; without its hardening it is 9.2."""
    told = run(
        "systemd-analyze",
        "security",
        "--offline=true",
        f"--root={card}",
        "--no-pager",
        "blimp-payload.service",
    )
    level = re.search(r"Overall exposure level for blimp-payload.service: ([0-9.]+)", told.stdout)
    assert level and float(level[1]) <= 3.0, told.stdout[-300:]


def test_nothing_runs_that_a_card_has_no_use_for() -> None:
    masked = {
        p.name
        for p in (TREE / "etc/systemd/system").iterdir()
        if p.is_symlink() and p.readlink() == Path("/dev/null")
    }
    assert {
        "getty@.service", "serial-getty@.service", "ssh.service", "ssh.socket",
        "bluetooth.service", "apt-daily.timer", "systemd-firstboot.service",
        "systemd-networkd-wait-online.service", "systemd-hwdb-update.service",
    } <= masked  # fmt: skip
    preset = (TREE / "usr/lib/systemd/system-preset/00-blimp.preset").read_text().splitlines()
    assert preset[-1] == "disable *"


def test_what_systemd_starts_is_there() -> None:
    """Each module that a unit names, and each file that it is conditioned on."""
    for unit in UNITS.glob("blimp-*.service"):
        for module in re.findall(r"-m (deploy\.\S+)", unit.read_text()):
            path = ROOT / module.replace(".", "/")
            assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module


@pytest.mark.parametrize("board", sorted(path.stem for path in BOARDS_FOLDER.glob("*.toml")))
def test_each_boards_defaults_are_the_firmwares_words(board: str) -> None:
    path = ROOT / f"deploy/board/payload/{board}.toml"
    told = subprocess.run(
        [sys.executable, "-m", "pi_firmware", "--check", "--config", path],
        cwd=ROOT, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert told.stdout == "configuration is good\n", told.stderr
    text = path.read_text()
    for request in ("poweroff", "reboot"):
        assert f'["touch", "/run/blimp/{request}"]' in text
        assert f"PathExists=/run/blimp/{request}\n" in (UNITS / f"blimp-{request}.path").read_text()


def python_313() -> str | None:
    known = [shutil.which("python3.13")]
    known += map(str, (Path.home() / ".pyenv/versions").glob("3.13*/bin/python3"))
    for python in filter(None, known):
        if subprocess.run([python, "-c", ""], capture_output=True, check=False).returncode == 0:
            return python
    return None


@pytest.mark.parametrize("which", ["this", "3.13"])
def test_the_cards_programs_need_the_standard_library_only(tmp_path: Path, which: str) -> None:
    """Copied as they lie on the card, with the options that systemd starts them with."""
    python = sys.executable if which == "this" else python_313()
    if python is None:
        pytest.skip("no Python 3.13 here")
    package = tmp_path / "deploy"
    package.mkdir()
    for name in ("__init__.py", "errors.py", "run.py"):
        shutil.copy(ROOT / "deploy" / name, package)
    for name in ("board", "provisioning"):
        hidden = shutil.ignore_patterns("root", "payload", "__pycache__")
        shutil.copytree(ROOT / "deploy" / name, package / name, ignore=hidden)
    modules = [f"deploy.board.{p.stem}" for p in sorted((package / "board").glob("[a-z]*.py"))]
    assert "deploy.board.provision" in modules
    done = subprocess.run(
        [python, "-P", "-S", "-c", f"import {', '.join(modules)}"],
        env={"PYTHONPATH": str(tmp_path)}, cwd="/", capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(find("sshd") is None, reason="sshd is not installed")
@pytest.mark.skipif(os.geteuid() != 0, reason="sshd tests its configuration as root only")
def test_sshd_lets_in_the_pilot_by_key_and_nobody_else(tmp_path: Path) -> None:
    key = tmp_path / "key"
    assert run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", key).returncode == 0
    config = tmp_path / "sshd_config"
    ours = (TREE / "etc/ssh/sshd_config.d/10-blimp.conf").read_text()
    config.write_text(ours.replace("/data/ssh/ssh_host_ed25519_key", str(key)))
    Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)  # systemd's part
    told = run(find("sshd"), "-T", "-f", config)
    assert told.returncode == 0, told.stderr
    lines = set(told.stdout.splitlines())
    assert {
        "permitrootlogin no", "passwordauthentication no", "kbdinteractiveauthentication no",
        "authenticationmethods publickey", "allowusers pilot", "usedns no",
        "authorizedkeysfile /data/ssh/authorized_keys", "allowtcpforwarding no",
    } <= lines  # fmt: skip


@pytest.mark.skipif(find("visudo") is None, reason="sudo is not installed")
def test_sudo_takes_its_file(tmp_path: Path) -> None:
    path = shutil.copy(TREE / "etc/sudoers.d/blimp", tmp_path / "blimp")
    Path(path).chmod(0o440)
    told = run(find("visudo"), "-c", "-f", path)
    assert told.returncode == 0, told.stdout + told.stderr


@pytest.mark.skipif(find("systemd-sysusers") is None, reason="systemd is not installed")
def test_users_have_fixed_numbers_and_no_password(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    groups = "root:x:0:\nvideo:x:44:\nrender:x:105:\ndialout:x:20:\nsystemd-journal:x:104:\n"
    (tmp_path / "etc/group").write_text(groups)
    (tmp_path / "etc/passwd").write_text("root:x:0:0:root:/root:/bin/sh\n")
    folder = tmp_path / "usr/lib/sysusers.d"
    folder.mkdir(parents=True)
    shutil.copy(TREE / "usr/lib/sysusers.d/blimp.conf", folder)
    told = run("systemd-sysusers", f"--root={tmp_path}", folder / "blimp.conf")
    if told.returncode:
        assert os.geteuid() != 0, told.stderr
        pytest.skip("systemd-sysusers gives files to root")
    users = (tmp_path / "etc/passwd").read_text()
    assert "blimp:x:901:901:" in users and "pilot:x:1000:1000:" in users
    shadow = (tmp_path / "etc/shadow").read_text()
    assert re.search(r"^blimp:!\*", shadow, re.M) and re.search(r"^pilot:!\*", shadow, re.M)
    members = {
        line.split(":")[0]: line.split(":")[3]
        for line in (tmp_path / "etc/group").read_text().splitlines()
    }
    assert all("blimp" in members[name] for name in ("video", "render", "dialout", "i2c"))
