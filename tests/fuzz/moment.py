"""Readers in forks of one process, so that what they import is imported once; for CI.

    moment.py play [READER…]   their seeds and past findings, without a fuzzer
    moment.py fuzz [READER…]   the same and a moment of the fuzzer's own inputs, after them

Status 1 when one fails, whose output is printed. What it writes lies in the folder of TMPDIR.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

sys.path.insert(0, str(Path(__file__).resolve().parent))
import child
import pieces
from table import READERS

_AT_A_TIME = 2
_RUNS = 150
"""As many on every machine: with the seed, the same inputs each time."""
_STUCK_S = 300
_REGRESSIONS = child.HERE / "regressions"


def inputs(name: str, module: ModuleType) -> list[bytes]:
    """A reader's seeds and past findings."""
    folder = _REGRESSIONS / name
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return [*module.seeds(), *(path.read_bytes() for path in found)]


def _play(name: str, module: ModuleType) -> None:
    one = child.guarded(module.fuzz)
    for number, data in enumerate(inputs(name, module)):
        print(f"{name}: input {number}", flush=True)
        one(data)


def _fuzz(name: str, module: ModuleType) -> None:
    import atheris

    corpus = Path(tempfile.mkdtemp())
    for number, data in enumerate(inputs(name, module)):
        (corpus / f"{number:03d}").write_bytes(data)
    pieces.STRETCH_BYTES = child.STRETCH_BYTES
    most = next(reader.most_bytes for reader in READERS if reader.name == name)
    options = (f"-runs={_RUNS}", f"-max_len={most}", "-seed=8")
    command = [name, *options, f"-artifact_prefix={corpus}/finding-", str(corpus)]
    atheris.Setup(command, child.guarded(module.fuzz))
    atheris.Fuzz()


def _fork(name: str, module: ModuleType, do: Callable[[str, ModuleType], None], log: Path) -> int:
    """A process of its own; its id."""
    if pid := os.fork():
        return pid
    atexit._clear()  # folders are this one's parent's
    with log.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    signal.alarm(_STUCK_S)
    try:
        child.bound_memory()
        do(name, module)
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def main(action: str, names: list[str]) -> int:
    """Plays or fuzzes the readers of these names, all without one."""
    names = names or [reader.name for reader in READERS]
    do = _play if action == "play" else _fuzz
    if action == "fuzz":
        import atheris

        with atheris.instrument_imports(include=child.INSTRUMENTED):
            modules = {name: child.load(name) for name in names}
    else:
        modules = {name: child.load(name) for name in names}
    running: dict[int, tuple[str, Path]] = {}
    failed = []
    waiting = list(names)
    began_s = time.monotonic()
    while waiting or running:
        while waiting and len(running) < _AT_A_TIME:
            name = waiting.pop(0)
            log = Path(tempfile.gettempdir()) / f"{name}.log"
            running[_fork(name, modules[name], do, log)] = name, log
        pid, status = os.wait()
        name, log = running.pop(pid)
        if status:
            failed.append(name)
            print(f"== {name}: status {status}\n{log.read_text(errors='replace')[-6000:]}")
    print(f"{len(names)} readers in {time.monotonic() - began_s:.0f} s; failed: {failed or 'none'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
