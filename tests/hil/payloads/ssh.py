"""`ssh:user@host[:port]`: a payload at the other end of SSH, a card's or any machine's firmware.

The system's `ssh` with the user's own keys and known hosts, without a question asked: what needs
an answer fails in one line. A card is spoken to with mutual TLS and SRTP, by the ground's own keys.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import shlex
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from payloads.distant import Flight
from payloads.target import SshError, Target, parsed, reason

from ground_station.replay.rig import Rig
from ground_station.service.settings import TelemetrySettings, VideoSettings
from ground_station.stream.srtp import load_keys

BOARD = Path(__file__).with_name("board.py")
_TAKE = (
    "import os,sys\nn=int(sys.argv.pop(1));b=b''\n"
    "while len(b)<n:\n d=os.read(0,n-len(b))\n if not d: sys.exit('no program came')\n b+=d\n"
    "exec(compile(b,'board.py','exec'),{'__name__':'__main__','SOURCE':b})"
)
"""Reads the program from standard input, byte for byte, and leaves the rest there to it."""
_SEND_S = 1800.0
PLACEHOLDER = "@RECORDING@"


@dataclass(frozen=True)
class Plain:
    """How the firmware is run on a machine that is no card."""

    folder: str = "blimp"
    """Where `pi_firmware` lies, and its payload.toml where it has one."""
    python: str = "python3"
    recordings: str = "~/.cache/blimp-hil"


class SshPayload:
    """The payload; made once for a suite, it flies one recording after the other.

    Args:
        target: the machine.
        keys: the authority's folder of `blimp keys`, for a card.
        ground: whose certificates there the ground's end uses.
        plain: for a machine that is no card.
        ground_host: the ground's address as the payload sees it; None: the one it is reached from.
        video_port, telemetry_port: the ground's; 0 takes free ones.
        bind: the ground's own address for a card's video and telemetry.
        limit_s: a flight's longest, from its start; then the board ends it.
        start_s: how long the firmware may take to load.
        ask_s: how long an answer may take.

    Raises:
        SshError: it is not reached, or not as needed; one line.
    """

    name = "ssh"

    def __init__(
        self,
        target: Target,
        *,
        keys: Path | None = None,
        ground: str = "main",
        plain: Plain = Plain(),
        ground_host: str | None = None,
        video_port: int = 5600,
        telemetry_port: int = 7447,
        bind: str = "0.0.0.0",
        limit_s: float = 3600.0,
        start_s: float = 240.0,
        ask_s: float = 120.0,
    ) -> None:
        self.target, self.plain = target, plain
        self._video_port, self._telemetry_port, self._bind = video_port, telemetry_port, bind
        self._limit_s, self._start_s, self._ask_s = limit_s, start_s, ask_s
        self.sent = 0
        """Recordings sent so far."""
        self._digests: dict[Path, str] = {}
        first = self._look(root=False)
        self.is_card = bool(first["card"])
        told = self._look(root=True) if self.is_card else first
        self._held = set(told["recordings"])
        self.machine = f"{told['machine']}, Python {told['python']}"
        self.ground_host = ground_host or first["ground"]
        if not self.ground_host:
            raise SshError(f"{target.host}: does not tell where it is reached from; --ground-host")
        self.payload_id: str | None = told.get("payload_id") or None
        self.certificates: Path | None = None
        if self.is_card:
            if keys is None or not (keys / "ground" / ground).is_dir():
                raise SshError(
                    f"{keys}: no ground station '{ground}' in it; `blimp keys` makes one"
                )
            self.certificates = keys / "ground" / ground
        elif self.ground_host not in ("127.0.0.1", "::1"):
            raise SshError(
                f"{target.host}: no blimp-payload.service on it; without a card's certificates"
                f" the firmware speaks to loopback only, and we are {self.ground_host}"
            )

    def describe(self) -> str:
        """For the outcome: which machine and whether it is a card."""
        kind = f"card of {self.payload_id}" if self.is_card else "no card, firmware from a folder"
        return f"ssh:{self.target.host} ({self.machine}; {kind})"

    def __enter__(self) -> SshPayload:
        return self

    def __exit__(self, *_: object) -> None: ...

    @property
    def link_host(self) -> str:
        """Where a relay before the ground listens."""
        return self._bind if self.is_card else "127.0.0.1"

    @property
    def link_port(self) -> int:
        """And on which port: the one that the ground's firewall lets in."""
        return self._video_port if self.is_card else 0

    def recording(self, path: Path) -> Path:
        """What it flies for a recording: the same."""
        return path

    def stand(self, settings: tuple[str, ...], link: Any) -> Rig:
        """For one flight: `settings` are the firmware's, `link` the suite's."""
        made = Rig(payload=lambda config, folder: self.payload(config, folder, settings), link=link)
        if self.certificates is None:  # plain, on loopback
            return made
        if self.payload_id not in load_keys(self.certificates):
            raise SshError(f"{self.certificates}: no SRTP key of '{self.payload_id}'")
        video = VideoSettings(host=self._bind, port=self._video_port)
        return dataclasses.replace(
            made,
            video=video if link.kind == "loopback" else made.video,
            telemetry=TelemetrySettings(
                listen=[f"tls/{self._bind}:{self._telemetry_port}"],
                certificates=str(self.certificates),
            ),
            payload_id=self.payload_id,
        )

    def send(self, recording: Path) -> str:
        """Brings a recording there unless it is there already; its name on the board."""
        if recording not in self._digests:
            with recording.open("rb") as file:
                self._digests[recording] = hashlib.file_digest(file, "sha256").hexdigest()
        digest = self._digests[recording]
        name = f"{digest}.mcap"
        if name not in self._held:
            spec = {**self._spec(), "sha256": digest, "size": recording.stat().st_size}
            self._ask("receive", spec, recording.read_bytes(), _SEND_S)
            self.sent += 1
            self._held = set(self._look(root=self.is_card)["recordings"])
        return name

    @contextlib.contextmanager
    def payload(
        self, config: dict[str, Any], folder: Path, settings: tuple[str, ...] = ()
    ) -> Iterator[Flight]:
        """The firmware on the board; on a card its own settings with a few others."""
        uri = str(config["camera"]["uri"])
        scheme, _, rest = uri.partition(":")
        path, question, options = rest.partition("?")
        if scheme != "replay":
            raise SshError(f"camera.uri is {uri!r}; over SSH a recording is flown")
        name = self.send(Path(path))
        camera = {**config["camera"], "uri": f"replay:{PLACEHOLDER}{question}{options}"}
        spec = {
            **self._spec(),
            "recording": name,
            "placeholder": PLACEHOLDER,
            "settings": self._overrides({**config, "camera": camera}, settings),
            "limit_s": self._limit_s,
        }
        flight = Flight(self._command("fly", spec), BOARD.read_bytes(), folder, self.target.host)
        try:
            flight.wait_started(self._start_s)
            yield flight
        finally:
            flight.end()

    def _overrides(self, config: dict[str, Any], settings: tuple[str, ...]) -> list[str]:
        """What is told to the firmware as `--set`.

        A card keeps its own payload.toml: it is told of the camera, the gate where the replay sets
        one, what the case sets, and where the ground is. Any other machine gets all of `config`.
        """
        host, port = self.ground_host, int(config["link"]["port"])
        told = config
        endpoints = config["telemetry"]["connect"]
        if self.is_card:
            told = {name: config[name] for name in ("camera", "gate")}
            ground = f"[{host}]" if ":" in host else host
            endpoints = [f"tls/{ground}:{str(endpoints[0]).rpartition(':')[2]}"]
        listed = [
            f"{table}.{key}={_text(value)}"
            for table, keys in told.items()
            if isinstance(keys, dict)
            for key, value in keys.items()
        ]
        if not self.is_card:
            listed.append(f"payload_id={config['payload_id']}")
        return [
            *listed, *settings, f"link.host={host}", f"link.port={port}",
            f"telemetry.connect={_text(endpoints)}",
        ]  # fmt: skip

    def _spec(self) -> dict[str, Any]:
        plain = self.plain
        return {
            "folder": plain.folder, "python": plain.python, "recordings": plain.recordings,
        }  # fmt: skip

    def _look(self, *, root: bool) -> dict[str, Any]:
        answer = self._ask("look", self._spec(), root=root)
        found = answer.get("look")
        if not isinstance(found, dict):
            raise SshError(f"{self.target.host}: gave no answer that is understood")
        return found

    def _ask(
        self,
        verb: str,
        spec: dict[str, Any],
        data: bytes = b"",
        limit_s: float | None = None,
        *,
        root: bool | None = None,
    ) -> dict[str, Any]:
        """One command's answer; raises `SshError` with one line."""
        host, limit_s = self.target.host, limit_s or self._ask_s
        try:
            done = subprocess.run(
                self._command(verb, spec, root=root),
                input=BOARD.read_bytes() + data,
                capture_output=True,
                timeout=limit_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise SshError(f"{host}: no answer to '{verb}' within {limit_s:g} s") from None
        except OSError as error:
            raise SshError(f"ssh: {error.strerror or error}") from None
        if done.returncode:
            raise SshError(reason(host, done.returncode, done.stderr))
        answer = parsed(done.stdout)
        if answer is None:
            raise SshError(f"{host}: answered {done.stdout[:60]!r}")
        return answer

    def _command(self, verb: str, spec: dict[str, Any], *, root: bool | None = None) -> list[str]:
        words = ["python3", "-I", "-c", _TAKE, str(BOARD.stat().st_size), verb, json.dumps(spec)]
        if self.is_card if root is None else root:
            words = ["sudo", "-n", *words]
        return [*self.target.words(), shlex.join(words)]


def _text(value: Any) -> str:
    """A value as `--set` takes it: text as it is, all else as TOML, which JSON is for these."""
    return value if isinstance(value, str) else json.dumps(value)
