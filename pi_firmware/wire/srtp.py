"""What sender and receiver of encrypted video agree on (RFC 3711): profile, sizes and key file."""

from __future__ import annotations

from pathlib import Path

from pi_firmware.wire.errors import StreamError, os_errors_as

CIPHER, AUTHENTICATION = "aes-128-icm", "hmac-sha1-80"
"""AES_CM_128_HMAC_SHA1_80 (RFC 3711, 8.2), as GStreamer's `srtpenc` names its parts."""

KEY_BYTES, SALT_BYTES = 16, 14
MASTER_BYTES = KEY_BYTES + SALT_BYTES
"""The master key with its salt behind it, as one."""

TAG_BYTES = 10
"""The authentication tag at a packet's end: all that a packet grows by."""

KEY_FILE = "srtp.key"
"""A payload's own key, in the folder that `blimp keys payload` wrote."""

_FILE_LIMIT = 4096


def read_key(path: Path) -> bytes:
    """A master key with salt (30 bytes) from a file of hexadecimal digits.

    Raises `StreamError` with one line, which never shows what the file holds.
    """
    with os_errors_as(path, StreamError), path.open("rb") as file:
        text = file.read(_FILE_LIMIT)
    try:
        key = bytes.fromhex(text.decode("ascii").strip())
    except ValueError:
        raise StreamError(f"{path}: not hexadecimal digits, as an SRTP key's are") from None
    if len(key) != MASTER_BYTES:
        raise StreamError(
            f"{path}: {len(key)} bytes; an SRTP key with its salt has {MASTER_BYTES}"
            f" ({2 * MASTER_BYTES} digits)"
        )
    return key
