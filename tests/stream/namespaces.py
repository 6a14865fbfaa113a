"""Network namespaces of a test's own, without root where the system lets anybody make them."""

from __future__ import annotations

import shutil
import subprocess

import pytest


def unshared(*more: str) -> list[str]:
    """The command that runs another one in namespaces of its own; skips the test where it cannot.

    `more` are commands that must work in there, too.
    """
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        pytest.skip("unshare or ip is missing")
    command = ["unshare", "-rn"]
    probe = " && ".join(["ip link set lo up && ip link add a0 type veth peer name b0", *more])
    tried = subprocess.run([*command, "sh", "-c", probe], capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(f"network namespaces are not allowed here: {tried.stderr.strip()[:100]}")
    return command
