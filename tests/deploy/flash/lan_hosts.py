"""A station and a flashed card's firmware as two hosts, in network namespaces that end with this.

`unshare -rn python lan_hosts.py PAYLOAD_TOML INTERFACES WORDS…` is the station's host, where the
command WORDS runs. Its network is `ground0`; with INTERFACES 2 another one is up beside it, which
the payload does not reach. Prints one JSON object: what the station's page says of the payloads.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import urllib.error
import urllib.request
from typing import Any

LIMIT_S = 90.0
FRAMES = 10
DEVICES = (
    "camera.uri=test:", "encoder.name=x264enc", "battery.uri=fake:", "wifi.interface=",
    "recording.folder=", "supervision.state=",
)  # fmt: skip
"""What this machine lacks of a board. All else, of the network above all, is the card's own."""


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, timeout=20)


def cable(name: str, other: str, address: str) -> None:
    ip("link", "add", name, "type", "veth", "peer", "name", other)
    ip("addr", "add", address, "dev", name)
    ip("link", "set", name, "up")


def station(payload_toml: str, interfaces: int, words: list[str]) -> int:
    ip("link", "set", "lo", "up")
    cable("ground0", "wlan0", "10.9.0.1/24")
    if interfaces == 2:
        cable("cable0", "far0", "10.8.0.1/24")
        ip("link", "set", "far0", "up")
    board = subprocess.Popen(
        ["unshare", "-n", sys.executable, __file__, "board", payload_toml],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    serving = None
    try:
        assert board.stdout is not None and board.stdin is not None
        assert board.stdout.readline() == "ready\n"
        ip("link", "set", "wlan0", "netns", str(board.pid))
        board.stdin.write("go\n")
        board.stdin.flush()
        while ip_state("ground0") != "UP":
            time.sleep(0.05)
        serving = subprocess.Popen(words, stdout=sys.stderr)
        print(json.dumps(heard(serving)))
    finally:
        board.kill()
        board.wait()
        if serving is not None:
            serving.terminate()
            serving.wait(20)
    return 0


def ip_state(name: str) -> str:
    said = subprocess.run(["ip", "-j", "link", "show", name], capture_output=True, check=True)
    return str(json.loads(said.stdout)[0]["operstate"])


def heard(serving: subprocess.Popen[bytes]) -> dict[str, Any]:
    """The page's payloads, once one lives and its video comes, or at the limit."""
    payloads: dict[str, Any] = {}
    until_s = time.monotonic() + LIMIT_S
    while time.monotonic() < until_s and serving.poll() is None:
        time.sleep(0.5)
        try:
            with urllib.request.urlopen("http://127.0.0.1:8080/api/state", timeout=5) as answer:
                views = json.load(answer)["payloads"]
        except (urllib.error.URLError, TimeoutError):
            continue
        payloads = {
            name: {
                "alive": view["alive"],
                "frames": (view["payload"] or {}).get("frames", {}).get("received", 0),
                "encrypted": (view["payload"] or {}).get("encrypted"),
            }
            for name, view in views.items()
        }
        if any(view["alive"] and view["frames"] >= FRAMES for view in payloads.values()):
            break
    return payloads


def board(payload_toml: str) -> int:
    """The payload's host, once it has its radio."""
    from pi_firmware import __main__ as firmware

    print("ready", flush=True)
    sys.stdin.readline()
    ip("link", "set", "lo", "up")
    ip("addr", "add", "10.9.0.2/24", "dev", "wlan0")
    ip("link", "set", "wlan0", "up")
    settings = (part for setting in DEVICES for part in ("--set", setting))
    sys.argv = ["pi_firmware", "--config", payload_toml, *settings]
    return firmware.main()


if __name__ == "__main__":
    if sys.argv[1] == "board":
        sys.exit(board(sys.argv[2]))
    sys.exit(station(sys.argv[1], int(sys.argv[2]), sys.argv[3:]))
