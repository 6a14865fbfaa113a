"""The rooms' pictures on disk: made once, in parallel; what is there is not made again.

A shard is one file, written beside and renamed, and depends on nothing but the settings and its
number: a run that is killed loses the shards it was at.
"""

from __future__ import annotations

import json
import multiprocessing
import signal
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from ground_station import files
from ground_station.arrays import U8
from ground_station.progress import Progress
from ground_station.training.errors import TrainingError

VERSION = 2
"""Another one makes other pictures of the same settings."""
LIGHTS = 2
"""That each place of a room is drawn in."""
_WEBP_QUALITY = 88
"""A tenth of the bytes; a payload's encoder leaves less, and training compresses further."""


@dataclass(frozen=True)
class CorpusSettings:
    """What a corpus holds; more rooms may be asked for later."""

    seed: int = 1
    rooms: int = 40
    """The last one is held out."""
    places: int = 24
    """Of a room."""
    rows: int = 384
    columns: int = 512

    def __post_init__(self) -> None:
        """Raises `TrainingError` with one line for a number that makes no corpus."""
        limits = {
            "rooms": (0, 100_000), "places": (1, 200), "rows": (128, 2048), "columns": (128, 2048)
        }  # fmt: skip
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise TrainingError(f"{name} is {getattr(self, name)}; allowed: {low} to {high}")
        if self.rows % 32 or self.columns % 32:
            raise TrainingError(f"{self.columns}x{self.rows} px; both must be multiples of 32")

    def fixed(self) -> dict[str, Any]:
        """What must not change where there are shards already."""
        return {k: v for k, v in asdict(self).items() if k != "rooms"}


def shard_path(folder: Path, number: int) -> Path:
    """Where a room is."""
    return folder / f"room-{number:04d}.safetensors"


def _make_shard(settings: CorpusSettings, number: int, path: Path) -> None:
    """Draws and writes one room. Ctrl-C is for the process that started it: a shard is not cut."""
    from ground_station.training import rooms  # a machine that only trains need not render

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    size = (settings.rows, settings.columns)
    tensors: dict[str, U8] = {}
    for k, views in enumerate(
        rooms.views_of_room(settings.seed, number, settings.places, LIGHTS, size)
    ):
        for light, view in enumerate(views):
            coded = cv2.imencode(".webp", view, [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])[1]
            tensors[f"{k}.{light}"] = np.asarray(coded, np.uint8).ravel()
    files.write_bytes(path, save(tensors))


def make(folder: Path, settings: CorpusSettings, jobs: int) -> None:
    """Makes what is missing of a corpus, in `jobs` processes.

    Raises `TrainingError` where the folder holds one of other settings.
    """
    document = {"version": VERSION, "settings": settings.fixed()}
    note = folder / "corpus.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        known = json.loads(note.read_text()) if note.exists() else None
    except (OSError, ValueError) as error:
        raise TrainingError(f"{note}: {error}") from None
    if known is not None and known != document:
        raise TrainingError(f"{folder} holds a corpus of other settings")
    files.write_json(note, document)
    missing = [k for k in range(settings.rooms) if not shard_path(folder, k).exists()]
    if not missing:
        return
    with (
        Progress("rooms", len(missing)) as progress,
        ProcessPoolExecutor(min(jobs, len(missing)), multiprocessing.get_context("spawn")) as pool,
    ):
        futures = [pool.submit(_make_shard, settings, k, shard_path(folder, k)) for k in missing]
        try:
            for future in as_completed(futures):
                future.result()
                progress.step()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def read(folder: Path, number: int, size: tuple[int, int]) -> U8:
    """A room's pictures (places, lights, rows, columns); raises `TrainingError` naming the file."""
    path = shard_path(folder, number)
    try:
        coded = load_file(path)
        places = [
            np.stack([_decoded(coded[f"{k}.{light}"], size) for light in range(LIGHTS)])
            for k in range(len(coded) // LIGHTS)
        ]
    except (OSError, SafetensorError, KeyError, ValueError, cv2.error) as error:
        line = (str(error).splitlines() or [type(error).__name__])[0]
        raise TrainingError(f"{path}: {line}; without this file, --resume makes it again") from None
    return np.stack(places) if places else np.empty((0, LIGHTS, *size), np.uint8)


def _decoded(data: U8, size: tuple[int, int]) -> U8:
    picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    if picture is None or picture.shape != size:
        raise ValueError("a picture of it is damaged")
    return np.asarray(picture, np.uint8)
