"""Whether a payload runs this checkout's firmware, by what its telemetry says of itself."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

from ground_station.stream.telemetry import PayloadState
from pi_firmware import __version__

_RELEASE = re.compile(r"\+git([0-9a-f]{7,40})(\.dirty)?", re.ASCII)
_GIT_S = 10.0
_FELL_BACK = "fell back"


def told(state: PayloadState | None) -> str:
    """What a payload says of its version and how it came, as it is told to a person."""
    health = state.health if state is not None else None
    if health is None or not health.version:
        return "a version that it does not tell"
    how = f" ({health.release})" if health.release else ""
    return f"{health.version}{how}"


def trouble(state: PayloadState | None) -> str:
    """Why a payload's last update did not stay; '' when it did."""
    health = state.health if state is not None else None
    if health is None or health.release != _FELL_BACK:
        return ""
    return health.release_reason or "an update did not stay"


def difference(version: str, root: Path) -> str:
    """How a payload's version differs from the firmware at `root`; '' when it does not, as far as
    can be known.

    Commits that change no file of the firmware make no difference. Without git at `root`, as in an
    installed service, only the version's number is compared.
    """
    number = re.split(r"[ +]", version, maxsplit=1)[0]
    if number != __version__:
        return f"here it is {__version__}"
    found = _RELEASE.search(version)
    git = shutil.which("git")
    if found is None or git is None or not (root / ".git").exists():
        return ""
    if found[2]:
        return "it has changes that no commit holds"
    words = [git, "-c", f"safe.directory={root}", "-C", str(root)]
    try:
        done = subprocess.run(
            [*words, "diff", "--quiet", found[1], "--", "pi_firmware"],
            capture_output=True,
            timeout=_GIT_S,
            check=False,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    if done.returncode == 0:
        return ""
    return (
        "the firmware here is another" if done.returncode == 1 else "its commit is not known here"
    )
