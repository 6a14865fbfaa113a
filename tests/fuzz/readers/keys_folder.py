"""Certificates, keys and access lists in the folders that `blimp keys` writes."""

from __future__ import annotations

import contextlib

from pieces import Picker, as_json, changed, refusing, scratch, stretch

from deploy.errors import DeployError
from deploy.flash import keys as flash_keys
from ground_station.errors import KeysError
from ground_station.keys import certificates
from ground_station.keys.authority import Authority
from ground_station.stream.srtp import load_keys
from pi_firmware.wire import credentials, srtp
from pi_firmware.wire.errors import BlimpError

_FOLDER = scratch("keys")
(_FOLDER / "srtp").mkdir()
_ACCESS = {"schema": credentials.SCHEMA, "name": "payload.blimp-1", "peers": ["ground.station"]}
_AUTHORITY = {
    "schema": "blimp.authority/1", "members": {"payload.blimp-1": {"revoked": False, "days": 730}},
    "trusted": [1], "signing": 1, "step": 0,
}  # fmt: skip
_PEM = b"""-----BEGIN CERTIFICATE-----
MIIBVjCB/aADAgECAgEBMAoGCCqGSM49BAMCMAwxCjAIBgNVBAMMAWEwIBcNNzAw
MTAxMDAwMDAwWhgPMjA1MDAxMDEwMDAwMDBaMAwxCjAIBgNVBAMMAWEwWTATBgcq
-----END CERTIFICATE-----
"""


def fuzz(data: bytes) -> None:
    """Each reader's own error, and never the key in it."""
    picker = Picker(data)
    which = picker.number(1) % 6
    for name in (credentials.AUTHORITIES, credentials.CERTIFICATE, credentials.KEY):
        (_FOLDER / name).write_bytes(b"x")
    if which == 0:
        raw = picker.number(1) % 2
        text = picker.rest() if raw else as_json(changed(picker, _ACCESS))
        (_FOLDER / credentials.ACCESS).write_bytes(text)
        with refusing(BlimpError):
            credentials.tls_settings(credentials.load(_FOLDER))
        with contextlib.suppress(DeployError):
            flash_keys._access(_FOLDER, text)
    elif which == 1:
        (_FOLDER / srtp.KEY_FILE).write_bytes(picker.rest())
        with refusing(BlimpError):
            assert len(srtp.read_key(_FOLDER / srtp.KEY_FILE)) == srtp.MASTER_BYTES
    elif which == 2:
        for old in (_FOLDER / "srtp").iterdir():
            old.unlink()
        name = picker.block().hex()[:20] if picker.number(1) % 2 else "blimp-1"
        (_FOLDER / "srtp" / f"{name}.key").write_bytes(picker.rest())
        with refusing(BlimpError):
            load_keys(_FOLDER)
    elif which == 3:
        raw = picker.number(1) % 2
        text = picker.rest() if raw else as_json(changed(picker, _AUTHORITY))
        (_FOLDER / "authority.json").write_bytes(text)
        with refusing(KeysError, BlimpError):
            Authority(_FOLDER)
    elif which == 4:
        pem = picker.block()
        with refusing(KeysError):
            certificates.inspect(pem, picker.rest())
    else:
        pem = picker.block()
        with refusing(KeysError):
            certificates.check_key(certificates.Pair(pem, picker.rest()))


def seeds() -> list[bytes]:
    """One of each, and a certificate of an authority made for it."""
    import datetime

    until = datetime.datetime(2050, 1, 1, tzinfo=datetime.UTC)
    made = certificates.make_authority("a", until)
    size = len(made.certificate).to_bytes(2, "little")
    return [
        b"\0\0",
        b"\0\1" + as_json(_ACCESS),
        b"\1" + b"0f" * 30 + b"\n",
        b"\1" + "٣".encode() * 60,
        b"\2\0" + b"0f" * 30,
        b"\3\0",
        b"\3\1" + as_json({**_AUTHORITY, "step": 1e400}),
        b"\3\1" + as_json({**_AUTHORITY, "trusted": [float("inf")]}),
        b"\4" + size + made.certificate + made.certificate,
        b"\5" + size + made.certificate + made.key,
        b"\4" + len(_PEM).to_bytes(2, "little") + _PEM + _PEM,
        stretch((1, b"\0\1"), (5000, b"[")),
        stretch((1, b"\3\1"), (5000, b"[")),
    ]
