"""`blimp serve --check` refuses what `blimp serve` refuses at its start, in the same line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ground_station.keys.authority import Authority

ROOT = Path(__file__).parents[2]
TLS = 'telemetry.listen=["tls/127.0.0.1:0"]'
PORTS = ("video.port=5699", "http.port=0", "foxglove.port=0")


def serve(*words: str) -> subprocess.CompletedProcess[str]:
    """The program, to its end."""
    blimp = str(Path(sys.executable).with_name("blimp"))
    return subprocess.run(
        [blimp, "serve", *words], cwd=ROOT, capture_output=True, text=True, timeout=120,
        check=False,
    )  # fmt: skip


def sets(*settings: str) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


def test_what_is_good_is_said() -> None:
    done = serve("--check")
    assert done.returncode == 0 and done.stderr == ""
    assert done.stdout.splitlines()[0] == "configuration is good"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (("map.folder=tests",), "tests: a folder without a map (map.toml); blimp map build"),
        (("map.folder=nosuch",), "nosuch: there is no such map; blimp map build INPUT --out"),
        (("map.camera=/nosuch.toml",), "/nosuch.toml: No such file or directory"),
        (("telemetry.certificates=/nosuch", TLS), "/nosuch"),
        (("telemetry.discoverable=wlan9",), "discovery on 'wlan9': without certificates only 'lo'"),
        (("http.host=0.0.0.0",), "http.host is '0.0.0.0', which others reach: it needs"),
        (("http.token_file=/nosuch",), "/nosuch"),
    ],
)
def test_both_refuse_it(settings: tuple[str, ...], said: str) -> None:
    checked = serve("--check", *sets(*settings))
    assert (checked.returncode, checked.stderr.count("\n")) == (2, 1)
    assert said in checked.stderr
    served = serve(*sets(*PORTS, *settings))
    assert served.returncode == 2 and said in served.stderr, served.stderr


def test_keys_and_the_interface_are_looked_at(tmp_path: Path) -> None:
    keys = Authority.create(tmp_path / "keys").add("ground", "main")
    words = ["--check", *sets(f"telemetry.certificates={keys}", TLS)]
    done = serve(*words)
    assert done.returncode == 0, done.stderr
    done = serve(*words, *sets("telemetry.discoverable=wlan9"))
    assert "telemetry.discoverable is 'wlan9': no such interface (there are: " in done.stderr
