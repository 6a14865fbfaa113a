"""Not a test: what a build that is killed loses, and whether a Dask cluster builds the same map.

    .venv/bin/python tests/mapping/construction/measure_resume.py --range 0:60 --json out/r.json

Builds a map of a recording with truth by the command, once undisturbed. Then again, ended by
SIGKILL at random moments spread over the whole of it and started again each time; how often an
image was extracted and a pair compared is counted beside the build, in a file that outlives it.
Then once more with two Dask workers. Camera centres are compared after Sim(3), in metres of the
truth.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.files import write_json
from ground_station.geometry.alignment import align
from ground_station.map import store
from ground_station.recording.flight import trajectory_of

ROOT = Path(__file__).resolve().parents[3]
BUILDING = "counted build: frames begin"


def counted(calls: str, words: list[str]) -> int:
    """The command, with a line in the file `calls` for each image extracted and pair compared."""
    from ground_station.cli import main
    from ground_station.mapping.construction import build, images, verification
    from ground_station.progress import Progress

    file = os.open(calls, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def around(name: str, function: Any) -> Any:
        def call(*args: Any) -> Any:
            os.write(file, f"{name}\n".encode())
            return function(*args)

        return call

    if "--dask" not in words:  # a cluster would be sent what counts
        images.extract_features = around("extract", images.extract_features)
        verification.verify_pair = around("verify", verification.verify_pair)
    build.assemble = around("assemble", build.assemble)
    stepped, extract = Progress.step, build.extract

    def step(self: Any, *args: Any) -> None:
        if self._label.startswith("structure"):
            os.write(file, b"structure\n")
        stepped(self, *args)

    def begin(*args: Any, **kwargs: Any) -> Any:
        print(BUILDING, flush=True)
        return extract(*args, **kwargs)

    Progress.step, build.extract = step, begin  # type: ignore[method-assign]
    return main(words)


class Build:
    """One map of the input, and the calls that it took, in a folder of its own."""

    def __init__(self, folder: Path, words: list[str]) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        self.map, self._calls, self._log = folder / "map", folder / "calls", folder / "log"
        self._words = [*words, "--cache", str(folder / "cache"), "--out", str(self.map)]
        self._calls.touch()

    def run(self, kill_after_s: float | None = None) -> float | None:
        """Seconds it took from the first frame on; None when it was killed after so many."""
        command = [sys.executable, __file__, "counted", str(self._calls), *self._words]
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # as the command sets it
        with (
            self._log.open("ab") as log,
            subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=log, text=True, cwd=ROOT, env=environment
            ) as process,
        ):
            assert process.stdout is not None
            while (line := process.stdout.readline()) and line.strip() != BUILDING:
                pass
            began_s = time.monotonic()
            try:
                process.wait(kill_after_s)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
                return None
            if process.returncode:
                raise SystemExit(f"the build failed: see {self._log}")
            return time.monotonic() - began_s

    def calls(self) -> Counter[str]:
        """How often each was done, in all runs together."""
        return Counter(self._calls.read_text().split())

    def built(self) -> dict[str, Any]:
        """What map.toml says of the build."""
        return store.load_info(self.map).built

    def centres(self) -> tuple[list[str], Any]:
        """Names and camera centres (K, 3), in the model's units."""
        keyframes = store.load(self.map).keyframes
        return keyframes.names, keyframes.wTc[:, :3, 3]


def killed(build: Build, took_s: float, moments: list[float]) -> list[dict[str, Any]]:
    """Ends the build at these shares of its whole and lets it finish; a row a run."""
    rows: list[dict[str, Any]] = []
    for share, before in zip([*moments, None], [0.0, *moments], strict=True):
        took = build.run(None if share is None else (share - before) * took_s)
        row: dict[str, Any] = {"killed_at": share, "seconds": took, **build.calls()}
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        if took is not None:
            break
    return rows


def compared(build: Build, reference: Build, truth: Any) -> dict[str, Any]:
    """Registered images, and how far camera centres are from the reference's, in millimetres."""
    names, centres = build.centres()
    expected, theirs = reference.centres()
    nearest = [truth.nearest(int(t)) for t in store.load(reference.map).keyframes.time_ns]
    metres = align(theirs, truth.position_m[nearest], True).apply(theirs)
    if names != expected:
        return {"registered": len(names), "same_images": False}
    offset = np.linalg.norm(align(centres, metres, True).apply(centres) - metres, axis=1)
    return {
        "registered": len(names),
        "same_images": True,
        "largest_mm": 1e3 * float(offset.max()),
        "median_mm": 1e3 * float(np.median(offset)),
    }


def main() -> int:
    """Prints a table; status 1 where a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--input", type=Path, default=ROOT / "maps" / "atrium" / "mapping.mcap")
    parser.add_argument("--range", default="0:60")
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=("killed", "dask"))
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "resume")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    out = args.out.resolve()
    words = ["map", "build", str(args.input.resolve()), "--range", args.range]
    reference = Build(out / "undisturbed", words)
    took_s = reference.run()
    assert took_s is not None
    truth = trajectory_of(args.input)
    document: dict[str, Any] = {
        "input": args.input.name, "range": args.range, "seed": args.seed,
        "undisturbed": {
            "seconds": took_s, **reference.calls(), "stage_s": reference.built()["stage_s"],
            "registered": reference.built()["registered"],
        },
    }  # fmt: skip
    good = True
    if args.only != "dask":
        moments = np.sort(np.random.default_rng(args.seed).uniform(0.02, 0.98, args.kills))
        build = Build(out / "killed", words)
        rows = killed(build, took_s, moments.tolist())
        once, all_calls = reference.calls(), build.calls()
        twice = {name: all_calls[name] - once[name] for name in ("extract", "verify")}
        figures = compared(build, reference, truth)
        document["killed"] = {"runs": rows, "done_twice": twice, **figures}
        good &= figures["same_images"] and figures["largest_mm"] <= 1
    if args.only != "killed":
        build = Build(out / "dask", [*words, "--dask", "2"])
        seconds = build.run()
        figures = compared(build, reference, truth)
        document["dask"] = {
            "seconds": seconds, "workers": build.built()["workers"],
            "stage_s": build.built()["stage_s"], **figures,
        }  # fmt: skip
        good &= figures["same_images"] and figures["largest_mm"] <= 1
    print(json.dumps(document, indent=2))
    if args.json:
        write_json(args.json, document)
    return 0 if good else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["counted"]:
        sys.exit(counted(sys.argv[2], sys.argv[3:]))
    sys.exit(main())
