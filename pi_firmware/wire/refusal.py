"""Why a ground station that is there takes no part: Zenoh tries again and does not say.

One TLS handshake of our own with the same certificates (RFC 8446), nothing said after it. Under
TLS 1.3 a server refuses a certificate only after the client's handshake is done, so that one more
read is needed to hear of it.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pi_firmware.wire import credentials
from pi_firmware.wire.telemetry import check_endpoint

if TYPE_CHECKING:
    import ssl

_LIMIT_S = 2.0
_EXPIRED, _NOT_YET_VALID = 10, 9  # X509_V_ERR_*, openssl-verification-options(1)
_ALERTS = {
    "UNKNOWN_CA": "it does not trust the authority of this machine's certificate",
    "BAD_CERTIFICATE": "it refuses this machine's certificate",
    "CERTIFICATE_UNKNOWN": "it refuses this machine's certificate",
    "CERTIFICATE_EXPIRED": "by its clock this machine's certificate has expired",
    "DECRYPT_ERROR": "it refuses this machine's certificate",
}


def refusal(
    endpoint: str,
    held: credentials.Credentials,
    limit_s: float = _LIMIT_S,
    peers: Sequence[str] | None = None,
) -> str:
    """Why nobody can be spoken to at `tls/HOST:PORT`, in words; empty when nothing is wrong there.

    `peers` are the names that may answer there, by default those that `held` talks to.
    A host that does not answer at all refuses nothing. Takes `limit_s` a step at most, and raises
    nothing but what reading our own certificates raises.
    """
    host, port = check_endpoint(endpoint, certified=True)
    context = _context(held)
    try:
        plain = socket.create_connection((host.strip("[]"), port), timeout=limit_s)
    except OSError:
        return ""
    with plain:
        why = _shake(plain, context, held.peers if peers is None else peers)
    return f"{endpoint}: {why}" if why else ""


def _context(held: credentials.Credentials) -> ssl.SSLContext:
    import ssl  # takes long on a small board, and is needed only when something is wrong

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False  # names in certificates are ours, not the network's
    context.load_verify_locations(held.folder / credentials.AUTHORITIES)
    context.load_cert_chain(held.folder / credentials.CERTIFICATE, held.folder / credentials.KEY)
    return context


def _shake(plain: socket.socket, context: ssl.SSLContext, peers: Sequence[str]) -> str:
    import ssl

    try:
        with context.wrap_socket(plain) as spoken:
            name = _common_name(spoken)
            if name not in peers:
                return f"its certificate is {name or 'nobody'}'s, who is not on this machine's list"
            with contextlib.suppress(TimeoutError):
                spoken.recv(1)
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in (_EXPIRED, _NOT_YET_VALID):
            now = time.strftime("%Y-%m-%d", time.gmtime())
            when = "has expired" if error.verify_code == _EXPIRED else "is not valid yet"
            return f"by this machine's clock ({now}) its certificate {when}"
        return "its certificate is another authority's"
    except ssl.SSLError as error:
        reason = error.reason or ""
        for alert, words in _ALERTS.items():
            if reason.endswith(alert):
                return words
        if "ALERT" in reason:
            return f"it ends the handshake: {reason.lower().replace('_', ' ')}"
        return "it has no certificate: what answers there speaks no TLS"
    except TimeoutError:
        return "it has no certificate: what answers there speaks no TLS"
    except OSError:  # cut off, as by a ground station that is just going
        return ""
    return ""


def _common_name(spoken: ssl.SSLSocket) -> str:
    subject: Any = (spoken.getpeercert() or {}).get("subject", ())
    names = [value for part in subject for key, value in part if key == "commonName"]
    return str(names[0]) if names else ""
