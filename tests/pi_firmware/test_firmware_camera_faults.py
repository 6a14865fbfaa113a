"""A test camera goes and hangs when asked, across its being closed and opened again."""

import time
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import eventually

from pi_firmware import gstreamer, sources
from pi_firmware.settings import CameraSettings
from pi_firmware.sources.schemes import test as faults
from pi_firmware.wire.errors import SourceError

LIMIT_S = 20.0


class Clock:
    """Seconds that pass when the test says so."""

    now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    result = Clock()
    monkeypatch.setattr(faults, "time", SimpleNamespace(monotonic=result.monotonic))
    monkeypatch.setattr(faults, "_first_opened_s", {})
    return result


class Running:
    """A source of this URI in a playing pipeline that counts its frames."""

    def __init__(self, uri: str) -> None:
        self._gst = gst = gstreamer.load()
        self.source = sources.open_source(CameraSettings(uri=uri, width_px=64, height_px=64))
        self.pipeline = gstreamer.launch(f"{self.source.elements()} ! fakesink name=end")
        self.source.attach(self.pipeline)
        self.count = 0
        pad = self.pipeline.get_by_name("end").get_static_pad("sink")
        pad.add_probe(gst.PadProbeType.BUFFER, self._on_frame)

    def _on_frame(self, pad: Any, probe: Any) -> Any:
        self.count += 1
        return self._gst.PadProbeReturn.OK

    def __enter__(self) -> "Running":
        self.pipeline.set_state(self._gst.State.PLAYING)
        self.source.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.pipeline.set_state(self._gst.State.NULL)
        self.source.close()

    def await_frames(self, more: int) -> None:
        wanted = self.count + more
        eventually(lambda: self.count >= wanted)

    def error(self, limit_s: float = LIMIT_S) -> str:
        """The pipeline's error, empty when none comes."""
        kind = self._gst.MessageType.ERROR
        message = self.pipeline.get_bus().timed_pop_filtered(int(limit_s * 1e9), kind)
        return message.parse_error()[0].message if message else ""


def test_a_camera_is_gone_and_back(clock: Clock) -> None:
    uri = "test:?pattern=ball&gone_at_s=3&gone_for_s=2"
    with Running(uri) as flight:
        flight.await_frames(3)
        clock.now_s += 3
        assert flight.error() == faults.GONE
        stood = flight.count
        clock.now_s += 0.5
        with pytest.raises(SourceError) as caught:
            sources.open_source(CameraSettings(uri=uri))
        assert str(caught.value) == f"camera.uri '{uri}': {faults.GONE}"
        clock.now_s += 2  # it is back, but who held it before has lost it
        assert flight.error(0.3) == "" and flight.count == stood
    with Running(uri) as anew:
        anew.await_frames(3)
        clock.now_s += 100  # once is enough
        anew.await_frames(3)


def test_a_camera_hangs_without_a_word_and_delivers_again(clock: Clock) -> None:
    uri = "test:?pattern=ball&hang_at_s=3&hang_for_s=60"
    with Running(uri) as flight:
        flight.await_frames(3)
        clock.now_s += 10
        time.sleep(0.1)  # a frame may be on its way
        stood = flight.count
        assert flight.error(0.3) == "" and flight.count == stood
        with Running(uri) as anew:  # opening it again helps
            anew.await_frames(3)
        assert flight.count == stood
        clock.now_s += 60
        flight.await_frames(3)


def test_a_duration_counts_from_the_first_opening(clock: Clock) -> None:
    uri = "test:?gone_at_s=1&gone_for_s=1&duration_s=4"
    camera = CameraSettings(uri=uri)
    assert "num-buffers=120 " in sources.open_source(camera).elements()
    clock.now_s += 2.5
    assert "num-buffers=45 " in sources.open_source(camera).elements()
    clock.now_s += 100
    assert "num-buffers=1 " in sources.open_source(camera).elements()


def test_a_camera_without_faults_starts_afresh_each_time(clock: Clock) -> None:
    camera = CameraSettings(uri="test:?duration_s=4")
    for _ in range(2):
        assert "num-buffers=120 " in sources.open_source(camera).elements()
        clock.now_s += 2
