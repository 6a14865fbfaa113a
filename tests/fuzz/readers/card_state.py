"""What a card keeps about itself: releases on trial, restarts, provisioning's outcome."""

from __future__ import annotations

from pathlib import Path

from pieces import Picker, as_json, changed, scratch, stretch

from deploy.board import light
from deploy.board.releases import choose, places
from pi_firmware import release
from pi_firmware.health import restarts

_ROOT = scratch("card")
_AT = places.Places(_ROOT)
_AT.releases.mkdir(parents=True)
_AT.trial.parent.mkdir(parents=True, exist_ok=True)
_STATE = _ROOT / "restarts.json"
_NETIF = _ROOT / "run/systemd/netif"
_NETIF.mkdir(parents=True)
_FOLDER = _AT.releases / "1.2"
_FOLDER.mkdir()
_TRIAL = {
    "schema": "blimp.trial/1", "id": "ab", "release": "1.2", "previous": "", "boot_id": "",
    "started_s": 1.0, "telemetry": True, "outcome": "healthy", "reason": "",
}  # fmt: skip
_MANIFEST = {"files": [["release.json", 3, "0" * 64]], "schema": "blimp.bundle/1"}
_TOLD = {"release": "1.2", "how": "update", "reason": "", "version": "0.1", "commit": "abc"}


def fuzz(data: bytes) -> None:
    """Damaged files are as absent ones: nothing raises, for who should fix it?"""
    picker = Picker(data)
    for path, like in (
        (_AT.trial, _TRIAL),
        (_AT.last, _TRIAL),
        (_FOLDER / choose.MANIFEST, _MANIFEST),
        (_FOLDER / choose.RELEASE, _TOLD),
        (_STATE, {"schema": restarts._SCHEMA, "without_frame": 1, "reboots_in_a_row": 1}),
    ):
        _write(path, picker, like)
    (_NETIF / "state").write_bytes(b"DNS=" + picker.block())
    state = choose.read_state(_AT)
    choice = choose.choose(state, lambda name: choose.size_fault(_AT, name))
    assert choice.how
    choose.size_fault(_AT, "1.2")
    restarts._read(_STATE)
    places.read(_STATE)
    assert len(light.name_servers(_ROOT)) <= 3
    release.of_environment({release.ENVIRONMENT: picker.block().decode("latin-1")})


def _write(path: Path, picker: Picker, like: dict[str, object]) -> None:
    text = picker.block() if picker.number(1) > 200 else as_json(changed(picker, like))
    path.write_bytes(text)


def seeds() -> list[bytes]:
    """All whole; some bytes that are none."""
    deep = b"\xff\xff\xff"
    return [
        bytes(40),
        b"\xff\5\0[1,2]" * 5,
        b"\0" * 10 + b"\xff\5\0[[1]]",
        bytes(60) + b"\x0b\x0010.0.0.1 ::1" + b"\2\0{}",
        stretch((1, deep), (5000, b"[")),
    ]
