"""The payload follows the ground station that takes its video, and believes no other report."""

import math
import time
from types import SimpleNamespace

import pytest

from pi_firmware.capture import UnrecoverableError
from pi_firmware.ground import Ground
from pi_firmware.payload import Payload
from pi_firmware.settings import LinkSettings
from pi_firmware.wire.messages import LinkReport

SSRC = 77


class Link:
    def __init__(self) -> None:
        self.to: list[tuple[str, int]] = []

    def redirect(self, host: str, port: int) -> None:
        self.to.append((host, port))

    def report(self, report: LinkReport, now_s: float) -> float:
        return 10 * report.lost


class Capture:
    def __init__(self) -> None:
        self.reports: list[LinkReport] = []
        self.idrs = 0

    def link_report(self, report: LinkReport, corrections: float) -> None:
        assert corrections == 10 * report.lost
        self.reports.append(report)

    def force_idr(self) -> None:
        self.idrs += 1


class Telemetry:
    def __init__(self) -> None:
        self.connected = {"main": "10.0.0.5", "spare": "10.0.0.6"}

    def ground_address(self, ground: str) -> str | None:
        return self.connected.get(ground)


class Following:
    """A `Ground` among stand-ins, and a clock that is set by hand."""

    def __init__(self, host: str) -> None:
        self.now_s = 100.0
        self.heard = 0
        self.link, self.capture, self.telemetry = Link(), Capture(), Telemetry()
        self.ground = Ground(
            LinkSettings(host=host),
            SSRC,
            self.link,  # type: ignore[arg-type]
            self.capture,  # type: ignore[arg-type]
            self.telemetry,  # type: ignore[arg-type]
            on_heard=self._hear,
            clock=lambda: self.now_s,
        )

    def _hear(self) -> None:
        self.heard += 1

    def report(self, ground: str = "main", **values: object) -> None:
        report = {"video_port": 5600, "ssrc": SSRC, "lost": 0.0} | values
        self.ground.heard(LinkReport(time_ns=1, ground=ground, **report))  # type: ignore[arg-type]


def test_a_report_of_our_stream_adapts_the_encoder() -> None:
    following = Following("127.0.0.1")
    following.report(lost=0.25, round_trip_s=0.01)
    following.report(lost=0.0, queue_s=0.2)
    told = [
        (report.lost, report.round_trip_s, report.queue_s) for report in following.capture.reports
    ]
    assert told == [(0.25, 0.01, None), (0.0, None, 0.2)]
    assert following.link.to == []  # a configured address stays
    seen = following.ground.seen
    assert seen is not None and (seen.ground, seen.lost) == ("main", 0.0)
    following.now_s += 6
    assert following.ground.seen is None


@pytest.mark.parametrize(
    "values", [{"video_port": 0}, {"video_port": 65_536}, {"lost": -0.1}, {"lost": math.nan}]
)
def test_a_report_that_cannot_be_changes_nothing(values: dict[str, object]) -> None:
    following = Following("auto")
    following.report(**values)
    assert following.capture.reports == [] and following.link.to == [] and following.heard == 0


def test_a_report_of_another_stream_is_heard_but_not_believed() -> None:
    following = Following("127.0.0.1")
    following.report(ssrc=SSRC + 1, lost=0.5)
    assert following.capture.reports == [] and following.ground.seen is None
    assert following.heard == 1


def test_video_goes_to_the_first_ground_station_and_on_to_another_once_it_is_silent() -> None:
    following = Following("auto")
    following.report("unknown")
    assert following.link.to == []
    following.report("main", ssrc=None)
    following.report("spare", video_port=5700)
    assert following.link.to == [("10.0.0.5", 5600)]
    following.now_s += 2
    following.report("main", video_port=5601)
    following.now_s += 2
    following.report("spare", video_port=5700)
    assert following.link.to == [("10.0.0.5", 5600), ("10.0.0.5", 5601)]
    assert following.ground.followed == "main"
    following.now_s += 2
    following.report("spare", video_port=5700)
    assert following.link.to[-1] == ("10.0.0.6", 5700) and following.ground.followed == "spare"


def test_video_goes_on_at_once_when_the_connection_of_its_station_ends() -> None:
    following = Following("auto")
    following.report("main")
    del following.telemetry.connected["main"]
    following.report("spare", video_port=5700)
    assert following.link.to == [("10.0.0.5", 5600), ("10.0.0.6", 5700)]


def test_a_ground_that_cannot_show_frames_gets_an_idr_but_not_a_flood_of_them() -> None:
    following = Following("127.0.0.1")
    for _ in range(100):
        following.report(wants_idr=True, lost=0.5)
        following.now_s += 0.01
    assert 10 < following.capture.idrs <= 25  # no second frame in a row
    asked = following.capture.idrs
    assert following.capture.reports == []  # the bit rate follows the report of each second
    following.report(ssrc=SSRC + 1, wants_idr=True)
    assert following.capture.idrs == asked


class Looking:
    """What a payload's look for its ground station asks of the rest of it."""

    def __init__(self, *, known: bool) -> None:
        self.settings = SimpleNamespace(telemetry=SimpleNamespace(discover="wlan0"))
        self._ground = SimpleNamespace(seen=None)
        self._telemetry = SimpleNamespace(outdated=True, renew=self._renew)
        self._looks_s, self._renewed = 0.0, False
        self._known, self.renewals = known, 0

    def _renew(self) -> bool:
        self.renewals += self._known
        return self._known

    def look(self) -> None:
        Payload._look_for_ground(self)  # type: ignore[arg-type]


@pytest.mark.parametrize("known", [True, False])
def test_at_another_address_the_ground_of_before_is_tried_once_and_then_another_process(
    known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    looking = Looking(known=known)
    if known:
        looking.look()
        now[0] += 9.0
        looking.look()
        assert looking.renewals == 1
        looking._ground.seen = object()
        now[0] += 2.0
        looking.look()
        looking._ground.seen = None  # it is lost once more: that is tried again, too
        now[0] += 2.0
        looking.look()
        assert looking.renewals == 2
        now[0] += 11.0
    with pytest.raises(UnrecoverableError, match="another address"):
        looking.look()
    assert looking.renewals == 2 * known
