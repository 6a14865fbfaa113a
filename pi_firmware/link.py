"""The video's way out: access units into RTP packets over UDP (RFC 6184).

A pipeline of its own, which lives as long as the program: cameras and encoders are restarted in
front of it while sequence numbers and timestamps go on, so that a receiver sees a pause and no
other stream, and SRTP's rollover counter keeps step.
"""

from __future__ import annotations

import ipaddress
import secrets
import socket
import sys
import threading
from dataclasses import replace
from pathlib import Path

from pi_firmware import gstreamer, retransmission
from pi_firmware.correction import ForwardCorrection, Sender
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import srtp, video
from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.messages import LinkReport
from pi_firmware.wire.telemetry import is_loopback

DISCOVERED = "auto"
"""`link.host` that waits for a ground station to say where it is."""
_QUEUE_UNITS = 30  # a second: a busy board catches up, a network that hangs does not
_RESOLVE_S = 2.0
_FLUSH_LIMIT_NS = 5_000_000_000
_VANISHING, _SMALLER, _LEAST_BYTES = 0.3, 0.85, 500
"""Packets get so much smaller, down to what IPv4 carries anywhere, while so many are lost."""
_ROUNDING_BYTES = 40
"""Of its packets a payloader fills the largest to within so much, corrections' room included."""
_SHRUNK_S = 1.2
"""By then nothing that the ground reports on was sent before."""


def draw_ssrc(link: LinkSettings) -> int:
    """The stream's SSRC: the configured one, or a random one from 1 on (RFC 3550, 8.1)."""
    return link.ssrc or 1 + secrets.randbelow(0xFFFFFFFF)


def load_key(certificates: str) -> bytes | None:
    """The payload's SRTP master key with salt (30 bytes) from the folder of its certificates.

    None without a folder; raises `StreamError` with one line when it holds no key that can be used.
    """
    return srtp.read_key(Path(certificates) / srtp.KEY_FILE) if certificates else None


def description(link: LinkSettings, ssrc: int, *, encrypted: bool = False) -> str:
    """The pipeline, from whole access units to datagrams of at most `link.mtu_bytes`.

    The address and the key are not in it: `Link` sets those, whatever characters they have.
    """
    history = retransmission.description(link, ssrc)
    mtu_bytes, protect = link.mtu_bytes, ""
    if history:
        mtu_bytes -= video.OSN_BYTES
    if encrypted:
        mtu_bytes -= srtp.TAG_BYTES
        protect = (
            f"! srtpenc name=srtp rtp-cipher={srtp.CIPHER} rtp-auth={srtp.AUTHENTICATION} "
            f"rtcp-cipher={srtp.CIPHER} rtcp-auth={srtp.AUTHENTICATION} "
        )
    return (
        "appsrc name=link is-live=true format=time max-bytes=0 "
        "caps=video/x-h264,stream-format=byte-stream,alignment=au "
        f"! rtph264pay name=payloader pt={video.PAYLOAD_TYPE} ssrc={ssrc} mtu={mtu_bytes} "
        f"config-interval=0 aggregate-mode=none {history}{protect}"
        "! udpsink name=out sync=false async=false"
    )


class Link:
    """Sends access units to where the settings, or a ground station that was found, say.

    A name that has no address yet is tried again in the background: Wi-Fi may come later than the
    camera. A network that takes nothing costs whole stretches up to the next IDR, never memory.

    With a `key` (master key with salt, 30 bytes) and `link.encrypted` it sends SRTP. Encrypted
    without a key it speaks to loopback only, and raises `StreamError` with one line for any other
    host. An SSRC must not serve two links with one key: both would encrypt with the same keystream
    (RFC 3711, 9.1), so that a fixed `link.ssrc` is refused, too.

    What a ground station asks for again within `link.history_s` is sent again, beside, and so are
    corrections, as far as its `report` asks for them.
    """

    def __init__(self, link: LinkSettings, ssrc: int, key: bytes | None = None) -> None:
        self._gst = gstreamer.load()
        encrypted = link.encrypted and key is not None
        self._loopback_only = link.encrypted and key is None
        if encrypted:
            gstreamer.require(("srtpenc",), "link.encrypted")
            if link.ssrc:
                raise StreamError(
                    f"link.ssrc is {link.ssrc}; with SRTP it must be 0, as each start needs another"
                )
        if link.history_s and (missing := retransmission.unavailable(encrypted=encrypted)):
            print(f"pi_firmware: {missing}; nothing is sent again", file=sys.stderr, flush=True)
            link = replace(link, history_s=0.0)
        self._pipeline = gstreamer.launch(description(link, ssrc, encrypted=encrypted))
        if encrypted:
            element = self._pipeline.get_by_name("srtp")
            element.set_property("key", self._gst.Buffer.new_wrapped(key))
        self._source = self._pipeline.get_by_name("link")
        self._sink = self._pipeline.get_by_name("out")
        self._payloader = self._pipeline.get_by_name("payloader")
        self._shrunk_s = float("-inf")
        self._retransmission: retransmission.Retransmission | None = None
        self.rtx_ssrc: int | None = None
        """What is asked for again comes with it; None: nothing does."""
        if link.history_s:
            self._retransmission = retransmission.Retransmission(
                self._pipeline, link, ssrc, key if encrypted else None
            )
            self.rtx_ssrc = retransmission.rtx_ssrc(ssrc)
        self._correction: ForwardCorrection | None = None
        if link.correction:
            sender = Sender(link, ssrc, sends_again=self.rtx_ssrc is not None)
            self._correction = ForwardCorrection(self._pipeline, sender)
        self._first_ns: int | None = None
        self.destination: tuple[str, int] | None = None
        """Numeric address and port that packets go to; None while there is none."""
        self._waits_for_idr = False
        self._closing = threading.Event()
        self._resolver: threading.Thread | None = None
        self.problem = ""
        """Why there is nowhere to send to, in one line; empty when there is."""
        if link.host == DISCOVERED:
            self.problem = f"link.host '{DISCOVERED}': no ground station was found yet"
        elif self._loopback_only or _is_numeric(link.host):
            if not self._resolve(link):
                raise StreamError(_without_key(link.host) if self._loopback_only else self.problem)
        else:
            # Never on this thread: a name server that is out of reach is waited for half a minute.
            self._resolver = threading.Thread(
                target=self._resolve_later, args=(link,), name="link-host", daemon=True
            )
            self._resolver.start()

    @property
    def correction_ssrc(self) -> int | None:
        """Corrections come with it; None: there are never any."""
        return self._correction.sender.ssrc if self._correction is not None else None

    def start(self) -> None:
        """Sets the pipeline to playing; raises `StreamError` with one line."""
        if self._pipeline.set_state(self._gst.State.PLAYING) == self._gst.StateChangeReturn.FAILURE:
            raise StreamError(f"video link: {self.failure() or 'it does not start'}")
        if self._retransmission is not None:
            self._retransmission.start()

    def redirect(self, host: str, port: int) -> bool:
        """Sends to another numeric address from the next packet on; False if it must not."""
        if self._loopback_only and not is_loopback(host):
            self.destination = None
            self.problem = _without_key(host)
            return False
        if (host, port) != self.destination:
            self._sink.set_property("host", host)
            self._sink.set_property("port", port)
            self.destination = (host, port)
            self.problem = ""
        return True

    def report(self, report: LinkReport, now_s: float) -> float:
        """Takes what the ground saw; the share of corrections beside what is sent, of late.

        Where many packets are lost and none of full size comes, the path's MTU is less than
        thought, and packets get smaller (RFC 8899's black hole): for good, it costs little.
        """
        full_bytes, largest_bytes = self._payloader.get_property("mtu"), report.largest_bytes
        if (
            largest_bytes is not None
            and (report.dropped or 0.0) > _VANISHING
            and largest_bytes + _ROUNDING_BYTES < full_bytes
            and full_bytes > _LEAST_BYTES
            and now_s - self._shrunk_s > _SHRUNK_S
        ):
            self._shrunk_s, smaller_bytes = now_s, max(_LEAST_BYTES, int(_SMALLER * full_bytes))
            self._payloader.set_property("mtu", smaller_bytes)
            said = f"RTP packets of {full_bytes} bytes do not arrive; {smaller_bytes} from now on"
            print(f"pi_firmware: {said}", file=sys.stderr, flush=True)
        return self._correction.report(report, now_s) if self._correction is not None else 0.0

    def send(self, access_unit: bytes, clock_ns: int, *, idr: bool) -> bool:
        """Queues one access unit of an instant on a clock that only rises; whether it will leave.

        It will not when there is nowhere to send to, when the network takes nothing, and from then
        on until the next IDR: what hangs on a missing frame is worth nothing.
        """
        full = self._source.get_property("current-level-buffers") >= _QUEUE_UNITS
        if self.destination is None or full or (self._waits_for_idr and not idr):
            self._waits_for_idr = True
            return False
        self._waits_for_idr = False
        if self._first_ns is None:
            self._first_ns = clock_ns
        if self._retransmission is not None:
            self._retransmission.budget.sent(len(access_unit))
        buffer = self._gst.Buffer.new_wrapped(access_unit)
        buffer.pts = clock_ns - self._first_ns
        return bool(self._source.emit("push-buffer", buffer) == self._gst.FlowReturn.OK)

    def failure(self) -> str | None:
        """What ended the pipeline, in GStreamer's words; None while it lives."""
        return gstreamer.failure(self._pipeline)

    def flush(self) -> bool:
        """Waits until all that is queued has left; whether it did within 5 s."""
        self._source.emit("end-of-stream")
        kinds = self._gst.MessageType.EOS | self._gst.MessageType.ERROR
        message = self._pipeline.get_bus().timed_pop_filtered(_FLUSH_LIMIT_NS, kinds)
        return message is not None and message.type == self._gst.MessageType.EOS

    def stop(self) -> None:
        """Stops the pipeline, whatever is queued."""
        self._closing.set()
        if self._retransmission is not None:
            self._retransmission.stop()
        self._pipeline.set_state(self._gst.State.NULL)
        if self._resolver is not None:
            self._resolver.join(_RESOLVE_S)

    def _resolve_later(self, link: LinkSettings) -> None:
        told = False
        while not self._resolve(link):
            if not told:
                told = True
                print(f"pi_firmware: {self.problem}", file=sys.stderr, flush=True)
            if self._closing.wait(_RESOLVE_S):
                return

    def _resolve(self, link: LinkSettings) -> bool:
        """Finds the host's numeric address: the sink would send nowhere without a word."""
        try:
            found = socket.getaddrinfo(link.host, link.port, type=socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            self.problem = f"link.host '{link.host}': {reason}; it is tried again"
            return False
        return self.redirect(str(found[0][4][0]), link.port)


def _without_key(host: str) -> str:
    return (
        f"video to '{host}': no SRTP key; set telemetry.certificates to the folder that"
        " 'blimp keys payload' wrote, or link.encrypted = false to send it for all to see"
    )


def _is_numeric(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
