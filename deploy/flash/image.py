"""A card image, checked before anything is written: whole, ours, and for this board.

Its block map (`.bmap`) says which blocks mean something, each range with its checksum: the format
of bmap-tools, https://github.com/yoctoproject/bmaptool. Its `bmaptool copy` is not used for
writing: it checks the image as it reads it, and never reads back what it wrote.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import lzma
import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree import ElementTree

from deploy.errors import DeployError
from deploy.flash.boot import BootPartition
from deploy.progress import Progress

CHUNK_BYTES = 4 << 20
_MAX_FILE_BYTES = 8 << 20
_MAX_BLOCK_BYTES = 1 << 20
_VALUES = ("ImageSize", "BlockSize", "ChecksumType", "BmapFileChecksum")
_NUMBER = re.compile(r"\d{1,18}", re.ASCII)
_RANGE = re.compile(r"(\d{1,18})(?:-(\d{1,18}))?", re.ASCII)
_SHA256 = re.compile(r"[0-9a-f]{64}", re.ASCII)


@dataclass(frozen=True)
class Stretch:
    """Bytes `start` to `stop` (without it) of an image; `sha256` of them, "" where not known."""

    start: int
    stop: int
    sha256: str = ""


def read_map(path: Path, image_bytes: int) -> list[Stretch]:
    """The stretches that a block map names, in order; raises `DeployError` with one line."""
    try:
        size = path.stat().st_size
        if size > _MAX_FILE_BYTES:
            raise DeployError(f"{path}: {size} bytes; allowed: {_MAX_FILE_BYTES}")
        data = path.read_bytes()
    except OSError as error:
        raise DeployError(f"{path}: {error.strerror or error}") from None
    try:
        return _mapped(data, image_bytes)
    except (ElementTree.ParseError, ValueError) as error:
        raise DeployError(f"{path}: not a block map: {' '.join(str(error).split())}") from None


def verify(file: BinaryIO, stretches: list[Stretch]) -> int | None:
    """Whether an image is the map's: its first byte that is not as the map says, or None.

    A map of another build leaves blocks out that matter, so what it leaves out must be zeros.
    """
    position = 0
    size = file.seek(0, os.SEEK_END)
    for stretch in [*stretches, Stretch(size, size)]:
        for start, data in chunks(file, Stretch(position, stretch.start), sparse=True):
            if data.count(0) != len(data):
                return start
        whole = hashlib.sha256()
        for _, data in chunks(file, stretch):
            whole.update(data)
        if stretch.sha256 and whole.hexdigest() != stretch.sha256:
            return stretch.start
        position = stretch.stop
    return None


def chunks(
    file: BinaryIO, stretch: Stretch, *, sparse: bool = False
) -> Iterator[tuple[int, bytes]]:
    """Offset and bytes of a stretch, piece by piece; `sparse` leaves a file's holes out."""
    position = stretch.start
    while position < stretch.stop:
        if sparse:
            try:
                position = os.lseek(file.fileno(), position, os.SEEK_DATA)
            except OSError:  # ENXIO: nothing but a hole up to the end
                return
            if position >= stretch.stop:
                return
        data = os.pread(file.fileno(), min(CHUNK_BYTES, stretch.stop - position), position)
        if not data:
            raise DeployError(f"the image ends at byte {position}: it was cut meanwhile")
        yield position, data
        position += len(data)


class _NoDoctype(ElementTree.TreeBuilder):
    """Refuses a document type, where entities are made."""

    def doctype(self, *_: object) -> None:
        raise ValueError("it declares a document type")


def _mapped(data: bytes, image_bytes: int) -> list[Stretch]:
    root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_NoDoctype()))
    if root.tag != "bmap":
        raise ValueError(f"<{root.tag[:30]}> is not expected there")
    values = {name: root.findtext(name, "").strip() for name in _VALUES}
    if (version := root.get("version", "")[:20])[:2] != "2.":
        raise ValueError(f"version {version!r}; expected 2.0")
    if values["ChecksumType"] != "sha256":
        raise ValueError("its checksums are not sha256")
    own = values["BmapFileChecksum"]
    # The map's own checksum is made over the file with zeros in the checksum's place.
    blank = data.replace(own.encode(), b"0" * len(own), 1)
    if not _SHA256.fullmatch(own) or hashlib.sha256(blank).hexdigest() != own:
        raise ValueError("its own checksum is wrong: it is cut or damaged")
    for name in ("ImageSize", "BlockSize"):
        if not _NUMBER.fullmatch(values[name]):
            raise ValueError(f"<{name}> is {values[name][:30]!r}")
    size, block = int(values["ImageSize"]), int(values["BlockSize"])
    if size != image_bytes:
        raise ValueError(f"it is of an image of {size} bytes, and this one has {image_bytes}")
    if not 512 <= block <= _MAX_BLOCK_BYTES or block % 512:
        raise ValueError(f"BlockSize is {block}; allowed: multiples of 512 to {_MAX_BLOCK_BYTES}")
    stretches: list[Stretch] = []
    end = 0
    for element in root.iterfind("BlockMap/Range"):
        text, checksum = (element.text or "").strip(), element.get("chksum", "").lower()
        match = _RANGE.fullmatch(text)
        if match is None or not _SHA256.fullmatch(checksum):
            raise ValueError(f"range {text[:40]!r} with checksum {checksum[:70]!r}")
        start, stop = int(match[1]) * block, (int(match[2] or match[1]) + 1) * block
        if start < end or stop <= start or stop >= size + block:
            raise ValueError(f"range {text!r} overlaps, is backwards or lies outside")
        end = stop
        stretches.append(Stretch(start, min(stop, size), checksum))
    if not stretches:
        raise ValueError("it names no block")
    return stretches


MANIFEST_SCHEMA = "blimp.image/1"
_SUM = re.compile(r"([0-9a-fA-F]{64})(?: [ *](.+))?", re.ASCII)


@dataclass(frozen=True)
class Image:
    """An image's bytes in a file that can be read anywhere, and which of them mean something."""

    path: Path
    file: BinaryIO
    size: int
    stretches: list[Stretch]
    boot: BootPartition
    board: str
    version: str


@contextlib.contextmanager
def opened(path: Path, *, checksum: bool, board: str = "") -> Iterator[Image]:
    """Opens and checks IMG or IMG.xz with the `.sha256` and `.bmap` beside it.

    Args:
        path: the image.
        checksum: whether a missing `.sha256` is refused; a wrong one always is.
        board: the one it must be for ("": any).

    Raises:
        DeployError: it is missing, cut, damaged, not ours or for another board.
    """
    with contextlib.ExitStack() as stack:
        try:  # of the image only: what goes wrong while it is used is told there
            source = stack.enter_context(open(path, "rb"))
            file = _checked(path, source, stack, checksum)
            size = file.seek(0, os.SEEK_END)
            boot = BootPartition.find(file.fileno(), path.name)
            manifest = _manifest(path)
            found, version = (str(manifest.get(key, "")) for key in ("board", "version"))
            if board and found != board:
                raise DeployError(
                    f"{path}: an image for {found or 'a board that no .manifest.json tells'};"
                    f" this card is to be for {board}"
                )
            image = Image(path, file, size, _stretches(path, file, size), boot, found, version)
        except OSError as error:
            hint = "; make image builds one" if isinstance(error, FileNotFoundError) else ""
            raise DeployError(f"{path}: {error.strerror or error}{hint}") from None
        yield image


def _checked(path: Path, source: BinaryIO, stack: contextlib.ExitStack, required: bool) -> BinaryIO:
    """The image's content as a file, unpacked where needed; raises on a wrong checksum."""
    packed = path.suffix == ".xz"
    wanted = _checksums(path)
    if not wanted and required:
        raise DeployError(
            f"{path}: no {path.name}.sha256 beside it to check it by (--no-checksum goes on)"
        )
    if not packed and not wanted:
        return source
    content, total = source, os.fstat(source.fileno()).st_size
    with Progress("unpacking" if packed else "checking", total) as progress:
        if packed:
            # Unnamed, so that nothing stays behind however this program ends.
            folder = os.environ.get("TMPDIR", "/var/tmp")
            unnamed = tempfile.TemporaryFile(dir=folder, prefix="blimp-")  # noqa: SIM115
            content = stack.enter_context(unnamed)
            sums = {path.name: _unpack(path, source, content, progress)}
            if path.stem in wanted:
                sums[path.stem] = _hash(content)
        else:
            sums = {path.name: _hash(source, progress)}
    for name, expected in wanted.items():
        if sums[name] != expected:
            raise DeployError(
                f"{path}: its checksum is wrong: {name} has {sums[name][:16]}…, expected"
                f" {expected[:16]}…; it is cut, damaged or another one"
            )
    return content


def _checksums(path: Path) -> dict[str, str]:
    """What the `.sha256` beside an image says, by the name it says it of; empty when there is none.

    Of a packed image either the file's own or its content's is there.
    """
    found = {}
    for subject in dict.fromkeys((path, _content_name(path))):
        place = _beside(subject, ".sha256")
        try:
            lines = place.read_text(errors="replace").splitlines()
        except FileNotFoundError:
            continue
        for match in filter(None, (_SUM.fullmatch(line.strip()) for line in lines)):
            if match[2] is None or Path(match[2]).name == subject.name:
                found[subject.name] = match[1].lower()
        if subject.name not in found:
            raise DeployError(f"{place}: it tells no checksum of {subject.name}")
    return found


def _hash(file: BinaryIO, progress: Progress | None = None) -> str:
    whole = hashlib.sha256()
    for _, data in chunks(file, Stretch(0, file.seek(0, os.SEEK_END))):
        whole.update(data)
        if progress is not None:
            progress.advance(len(data))
    return whole.hexdigest()


def _unpack(path: Path, source: BinaryIO, content: BinaryIO, progress: Progress) -> str:
    """Unpacks with holes where zeros are; gives the packed file's checksum."""
    whole = hashlib.sha256()
    unpacker = lzma.LZMADecompressor(format=lzma.FORMAT_XZ)
    try:
        while packed := source.read(CHUNK_BYTES):
            whole.update(packed)
            progress.advance(len(packed))
            data = packed
            while not unpacker.eof and (data or not unpacker.needs_input):
                piece = unpacker.decompress(data, CHUNK_BYTES)
                data = b""
                if piece.count(0) == len(piece):
                    content.seek(len(piece), os.SEEK_CUR)
                else:
                    content.write(piece)
    except lzma.LZMAError:
        raise DeployError(f"{path}: not an .xz file, or damaged") from None
    if not unpacker.eof:
        raise DeployError(f"{path}: the .xz file is cut")
    content.truncate(content.tell())
    content.flush()
    return whole.hexdigest()


def _stretches(path: Path, file: BinaryIO, size: int) -> list[Stretch]:
    """What must be written: what the map beside the image says, or all of it."""
    place = _beside(_content_name(path), ".bmap")
    if not place.is_file():
        return [Stretch(0, size)]
    stretches = read_map(place, size)
    wrong = verify(file, stretches)
    if wrong is not None:
        raise DeployError(
            f"{place}: not the map of this image (byte {wrong}); delete it, or build again"
        )
    return stretches


def _manifest(path: Path) -> dict[str, Any]:
    """The builder's description beside an image; empty where there is none."""
    place = _beside(_content_name(path), ".manifest.json")
    try:
        document = json.loads(place.read_bytes())
    except FileNotFoundError:
        return {}
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict) or document.get("schema") != MANIFEST_SCHEMA:
        raise DeployError(f"{place}: not of schema {MANIFEST_SCHEMA}")
    return document


def _beside(image: Path, suffix: str) -> Path:
    return image.with_name(image.name + suffix)


def _content_name(path: Path) -> Path:
    """Where the unpacked image would lie."""
    return path.with_suffix("") if path.suffix == ".xz" else path
