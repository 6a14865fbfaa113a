"""The video's way out: access units into RTP packets over UDP (RFC 6184)."""

from __future__ import annotations

import secrets
import socket
from typing import Any

from pi_firmware import gstreamer
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import video
from pi_firmware.wire.errors import StreamError


def draw_ssrc(link: LinkSettings) -> int:
    """The stream's SSRC: the configured one, or a random one from 1 on (RFC 3550, 8.1)."""
    return link.ssrc or 1 + secrets.randbelow(0xFFFFFFFF)


def description(link: LinkSettings, ssrc: int) -> str:
    """The link's part of the pipeline, from whole access units to datagrams.

    The address is not in it: `Link` sets that, whatever characters it has.
    """
    return (
        "appsrc name=link is-live=true format=time "
        "caps=video/x-h264,stream-format=byte-stream,alignment=au "
        f"! rtph264pay pt={video.PAYLOAD_TYPE} ssrc={ssrc} mtu={link.mtu_bytes} "
        "config-interval=0 aggregate-mode=none "
        "! udpsink name=out sync=false async=false"
    )


class Link:
    """Hands access units to the sending part of a pipeline built from `description`.

    Raises `StreamError` with one line when the host has no address.
    """

    def __init__(self, pipeline: Any, link: LinkSettings) -> None:
        self._gst = gstreamer.load()
        sink = pipeline.get_by_name("out")
        sink.set_property("host", _address(link))
        sink.set_property("port", link.port)
        self._source = pipeline.get_by_name("link")

    def send(self, access_unit: bytes, running_ns: int) -> bool:
        """Queues one access unit; False when the pipeline no longer takes any."""
        buffer = self._gst.Buffer.new_wrapped(access_unit)
        buffer.pts = running_ns
        return bool(self._source.emit("push-buffer", buffer) == self._gst.FlowReturn.OK)

    def end(self) -> None:
        """Ends the stream behind what is queued."""
        self._source.emit("end-of-stream")


def _address(link: LinkSettings) -> str:
    """The host's numeric address: the sink would send nowhere without a word if it had none."""
    try:
        found = socket.getaddrinfo(link.host, link.port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise StreamError(f"link.host '{link.host}': {reason}") from None
    return str(found[0][4][0])
