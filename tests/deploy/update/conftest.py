"""A card in a folder, for the tests of updates."""

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from card_stand import Card, make_key


@pytest.fixture(scope="session")
def release_key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("ssh-keygen") is None:
        pytest.skip("no ssh-keygen here (openssh-client)")
    return make_key(tmp_path_factory.mktemp("keys") / "releases")


@pytest.fixture
def card(tmp_path: Path, release_key: Path) -> Card:
    return Card(tmp_path / "card", release_key)


@pytest.fixture
def git(tmp_path: Path) -> Callable[..., str]:
    """A checkout of a small project in tmp_path, with one commit; runs git there."""

    def run(*words: str) -> str:
        when = "2026-05-06T07:08:09Z"
        who = {"GIT_AUTHOR_DATE": when, "GIT_COMMITTER_DATE": when, "HOME": str(tmp_path)}
        names = ("-c", "user.name=x", "-c", "user.email=x@localhost")
        done = subprocess.run(
            ["git", *names, "-C", str(tmp_path), *words],
            env={**os.environ, **who},
            check=True,
            capture_output=True,
            text=True,
            timeout=60,
        )
        return done.stdout.strip()

    (tmp_path / "pi_firmware").mkdir()
    (tmp_path / "pi_firmware/__init__.py").write_text('__version__ = "0.3.0"\n')
    (tmp_path / "pi_firmware/__main__.py").write_text("print(1)\n")
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "x"\nversion = "0.3.0"\n')
    run("init", "-q")
    run("add", ".")
    run("commit", "-qm", "first")
    (tmp_path / "pi_firmware/untracked.py").write_text("not of the release\n")
    return run
