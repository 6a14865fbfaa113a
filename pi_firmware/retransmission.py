"""What the ground asks for again (RFC 4585) is sent again (RFC 4588), from a bounded history.

GStreamer keeps the packets and sends them. Python sees what is asked for, and only while something
is: at the address that the video leaves from (RFC 5761).
"""

from __future__ import annotations

import importlib.util
import os
import select
import socket
import threading
import time
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import rtcp, video
from pi_firmware.wire.errors import StreamError

HISTORY_BYTES = 1 << 20
"""The history's size at most: a second of 8 Mbit/s."""
_SHARE, _MOST_BYTES = 0.5, 64 << 10
"""What is sent again at most, of what is sent, and in one burst: a link that loses a third is full,
and 64 KB is what 3 Mbit/s send in the time that a receiver waits for a frame."""
_POLL_S = 0.2
_BURST, _PER_S = 20, 200
"""Datagrams that are read at once, and a second: more than who waits for frames ever asks."""
_LONGEST = 1500


def rtx_ssrc(ssrc: int) -> int:
    """The SSRC of what is sent again: as random as the stream's own, and never the same or 0."""
    other = ssrc ^ 0x8000_0000
    return other or 1


def unavailable(*, encrypted: bool) -> str:
    """What is not installed, as on a card of before there was this; "" when all of it is."""
    try:
        gstreamer.require(("rtprtxsend",), "link.history_s")
    except StreamError as error:
        return str(error)
    if encrypted and importlib.util.find_spec("cryptography") is None:
        return "link.history_s: Python has no 'cryptography' here (package python3-cryptography)"
    return ""


def description(link: LinkSettings, ssrc: int) -> str:
    """The history's part of the pipeline, between payloader and encryption; "" without one."""
    if not link.history_s:
        return ""
    return (
        f"! rtprtxsend name=history max-size-time={round(1e3 * link.history_s)} "
        f"max-size-packets={max(1, min(HISTORY_BYTES // link.mtu_bytes, 32_767))} "
        f"payload-type-map=application/x-rtp-pt-map,{video.PAYLOAD_TYPE}="
        f"(uint){video.RTX_PAYLOAD_TYPE} "
        f"ssrc-map=application/x-rtp-ssrc-map,{ssrc}=(uint){rtx_ssrc(ssrc)} "
    )


class Budget:
    """How much may be sent again: a share of what is sent, and a burst; bytes, for two threads."""

    def __init__(self, most_bytes: int = _MOST_BYTES) -> None:
        self._most_bytes = self._left = most_bytes
        self._lock = threading.Lock()

    def sent(self, size: int) -> None:
        with self._lock:
            self._left = min(self._most_bytes, self._left + int(_SHARE * size))

    def take(self, size: int) -> bool:
        """Whether so much may be sent again, which then is spent."""
        with self._lock:
            if self._left < size:
                return False
            self._left -= size
            return True


class Retransmission:
    """Reads what is asked for at the sockets of a running pipeline; `start` and `stop` it.

    With a `key` (30 bytes) it is SRTCP of that key or nothing. Whoever asks, it goes to where the
    video goes, and never more of it than `budget` has.
    """

    def __init__(self, pipeline: Any, link: LinkSettings, ssrc: int, key: bytes | None) -> None:
        self._gst = gstreamer.load()
        self._history = pipeline.get_by_name("history").get_static_pad("src")
        self._sink = pipeline.get_by_name("out")
        self._ssrc, self._packet_bytes = ssrc, link.mtu_bytes
        self._unprotector: Any = None
        if key is not None:
            from pi_firmware.wire.srtcp import SrtcpUnprotector  # 8 MB that plain video saves

            self._unprotector = SrtcpUnprotector(key)
        self.budget = Budget()
        self._closing = threading.Event()
        self._sockets: list[socket.socket] = []
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Reads at the sockets that the pipeline sends from, of which there are two at most."""
        from gi.repository import Gio  # noqa: F401  # without it a GSocket has no file descriptor

        for name in ("used-socket", "used-socket-v6"):
            used = self._sink.get_property(name)
            if used is not None:
                self._sockets.append(socket.socket(fileno=os.dup(used.get_fd())))
        self._thread = threading.Thread(target=self._run, name="retransmission", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Reads no more."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
        for own in self._sockets:
            own.close()

    def take(self, datagram: bytes) -> int:
        """Sends again what a datagram asks for, as far as may be; returns how many were tried."""
        if rtcp.sender_of(datagram) is None:
            return 0
        if self._unprotector is not None:
            plain = self._unprotector.unprotect(datagram)
            if plain is None:
                return 0
            datagram = plain
        tried = 0
        for sequence in rtcp.asked_for(datagram, self._ssrc):
            if not self.budget.take(self._packet_bytes):
                break
            tried += 1
            self._history.send_event(self._request(sequence))
        return tried

    def _request(self, sequence: int) -> Any:
        """What GStreamer's RTP session tells the history's element."""
        gst = self._gst
        text = f"GstRTPRetransmissionRequest, seqnum=(uint){sequence}, ssrc=(uint){self._ssrc}"
        structure = gst.Structure.from_string(text)[0]
        return gst.Event.new_custom(gst.EventType.CUSTOM_UPSTREAM, structure)

    def _run(self) -> None:
        left, read_s = float(_BURST), time.monotonic()
        while not self._closing.is_set():
            ready, _, _ = select.select(self._sockets, [], [], _POLL_S)
            now_s = time.monotonic()
            left, read_s = min(_BURST, left + _PER_S * (now_s - read_s)), now_s
            for own in ready:
                left -= 1
                try:
                    datagram = own.recv(_LONGEST, socket.MSG_DONTWAIT)
                except OSError:
                    continue  # an ICMP error, or another thread's
                self.take(datagram)
            if left < 1:  # the system throws away what does not wait in its own queue
                self._closing.wait(1 / _PER_S)
