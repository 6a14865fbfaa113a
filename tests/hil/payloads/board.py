"""The far end of a payload at `ssh:`; runs on its board, sent with each command, not installed.

Standard library of Python 3.11 only. Standard input is the line to the ground: when it ends, so
does the flight. Standard output is JSON, one object a line; an error is one line on standard error
and status 2. A card (it has the payload's service) flies with that service itself: the same
release, user, certificates and payload.toml, with `--set` for what is another in a replay, by a
drop-in below /run that a power cut takes away. A unit of its own below /run owns the drop-in, and
systemd undoes it whatever becomes of that unit. Any other machine runs the firmware from a folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import platform
import select
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any, NoReturn

SERVICE = "blimp-payload.service"
UNIT = "blimp-hil.service"
CONFIG = Path("/data/blimp/payload.toml")
TRIAL = Path("/data/releases/trial.json")
RECORDINGS = Path("/data/hil")
WORK = Path("/run/blimp-hil")
DROP_IN = Path("/run/systemd/system") / f"{SERVICE}.d" / "90-hil.conf"
UNIT_FILE = Path("/run/systemd/system") / UNIT
LOG = WORK / "firmware.log"
LINE, SAID = WORK / "line", WORK / "said"
"""Pipes between the ground's line and the unit: what comes from the ground, what goes to it."""
KEPT = 4
"""Recordings that stay; those not used the longest go."""
ROOM_BYTES = 32 << 20
"""Of the data partition, left to the payload."""
_PROPERTIES = "ActiveState,Result,ExecMainStatus,MemoryPeak,CPUUsageNSec"
_BLOCK = 1 << 16
_END_S = 10.0
_START_S = 60.0


class BoardError(Exception):
    """One line for the person at the ground."""


def tell(**what: Any) -> None:
    """One JSON object for the ground."""
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def is_card() -> bool:
    """Whether this machine has the payload's service."""
    folders = ("/usr/lib/systemd/system", "/lib/systemd/system", "/etc/systemd/system")
    return any((Path(folder) / SERVICE).is_file() for folder in folders)


def look(spec: dict[str, Any]) -> None:
    """What the ground has to know before a flight."""
    told: dict[str, Any] = {
        "card": is_card(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "ground": os.environ.get("SSH_CONNECTION", "").split(" ")[0],
        "recordings": sorted(path.name for path in _folder(spec).glob("*.mcap")),
    }
    if told["card"] and os.geteuid() == 0:
        try:
            told["payload_id"] = tomllib.loads(CONFIG.read_text()).get("payload_id", "")
        except (OSError, ValueError) as error:
            raise BoardError(f"{CONFIG}: {error}; the card is not provisioned") from None
        if TRIAL.exists():
            raise BoardError("an update is on trial; ask again when the card has decided")
    tell(look=told)


def receive(spec: dict[str, Any]) -> None:
    """Takes a recording from standard input, beside its place, and names it by its digest."""
    folder, size = _folder(spec), int(spec["size"])
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        _make_room(folder, size)
        path = folder / f"{spec['sha256']}.mcap"
        part = path.with_suffix(".part")
        try:
            digest = _write(part, size)
            if digest != spec["sha256"]:
                raise BoardError(f"{size} bytes came with another digest than they were sent with")
            part.chmod(0o644)
            part.replace(path)
            _sync(folder)
        except OSError as error:
            raise BoardError(f"{part}: {error.strerror or error}") from None
        finally:
            part.unlink(missing_ok=True)
    tell(received=path.name)


def _folder(spec: dict[str, Any]) -> Path:
    return RECORDINGS if is_card() else Path(spec["recordings"]).expanduser()


def _make_room(folder: Path, size: int) -> None:
    for part in folder.glob("*.part"):
        part.unlink()
    kept = sorted(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime)
    while kept and (len(kept) >= KEPT or _free(folder) < size + ROOM_BYTES):
        kept.pop(0).unlink()
    if (free := _free(folder)) < size + ROOM_BYTES:
        need = f"{size / 1e6:.0f} MB and {ROOM_BYTES / 1e6:.0f} MB for the payload"
        raise BoardError(f"{folder}: {free / 1e6:.0f} MB are free; needed are {need}")


def _free(folder: Path) -> int:
    return shutil.disk_usage(folder).free


def _write(part: Path, size: int) -> str:
    digest, left = hashlib.sha256(), size
    with part.open("wb") as file:
        while left:
            block = os.read(0, min(left, _BLOCK))
            if not block:
                raise BoardError(f"the line ended {left} bytes before the recording's end")
            digest.update(block)
            file.write(block)
            left -= len(block)
        file.flush()
        os.fsync(file.fileno())
    return digest.hexdigest()


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fly(spec: dict[str, Any]) -> None:
    """Flies until the recording's end or the line's: on a card in a unit that undoes it all."""
    recording = _folder(spec) / spec["recording"]
    if not recording.is_file():
        raise BoardError(f"{recording}: not there")
    os.utime(recording)
    words = list(spec["settings"])
    at = next(i for i, word in enumerate(words) if word.startswith("camera.uri="))
    words[at] = words[at].replace(spec["placeholder"], str(recording))
    if not is_card():
        _fly_plainly(spec, words)
        return
    if _is_on(UNIT):
        raise BoardError(f"{UNIT} is active: another replay is under way on this card")
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(mode=0o755)
    (WORK / "board.py").write_bytes(SOURCE)
    was_active = _systemctl("is-active", "--quiet", SERVICE).returncode == 0
    (WORK / "spec.json").write_text(json.dumps({"settings": words, "was_active": was_active}))
    status = _in_a_unit(int(spec["limit_s"]))
    if status:
        sys.exit(status)


def _in_a_unit(limit_s: int) -> int:
    """Runs `lent` in a unit of its own and stands between it and the line; returns its status.

    `systemd-run` would do that, but it asks D-Bus, which a card does not carry.
    """
    for pipe in (LINE, SAID):
        os.mkfifo(pipe, 0o600)
    said, line = os.open(SAID, os.O_RDONLY | os.O_NONBLOCK), os.open(LINE, os.O_RDWR)
    UNIT_FILE.parent.mkdir(parents=True, exist_ok=True)
    UNIT_FILE.write_text(unit(limit_s))
    try:
        _checked("daemon-reload")
        _checked("start", UNIT)
        _relay(said, line)
        until_s = time.monotonic() + 1.5 * _START_S
        while _is_on(UNIT) and time.monotonic() < until_s:
            time.sleep(0.2)
        found = _shown(UNIT)
        good = found.get("Result", "success") == "success"
        return 0 if good else int(found.get("ExecMainStatus") or 0) or 1
    finally:
        UNIT_FILE.unlink(missing_ok=True)
        _systemctl("reset-failed", UNIT)
        _systemctl("daemon-reload")


def unit(limit_s: int) -> str:
    """The unit's words; its end undoes what it did, also after a kill."""
    program = f"/usr/bin/python3 -I {WORK}/board.py"
    return (
        "[Unit]\nDescription=A recorded flight, replayed for the ground\n"
        f"[Service]\nType=exec\nExecStart={program} lent\nExecStopPost={program} restore\n"
        f"TimeoutStopSec=60\nRuntimeMaxSec={limit_s}\n"
    )


def _relay(said: int, line: int) -> None:
    """Passes the unit's words on until it says no more; the ground's line ends its own."""
    watched, rest = [0, said], b""
    while said in watched:
        ready = select.select(watched, [], [], 5.0)[0]
        if 0 in ready and not os.read(0, _BLOCK):
            watched.remove(0)
            os.close(line)
        if said in ready:
            block = os.read(said, _BLOCK)
            *lines, rest = (rest + block).split(b"\n")
            for one in lines:
                # Nobody may listen any more, and the unit has to end all the same.
                with contextlib.suppress(BrokenPipeError):
                    to = sys.stdout if one.startswith(b"{") else sys.stderr
                    to.write(one.decode(errors="replace") + "\n")
                    to.flush()
            if not block:
                watched.remove(said)
        elif not ready and not _is_on(UNIT):
            return  # it never came to say a word


def lent() -> None:
    """Inside the unit: `hold`, with the pipes for a line; the unit's end finds none in its way."""
    taken, given = (os.open(LINE, os.O_RDONLY | os.O_NONBLOCK),
                    os.open(SAID, os.O_WRONLY | os.O_NONBLOCK))  # fmt: skip
    os.set_blocking(given, True)
    for descriptor, stream in ((taken, 0), (given, 1), (given, 2)):
        os.dup2(descriptor, stream)
    os.close(given)
    hold()


def hold() -> None:
    """Lets the payload's own service fly the recording, and watches."""
    spec = json.loads((WORK / "spec.json").read_text())
    _checked("stop", SERVICE)
    LOG.touch()
    DROP_IN.parent.mkdir(parents=True, exist_ok=True)
    DROP_IN.write_text(drop_in(spec["settings"]))
    _checked("daemon-reload")
    _checked("start", "--no-block", SERVICE)
    log, begun_s, started = _Tail(LOG), time.monotonic(), False
    while True:
        found, took_s = _state()
        log.forward()
        ended = found.get("ActiveState") in ("inactive", "failed")
        # A service that was only just told to start may not be at it yet.
        started |= not ended or LOG.stat().st_size > 0 or time.monotonic() - begun_s > _START_S
        if ended and started:
            break
        if _line_ended(max(0.5, 4 * took_s), log):
            return  # nobody listens any more; the unit's end does the rest
    good = found.get("Result") == "success"
    status = 0 if good else int(found.get("ExecMainStatus") or 0) or 1
    usage = {
        name: int(found[key])
        for name, key in (("memory_bytes", "MemoryPeak"), ("cpu_ns", "CPUUsageNSec"))
        if found.get(key, "").isdigit()
    }
    tell(ended=status, result=found.get("Result", ""), **usage)


def drop_in(settings: list[str]) -> str:
    """The unit's changes: how it is started, where it writes, and that it flies once."""
    words = ["/usr/bin/python3", "-P", "-m", "deploy.board.start"]
    for setting in settings:
        words += ["--set", setting]
    return (
        "[Service]\nExecStart=\n"
        f"ExecStart={' '.join(quoted(word) for word in words)}\n"
        f"Restart=no\nStandardOutput=append:{LOG}\nStandardError=inherit\n"
    )


def quoted(word: str) -> str:
    """A word as systemd's ExecStart takes it literally (systemd.service(5), "Command lines")."""
    if any(not character.isprintable() for character in word):
        raise BoardError(f"{word!r}: a setting with unprintable characters")
    for what in ("\\", '"'):
        word = word.replace(what, "\\" + what)
    return '"' + word.replace("%", "%%").replace("$", "$$") + '"'


def restore() -> None:
    """The card as it was: its service by its own words, running if it ran before."""
    try:
        was_active = json.loads((WORK / "spec.json").read_text())["was_active"]
    except (OSError, ValueError, KeyError):
        was_active = True
    DROP_IN.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        DROP_IN.parent.rmdir()
    _systemctl("daemon-reload")
    _systemctl("restart" if was_active else "stop", "--no-block", SERVICE)
    shutil.rmtree(WORK, ignore_errors=True)


def _state() -> tuple[dict[str, str], float]:
    begun_s = time.monotonic()
    found = _shown(SERVICE)
    return found, time.monotonic() - begun_s


def _shown(name: str) -> dict[str, str]:
    said = _systemctl("show", "-p", _PROPERTIES, name).stdout
    return dict(line.split("=", 1) for line in said.splitlines() if "=" in line)


def _is_on(name: str) -> bool:
    return _systemctl("is-active", name).stdout.strip() not in ("inactive", "failed", "unknown")


def _line_ended(for_s: float, log: _Tail) -> bool:
    """Waits so long, forwarding what is written; True when the ground's line has ended."""
    until_s = time.monotonic() + for_s
    while (left_s := until_s - time.monotonic()) > 0:
        if select.select([0], [], [], min(left_s, 0.25))[0] and not os.read(0, _BLOCK):
            return True
        log.forward()
    return False


class _Tail:
    """The lines of a file that grows, whole ones only."""

    def __init__(self, path: Path) -> None:
        self._file, self._rest = path.open("rb"), b""

    def forward(self) -> None:
        *lines, self._rest = (self._rest + self._file.read()).split(b"\n")
        _tell_lines(lines)


def _systemctl(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["systemctl", *words], capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False
    )


def _checked(*words: str) -> None:
    done = _systemctl(*words)
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no word"])[-1]
        raise BoardError(f"systemctl {' '.join(words)}: {said}")


def _fly_plainly(spec: dict[str, Any], settings: list[str]) -> None:
    """Runs the firmware from a folder, with that folder's payload.toml where there is one."""
    folder = Path(spec["folder"]).expanduser()
    if not (folder / "pi_firmware/__main__.py").is_file():
        raise BoardError(f"{folder}: no pi_firmware in it")
    tell(line=f"no {SERVICE} on this machine: the firmware runs from {folder}")
    words = [spec["python"], "-m", "pi_firmware"]
    if (config := folder / "payload.toml").is_file():
        words += ["--config", str(config)]
    for setting in settings:
        words += ["--set", setting]
    paths = os.pathsep.join((str(folder), str(folder / "site")))
    try:
        child = subprocess.Popen(
            words, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, env={**os.environ, "PYTHONPATH": paths},
        )  # fmt: skip
    except OSError as error:
        raise BoardError(f"{words[0]}: {error.strerror or error}") from None
    begun_s = time.monotonic()
    status = _watched(child, float(spec["limit_s"]))
    usage = _children()
    cpu_ns = int(1e9 * (usage.ru_utime + usage.ru_stime))
    took_s = time.monotonic() - begun_s
    tell(ended=status, memory_bytes=usage.ru_maxrss << 10, cpu_ns=cpu_ns, took_s=took_s)


def _children() -> Any:
    import resource

    return resource.getrusage(resource.RUSAGE_CHILDREN)


def _watched(child: subprocess.Popen[bytes], limit_s: float) -> int:
    """Forwards what the firmware says until it ends, or the line does and with it the firmware."""
    assert child.stdout is not None
    out, rest, until_s = child.stdout.fileno(), b"", time.monotonic() + limit_s
    watched, told_to_end = [0, out], False
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, lambda *_: child.terminate())
    while out in watched:
        ready = select.select(watched, [], [], 1.0)[0]
        line_ended = 0 in ready and not os.read(0, _BLOCK)
        if line_ended:
            watched.remove(0)
        if time.monotonic() > until_s and told_to_end:
            child.kill()
        elif (line_ended or time.monotonic() > until_s) and not told_to_end:
            child.terminate()
            told_to_end, until_s = True, time.monotonic() + _END_S
        if out in ready:
            block = os.read(out, _BLOCK)
            *lines, rest = (rest + block).split(b"\n")
            _tell_lines(lines)
            if not block:
                watched.remove(out)
    try:
        return child.wait(_END_S)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()


def _tell_lines(lines: list[bytes]) -> None:
    for line in lines:
        with contextlib.suppress(BrokenPipeError):  # nobody listens, and it has to end all the same
            tell(line=line.decode(errors="replace"))


def main(verb: str, text: str = "{}") -> NoReturn:
    """One command of the ground's, or of the unit's."""
    try:
        if verb in ("lent", "hold", "restore"):
            {"lent": lent, "hold": hold, "restore": restore}[verb]()
        else:
            {"look": look, "receive": receive, "fly": fly}[verb](json.loads(text))
    except BoardError as error:
        print(f"board: {error}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        print(f"board: {error.filename or verb}: {error.strerror or error}", file=sys.stderr)
        sys.exit(2)
    sys.exit(0)


SOURCE: bytes = globals().get("SOURCE", b"")
"""This file, as the ground has sent it."""

if __name__ == "__main__":
    main(*sys.argv[1:])
