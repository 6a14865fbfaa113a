"""COLMAP's own reader, tried on a model in a process of its own.

It believes every count in a file: it may wait, ask for what a count claims, or end its process. So
a child reads the model first, with bounded time and memory, and writes it again: what comes out
otherwise than it went in was cut, or says other things than it holds. Run as a program it is that
child: it prints what is wrong, in a line.
"""

from __future__ import annotations

# pycolmap's wheel exports zlib symbols that corrupt PNG writing unless zlib and OpenCV come first.
import zlib  # noqa: F401  # isort: skip
import cv2  # noqa: F401  # isort: skip

import sys
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

_LARGEST_PX = 1 << 20
_NEAR = 1e-5
"""How exactly a number of a text file comes back: others write fewer digits than COLMAP."""
_SECONDS, _BYTES = 10, 4 << 30
"""What the child may take, and `_SECONDS_MB` more for each MB of the model, `_TIMES` its bytes."""
_SECONDS_MB, _TIMES = 1.0, 50


def check(folder: Path) -> None:
    """Raises `MapError` with one line where a model is not one that COLMAP reads as it stands."""
    from ground_station import bounded  # the child needs none of it
    from ground_station.errors import MapError
    from pi_firmware.wire.text import printable

    if not folder.is_dir():
        raise MapError(f"{folder}: there is no such folder")
    for path in sorted(folder.iterdir()):
        if not (path.is_file() or path.is_dir()):  # a pipe would be waited for without end
            raise MapError(f"{path}: neither a file nor a folder: what is a model's is a file")
    size = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
    run = bounded.run(
        Path(__file__),
        str(folder.absolute()),
        seconds=_SECONDS + _SECONDS_MB * size / 1e6,
        memory_bytes=_BYTES + _TIMES * size,
    )
    fault = (run.stdout.decode(errors="replace").strip().splitlines() or [""])[-1]
    if run.returncode:
        fault = f"COLMAP's reader does not end well with it (status {run.returncode})"
    if fault:
        raise MapError(f"{folder}: not a COLMAP model: {printable(fault, 200)}")


def _look(folder: Path) -> str:
    """What is wrong; raises whatever COLMAP does."""
    model = pycolmap.Reconstruction(folder)
    if not model.is_valid():
        return "its files contradict each other"
    for number, camera in model.cameras.items():
        sizes = camera.width, camera.height
        if not all(0 < size <= _LARGEST_PX for size in sizes) or not _finite(camera.params):
            return f"camera {number} cannot be"
    for number, image in model.images.items():
        if not _finite(image.cam_from_world().matrix()):
            return f"the pose of image {number} is none"
        if not _finite([point.xy for point in image.points2D]):
            return f"a pixel of image {number} is not finite"
    if not _finite([point.xyz for point in model.points3D.values()]):
        return "a point is not finite"
    binary = (folder / "cameras.bin").exists()
    with tempfile.TemporaryDirectory() as again:
        (model.write_binary if binary else model.write_text)(again)
        for path in sorted(folder.glob("*.bin" if binary else "*.txt")):
            back = Path(again, path.name)
            if not back.exists():
                continue
            if binary and path.stat().st_size != back.stat().st_size:
                return f"{path.name} is cut, or holds other things than it says"
            if not binary and not _alike(path, back):
                return (
                    f"{path.name} is cut, holds words for numbers, or names with spaces, which "
                    "COLMAP reads in binary models only"
                )
    return ""


def _finite(values: object) -> bool:
    return bool(np.isfinite(np.asarray(values, np.float64)).all())


def _alike(path: Path, back: Path) -> bool:
    """Whether a text file has an end, and comes back with its words and numbers, in any order."""
    (words, before), (words_back, after) = _content(path), _content(back)
    same = words == words_back and len(before) == len(after)
    return path.read_bytes().endswith(b"\n") and same and np.allclose(before, after, _NEAR, _NEAR)


def _content(path: Path) -> tuple[list[str], npt.NDArray[np.float64]]:
    """A text file's words that are no numbers and its numbers, both sorted."""
    words, numbers = [], []
    for line in path.read_text().split("\n"):
        for word in line.split() if not line.lstrip().startswith("#") else ():
            try:
                numbers.append(float(word))
            except ValueError:
                words.append(word)
    return sorted(words), np.sort(numbers)


if __name__ == "__main__":
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        print(_look(Path(sys.argv[1])))
    except (ValueError, RuntimeError, OSError, IndexError, MemoryError) as error:
        print(str(error).splitlines()[0] if str(error) else type(error).__name__)
