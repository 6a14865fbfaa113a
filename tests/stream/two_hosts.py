"""Two hosts on one network, as network namespaces that end with this program.

`unshare -rn python two_hosts.py CERTIFICATES FOREIGN` is the ground station's, which makes the
other one for the payload. Prints one JSON object of what the ground stations heard.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.settings import TelemetrySettings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import messages
from pi_firmware.wire.telemetry import interface_address

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
    """What both heard, and what ours heard after it was started anew on another port."""
    said: dict[str, object] = {}
    endpoint = "tls/10.9.0.1:0"
    with TelemetryListener(
        [endpoint], certificates=foreign / "ground" / "main", discoverable=GROUND
    ) as stranger:
        for name in ("first", "again"):
            with TelemetryListener(
                [endpoint], certificates=certificates / "ground" / "main", discoverable=GROUND
            ) as ours:
                state = ours.wait("blimp-1", lambda s: s.battery is not None, LIMIT_S)
                said[name] = state is not None and state.alive
        said["stranger"] = stranger.payloads()
    return said


def payload(folder: str) -> None:
    """The payload's host: its interface comes late, and its address later."""
    print("ready", flush=True)

    def switch_on() -> None:
        while PAYLOAD not in [name for _, name in socket.if_nameindex()]:
            time.sleep(0.05)
        ip("addr", "add", "10.9.0.2/24", "dev", PAYLOAD)
        ip("link", "set", PAYLOAD, "up")

    assert interface_address(PAYLOAD) is None
    threading.Thread(target=switch_on, daemon=True).start()
    settings = TelemetrySettings(connect=[], certificates=folder, discover=PAYLOAD)
    telemetry = Telemetry("blimp-1", settings)
    while os.getppid() != 1:
        telemetry.battery(messages.Battery(time_ns=1, voltage=3.9))
        time.sleep(0.1)


if __name__ == "__main__":
    if sys.argv[1] == "payload":
        payload(sys.argv[2])
    else:
        ground(Path(sys.argv[1]), Path(sys.argv[2]))
