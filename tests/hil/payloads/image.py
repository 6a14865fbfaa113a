"""`image`: the flashed card image in the emulated board, flown over SSH as a real one is.

The card is flashed with throw-away keys and booted once for a suite. An emulated processor bears
320x240 at 5 Hz: each recording is made small once (`small.py`) and kept. Its emulated USB network
bears a few hundred kbit/s; what is more waits in the board's own queue for seconds, and that queue
(fq_codel) throws packets away. So the encoder gets less, unless a case says what, and what is lost
there is accounted for but has no bound.
"""

from __future__ import annotations

import contextlib
import socket
import sys
import tempfile
from pathlib import Path
from typing import Any

from payloads import small
from payloads.ssh import SshPayload
from payloads.target import Target

from ground_station.errors import InputError
from ground_station.replay.rig import Rig

HIL = Path(__file__).resolve().parents[1]
CHECKOUT = HIL.parents[1]
EMULATOR = CHECKOUT / "out/emulator/qemu-system-aarch64"
IMAGE = CHECKOUT / "out/image/blimp-qemu.img"
SIZE = small.Size()
_SETTINGS = (
    "recording.at_start=false", "encoder.bitrate_kbps=300", "encoder.min_bitrate_kbps=100",
    "encoder.gop_frames=5",
)  # fmt: skip
_ASK_S = 600.0
_START_S = 900.0
"""Of the firmware, from its start to its first word, in an emulated processor beside other work."""


class ImagePayload:
    """A context manager for a whole suite: flashes, boots, and takes the power away at its end.

    Raises `InputError` for an image or an emulator that is not there, and what `Rig` does.
    """

    name = "image"
    link_host = "127.0.0.1"
    link_port = 0

    def __init__(self, image: Path = IMAGE, cache: Path = CHECKOUT / "out/hil/recordings") -> None:
        if not image.is_file():
            raise InputError(f"{image}: not there; `make image BOARD=qemu` builds it")
        if not EMULATOR.is_file():
            raise InputError(f"{EMULATOR}: not there; `sh tests/hil/image/tools.sh` makes it")
        self._image, self._cache = image, cache
        self._stack = contextlib.ExitStack()
        self._ssh: SshPayload | None = None

    def __enter__(self) -> ImagePayload:
        for folder in (CHECKOUT, HIL / "image"):
            if str(folder) not in sys.path:
                sys.path.insert(0, str(folder))
        from rig import PAYLOAD, Figures, Rig

        try:
            return self._up(PAYLOAD, Figures, Rig)
        except AssertionError as error:  # a program of the rig's failed
            raise InputError(f"{self._image}: {str(error).strip().splitlines()[-1]}") from None

    def _up(self, name: str, figures: Any, rig_of: Any) -> ImagePayload:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="blimp-image-")))
            port = _free_port()
            made = rig_of(folder, self._image, figures(folder / "figures.json"), port)
            rig = stack.enter_context(made)
            rig.power()
            up = rig.until_up()
            rig.ground.close()  # the flights open their own
            self.boot = up.times()
            known = folder / "known_hosts"
            host_key = (rig.keys / "payload" / name / "ssh_ed25519.pub").read_text()
            known.write_text(f"[127.0.0.1]:{port} {host_key}")
            identity = rig.keys / "ground" / "main" / "ssh_ed25519"
            target = Target("127.0.0.1", "pilot", port, identity, known)
            self._ssh = SshPayload(
                target, keys=rig.keys, video_port=0, telemetry_port=0, ask_s=_ASK_S,
                start_s=_START_S, bind="127.0.0.1",
            )  # fmt: skip
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def describe(self) -> str:
        """For the outcome."""
        assert self._ssh is not None
        boot = ", ".join(f"{name} {value:g}" for name, value in self.boot.items())
        return f"image {self._image.name} in QEMU: {self._ssh.describe()}; {boot}"

    def recording(self, path: Path) -> Path:
        """The recording as small as the board bears it."""
        return small.small(path, self._cache, SIZE)

    def stand(self, settings: tuple[str, ...], link: Any) -> Rig:
        """For one flight; the rig's card records from the start, which a replay does not need."""
        assert self._ssh is not None
        return self._ssh.stand((*_SETTINGS, *settings), link)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
