"""Recordings of small videos whose every frame shows its own number."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from numbered_video import FRAMES, HEIGHT, PERIOD_NS, START_NS, WIDTH, encode, picture

from pi_firmware.wire.recording import TRUTH_TOPIC, RecordingWriter


@pytest.fixture(scope="session")
def access_units() -> list[bytes]:
    """FRAMES pictures, an IDR every 10."""
    return encode(map(picture, range(FRAMES)))


@pytest.fixture
def make_flight(tmp_path: Path) -> Callable[..., Path]:
    """Writes a recording of access units with camera and truth; gives its path."""

    def make(
        units: list[bytes],
        *,
        name: str = "flight.mcap",
        matrix: Iterable[float] = (150, 0, 79.5, 0, 151, 59.5, 0, 0, 1),
        distortion: Iterable[float] = (0.1, -0.2, 0.001, 0.002, 0.03),
        distortion_model: str = "plumb_bob",
        width_px: int = WIDTH,
        readout: str | None = "0.02",
        chunk_bytes: int = 4096,
    ) -> Path:
        path = tmp_path / name
        with RecordingWriter(path, chunk_bytes=chunk_bytes) as writer:
            writer.write_calibration(
                START_NS,
                width_px=width_px,
                height_px=HEIGHT,
                matrix=list(matrix),
                distortion=list(distortion),
                distortion_model=distortion_model,
            )
            for number, unit in enumerate(units):
                time_ns = START_NS + number * PERIOD_NS
                writer.write_video(time_ns, unit)
                writer.write_pose(time_ns, [number, 2, 3], [0, 0, 0, 2], topic=TRUTH_TOPIC)
            if readout is not None:
                writer.write_metadata("camera", {"readout_s": readout})
        return path

    return make
