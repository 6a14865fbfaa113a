"""Certificates that end soon, for those who want to see them end."""

from __future__ import annotations

import datetime
import shutil
from pathlib import Path

from ground_station.keys.authority import Authority
from ground_station.keys.certificates import Pair, make_certificate


def certify(authority: Authority, name: str, to: Path, lasts: datetime.timedelta) -> Path:
    """A copy of a member's folder whose certificate, of the same authority, ends then."""
    shutil.copytree(authority.of(name), to)
    signer = authority.folder / "authorities"
    pair = make_certificate(
        name,
        Pair((signer / "1.pem").read_bytes(), (signer / "1.key").read_bytes()),
        (datetime.datetime.now(datetime.UTC) + lasts).replace(microsecond=0),
    )
    (to / "certificate.pem").write_bytes(pair.certificate)
    (to / "key.pem").write_bytes(pair.key)
    return to
