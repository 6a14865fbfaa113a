"""One flight under a fault: payload, impaired link and ground, and the account at its end.

    with Ground() as ground, Flight(tmp_path, ground, recording) as flight:
        flight.wait_streaming()
        flight.link.gone(10)
        ...
        flight.wait_streaming()       # fresh frames within 5 s of the fault's end
        flight.finish().assert_exact()

A new family of faults brings its fault and nothing else: a shim goes into `env`, a namespace or
another starter into `prefix`, a folder on a full disk or a camera that goes into `settings`.
Pictures are those of a recording whose frames carry their numbers, again and again, so that a wrong
one is seen whatever its stamp says; `camera` takes any other URI, unnumbered. A flight whose frames
the payload had to discard says so in its counters, and the account holds with them.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ground import Gallery, Ground, GroundProcess, Seen
from impaired_link import CLEAN, ImpairedLink, Impairment, LinkCounts
from payload_process import LIMIT_S, Ended, PayloadProcess
from witness import Left, Witness

from ground_station.stream.counters import Counters
from pi_firmware.wire import messages

ROUND = 60
"""Frames of the recording that is flown in a loop."""
FRESH_S = 5.0
"""The issue's promise: streaming again this long after a fault's end."""
LONGEST_GOP = 15
_QUIET_S = 0.3  # longer than the receiver waits for a missing packet
SMALL_FRAMES = ("encoder.gop_frames=3", "encoder.bitrate_kbps=400")
"""Few packets a frame, so that some are whole at 20 % loss."""


@dataclass(frozen=True)
class Account:
    """What each party says of a flight that has ended, and the checks of one against the others."""

    ended: Ended
    left: list[Left]
    visible: list[int]
    seen: list[Seen]
    link: LinkCounts
    witness: Witness
    received: Counters | None
    said: dict[str, int]
    numbered: bool

    def assert_in_order(self) -> None:
        """Ended by itself as asked, every captured frame accounted for, no wrong picture."""
        self.ended.assert_in_order()
        counts = self.ended.counts
        assert counts, f"no counters: {self.ended.out}"
        kept = counts["captured"] - counts["gated"]
        assert kept == counts["sent"] + counts["discarded"], counts
        for name, value in self.said.items():
            assert counts[name] == value, (name, counts, self.said)
        self.assert_pictures()

    def assert_pictures(self) -> None:
        """What was shown as whole had left the payload undamaged, and all was shown once, right."""
        shown = [frame.sequence for frame in self.seen]
        assert len(set(shown)) == len(shown)
        whole = {frame.sequence: frame.number for frame in self.seen if not frame.damaged}
        assert not set(whole) - set(self.witness.showable())
        assert not set(shown) - {frame.sequence for frame in self.left}
        if self.numbered:
            assert whole == {sequence: sequence % ROUND for sequence in whole}

    def assert_sent(self) -> None:
        """What the payload says it sent is what came to the link, each frame once."""
        assert self.witness.gaps == self.witness.strangers == 0
        sequences = [frame.sequence for frame in self.left]
        assert sequences == sorted(set(sequences))
        assert len(sequences) == self.ended.counts["sent"]

    @property
    def given_up(self) -> int:
        """Packets that came after the receiver had given them up: it, or the link, stood still.

        It waits for 30 ms. A machine that stops a process for longer makes losses of its own.
        """
        assert self.received is not None
        return self.received.packets_late - self.link.duplicated

    def assert_exact(self) -> None:
        """All of it: sent less seen are the frames that the link's losses cost, one by one.

        Each packet that was given up may cost one group of pictures more.
        """
        self.assert_in_order()
        self.assert_sent()
        link, received = self.link, self.received
        assert link.received == link.passed + link.lost
        assert received is not None
        assert received.packets == link.passed + link.duplicated
        assert received.packets_lost - self.given_up == link.lost and self.given_up >= 0
        assert (received.decoded + received.damaged) == len(self.seen)
        assert received.garbage == received.other_streams == 0
        assert received.failed == 0
        assert len(self.visible) - received.decoded <= LONGEST_GOP * self.given_up


class Flight:
    """A payload that flies over an impaired link to a ground; a context manager."""

    def __init__(
        self,
        folder: Path,
        ground: Ground | GroundProcess,
        recording: Path | None = None,
        *settings: str,
        camera: str = "",
        impairment: Impairment = CLEAN,
        seed: int = 0,
        payload_id: str = "blimp-1",
        env: Mapping[str, str] | None = None,
        prefix: Sequence[str] = (),
        host: str = "127.0.0.1",
    ) -> None:
        self.payload_id = payload_id
        self.ground: Ground | GroundProcess = ground
        self.witness = Witness()
        self._numbered = not camera
        self._speaks = "telemetry.enabled=false" not in settings
        self._stack = contextlib.ExitStack()
        self.link = self._stack.enter_context(
            ImpairedLink(ground.port, impairment, seed=seed, tap=self.witness, host=host)
        )
        self.payload = self._stack.enter_context(
            PayloadProcess(
                folder,
                f"payload_id={payload_id}",
                f"camera.uri={camera or f'replay:{recording}?loop=1'}",
                f"link.port={self.link.port}",
                f"telemetry.connect={json.dumps(ground.endpoints)}",
                *settings,
                env=env,
                prefix=prefix,
            )
        )

    def __enter__(self) -> Flight:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def wait_streaming(self, within_s: float = FRESH_S, *, ground: Gallery | None = None) -> float:
        """Seconds until a frame is seen that leaves the payload from now on; fails beyond."""
        before = len(self.witness.left())
        asked_s = time.monotonic()

        def fresh(seen: Seen) -> bool:
            return any(frame.sequence == seen.sequence for frame in self.witness.left()[before:])

        seen = (ground or self.ground).wait_for(fresh, within_s)
        took_s = time.monotonic() - asked_s
        left = len(self.witness.left()) - before
        assert seen is not None, (
            f"no fresh frame within {within_s:g} s, {left} left the payload;"
            f" its status: {self.payload.process.poll()}, it wrote: {self.payload.written()}"
        )
        return took_s

    def finish(self) -> Account:
        """Stops the payload by SIGTERM and takes down what everyone says."""
        return self.account(self.payload.end())

    def account(self, ended: Ended) -> Account:
        """What everyone says, after the payload has ended and all that was on its way is here."""
        self._let_arrive()
        left = self.witness.left()
        ground = self.ground
        received = ground.receiver.counters if isinstance(ground, Ground) else None
        return Account(
            ended, left, self.witness.visible(), ground.frames, self.link.counts, self.witness,
            received, self._said(), self._numbered,
        )  # fmt: skip

    def _let_arrive(self) -> None:
        until_s = time.monotonic() + LIMIT_S
        before = None
        while time.monotonic() < until_s:
            now = (len(self.ground.frames), self.link.counts)
            if now == before and self.link.idle:
                return
            before = now
            time.sleep(_QUIET_S)

    def _said(self) -> dict[str, int]:
        """The counters of the last event in telemetry, where a listener is at hand."""
        if not (isinstance(self.ground, Ground) and self._speaks):
            return {}
        ends = (messages.EVENT_STOPPED, messages.EVENT_END_OF_STREAM)
        listener = self.ground.listener
        listener.wait(self.payload_id, lambda s: any(e.name in ends for e in s.events), FRESH_S)
        state = listener.state(self.payload_id)
        events = state.events if state else []
        last = next((event for event in reversed(events) if event.name in ends), None)
        assert last is not None, f"{self.payload_id} did not say that it ended: {events}"
        wanted = ("captured", "gated", "sent", "discarded")
        return {name: last.values[name] for name in wanted if name in last.values}
