"""What a person types wrong gets one line that says what to do next, and status 2."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from deploy.flash.__main__ import main as flash
from deploy.update.__main__ import main as update
from ground_station.cli import main as blimp
from pi_firmware.__main__ import main as firmware

ATRIUM = Path(__file__).parents[2] / "maps/atrium"
PROGRAMS: dict[str, Callable[[], int]] = {
    "blimp": blimp, "flash": flash, "update": update, "pi": firmware,
}  # fmt: skip
CAMERA = """\
width_px = 640
height_px = 480
fx_px = 500.0
fy_px = 500.0
cx_px = 320.0
cy_px = 240.0
"""
CALIBRATE = "blimp calibrate makes a camera file"
LISTEN = '--set telemetry.listen=["{}/0.0.0.0:7447"]'
POSES = "time_s x y z qx qy qz qw"
# What is typed, and what the line must say of what to do next. hw's mistakes and those of the image
# builder are in their rooms.
MISTAKES = """
blimp locallize walk.mp4
    choose from 'simulate', 'calibrate'
blimp
    blimp --help has an example
blimp map
    blimp map --help has an example
blimp localize walk.mp4 --map atrium
    required: --out; blimp localize --help
blimp localize walk.mp4 --map atrium --out e --preset fast
    there is no 'fast' (known: default, thesis, or a .toml file)
blimp localize atrium --map walk.mp4 --out e
    blimp map build walk.mp4 --out maps/NAME
blimp localize nosuch.mp4 --map atrium --out e
    blimp localize --help has an example
blimp localize walk.mp4 --map atrium --out empty
    empty: is a folder; name a file in it
blimp localize walk.mp4 --map nosuch --out e
    blimp map build INPUT --out nosuch
blimp localize walk.mp4 --map empty --out e
    blimp map build INPUT --out empty
blimp localize walk.mp4 --map cut-map --out e
    copy the map again, or build it again
blimp localize walk.mp4 --map other-map --out e
    is not here (there are: lark, orb, rootsift, wren
blimp localize upright.mp4 --map atrium --out e
    calibrate with pictures that stand like
blimp localize wide.mp4 --map atrium --out e
    calibrate at 1280x720
blimp localize walk.mp4 --map atrium --camera nosuch --out e
    {CALIBRATE}
blimp localize walk.mp4 --map atrium --camera nan.toml --out e
    'fx_px' must be a finite number
blimp localize walk.mp4 --map atrium --camera half.toml --out e
    {CALIBRATE}
blimp localize walk.mp4 --map atrium --camera bad.toml --out e
    {CALIBRATE}
blimp localize walk.mp4 --map atrium --camera walk.mp4 --out e
    {CALIBRATE}
blimp localize walk.mp4 --map atrium --out e --range 10:5
    A:B or A:B:S with 0 <= A < B
blimp localize walk.mp4 --map atrium --out e --init walk.mp4
    {POSES}
blimp localize walk.mp4 --map atrium --out e --preset thesis
    --init TUM.txt is needed
blimp localize notes.txt --map atrium --out e
    wanted: a video, a folder of images
blimp localize empty --map atrium --out e
    no images in this folder (jpg, png
blimp localize empty.mcap --map atrium --out e
    copy it again
blimp localize notes.mcap --map atrium --out e
    blimp import makes one of a video
blimp map build notes.mcap --out m
    notes.mcap: no MCAP recording
blimp map build cut.mcap --out m
    cut.mcap: cut (the file ends before its footer); no whole frame
blimp map build upright.mp4 --camera camera.toml --out m
    use the file as the camera wrote it
blimp map build walk.mp4 --camera half.toml --out m
    {CALIBRATE}
blimp map build walk.mp4 --out m --features superpoint
    blimp models import FILE
blimp map build walk.mp4 --out m --features sift9
    known: lark, orb, rootsift, wren
blimp map build walk.mp4 --out notes.txt
    name a new one, as --out maps/NAME
blimp map build nosuch.mp4 --out m
    blimp map build --help has an example
blimp map info walk.mp4
    blimp map build walk.mp4 --out maps/NAME
blimp map view atrium --out empty
    is a folder; name a file in it
blimp map view atrium --out nosuch/v.html
    mkdir -p nosuch
blimp map export atrium
    --ply or --png is needed
blimp map register atrium
    one of --page, --picks, --pairs
blimp map register atrium --pairs nosuch.csv
    blimp map register --help
blimp map register atrium --pairs notes.txt
    needed: point,image,u_px,v_px
blimp map register atrium --trajectory late.txt
    its times are 100.000 to 102.000 s, the
blimp map register atrium --tags nosuch.toml
    needs --frames: what the map was built
blimp map extend atrium walk.mp4 --out atrium
    leave --out away to replace it
blimp map refine atrium poses.txt
    blimp localize … --observations F
blimp calibrate walk.mp4 --out c.toml
    what 'blimp calibrate board' wrote
blimp calibrate walk.mp4 --out c.toml --board nosuch.toml
    blimp calibrate board --out board.pdf
blimp calibrate walk.mp4 --out c.toml --board camera.toml
    blimp calibrate board --out board.pdf
blimp calibrate board --out b.pdf --squares 3
    expected CxR, each 3 to 40, as 10x7
blimp import walk.mp4 --out f.mcap
    required: --camera; blimp import --help
blimp import {ATRIUM}/flight.mcap --camera camera.toml --out f
    blimp replay
blimp export walk.mp4 --out f.txt
    blimp import makes one of a video
blimp export {ATRIUM}/flight.mcap --out f.txt
    blimp localize makes them
blimp evaluate poses.txt walk.mp4
    {POSES}
blimp evaluate notes.txt poses.txt
    {POSES}
blimp evaluate nan.txt poses.txt
    {POSES}
blimp evaluate empty.txt poses.txt
    {POSES}
blimp evaluate poses.txt late.txt
    truth: 100.000 to 102.000 s
blimp replay
    a RECORDING and --map are needed
blimp replay nosuch.mcap --map atrium
    nosuch.mcap: No such file
blimp replay --compare nosuch atrium
    blimp replay RECORDING --map MAP --out
blimp replay {ATRIUM}/flight.mcap --map empty
    blimp map build INPUT --out empty
blimp replay {ATRIUM}/flight.mcap --map atrium --out poses.txt/out
    poses.txt/out: Not a directory
blimp serve --config nosuch.toml --check
    blimp serve --help has an example
blimp serve --set video.prot=5 --check
    known here: host, port
blimp serve --set video.port=99999 --check
    allowed: 0 to 65535
blimp serve --map empty --check
    blimp map build INPUT --out empty
blimp serve --map walk.mp4 --check
    blimp map build walk.mp4 --out maps/NAME
blimp serve --map atrium --set http.host=0.0.0.0 --check
    needs http.token_file
blimp serve --map atrium {TCP} --check
    only loopback is allowed
blimp serve --map atrium {TLS} --set telemetry.certificates=nosuch --check
    blimp keys writes
blimp serve --demo --lan
    leave out --demo or --lan
blimp serve --lan
    blimp keys init && blimp keys ground main
blimp record --lan
    blimp keys init && blimp keys ground main
blimp record --port {UDP}
    blimp doctor says who has it
blimp record --port 70000
    'video.port' is 70000; allowed: 0 to 65535
blimp record --port 0 {ANY} --camera nosuch.toml
    {CALIBRATE}
blimp record --port 0 {ANY} --out /proc/nothing/here
    recording.folder '/proc/nothing/here': No such file or directory
blimp record --port 0 {ANY} --set video.host=192.0.2.1
    video on 192.0.2.1 port 0: Cannot assign requested address
blimp record --seconds 0
    must be more than 0
blimp command blimp-1 dance
    'record-start', 'record-stop', 'idr'
blimp command blimp-1 idr --connect tcp/127.0.0.1:1 --timeout-s 0.3
    is blimp serve running there?
blimp command Blimp! idr
    allowed are 1 to 32 of a-z
blimp models info superpoint
    blimp models import FILE
blimp simulate
    such as out/flight.mcap
blimp simulate --scene moon --out s.mcap
    there are: atrium, office
blimp experiments nosuch
    there are: pillars, descriptor
flash --device /dev/nosuch --image c.img --payload p --no-wifi
    lsblk -o NAME,SIZE,MODEL,RM
flash --device card.img --image nosuch.img --payload p --no-wifi
    make image builds one
update --payload blimp-1
    blimp keys init
pi --config nosuch.toml
    No such file or directory
pi --set camera.uri=gopro: --check
    available: libcamera:, replay:
pi --set camera.rate_hz=-1 --check
    allowed: 1 to 120 Hz
"""
ROWS = re.findall(r"^(\S.*)\n +(.*)$", MISTAKES, re.MULTILINE)


def video(path: Path, width_px: int, height_px: int) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30, (width_px, height_px))
    for _ in range(3):
        writer.write(np.zeros((height_px, width_px, 3), np.uint8))
    writer.release()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the person is: videos, maps and files, most of them not what they should be."""
    here = tmp_path_factory.mktemp("mistakes")
    for name, width_px, height_px in (
        ("walk", 640, 480),
        ("upright", 480, 640),
        ("wide", 1280, 720),
    ):
        video(here / f"{name}.mp4", width_px, height_px)
    map_files = shutil.ignore_patterns("*.mcap", "*.jpg", "map.png")
    shutil.copytree(ATRIUM, here / "atrium", ignore=map_files)
    shutil.copytree(here / "atrium", here / "cut-map")
    os.truncate(here / "cut-map/landmarks.safetensors", 1000)
    shutil.copytree(here / "atrium", here / "other-map")
    told = (here / "other-map/map.toml").read_text()
    (here / "other-map/map.toml").write_text(told.replace('name = "rootsift"', 'name = "nobodys"'))
    (here / "empty").mkdir()
    pose = "{} 0 0 0 0 0 0 1\n"
    for name, text in {
        "notes.txt": "shopping: milk\n",
        "notes.mcap": "shopping: milk\n",
        "empty.txt": "",
        "empty.mcap": "",
        "poses.txt": "".join(pose.format(t) for t in (0, 1, 2)),
        "late.txt": "".join(pose.format(t) for t in (100, 101, 102)),
        "nan.txt": "0 0 0 nan 0 0 0 1\n",
        "camera.toml": CAMERA,
        "nan.toml": CAMERA.replace("500.0", "nan", 1),
        "half.toml": "fx_px = 500.0\n",
        "bad.toml": "width_px = = 640\n",
        "c.img": "no card",
        "card.img": "",
    }.items():
        (here / name).write_text(text)
    os.truncate(here / "card.img", 8 << 20)
    with (ATRIUM / "flight.mcap").open("rb") as flight:
        (here / "cut.mcap").write_bytes(flight.read(100))
    return here


@pytest.fixture(scope="module")
def taken_port() -> Iterator[int]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        yield other.getsockname()[1]


@pytest.mark.parametrize(("typed", "advice"), ROWS, ids=[row[0][:90] for row in ROWS])
def test_a_mistake_gets_one_line_that_says_what_to_do(
    typed: str,
    advice: str,
    folder: Path,
    taken_port: int,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    places = {
        "ATRIUM": ATRIUM,
        "UDP": taken_port,
        "ANY": '--set telemetry.listen=["tcp/127.0.0.1:0"]',
        "TCP": LISTEN.format("tcp"),
        "TLS": LISTEN.format("tls"),
    }
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_DATA_HOME", str(folder / "data"))
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the test runner's own stay
    monkeypatch.setattr(sys, "argv", typed.format(**places).split())
    try:
        status: object = PROGRAMS[sys.argv[0]]()
    except SystemExit as ended:
        status = ended.code
    line = capfd.readouterr().err.strip()
    assert status == 2, line
    assert advice.format(CALIBRATE=CALIBRATE, POSES=POSES) in line
    assert "\n" not in line


def test_there_are_sixty_and_more() -> None:
    assert len({typed for typed, _ in ROWS}) == len(ROWS) >= 60


@pytest.mark.skipif(os.geteuid() != 0, reason="only root could put a file in a device's place")
def test_a_device_is_not_replaced_by_a_result(tmp_path: Path) -> None:
    from ground_station.errors import GroundStationError
    from ground_station.files import write_text

    device = tmp_path / "full"
    subprocess.run(["mknod", str(device), "c", "1", "7"], check=True)
    with pytest.raises(GroundStationError, match="a device or a pipe, not a file"):
        write_text(device, "poses")
    assert device.is_char_device()
