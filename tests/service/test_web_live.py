"""The live channel: rates, pictures encoded once, and viewers that cannot harm each other."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import time
from collections import Counter

import cv2
import httpx
import numpy as np
import pytest
import web_station as station
import websockets
from viewing import connect, next_of

from ground_station.service import bus_messages
from ground_station.service.web import viewer as viewer_module
from ground_station.service.web.app import build
from ground_station.service.web.video import Video
from ground_station.service.web.viewer import SLOTS, TEXTS, Outbox

P = station.PAYLOAD


@pytest.fixture
def served(tmp_path):
    """The application behind the real server, on a thread; its bus is the test's."""
    bus = station.SilentBus()
    web = build(station.run_of(tmp_path, viewers=3, video_rate_hz=20.0), tmp_path, bus, None)
    with station.serving(web) as port:
        station.say_all(bus.put)
        yield web, bus, port


async def test_a_viewer_is_greeted_with_everything_and_then_told_what_changes(served):
    _, bus, port = served
    async with connect(port) as viewer:
        hello = await next_of(viewer, "hello", "state", "estimate")
        assert hello["type"] == "hello" and hello["payload"] == P
        assert hello["state"]["payloads"][P]["trail"]
        state = await next_of(viewer, "state")
        assert state["payloads"][P]["estimate"]["points_px"] == []
        bus.put(bus_messages.ESTIMATE, P, station.estimate(77))
        assert (await next_of(viewer, "estimate"))["estimate"]["points_px"]
        bus.put(bus_messages.EVENT, P, station.event(text="now"))
        event = (await next_of(viewer, "event"))["event"]
        assert (event["text"], event["payload"]) == ("now", P)
        bus.put(bus_messages.RECORDING, "-", station.recording(problem="disk", active=True))
        assert (await next_of(viewer, "recording"))["recording"]["problem"] == "disk"
        alarm = await next_of(viewer, "alarm")
        assert alarm["active"] and alarm["alarm"]["id"] == "recording"
        bus.put(bus_messages.RECORDING, "-", station.recording())
        while (alarm := await next_of(viewer, "alarm"))["alarm"]["id"] != "recording":
            pass
        assert not alarm["active"]


async def test_a_note_of_other_types_ends_nothing(served, capfd):
    web, bus, port = served
    bus.put(bus_messages.ESTIMATE, P, station.estimate(points_px=None, stage_ms=[], done_ns="x"))
    bus.put(bus_messages.EVENT, P, station.event(text=None, level=7))
    bus.put(bus_messages.PAYLOAD, P, station.payload(battery=[], health="x", frames=None))
    web.snapshot.set_alarms([])
    web.snapshot._payloads[P].came_ns["frame"] = "what nobody checks"
    async with connect(port) as viewer:
        with pytest.raises((TimeoutError, websockets.ConnectionClosed)):
            await next_of(viewer, "hello", limit_s=0.6)
        web.snapshot._payloads[P].came_ns["frame"] = 0
    async with connect(port) as viewer:
        await next_of(viewer, "state")


async def test_a_payload_that_goes_is_told(served):
    _, bus, port = served
    async with connect(port) as viewer:
        await next_of(viewer, "state")
        bus.put(bus_messages.PAYLOAD, P, station.payload(alive=False))
        assert (await next_of(viewer, "gone"))["payload"] == P


async def test_estimates_are_bounded_in_rate_and_those_of_others_come_seldom(served):
    _, bus, port = served
    bus.put(bus_messages.PAYLOAD, "blimp-2", station.payload())
    counted: Counter[str] = Counter()
    async with connect(port, f"/api/live?payload={P}") as viewer:
        await next_of(viewer, "hello")
        begin_s = time.monotonic()
        while time.monotonic() - begin_s < 1.0:
            for name in (P, "blimp-2"):  # a hundred times a second, or as often as can be
                bus.put(bus_messages.ESTIMATE, name, station.estimate())
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.01):
                    found = await next_of(viewer, "estimate")
                    counted[found["payload"]] += 1
                    assert bool(found["estimate"]["points_px"]) == (found["payload"] == P)
        span_s = time.monotonic() - begin_s
        assert 0 < counted[P] <= 31 * span_s + 3
        assert 0 < counted["blimp-2"] <= 5 * span_s + 3


async def test_pictures_are_the_frames_and_come_only_to_who_looks(served, tmp_path):
    web, bus, port = served
    ring = station.ring(tmp_path)
    image = cv2.GaussianBlur(station.texture(), (0, 0), 3)
    async with connect(port) as viewer, connect(port) as blind:
        await blind.send(json.dumps({"type": "video", "on": False}))
        await blind.send(json.dumps({"type": "ping", "sent_ms": 5}))
        pong = await next_of(blind, "pong")
        assert pong["sent_ms"] == 5 and pong["now_ns"] > 1e18
        await next_of(viewer, "hello")
        for sequence in range(5):
            slot, stamp = ring.write(image)
            note = station.frame(slot, stamp, sequence)
            bus.put(bus_messages.FRAME, P, note)
            found = await next_of(viewer, "video")
            assert (found["sequence"], found["payload"]) == (sequence, P)
            assert found["capture_ns"] == note.capture_ns
            shown = cv2.imdecode(np.frombuffer(found["jpeg"], np.uint8), cv2.IMREAD_UNCHANGED)
            assert shown.shape == image.shape
            assert np.abs(shown.astype(int) - image).mean() < 4
            await asyncio.sleep(0.08)
        assert web.video.encoded == 5
        with pytest.raises(TimeoutError):
            await next_of(blind, "video", limit_s=0.5)
    station.eventually(lambda: not web.video._wanted)  # nobody looks: nothing is encoded
    bus.put(bus_messages.FRAME, P, station.frame())
    assert web.video.encoded == 5


async def test_what_was_shown_is_measured(served):
    web, _, port = served
    async with connect(port) as viewer:
        await next_of(viewer, "hello")
        for shown_ms in (80, -5, 1e9, 90.5):  # two of which cannot be
            report = {"type": "shown", "sequence": 3, "shown_ms": shown_ms}
            await viewer.send(json.dumps(report))
        await viewer.send(json.dumps({"type": "of a newer page", "x": 1}))
        await viewer.send(json.dumps({"type": "ping"}))
        await next_of(viewer, "pong")
    name = "blimp_capture_to_screen_seconds"
    value = web.metrics.registry.get_sample_value
    assert value(f"{name}_count", {"payload": P}) == 2
    assert value(f"{name}_sum", {"payload": P}) == pytest.approx(0.1705)


async def test_another_payload_is_chosen(served):
    _, bus, port = served
    bus.put(bus_messages.PAYLOAD, "blimp-2", station.payload())
    async with connect(port, "/api/live?payload=no-such") as viewer:
        assert (await next_of(viewer, "hello"))["payload"] == P
        for asked, chosen in (("blimp-2", "blimp-2"), ("no-such", "blimp-2"), (P, P)):
            await viewer.send(json.dumps({"type": "select", "payload": asked}))
            assert (await next_of(viewer, "selected"))["payload"] == chosen


async def test_who_speaks_otherwise_is_closed(served):
    _, _, port = served
    for message in (
        "no json", "[]", "{}", '{"type": 5}', "[" * 2000, '{"type":"select"}', b"bytes",
        '{"type":"select","payload":"' + "x" * 40 + '"}', '{"type":"video","on":1}',
        '{"type":"shown","shown_ms":NaN}', '{"type":"shown","shown_ms":1' + "0" * 400 + "}",
        '{"type":"ping","sent_ms":true}', '{"type":"ping","x":"' + "x" * 4000 + '"}',
        "x" * 100_000,
    ):  # fmt: skip
        async with connect(port) as viewer:
            await viewer.send(message)
            with pytest.raises(websockets.ConnectionClosed) as closed:
                await next_of(viewer, "pong")
        code = closed.value.rcvd.code if closed.value.rcvd else None
        assert code == (1009 if len(message) > 50_000 else 1008), message


async def test_a_flood_of_messages_is_closed(served):
    web, _, port = served
    async with connect(port) as viewer:
        with pytest.raises(websockets.ConnectionClosed):
            while True:
                await viewer.send('{"type":"video","on":true}')
        # Whoever goes on sending may not get to read why.
        assert viewer.close_code in (1008, 1006)
    assert web.live.viewers == 0


async def test_viewers_are_bounded_and_a_place_is_free_again(served):
    _, _, port = served
    async with contextlib.AsyncExitStack() as stack:
        for _ in range(3):
            viewer = await stack.enter_async_context(connect(port))
            await next_of(viewer, "hello")
        async with connect(port) as late:
            with pytest.raises(websockets.ConnectionClosed):
                await next_of(late, "hello")
            assert late.close_code == 1013
    async with asyncio.timeout(20.0):
        while True:
            async with connect(port) as again:
                with contextlib.suppress(websockets.ConnectionClosed):
                    await next_of(again, "hello")
                    return
            await asyncio.sleep(0.05)


def stopped_viewer(port) -> socket.socket:
    """A viewer that shakes hands and then reads nothing, ever."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.connect(("127.0.0.1", port))
    sock.sendall(
        f"GET /api/live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
    )
    return sock


async def test_a_viewer_that_takes_nothing_harms_nobody_and_is_closed(served, monkeypatch):
    web, _, port = served
    monkeypatch.setattr(viewer_module, "TAKES_NOTHING_S", 2.0)
    stopped = stopped_viewer(port)
    station.eventually(lambda: web.live.viewers == 1)
    loop = web.loop()
    picture = b"\0\0\0\2{}" + b"x" * 1_000_000
    received: list[float] = []
    async with connect(port) as viewer:
        await next_of(viewer, "hello")
        assert web.live.viewers == 2
        begin_s = time.monotonic()
        while web.live.viewers == 2 and time.monotonic() - begin_s < 30:
            loop.call_soon_threadsafe(web.live.picture, P, picture)
            message = await viewer.recv()
            while not isinstance(message, bytes):
                message = await viewer.recv()
            received.append(time.monotonic())
            await asyncio.sleep(0.02)
    assert len(received) > 20
    assert max(np.diff(received)) < 1.9  # the other one saw its pictures all the while
    station.eventually(lambda: web.live.viewers == 0)
    assert "blimp_viewer_pictures_lost_total 0.0" not in web.metrics.text().decode()
    # The connection is gone, not only its place, though what was sent still lies unread.
    station.eventually(lambda: _was_reset(stopped))
    stopped.close()


def _was_reset(sock) -> bool:
    try:
        sock.sendall(b"\x8a\x80\0\0\0\0")  # a pong that nobody asked for
    except (ConnectionResetError, BrokenPipeError):
        return True
    return False


async def test_an_outbox_is_bounded_and_keeps_the_newest():
    outbox = Outbox()
    for number in range(10_000):
        outbox.queue(f"text {number}")
        outbox.replace(f"slot {number}", str(number))
        outbox.replace("slot 3", f"newest {number}")
        outbox.show(bytes([number % 256]))
    taken = [await outbox.take() for _ in range(TEXTS + SLOTS + 1)]
    assert taken[0] == f"text {10_000 - TEXTS}" and taken[TEXTS - 1] == "text 9999"
    assert "newest 9999" in taken and taken[-1] == bytes([9999 % 256])
    assert outbox.pictures_lost == 9999
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.05):
            await outbox.take()


def test_encoding_keeps_the_rate_and_skips_the_rest(tmp_path):
    ring, taken = station.ring(tmp_path), []
    video = Video(tmp_path, 10.0, 80, lambda name, message: taken.append((name, message)))
    try:
        video.want(frozenset({P}))
        begin_s = time.monotonic()
        count = 0
        while time.monotonic() - begin_s < 1.0:
            slot, stamp = ring.write(station.texture())
            video.frame(P, station.frame(slot, stamp, count))
            video.frame("other", station.frame(slot, stamp, count))
            count += 1
            time.sleep(0.004)
        span_s = time.monotonic() - begin_s
        station.eventually(lambda: video.encoded + video.skipped + video.gone == count)
        assert 0 < len(taken) <= 10 * span_s + 2
        assert {name for name, _ in taken} == {P}
    finally:
        video.close()


def test_a_picture_that_is_gone_or_cannot_be_read_ends_nothing(tmp_path):
    taken = []
    video = Video(tmp_path, 60.0, 80, lambda name, message: taken.append(message))
    try:
        video.want(frozenset({P}))
        video.frame(P, station.frame())  # there is no ring yet
        station.eventually(lambda: video.gone == 1)
        ring = station.ring(tmp_path)
        slot, stamp = ring.write(station.texture())
        time.sleep(0.05)
        video.frame(P, station.frame("slot", stamp))
        station.eventually(lambda: video.failed == 1)
        time.sleep(0.05)
        video.frame(P, station.frame(slot, stamp))
        station.eventually(lambda: taken)
    finally:
        video.close()


def test_a_connection_that_asks_nothing_is_closed(served, monkeypatch):
    _, _, port = served
    from ground_station.service.web import server as server_module

    monkeypatch.setattr(server_module, "_REQUEST_S", 0.3)
    for begun in (b"", b"GET /api/state HTTP/1.1\r\nHost: 127.0.0.1\r\n"):
        with socket.create_connection(("127.0.0.1", port), timeout=20.0) as sock:
            sock.sendall(begun)
            with contextlib.suppress(ConnectionResetError):
                assert sock.recv(100) == b""
    assert httpx.get(f"http://127.0.0.1:{port}/healthz").status_code == 200


def test_who_stops_in_the_middle_of_a_later_request_is_closed_too(served, monkeypatch):
    _, _, port = served
    from ground_station.service.web import server as server_module

    monkeypatch.setattr(server_module, "_REQUEST_S", 0.5)
    with socket.create_connection(("127.0.0.1", port), timeout=20.0) as sock:
        request = f"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n".encode()
        sock.sendall(request + b"\r\n")
        assert sock.recv(4096).startswith(b"HTTP/1.1 200")
        sock.sendall(request)  # and not the empty line
        with contextlib.suppress(ConnectionResetError):
            while sock.recv(4096):
                pass


def test_a_body_that_does_not_come_is_refused_in_time(served, monkeypatch):
    _, _, port = served
    from ground_station.service.web import guard

    monkeypatch.setattr(guard, "_BODY_S", 0.3)
    with socket.create_connection(("127.0.0.1", port), timeout=20.0) as sock:
        sock.sendall(
            f"POST /api/recording HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n"
            'Content-Type: application/json\r\nContent-Length: 16\r\n\r\n{"active"'.encode()
        )
        assert sock.recv(4096).startswith(b"HTTP/1.1 408")


def test_connections_are_bounded(served, monkeypatch):
    _, _, port = served
    from ground_station.service.web import server as server_module

    monkeypatch.setattr(server_module, "CONNECTIONS", 8)
    with contextlib.ExitStack() as stack:
        held = [
            stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=20.0))
            for _ in range(8)
        ]
        late = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=20.0))
        with contextlib.suppress(ConnectionResetError):
            assert late.recv(1) == b""
        assert len(held) == 8
    station.eventually(lambda: _answers(port))


def _answers(port) -> bool:
    with contextlib.suppress(httpx.HTTPError):
        return httpx.get(f"http://127.0.0.1:{port}/healthz").status_code == 200
    return False
