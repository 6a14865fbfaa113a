"""The system service: what an installation puts where, that it can be repeated, and what stays."""

import dataclasses
import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ground_station.service import settings
from ground_station.service.web.access import read_token

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "deploy/ground_station/service.sh"
UNIT = "blimp-station.service"
ENVIRONMENT = Path(sys.prefix)

analyze = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed"
)


def ran(*words: object, **how: Any) -> subprocess.CompletedProcess[str]:
    command = list(map(str, words))
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **how)


def service(*arguments: object, source: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return ran("sh", source / "deploy/ground_station/service.sh", *arguments)


def install(root: Path, source: Path) -> subprocess.CompletedProcess[str]:
    run = service("install", "--root", root, "--environment", ENVIRONMENT, source=source)
    assert run.returncode == 0, run.stderr
    return run


def tree(root: Path) -> dict[str, tuple[int, int, str]]:
    """Mode, time of the last change and target or size of everything in a folder."""
    found = {}
    for path in sorted(root.rglob("*")):
        status = path.lstat()
        what = link(path) if path.is_symlink() else str(status.st_size)
        found[str(path.relative_to(root))] = (status.st_mode, status.st_mtime_ns, what)
    return found


def link(path: Path) -> str:
    """The target of a symbolic link as it stands there."""
    return str(path.readlink())


LARGE = (
    "mapping", "simulator", "replay", "training", "experiments", "calibration", "bench",
    "feature_models", "map_update", "inspection", "doctor", "evaluation", "*.mcap",
)  # fmt: skip
"""What the check of a configuration does without, and whose byte code takes long."""


def copied(into: Path, *left_out: str) -> Path:
    """A checkout of one's own, that nobody changes meanwhile."""
    for name in ("deploy", "pi_firmware", "ground_station", "hw", "maps"):
        hidden = shutil.ignore_patterns("__pycache__", "*.part", *left_out)
        shutil.copytree(ROOT / name, into / name, symlinks=True, ignore=hidden)
    for name in ("pyproject.toml", "requirements.lock", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, into / name)
    return into


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copied(tmp_path_factory.mktemp("checkout"))


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> Path:
    root = tmp_path_factory.mktemp("installed")
    install(root, checkout)
    return root


@pytest.fixture
def root(tmp_path: Path, installed: Path) -> Path:
    """An installation that the test can change; what nobody writes into is the other's own."""

    def copy(file: str, to: str) -> None:
        (os.link if "/releases/" in file or "/maps/" in file else shutil.copy2)(file, to)

    return shutil.copytree(installed, tmp_path / "root", symlinks=True, copy_function=copy)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A small checkout of another release, that the test can change."""
    return copied(tmp_path / "checkout", *LARGE)


def test_everything_is_in_its_place(installed: Path) -> None:
    for name, mode in (
        (f"etc/systemd/system/{UNIT}", 0o644),
        ("etc/sysusers.d/blimp.conf", 0o644),
        ("etc/sysctl.d/60-blimp.conf", 0o644),
        ("etc/blimp/station.toml", 0o644),
        ("opt/blimp/current/bin/blimp", 0o755),
        ("opt/blimp/current/ground_station/service/serve.py", 0o644),
        ("opt/blimp/current/pi_firmware/wire/telemetry.py", 0o644),
        ("opt/blimp/current/maps/atrium/flight.mcap", 0o644),
        ("var/lib/blimp", 0o750),
        ("var/lib/blimp/recordings", 0o755),
        ("var/lib/blimp/maps/atrium/landmarks.safetensors", 0o644),
    ):
        assert stat.S_IMODE((installed / name).stat().st_mode) == mode, name
    assert (installed / f"etc/systemd/system/multi-user.target.wants/{UNIT}").is_symlink()
    assert link(installed / "usr/local/bin/blimp") == "/opt/blimp/current/bin/blimp"


def test_nobody_but_the_owner_can_change_the_program(installed: Path) -> None:
    for path in (installed / "opt").rglob("*"):
        if not path.is_symlink():
            assert not path.lstat().st_mode & 0o022, path
            assert path.lstat().st_uid == os.geteuid(), path


def test_nothing_that_is_installed_names_where_it_was_built(installed: Path) -> None:
    release = (installed / "opt/blimp/current").resolve()
    for path in (p for p in release.rglob("*") if p.is_file() and not p.is_symlink()):
        if "environment" not in path.relative_to(release).parts:
            assert str(installed).encode() not in path.read_bytes(), path


def test_the_configuration_is_the_shipped_one_with_this_installation_s_folders(
    installed: Path,
) -> None:
    loaded = settings.load(installed / "etc/blimp/station.toml")
    assert loaded.map.folder == "/var/lib/blimp/maps/atrium"
    assert loaded.map.shelf == "/var/lib/blimp/maps"
    assert loaded.recording.folder == "/var/lib/blimp/recordings"
    shipped = settings.load(settings.SHIPPED)
    assert (loaded.video, loaded.telemetry) == (shipped.video, shipped.telemetry)
    assert loaded.http == dataclasses.replace(shipped.http, token_file="/var/lib/blimp/token")


def test_no_web_page_and_no_other_user_gets_in(root: Path, checkout: Path) -> None:
    loaded, path = settings.load(root / "etc/blimp/station.toml"), root / "var/lib/blimp/token"
    assert not loaded.foxglove.enabled
    http = dataclasses.replace(loaded.http, token_file=str(path))
    token = read_token(http)
    assert token is not None and len(token) > 40
    install(root, checkout)
    assert read_token(http) == token
    path.unlink()
    install(root, checkout)
    assert read_token(http) not in (token, None)


def test_the_installed_command_runs_its_own_release(installed: Path, tmp_path: Path) -> None:
    # What lies about where it is called, or is named in the environment, is not imported.
    (tmp_path / "ground_station.py").write_text("raise SystemExit('the wrong one')")
    command, atrium = "opt/blimp/current/bin/blimp", "var/lib/blimp/maps/atrium"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    words = (installed / command, "serve", "--check", "--map", installed / atrium)
    run = ran(*words, cwd=tmp_path, env=environment)
    assert (run.returncode, run.stdout.splitlines()[0]) == (0, "configuration is good"), run.stderr


def test_a_second_installation_changes_nothing(installed: Path, checkout: Path) -> None:
    before = tree(installed)
    assert "nothing to change" in install(installed, checkout).stdout
    assert tree(installed) == before


def test_an_upgrade_keeps_the_configuration_and_one_release_before(
    root: Path, source: Path
) -> None:
    config = root / "etc/blimp/station.toml"
    config.write_text(config.read_text().replace('name = "main"', 'name = "hall"'))
    names = [link(root / "opt/blimp/current")]
    for number in (1, 2):
        (source / "ground_station/__init__.py").open("a").write(f"# release {number}\n")
        install(root, source)
        names.append(link(root / "opt/blimp/current"))
    assert len(set(names)) == 3
    assert link(root / "opt/blimp/previous") == names[1]
    kept = sorted(f"releases/{path.name}" for path in (root / "opt/blimp/releases").iterdir())
    assert kept == sorted(names[1:])
    assert settings.load(config).name == "hall"


def test_a_release_that_refuses_the_configuration_does_not_take_over(
    root: Path, source: Path
) -> None:
    before = link(root / "opt/blimp/current")
    with (root / "etc/blimp/station.toml").open("a") as config:
        config.write("\n[unheard]\nof = 1\n")
    (source / "ground_station/__init__.py").open("a").write("# the next\n")
    run = service("install", "--root", root, "--environment", ENVIRONMENT, source=source)
    assert run.returncode == 2
    assert "unheard" in run.stderr and "nothing was switched" in run.stderr
    assert link(root / "opt/blimp/current") == before


def test_uninstalling_leaves_configuration_and_recordings_and_says_so(root: Path) -> None:
    recording = root / "var/lib/blimp/recordings/flight.mcap"
    recording.write_bytes(b"a flight")
    run = service("uninstall", "--root", root)
    assert run.returncode == 0, run.stderr
    left = [p for p in root.rglob("*") if p.is_file() or p.is_symlink()]
    kept = (root / "etc/blimp", root / "var/lib/blimp")
    assert all(any(path.is_relative_to(k) for k in kept) for path in left)
    assert recording.read_bytes() == b"a flight"
    for path in kept:
        assert f"kept {path}" in run.stdout
    assert service("uninstall", "--root", root, "--purge").returncode == 0
    assert not any(path.is_file() or path.is_symlink() for path in root.rglob("*"))


def test_a_command_of_somebody_else_s_is_left_alone(root: Path, checkout: Path) -> None:
    other = root / "usr/local/bin/blimp"
    other.unlink()
    other.write_text("#!/bin/sh\n")
    assert "it is not ours" in install(root, checkout).stdout
    service("uninstall", "--root", root)
    assert other.read_text() == "#!/bin/sh\n"


@pytest.mark.parametrize(
    "arguments",
    [(), ("start",), ("install", "--purge"), ("install", "--root", "/nowhere"), ("install", "-x")],
)
def test_wrong_arguments_are_refused(arguments: tuple[str, ...]) -> None:
    run = service(*arguments)
    assert run.returncode == 2
    assert run.stderr and not run.stdout


@analyze
def test_systemd_finds_nothing_wrong_with_the_unit(installed: Path, tmp_path: Path) -> None:
    # A root of its own: the units of a whole system beside ours, and the command that it names.
    root = tmp_path / "root"
    for name in (f"etc/systemd/system/{UNIT}", "opt/blimp/current/bin/blimp"):
        (root / name).parent.mkdir(parents=True)
        shutil.copy(installed / name, root / name)
    units = Path("/usr/lib/systemd/system")
    shutil.copytree(units, root / "usr/lib/systemd/system", symlinks=True)
    run = ran("systemd-analyze", "verify", "--man=no", f"--root={root}", UNIT)
    about_it = [line for line in run.stderr.splitlines() if "blimp" in line]
    assert (run.returncode, about_it) == (0, []), run.stderr


@analyze
def test_the_unit_s_exposure_is_low() -> None:
    words = ("systemd-analyze", "security", "--offline=true", "--no-pager")
    run = ran(*words, SCRIPT.with_name(UNIT))
    match = re.search(r"Overall exposure level for \S+: ([0-9.]+)", run.stdout)
    assert match, run.stdout + run.stderr
    assert float(match[1]) < 2.0  # of 10; systemd calls less than 5 OK


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is not installed")
def test_shellcheck_finds_nothing() -> None:
    run = ran("shellcheck", SCRIPT)
    assert run.returncode == 0, run.stdout
