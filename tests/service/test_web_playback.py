"""A recording is played back as it was: over the live channel's messages, from any time on."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import web_station as station
import websockets
from tape_stand import ALARM_S, FLIGHT, OTHER, RATE_HZ, SECONDS, T0_NS, P, serving, write, x_of
from viewing import connect, next_of

from ground_station.recording.flight import FlightRecording
from ground_station.recording.frames import FrameRange
from ground_station.service.web import playback
from ground_station.service.web.playback import AT_ONCE
from ground_station.service.web.tape import Tape
from pi_firmware.wire.errors import BlimpError


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("tape") / "flight.mcap")


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("station") / "recordings"


@pytest.fixture(scope="module")
def port(shelf: Path, flight: Path) -> Iterator[int]:
    with serving(shelf.parent, flight) as port:
        yield port


def play(port: int, file: str = "flight.mcap") -> Any:
    return connect(port, f"/api/recordings/{file}/play")


async def ask(viewer: Any, kind: str, **content: Any) -> None:
    await viewer.send(json.dumps({"type": kind, **content}))


async def told(viewer: Any, holds: Any) -> Any:
    """The first state of which something holds."""
    while True:
        state = await next_of(viewer, "state")
        if holds(state):
            return state


async def test_a_flight_is_shown_as_it_was_from_its_beginning(port: int) -> None:
    async with play(port) as viewer:
        hello = await next_of(viewer, "hello", "state", "estimate")
        assert hello["type"] == "hello" and hello["payload"] == P
        assert hello["tape"]["begin_ns"] == T0_NS
        assert hello["tape"]["length_s"] == pytest.approx(SECONDS, abs=0.1)
        assert hello["state"]["station"]["map"] == "atrium"
        state = await told(viewer, lambda state: state["payloads"].get(P, {}).get("estimate"))
        assert set(state["payloads"]) <= {P, OTHER} and state["payloads"][P]["alive"]
        assert state["playback"]["playing"] and state["playback"]["rate"] == 1.0
        assert abs(state["now_ns"] - T0_NS - 1e9 * state["playback"]["at_s"]) < 1e7
        estimate = (await next_of(viewer, "estimate"))["estimate"]
        assert estimate["position_m"][0] == x_of(estimate["sequence"] / RATE_HZ)


def test_the_time_line_has_the_alarms_of_then_and_not_what_is_of_no_weight(flight: Path) -> None:
    tape = Tape(flight)
    mark = {"at_s": ALARM_S, "level": "alarm", "payload": P, "text": "LOST for 2 s: searching"}
    assert tape.marks == [mark]
    assert tape.payloads == [P, OTHER] and tape.map == "atrium"


async def test_any_time_is_sought_with_its_values_its_alarms_and_its_picture(port: int) -> None:
    played = FrameRange(0, int(SECONDS * RATE_HZ))
    frames = [frame.image for frame in FlightRecording(FLIGHT, played)]
    async with play(port) as viewer:
        await next_of(viewer, "hello")
        await ask(viewer, "play", on=False)
        for at_s in (8.5, 3.2, 12.0):
            await ask(viewer, "seek", at_s=at_s)
            hello = await told_hello(viewer, at_s)
            view = hello["state"]["payloads"][P]
            assert view["estimate"]["position_m"][0] == pytest.approx(x_of(at_s), abs=0.02)
            assert view["payload"]["battery"]["voltage"] == pytest.approx(
                4.2 - 0.01 * at_s, abs=0.01
            )
            assert view["stale"] == [] and len(view["trail"]) > 5
            picture = await next_of(viewer, "video")
            shown = cv2.imdecode(np.frombuffer(picture["jpeg"], np.uint8), 0).astype(int)
            number = int(at_s * RATE_HZ) - (int(at_s * RATE_HZ) == at_s * RATE_HZ)
            near = [frames[k] for k in range(number - 1, number + 2)]
            assert min(np.abs(shown - image).mean() for image in near) < 3.0
            state = await next_of(viewer, "state")
            names = {alarm["id"] for alarm in state["alarms"]}
            assert (f"lost/{P}" in names) == (at_s == 8.5)


async def told_hello(viewer: Any, at_s: float) -> Any:
    while True:
        hello = await next_of(viewer, "hello")
        if abs(hello["now_ns"] - T0_NS - 1e9 * at_s) < 1e8:
            return hello


async def test_it_stands_still_runs_faster_and_ends_where_it_can_be_begun_again(port: int) -> None:
    async with play(port) as viewer:
        await ask(viewer, "play", on=False)
        first = await told(viewer, lambda state: not state["playback"]["playing"])
        for _ in range(3):
            state = await next_of(viewer, "state")
            assert state["playback"]["at_s"] == first["playback"]["at_s"]
            assert state["now_ns"] == first["now_ns"]
        await ask(viewer, "rate", rate=16.0)
        await ask(viewer, "play", on=True)
        end_s = SECONDS - 1 / RATE_HZ
        await told(viewer, lambda state: state["playback"]["playing"])  # none of before
        last = await told(viewer, lambda state: not state["playback"]["playing"])
        assert last["playback"]["at_s"] == pytest.approx(end_s, abs=0.01)
        position = last["payloads"][P]["estimate"]["position_m"]
        assert position[0] == x_of(round(end_s * RATE_HZ) / RATE_HZ)
        await ask(viewer, "play", on=True)
        assert (await next_of(viewer, "hello"))["now_ns"] < T0_NS + 5e9


async def test_video_is_for_who_wants_it_and_of_whom_is_chosen(port: int) -> None:
    async with play(port) as viewer:
        assert (await next_of(viewer, "video"))["payload"] == P
        await ask(viewer, "select", payload=OTHER)
        await next_of(viewer, "selected")
        hello = await next_of(viewer, "hello")
        assert hello["payload"] == OTHER  # which has no video in this recording
        kinds = [(await next_of(viewer, "video", "state", "estimate"))["type"] for _ in range(60)]
        assert "video" not in kinds[10:] and "estimate" in kinds


async def test_video_alone_is_played_too(port: int, shelf: Path) -> None:
    """As of a payload's own card, or of the simulator."""
    write(shelf / "card.mcap", told=False)
    async with play(port, "card.mcap") as viewer:
        hello = await next_of(viewer, "hello")
        assert hello["payload"] == "recording" and hello["tape"]["marks"] == []
        assert (await next_of(viewer, "video"))["width_px"] == 640
        state = await told(viewer, lambda state: state["payloads"])
        assert state["payloads"]["recording"]["alive"]


async def test_one_that_was_cut_is_played_up_to_there(port: int, shelf: Path, flight: Path) -> None:
    data = flight.read_bytes()
    (shelf / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    async with play(port, "cut.mcap") as viewer:
        hello = await next_of(viewer, "hello")
        assert 6.5 < hello["tape"]["length_s"] < SECONDS - 2
        assert [mark["at_s"] for mark in hello["tape"]["marks"]] == [ALARM_S]
        await ask(viewer, "seek", at_s=5.0)
        found = await told_hello(viewer, 5.0)
        x = found["state"]["payloads"][P]["estimate"]["position_m"][0]
        assert x == pytest.approx(x_of(5.0), abs=0.02)


async def test_a_page_is_told_that_a_long_one_is_being_read(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would take the silence for a broken connection."""
    read = threading.Event()

    def slow(path: Path) -> Tape:
        read.wait(30.0)
        return Tape(path)

    monkeypatch.setattr(playback, "_BREATH_S", 0.05)
    monkeypatch.setattr(playback, "Tape", slow)
    async with play(port) as viewer:
        for _ in range(3):
            assert json.loads(await viewer.recv())["type"] == "reading"
        read.set()
        assert (await next_of(viewer, "hello"))["payload"] == P


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("none.mcap", None, "there is no recording"),
        ("not.mcap", b"not one", "no MCAP recording"),
        ("empty.mcap", b"\x89MCAP0\r\n", "nothing in it can be read"),
        ("..%2Fflight.mcap", None, ""),
    ],
)
async def test_what_cannot_be_played_is_said_in_one_line(
    port: int, shelf: Path, name: str, data: bytes | None, reason: str
) -> None:
    if data is not None:
        (shelf / name).write_bytes(data)
    with pytest.raises((websockets.ConnectionClosed, websockets.InvalidStatus)) as ended:
        async with play(port, name) as viewer:
            await next_of(viewer, "hello")
    closed = ended.value
    if isinstance(closed, websockets.ConnectionClosed):
        assert closed.rcvd and reason in closed.rcvd.reason
        assert len(closed.rcvd.reason.splitlines()) == 1


async def test_what_is_no_message_ends_it(port: int) -> None:
    messages: list[Any] = [
        {"type": "seek", "at_s": "1"}, {"type": "seek", "at_s": float("nan")}, {"type": "seek"},
        {"type": "rate", "rate": 0}, {"type": "rate", "rate": 1e9}, {"type": "play", "on": 1},
        {"type": "select", "payload": "nobody"}, {"type": "video", "on": None}, {}, [],
    ]  # fmt: skip
    for message in messages:
        async with play(port) as viewer:
            await viewer.send(json.dumps(message))
            with pytest.raises(websockets.ConnectionClosed) as ended:
                while True:
                    await viewer.recv()
        assert ended.value.rcvd and ended.value.rcvd.code == 1008, message


async def test_few_are_played_at_once_and_who_leaves_leaves_nothing(port: int) -> None:
    def players() -> int:
        return sum(thread.name == "playback" for thread in threading.enumerate())

    viewers = [await play(port) for _ in range(AT_ONCE)]
    for viewer in viewers:
        await next_of(viewer, "hello")
    with pytest.raises(websockets.ConnectionClosed, match="played back already"):
        async with play(port) as more:
            await more.recv()
    for viewer in viewers:
        await viewer.close()
    station.eventually(lambda: players() == 0)


def test_a_recording_that_damages_later_ends_in_words(tmp_path: Path, flight: Path) -> None:
    """Of every byte: what is read is what was written, or the tape ends."""
    data = bytearray(flight.read_bytes())
    rng = np.random.default_rng(0)
    for k in range(20):
        hurt = bytearray(data)
        for at in rng.integers(8, len(hurt), 40):
            hurt[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / f"{k}.mcap"
        path.write_bytes(hurt)
        try:
            times = [heard.log_ns for heard in Tape(path).since(0)]
        except BlimpError as error:
            assert len(str(error).splitlines()) == 1
        else:
            assert len(times) <= 3 * SECONDS * RATE_HZ + 100
