"""What a process loads before its first work: the service is back as fast as that allows."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("cv2", "scipy", "gtsam", "pycolmap", "matplotlib", "onnxruntime", "mujoco")


@pytest.mark.parametrize(
    ("module", "without"),
    [
        ("ground_station.service.serve", (*HEAVY, "numpy", "av", "google.protobuf")),
        ("ground_station.service.intake.__main__", HEAVY),
        ("ground_station.service.web.app", (*HEAVY, "av")),
        ("ground_station.service.foxglove.process", tuple(set(HEAVY) - {"scipy"})),
        ("ground_station.service.localizing.process", ("pycolmap", "matplotlib", "onnxruntime")),
    ],
)
def test_a_process_loads_nothing_heavy_that_it_does_not_need(
    module: str, without: tuple[str, ...]
) -> None:
    code = f"import sys, {module}; print(*sys.modules, sep='\\n')"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert not set(without) & set(loaded.stdout.split())
