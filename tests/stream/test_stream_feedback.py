"""A payload hears once a second how its own video arrives, and nobody else's."""

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from numbered_flight import encoded, packets, stamped
from waiting import eventually

from ground_station.stream import telemetry
from ground_station.stream.arrivals import Flow
from ground_station.stream.counters import Counters
from ground_station.stream.feedback import Feedback, StreamAccount
from ground_station.stream.multi_stream import MultiStreamReceiver
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.settings import TelemetrySettings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import keys, messages
from pi_firmware.wire.clock_offset import RoundTrip
from pi_firmware.wire.telemetry import Session, open_session

LIMIT_S = 20.0


@dataclass
class Video:
    """A receiver that says what it is told."""

    port: int = 5600
    ssrc: int | None = None
    counters: Counters = field(default_factory=Counters)
    seen: Flow | None = None
    told: tuple[int | None, float | None] = (None, None)
    correction_ssrc: int | None = None

    def corrects(self, ssrc: int | None) -> None:
        self.correction_ssrc = ssrc

    def retransmits(self, rtx_ssrc: int | None, round_trip_s: float | None) -> None:
        self.told = (rtx_ssrc, round_trip_s)

    def flow(self) -> Flow | None:
        return self.seen


def test_a_late_packet_stays_lost_and_a_duplicate_counts_once() -> None:
    account = StreamAccount()
    account.add(7, Counters(), 0, 0.0)
    # Of 100 sent 10 were given up; 4 of these came late, and 5 came twice.
    came = Counters(packets=90 + 4 + 5, packets_late=4 + 5, packets_lost=10)
    tally, lost = account.add(7, came, 20, 1.0)
    assert (tally.packets, tally.lost) == (90, 10)
    assert lost == pytest.approx(0.1)


def test_what_was_mended_is_not_lost_but_was_missed() -> None:
    account = StreamAccount()
    account.add(7, Counters(), 0, 0.0)
    # Of 100 sent 15 did not come by themselves: 7 were sent again in time, 5 were found, 3 given
    # up, of which one came late.
    came = Counters(
        packets=86, packets_late=1, packets_lost=3, packets_asked=10, packets_recovered=7,
        packets_corrected=5,
    )  # fmt: skip
    tally, lost = account.add(7, came, 20, 1.0)
    assert (tally.packets, tally.recovered, tally.corrected, tally.lost) == (97, 7, 5, 3)
    assert lost == pytest.approx(0.03) and account.late.share_missed == pytest.approx(0.15)


def test_the_share_is_of_the_last_two_seconds() -> None:
    account = StreamAccount()
    shares = []
    for second in range(9):
        bad = min(second, 4)  # 50 of each second's 100 are lost, for four seconds
        counters = Counters(packets=100 * second - 50 * bad, packets_lost=50 * bad)
        tally, lost = account.add(7, counters, 30 * second, float(second))
        shares.append(lost)
        assert tally.packets + tally.lost == 100 * second
    assert shares == pytest.approx([0, 0.5, 0.5, 0.5, 0.5, 0.25, 0, 0, 0])


def test_nothing_received_is_all_lost_only_if_something_was_sent() -> None:
    account = StreamAccount()
    came = Counters(packets=500, packets_lost=3)
    account.add(7, came, 100, 0.0)
    for second in (1.0, 2.0, 3.0):
        assert account.add(7, came, 100, second)[1] == 0.0  # all of it gated
    assert account.add(7, came, 101, 4.0)[1] == 0.0  # one: its packets may be on their way
    assert account.add(7, came, 131, 5.0)[1] == 1.0
    assert account.add(7, came, 5, 6.0)[1] == 0.0  # the payload counts again


def test_a_new_stream_and_a_new_receiver_count_from_zero() -> None:
    account = StreamAccount()
    account.add(7, Counters(packets=80, packets_lost=20), 10, 0.0)
    tally, lost = account.add(8, Counters(packets=100), 10, 1.0)
    assert (tally.packets, tally.lost, lost) == (100, 0, 0.0)
    tally, lost = account.add(8, Counters(packets=9, packets_lost=1), 10, 2.0)
    assert (tally.packets, tally.lost) == (9, 1) and lost == pytest.approx(0.1)


@pytest.fixture
def listener() -> Iterator[TelemetryListener]:
    with TelemetryListener(["tcp/127.0.0.1:0"]) as opened:
        yield opened


class Ear:
    """A payload with its telemetry, and what it is told of its link."""

    def __init__(self, listener: TelemetryListener, payload_id: str) -> None:
        self.telemetry = Telemetry(payload_id, TelemetrySettings(connect=list(listener.endpoints)))
        self.session: Session = open_session(connect=listener.endpoints)
        self.reports: list[messages.LinkReport] = []
        self._heard = threading.Condition()
        self._subscriber = self.session.zenoh.declare_subscriber(
            keys.key(payload_id, keys.LINK), self._take
        )

    def _take(self, sample: Any) -> None:
        with self._heard:
            report = messages.decode(messages.LinkReport, sample.payload.to_bytes())
            self.reports.append(report)
            self._heard.notify_all()

    def wait(self, condition: Any) -> messages.LinkReport | None:
        with self._heard:
            self._heard.wait_for(lambda: any(map(condition, self.reports)), LIMIT_S)
            return next(filter(condition, self.reports), None)

    def close(self) -> None:
        self.telemetry.close()
        self.session.close()


def gate(sent: int, ssrc: int) -> messages.Gate:
    return messages.Gate(
        time_ns=sent, capture_ns=sent, sequence=sent, passed=True, heartbeat=False,
        entropy_bits=7.0, sharpness=1.0, captured=sent, gated=0, heartbeats=0, sent=sent, ssrc=ssrc,
    )  # fmt: skip


def test_each_living_payload_hears_of_its_own_stream(listener: TelemetryListener) -> None:
    ears = {name: Ear(listener, name) for name in ("one", "two", "elsewhere")}
    videos = {
        "one": Video(5601, 11, Counters(packets=97, packets_lost=3)),
        "two": Video(5602, 99, Counters(packets=50)),  # a stream that is not the one of `two`
    }
    for name, ssrc in (("one", 11), ("two", 22), ("elsewhere", 33)):
        ears[name].telemetry.publish(gate(10, ssrc))
        assert listener.wait(name, lambda s: s.alive and s.ssrc is not None, LIMIT_S)
    with Feedback(listener, videos.get, period_s=0.05):
        one = ears["one"].wait(lambda r: r.round_trip_s is not None)
        two = ears["two"].wait(lambda r: True)
        assert one is not None and two is not None
        assert (one.ground, one.video_port, one.ssrc) == (listener.name, 5601, 11)
        assert (one.packets, one.packets_lost) == (97, 3)
        assert ears["one"].reports[0].lost in (0.0, pytest.approx(0.03))
        assert one.round_trip_s is not None and 0 <= one.round_trip_s < LIMIT_S
        assert abs(one.time_ns - time.time_ns()) < 60 * 10**9
        assert (two.video_port, two.ssrc, two.packets, two.lost) == (5602, None, 0, 0.0)
        ears["two"].telemetry.publish(gate(11, 99))
        assert ears["two"].wait(lambda r: r.ssrc == 99 and r.packets == 50)
    assert ears["elsewhere"].reports == []
    for ear in ears.values():
        ear.close()


def test_a_stream_hears_what_its_payload_mends_it_with_and_reports_what_that_recovered(
    listener: TelemetryListener,
) -> None:
    ear = Ear(listener, "one")
    counters = Counters(
        packets=92, packets_lost=1, packets_recovered=4, packets_corrected=3, retransmissions=6
    )
    video = Video(5601, 11, counters, Flow(900.0, 0.0, 0.05, 40.0, 1.5))
    ear.telemetry.publish(gate(10, 11))
    assert listener.wait("one", lambda s: s.alive and s.ssrc is not None, LIMIT_S)
    with Feedback(listener, lambda _: video, period_s=0.05):
        told = ear.wait(lambda report: report.packets_recovered == 4)
        assert told is not None and told.missed is not None
        assert (told.packets, told.packets_lost, told.retransmitted_kbps) == (99, 1, 40.0)
        assert told.corrects and (told.packets_corrected, told.answered, told.burst) == (3, 6, 1.5)
        # An older payload says nothing of it.
        assert video.told[0] is None and video.correction_ssrc is None
        ear.telemetry.publish(messages.Health(1, 1.0, rtx_ssrc=4711, correction_ssrc=4712))
        eventually(lambda: video.told[0] == 4711 and video.correction_ssrc == 4712)
        eventually(lambda: video.told[1] is not None)
        video.ssrc = 12  # a stream that is not the payload's own
        video.told = (None, None)
        time.sleep(0.2)
        assert video.told == (None, None)
    ear.close()


def test_a_payload_that_has_ended_hears_no_more(listener: TelemetryListener) -> None:
    ear = Ear(listener, "one")
    with Feedback(listener, lambda _: Video(), period_s=0.05):
        assert ear.wait(lambda r: r.ssrc is None)
        ear.telemetry.close()
        assert listener.wait("one", lambda s: not s.alive, LIMIT_S)
        time.sleep(0.2)  # one that is on its way may still come
        told = len(ear.reports)
        time.sleep(0.3)
        assert len(ear.reports) == told
    ear.close()


def test_the_newest_round_trip_is_told_and_not_the_shortest(
    listener: TelemetryListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A link that gets slow is told slow although the clock's offset stays the tight one."""
    delays_ns = [2_000_000, 700_000_000, 300_000_000]
    now_ns = [10**18]
    told: list[float | None] = []
    asked_enough = threading.Event()

    def ask(session: Any, key: str, now: Any) -> RoundTrip | None:
        if told or follower_made.wait(LIMIT_S):
            told.append(follower.round_trip_s("one"))
        if len(told) > len(delays_ns) + 1:
            asked_enough.set()
        if len(told) > len(delays_ns):
            return None  # and at once: nobody serves it
        sent_ns, delay_ns = now_ns[0], delays_ns[len(told) - 1]
        now_ns[0] += delay_ns
        return RoundTrip(sent_ns, sent_ns + delay_ns // 2, sent_ns + delay_ns // 2, now_ns[0])

    monkeypatch.setattr(telemetry, "ask", ask)
    monkeypatch.setattr(telemetry, "_PERIOD_S", 0.01)
    follower_made = threading.Event()
    follower = telemetry.ClockFollower(listener.session.zenoh, lambda: ["one"], lambda: now_ns[0])
    follower_made.set()
    assert asked_enough.wait(LIMIT_S)
    follower.close()
    assert told[:5] == [None, 0.002, 0.7, 0.3, None]
    offset = follower.offset("one")
    assert offset is not None and offset.uncertainty_ns < 10_000_000


def test_a_question_without_an_answer_took_at_least_so_long(
    listener: TelemetryListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ask(session: Any, key: str, now: Any) -> None:
        time.sleep(telemetry.ASK_TIMEOUT_S)

    monkeypatch.setattr(telemetry, "ASK_TIMEOUT_S", 0.05)
    monkeypatch.setattr(telemetry, "ask", ask)
    follower = telemetry.ClockFollower(listener.session.zenoh, lambda: ["one"], time.time_ns)
    assert eventually(lambda: follower.round_trip_s("one")) >= 0.05
    follower.close()


def test_frames_that_cannot_be_shown_ask_for_an_idr_at_once(listener: TelemetryListener) -> None:
    ear = Ear(listener, "one")
    video = Video(ssrc=5, counters=Counters(packets=10))
    with Feedback(listener, lambda _: video, period_s=1000.0):
        assert listener.wait("one", lambda state: state.alive, LIMIT_S)
        time.sleep(0.2)
        assert ear.reports == []
        video.counters = Counters(packets=20, packets_lost=1, withheld=1)
        asked = ear.wait(lambda report: report.wants_idr)
        assert asked is not None and asked.ssrc == 5
        time.sleep(0.3)
        assert len(ear.reports) == 1  # nothing more was withheld since
        video.counters = Counters(packets=21, packets_lost=1, withheld=1, damaged=1)
        eventually(lambda: len(ear.reports) == 2)
        for withheld in range(2, 60):
            video.counters = Counters(packets=20 + withheld, packets_lost=1, withheld=withheld)
            time.sleep(0.01)
        time.sleep(0.2)
        assert 3 <= len(ear.reports) <= 12  # ten a second at most
    ear.close()


@pytest.mark.parametrize(("gap_s", "asked"), [(0.1, [1, 7]), (0.0, [1, 2, 3, 4, 6, 7, 8, 9, 10])])
def test_once_an_idr_has_come_the_next_is_asked_for_as_soon_as_its_payload_takes_it(
    listener: TelemetryListener, gap_s: float, asked: list[int]
) -> None:
    ear = Ear(listener, "one")
    ear.telemetry.publish(messages.Health(1, 1.0, idr_gap_s=gap_s))
    assert listener.wait("one", lambda state: state.health is not None, LIMIT_S)
    video = Video(ssrc=5, counters=Counters(packets=10))
    feedback = Feedback(listener, lambda _: video, period_s=1000.0)
    feedback.close()  # the clock is ours
    wishes = []
    for step in range(11):  # a frame is lost each 20 ms; the fourth IDR comes a step late
        video.counters = Counters(packets=20, withheld=1 + step, idrs=step - (step > 4))
        if feedback._wants_idr("one", video, 10 + 0.02 * step):
            wishes.append(step)
    assert wishes == asked
    ear.close()


def test_an_idr_is_asked_for_when_mending_failed_and_not_before(
    listener: TelemetryListener,
) -> None:
    ear = Ear(listener, "one")
    datagrams = packets([stamped(unit, n) for n, unit in enumerate(encoded(12))], ssrc=5)
    shown: list[int] = []
    with (
        MultiStreamReceiver(
            0, owner=lambda *_: "one", on_frame=lambda _, frame: shown.append(frame.sequence)
        ) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        Feedback(listener, receiver.stream_of, period_s=0.05),
    ):
        ear.telemetry.publish(gate(10, 5))
        ear.telemetry.publish(messages.Health(1, 1.0, rtx_ssrc=99))
        whole = len(packets([stamped(encoded(12)[0], 0)]))
        for number, datagram in enumerate(datagrams[: whole + 2]):
            sender.sendto(datagram, ("127.0.0.1", receiver.port))
            assert number == 0 or eventually(lambda: receiver.streams())
        eventually(lambda: (stream := receiver.stream_of("one")) and stream.rtx_ssrc == 99)
        missed_s = time.monotonic()
        for datagram in datagrams[whole + 3 :]:
            sender.sendto(datagram, ("127.0.0.1", receiver.port))
        asked = ear.wait(lambda report: report.wants_idr)
        waited_s = time.monotonic() - missed_s
        stream = receiver.stream_of("one")
        assert asked is not None and waited_s > 0.1 and stream is not None
        # All of it was withheld at once, when the one packet was given up.
        assert stream.counters.packets_asked == stream.counters.packets_lost == 1
        eventually(lambda: len(shown) + stream.counters.withheld == 12)
        assert stream.counters.withheld >= 10
        assert sum(report.wants_idr for report in ear.reports) == 1
    ear.close()


def test_a_queue_is_told_at_once_to_who_takes_it_and_once_a_second_to_who_does_not(
    listener: TelemetryListener,
) -> None:
    """An older payload takes each report for a second's, and would adapt five times as much."""
    ears = {name: Ear(listener, name) for name in ("newer", "older")}
    videos = {name: Video(ssrc=5, seen=Flow(900.0, 0.01, 0.0)) for name in ears}
    for name, ear in ears.items():
        ear.telemetry.publish(messages.Health(1, 1.0, early_reports=name == "newer"))
        assert listener.wait(name, lambda s: s.alive and s.health is not None, LIMIT_S)
    with Feedback(listener, videos.get, period_s=1000.0):
        time.sleep(0.3)
        assert not ears["newer"].reports and not ears["older"].reports
        for video in videos.values():
            video.seen = Flow(800.0, 0.25, 0.125)
        told = ears["newer"].wait(lambda r: r.queue_s == 0.25)
        assert told is not None
        assert (told.received_kbps, told.queue_s, told.dropped) == (800.0, 0.25, 0.125)
        began_s, before = time.monotonic(), len(ears["newer"].reports)
        ears["newer"].wait(lambda r: len(ears["newer"].reports) >= before + 3)
        assert time.monotonic() - began_s > 0.45
        videos["newer"].seen = Flow(850.0, 0.0, 0.0)
        assert ears["newer"].wait(lambda r: r.queue_s == 0.0)  # and once that it is over
        time.sleep(0.3)
        over = [report for report in ears["newer"].reports if report.queue_s == 0.0]
        assert len(over) == 1 and not ears["older"].reports
    for ear in ears.values():
        ear.close()
