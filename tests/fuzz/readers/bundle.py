"""`deploy.board.releases`: the tar of an update and its list, before and after the signature."""

from __future__ import annotations

import io
import struct

from pieces import Picker, as_json, blocks, changed, refusing, stretch

from deploy.board.releases import manifest, receive
from deploy.errors import DeployError

_RELEASE = {
    "schema": "blimp.release/1", "version": "0.1.0+abc", "machine": "aarch64", "python": "cp313",
    "made": "2026-01-02T03:04:05Z",
}  # fmt: skip
_LIST = {
    "schema": "blimp.bundle/1",
    "release": _RELEASE,
    "replaces": "",
    "files": [["pi_firmware/__init__.py", 3, "0" * 64], ["pi_firmware/__main__.py", 3, "0" * 64]],
}
_MOST_BYTES = 1 << 22


def header(name: bytes, size: bytes, kind: bytes = b"0", mode: bytes = b"0000644\0") -> bytes:
    """A ustar header with the sum that it needs."""
    block = bytearray(512)
    block[: len(name[:100])] = name[:100]
    block[100:108] = mode.ljust(8, b"\0")[:8]
    block[124:136] = size.ljust(12, b"\0")[:12]
    block[156:157], block[257:265] = kind, b"ustar\00000"
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


def fuzz(data: bytes) -> None:
    """A tar from pieces with right sums, or bytes; and a list that was signed."""
    picker = Picker(data)
    how = picker.number(1) % 4
    if how == 3:
        with refusing(DeployError):
            text = picker.rest()
            found = manifest.parse(text)
            assert all(manifest.is_path(file.path) for file in found.files)
        return
    if how == 2:
        with refusing(DeployError):
            found = manifest.parse(as_json(changed(picker, _LIST)))
            assert found.size >= 0 and found.release.age >= ((0, 0, 0, 0), "")
        return
    content = picker.rest() if how else b""
    while not how and picker.left():
        name, size = picker.bytes(picker.number(1)), picker.bytes(picker.number(1) % 13)
        content += header(name, size, picker.of((b"0", b"0", b"0", b"1", b"5", b"x")))
        content += picker.block()
    with refusing(DeployError):
        for member in receive.members(io.BytesIO(content)):
            assert sum(map(len, member.chunks())) == member.size <= _MOST_BYTES


def seeds() -> list[bytes]:
    """A tar of one file, lists, paths that lead out."""
    name = b"manifest.json"
    body = b"abc".ljust(512, b"\0") + bytes(1024)
    whole = bytes([len(name)]) + name + bytes([11]) + b"00000000003" + b"\0" + blocks(body)
    escaping = {**_LIST, "files": [["pi_firmware/../../etc/x", 3, "0" * 64]]}
    huge = as_json({**_LIST, "files": [["pi_firmware/__main__.py", 10**4000, "0" * 64]]})
    return [
        b"\0" + whole,
        b"\1" + header(name, b"00000000003\0") + body,
        b"\2",
        b"\3" + as_json(_LIST),
        b"\3" + as_json(escaping),
        b"\3" + huge[:4000],
        b"\0" + bytes([4]) + b"a/..\x0b77777777777" + b"\0" + struct.pack("<H", 0),
        stretch((1, b"\3"), (5000, b"[")),
        stretch((1, b'\3{"schema":"blimp.bundle/1","files":['), (20_000, b"[[]],"), (1, b"0]}")),
    ]
