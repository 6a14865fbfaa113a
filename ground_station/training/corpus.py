"""The pictures and their labels on disk: made once, in parallel; what is there is not made again.

A shard is one file, written beside and renamed, and depends on nothing but the settings and its
number: a run that is killed loses the shards it was at.
"""

from __future__ import annotations

import json
import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ground_station import files
from ground_station.arrays import F32, U8
from ground_station.feature_models import images
from ground_station.progress import Progress
from ground_station.training import rooms
from ground_station.training.errors import TrainingError
from ground_station.training.teacher import Teacher, load

VERSION = 1
"""Another one makes other pictures or labels of the same settings."""
_KINDS = ("pictures", "rooms")


@dataclass(frozen=True)
class CorpusSettings:
    """What a corpus holds; more pictures or rooms may be asked for later."""

    seed: int = 1
    pictures: int = 1200
    """Places that are textures: made by `images`."""
    rooms: int = 40
    places: int = 24
    """Of a room, each drawn in every light."""
    lights: int = 3
    rows: int = 384
    columns: int = 512
    warps: int = 6
    """Turned pictures that the teacher sees of each place, beside those as they are."""
    points: int = 600
    per_shard: int = 40
    """Pictures in a file; their number is rounded up to whole files."""

    def __post_init__(self) -> None:
        """Raises `TrainingError` with one line for a number that makes no corpus."""
        limits = {
            "pictures": (0, 1_000_000),
            "rooms": (0, 100_000),
            "places": (1, 200),
            "lights": (1, 8),
            "warps": (0, 100),
            "points": (16, 4000),
            "per_shard": (1, 1000),
            "rows": (128, 2048),
            "columns": (128, 2048),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise TrainingError(f"{name} is {getattr(self, name)}; allowed: {low} to {high}")
        if self.rows % 32 or self.columns % 32:
            raise TrainingError(f"{self.columns}x{self.rows} px; both must be multiples of 32")
        if self.pictures + self.rooms == 0:
            raise TrainingError("pictures and rooms are both 0")

    def shards(self) -> list[tuple[str, int]]:
        """Kind and number of each; rooms, which take longest, between the pictures."""
        numbered = [(k, n) for k in _KINDS for n in range(self._count(k))]
        return sorted(numbered, key=lambda shard: (shard[1] / self._count(shard[0]), shard))

    def _count(self, kind: str) -> int:
        return self.rooms if kind == "rooms" else -(-self.pictures // self.per_shard)

    def fixed(self) -> dict[str, Any]:
        """What must not change where there are shards already."""
        return {k: v for k, v in asdict(self).items() if k not in _KINDS}


def shard_path(folder: Path, kind: str, number: int) -> Path:
    """Where a shard is."""
    return folder / f"{kind}-{number:04d}.safetensors"


def _places(settings: CorpusSettings, kind: str, number: int) -> Iterator[U8]:
    size = (settings.rows, settings.columns)
    if kind == "rooms":
        yield from rooms.views_of_room(
            settings.seed, number, settings.places, settings.lights, size
        )
        return
    for index in range(number * settings.per_shard, (number + 1) * settings.per_shard):
        yield images.procedural(settings.seed, index, size)[None]


_teacher: Teacher | None = None


def _start(name: str) -> None:
    """In a worker, once. Ctrl-C is for the process that started it: a shard is not cut."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    global _teacher
    cv2.setNumThreads(1)
    _teacher = Teacher(load(name))


def make_shard(
    settings: CorpusSettings, kind: str, number: int, path: Path, teacher: Teacher
) -> None:
    """Makes, labels and writes one shard."""
    tensors: dict[str, npt.NDArray[Any]] = {}
    count = 0
    for count, views in enumerate(_places(settings, kind, number), 1):
        k = count - 1
        rng = np.random.default_rng([settings.seed, 4, _KINDS.index(kind), number, k])
        labels = teacher.label(views, settings.warps, settings.points, rng)
        tensors |= {
            f"{k}.views": views,
            f"{k}.points": labels.points_px,
            f"{k}.scores": labels.scores,
            f"{k}.descriptors": labels.descriptors,
        }
    files.write_bytes(path, save(tensors, {"places": str(count)}))


def _work(settings: CorpusSettings, kind: str, number: int, path: Path) -> None:
    assert _teacher is not None
    make_shard(settings, kind, number, path, _teacher)


def make(folder: Path, settings: CorpusSettings, teacher: str, jobs: int) -> None:
    """Makes what is missing of a corpus, in `jobs` processes.

    Raises `TrainingError` where the folder holds another one (other settings or teacher).
    """
    document = {
        "version": VERSION, "settings": settings.fixed(), "teacher": load(teacher).sha256
    }  # fmt: skip
    note = folder / "corpus.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        known = json.loads(note.read_text()) if note.exists() else None
    except (OSError, ValueError) as error:
        raise TrainingError(f"{note}: {error}") from None
    if known is not None and known != document:
        raise TrainingError(f"{folder} holds a corpus of other settings or of another teacher")
    files.write_json(note, document)
    shards = [(kind, number, shard_path(folder, kind, number))
              for kind, number in settings.shards()]  # fmt: skip
    missing = [shard for shard in shards if not shard[2].exists()]
    if not missing:
        return
    with (
        Progress("pictures and labels, shards", len(missing)) as progress,
        ProcessPoolExecutor(
            min(jobs, len(missing)), multiprocessing.get_context("spawn"), _start, (teacher,)
        ) as pool,
    ):
        futures = [pool.submit(_work, settings, *shard) for shard in missing]
        try:
            for future in as_completed(futures):
                future.result()
                progress.step()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


@dataclass(frozen=True)
class Place:
    """One place: `views` (V, H, W) uint8 in V lights and its labels, as in `teacher.Labels`."""

    views: U8
    points_px: F32
    scores: F32
    descriptors: npt.NDArray[np.float16]


class Corpus:
    """The shards of some settings, read by place; files stay mapped."""

    def __init__(self, folder: Path, settings: CorpusSettings) -> None:
        self._open: dict[Path, Any] = {}
        self._places: list[tuple[Path, int]] = []
        for kind, number in settings.shards():
            path = shard_path(folder, kind, number)
            try:
                count = int((self._file(path).metadata() or {})["places"])
            except (KeyError, ValueError):
                raise TrainingError(f"{path}: not a shard of ours") from None
            self._places += [(path, k) for k in range(count)]
        if not self._places:
            raise TrainingError(f"{folder}: the corpus is empty")

    def _file(self, path: Path) -> Any:
        if path not in self._open:
            try:
                self._open[path] = safe_open(path, "numpy")
            except (OSError, SafetensorError) as error:
                line = str(error).splitlines()[0]
                raise TrainingError(
                    f"{path}: {line}; without this file, --resume makes it again"
                ) from None
        return self._open[path]

    def __getstate__(self) -> dict[str, Any]:
        """To another process: it opens the files itself."""
        return {**self.__dict__, "_open": {}}

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> Place:
        path, k = self._places[index]
        shard = self._file(path)
        names = ("views", "points", "scores", "descriptors")
        return Place(*(shard.get_tensor(f"{k}.{name}") for name in names))
