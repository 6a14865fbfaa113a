"""The receiving side of SRTP (RFC 3711): only what a known payload sent, decrypted.

The profile is AES_CM_128_HMAC_SHA1_80 with key derivation rate 0 and without MKI. A packet's index
has 48 bits, of which it carries the lower 16. The rest, the rollover counter (ROC), is known only
to who has heard the stream from its start; a receiver that joins later finds it by trying which one
the authentication tag was made with.
"""

from __future__ import annotations

import hmac
import struct
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from ground_station.stream.counters import Counters
from ground_station.stream.rtp import MAX_JUMP, header_bytes
from pi_firmware.wire import keys as names
from pi_firmware.wire.errors import StreamError, TelemetryError, os_errors_as
from pi_firmware.wire.srtcp import SRTP_LABEL, ReplayWindow, SessionKeys
from pi_firmware.wire.srtp import TAG_BYTES, read_key

FOLDER = "srtp"
"""Where the payloads' keys are in a ground station's certificate folder."""
REPLAY_WINDOW = MAX_JUMP
"""Packets of which it is known whether they came. The reorderer would take older ones for a new
sender's."""
STREAMS = 64
"""SSRCs kept for each key; each of them has authenticated itself, so that no flood fills them, and
no payload another's."""
SEARCH_RATE_HZ = 20_000
"""Tags computed a second, at most, to find ROCs, of 1.7 microseconds each where it was measured."""
SEARCH_TAGS = 2048
"""Tags computed for one packet, at most: 1024 rollovers are three days of 240 packets a second."""

_ROC_LIMIT = 1 << 16


def load_keys(folder: str | Path) -> dict[str, bytes]:
    """The payloads' master keys with salt, by payload id, of a ground station's folder.

    It reads `FOLDER/srtp/ID.key` as `blimp keys` wrote them; raises `StreamError` with one line.
    """
    folder = Path(folder) / FOLDER
    with os_errors_as(folder, StreamError):
        paths = sorted(path for path in folder.iterdir() if path.suffix == ".key")
    loaded = {}
    for path in paths:
        try:
            names.check_payload_id(path.stem)
        except TelemetryError:
            raise StreamError(f"{path}: not the name of a payload") from None
        loaded[path.stem] = read_key(path)
    return loaded


class _Packet(NamedTuple):
    """An SRTP packet, taken apart."""

    sequence: int
    ssrc: int
    header_bytes: int
    authenticated: bytes
    tag: bytes


def _parse(datagram: bytes) -> _Packet | None:
    """The packet in a datagram; None when it cannot be one of the video's."""
    authenticated = datagram[:-TAG_BYTES]
    size = header_bytes(authenticated)
    if size is None:
        return None
    sequence, ssrc = struct.unpack_from(">2xH4xI", authenticated)
    return _Packet(sequence, ssrc, size, authenticated, datagram[-TAG_BYTES:])


def _made_with(begun: hmac.HMAC, roc: int, tag: bytes) -> bool:
    if not 0 <= roc < 1 << 32:
        return False
    mac = begun.copy()
    mac.update(roc.to_bytes(4, "big"))
    return hmac.compare_digest(mac.digest()[:TAG_BYTES], tag)


class _Stream(ReplayWindow):
    """One payload's with one SSRC: its keys, and which of its indices came."""

    def __init__(self, keys: SessionKeys, highest: int) -> None:
        super().__init__(highest, REPLAY_WINDOW)
        self.keys = keys

    def estimate(self, sequence: int) -> int:
        """The index nearest to the highest one (RFC 3711, 3.3.1); it can come out below 0."""
        ahead = (sequence - self.highest + 0x8000) % 0x10000 - 0x8000
        return self.highest + ahead


class _Budget:
    """How much may be searched: a second's worth at once, and then as much a second."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._left, self._at_s = float(SEARCH_RATE_HZ), clock()

    def is_left(self) -> bool:
        now_s = self._clock()
        gained = (now_s - self._at_s) * SEARCH_RATE_HZ
        self._left, self._at_s = min(SEARCH_RATE_HZ, self._left + gained), now_s
        return self._left > 0

    def spend(self, tags: int) -> None:
        self._left -= tags  # a search that was begun goes to its end, on credit


class Unprotector:
    """Takes SRTP packets apart; `keys` are master keys with salt (30 bytes) by payload id.

    Unauthenticated packets go to `counters.refused`, repeated or very old ones to
    `counters.replayed`. Raises `StreamError` for a key of another length.

    A stream is a payload's key with an SSRC, so that who sends with another's SSRC does not shut
    it out. What a payload sent in an earlier flight is authentic, too: only its SSRC, which
    telemetry announces, tells today's stream from one played back to a receiver that has just
    started.
    """

    def __init__(
        self,
        keys: Mapping[str, bytes],
        counters: Counters | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.counters = counters or Counters()
        self.sender: str | None = None
        """The payload of the packet that was taken last."""
        self.tags_searched = 0
        """Tags computed so far to find ROCs."""
        self._keys = [
            SessionKeys(payload_id, master, SRTP_LABEL) for payload_id, master in keys.items()
        ]
        self._streams: dict[str, dict[int, _Stream]] = {payload_id: {} for payload_id in keys}
        # Apart, so that a flood of unknown streams does not keep a known one from coming back.
        self._to_join, self._to_follow = _Budget(clock), _Budget(clock)
        # One half for young streams, the other for older ones, and the payloads share both.
        self._rocs = max(1, SEARCH_TAGS // (2 * max(1, len(keys))))
        self._next_roc = self._rocs

    def unprotect(self, datagram: bytes) -> bytes | None:
        """The RTP packet in a datagram; None, and counted, when it is not authentic and new."""
        packet = _parse(datagram)
        if packet is None:
            self.counters.refused += 1
            return None
        found = self._find(packet)
        if found is None:
            self.counters.refused += 1
            return None
        stream, index = found
        self.sender = stream.keys.payload_id
        own = self._streams[self.sender]
        own.pop(packet.ssrc, None)
        own[packet.ssrc] = stream  # behind those that were heard less lately
        if len(own) > STREAMS:
            del own[next(iter(own))]
        if not stream.accept(index):
            self.counters.replayed += 1
            return None
        header, size = packet.authenticated[: packet.header_bytes], packet.header_bytes
        return header + stream.keys.crypt(packet.authenticated[size:], packet.ssrc, index)

    def _find(self, packet: _Packet) -> tuple[_Stream, int] | None:
        """The packet's stream and index, authenticated; None when it is not authentic."""
        known = {who: own[packet.ssrc] for who, own in self._streams.items() if packet.ssrc in own}
        for stream in known.values():
            index = stream.estimate(packet.sequence)
            if _made_with(stream.keys.begin_tag(packet.authenticated), index >> 16, packet.tag):
                return stream, index
        for stream in known.values():
            if (found := self._follow(packet, stream)) is not None:
                return found
        return self._join(packet, [own for own in self._keys if own.payload_id not in known])

    def _follow(self, packet: _Packet, stream: _Stream) -> tuple[_Stream, int] | None:
        """A known stream after a silence of more than half a round of the sequence numbers."""
        if not self._to_follow.is_left():
            return None
        first = (stream.highest - packet.sequence >> 16) + 1  # the least that is beyond the highest
        rocs = range(first, first + SEARCH_TAGS)
        found = self._search(packet, [stream.keys], rocs, self._to_follow)
        return (stream, found[1]) if found else None

    def _join(self, packet: _Packet, keys: Sequence[SessionKeys]) -> tuple[_Stream, int] | None:
        """A stream not heard before: mostly young; if not, older ones are tried by and by."""
        if not keys or not self._to_join.is_left():
            return None
        young, older = range(self._rocs), range(self._next_roc, self._next_roc + self._rocs)
        found = self._search(packet, keys, chain(young, older), self._to_join)
        if found is None:
            self._next_roc = older.stop if older.stop < _ROC_LIMIT else young.stop
            return None
        return _Stream(*found), found[1]

    def _search(
        self, packet: _Packet, keys: Sequence[SessionKeys], rocs: Iterable[int], budget: _Budget
    ) -> tuple[SessionKeys, int] | None:
        """Whose the packet is and its index, if the tag was made with one of these ROCs."""
        begun = [(own, own.begin_tag(packet.authenticated)) for own in keys]
        before = self.tags_searched
        try:
            for roc in rocs:
                for own, mac in begun:
                    self.tags_searched += 1
                    if _made_with(mac, roc, packet.tag):
                        return own, roc << 16 | packet.sequence
            return None
        finally:
            budget.spend(self.tags_searched - before)
