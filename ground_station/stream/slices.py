"""What of H.264's headers tells which macroblocks a loss takes (ITU-T H.264, 7.3.2 and 7.3.3)."""

from __future__ import annotations

from dataclasses import dataclass

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
