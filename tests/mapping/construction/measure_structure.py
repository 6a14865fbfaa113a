"""Not a test: how right and how fast builds are, beside plain COLMAP; prints one table.

    .venv/bin/python tests/mapping/construction/measure_structure.py redkitchen corridor atrium \\
        [--methods] [--flights out/cache/flights] [--seed N] [--json FILE]

`redkitchen`: ../shared/data/redkitchen, frames 0:500:5; our whole build, cache off, against
pycolmap's own SIFT, exhaustive matching and incremental mapping, in one run. `corridor`: the
simulated corridor of equal bays; plain COLMAP on the same verified pairs beside ours. `atrium`: 500
frames of the simulated hall, registered then by six points told with 5 cm of noise. Flights are
rendered once. `--methods` solves each row's pairs by the incremental and by the global method. The
truth is looked at only to print how far off a map is.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command sets it

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "registration"))
from surveyed_points import six_points

from ground_station.files import write_json
from ground_station.geometry.alignment import align
from ground_station.geometry.camera import Camera, load_camera
from ground_station.geometry.trajectory import Trajectory, read_tum
from ground_station.map import colmap
from ground_station.map.table import print_table
from ground_station.mapping.construction import structure
from ground_station.mapping.construction.build import build_map
from ground_station.mapping.construction.images import Images, extract
from ground_station.mapping.construction.verification import match
from ground_station.mapping.registration.observations import read_pairs
from ground_station.mapping.settings import MappingSettings, load_settings
from ground_station.mapping.sfm import global_mapping
from ground_station.mapping.sfm.database import write_database
from ground_station.mapping.sfm.incremental import Incremental, Wanted, pipeline_options
from ground_station.progress import Progress
from ground_station.recording.flight import trajectory_of
from ground_station.recording.open import open_input, parse_range
from ground_station.simulator.simulate import SimulationSettings, simulate
from pi_firmware.wire.recording import TRUTH_TOPIC

pycolmap = colmap.pycolmap

DATA = Path(__file__).parents[3] / "../shared/data/redkitchen"
RANGE = "0:500:5"
THREADS = os.cpu_count() or 1
OFF_M = 0.10
SAME_NS = 1_000_000
DRAWS = 20

Row = dict[str, Any]


@contextmanager
def timed(row: Row, name: str):  # type: ignore[no-untyped-def]
    """Adds the wall time and the processor's of a block to a row, seconds."""
    wall, cpu = time.monotonic(), time.process_time()
    yield
    row[f"{name}_s"] = round(time.monotonic() - wall, 1)
    row[f"{name}_cpu_s"] = round(time.process_time() - cpu, 1)


def errors_m(time_ns: np.ndarray, centres: np.ndarray, truth: Trajectory) -> np.ndarray:
    """Distances of camera centres (K, 3) to the truth after Sim(3), of those that it has (J,).

    Fitted to the half that fits best, so that images in a wrong place do not drag the others along.
    """
    nearest = np.array([truth.nearest(int(t)) for t in time_ns])
    known = np.abs(truth.time_ns[nearest] - time_ns) <= SAME_NS
    x, y = centres[known], truth.position_m[nearest[known]]
    used = np.ones(len(x), dtype=bool)
    for _ in range(30):
        off = np.linalg.norm(align(x[used], y[used], True).apply(x) - y, axis=1)
        used = off <= max(4 * float(np.median(off)), 1e-9)
    return off


def judged(name: str, time_ns: np.ndarray, centres: np.ndarray, truth: Trajectory) -> Row:
    """The figures of one map."""
    off = errors_m(time_ns, centres, truth)
    # All of them count in the RMSE, and in its fit.
    nearest = [truth.nearest(int(t)) for t in time_ns]
    known = np.abs(truth.time_ns[nearest] - time_ns) <= SAME_NS
    x, y = centres[known], truth.position_m[np.array(nearest)[known]]
    every = np.linalg.norm(align(x, y, True).apply(x) - y, axis=1)
    return {
        "map": name,
        "registered": len(centres),
        "compared": len(off),
        "median_m": round(float(np.median(off)), 4),
        "rmse_m": round(float(np.sqrt(np.mean(every**2))), 4),
        "max_m": round(float(off.max()), 4),
        f"off_by_{OFF_M:g}_m": int(np.count_nonzero(off > OFF_M)),
    }


def of_model(name: str, images: Images, model: Any, truth: Trajectory) -> Row:
    """The figures of a reconstruction of images."""
    found = colmap.to_arrays(model)
    return judged(name, images.time_ns[found.image_id - 1], found.wTc[:, :3, 3], truth)


def flight(
    folder: Path, scene: str, plan: str, rate_hz: float, duration_s: float, seed: int
) -> Path:
    """A flight at noon, rendered when it is not there yet."""
    path = folder / f"{scene}-{plan}-noon-{seed}-{duration_s:g}-{rate_hz:g}hz.mcap"
    if not (path.exists() and points_of(path).exists()):
        wanted = SimulationSettings(
            out=path, scene=scene, plan=plan, light="noon", seed=seed, rate_hz=rate_hz,
            duration_s=duration_s, points=points_of(path),
        )  # fmt: skip
        with Progress(f"{path.name}, frames", None) as progress:
            simulate(wanted, lambda done, total: progress.step(total))
    return path


def points_of(flight: Path) -> Path:
    """Where the observations of a flight's surveyed points are."""
    return flight.with_suffix(".points.csv")


def pairs_of(path: Path, settings: MappingSettings, frames: str | None, camera: Camera | None):  # type: ignore[no-untyped-def]
    """Images, verified pairs and the camera of an input."""
    source = open_input(path, 30.0, parse_range(frames) if frames else None)
    camera = camera or source.camera
    assert camera is not None
    images = extract(source, camera, settings, THREADS, source.count())
    return images, match(images, camera, settings, THREADS), camera


def methods(images: Images, pairs: Any, camera: Camera, truth: Trajectory, seed: int) -> list[Row]:
    """Incremental and global structure from motion of the same pairs, adjusted and filtered."""
    rows = []
    wanted = Wanted(seed, THREADS, 1.5, len(images.names))
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        database = work / "database.db"
        write_database(database, camera, images.names, images.pinhole_px, pairs)
        solvers: dict[str, Callable[[], Any]] = {
            "incremental": lambda: Incremental(database, work / "i", wanted, lambda: None).run(),
            "global": lambda: global_mapping.reconstruct(database, work / "g", wanted),
        }
        for name, solve in solvers.items():
            timing: Row = {}
            with timed(timing, "sfm"):
                models = solve()
            if models:
                model = max(models, key=lambda model: model.num_reg_images())
                structure.adjust_and_filter(model, load_settings().sfm, THREADS)
                rows.append(of_model(f"by the {name} method", images, model, truth) | timing)
    return rows


def redkitchen(_: Path, with_methods: bool, __: int) -> list[Row]:
    """Our build against pycolmap's own, of 100 frames."""
    settings, camera = load_settings(), load_camera(DATA / "camera.toml")
    truth = read_tum(DATA / "pseudo_groundtruth.txt")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        timing: Row = {}
        source = open_input(DATA / "frames", 30.0, parse_range(RANGE))
        with timed(timing, "build"):
            map_ = build_map(source, camera, settings, Path(folder) / "map", total=source.count())
        frames = map_.keyframes
        rows.append(
            judged("redkitchen", frames.time_ns, frames.wTc[:, :3, 3], truth)
            | timing
            | map_.info.built["stage_s"]
        )
        rows.append(_pycolmaps_own(Path(folder) / "own", camera, truth))
    rows[0]["share_of_time"] = round(rows[0]["build_s"] / rows[1]["build_s"], 3)
    if with_methods:
        images, pairs, _ = pairs_of(DATA / "frames", settings, RANGE, camera)
        rows += methods(images, pairs, camera, truth, settings.seed)
    return rows


def _pycolmaps_own(work: Path, camera: Camera, truth: Trajectory) -> Row:
    """pycolmap's SIFT, exhaustive matching and incremental mapping, with its own settings."""
    chosen = sorted((DATA / "frames").iterdir())[0:500:5]
    pictures = work / "pictures"
    pictures.mkdir(parents=True)
    for path in chosen:
        shutil.copy(path, pictures)
    colmap.quiet()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "OPENCV"
    reader.camera_params = ",".join(
        f"{value:.8g}"
        for value in (
            camera.fx_px, camera.fy_px, camera.cx_px + 0.5, camera.cy_px + 0.5,
            camera.k1, camera.k2, camera.p1, camera.p2,
        )
    )  # fmt: skip
    timing: Row = {}
    with timed(timing, "build"):
        with timed(timing, "features"):
            pycolmap.extract_features(
                work / "db", pictures, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
            )
        with timed(timing, "match"):
            pycolmap.match_exhaustive(work / "db")
        with timed(timing, "sfm"):
            models = pycolmap.incremental_mapping(work / "db", pictures, work)
    model = max(models.values(), key=lambda model: model.num_reg_images())
    ids = sorted(model.reg_image_ids())
    centres = np.array([model.images[k].cam_from_world().inverse().translation for k in ids])
    number = [int(Path(model.images[k].name).stem.rpartition("-")[2]) for k in ids]
    time_ns = np.array([round(k / 30 * 1e9) for k in number])
    return judged("redkitchen, pycolmap's own", time_ns, centres, truth) | timing


def corridor(flights: Path, with_methods: bool, seed: int) -> list[Row]:
    """Equal bays: what COLMAP makes of our pairs, and what we make of them."""
    settings = load_settings()
    path = flight(flights, "corridor", "corridor", 2.0, 105.0, seed)
    truth = trajectory_of(path, TRUTH_TOPIC, [])
    images, pairs, camera = pairs_of(path, settings, None, None)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        database = work / "database.db"
        write_database(database, camera, images.names, images.pinhole_px, pairs)
        wanted = Wanted(settings.seed, THREADS, 1.5, len(images.names))
        timing: Row = {}
        with timed(timing, "sfm"):
            models = pycolmap.incremental_mapping(database, work, work, pipeline_options(wanted))
        sizes = sorted((model.num_reg_images() for model in models.values()), reverse=True)
        model = max(models.values(), key=lambda model: model.num_reg_images())
        structure.adjust_and_filter(model, settings.sfm, THREADS)
        plain = of_model("corridor, plain COLMAP", images, model, truth)
        rows.append(plain | timing | {"models": str(sizes)})
        timing = {}
        with timed(timing, "sfm"):
            found = structure.reconstruct(images, pairs, camera, settings, THREADS, work / "ours")
        structure.adjust_and_filter(found.reconstruction, settings.sfm, THREADS)
        ours = of_model("corridor", images, found.reconstruction, truth)
        rows.append(ours | timing | {"models": str(found.sizes), "notes": "; ".join(found.notes)})
    rows[1]["images"], rows[1]["pairs"] = len(images.names), len(pairs)
    if with_methods:
        rows += methods(images, pairs, camera, truth, settings.seed)
    return rows


def atrium(flights: Path, with_methods: bool, seed: int) -> list[Row]:
    """500 frames of the hall."""
    settings = load_settings()
    path = flight(flights, "atrium", "mapping", 5.0, 100.0, seed)
    truth = trajectory_of(path, TRUTH_TOPIC, [])
    source = open_input(path, 30.0)
    assert source.camera is not None
    timing: Row = {}
    with tempfile.TemporaryDirectory() as folder:
        with timed(timing, "build"):
            map_ = build_map(
                source, source.camera, settings, Path(folder) / "map", total=source.count()
            )
        frames = map_.keyframes
        rows = [judged("atrium", frames.time_ns, frames.wTc[:, :3, 3], truth)]
        rows[0] |= timing | map_.info.built["stage_s"]
        rows[0]["notes"] = "; ".join(map_.info.built["notes"])
        true_m = truth.position_m[[truth.nearest(int(t)) for t in frames.time_ns]]
        drawn = six_points(map_, true_m, read_pairs(points_of(path)), DRAWS)
    rows[0]["by_six_points_median_m"] = round(float(np.median(drawn.median_m)), 4)
    rows[0]["by_six_points_covered"] = round(float(np.mean(drawn.covered)), 3)
    rows[0]["draws_covering_most"] = f"{np.sum(np.array(drawn.covered) >= 0.5)} of {DRAWS}"
    if with_methods:
        images, pairs, camera = pairs_of(path, settings, None, None)
        rows += methods(images, pairs, camera, truth, settings.seed)
    return rows


ROWS = {"redkitchen": redkitchen, "corridor": corridor, "atrium": atrium}


def main() -> int:
    """The rows asked for, one after the other."""
    parser = argparse.ArgumentParser()
    parser.add_argument("rows", nargs="+", choices=tuple(ROWS))
    parser.add_argument("--methods", action="store_true")
    parser.add_argument("--flights", type=Path, default=Path("out/cache/flights"))
    parser.add_argument("--seed", type=int, default=41, help="of the simulated flights")
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    done: list[Row] = []
    for name in args.rows:
        done += ROWS[name](args.flights, args.methods, args.seed)
        if args.json:
            write_json(args.json, {"threads": THREADS, "rows": done})
    for row in done:
        print()
        print_table(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
