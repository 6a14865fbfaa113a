"""One Wi-Fi radio: what the kernel tells of it, and what `iw` and `ip` do to it."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from pi_firmware.health import small_files
from pi_firmware.wire.errors import BlimpError, ConfigError

LIMIT_S = 3.0
_KILLED_LIMIT_S = 0.5
_SYSTEM_FOLDERS = ("/usr/sbin", "/sbin", "/usr/bin", "/bin")  # a user's PATH may lack the first two


class ProgramError(BlimpError):
    """A program that is missing, refuses, or does not end in time."""


def run(words: Sequence[str], limit_s: float = LIMIT_S) -> str:
    """A program's standard output; raises `ProgramError` with one line.

    It runs in a session of its own, so that a Ctrl-C meant for us does not end it halfway. One that
    ignores even SIGKILL, as it hangs inside a driver, is left behind.
    """
    shown = " ".join(words)
    # An empty entry of a PATH would be the folder we stand in.
    folders = [folder for folder in os.environ.get("PATH", "").split(":") if folder]
    path = shutil.which(words[0], path=":".join((*folders, *_SYSTEM_FOLDERS)))
    if path is None:
        raise ProgramError(f"{shown}: {words[0]} is not installed")
    try:
        process = subprocess.Popen(
            [path, *words[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
    except (OSError, ValueError) as error:
        raise ProgramError(f"{shown}: {error}") from None
    try:
        output, complaint = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        _kill(process)
        raise ProgramError(f"{shown}: no end within {limit_s:g} s") from None
    if process.returncode:
        lines = complaint.decode(errors="replace").split("\n")
        reason = lines[0].strip()[:200] or f"exit status {process.returncode}"
        raise ProgramError(f"{shown}: {reason}")
    return output.decode(errors="replace")


def _kill(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_KILLED_LIMIT_S)
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()


AUTO = "auto"
Run = Callable[[list[str]], str]

_CLASS = "sys/class/net"
# Stricter than the kernel's rule: no name can be taken for an option or a path.
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,14}", re.ASCII)
_FLAGS = re.compile(r"0x[0-9a-fA-F]{1,8}", re.ASCII)
_IFF_UP = 1  # linux/if.h
_SIGNAL = re.compile(r"^\s*signal: (-[0-9]{1,3}) dBm", re.ASCII | re.MULTILINE)
_WEAKEST_DBM, _STRONGEST_DBM = -150, -1


def check_name(name: str) -> str:
    """Returns an interface's name; raises `ConfigError` for one that cannot be."""
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"'wifi.interface' is {name!r:.60}; expected a name of 1 to 15 letters, digits, '_',"
            " '-' and '.', as wlan0"
        )
    return name


def find(root: Path, wanted: str) -> str | None:
    """The radio of that name, or with "auto" the first there is; None without one."""
    if wanted != AUTO:
        return wanted if _is_radio(root, wanted) else None
    try:
        names = sorted(path.name for path in (root / _CLASS).iterdir())
    except OSError:
        return None
    return next((n for n in names if _NAME.fullmatch(n) and _is_radio(root, n)), None)


def exists(root: Path, name: str) -> bool:
    """Whether there is a network interface of that name, radio or not."""
    return (root / _CLASS / name).is_dir()


def index(root: Path, name: str) -> int | None:
    """The interface's number, another one each time its driver is loaded."""
    return small_files.number(root / _CLASS / name / "ifindex")


def is_down(root: Path, name: str) -> bool:
    """Whether it is switched off; False where the kernel does not tell."""
    flags = (small_files.text(root / _CLASS / name / "flags") or "").strip()
    return bool(_FLAGS.fullmatch(flags)) and not int(flags, 16) & _IFF_UP


def tells_signal(root: Path) -> bool:
    """Whether the kernel has /proc/net/wireless; without wireless extensions it has not."""
    return small_files.text(root / "proc/net/wireless") is not None


def signal_dbm(root: Path, name: str) -> float | None:
    """The signal in dBm by /proc/net/wireless; None when it is not connected or gives no dBm."""
    for line in (small_files.text(root / "proc/net/wireless") or "").splitlines():
        interface, colon, values = line.partition(":")
        words = values.split()  # status, quality, level, noise, …
        if colon and interface.strip() == name and len(words) >= 3:
            level = words[2].rstrip(".")
            if re.fullmatch(r"-[0-9]{1,3}", level, re.ASCII):
                return _believable(int(level))
    return None


def asked_signal_dbm(run: Run, name: str) -> float | None:
    """The same by `iw`; None when it is not connected. Raises `ProgramError`."""
    match = _SIGNAL.search(run(["iw", "dev", name, "link"]))
    return _believable(int(match[1])) if match else None


def quality(signal: float) -> float:
    """Linux's link quality, 0 to 1, of a signal in dBm: -110 and below is 0, -40 and above 1.

    As `cfg80211_wireless_stats` of the kernel's net/wireless/wext-compat.c has it.
    """
    return (min(max(signal, -110.0), -40.0) + 110.0) / 70.0


def set_power_save_off(run: Run, name: str) -> None:
    """Switches power save off and reads it back; raises `ProgramError`."""
    run(["iw", "dev", name, "set", "power_save", "off"])
    if not power_save_is_off(run, name):
        raise ProgramError(f"iw dev {name} set power_save off: it is still on")


def power_save_is_off(run: Run, name: str) -> bool:
    """Whether power save is off; raises `ProgramError`."""
    return run(["iw", "dev", name, "get", "power_save"]).strip().lower().endswith(": off")


def switch(run: Run, name: str, to: str) -> None:
    """Takes the interface `down`, or brings it `up`; raises `ProgramError`."""
    run(["ip", "link", "set", "dev", name, to])


def _is_radio(root: Path, name: str) -> bool:
    folder = root / _CLASS / name
    return (folder / "wireless").exists() or (folder / "phy80211").exists()


def _believable(level: int) -> float | None:
    return float(level) if _WEAKEST_DBM <= level <= _STRONGEST_DBM else None
