"""One reader under the fuzzer, or inputs of it played back; started by `run.py` as a process.

    child.py fuzz READER [libFuzzer's options and folders]
    child.py play READER FILE…           without a fuzzer; what a file does wrong is a traceback
    child.py seeds READER FOLDER         writes the seeds

Memory is bounded twice: the address space, so that a claim is a `MemoryError` and not a dead
machine, and what was in memory at most, which is a finding even where the error was taken.
"""

from __future__ import annotations

import importlib
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType, ModuleType

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parents[1])]  # of the checkout, `deploy` is not installed
# What the tests of these rooms make, too: small models, weights, networks.
sys.path += [str(HERE.parent / room) for room in ("mapping", "features", "feature_models")]
import pieces  # noqa: E402

MEMORY_BYTES = 1 << 30
HANG_S = 10
"""Of this process's own time: on a busy machine the wall clock says little."""
STUCK_S = 120
"""Of the wall clock: a library that never comes back lets Python judge nothing."""
STRETCH_BYTES = 1 << 14
"""Under the fuzzer stretched inputs are shorter, so that there are many; played back, 1 MB."""
INSTRUMENTED = ["pi_firmware", "ground_station", "deploy", "hw", "tomllib", "mcap"]


def load(name: str) -> ModuleType:
    """The reader's module."""
    return importlib.import_module(f"readers.{name}")


def bound_memory() -> None:
    """No more address space than there is now and 1 GB on top."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))


def guarded(fuzz: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """The reader's function with long inputs made from short ones, and its memory looked at."""

    def one(data: bytes) -> None:
        signal.setitimer(signal.ITIMER_PROF, HANG_S)
        fuzz(pieces.stretched(data))
        signal.setitimer(signal.ITIMER_PROF, 0)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
        if peak > MEMORY_BYTES:
            raise MemoryError(f"{peak >> 20} MB were in memory; allowed: {MEMORY_BYTES >> 20}")

    signal.signal(signal.SIGPROF, _hangs)
    return one


def _play(name: str, files: list[str]) -> None:
    one = guarded(load(name).fuzz)
    bound_memory()
    for file in files:
        print(f"{name}: {file}", flush=True)
        signal.alarm(STUCK_S)  # without a handler it ends the process
        one(Path(file).read_bytes())
        signal.alarm(0)


class Hang(BaseException):
    """Not one that a reader which takes all exceptions would take."""


def _hangs(_: int, frame: FrameType | None) -> None:
    raise Hang(f"no end within {HANG_S} s")


def _fuzz(name: str, options: list[str]) -> None:
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED):
        one = guarded(load(name).fuzz)
    pieces.STRETCH_BYTES = STRETCH_BYTES
    bound_memory()
    atheris.Setup([sys.argv[0], f"-timeout={STUCK_S}", *options], one)
    atheris.Fuzz()


def _write_seeds(name: str, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(load(name).seeds()):
        (folder / f"seed-{number:02d}").write_bytes(seed)


if __name__ == "__main__":
    action, reader, *words = sys.argv[1:]
    if action == "fuzz":
        _fuzz(reader, words)
    elif action == "play":
        _play(reader, words)
    else:
        _write_seeds(reader, Path(words[0]))
