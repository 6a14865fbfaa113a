"""What a build costs against its size: simulated campuses of so many images, each by itself.

Features are simulated (`simulator.campus`), so no picture is rendered and none is described; from
the choice of pairs on, everything is the build's own.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.geometry.alignment import align
from ground_station.map import colmap, store
from ground_station.mapping.construction.assembly import assemble
from ground_station.mapping.construction.dask_option import open_workers
from ground_station.mapping.construction.feature_file import FeatureFile
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.parts.reconstruction import reconstruct
from ground_station.mapping.construction.structure import adjust_and_filter
from ground_station.mapping.construction.verification import match
from ground_station.mapping.settings import MappingSettings
from ground_station.presentation.text import columns
from ground_station.simulator.campus import CAMERA, Campus, campus

_LOOK_S = 0.2
"""How often memory is looked at."""

Row = dict[str, Any]


def measured(
    sizes: Sequence[int], processes: Sequence[int], settings: MappingSettings
) -> Iterator[Row]:
    """A row for each size and way: 0 processes are threads of one, others Dask's on this machine.

    Each is built in a process of its own, so that its memory is known.
    """
    for dask in processes:
        for images in sizes:
            context = multiprocessing.get_context("spawn")
            with ProcessPoolExecutor(1, mp_context=context) as alone:
                yield alone.submit(build, images, dask, settings).result()


def build(images: int, dask: int, settings: MappingSettings) -> Row:
    """Builds a campus of so many images; what it took and how true it is."""
    made = campus(images, settings.seed)
    threads = settings.threads or os.cpu_count() or 1
    stage_s: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="bench-campus-") as folder, _memory() as peak:
        work = Path(folder)
        given = _images(made, work)
        before_s = _cpu_s()
        with open_workers(str(dask) if dask else None, threads, settings) as workers:
            start_s = time.monotonic()
            pairs = match(given, CAMERA, settings, workers)
            stage_s["match"] = time.monotonic() - start_s
            start_s = time.monotonic()
            structure = reconstruct(given, pairs, CAMERA, settings, threads, work, workers)
            stage_s["sfm"] = time.monotonic() - start_s
        start_s = time.monotonic()
        model = adjust_and_filter(structure.reconstruction, settings.sfm, threads)
        stage_s["refine"] = time.monotonic() - start_s
        start_s = time.monotonic()
        map_ = assemble(model, given, CAMERA, settings, "campus")
        colmap.write(colmap.from_arrays(model, CAMERA), work / "sparse")
        store.save_tables(work, map_)
        stage_s["write"] = time.monotonic() - start_s
    centres, truth = model.wTc[:, :3, 3], made.wTc[model.image_id - 1, :3, 3]
    off = np.linalg.norm(align(centres, truth, True).apply(centres) - truth, axis=1)
    return {
        "images": images,
        "processes": dask,
        "threads": threads,
        "registered": len(model.names),
        "pairs": len(pairs),
        "landmarks": len(model.position),
        "observations": len(model.point),
        "stage_s": {name: round(value, 2) for name, value in stage_s.items()},
        "total_s": round(sum(stage_s.values()), 2),
        "cpu_s": round(_cpu_s() - before_s, 2),
        "peak_gb": round(max(peak) / 1e9, 3),
        "ate_m": float(np.sqrt(np.mean(off**2))),
        "median_m": float(np.median(off)),
        "max_m": float(off.max()),
        "notes": structure.notes,
    }


def _images(made: Campus, folder: Path) -> Images:
    file, pixels = FeatureFile(folder), []
    for k, features in enumerate(made.features()):
        file.put(k, features)
        pixels.append(CAMERA.undistort_to_pinhole(features.keypoints_px))
    names = [f"{k:06d}" for k in range(len(pixels))]
    return Images(names, made.time_ns, file.close(), pixels)


def _cpu_s() -> float:
    """Of this process and of those that have ended."""
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in spent)


@contextlib.contextmanager
def _memory() -> Iterator[list[int]]:
    """The resident bytes of this process and of all it started, looked at while the block runs."""
    seen, done = [0], threading.Event()

    def look() -> None:
        while not done.wait(_LOOK_S):
            seen[0] = max(seen[0], _resident_bytes(os.getpid()))

    watch = threading.Thread(target=look, daemon=True)
    watch.start()
    try:
        yield seen
    finally:
        done.set()
        watch.join()


def _resident_bytes(root: int) -> int:
    """Of a process and all that descend from it."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has just ended
            # The name, in brackets, may hold anything; its parent comes second after it.
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            children.setdefault(parent, []).append(int(stat.parent.name))
    total, waiting = 0, [root]
    while waiting:
        number = waiting.pop()
        waiting += children.get(number, [])
        with contextlib.suppress(OSError):
            total += int(Path(f"/proc/{number}/statm").read_text().split()[1])
    return total * resource.getpagesize()


def table(rows: Sequence[Row]) -> list[str]:
    """Lines of plain text."""
    head = ["images", "by", "registered", "pairs", "match s", "sfm s", "refine s", "all s", "CPU s",
            "s an image", "peak GB", "ATE cm", "max cm"]  # fmt: skip
    cells = [
        [
            str(row["images"]),
            f"{row['processes']} processes" if row["processes"] else f"{row['threads']} threads",
            str(row["registered"]),
            str(row["pairs"]),
            *(f"{row['stage_s'][name]:.0f}" for name in ("match", "sfm", "refine")),
            f"{row['total_s']:.0f}",
            f"{row['cpu_s']:.0f}",
            f"{row['total_s'] / row['images']:.3f}",
            f"{row['peak_gb']:.2f}",
            f"{100 * row['ate_m']:.1f}",
            f"{100 * row['max_m']:.1f}",
        ]
        for row in rows
    ]
    return [
        *columns([head, *cells]),
        "",
        "simulated features of small pictures (no picture is rendered or described); ATE: RMSE of "
        "the centres after a similarity;",
        "peak: resident memory of the build's process and its workers together; CPU: of them all",
    ]
