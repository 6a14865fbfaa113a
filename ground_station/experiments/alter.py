"""What happens to a flight's frames on their way, and to the landmarks of the map they meet."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from ground_station.arrays import U8, Bools, Indices
from ground_station.experiments.declaration import Alteration
from ground_station.geometry.camera import Camera
from ground_station.geometry.resizing import scaled
from ground_station.map.descriptors import Descriptors
from ground_station.map.store import Landmarks, Map, MapInfo
from ground_station.recording.frames import Frame
from pi_firmware.wire import annexb

PACKET_BYTES = 1200
"""Of video in an RTP packet, as the payload's packetizer makes them."""


def altered(
    frames: Iterable[Frame], alteration: Alteration, arrived: Bools | None = None
) -> Iterator[Frame]:
    """The frames that a localizer sees.

    `arrived` (n,) says of each frame of the flight, by its index, whether it could be decoded;
    None: all. Times, and the indices in the flight, stay.
    """
    start_ns: int | None = None
    for frame in frames:
        start_ns = frame.time_ns if start_ns is None else start_ns
        if frame.index % alteration.every or (arrived is not None and not arrived[frame.index]):
            continue
        yield replace(frame, image=_seen(frame, alteration, (frame.time_ns - start_ns) / 1e9))


def _seen(frame: Frame, alteration: Alteration, time_s: float) -> U8:
    image = frame.image
    if is_dark(alteration, time_s):
        image = np.zeros_like(image)
    if alteration.scale < 1:
        height, width = scaled_size(image.shape[1], image.shape[0], alteration.scale)[::-1]
        image = np.asarray(
            cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8
        )
    if alteration.blur_px > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), alteration.blur_px), np.uint8)
    return image


def told_ns(frame: Frame, alteration: Alteration, seed: int) -> int:
    """The time that the localizer is told, in the clock of the frame's own: off by chance."""
    off_s = alteration.stamp_error_s * np.random.default_rng((seed, frame.index)).standard_normal()
    return frame.time_ns + round(1e9 * off_s)


def is_dark(alteration: Alteration, time_s: float) -> bool:
    """Whether the lens is covered `time_s` after the flight's first frame."""
    return 0 <= time_s - alteration.dark_from_s < alteration.dark_s


def scaled_size(width_px: int, height_px: int, scale: float) -> tuple[int, int]:
    """Width and height of a picture at that scale, at least 16 px each."""
    return max(16, round(width_px * scale)), max(16, round(height_px * scale))


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """The camera of pictures at that scale."""
    if scale >= 1:
        return camera
    return scaled(camera, *scaled_size(camera.width_px, camera.height_px, scale))


def arrivals(units: Iterable[bytes], packet_loss: float, seed: int) -> Bools:
    """Which access units of an H.264 stream can be decoded when packets are lost one by one (n,).

    A unit goes in packets of `PACKET_BYTES`; one that misses a packet is useless, and so is all
    after it up to the next IDR, because each picture is predicted from the one before. A live link
    sends lost packets again and asks for an IDR, which a recording cannot: it loses far less.
    """
    rng = np.random.default_rng(seed)
    whole = False
    result = []
    for unit in units:
        packets = -(-len(unit) // PACKET_BYTES)
        complete = bool((rng.random(packets) >= packet_loss).all())
        whole = complete and (whole or annexb.is_idr(unit))
        result.append(whole)
    return np.array(result, dtype=bool)


def drawn(map_: Map, share: float, seed: int) -> Map:
    """The map with that share of its landmarks; by one seed, a smaller share is in a larger one."""
    total = len(map_.landmarks)
    order = np.random.default_rng(seed).permutation(total)
    return subset(map_, np.sort(order[: round(share * total)]))


def subset(map_: Map, kept: Indices) -> Map:
    """The map with some of its landmarks (N,), in order, their modes, and all of its keyframes."""
    lm, kf = map_.landmarks, map_.keyframes
    names = [field.name for field in dataclasses.fields(Landmarks)]
    rows = {name: getattr(lm, name)[kept] for name in names if name != "descriptor"}
    descriptor = lm.descriptor
    rows["descriptor"] = (
        descriptor.rows(kept) if isinstance(descriptor, Descriptors) else descriptor[kept]
    )
    place = np.full(len(lm), -1, np.int64)
    place[kept] = np.arange(len(kept))
    landmark = place[kf.landmark]
    left = landmark >= 0
    keyframes = dataclasses.replace(
        kf,
        offset=np.concatenate([[0], np.cumsum(left)])[kf.offset],
        landmark=landmark[left].astype(np.int32),
        pixel_px=kf.pixel_px[left],
    )
    modes = map_.modes.among(place >= 0) if map_.modes is not None else None
    info = MapInfo(**vars(map_.info))
    return Map(info, Landmarks(**rows), keyframes, map_.folder, modes)
