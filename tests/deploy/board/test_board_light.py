"""What a card tells of itself: the light's code, STATUS.txt, and how seldom it writes that."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from board_cards import FastDisk, Person

from deploy.board import light, provision, status
from deploy.board.light import PATIENCE_S, SETTLED_S, Judge, Link, StatusLed, StatusWriter, View
from deploy.board.releases.places import Places
from deploy.board.releases.service import Seen
from deploy.board.status import Fault

GOOD = {"state": provision.IN_FORCE, "payload_id": "blimp-1", "wifi": True}
STREAMS = Seen(active=True, said="active")
UP = (Link("wlan0", True, "192.0.2.7"),)


class Led:
    """A light as sysfs has it, which remembers what was written."""

    def __init__(self, root: Path, name: str = "ACT", triggers: str = "none heartbeat") -> None:
        self.folder = root / "sys/class/leds" / name
        self.folder.mkdir(parents=True)
        for file in ("trigger", "brightness"):
            (self.folder / file).write_text("")
        self.triggers = triggers.split()

    def read(self) -> tuple[str, str]:
        trigger, brightness = (self.folder / f for f in ("trigger", "brightness"))
        return trigger.read_text(), brightness.read_text()


@pytest.mark.parametrize("name", ["ACT", "led0"])
def test_a_fault_is_so_many_short_blinks_and_a_pause(tmp_path: Path, name: str) -> None:
    led = Led(tmp_path, name)
    seen: list[tuple[str, float]] = []
    lamp = StatusLed(tmp_path, lambda s: seen.append((led.read()[1], s)))
    lamp.blink(3)
    assert seen == [("255", 0.2), ("0", 0.3)] * 3 + [("0", 1.5)]
    assert led.read()[0] == "none"


def test_streaming_is_the_kernels_heartbeat_and_is_set_once(tmp_path: Path) -> None:
    led = Led(tmp_path)
    lamp = StatusLed(tmp_path, lambda s: None)
    lamp.steady()
    assert led.read() == ("none", "255")
    lamp.heartbeat()
    assert led.read()[0] == "heartbeat"
    (led.folder / "trigger").write_text("")
    lamp.heartbeat()
    assert led.read()[0] == ""


def test_a_kernel_without_the_heartbeat_and_a_board_without_a_light(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    led = Led(tmp_path)
    write = Path.write_text

    def refusing(path: Path, text: str, *rest: Any) -> int:
        if text == "heartbeat":
            raise OSError(22, "Invalid argument")  # as sysfs does for a trigger that it has not
        return write(path, text, *rest)

    monkeypatch.setattr(Path, "write_text", refusing)
    StatusLed(tmp_path, lambda s: None).heartbeat()
    assert led.read() == ("none", "255")
    dark = StatusLed(tmp_path / "none", lambda s: None)
    dark.blink(2)
    dark.heartbeat()


JUDGED: list[tuple[View, Fault | None, bool]] = [
    (View(GOOD, firmware=STREAMS, links=UP), None, True),
    (View(GOOD, "it could not be mounted", STREAMS, UP), status.NO_DATA, False),
    (View({"state": provision.NONE, "reason": ""}), status.NO_PROVISIONING, False),
    (View({"state": provision.NONE, "reason": "no user"}), status.REFUSED, False),
    (View({**GOOD, "state": provision.REFUSED}, "", STREAMS, UP), status.REFUSED, True),
    (View({}), status.REFUSED, False),
    (View(GOOD, links=UP), status.NO_VIDEO, False),
    (View(GOOD, firmware=STREAMS), status.NO_NETWORK, True),
    (View(GOOD, firmware=STREAMS, links=(Link("wlan0", True, ""),)), status.NO_NETWORK, True),
    (View(GOOD, firmware=STREAMS, links=(Link("eth0", False, "192.0.2.1"),)), None, True),
]


@pytest.mark.parametrize(("view", "fault", "streams"), JUDGED)
def test_the_worst_fault_is_told(view: View, fault: Fault | None, streams: bool) -> None:
    judge = Judge(100.0)
    early, _ = judge.fault(view, 100.0)
    if fault in (status.NO_VIDEO, status.NO_NETWORK):
        assert early is None  # the first frame and the first address take their time
        assert judge.fault(view, 99.9 + PATIENCE_S)[0] is None
    assert judge.fault(view, 100.0 + PATIENCE_S) == (fault, streams)


def test_a_firmware_that_comes_and_goes_is_given_time_again() -> None:
    judge = Judge(0.0)
    up, down = View(GOOD, firmware=STREAMS, links=UP), View(GOOD, links=UP)
    assert judge.fault(down, 80.0)[0] is None
    assert judge.fault(up, 85.0) == (None, True)
    assert judge.fault(down, 85.0 + PATIENCE_S - 1) == (None, False)
    assert judge.fault(down, 85.0 + PATIENCE_S)[0] is status.NO_VIDEO


def test_the_first_start_of_the_firmware_may_take_longer() -> None:
    judge = Judge(0.0)
    first = View(GOOD, firmware=Seen(said="activating"), links=UP)
    again = View(GOOD, firmware=Seen(said="activating", restarts=1), links=UP)
    assert judge.fault(first, PATIENCE_S)[0] is None
    assert judge.fault(again, PATIENCE_S)[0] is status.NO_VIDEO
    assert judge.fault(first, light.START_S)[0] is status.NO_VIDEO


class Written(FastDisk):
    def __init__(self) -> None:
        self.count = 0

    def write(self, path: Path, data: bytes, mode: int | None = None, owner: Any = None) -> None:
        self.count += 1
        super().write(path, data, mode, owner)


def test_the_card_is_written_to_when_a_state_has_settled_and_seldom(person: Person) -> None:
    disk = Written()
    status_writer = StatusWriter(person.card, disk, 0.0)
    status_writer.report(status.NO_NETWORK, True, lambda: b"no network", 10.0)
    status_writer.report(status.NO_NETWORK, True, lambda: b"no network", 10.0 + SETTLED_S - 1)
    assert disk.count == 0
    status_writer.report(status.NO_NETWORK, True, lambda: b"no network", 10.0 + SETTLED_S)
    assert (person.card.boot / "STATUS.txt").read_bytes() == b"no network"
    for second in range(100):
        status_writer.report(status.NO_NETWORK, True, lambda: b"other words", 50.0 + second)
    assert disk.count == 1
    status_writer.report(None, False, lambda: b"starting", 200.0)
    status_writer.report(None, False, lambda: b"starting", 400.0)
    assert disk.count == 1
    for turn in range(50):  # it comes and goes all flight long
        now_s = 1000.0 + 100 * turn
        text = f"turn {turn}".encode()
        fault = status.NO_NETWORK if turn % 2 else None
        status_writer.report(fault, True, lambda: b"never", now_s)
        status_writer.report(fault, True, lambda text=text: text, now_s + SETTLED_S)
    assert disk.count == light.MOST_WRITES


def test_the_same_text_is_not_written_again(person: Person) -> None:
    disk = Written()
    for _ in range(3):  # three boots
        status_writer = StatusWriter(person.card, disk, 0.0)
        status_writer.report(None, True, lambda: b"streaming", 0.0)
        status_writer.report(None, True, lambda: b"streaming", SETTLED_S)
    assert disk.count == 1


def test_a_boot_partition_that_is_not_there_is_said_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status_writer = StatusWriter(light.Card(tmp_path), FastDisk(), 0.0)
    for fault in status.ALL:
        status_writer.report(fault, False, lambda: b"", 0.0)
        status_writer.report(fault, False, lambda: b"", SETTLED_S)
    assert (
        capsys.readouterr().err == f"light: STATUS.txt: {tmp_path}/boot/firmware/blimp: not there\n"
    )


def test_status_txt_names_everything_and_how_to_mend_it(
    person: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    card = person.card
    Places(card.root).board.write_text(json.dumps({"board": "zero2w", "image": "2026.11"}))
    running = card.root / "run/blimp/release.json"
    running.parent.mkdir(parents=True)
    running.write_text(json.dumps({"version": "0.2.0", "how": "fell back\r\nFAULT: forged"}))
    monkeypatch.setattr(
        status,
        "said",
        lambda unit: ["wlan0: CTRL-EVENT-SSID-TEMP-DISABLED reason=WRONG_KEY"],
    )
    view = View({**GOOD, "warning": "SSH is not set up: ö"}, firmware=STREAMS, links=UP)
    text = light.text_of(card, status.NO_NETWORK, view)
    lines = text.decode().split("\r\n")
    assert "\n" not in "".join(lines)
    assert "State:    FAULT: no network (5 blinks)" in lines
    assert "Reason:   the network refuses the password" in lines
    assert f"To fix:  {status.NO_NETWORK.fix}" in lines
    assert "Warning:  SSH is not set up: ö" in lines
    assert "Payload:  blimp-1" in lines
    assert "Network:  wlan0 192.0.2.7" in lines
    assert "Firmware: 0.2.0 (fell back FAULT: forged)" in lines
    assert "Image:    2026.11, for the board zero2w" in lines


def test_a_good_card_says_so(person: Person) -> None:
    text = light.text_of(person.card, None, View(GOOD, firmware=STREAMS, links=UP)).decode()
    assert "State:    streaming\r\n" in text and "Reason" not in text and "To fix" not in text


REASONS: list[tuple[Fault, View, list[str], str]] = [
    (status.NO_DATA, View(GOOD, "it could not be mounted"), [], "it could not be mounted"),
    (status.REFUSED, View({"reason": "blimp.toml: x"}), [], "blimp.toml: x"),
    (status.REFUSED, View({}), [], "the program that reads this folder did not come to an end"),
    (
        status.NO_VIDEO,
        View(GOOD),
        ["start: release 1", "pi_firmware: no camera", "Traceback", "start: release 1"],
        "no camera",
    ),
    (status.NO_VIDEO, View(GOOD, firmware=Seen(said="failed")), ["start: release 1"], "failed"),
    (status.NO_NETWORK, View(GOOD), [], "this board has no radio, or its driver did not start"),
    (
        status.NO_NETWORK,
        View(GOOD, links=(Link("wlan0", True, ""),)),
        ["4-Way Handshake failed", "CTRL-EVENT-NETWORK-NOT-FOUND"],
        "the network is not in reach, or has another name",
    ),
    (
        status.NO_NETWORK,
        View({**GOOD, "wifi": False}),
        [],
        "no cable, or nobody there who gives addresses",
    ),
]


@pytest.mark.parametrize(("fault", "view", "lines", "told"), REASONS)
def test_the_cause_is_told_as_far_as_it_is_known(
    monkeypatch: pytest.MonkeyPatch, fault: Fault, view: View, lines: list[str], told: str
) -> None:
    monkeypatch.setattr(status, "said", lambda unit: lines)
    assert light.reason(fault, view) == told


def test_what_others_say_is_one_printable_line_of_bounded_length() -> None:
    line = status.one_line("a\x1b[31m\r\nState: fine\x85" + "x" * 1000)
    assert line.startswith("a [31m State: fine x") and len(line) == 300


MOUNTS = {
    "/dev/mmcblk0p3 /data ext4 rw,noatime,errors=remount-ro 0 0": "",
    "/dev/mmcblk0p3 /data ext4 ro,noatime 0 0": "it had an error while it was written, and is",
    "overlay / overlay rw 0 0": "it could not be mounted",
}


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_data_partition_is_judged_by_how_it_is_mounted(tmp_path: Path, mount: str) -> None:
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/mounts").write_text(f"proc /proc proc rw 0 0\n{mount}\n")
    told = light.data_fault(tmp_path)
    assert told.startswith(MOUNTS[mount]) and bool(told) == bool(MOUNTS[mount])


def test_links_with_a_carrier_have_their_address(tmp_path: Path) -> None:
    for name, carrier in (("lo", "1"), ("eth0", "0"), ("wlan0", "1"), ("usb0", None)):
        folder = tmp_path / "sys/class/net" / name
        folder.mkdir(parents=True)
        if carrier:
            (folder / "carrier").write_text(f"{carrier}\n")
    (tmp_path / "sys/class/net/wlan0/phy80211").mkdir()
    assert light.links(tmp_path, lambda name: "192.0.2.9") == [
        Link("eth0", False, ""),
        Link("usb0", False, ""),
        Link("wlan0", True, "192.0.2.9"),
    ]
    assert light.ipv4("lo") == "127.0.0.1" and light.ipv4("no-such") == ""


def test_name_servers_are_those_of_the_networks_and_nothing_else(person: Person) -> None:
    card = person.card
    card.resolver.parent.mkdir(parents=True)
    light.resolve(card)
    assert card.resolver.read_text() == "options timeout:2 attempts:2\n"
    state = card.root / "run/systemd/netif/state"
    state.parent.mkdir(parents=True)
    state.write_text("OPER_STATE=routable\nDNS=192.0.2.1 evil;rm fd00::1 192.0.2.2 192.0.2.3\n")
    light.resolve(card)
    assert card.resolver.read_text() == (
        "nameserver 192.0.2.1\nnameserver fd00::1\nnameserver 192.0.2.2\n"
        "options timeout:2 attempts:2\n"
    )
    before = card.resolver.stat()
    light.resolve(card)
    assert card.resolver.stat().st_ino == before.st_ino
    assert card.resolver.stat().st_mtime_ns == before.st_mtime_ns
