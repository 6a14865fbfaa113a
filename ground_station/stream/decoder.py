"""Access units into pictures, each with what a loss took of it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import av
import numpy as np
from numpy.typing import NDArray

from ground_station.arrays import Bools
from ground_station.recording.h264 import grey
from ground_station.stream import damage
from ground_station.stream.counters import Counters
from ground_station.stream.damage import ParameterSets, SliceHeader, parameter_sets, slice_header
from ground_station.stream.rtp import MAX_JUMP, AccessUnit
from pi_firmware.wire import annexb, sei

_OF_IDR = {annexb.NAL_SPS, annexb.NAL_PPS, annexb.NAL_IDR}


@dataclass(frozen=True)
class Picture:
    """Gray (H, W) uint8 of full range; `damaged` (rows, columns of macroblocks) is what is not as
    it was sent, None where all has come since the last IDR."""

    image: NDArray[np.uint8]
    damaged: Bools | None = None


class Decoder:
    """Decodes the access units of one stream, past losses as long as something is as it was sent.

    Decoders paint over what is missing and don't say so: what that is, and where motion carries it
    up to the next IDR, is kept here. Where a whole picture is missing, or that cannot be known,
    nothing is given out until that IDR.
    """

    def __init__(self, counters: Counters) -> None:
        self.saw_parameter_sets = False
        self._counters = counters
        self._trusted = False
        self._codec = damage.open_decoder()
        self._sets: ParameterSets | None = None
        self._idr = self._last = b""
        self._number: int | None = None
        self._damaged: deque[Bools] | None = None
        """Cells of the last pictures, of as many as one may be predicted from; None: none are."""

    def with_sets(self, unit: AccessUnit) -> AccessUnit:
        """The unit; with the parameter sets that are known where it is an IDR that lost its own.

        A payload's sets stay for as long as its stream: those of another begin far off.
        """
        if unit.complete or self._sets is None or unit.missing_before >= MAX_JUMP:
            return unit
        here = [*annexb.nal_units(unit.data)]
        sets = [nal for nal in here if annexb.nal_type(nal) in (annexb.NAL_SPS, annexb.NAL_PPS)]
        known = self._sets.units
        if len(sets) > 1 or not annexb.is_idr(unit.data) or not set(sets) <= set(known):
            return unit
        nals = (*known, *(nal for nal in here if nal not in sets))
        return replace(unit, data=b"".join(annexb.START_CODE + nal for nal in nals))

    def decode(self, unit: AccessUnit) -> Picture | None:
        """The picture; None when withheld."""
        missing = self._missing(unit)
        if not self._trusted:
            self._counters.withheld += 1
            return None
        try:
            (frame,) = self._codec.decode(av.Packet(unit.data))
            image = grey(frame)
            if self._damaged is not None:
                self._damaged.append(self._carried(frame, missing))
        except (av.FFmpegError, ValueError):  # ValueError: not exactly one picture
            self._counters.failed += 1
            self._trusted = False
            self._codec = damage.open_decoder()
            return None
        if self._damaged is None:
            return Picture(image)
        damaged = damage.of_macroblocks(self._damaged[-1])
        if damaged.all():
            self._trusted = False
            self._counters.withheld += 1
            return None
        return Picture(image, damaged)

    def _missing(self, unit: AccessUnit) -> Bools | None:
        """Which rows of its macroblocks are missing, None: none; settles whether it is trusted."""
        before, self._last = self._last, unit.data
        types = annexb.nal_types(unit.data)
        self._counters.idrs += not _OF_IDR.isdisjoint(types)
        if annexb.NAL_SPS in types and annexb.NAL_PPS in types:
            sets, self.saw_parameter_sets = parameter_sets(unit.data), True
            if sets != self._sets:
                self._sets, self._idr = sets, b""
        elif not unit.complete:
            types.clear()  # an IDR may be of other sets than are known
        if annexb.NAL_IDR in types and self.saw_parameter_sets:
            self._trusted, self._damaged = True, None
            if unit.complete:
                self._idr = unit.data
        elif self._trusted and unit.missing_before:
            self._trusted = self._sets is not None and _follows(before, unit, self._sets)
        if not self._trusted or unit.complete:
            return None
        missing = None
        if self._sets is not None:
            missing = damage.missing_rows(unit.data, self._idr, self._sets)
        if missing is None:
            self._trusted = False
        elif self._sets is not None and missing.any() and self._damaged is None:
            self._damaged = deque(maxlen=self._sets.references)
        return missing

    def _carried(self, frame: av.VideoFrame, missing: Bools | None) -> Bools:
        """The damaged cells of a picture."""
        assert self._sets is not None and self._damaged is not None
        cells = np.zeros((4 * self._sets.height, 4 * self._sets.width), bool)
        vectors = frame.side_data.get("MOTION_VECTORS")
        if self._damaged and vectors is not None:
            before = np.logical_or.reduce(list(self._damaged))
            cells = damage.carried(vectors.to_ndarray(), before, self._sets)
        elif self._damaged:
            cells[:] = True
        if missing is not None:
            cells |= np.repeat(missing, 4)[:, None]
        return damage.blurred(cells)


def _follows(before: bytes, unit: AccessUnit, sets: ParameterSets) -> bool:
    """Whether nothing is missing between two units but parts of them.

    The slices' `frame_num` counts the pictures (H.264, 7.4.3), but begins again with each IDR and
    every 16 or more; the SEI's number counts those as well that were never sent. One packet is less
    than a picture, which is sent with its SEI.
    """
    earlier, later = _first_slice(before, sets), _first_slice(unit.data, sets)
    if earlier is None or later is None or later.idr:
        return False
    if later.frame_num != (earlier.frame_num + 1) % (1 << sets.frame_num_bits):
        return False
    first, second = sei.find(before), sei.find(unit.data)
    if first is None or second is None:
        return unit.missing_before == 1
    step = second.sequence - first.sequence
    return step == 1 or (1 < step < 16 and earlier.frame_num != 0)


def _first_slice(access_unit: bytes, sets: ParameterSets) -> SliceHeader | None:
    headers = (slice_header(nal, sets) for nal in annexb.nal_units(access_unit))
    return next((header for header in headers if header is not None), None)
