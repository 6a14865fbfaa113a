"""Payloads' own programs fly to the intake's: pictures, accounts, appearing and going."""

from __future__ import annotations

import random
import socket
import statistics
from pathlib import Path

import pytest
from intake_stand import (
    ROUND,
    ImpairedLink,
    Impairment,
    Stand,
    encoded,
    eventually,
    packets,
    stamped,
)

from ground_station.service import bus_messages
from ground_station.service.bus_messages import EstimateMessage
from pi_firmware.wire import keys, messages
from pi_firmware.wire.telemetry import open_session


def all_right(stand: Stand, payload_id: str) -> list[int]:
    """The sequence numbers that were shown, each once, in order, with its own picture."""
    frames = stand.heard.of(payload_id)
    shown = [note.sequence for note, _ in frames]
    assert shown == sorted(set(shown))
    assert all(number in (note.sequence % ROUND, -1) for note, number in frames if not note.damaged)
    assert sum(number == -1 for _, number in frames) <= len(frames) // 4  # a busy machine's
    return shown


def test_two_payloads_and_garbage_on_one_port(tmp_path: Path) -> None:
    draw = random.Random(3)
    stranger = packets([stamped(unit, k) for k, unit in enumerate(encoded(30))], ssrc=4711)
    with Stand(tmp_path) as stand:
        slow = "&pace=stepped&max_hz=15"
        flying = {name: stand.payload(name, query=slow) for name in ("blimp-1", "blimp-2")}
        stand.heard.more(20, *flying)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise:
            for datagram in stranger:
                noise.sendto(datagram, ("127.0.0.1", stand.port))
                noise.sendto(draw.randbytes(draw.randint(0, 1400)), ("127.0.0.1", stand.port))
        stand.heard.more(60, *flying)
        counts = {name: payload.end().counts for name, payload in flying.items()}
        for name, ended in counts.items():
            note = stand.settled(name, ended)
            account = note.frames
            assert account["received"] == account["sent"] == len(all_right(stand, name))
            assert account["lost"] == account["withheld"] == account["dropped"] == 0
            assert note.ssrc is not None and not note.encrypted
            assert note.battery is not None and note.health is not None and note.clock is not None
            assert {"started", "stopped", "payload-appeared"} <= {*stand.heard.event_names(name)}
        # Two that fly at one rate get as much: neither starves the other.
        one, two = (len(stand.heard.of(name)) for name in flying)
        assert min(one, two) > 0.5 * max(one, two)
        captures = [note for _, note, _ in stand.heard.frames if note.capture_ns is not None]
        assert len(captures) > 20
        late_ms = [(note.arrival_ns - (note.capture_ns or 0)) / 1e6 for note in captures]
        assert -5 < statistics.median(late_ms) < 1000
        assert set(stand.heard.payloads) == {"blimp-1", "blimp-2"}  # and no stranger
        stand.process.terminate()
        assert stand.process.wait(10) == 0 and stand.written() == ""


def test_lost_packets_are_accounted_for_exactly(tmp_path: Path) -> None:
    with (
        Stand(tmp_path) as stand,
        ImpairedLink(stand.port, Impairment(loss=0.02), seed=5) as link,
    ):
        payload = stand.payload("blimp-1", "link.correction=0", port=link.port)
        stand.heard.more(150, "blimp-1")
        ended = payload.end().counts
        eventually(lambda: link.idle)
        note = stand.settled("blimp-1", ended)
        account, stream = note.frames, note.stream
        shown = all_right(stand, "blimp-1")
        assert account["received"] == len(shown) <= account["sent"]
        assert account["received"] + account["withheld"] + account["lost"] == account["sent"]
        given_up = stream["packets_late"]  # later than 30 ms on a busy machine
        assert stream["packets"] + stream["retransmissions"] == link.counts.passed
        assert given_up <= stream["packets"] // 20
        assert stream["packets_recovered"] > stream["packets_lost"] - given_up
        # A loss behind the last packet that came is one that nobody can see, and so is most of what
        # was sent again and lost again.
        missed = stream["packets_lost"] - given_up + stream["packets_recovered"]
        assert 0 <= link.counts.lost - missed <= 3 + 0.1 * link.counts.lost
        assert account["withheld"] == 0 or stream["packets_lost"] > 0


def test_a_payload_that_starts_anew_is_taken_up_and_counts_from_zero(tmp_path: Path) -> None:
    with Stand(tmp_path, payloads={"most": 1}) as stand:
        first = stand.payload("blimp-1")
        stand.heard.more(20, "blimp-1")
        first.process.kill()
        gone = eventually(
            lambda: (note := stand.heard.payload("blimp-1")) and not note.alive and note
        )
        assert gone.frames["received"] > 20
        second = stand.payload("blimp-1")
        anew = eventually(
            lambda: (
                (note := stand.heard.payload("blimp-1"))
                and note.alive
                and note.ssrc not in (None, gone.ssrc)
                and note
            )
        )
        assert anew.ssrc is not None

        def shown_anew() -> list[int]:
            return [n.sequence for n, _ in stand.heard.of("blimp-1") if n.ssrc == anew.ssrc]

        eventually(lambda: len(shown_anew()) > 20)
        note = stand.settled("blimp-1", second.end().counts)
        shown = shown_anew()
        assert note.frames["received"] == note.frames["sent"] == len(shown)
        assert shown == list(range(len(shown))) and note.frames["lost"] == 0
        names = stand.heard.event_names("blimp-1")
        assert names.count("payload-appeared") == 2 and names.count("payload-gone") >= 1
        # Its place is free for another now.
        stand.payload("blimp-2")
        stand.heard.more(5, "blimp-2")


def test_of_two_payloads_with_one_id_the_first_is_kept(tmp_path: Path) -> None:
    with Stand(tmp_path) as stand:
        stand.payload("blimp-1")
        stand.heard.more(20, "blimp-1")
        ssrc = stand.heard.of("blimp-1")[0][0].ssrc
        stand.payload("blimp-1")
        eventually(lambda: "payload-twice" in stand.heard.event_names("blimp-1"))
        stand.heard.more(60, "blimp-1")
        assert {note.ssrc for note, _ in stand.heard.of("blimp-1")} == {ssrc}
        all_right(stand, "blimp-1")


def test_hostile_telemetry_neither_ends_the_intake_nor_takes_a_place(tmp_path: Path) -> None:
    draw = random.Random(8)
    gate = messages.Gate(
        time_ns=-(2**62), capture_ns=2**62, sequence=2**31, passed=True, heartbeat=False,
        entropy_bits=1.0, sharpness=1.0, captured=-5, gated=9, heartbeats=0, sent=-7, ssrc=-1,
    )  # fmt: skip
    said = [
        b"", b"{", b"[" * 5000, b"null", b'{"schema": "blimp.gate/1.0"}', draw.randbytes(500),
        messages.encode(gate),
        messages.encode(messages.Event(time_ns=0, name="n" * 5000, text="\n" * 100_000)),
        messages.encode(messages.Event(time_ns=0, name="x", text="", values={"ssrc": 2**70})),
        messages.encode(messages.Battery(time_ns=2**70, voltage=1e300)),
    ]  # fmt: skip
    with Stand(tmp_path, recording={"at_start": True}) as stand:
        stranger = open_session(connect=[stand.endpoint])
        payload = stand.payload("blimp-1")
        stand.heard.more(10, "blimp-1")
        for number in range(80):
            for kind in (keys.GATE, keys.EVENT, keys.BATTERY, keys.HEALTH, "nothing"):
                for body in said:
                    stranger.zenoh.put(f"blimp/s{number}/{kind}", body)
                    if number % 10 == 0 and kind != keys.EVENT and b"blimp.gate" not in body:
                        stranger.zenoh.put(f"blimp/blimp-1/{kind}", body)
        stranger.zenoh.put("blimp/../gate", said[6])
        stand.heard.more(60, "blimp-1")
        stranger.close()
        ended = payload.end().counts
        note = stand.settled("blimp-1", ended)
        assert note.frames["received"] == note.frames["sent"]
        all_right(stand, "blimp-1")
        assert set(stand.heard.payloads) == {"blimp-1"}  # nobody else was seen to live
        assert stand.heard.recording[-1].problem == "" and stand.heard.recording[-1].active
        stand.process.terminate()
        assert stand.process.wait(20) == 0
        assert "Traceback" not in stand.written() and "panicked" not in stand.written()


def test_poses_reach_the_payload_and_commands_are_answered(tmp_path: Path) -> None:
    with Stand(tmp_path) as stand:
        poses: list[messages.Pose] = []
        listener = open_session(connect=[stand.endpoint])
        subscriber = listener.zenoh.declare_subscriber(
            keys.key("blimp-1", keys.POSE),
            lambda sample: poses.append(messages.decode(messages.Pose, sample.payload.to_bytes())),
        )
        stand.payload("blimp-1")
        stand.heard.more(5, "blimp-1")
        bad = EstimateMessage(sequence=1, time_ns=1, clock_ns=1, done_ns=1, state="ELATED")
        said = EstimateMessage(
            sequence=7, time_ns=70, clock_ns=71, done_ns=72, state="TRACKING",
            position_m=[1.0, 2.0, 3.0], quaternion_xyzw=[0.0, 0.0, 1.0, 0.0],
            covariance=[float(k) for k in range(36)], relocalized=True,
        )  # fmt: skip

        def told() -> bool:
            for note in (bad, said):
                stand.bus.publish(bus_messages.ESTIMATE, "blimp-1", note)
            return bool(poses)

        eventually(told)
        assert {pose.state for pose in poses} == {"TRACKING"}
        pose = poses[0]
        assert (pose.sequence, pose.capture_ns, pose.relocalized) == (7, 71, True)
        assert pose.position_m == [1.0, 2.0, 3.0]
        assert pose.quaternion_xyzw == pytest.approx([0.0, 0.0, 1.0, 0.0])
        assert pose.covariance == [float(k) for k in range(36)]
        ask = {"do": "payload-command", "payload": "blimp-1"}
        assert stand.ask(**ask, name="idr", arguments={})["done"] is True
        answer = stand.ask(**ask, name="bitrate", arguments={"kbps": 1e9})
        assert answer["done"] is False and "kbps" in answer["reason"]
        refused = (
            {**ask, "name": "explode"},
            {**ask, "name": "bitrate", "arguments": {"kbps": "much"}},
            {**ask, "name": "idr", "payload": "../etc"},
            {**ask, "name": "idr", "payload": "blimp-9"},
            {"do": "dance"},
            {},
        )
        for request in refused:
            answer = stand.ask(**request)
            assert answer["done"] is False and answer["reason"].count("\n") == 0, request
            assert answer["reason"], request
        subscriber.undeclare()
        listener.close()
