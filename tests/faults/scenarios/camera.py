"""Cameras by name, each with where it truly was when it took a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
from standing import ATRIUM

from pi_firmware.wire.recording import TRUTH_TOPIC, PoseSample, RecordingReader, RecordingWriter

FLIGHT = ATRIUM / "flight.mcap"
NAMES = ("flight", "black", "frozen", "gone", "hangs", "stuck", "pattern")
_EVERY, _FRAMES = 3, 120
"""Of the flight's 30 Hz, so that a stretch of 12 s is made within seconds."""
_FAULT = range(40, 80)
"""Its frames that are black or frozen: 4 s of 12."""
_GOP = 10

Position = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """`camera.uri` without a rate, and the truth; None where it sees nothing of the map."""

    uri: str
    truth: Truth | None


class Truth:
    """Positions (m, world) of a recording that is played in a loop, by capture time."""

    def __init__(self, recording: Path) -> None:
        poses = RecordingReader(recording).poses(TRUTH_TOPIC)
        self._time_ns = np.array([pose.time_ns for pose in poses])
        self._position_m = np.array([pose.position_m for pose in poses])
        # As `pi_firmware.sources.schemes.replay` shifts a round: by its length, and one frame more.
        first, before, last = (int(self._time_ns[i]) for i in (0, -2, -1))
        self._first_ns, self.round_ns = first, last - first + (last - before)

    def at(self, time_ns: int) -> Position:
        """Where the camera was, (3,), at the frame nearest to a capture time of any round."""
        own_ns = self._first_ns + (time_ns - self._first_ns) % self.round_ns
        return np.asarray(self._position_m[int(np.argmin(np.abs(self._time_ns - own_ns)))])


class Cameras:
    """Makes each once, in a folder that several flights may share."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._made: dict[str, Camera] = {}

    def get(self, name: str) -> Camera:
        """A camera by its name; those of `test:` see a picture that is in no map."""
        if name not in self._made:
            self._made[name] = self._make(name)
        return self._made[name]

    def _make(self, name: str) -> Camera:
        if name == "flight":
            return Camera(f"replay:{FLIGHT}?loop=1", Truth(FLIGHT))
        if name in ("black", "frozen"):
            path = self._folder / f"{name}.mcap"
            write(path, black if name == "black" else frozen)
            return Camera(f"replay:{path}?loop=1", Truth(path))
        faults = {
            "gone": "gone_at_s=2&gone_for_s=3",
            "hangs": "hang_at_s=2&hang_for_s=60",
            "stuck": "pattern=gradient",
            "pattern": "",
        }
        return Camera(f"test:?{faults[name]}".rstrip("?"), None)


Picture = tuple[av.VideoFrame, PoseSample]


def black(pictures: list[Picture]) -> Iterable[Picture]:
    """The lens is covered for a while, and the camera flies on."""
    for index, (frame, pose) in enumerate(pictures):
        if index in _FAULT:
            dark = np.full((frame.height, frame.width, 3), 16, np.uint8)
            yield av.VideoFrame.from_ndarray(dark, format="rgb24"), pose
        else:
            yield frame, pose


def frozen(pictures: list[Picture]) -> Iterable[Picture]:
    """The same picture for a while, then the one where it is by then.

    Its truth is the picture's own place: nothing tells it from a camera that stands still.
    """
    for index, one in enumerate(pictures):
        yield pictures[_FAULT[0]] if index in _FAULT else one


def write(path: Path, fault: Callable[[list[Picture]], Iterable[Picture]]) -> None:
    """A stretch of the sample flight with a faulty camera, as a recording with its truth."""
    reader = RecordingReader(FLIGHT)
    truth = reader.poses(TRUTH_TOPIC)
    decoder = av.CodecContext.create("h264", "r")
    decoder.thread_count = 1
    pictures: list[Picture] = []
    times_ns: list[int] = []
    for index, sample in enumerate(reader.video()):
        for frame in decoder.decode(av.Packet(sample.data)):
            if index % _EVERY == 0:
                pictures.append((frame, truth[index]))
                times_ns.append(truth[index].time_ns)
        if len(pictures) == _FRAMES:
            break
    with RecordingWriter(path) as recording:
        units = _encode([frame for frame, _ in fault(pictures)])
        for unit, time_ns, (_, pose) in zip(units, times_ns, fault(pictures), strict=True):
            recording.write_video(time_ns, unit)
            recording.write_pose(time_ns, pose.position_m, pose.quaternion_xyzw, topic=TRUTH_TOPIC)


def _encode(frames: list[av.VideoFrame]) -> list[bytes]:
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt = frames[0].width, frames[0].height, "yuv420p"
    codec.time_base, codec.framerate, codec.thread_count = Fraction(1, 10), Fraction(10), 1
    codec.options = {"tune": "zerolatency", "preset": "ultrafast", "crf": "16", "g": str(_GOP)}
    units = []
    for index, frame in enumerate(frames):
        copied = frame.reformat(format="yuv420p")
        copied.pts, copied.pict_type = index, av.video.frame.PictureType.NONE
        (packet,) = codec.encode(copied)
        units.append(bytes(packet))
    return units
