"""The whole card in an emulated Raspberry Pi: `make hil-image`.

Not among the tests that `make test` collects, by its name. The image is built first, or named by
BLIMP_IMAGE. Figures go to out/hil-image.json. Seeds: BLIMP_SEED (default 1) draws the moments.
"""

from __future__ import annotations

import base64
import json
import os
import random
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import emulator_card as card
import emulator_gauge as gauge
from rig import CHECKOUT, PAYLOAD, Figures, Rig, Up, program

from deploy.run import need, run
from ground_station.stream.telemetry import PayloadState
from pi_firmware.wire.messages import Health

OUT = CHECKOUT / "out"
SEED = int(os.environ.get("BLIMP_SEED", "1"))
YEAR_NS = 365 * 24 * 3600 * 10**9
KINDS = ["first boot"] * 4 + ["flying"] * 3 + ["booting"] * 3
STEADY_S = float(os.environ.get("BLIMP_STEADY_S", "60"))
VCELL_BIT_V = 78.125e-6
OF_FIRMWARE = """
for process in /proc/[0-9]*; do
  case $(tr '\\0' ' ' 2>/dev/null <$process/cmdline) in
    "/usr/bin/python3 -P -m deploy.board.start "*) WHAT ;;
  esac
done
"""
STATUS_OF_FIRMWARE = OF_FIRMWARE.replace("WHAT", "cat $process/status")
TICKS_OF_FIRMWARE = OF_FIRMWARE.replace("WHAT", "cut -d' ' -f14,15 $process/stat")
RELEASE = "PYTHONPATH=/usr/lib/blimp/release:/usr/lib/blimp/release/site"
IMPORTS = f"""\
{RELEASE} python3 -c '
import time
begun = time.monotonic()
import pi_firmware.__main__, pi_firmware.payload, zenoh
print(time.monotonic() - begun)'"""
LOOP = """python3 -c '
import time
begun = time.monotonic()
total = 0
for i in range(1_000_000):
    total += i * i
print(time.monotonic() - begun)'"""
START_LIMIT_S = float(os.environ.get("BLIMP_START_LIMIT_S", "60"))
"""What this emulation takes and more; what a board takes is to be measured on one."""
NEVER_HEALTHY = """
import time
print("this release never sends a frame", flush=True)
while True:
    time.sleep(1)
"""


@pytest.fixture(scope="module")
def figures() -> Figures:
    figures = Figures(OUT / "hil-image.json")
    cores = os.cpu_count() or 0
    figures.add("host", f"{cores} cores, load {os.getloadavg()[0]:.1f} at the start")
    figures.add("board", "QEMU 10 raspi3b (TCG, 4 cores), Debian 13 arm64, vivid 320x180 at 5 Hz")
    figures.add("seed", SEED)
    return figures


@pytest.fixture(scope="module")
def image(figures: Figures) -> Path:
    """The card image: the one named, or one built now."""
    if named := os.environ.get("BLIMP_IMAGE"):
        return Path(named)
    begun = time.monotonic()
    program("deploy.image", "--board", "qemu")
    figures.add("image_build_s", round(time.monotonic() - begun, 1))
    return OUT / "image/blimp-qemu.img"


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory, image: Path, figures: Figures) -> Iterator[Rig]:
    run(["sh", CHECKOUT / "tests/hil/image/tools.sh"], cwd=CHECKOUT)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    folder = Path(os.environ.get("BLIMP_RIG") or tmp_path_factory.mktemp("hil"))
    with Rig(folder, image, figures, port) as made:
        yield made


def assert_from_vivid(up: Up) -> None:
    """vivid's picture is eight colour bars, white to black: their brightness falls to the right."""
    luma = up.frame.image
    cv2.imwrite(str(OUT / "hil-image-frame.png"), luma)
    assert luma.shape == (180, 320)
    bars = np.median(luma[150:176], axis=0).reshape(8, 40)[:, 8:32].mean(axis=1)
    assert (np.diff(bars) < -4).all(), bars.round().tolist()


def assert_said(up: Up, rig: Rig) -> None:
    """Telemetry carries the volts that were written into the gauge."""
    battery = up.state.battery
    assert battery is not None and battery.voltage is not None
    assert abs(battery.voltage - rig.volts) <= VCELL_BIT_V
    assert battery.percentage == pytest.approx(0.625, abs=1e-4)


def ensure_up(rig: Rig) -> None:
    """Power and a stream, whatever a test before has left."""
    if not rig.machine.running:
        rig.power()
        rig.until_up()


def test_a_flashed_card_boots_into_a_streaming_payload(rig: Rig, figures: Figures) -> None:
    rig.power(volts=3.876)
    up = rig.until_up()
    figures.add("first_boot", up.times())
    assert_said(up, rig)
    assert_from_vivid(up)
    assert not gauge.was_reset(rig.gauge.read_bytes())  # the driver has set it up


def test_it_streams_at_its_rate_and_stays_small(rig: Rig, figures: Figures) -> None:
    ensure_up(rig)
    rig.frames(5)
    begun = time.monotonic()
    taken = rig.frames(40)
    rate_hz = len(taken) / (time.monotonic() - begun)
    sequences = [frame.sequence for frame in taken]
    figures.add("frames", {"rate_hz": round(rate_hz, 2), "of": taken[0].image.shape[::-1]})
    assert sequences == sorted(set(sequences))
    rig.run_until(rig.machine.age_s + STEADY_S)
    state = rig.ground.state()
    assert state is not None and state.health is not None
    now_s, stamp_s, up_s = map(
        float,
        rig.ssh("date +%s; stat -c %Y /usr/lib/clock-epoch; cut -d' ' -f1 /proc/uptime").split(),
    )
    # It has no clock: it begins at the image's own time and not in 1970.
    assert stamp_s <= now_s <= stamp_s + up_s + 60
    lines = rig.ssh(STATUS_OF_FIRMWARE).splitlines()
    kb = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith("Vm")}
    memory_mb = {name: round(int(kb[name]) / 1024, 1) for name in ("VmRSS", "VmHWM")}
    figures.add("memory_MB", {**memory_mb, "after_s": round(state.health.uptime_s)})
    assert memory_mb["VmRSS"] <= 120


def test_how_long_the_firmware_takes_to_start(rig: Rig, figures: Figures) -> None:
    """From systemd's exec to the first frame that left the encoder (READY=1), beside imports."""
    ensure_up(rig)
    starts_s = []
    for _ in range(3):
        rig.ssh("sudo systemctl restart blimp-payload", limit_s=240)
        names = ("ExecMainStartTimestampMonotonic", "ActiveEnterTimestampMonotonic")
        show = " ".join(f"-p {name}" for name in names)
        lines = rig.ssh(f"sudo systemctl show {show} blimp-payload").split()
        us = dict(line.split("=") for line in lines)
        starts_s.append((int(us[names[1]]) - int(us[names[0]])) / 1e6)
    imports_s = [float(rig.ssh(IMPORTS)) for _ in range(3)]
    loop_s = [float(rig.ssh(LOOP)) for _ in range(3)]
    figures.add("start_s", [round(s, 2) for s in starts_s])
    figures.add("imports_s", [round(s, 2) for s in imports_s])
    figures.add("loop_of_a_million_s", [round(s, 2) for s in loop_s])
    assert min(starts_s) < START_LIMIT_S


def test_what_a_frame_costs_its_processor(rig: Rig, figures: Figures) -> None:
    """The whole firmware's, as it flies, and the link's parts one by one.

    In processor seconds of this emulation. A loop of a million beside says what these are worth:
    it can be timed on any board.
    """
    ensure_up(rig)

    def used() -> tuple[float, int]:
        *ticks, a_second = map(int, rig.ssh(f"{TICKS_OF_FIRMWARE}getconf CLK_TCK").split())
        state = rig.ground.state()
        assert state is not None and state.gate is not None
        return sum(ticks) / a_second, state.gate.sequence

    begun_s, first = used()
    rig.run_until(rig.machine.age_s + STEADY_S)
    ended_s, last = used()
    figures.add("processor_s_a_frame", round((ended_s - begun_s) / (last - first), 4))
    assert last > first
    rig.ssh("sudo systemctl stop blimp-payload", limit_s=240)
    try:
        program = base64.b64encode((CHECKOUT / "tests/pi_firmware/measure_link.py").read_bytes())
        rig.ssh(f"echo {program.decode()} | base64 -d >/tmp/measure_link.py")
        told = rig.ssh(f"{RELEASE} python3 /tmp/measure_link.py --time --json", limit_s=600)
        figures.add("loop_beside_s", round(float(rig.ssh(LOOP)), 2))
    finally:
        rig.ssh("sudo systemctl start blimp-payload", limit_s=240)
    link = json.loads(told)
    figures.add("link_processor_s_a_frame", {k: round(v, 5) for k, v in link["frame"].items()})
    figures.add("link_memory_MB", {k: round(v, 1) for k, v in link["memory_MB"].items()})
    # A second and a half of history at 1 Mbit/s are 0.2 MB.
    assert link["memory_MB"]["history"] - link["memory_MB"]["bare"] < 10


def test_no_unit_has_failed(rig: Rig) -> None:
    ensure_up(rig)
    assert rig.ssh("sudo systemctl --failed --plain --no-legend").strip() == ""


def test_first_boot_has_grown_the_data_and_shredded_the_keys(rig: Rig, figures: Figures) -> None:
    ensure_up(rig)
    before = card.partition(rig.fresh, card.DATA)
    size = int(rig.ssh("df --output=size -B1 /data | tail -n 1"))
    assert size > 0.9 * (rig.fresh.stat().st_size - before.start)
    health = rig.cut()
    assert health.problems == ()
    after = card.partition(rig.card, card.DATA)
    assert after.start == before.start and after.stop > 0.98 * rig.card.stat().st_size
    key = (rig.keys / "payload" / PAYLOAD / "key.pem").read_bytes().splitlines()[1]
    assert rig.on_boot("blimp/certificates/key.pem") is None
    assert key not in boot_bytes(rig.card) and key in boot_bytes(rig.fresh)
    assert b"streaming" in (rig.on_boot("blimp/STATUS.txt") or b"")


def boot_bytes(image: Path) -> bytes:
    """The whole boot partition, what is deleted in it as well."""
    place = card.partition(image, card.BOOT)
    with image.open("rb") as file:
        file.seek(place.start)
        return file.read(place.stop - place.start)


@pytest.mark.parametrize("cycle", range(len(KINDS)))
def test_it_comes_back_from_a_power_cut(rig: Rig, figures: Figures, cycle: int) -> None:
    """Cut at a random moment; then file systems clean, and streaming again."""
    kind, draw = KINDS[cycle], random.Random(SEED * 1000 + cycle)
    usual_s = figures.values.get("first_boot", {}).get("power_to_first_frame_s", 90.0)
    if kind == "flying":
        ensure_up(rig)
        at_s = rig.machine.age_s + draw.uniform(0, 15)
    else:
        rig.machine.cut()
        if kind == "first boot":
            rig.renew()
        rig.power()
        # The kernel needs some seconds until there is anything to lose.
        at_s = draw.uniform(0.15 * usual_s, usual_s + 5)
    rig.run_until(at_s)
    said = rig.machine.tail(2)
    health = rig.cut()
    facts = {"kind": kind, "cut_at_s": round(at_s, 2), "journal_replayed": health.replayed}
    figures.append("cuts", {**facts, "problems": list(health.problems), "last_words": said})
    assert health.problems == ()
    rig.power(volts=draw.randrange(46_080, 53_760) * VCELL_BIT_V)
    up = rig.until_up()
    figures.values["cuts"][-1] |= up.times()
    figures.add("cuts", figures.values["cuts"])
    assert_said(up, rig)
    assert_from_vivid(up)


def test_recordings_that_were_cut_are_readable(rig: Rig, figures: Figures) -> None:
    """Each power cut has hit one; they are read where they lie, on a copy of the card.

    Those cut in the midst of a start may hold nothing yet; one that was cut in flight does.
    """
    from pi_firmware.wire.recording import RecordingReader

    rig.cut()
    data = rig.folder / "look" / "data.ext4"
    from deploy.image.sparse import cut_out

    cut_out(rig.card, card.partition(rig.card, card.DATA), data)
    run(["e2fsck", "-p", data], ok=(0, 1))
    into = rig.folder / "recordings"
    into.mkdir(exist_ok=True)
    run(["debugfs", "-R", f"rdump /recordings {into}", data])
    files = sorted(into.rglob("*.mcap"))
    frames = [sum(1 for _ in RecordingReader(path).video()) for path in files]
    figures.add("recordings", {path.name: count for path, count in zip(files, frames, strict=True)})
    flying = [cut for cut in figures.values.get("cuts", []) if cut["kind"] == "flying"]
    assert files and sum(count > 0 for count in frames) >= max(1, len(flying))


def test_it_boots_in_1970(rig: Rig, figures: Figures) -> None:
    """Mutual TLS and exact latencies, although systemd itself is told that it is 1970."""
    rig.machine.cut()
    rig.power(words="systemd.clock_usec=60000000")
    up = rig.until_up()
    clock = rig.machine.wait(lambda: rig.ground.telemetry.clock(PAYLOAD), 60, "clock offset")
    assert rig.ssh("date -u +%Y").strip() == "1970"
    assert_said(up, rig)
    taken = rig.frames(10)
    clock = rig.ground.telemetry.clock(PAYLOAD)
    assert clock is not None and clock.offset_ns < -50 * YEAR_NS
    late_s = [(frame.arrival_ns - clock.to_ours(frame.clock_ns)) / 1e9 for frame in taken]
    figures.add("in_1970", {**up.times(), "latency_s": [round(late, 3) for late in late_s]})
    assert all(-clock.uncertainty_ns / 1e9 <= late < 10 for late in late_s)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout of its own, to make releases of."""
    place = tmp_path_factory.mktemp("releases") / "checkout"
    run([need("git"), "clone", "-q", CHECKOUT, place])
    return place


def commit(place: Path, path: str, text: str) -> None:
    """A commit that is younger than the last."""
    (place / path).write_text(text)
    when = int(run(["git", "-C", place, "log", "-1", "--format=%ct"])) + 60
    identity = ["-c", "user.name=test", "-c", "user.email=test@localhost"]
    date = {"GIT_COMMITTER_DATE": f"{when} +0000", "GIT_AUTHOR_DATE": f"{when} +0000"}
    run(["git", "-C", place, *identity, "commit", "-qm", "Another release", "--", path], env=date)


def update(rig: Rig, place: Path) -> tuple[int, str]:
    """`python -m deploy.update` from a checkout; its status and what it said."""
    done = subprocess.run(
        [sys.executable, "-m", "deploy.update", "--payload", PAYLOAD, "--host", "127.0.0.1",
         "--port", str(rig.ssh_port), "--keys", str(rig.keys),
         "--identity", str(rig.keys / "ground/main/ssh_ed25519"), "--site", str(site())],
        cwd=place, env={**os.environ, "PYTHONPATH": str(place)}, text=True, timeout=900,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    return done.returncode, done.stdout


def site() -> Path:
    """The wheels that the image was built with: the newest ones in the builder's cache."""
    from deploy.image.packages.board import load_board
    from deploy.image.packages.wheels import fetch_wheels

    return fetch_wheels(load_board("qemu"), OUT / "cache/image")


def told(rig: Rig, words: str, condition: Callable[[Health], bool]) -> Health:
    """The payload's health in telemetry, once it meets a condition."""

    def met(state: PayloadState) -> bool:
        return state.health is not None and condition(state.health)

    state = rig.ground.telemetry.wait(PAYLOAD, met, 180)
    assert state is not None and state.health is not None, words + rig.machine.tail()
    return state.health


def test_an_update_comes_into_force(rig: Rig, figures: Figures, checkout: Path) -> None:
    rig.machine.cut()
    rig.power()
    rig.until_up()
    before = told(rig, "no health", lambda health: health.version != "")
    note = (checkout / "pi_firmware/__init__.py").read_text() + "\n# another release\n"
    commit(checkout, "pi_firmware/__init__.py", note)
    begun = time.monotonic()
    status, said = update(rig, checkout)
    figures.add("update", {"s": round(time.monotonic() - begun, 1), "said": said.splitlines()})
    assert status == 0, said + rig.machine.tail()
    after = told(rig, "no new version", lambda health: health.version != before.version)
    assert before.release == "factory" and after.release == "update"
    rig.ground.drain()
    rig.frames(5)


def test_an_update_that_never_gets_healthy_falls_back(
    rig: Rig, figures: Figures, checkout: Path
) -> None:
    ensure_up(rig)
    before = told(rig, "no health", lambda health: health.version != "")
    commit(checkout, "pi_firmware/__main__.py", NEVER_HEALTHY)
    begun = time.monotonic()
    status, said = update(rig, checkout)
    figures.add("fallback", {"s": round(time.monotonic() - begun, 1), "said": said.splitlines()})
    assert status == 1 and "no frames within" in said, said + rig.machine.tail()
    after = told(rig, "no reason", lambda health: health.release == "fell back")
    assert after.version == before.version and "no frames within" in after.release_reason
    rig.ground.drain()
    rig.frames(5)
