"""Session keys of SRTP, and SRTCP with them (RFC 3711), both ways: what is asked of the payload.

The profile is AES_CM_128_HMAC_SHA1_80 with key derivation rate 0 and without MKI.
"""

from __future__ import annotations

import hmac
import struct
import threading

from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes

from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.rtcp import HEADER_BYTES
from pi_firmware.wire.srtp import KEY_BYTES, MASTER_BYTES, SALT_BYTES, TAG_BYTES

SRTP_LABEL, SRTCP_LABEL = 0, 3
"""The first of each one's three labels: cipher, authentication, salt (RFC 3711, 4.3.2)."""

_AUTHENTICATION_KEY_BYTES = 20
_INDEX_BYTES = 4  # before the tag: whether it is encrypted, and the index (RFC 3711, 3.4)
_ENCRYPTED, _INDICES = 1 << 31, 1 << 31
_WINDOW = 64
_SENDERS = 8


def aes_cm(key: bytes, counter: int, data: bytes) -> bytes:
    """AES in counter mode (RFC 3711, 4.1.1) from a 128-bit counter on: data to or from cipher."""
    return _aes_cm(algorithms.AES(key), counter, data)


def _aes_cm(key: algorithms.AES, counter: int, data: bytes) -> bytes:
    return Cipher(key, modes.CTR(counter.to_bytes(16, "big"))).encryptor().update(data)


def derive(master: bytes, label: int, size: int) -> bytes:
    """A session key of `size` bytes (RFC 3711, 4.3.1, rate 0) from the master key with its salt."""
    salt = int.from_bytes(master[KEY_BYTES:], "big")
    return aes_cm(master[:KEY_BYTES], (salt ^ label << 48) << 16, bytes(size))


class SessionKeys:
    """One payload's session keys, from its master key with salt (30 bytes) and the first label.

    Raises `StreamError` for a key of another length.
    """

    def __init__(self, payload_id: str, master: bytes, first_label: int) -> None:
        if len(master) != MASTER_BYTES:
            raise StreamError(
                f"SRTP key of '{payload_id}': {len(master)} bytes; it has {MASTER_BYTES}"
            )
        self.payload_id = payload_id
        self._cipher = algorithms.AES(derive(master, first_label, KEY_BYTES))
        authentication = derive(master, first_label + 1, _AUTHENTICATION_KEY_BYTES)
        self._mac = hmac.new(authentication, digestmod="sha1")
        self._salt = int.from_bytes(derive(master, first_label + 2, SALT_BYTES), "big") << 16

    def begin_tag(self, authenticated: bytes) -> hmac.HMAC:
        """The tag but for SRTP's rollover counter, which is authenticated last (RFC 3711, 4.2)."""
        mac = self._mac.copy()
        mac.update(authenticated)
        return mac

    def crypt(self, data: bytes, ssrc: int, index: int) -> bytes:
        """What a packet of this index carries (RFC 3711, 4.1.1), to or from cipher."""
        return _aes_cm(self._cipher, self._salt ^ ssrc << 64 ^ index << 16, data)


class ReplayWindow:
    """Which of a sender's packets came: of the `size` newest indices (RFC 3711, 3.3.2)."""

    def __init__(self, highest: int, size: int) -> None:
        self.highest = highest
        self._size, self._came = size, 0  # bit n: the packet of index `highest` - n

    def accept(self, index: int) -> bool:
        """Marks an authenticated index; False when it came before or is too old to tell."""
        ahead = index - self.highest
        if ahead > 0:
            self.highest = index
            self._came = (self._came << min(ahead, self._size) | 1) & (1 << self._size) - 1
            return True
        bit = 1 << -ahead
        if -ahead >= self._size or self._came & bit:
            return False
        self._came |= bit
        return True


class SrtcpProtector:
    """Protects what is said to one payload, in all its streams; from any thread.

    Each sender's SSRC is to be drawn again at its start: no index is used twice with it.
    """

    def __init__(self, payload_id: str, master: bytes) -> None:
        self._keys = SessionKeys(payload_id, master, SRTCP_LABEL)
        self._lock = threading.Lock()
        self._index = 0

    def protect(self, rtcp: bytes) -> bytes:
        """The SRTCP packet of an RTCP packet (RFC 3711, 3.4)."""
        with self._lock:
            self._index = (self._index + 1) % _INDICES
            index = self._index
        head, body = rtcp[:HEADER_BYTES], rtcp[HEADER_BYTES:]
        ssrc = int.from_bytes(head[4:], "big")
        said = head + self._keys.crypt(body, ssrc, index) + struct.pack(">I", _ENCRYPTED | index)
        return said + self._keys.begin_tag(said).digest()[:TAG_BYTES]


class SrtcpUnprotector:
    """Takes SRTCP packets of one payload apart; for one thread."""

    def __init__(self, master: bytes) -> None:
        self._keys = SessionKeys("this payload", master, SRTCP_LABEL)
        self._senders: dict[int, ReplayWindow] = {}

    def unprotect(self, datagram: bytes) -> bytes | None:
        """The RTCP packet in a datagram; None when it is not authentic, not encrypted or not new.

        A sender that has not been heard for long may be heard again with what it said before.
        """
        if len(datagram) < HEADER_BYTES + _INDEX_BYTES + TAG_BYTES:
            return None
        said, tag = datagram[:-TAG_BYTES], datagram[-TAG_BYTES:]
        if not hmac.compare_digest(self._keys.begin_tag(said).digest()[:TAG_BYTES], tag):
            return None
        (marked,) = struct.unpack_from(">I", said, len(said) - _INDEX_BYTES)
        ssrc, index = int.from_bytes(said[4:8], "big"), marked & _INDICES - 1
        if not marked & _ENCRYPTED or not self._is_new(ssrc, index):
            return None
        body = said[HEADER_BYTES:-_INDEX_BYTES]
        return said[:HEADER_BYTES] + self._keys.crypt(body, ssrc, index)

    def _is_new(self, ssrc: int, index: int) -> bool:
        window = self._senders.pop(ssrc, None) or ReplayWindow(index, _WINDOW)
        self._senders[ssrc] = window  # behind those that were heard less lately
        if len(self._senders) > _SENDERS:
            del self._senders[next(iter(self._senders))]
        return window.accept(index)
