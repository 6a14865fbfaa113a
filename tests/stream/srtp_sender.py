"""GStreamer's own SRTP encoder: what the receiving side is held against."""

from __future__ import annotations

from collections.abc import Iterable

from pi_firmware import gstreamer
from pi_firmware.wire import srtp

_LIMIT_NS = 10_000_000_000


class SrtpSender:
    """One sender, with its own rollover counters; a context manager."""

    def __init__(self, key: bytes) -> None:
        self._gst = gstreamer.load()
        self._pipeline = gstreamer.launch(
            "appsrc name=in format=time caps=application/x-rtp,media=video,clock-rate=90000,"
            "encoding-name=H264,payload=96 "
            f"! srtpenc name=srtp rtp-cipher={srtp.CIPHER} rtp-auth={srtp.AUTHENTICATION} "
            "! appsink name=out sync=false async=false"
        )
        element = self._pipeline.get_by_name("srtp")
        element.set_property("key", self._gst.Buffer.new_wrapped(key))
        self._in = self._pipeline.get_by_name("in")
        self._out = self._pipeline.get_by_name("out")

    def __enter__(self) -> SrtpSender:
        self._pipeline.set_state(self._gst.State.PLAYING)
        return self

    def __exit__(self, *_: object) -> None:
        self._pipeline.set_state(self._gst.State.NULL)

    def protect(self, datagrams: Iterable[bytes]) -> list[bytes]:
        """The SRTP packets of these RTP packets, one for each."""
        protected = []
        for datagram in datagrams:
            self._in.emit("push-buffer", self._gst.Buffer.new_wrapped(datagram))
            sample = self._out.emit("try-pull-sample", _LIMIT_NS)
            assert sample is not None, "srtpenc gave nothing"
            buffer = sample.get_buffer()
            protected.append(buffer.extract_dup(0, buffer.get_size()))
        return protected
