"""A card, the emulated board that it boots, and the ground station that waits for it.

The card is made as a user makes it: `python -m deploy.image`, `blimp keys`, `python -m
deploy.flash`. The ground station is this process: telemetry by mutual TLS, video by SRTP, on the
ports that a card is told by default. Each wait has a bound and ends with the serial line's tail.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[2] / "stream"))

import emulator_card as card
import emulator_gauge as gauge
from emulator_machine import HOST, Machine
from receiving import Receiver

from deploy.errors import DeployError
from deploy.run import run
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.srtp import load_keys
from ground_station.stream.telemetry import PayloadState, TelemetryListener

CHECKOUT = Path(__file__).resolve().parents[3]
PAYLOAD = "blimp-1"
BOOT_LIMIT_S = float(os.environ.get("BLIMP_BOOT_LIMIT_S", "300"))
"""From power to telemetry and video; more where the machine has something else to do."""
FRAMES = 3
SETTINGS = """\
# All frames are sent, so that their rate can be told, and recorded, so that each power cut hits a
# file that is being written.
[gate]
enabled = false
[recording]
at_start = true
"""


@dataclass
class Figures:
    """What the run measured, written again after each addition."""

    path: Path
    values: dict[str, Any] = field(default_factory=dict)

    def add(self, name: str, value: Any) -> None:
        self.values[name] = value
        self._write()

    def append(self, name: str, value: Any) -> None:
        self.values.setdefault(name, []).append(value)
        self._write()

    def _write(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(self.values, indent=1) + "\n")


@dataclass(frozen=True)
class Up:
    """A payload that is up again: times since power-on, what it said, a frame from its camera."""

    telemetry_s: float
    packet_s: float
    frame_s: float
    state: PayloadState
    frame: ReceivedFrame

    def times(self) -> dict[str, float]:
        """The times, s, for a table."""
        return {
            "power_to_first_rtp_s": round(self.packet_s, 1),
            "power_to_first_frame_s": round(self.frame_s, 1),
            "power_to_telemetry_s": round(self.telemetry_s, 1),
        }


class Ground:
    """The ground station; it runs all the while, as a real one does. A context manager."""

    def __init__(self, keys: Path) -> None:
        folder = keys / "ground" / "main"
        self._closed = False
        self.telemetry = TelemetryListener(["tls/127.0.0.1:7447"], certificates=folder)
        self.video = Receiver(5600, queue_frames=8, srtp_keys=load_keys(folder))

    def __enter__(self) -> Ground:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Gives the ports away; a second call does nothing."""
        if not self._closed:
            self._closed = True
            self.video.close()
            self.telemetry.close()

    def state(self) -> PayloadState | None:
        return self.telemetry.state(PAYLOAD)

    def drain(self) -> None:
        """Throws away the frames that are still queued."""
        while self.video.get(0.0) is not None:
            pass


def program(*words: str | Path, **variables: str) -> str:
    """Runs one of the checkout's programs to its end; what it said, or a failure with it."""
    done = subprocess.run(
        [sys.executable, "-m", *map(str, words)],
        cwd=CHECKOUT, env={**os.environ, **variables}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.returncode == 0, f"{' '.join(map(str, words))}: {done.stdout[-2000:]}"
    return done.stdout


class Rig:
    """One payload's card, board and ground station."""

    def __init__(self, folder: Path, image: Path, figures: Figures, ssh_port: int) -> None:
        self.folder, self.figures, self.ssh_port = folder, figures, ssh_port
        self.keys = folder / "keys"
        self.fresh = folder / "fresh.img"  # as the flasher left it
        self.card = folder / "card.img"
        self.gauge = folder / "gauge.bin"
        self.volts = 3.9
        self._flash(image)
        self.root_digest = card.digest(self.fresh, card.ROOT)
        self.renew()
        self.machine = Machine(
            self.card,
            card.boot_files(self.card, folder / "boot"),
            folder / "logs",
            gauge_file=self.gauge,
            forward={22: ssh_port},
        )
        self.ground = Ground(self.keys)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        self.machine.cut()
        self.ground.__exit__()

    def _flash(self, image: Path) -> None:
        for words in (("init",), ("release",), ("ground", "main"), ("payload", PAYLOAD)):
            program("ground_station.cli", "keys", "--folder", self.keys, *words)
        settings = self.folder / "settings.toml"
        settings.write_text(SETTINGS)
        self.fresh.unlink(missing_ok=True)
        with self.fresh.open("wb") as file:
            file.truncate(2 * image.stat().st_size)  # a power of two, as the image is
        begun = time.monotonic()
        program(
            "deploy.flash", "--device", self.fresh, "--image", image, "--payload", PAYLOAD,
            "--no-wifi", "--ground", HOST, "--keys", self.keys, "--payload-toml", settings,
            "--board", "qemu", "--yes",
        )  # fmt: skip
        self.figures.add("flash_s", round(time.monotonic() - begun, 1))

    def renew(self) -> None:
        """A card that was never powered, as the flasher left it."""
        self.card.unlink(missing_ok=True)
        run(["cp", "--sparse=always", self.fresh, self.card])

    def power(self, volts: float | None = None, words: str = "") -> None:
        """Power on, with a gauge that shows these volts; returns at once."""
        self.volts = self.volts if volts is None else volts
        gauge.write(self.gauge, self.volts, percentage=0.625)
        self.machine.words = words
        self._before = self.ground.state()
        self._packets = self.ground.video.counters.packets
        self.ground.drain()
        self.machine.start()

    def until_up(self, limit_s: float = BOOT_LIMIT_S) -> Up:
        """Waits for telemetry and video of this power-on; raises `DeployError` without them."""
        telemetry_s = packet_s = frame_s = None
        frame: ReceivedFrame | None = None
        battery_before = self._before.battery if self._before else None
        end_s = self.machine.age_s + limit_s
        while None in (telemetry_s, packet_s, frame_s):
            got = self.ground.video.get(0.02)
            state = self.ground.state()
            if telemetry_s is None and state is not None and state.battery is not battery_before:
                telemetry_s = self.machine.age_s
            if packet_s is None and self.ground.video.counters.packets > self._packets:
                packet_s = self.machine.age_s
            if got is not None and frame_s is None:
                frame, frame_s = got, self.machine.age_s
            if not self.machine.running or self.machine.age_s > end_s:
                have = {"telemetry": telemetry_s, "packet": packet_s, "frame": frame_s}
                off = "" if self.machine.running else "the board went off; "
                raise DeployError(f"not up: {off}{have}, {limit_s:g} s{self.machine.tail()}")
        assert telemetry_s and packet_s and frame_s and state and frame
        return Up(telemetry_s, packet_s, frame_s, state, frame)

    def frames(self, count: int, limit_s: float = 60.0) -> list[ReceivedFrame]:
        """The next frames; raises `DeployError` when they do not come in time."""
        taken: list[ReceivedFrame] = []
        deadline = time.monotonic() + limit_s
        while len(taken) < count:
            if (frame := self.ground.video.get(0.2)) is not None:
                taken.append(frame)
            elif time.monotonic() > deadline or not self.machine.running:
                raise DeployError(f"{len(taken)} of {count} frames{self.machine.tail()}")
        return taken

    def run_until(self, age_s: float) -> None:
        """Lets the board run until so long after power-on."""
        while self.machine.age_s < age_s and self.machine.running:
            time.sleep(0.01)

    def cut(self) -> card.Health:
        """Takes the power away and looks at the card."""
        self.machine.cut()
        return card.health(self.card, self.folder / "look", self.root_digest)

    def ssh(self, command: str, limit_s: float = 60.0) -> str:
        """Runs a command on the board as its pilot."""
        key = self.keys / "ground" / "main" / "ssh_ed25519"
        done = subprocess.run(
            ["ssh", "-p", str(self.ssh_port), "-i", str(key), "-o", "IdentitiesOnly=yes",
             "-o", "BatchMode=yes", "-o", "StrictHostKeyChecking=no", "-o",
             "UserKnownHostsFile=/dev/null", "-o", "ConnectTimeout=20", "pilot@127.0.0.1", command],
            capture_output=True, text=True, timeout=limit_s, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        assert done.returncode == 0, f"ssh {command}: {done.stderr[-500:]}"
        return done.stdout

    def on_boot(self, path: str) -> bytes | None:
        """A file of the boot partition, by its path there; None when there is none."""
        offset = card.partition(self.card, card.BOOT).start
        try:
            return run(["mtype", "-i", f"{self.card}@@{offset}", f"::{path}"])
        except DeployError:
            return None
