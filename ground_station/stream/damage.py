"""Which parts of a picture a loss took, and where motion carried them since.

What is not marked is the picture that was sent, bit for bit. Of a slice that was cut FFmpeg decodes
on into garbage and tells neither where it began nor, for all it conceals, what it decoded. So the
slice is decoded twice more, in decoders of its own, with zeros and with ones behind the cut: what
both decode alike stands before it, as whatever was sent lies between the two (arithmetic decoding
keeps the order of its input, and of a code word that is cut zeros and ones make two others).
"""

from __future__ import annotations

from dataclasses import dataclass

import av
import numpy as np
from numpy.typing import NDArray

from ground_station.arrays import F64, I64, Bools
from pi_firmware.wire import annexb

_HEADER_BYTES = 64
"""More than what is read of a header takes, scaling lists and offsets of picture order aside."""
_WITH_CHROMA_FORMAT = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}
_P, _I = 0, 2
_MOST_MACROBLOCKS = 139_264
"""Of a picture (table A-1)."""


@dataclass(frozen=True)
class ParameterSets:
    """What an SPS and a PPS say of a stream of whole pictures in raster order.

    `width` and `height` in macroblocks; `references` how many pictures one may be predicted from;
    `frame_num_bits` the bits of a slice's `frame_num`; `units` are both as they came.
    """

    width: int
    height: int
    references: int
    frame_num_bits: int
    units: tuple[bytes, ...]


@dataclass(frozen=True)
class SliceHeader:
    """The beginning of a slice; `frame_num_at` is where that stands, in bits of the unit's RBSP."""

    first_macroblock: int
    frame_num: int
    frame_num_at: int
    idr: bool


class _Bits:
    """Reads a header; raises `ValueError` at its end."""

    def __init__(self, unit: bytes) -> None:
        rbsp = annexb.unescape(unit[1 : 1 + _HEADER_BYTES])
        self._bits = "".join(f"{byte:08b}" for byte in rbsp)
        self.at = 0

    def u(self, count: int) -> int:
        """`u(n)`."""
        self.at += count
        if self.at > len(self._bits):
            raise ValueError("the header is cut")
        return int(self._bits[self.at - count : self.at] or "0", 2)

    def ue(self) -> int:
        """`ue(v)` (9.1)."""
        zeros = 0
        while not self.u(1):
            zeros += 1
        return (1 << zeros) - 1 + self.u(zeros)


def parameter_sets(access_unit: bytes) -> ParameterSets | None:
    """Those of an access unit with one SPS and one PPS.

    None for another number of them, and for streams of fields, slice groups, with scaling lists or
    without CABAC: of a macroblock that was cut in CAVLC FFmpeg adds what it had read to the next
    picture.
    """
    units = list(annexb.nal_units(access_unit))
    sps = [unit for unit in units if annexb.nal_type(unit) == annexb.NAL_SPS]
    pps = [unit for unit in units if annexb.nal_type(unit) == annexb.NAL_PPS]
    if len(sps) != 1 or len(pps) != 1:
        return None
    try:
        return _read(sps[0], pps[0])
    except ValueError:
        return None


def _read(sps_unit: bytes, pps_unit: bytes) -> ParameterSets | None:
    sps, pps = _Bits(sps_unit), _Bits(pps_unit)
    profile = sps.u(8)
    sps.u(16)  # constraints and level
    sps.ue()
    if profile in _WITH_CHROMA_FORMAT:
        chroma_format = sps.ue()
        if chroma_format == 3 and sps.u(1):
            return None  # three pictures in one
        sps.ue(), sps.ue(), sps.u(1)  # depths, transform bypass
        if sps.u(1):
            return None
    frame_num_bits = sps.ue() + 4
    order = sps.ue()
    if order == 0:
        sps.ue()
    elif order == 1:
        sps.u(1), sps.ue(), sps.ue()
        for _ in range(sps.ue()):
            sps.ue()
    references = sps.ue()
    sps.u(1)
    width, height = sps.ue() + 1, sps.ue() + 1
    whole_frames = sps.u(1)
    sps.u(1)
    if sps.u(1):  # cropped: the picture has to begin with its first macroblock
        left, _, top = sps.ue(), sps.ue(), sps.ue()
        if left or top:
            return None
    pps.ue(), pps.ue()
    arithmetic = pps.u(1)
    pps.u(1)
    slice_groups = pps.ue()
    if not (arithmetic and whole_frames) or slice_groups:
        return None
    if frame_num_bits > 16 or references > 16 or width * height > _MOST_MACROBLOCKS:
        return None
    return ParameterSets(width, height, max(1, references), frame_num_bits, (sps_unit, pps_unit))


def slice_header(unit: bytes, sets: ParameterSets) -> SliceHeader | None:
    """The header of a slice of a P or I picture that others refer to; None for another unit."""
    kind = annexb.nal_type(unit)
    if kind not in (annexb.NAL_SLICE, annexb.NAL_IDR) or not unit[0] & 0x60:
        return None
    bits = _Bits(unit)
    try:
        first, slice_type = bits.ue(), bits.ue() % 5
        bits.ue()
        at = bits.at
        frame_num = bits.u(sets.frame_num_bits)
    except ValueError:
        return None
    if slice_type not in (_P, _I) or first >= sets.width * sets.height:
        return None
    return SliceHeader(first, frame_num, at, kind == annexb.NAL_IDR)


def with_frame_num(unit: bytes, header: SliceHeader, sets: ParameterSets, frame_num: int) -> bytes:
    """The slice with another `frame_num`."""
    rbsp = annexb.unescape(unit[1:])
    shift = 8 * len(rbsp) - header.frame_num_at - sets.frame_num_bits
    value = int.from_bytes(rbsp, "big") ^ (header.frame_num ^ frame_num) << shift
    return unit[:1] + annexb.escape(value.to_bytes(len(rbsp), "big"))


_CELL_PX, _CELLS = 4, 4
"""Damage is told in cells of H.264's smallest block, 4 by 4 to a macroblock."""
_ALIKE = 8
"""Macroblocks before the first one that differs that are not believed either: where little moves a
few may look alike by chance (measured: three at most at 300 kbit/s, none at 2,000)."""
_MAX_PIXELS = 1920 * 1088
"""A stranger's parameter sets must not make a decoder ask for gigabytes."""
_BEHIND = b"\xff" * 64
_BEFORE_PX, _AFTER_PX = 2, 3
"""What the luma's filter of six taps looks at beyond a block (H.264, 8.4.2.2.1)."""
_PART_PX = 8
"""Blocks of this size may be of parts whose motion FFmpeg does not tell: it lies within about the
same again."""


def open_decoder(**options: str) -> av.VideoCodecContext:
    """A decoder that paints over nothing, holds no picture back and tells motion vectors."""
    codec = av.CodecContext.create("h264", "r")
    assert isinstance(codec, av.VideoCodecContext)
    codec.thread_count = 1  # frame threads would hold pictures back
    codec.flags |= int(av.codec.context.Flags.low_delay)
    codec.options = {"ec": "0", "flags2": "+export_mvs", "max_pixels": str(_MAX_PIXELS), **options}
    return codec


def missing_rows(unit: bytes, idr: bytes, sets: ParameterSets) -> Bools | None:
    """Of an access unit of which packets are missing: which rows of macroblocks are (rows,).

    `idr` is a whole IDR of the same parameter sets. None: nothing of the picture is here.
    """
    pictures = []
    for tail in (b"", _BEHIND):
        made, is_idr = _alone(unit, sets, tail)
        codec = open_decoder(skip_loop_filter="all")
        try:
            if not is_idr:
                codec.decode(av.Packet(idr))
            (frame,) = codec.decode(av.Packet(made))
        except (av.FFmpegError, ValueError):  # ValueError: not exactly one picture
            return None
        if frame.format.name not in ("yuv420p", "yuvj420p"):
            return None
        pictures.append(
            [
                np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)[
                    : plane.height, : plane.width
                ]
                for plane in frame.planes
            ]
        )
    # A fresh decoder's pictures are zero, which no chroma that was decoded is.
    same = _all_of(pictures[0][1] != 0, annexb.MACROBLOCK_PX // 2)
    for with_zeros, with_ones, size in zip(*pictures, (16, 8, 8), strict=True):
        same &= _all_of(with_zeros == with_ones, size)
    if same.shape != (sets.height, sets.width):
        return None
    differs = np.flatnonzero(~same)
    missing = np.zeros(sets.height, bool)
    missing[differs // sets.width] = True
    missing[np.maximum(differs - _ALIKE, 0) // sets.width] = True
    return missing


def _alone(unit: bytes, sets: ParameterSets, tail: bytes) -> tuple[bytes, bool]:
    """The unit as it would follow an IDR at once, `tail` behind its slices; whether it is one."""
    made, is_idr = bytearray(), False
    for nal in annexb.nal_units(unit):
        header = slice_header(nal, sets)
        if header is not None:
            is_idr = header.idr
            nal = nal + tail if is_idr else with_frame_num(nal + tail, header, sets, 1)
        made += annexb.START_CODE + nal
    return bytes(made), is_idr


def _all_of(true: Bools, size: int) -> Bools:
    """Of each block of `size` samples (rows, columns) whether all are true."""
    for axis in (0, 1):
        true = np.logical_and.reduceat(true, np.arange(0, true.shape[axis], size), axis)
    return true


def carried(motion: NDArray[np.void], before: Bools, sets: ParameterSets) -> Bools:
    """The cells of a P picture (4 rows, 4 columns of a macroblock's) that rest on damaged ones.

    `motion` are FFmpeg's motion vectors of it, `before` the damaged cells of what it was predicted
    from. What is predicted inside the picture is damaged where what is around it is.
    """
    high, wide = before.shape
    w, h = motion["w"].astype(int), motion["h"].astype(int)
    x, y = motion["dst_x"] - w // 2, motion["dst_y"] - h // 2
    scale = np.maximum(motion["motion_scale"], 1)
    dx, dy = motion["motion_x"] / scale, motion["motion_y"] / scale
    part = np.where((w <= _PART_PX) & (h <= _PART_PX), _PART_PX, 0)

    def cells(first: F64, size: I64, most: int) -> tuple[I64, I64]:
        ends = first - _BEFORE_PX - part, first + size + _AFTER_PX + part
        low, end = (np.clip(px // _CELL_PX, 0, most - 1).astype(int) for px in ends)
        return low, end + 1

    left, right = cells(x + dx, w, wide)
    top, bottom = cells(y + dy, h, high)
    summed = np.zeros((high + 1, wide + 1), int)
    summed[1:, 1:] = before.cumsum(0).cumsum(1)
    touched = (
        summed[bottom, right] - summed[top, right] - summed[bottom, left] + summed[top, left]
    ) > 0  # fmt: skip
    corners = x // _CELL_PX, y // _CELL_PX, (x + w) // _CELL_PX, (y + h) // _CELL_PX
    damaged = _painted(corners, touched, high, wide)
    inter = _painted(corners, np.ones(len(x), bool), high, wide)
    for row, column in np.argwhere(~inter[::_CELLS, ::_CELLS]).tolist():
        r, c = _CELLS * row, _CELLS * column
        around = damaged[max(0, r - 1) : r + _CELLS, max(0, c - 1) : c + 2 * _CELLS]
        above, beside = around[: r > 0], around[r > 0 :, : c > 0]
        damaged[r : r + _CELLS, c : c + _CELLS] |= bool(above.any() or beside.any())
    return damaged


def _painted(corners: tuple[I64, ...], chosen: Bools, high: int, wide: int) -> Bools:
    """The cells of the chosen rectangles."""
    left, top, right, bottom = (np.clip(at[chosen], 0, limit) for at, limit in zip(
        corners, (wide, high, wide, high), strict=True))  # fmt: skip
    edges = np.zeros((high + 1, wide + 1), int)
    for r, c, by in ((top, left, 1), (top, right, -1), (bottom, left, -1), (bottom, right, 1)):
        np.add.at(edges, (r, c), by)
    return np.asarray(edges.cumsum(0).cumsum(1)[:high, :wide] > 0)


def blurred(damaged: Bools) -> Bools:
    """With the cells beside them, into which the loop filter carries three pixels (8.7)."""
    grown = damaged.copy()
    grown[1:] |= damaged[:-1]
    grown[:-1] |= damaged[1:]
    grown[:, 1:] |= damaged[:, :-1]
    grown[:, :-1] |= damaged[:, 1:]
    return grown


def of_macroblocks(cells: Bools) -> Bools:
    """Which macroblocks (rows, columns) have a damaged cell."""
    high, wide = cells.shape
    blocks = cells.reshape(high // _CELLS, _CELLS, wide // _CELLS, _CELLS)
    return np.asarray(blocks.any(axis=(1, 3)))
