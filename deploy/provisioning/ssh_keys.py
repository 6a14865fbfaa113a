"""Public keys for SSH: one line of `authorized_keys` each, without options."""

from __future__ import annotations

import base64
import binascii
import re

from deploy.errors import DeployError

TYPES = (
    "ssh-ed25519",
    "ecdsa-sha2-nistp256",
    "ecdsa-sha2-nistp384",
    "ecdsa-sha2-nistp521",
    "ssh-rsa",
    "sk-ssh-ed25519@openssh.com",
    "sk-ecdsa-sha2-nistp256@openssh.com",
)
MAX_BYTES = 8192
# sshd's own least size; shorter ones it refuses at log-in, which nobody would understand.
MIN_RSA_BITS = 2048
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")


def check_authorized_key(line: str, what: str) -> str:
    """Returns the line without blanks around it; raises `DeployError` when it is no public key.

    The key's bytes must begin with its type (RFC 4253, 6.6), so a line cut while it was copied is
    found here and not when the card is out of reach. `what` names the line in the error.
    """
    text = line.strip()
    if "PRIVATE KEY" in text:
        raise DeployError(f"{what} is a private key; give the public one, the file with .pub")
    if _UNPRINTABLE.search(text) or len(text.encode()) > MAX_BYTES:
        raise DeployError(f"{what}: expected one line of at most {MAX_BYTES} bytes")
    kind, _, rest = text.partition(" ")
    if kind not in TYPES:
        raise DeployError(
            f"{what} starts with {kind[:30]!r}; expected 'TYPE KEY NAME' without options, TYPE one"
            f" of {', '.join(TYPES)}"
        )
    try:
        blob = base64.b64decode(rest.split(" ")[0], validate=True)
        parts = _strings(blob)
    except (binascii.Error, ValueError):
        parts = []
    if len(parts) < 2 or parts[0] != kind.encode():
        raise DeployError(f"{what}: the key after {kind} is cut or damaged")
    if kind == "ssh-rsa":
        bits = int.from_bytes(parts[-1], "big").bit_length()
        if bits < MIN_RSA_BITS:
            raise DeployError(f"{what} is an RSA key of {bits} bits; allowed: {MIN_RSA_BITS} on")
    return text


def _strings(blob: bytes) -> list[bytes]:
    """SSH's strings in a row, each after its length; raises `ValueError` when they don't fit."""
    parts = []
    while blob:
        length = int.from_bytes(blob[:4], "big")
        if len(blob) < 4 + length:
            raise ValueError("cut")
        parts.append(blob[4 : 4 + length])
        blob = blob[4 + length :]
    return parts
