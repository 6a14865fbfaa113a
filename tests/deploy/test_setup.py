"""The installer: lists complete, lock hashed and without hosts, an old Python refused."""

import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import ground_station
import pi_firmware

ROOT = Path(__file__).parents[2]
LOCK = (ROOT / "requirements.lock").read_text()


def test_the_lock_is_hashed_throughout_and_names_no_index() -> None:
    assert "://" not in LOCK and "--index-url" not in LOCK
    requirements = re.findall(r"^[a-z0-9][a-z0-9._-]*==\S+", LOCK, re.M)
    blocks = re.split(r"^(?=[a-z0-9][a-z0-9._-]*==)", LOCK, flags=re.M)[1:]
    assert len(requirements) == len(blocks) > 20
    for block in blocks:
        assert "--hash=sha256:" in block, block.splitlines()[0]


def test_every_direct_dependency_is_locked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["dev"]
    locked = {name.lower() for name in re.findall(r"^([A-Za-z0-9._-]+)==", LOCK, re.M)}
    for requirement in wanted:
        name = re.split(r"[<>=!\[ ;]", requirement)[0].lower()
        assert name in locked, f"{requirement} is not in requirements.lock: run `make lock`"


def test_mmdebstrap_is_installed_with_what_it_only_recommends() -> None:
    listed = (ROOT / "deploy/image/apt-packages.txt").read_text().splitlines()
    # Without it, it refuses to build for a Pi.
    assert {"mmdebstrap", "arch-test"} <= set(listed)


def test_one_version_counts_and_its_changes_are_told() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    told = re.findall(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert project["version"] == pi_firmware.__version__ == ground_station.__version__ == told[0]


def test_setup_refuses_an_old_python_in_one_line(tmp_path: Path) -> None:
    checkout = tmp_path / "checkout"
    shutil.copytree(ROOT / "deploy", checkout / "deploy", symlinks=True)
    for name in ("requirements.lock", "pyproject.toml"):
        (checkout / name).write_text((ROOT / name).read_text())
    # A stand-in for dpkg, so that the test is about Python alone and installs nothing.
    tools = tmp_path / "bin"
    tools.mkdir()
    (tools / "dpkg-query").write_text("#!/bin/sh\nprintf installed\n")
    (tools / "python3").write_text(
        "#!/bin/sh\n[ \"$1\" = --version ] && { echo 'Python 3.9.2'; exit 0; }\nexit 1\n"
    )
    for tool in tools.iterdir():
        tool.chmod(0o755)
    run = subprocess.run(
        ["sh", "deploy/ground_station/setup.sh"],
        cwd=checkout,
        env={
            **os.environ,
            "PATH": f"{tools}:/usr/bin:/bin",
            "PYTHON": "python3",
            "BLIMP_SETUP_LOCKED": "1",
        },
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert run.returncode == 2
    assert run.stderr.strip() == "setup: Python 3.11 or newer is needed; found Python 3.9.2"
    assert not (checkout / ".venv").exists()


def test_setup_runs_again_without_doing_anything() -> None:
    run = subprocess.run(
        ["sh", "deploy/ground_station/setup.sh"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_readme_names_only_targets_that_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for page in ("README.md", "hw/README.md", "maps/README.md"):
        for target in re.findall(r"\bmake ([a-z][a-z-]*)\b", (ROOT / page).read_text()):
            assert target in targets, f"{page} says 'make {target}'"


def test_shell_scripts_parse() -> None:
    for script in (ROOT / "deploy").rglob("*.sh"):
        assert subprocess.run(["sh", "-n", script], check=False).returncode == 0, script
