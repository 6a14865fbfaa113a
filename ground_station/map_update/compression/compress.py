"""`compress_map`: fewer landmarks, shorter descriptors, tables in less bytes."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.errors import MapError
from ground_station.map import colmap, store
from ground_station.map.descriptors import Descriptors, joined
from ground_station.map.folder import carry_floorplan, check_target, replacing
from ground_station.map.model import model_of
from ground_station.map.observations import landmarks_sha256
from ground_station.map.refined import Refined
from ground_station.map.sizes import sizes
from ground_station.map_update.compression import codes
from ground_station.map_update.compression.choice import METHODS, choose

Indices = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Compression:
    """What is wanted.

    `landmarks`: a share of them up to 1, or their number; `descriptor_bytes` of each, 0: as they
    are, None: `codes.usual_bytes`; `sights`: the COLMAP model keeps its tracks, which the tables
    hold as well; `method` is one of `choice.METHODS`; `seed` of the words' first draw (and of the
    method `random`).
    """

    landmarks: float = 0.5
    descriptor_bytes: int | None = None
    sights: bool = False
    method: str = "coverage"
    seed: int = 0

    def count(self, total: int) -> int:
        """How many of `total` landmarks are kept; raises `MapError` when that cannot be."""
        wanted = self.landmarks
        if not (math.isfinite(wanted) and wanted > 0):
            raise MapError(f"--landmarks is {wanted:g}; a share above 0 or a number is needed")
        if wanted > 1 and wanted != int(wanted):
            raise MapError(f"--landmarks is {wanted:g}; above 1 it is a number of landmarks")
        if wanted > total:
            raise MapError(f"--landmarks is {wanted:g}; the map has {total}")
        return int(wanted) if wanted > 1 else max(1, round(wanted * total))


def compress_map(
    folder: str | Path, out: str | Path, wanted: Compression
) -> tuple[store.Map, dict[str, Any]]:
    """A smaller map of the one in `folder`, written to `out`, and a report of plain values.

    Nothing moves: what is kept has the places, ids and keyframes that it had, so flights localized
    in the old map can still refine the new one. The localizer reads it as any other. Raises
    `MapError` for what cannot be done.
    """
    folder, out = Path(folder), Path(out)
    if out.resolve() == folder.resolve():
        raise MapError(f"--out {out}: is the map itself; a compressed map is another one")
    check_target(out.absolute())
    map_ = store.load(folder)
    if not len(map_.landmarks) or not len(map_.keyframes.landmark):
        raise MapError(f"{folder}: it has no landmarks that a keyframe saw")
    each = wanted.descriptor_bytes
    if each is None:
        each = codes.usual_bytes(map_.info.dimension)
    if wanted.method not in METHODS:
        raise MapError(f"there is no method '{wanted.method}' (known: {', '.join(METHODS)})")
    if each < 0:
        raise MapError(f"{each} bytes a descriptor; 0 or more are needed")
    kept = choose(map_, wanted.count(len(map_.landmarks)), wanted.method, wanted.seed)
    smaller = subset(map_, kept)
    modes = [0 if m.modes is None else len(m.modes) for m in (map_, smaller)]
    told: dict[str, Any] = {
        "method": wanted.method,
        "landmarks_before": len(map_.landmarks),
        "landmarks": len(kept),
        "sights_before": len(map_.keyframes.landmark),
        "sights": len(smaller.keyframes.landmark),
        "modes_before": modes[0],
        "modes": modes[1],
        "seed": wanted.seed,
    }
    if each:
        off = _code(smaller, each, wanted.seed)
        told["descriptor_bytes"] = each
        told["descriptor_error"] = float(f"{off:.4g}")
    smaller.info = _info(map_, out.absolute().name, told)
    with replacing(out) as part:
        carry_floorplan(folder, part)
        model = model_of(smaller)
        if not wanted.sights:
            none = slice(0, 0)
            rows = ("image", "feature", "point", "pixel_px")
            model = dataclasses.replace(
                model, **{name: getattr(model, name)[none] for name in rows}
            )
        colmap.write(colmap.from_arrays(model, map_.info.camera), part / "sparse")
        store.save_tables(part, smaller)
    before, after = _in_keyframes(map_), _in_keyframes(smaller)
    report = told | {
        "in_keyframe_before": before,
        "in_keyframe": after,
        "bytes_before": sizes(folder),
        "bytes": sizes(out),
    }
    return store.load(out), report


def _code(map_: store.Map, each: int, seed: int) -> float:
    """Makes a map's descriptors codes, those of its modes of the same words; their RMS error."""
    lm, modes = map_.landmarks, map_.modes
    whole = lm.descriptor if modes is None else joined(lm.descriptor, modes.descriptor)
    coded = codes.code(whole, each, seed)
    if modes is not None:
        map_.modes = dataclasses.replace(modes, descriptor=coded.rows(slice(len(lm), None)))
    lm.descriptor = coded.rows(slice(0, len(lm)))
    return codes.error(whole, coded)


def subset(map_: store.Map, kept: Indices) -> store.Map:
    """The map with some of its landmarks (N,), in order, their modes, and all of its keyframes."""
    lm, kf = map_.landmarks, map_.keyframes
    names = [field.name for field in dataclasses.fields(store.Landmarks)]
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
    info = store.MapInfo(**vars(map_.info))
    return store.Map(info, store.Landmarks(**rows), keyframes, map_.folder, modes)


def _info(map_: store.Map, name: str, told: dict[str, Any]) -> store.MapInfo:
    past = Refined.of(map_)
    hashes = dict.fromkeys([*past.landmarks_sha256, landmarks_sha256(map_.landmarks)])
    return dataclasses.replace(
        map_.info,
        name=name,
        format=store.COMPACT,
        refined=dataclasses.replace(past, landmarks_sha256=list(hashes)).as_dict(),
        compressed={"map": map_.info.name, **told},
    )


def _in_keyframes(map_: store.Map) -> dict[str, int]:
    """The landmarks of the keyframe that has fewest, and of the median one."""
    count = np.diff(map_.keyframes.offset)
    return {"fewest": int(count.min()), "median": round(float(np.median(count)))}
