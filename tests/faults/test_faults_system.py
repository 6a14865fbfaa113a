"""A full disk and a network that is taken away: the flight goes on, the recording ends in order.

Each in namespaces of the payload's own, which end with it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest
from flight import Flight
from ground import Ground
from payload_process import LIMIT_S

from pi_firmware.wire import messages, sei
from pi_firmware.wire.recording import RecordingReader

DISK_KB = 800
MOUNT = f'mount -t tmpfs -o size={DISK_KB}k none "$0" && exec "$@"'
AWAY_S = 3.0


def need(*command: str) -> None:
    """Skips where this machine does not let a test do that."""
    if shutil.which(command[0]) is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip(f"not allowed here: {' '.join(command)}")


def test_a_disk_that_is_full_ends_the_recording_and_nothing_else(
    recording: Path, tmp_path: Path
) -> None:
    need("unshare", "-m", "mount", "-t", "tmpfs", "none", "/mnt")
    disk = tmp_path / "disk"
    disk.mkdir()
    with (
        Ground() as ground,
        Flight(
            tmp_path,
            ground,
            recording,
            f"recording.folder={disk}",
            "recording.at_start=true",
            "recording.min_free_MB=0",
            prefix=("unshare", "-m", "sh", "-c", MOUNT, str(disk)),
        ) as flight,
    ):
        flight.wait_streaming(30)
        ended = ground.listener.wait_for_event("blimp-1", messages.EVENT_RECORDING_ENDED, LIMIT_S)
        assert ended is not None and "No space left" in ended.text, ended
        written = copy(Path(f"/proc/{flight.payload.pid}/root{disk}"), tmp_path)
        flight.wait_streaming()
        account = flight.finish()
    account.assert_exact()
    assert len(account.seen) == len(account.left)
    infos = [sei.find(sample.data) for sample in RecordingReader(written).video()]
    recorded = [info.sequence for info in infos if info is not None]
    assert len(recorded) == len(infos) > 30
    sent = [frame.sequence for frame in account.left]
    begin = sent.index(recorded[0])
    assert recorded == sent[begin : begin + len(recorded)]


def copy(disk: Path, folder: Path) -> Path:
    """The one recording on the payload's disk, which ends with it, as a file here."""
    (found,) = disk.glob("*.mcap")
    return Path(shutil.copy(found, folder))


class Wire:
    """A cable from a process in a network namespace of its own to this machine."""

    def __init__(self, pid: int, host: str) -> None:
        self._pid, name, peer = str(pid), f"blimp{pid}", host.rpartition(".")[0] + ".2"
        self._run(
            "ip", "link", "add", name, "type", "veth", "peer", "name", "eth0", "netns", self._pid
        )
        self._run("ip", "address", "add", f"{host}/30", "dev", name)
        self._run("ip", "link", "set", name, "up")
        self._inside("address", "add", f"{peer}/30", "dev", "eth0")

    def plug(self) -> None:
        """There is a network."""
        self._inside("link", "set", "eth0", "up")

    def pull(self) -> None:
        """There is none, and no route to anywhere."""
        self._inside("link", "set", "eth0", "down")

    def _inside(self, *words: str) -> None:
        self._run("nsenter", "-t", self._pid, "-n", "ip", *words)

    def _run(self, *command: str) -> None:
        subprocess.run(command, check=True, capture_output=True)


def test_a_network_that_comes_late_and_goes(recording: Path, tmp_path: Path) -> None:
    """Nothing can be sent at all, not even a name looked up: frames are given up, none is kept."""
    need("unshare", "-n", "ip", "link", "add", "one", "type", "veth", "peer", "name", "two")
    host = f"10.{200 + os.getpid() // 250 % 50}.{os.getpid() % 250}.1"
    with (
        Ground() as ground,
        Flight(
            tmp_path,
            ground,
            recording,
            f"link.host={host}",
            "link.encrypted=false",
            "telemetry.enabled=false",
            prefix=("unshare", "-n"),
            host="0.0.0.0",
        ) as flight,
    ):
        flight.payload.wait_written("payload blimp-1")
        time.sleep(1)
        assert flight.payload.running and not flight.witness.left()
        wire = Wire(flight.payload.pid, host)
        wire.plug()
        flight.wait_streaming()
        time.sleep(1)
        wire.pull()
        time.sleep(AWAY_S)
        wire.plug()
        flight.wait_streaming()
        time.sleep(0.5)
        account = flight.finish()
    account.assert_in_order()
    assert account.link.lost == 0
    # What could not be sent never came to the link: its packets' numbers are missing there, and
    # the receiver misses the same.
    arrived = {frame.sequence for frame in account.left}
    assert 30 < len(arrived) < account.ended.counts["captured"] - 2 * 30
    received = account.received
    assert received is not None and received.packets == account.link.passed
    assert received.packets_lost == account.witness.gaps > 100
    assert received.failed == received.garbage == 0
