"""Checks of what runs: the installed service, and the payloads that are heard, by version."""

from __future__ import annotations

import re
import shutil
import subprocess
import time
from pathlib import Path

from ground_station.doctor import ROOT, network
from ground_station.doctor.findings import Finding, ok, problem, warning
from ground_station.service.settings import StationSettings
from ground_station.stream.telemetry import PayloadState, TelemetryListener
from pi_firmware import __version__
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.messages import Health

UNIT = "blimp-station.service"
_SYSTEMD = Path("/run/systemd/system")
_COMMAND_S = 3.0
_LISTEN_S = 2.0
_RELEASE = re.compile(r"\+git([0-9a-f]{7,40})(\.dirty)?", re.ASCII)
_GIT_S = 10.0
_FELL_BACK = "fell back"
_SILENT = Health(0, 0.0)
"""Of a payload that said nothing of its health yet."""


def unit(systemd: Path = _SYSTEMD) -> Finding:
    """The installed service runs, where it is installed."""
    if not systemd.is_dir() or shutil.which("systemctl") is None:
        return ok("service", "systemd does not run here; blimp serve runs without it")
    names = "LoadState,ActiveState,SubState,NRestarts,UnitFileState"
    run = subprocess.run(
        ["systemctl", "show", f"--property={names}", UNIT],
        capture_output=True,
        text=True,
        timeout=_COMMAND_S,
    )
    return judge_unit(dict(line.split("=", 1) for line in run.stdout.splitlines() if "=" in line))


def judge_unit(state: dict[str, str]) -> Finding:
    """What systemd's properties of the unit mean."""
    loaded, active = state.get("LoadState", ""), state.get("ActiveState", "")
    if loaded in ("", "not-found"):
        return ok("service", f"{UNIT} is not installed (make install-service)")
    said = f"{UNIT} is {active} ({state.get('SubState', '?')})"
    look = f"journalctl -u {UNIT} -n 50; then sudo systemctl restart {UNIT}"
    restarts = int(state.get("NRestarts") or 0)
    if loaded != "loaded":
        return problem("service", f"{UNIT} cannot be loaded ({loaded})", "make install-service")
    if active == "failed" or state.get("SubState") == "auto-restart":
        return problem("service", said, look)
    if active != "active":
        return warning("service", said, f"sudo systemctl start {UNIT}")
    if restarts:
        return warning("service", f"{said}, restarted {restarts} times", look)
    if state.get("UnitFileState") != "enabled":
        fix = f"sudo systemctl enable {UNIT}"
        return warning("service", f"{said}, but not from the next start of the machine", fix)
    return ok("service", said)


def payloads(settings: StationSettings, listen_s: float = _LISTEN_S) -> Finding:
    """Who is heard within 2 s, whether they speak this program's messages, and which version.

    Where a port is held, nobody is asked: the service itself is listening then.
    """
    telemetry = settings.telemetry
    ports = [port for port in network.ports_of(settings) if port.setting == "telemetry.listen"]
    if any(network.refusal(port) for port in ports):
        return ok("payloads", "not listened for: the telemetry port is held")
    try:
        with TelemetryListener(
            telemetry.listen, connect=telemetry.connect, certificates=telemetry.certificates
        ) as listener:
            time.sleep(listen_s)
            heard = {name: listener.state(name) for name in listener.payloads()}
    except TelemetryError as error:
        return problem("payloads", str(error), "fix telemetry.listen and telemetry.certificates")
    if not heard:
        return ok("payloads", f"none within {listen_s:g} s")
    other = [name for name, state in heard.items() if state is not None and state.refused]
    if other:
        found = f"{', '.join(other)}: messages of another version than this station's"
        return problem("payloads", found, "update payload and ground station to the same release")
    return judge_payloads(heard, ROOT)


def judge_payloads(heard: dict[str, PayloadState | None], root: Path) -> Finding:
    """The versions of those that are heard, beside the firmware at `root`."""
    found, fix = [], []
    for name, state in heard.items():
        health = state.health if state is not None and state.health is not None else _SILENT
        said = f"{name} runs {health.version or 'a version that it does not tell'}"
        if health.version and health.release:
            said += f" ({health.release})"
        if health.release == _FELL_BACK:
            said += f": {health.release_reason or 'an update did not stay'}"
            fix.append(f"fix that and update {name} again")
        if differs := difference(health.version, root) if health.version else "":
            said += f"; {differs}"
            fix.append(f"make update PAYLOAD={name}, or leave it: both speak the same messages")
        found.append(said)
    told = "; ".join(found)
    return warning("payloads", told, "; ".join(fix)) if fix else ok("payloads", told)


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
