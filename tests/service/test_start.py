"""What a process loads before its first work: the service is back as fast as that allows."""

from __future__ import annotations

import subprocess
import sys

HEAVY = {"cv2", "scipy", "gtsam", "pycolmap", "matplotlib", "onnxruntime", "mujoco"}
LOADS_NOT = (
    ("ground_station.service.serve", HEAVY | {"numpy", "av", "google.protobuf"}),
    ("ground_station.service.web.app", HEAVY | {"av"}),
    ("ground_station.service.intake.__main__", HEAVY),
    ("ground_station.service.foxglove.process", HEAVY - {"scipy"}),
    ("ground_station.service.localizing.process", {"pycolmap", "matplotlib", "onnxruntime"}),
)
"""Each may load what the ones before it may, and more: one program tells of all."""


def test_a_process_loads_nothing_heavy_that_it_does_not_need() -> None:
    code = "; ".join(f"import {module}; print(*sys.modules)" for module, _ in LOADS_NOT)
    loaded = subprocess.run(
        [sys.executable, "-c", f"import sys; {code}"],
        capture_output=True, text=True, timeout=120, check=True,
    ).stdout.splitlines()  # fmt: skip
    told = zip(LOADS_NOT, loaded, strict=True)
    assert {module: without & {*names.split()} for (module, without), names in told} == {
        module: set() for module, _ in LOADS_NOT
    }
