"""`deploy.flash.image`: block maps in XML, with the checksum that they carry over themselves."""

from __future__ import annotations

import hashlib

from pieces import Picker, refusing, scratch, stretch, with_a_line

from deploy.errors import DeployError
from deploy.flash import image

_FILE = scratch("bmap") / "image.bmap"
_SIZE = 8192
_SUM = b"0" * 64
_MAP = b"""<?xml version="1.0" ?>
<bmap version="2.0">
<ImageSize> 8192 </ImageSize>
<BlockSize> 4096 </BlockSize>
<BlocksCount> 2 </BlocksCount>
<ChecksumType> sha256 </ChecksumType>
<BmapFileChecksum> %s </BmapFileChecksum>
<BlockMap>
<Range chksum="%s"> 0-0 </Range>
</BlockMap>
</bmap>
""" % (_SUM, b"a" * 64)


def fuzz(data: bytes) -> None:
    """Stretches that are taken lie in the image, in order."""
    content = with_a_line(Picker(data), _MAP)
    own = hashlib.sha256(content).hexdigest().encode()
    _FILE.write_bytes(content.replace(_SUM, own, 1))
    with refusing(DeployError):
        end = 0
        for stretch_ in image.read_map(_FILE, _SIZE):
            assert end <= stretch_.start < stretch_.stop <= _SIZE
            end = stretch_.stop


def seeds() -> list[bytes]:
    """A whole one; ranges that are not; entities."""
    entities = b'<!DOCTYPE b [<!ENTITY a "xxxxxxxxxx"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>'
    return [
        b"\xff" + _MAP,
        b'\x08<Range chksum="' + b"a" * 64 + b'"> 1-0 </Range>',
        b'\x08<Range chksum="' + b"a" * 64 + b'"> 0-1 </Range>',
        b"\0" + entities,
        b"\3<BlockSize> 999999999999999999 </BlockSize>",
        b"\xff\xff\xfe<\0b\0",
        stretch((1, b"\xff"), (50_000, b"<bmap>")),
        stretch((1, b"\x08<Range>"), (200_000, b"1")),
        stretch((1, b"\1<bmap "), (20_000, b"a='' ")),
    ]
