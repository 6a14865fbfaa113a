"""Two hosts on one network, as network namespaces that end with this program.

`unshare -rn python two_hosts.py CERTIFICATES FOREIGN` is the ground station's, which makes the
other one for the payload. Prints one JSON object of what the ground stations heard.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

from receiving import Receiver

from ground_station.stream.feedback import Feedback
from ground_station.stream.srtp import load_keys
from ground_station.stream.telemetry import PayloadState, TelemetryListener
from pi_firmware import __main__ as firmware
from pi_firmware.wire.scouting import interface_address

GROUND, PAYLOAD = "ground0", "payload0"
LIMIT_S = 60.0


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, timeout=20)


def ground(certificates: Path, foreign: Path) -> None:
    """The ground station's host, with another authority's ground station beside ours."""
    ip("link", "set", "lo", "up")
    ip("link", "add", GROUND, "type", "veth", "peer", "name", PAYLOAD)
    ip("addr", "add", "10.9.0.1/24", "dev", GROUND)
    ip("link", "set", GROUND, "up")
    folder = certificates / "payload" / "blimp-1"
    other = subprocess.Popen(
        ["unshare", "-n", sys.executable, __file__, "payload", str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert other.stdout is not None and other.stdout.readline() == "ready\n"
        ip("link", "set", PAYLOAD, "netns", str(other.pid))
        print(json.dumps(listen(certificates, foreign)))
    finally:
        other.kill()
        other.wait()


def listen(certificates: Path, foreign: Path) -> dict[str, object]:
    """What both heard, and what ours heard after it was restarted on another port."""
    said: dict[str, object] = {}
    endpoint, folder = "tls/10.9.0.1:0", certificates / "ground" / "main"
    with (
        TelemetryListener(
            [endpoint], certificates=foreign / "ground" / "main", discoverable=GROUND
        ) as stranger,
        Receiver(0, "10.9.0.1", srtp_keys=load_keys(folder)) as receiver,
    ):
        for name in ("first", "again"):
            with (
                TelemetryListener([endpoint], certificates=folder, discoverable=GROUND) as ours,
                Feedback(ours, {"blimp-1": receiver}.get),
            ):
                told = ours.wait("blimp-1", lambda s: s.alive and _told(s), LIMIT_S)
                frame = receiver.get(LIMIT_S)
                said[name] = {"link told": told is not None, "video": frame is not None}
        said["stranger"] = stranger.payloads()
    return said


def _told(state: PayloadState) -> bool:
    """Whether the payload says that it was told of its link, since it was last lost sight of."""
    return state.health is not None and state.health.round_trip_s is not None


def payload(folder: str) -> int:
    """The payload's host: its interface comes late, and its address later.

    Its program knows nothing of the ground station but the certificates of both.
    """
    print("ready", flush=True)

    def switch_on() -> None:
        while PAYLOAD not in [name for _, name in socket.if_nameindex()]:
            time.sleep(0.05)
        ip("addr", "add", "10.9.0.2/24", "dev", PAYLOAD)
        ip("link", "set", PAYLOAD, "up")

    assert interface_address(PAYLOAD) is None
    threading.Thread(target=switch_on, daemon=True).start()
    settings = (
        "camera.uri=test:", "camera.rate_hz=10", "link.host=auto", "telemetry.connect=[]",
        f"telemetry.certificates={folder}", f"telemetry.discover={PAYLOAD}", "wifi.interface=",
    )  # fmt: skip
    sys.argv = ["pi_firmware", *(part for setting in settings for part in ("--set", setting))]
    return firmware.main()


if __name__ == "__main__":
    if sys.argv[1] == "payload":
        sys.exit(payload(sys.argv[2]))
    else:
        ground(Path(sys.argv[1]), Path(sys.argv[2]))
