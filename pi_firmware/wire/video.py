"""What sender and receiver of the video agree on (RFC 3550, RFC 6184)."""

PORT = 5600
"""UDP port of the RTP stream."""

PAYLOAD_TYPE = 96
"""RTP payload type of H.264."""

RTX_PAYLOAD_TYPE = 97
"""RTP payload type of packets that are sent again, on an SSRC of their own (RFC 4588, 4)."""

OSN_BYTES = 2
"""What such a packet begins with: its original sequence number."""

CORRECTION_PAYLOAD_TYPE = 98
"""RTP payload type of forward correction, on an SSRC of its own (RFC 5109; RFC 5956, 4.3)."""

PAYLOAD_TYPES = (PAYLOAD_TYPE, RTX_PAYLOAD_TYPE, CORRECTION_PAYLOAD_TYPE)
"""All that come at the video's port."""

MAX_IDR_INTERVAL_NS = 1_000_000_000
"""Two IDR pictures are at most this far apart, so that a receiver recovers from a loss."""
