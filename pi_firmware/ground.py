"""The ground stations as the payload sees them: who takes the video, and how well it arrives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from pi_firmware.capture import Capture
from pi_firmware.link import DISCOVERED, Link
from pi_firmware.settings import LinkSettings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire.messages import LinkReport

_SILENT_S = 5.0
_FOLLOWED_SILENT_S = 3.0
"""Stations report once a second: this many are missed before another gets the video."""
IDR_GAP_S = 0.04
"""An IDR is a few frames' size: no ground station has every frame of 30 a second made one."""
_LOWEST_PORT, _HIGHEST_PORT = 1, 65_535


class Ground:
    """Takes the ground stations' reports, and sends the video where one of them is.

    With `link.host` = "auto" it goes to the first that reports, and to another only when that one
    has been silent for 3 s, or its connection has ended. Reports of other streams than ours change
    nothing else. `on_heard` is called with each report.
    """

    def __init__(
        self,
        settings: LinkSettings,
        ssrc: int,
        link: Link,
        capture: Capture,
        telemetry: Telemetry,
        on_heard: Callable[[], object] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._discovers = settings.host == DISCOVERED
        self._ssrc = ssrc
        self.link = link
        """What the video leaves by."""
        self._capture, self._telemetry = capture, telemetry
        self._on_heard = on_heard
        self._clock = clock
        self._lock = threading.Lock()
        self.followed = ""
        """The ground station that was found and gets the video; empty while there is none."""
        self._followed_s = 0.0
        self._idr_s = float("-inf")
        self._seen: tuple[float, LinkReport] | None = None

    @property
    def seen(self) -> LinkReport | None:
        """The newest report of our video; None when none came within 5 s."""
        heard_s, report = self._seen or (float("-inf"), None)
        return report if self._clock() - heard_s < _SILENT_S else None

    def heard(self, report: LinkReport) -> None:
        """Takes a report; on any thread. One that cannot be changes nothing."""
        if not (_LOWEST_PORT <= report.video_port <= _HIGHEST_PORT and 0 <= report.lost <= 1):
            return
        self._on_heard()
        now_s = self._clock()
        with self._lock:
            if self._discovers:
                self._follow(report, now_s)
            if report.ssrc != self._ssrc:
                return
            if report.wants_idr:
                wanted = now_s - self._idr_s >= IDR_GAP_S
                self._idr_s = now_s if wanted else self._idr_s
            self._seen = now_s, report
        if report.wants_idr:  # of an IDR, and not of the link
            if wanted:
                self._capture.force_idr()
            return
        self._capture.link_report(report, self.link.report(report, now_s))

    def _follow(self, report: LinkReport, now_s: float) -> None:
        if report.ground != self.followed and self.followed:
            recent = now_s - self._followed_s < _FOLLOWED_SILENT_S
            if recent and self._telemetry.ground_address(self.followed) is not None:
                return
        address = self._telemetry.ground_address(report.ground)
        if address is not None:
            self.followed, self._followed_s = report.ground, now_s
            self.link.redirect(address, report.video_port)
