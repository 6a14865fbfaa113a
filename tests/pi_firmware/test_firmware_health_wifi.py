"""The radio's watch, with trees that stand for the kernel and small scripts for `iw` and `ip`."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from waiting import eventually

from pi_firmware.health import radio
from pi_firmware.health.radio import ProgramError
from pi_firmware.health.wifi import Wifi, WifiState
from pi_firmware.settings import WifiSettings
from pi_firmware.wire import messages
from pi_firmware.wire.errors import ConfigError

LIMIT_S = 20.0
RESTARTED = messages.EVENT_RADIO_RESTARTED
UP, DOWN = "0x1003\n", "0x1002\n"
WIRELESS = (
    "Inter-| sta-|   Quality        |   Discarded packets               | Missed | WE\n"
    " face | tus | link level noise |  nwid  crypt   frag  retry   misc | beacon | 22\n"
    " wlan0: 0000   {quality}.  {level}.  -256        0      0      0      0     11        0\n"
)


def interface(root: Path, name: str, *, is_radio: bool = True, index: int = 3) -> None:
    folder = root / "sys/class/net" / name
    (folder / "wireless" if is_radio else folder).mkdir(parents=True, exist_ok=True)
    (folder / "ifindex").write_text(f"{index}\n")
    (folder / "flags").write_text(UP)


def signal(root: Path, level: object, quality: object = 50) -> None:
    path = root / "proc/net/wireless"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(WIRELESS.format(level=level, quality=quality))


class Rig:
    """A radio's watch with a clock moved by hand, and programs that obey unless told not to."""

    def __init__(self, root: Path, wanted: str = "auto", restart_after_s: float = 20.0) -> None:
        self.root = root
        self.now_s = 1000.0
        self.calls: list[str] = []
        self.events: list[tuple[str, str]] = []
        self.refusing: dict[str, str] = {}
        self.power_save, self.stubborn = "on", False
        self.link = "Not connected.\n"
        self.wifi = Wifi(
            WifiSettings(interface=wanted, restart_after_s=restart_after_s),
            lambda name, text: self.announce(name, text),
            root=root,
            run=lambda words: self.run(words),
            clock=lambda: self.now_s,
            off_s=0.0,
        )

    def announce(self, name: str, text: str) -> None:
        self.events.append((name, text))

    def run(self, words: list[str]) -> str:
        call = " ".join(words)
        self.calls.append(call)
        for part, reason in self.refusing.items():
            if part in call:
                raise ProgramError(f"{call}: {reason}")
        if call.endswith("set power_save off") and not self.stubborn:
            self.power_save = "off"
        if call.endswith(("up", "down")):
            path = self.root / "sys/class/net" / words[4] / "flags"
            path.write_text(UP if words[5] == "up" else DOWN)
        if call.endswith("get power_save"):
            return f"Power save: {self.power_save}\n"
        return self.link if call.endswith("link") else ""

    def look(self, after_s: float = 1.0) -> list[str]:
        """One round `after_s` later; what it ran."""
        self.now_s += after_s
        before = len(self.calls)
        self.wifi.look()
        return self.calls[before:]

    def restarts(self, seconds: int, apart_s: int = 1) -> list[int]:
        """The seconds, of rounds so far apart, at which the radio was restarted."""
        rounds = range(apart_s, seconds + 1, apart_s)
        return [second for second in rounds if "ip link set dev wlan0 down" in self.look(apart_s)]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A board with a wired interface and a radio, connected at -50 dBm."""
    tree = tmp_path / "root"
    interface(tree, "eth0", is_radio=False, index=2)
    interface(tree, "wlan0")
    signal(tree, -50, 60)
    return tree


def test_the_first_radio_is_found_and_power_save_is_off_at_once(root: Path) -> None:
    interface(root, "wlan1", index=4)
    rig = Rig(root)
    assert rig.look() == ["iw dev wlan0 set power_save off", "iw dev wlan0 get power_save"]
    assert rig.look() == [] and rig.events == []
    assert rig.wifi.state == WifiState("wlan0", -50.0, 60 / 70, 0)


def test_power_save_that_somebody_switched_on_is_switched_off_within_a_minute(root: Path) -> None:
    rig = Rig(root)
    rig.look()
    rig.power_save = "on"
    calls = [call for _ in range(61) for call in rig.look()]
    assert calls == [
        "iw dev wlan0 get power_save",
        "iw dev wlan0 set power_save off",
        "iw dev wlan0 get power_save",
    ]


def test_a_driver_loaded_anew_is_kept_awake_at_once(root: Path) -> None:
    rig = Rig(root)
    rig.look()
    interface(root, "wlan0", index=7)
    assert rig.look() == ["iw dev wlan0 set power_save off", "iw dev wlan0 get power_save"]


def test_an_iw_that_refuses_is_told_once_and_tried_again(root: Path) -> None:
    rig = Rig(root)
    rig.refusing["iw"] = "Operation not permitted"
    for _ in range(200):
        rig.look()
    assert [name for name, _ in rig.events] == [messages.EVENT_RADIO_FAILED]
    assert "Operation not permitted" in rig.events[0][1]
    del rig.refusing["iw"]
    for _ in range(61):
        rig.look()
    assert rig.power_save == "off"


def test_power_save_that_stays_on_although_iw_says_nothing_is_told(root: Path) -> None:
    rig = Rig(root)
    rig.stubborn = True
    rig.look()
    assert [name for name, _ in rig.events] == [messages.EVENT_RADIO_FAILED]
    assert "still on" in rig.events[0][1]


def test_a_silent_ground_restarts_the_radio_ever_more_seldom(root: Path) -> None:
    rig = Rig(root)
    rig.wifi.heard()
    assert rig.restarts(2000, 10) == [20, 60, 140, 300, 620, 1220, 1820]
    assert rig.wifi.state.restarts == 7
    assert [name for name, _ in rig.events] == [RESTARTED] * 7
    assert "silent for 20 s" in rig.events[0][1]
    rig.wifi.heard()
    assert rig.restarts(70) == [20, 60], "heard again: it begins again"


def test_a_ground_that_is_heard_or_was_never_heard_restarts_nothing(root: Path) -> None:
    never = Rig(root)
    assert never.restarts(2000, 10) == []
    steady = Rig(root)
    for _ in range(5):
        steady.wifi.heard()
        assert steady.restarts(19) == []
    off = Rig(root, restart_after_s=0.0)
    off.wifi.heard()
    assert off.restarts(2000, 10) == []


def test_a_silence_of_an_hour_stays_an_hour(root: Path) -> None:
    rig = Rig(root, restart_after_s=3600.0)
    rig.wifi.heard()
    assert rig.restarts(8000, 100) == [3600, 7200]


def test_a_restart_that_is_refused_is_told_once_and_not_counted(root: Path) -> None:
    rig = Rig(root)
    rig.refusing["ip link"] = "RTNETLINK answers: Operation not permitted"
    rig.wifi.heard()
    rig.restarts(400)
    assert rig.wifi.state.restarts == 0
    assert [name for name, _ in rig.events] == [messages.EVENT_RADIO_FAILED]
    assert "Operation not permitted" in rig.events[0][1]
    rig.refusing.clear()
    rig.restarts(400)
    assert rig.wifi.state.restarts == 1 and rig.events[-1][0] == RESTARTED


def test_a_down_that_hangs_is_followed_by_up_all_the_same(root: Path) -> None:
    rig = Rig(root)
    rig.refusing["down"] = "no end within 3 s"
    rig.wifi.heard()
    calls = rig.look(20.0)
    assert calls.index("ip link set dev wlan0 down") < calls.index("ip link set dev wlan0 up")


def test_a_radio_left_switched_off_is_switched_on_with_growing_pauses(root: Path) -> None:
    (root / "sys/class/net/wlan0/flags").write_text(DOWN)
    rig = Rig(root)
    rig.refusing["up"] = "RTNETLINK answers: Operation not possible due to RF-kill"
    tried = [second for second in range(100) if "ip link set dev wlan0 up" in rig.look()]
    assert tried == [0, 5, 15, 35, 75]
    assert [name for name, _ in rig.events] == [messages.EVENT_RADIO_FAILED]
    rig.refusing.clear()
    for _ in range(100):
        rig.look()
    assert (root / "sys/class/net/wlan0/flags").read_text() == UP
    assert rig.wifi.state.restarts == 0


def test_a_ground_heard_within_a_restart_begins_the_pauses_anew(root: Path) -> None:
    rig = Rig(root)
    obey = rig.run

    def hears(words: list[str]) -> str:
        if words[-1] == "up":
            rig.now_s += 2.0
            rig.wifi.heard()
        return obey(words)

    rig.run = hears  # type: ignore[method-assign]
    rig.wifi.heard()
    assert rig.restarts(60) == [20, 40, 60]


def test_where_restarts_are_not_wanted_nothing_is_switched_on(root: Path) -> None:
    (root / "sys/class/net/wlan0/flags").write_text(DOWN)
    rig = Rig(root, restart_after_s=0.0)
    assert not any("ip" in call.split() for call in rig.look())


def test_without_a_radio_nothing_happens_until_one_comes(tmp_path: Path) -> None:
    interface(tmp_path, "eth0", is_radio=False)
    for wanted in ("auto", "wlan0"):
        rig = Rig(tmp_path, wanted)
        rig.wifi.heard()
        assert rig.restarts(100) == [] and rig.calls == [] and rig.events == []
        assert rig.wifi.state == WifiState()
    interface(tmp_path, "wlan0")
    assert rig.look()[0] == "iw dev wlan0 set power_save off"


def test_off_is_off(root: Path) -> None:
    rig = Rig(root, wanted="")
    rig.wifi.heard()
    assert rig.restarts(100) == [] and rig.calls == []
    rig.wifi.step()
    assert "wifi" not in {thread.name for thread in threading.enumerate()}


def test_a_wired_interface_by_mistake_is_told_and_left_alone(root: Path) -> None:
    rig = Rig(root, wanted="eth0")
    rig.wifi.heard()
    for _ in range(100):
        rig.look()
    assert rig.calls == []
    assert rig.events == [(messages.EVENT_RADIO_FAILED, "interface: eth0 is no radio")]


@pytest.mark.parametrize(
    "name",
    ["-h", "--help", "wlan0/..", "..", ".", "wlan 0", "wlan0\n", "wlan0;reboot", "x" * 16, "wlanö"],
)
def test_a_name_that_no_interface_can_have_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"'wifi\.interface' is .*; expected a name") as raised:
        Wifi(WifiSettings(interface=name), lambda *_: None)
    assert "\n" not in str(raised.value)


def test_a_name_like_an_option_is_not_taken_from_the_kernel_either(tmp_path: Path) -> None:
    interface(tmp_path, "-force")
    rig = Rig(tmp_path)
    assert rig.look() == []
    interface(tmp_path, "wlan0")
    assert rig.look()[0] == "iw dev wlan0 set power_save off"


@pytest.mark.parametrize(
    ("level", "dbm", "quality"),
    [
        (-50, -50.0, 60 / 70),
        (-40, -40.0, 1.0),
        (-20, -20.0, 1.0),
        (-110, -110.0, 0.0),
        (-256, None, None),  # the kernel's word for not known
        (0, None, None),  # not connected
        (55, None, None),  # a driver without dBm
        ("nan", None, None),
        ("", None, None),
    ],
)
def test_signal_and_quality(
    root: Path, level: object, dbm: float | None, quality: float | None
) -> None:
    signal(root, level)
    rig = Rig(root)
    rig.look()
    assert rig.wifi.state.signal_dBm == dbm
    assert rig.wifi.state.quality == quality


def test_a_kernel_without_the_file_is_asked_by_iw_each_5_s(root: Path) -> None:
    (root / "proc/net/wireless").unlink()
    rig = Rig(root)
    rig.link = "Connected to 02:00:00:00:01:00 (on wlan0)\n\tSSID: atrium\n\tsignal: -61 dBm\n"
    asked = [second for second in range(12) if "iw dev wlan0 link" in rig.look()]
    assert asked == [0, 5, 10]
    assert rig.wifi.state == WifiState("wlan0", -61.0, 0.7, 0)
    rig.link = "Not connected.\n"
    rig.look(6.0)
    assert rig.wifi.state == WifiState("wlan0", None, None, 0)


def test_a_signal_of_long_ago_is_not_told(root: Path) -> None:
    rig = Rig(root)
    rig.look()
    rig.now_s += 11.0  # a driver hangs, no round ends
    assert rig.wifi.state == WifiState("wlan0", None, None, 0)


# The programs themselves, found in PATH and run.


class Programs:
    """A folder in PATH with scripts named `iw` and `ip`, which keep their calls."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self.log = folder, folder / "calls"
        folder.mkdir()
        patch.setenv("PATH", f"{folder}:{os.environ['PATH']}")

    def write(self, name: str, body: str = "") -> None:
        path = self.folder / name
        path.write_text(f'#!/bin/sh\nprintf "%s|" {name} "$@" >> {self.log}\necho >> {self.log}\n')
        path.write_text(path.read_text() + body)
        path.chmod(0o755)

    @property
    def calls(self) -> list[str]:
        return self.log.read_text().splitlines() if self.log.exists() else []


@pytest.fixture
def scripts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Programs:
    return Programs(tmp_path / "bin", monkeypatch)


def test_the_programs_get_their_words_one_by_one(root: Path, scripts: Programs) -> None:
    scripts.write("iw", 'test "$3" = get && echo "Power save: off"; exit 0\n')
    scripts.write("ip")
    rig = Rig(root)
    rig.run = radio.run  # type: ignore[method-assign]
    rig.look()
    rig.wifi.heard()
    rig.look(20.0)
    power_save = ["iw|dev|wlan0|set|power_save|off|", "iw|dev|wlan0|get|power_save|"]
    assert scripts.calls == [
        *power_save,
        "ip|link|set|dev|wlan0|down|",
        "ip|link|set|dev|wlan0|up|",
        *power_save,
    ]
    assert [name for name, _ in rig.events] == [RESTARTED]


def test_a_program_that_refuses_is_one_line_with_its_reason(scripts: Programs) -> None:
    scripts.write("iw", "echo 'command failed: Operation not permitted (-1)' >&2\nexit 255\n")
    with pytest.raises(ProgramError, match=r"^iw dev x link: command failed: .* \(-1\)$"):
        radio.run(["iw", "dev", "x", "link"])
    scripts.write("iw", "exit 7\n")
    with pytest.raises(ProgramError, match=r"^iw: exit status 7$"):
        radio.run(["iw"])
    with pytest.raises(ProgramError, match="no-such-program is not installed"):
        radio.run(["no-such-program", "x"])


def test_a_program_that_hangs_is_ended_with_its_children(scripts: Programs, tmp_path: Path) -> None:
    # It ignores SIGTERM, and a child of it holds the pipe open.
    scripts.write("ip", f"trap '' TERM\nsleep 1000 &\necho $! > {tmp_path / 'child'}\nwait\n")
    began = time.monotonic()
    with pytest.raises(ProgramError, match=r"^ip link: no end within 0\.5 s$"):
        radio.run(["ip", "link"], limit_s=0.5)
    assert time.monotonic() - began < LIMIT_S
    child = int((tmp_path / "child").read_text())

    def gone() -> bool:
        try:
            state = Path(f"/proc/{child}/stat").read_text()
        except OSError:
            return True
        return state.rsplit(")", 1)[1].split()[0] == "Z"

    eventually(gone)


def test_an_empty_entry_of_path_is_not_the_folder_we_stand_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trap = tmp_path / "blimp-trap"
    trap.write_text("#!/bin/sh\necho caught\n")
    trap.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "::/usr/bin")
    with pytest.raises(ProgramError, match="not installed"):
        radio.run(["blimp-trap"])


def test_step_and_heard_never_wait_for_a_program_that_hangs(root: Path) -> None:
    began, release = threading.Event(), threading.Event()
    calls: list[list[str]] = []

    def hanging(words: list[str]) -> str:
        calls.append(words)
        began.set()
        release.wait(LIMIT_S)
        return "Power save: off\n"

    rig = Rig(root)
    rig.run = hanging  # type: ignore[method-assign]
    wifi = rig.wifi
    wifi.step()
    assert began.wait(LIMIT_S)
    for _ in range(100):
        wifi.step()
        wifi.heard()
        assert wifi.state.restarts == 0
    assert len(calls) == 1, "the steps neither waited nor piled up"
    release.set()
    eventually(lambda: wifi.state.signal_dBm == -50.0)
    wifi.stop()
    assert "wifi" not in {thread.name for thread in threading.enumerate()}


def test_stopped_in_the_middle_of_a_restart_the_radio_is_switched_on(root: Path) -> None:
    down = threading.Event()
    calls: list[str] = []

    def run(words: list[str]) -> str:
        calls.append(words[-1])
        if words[-1] == "down":
            down.set()
        return "Power save: off\n"

    rig = Rig(root)
    rig.run, rig.wifi._off_s = run, 10 * LIMIT_S  # type: ignore[method-assign]
    rig.wifi.heard()
    rig.now_s += 20.0
    rig.wifi.step()
    assert down.wait(LIMIT_S)
    rig.wifi.stop()
    assert calls[calls.index("down") + 1] == "up"
    eventually(lambda: "wifi" not in {thread.name for thread in threading.enumerate()})


def test_an_announcement_that_fails_does_not_end_the_watch(root: Path) -> None:
    told: list[str] = []

    def announce(name: str, text: str) -> None:
        told.append(name)
        raise RuntimeError("no link")

    def run(words: list[str]) -> str:
        if words[0] == "iw":
            raise ValueError("not foreseen")
        return ""

    rig = Rig(root)
    rig.run, rig.announce = run, announce  # type: ignore[method-assign]
    wifi = rig.wifi
    wifi.step()
    eventually(lambda: len(told) == 1)
    wifi.step()
    eventually(lambda: not wifi._wake.is_set())
    assert told == [messages.EVENT_RADIO_FAILED]
    assert wifi._thread is not None and wifi._thread.is_alive()
    wifi.stop()


IN_A_NAMESPACE = """
import fcntl, socket, struct
from pi_firmware.health import radio

def up():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        answer = fcntl.ioctl(any_socket, 0x8913, struct.pack("16sh14x", b"lo", 0))  # SIOCGIFFLAGS
    return struct.unpack("16sh14x", answer)[1] & 1

found = [up()]
for to in ("up", "down", "up"):
    radio.switch(radio.run, "lo", to)
    found.append(up())
try:
    radio.switch(radio.run, "wlan7", "up")
except radio.ProgramError as error:
    found.append(str(error))
print(found)
"""


def test_the_real_ip_takes_our_words() -> None:
    """On the loopback interface of a network namespace of its own."""
    words = ["unshare", "--user", "--map-root-user", "--net"]
    if subprocess.run([*words, "true"], capture_output=True).returncode:
        pytest.skip("no network namespaces here")
    done = subprocess.run(
        [*words, sys.executable, "-c", IN_A_NAMESPACE], capture_output=True, text=True, timeout=60
    )
    assert done.stderr == ""
    assert done.stdout.startswith("[0, 1, 0, 1, 'ip link set dev wlan7 up: ")
    assert "wlan7" in done.stdout.split(": ", 1)[1]


def test_radio_files_are_as_linux_has_them() -> None:
    """On whatever this machine has: no more than that nothing raises."""
    assert radio.find(Path("/"), "lo") is None
    assert radio.exists(Path("/"), "lo") and not radio.is_down(Path("/"), "no-such-if")
