"""A camera that is opened again again and again, for hours, takes no more than one."""

import gc
from pathlib import Path

import pytest

from pi_firmware.media import Counters, Media
from pi_firmware.settings import Settings
from pi_firmware.sources import open_source
from pi_firmware.wire.config import from_mapping


@pytest.mark.parametrize("uri", ["test:", "test:?gone_at_s=3600&gone_for_s=1"])
def test_a_pipeline_that_was_stopped_gives_all_back(uri: str) -> None:
    settings = from_mapping(
        {"camera": {"uri": uri, "width_px": 320, "height_px": 240}}, Settings, where="test"
    )

    def once() -> int:
        source = open_source(settings.camera)
        media = Media(settings, source, Counters(), lambda *_: None, lambda _: True)
        media.play()
        assert media.stop()
        source.close()
        del media, source
        gc.collect()
        return len(list(Path("/proc/self/fd").iterdir()))

    once()  # what GStreamer opens once
    assert len({once() for _ in range(2)}) == 1
