"""The whole service as its user runs it: from the start to poses, through deaths, to its end."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest
from foxglove.datasets import EpisodeReader, ObjectLocation
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from intake_stand import eventually, free_udp_port
from mcap.reader import make_reader
from mcap_doctor import complaints
from payload_process import PayloadProcess
from standing import STOP_S, Estimates, Process, Service, Viewer

from ground_station.geometry.trajectory import read_tum
from pi_firmware.wire import keys
from pi_firmware.wire.recording import ESTIMATE_TOPIC, VIDEO_TOPIC, RecordingReader

pytestmark = pytest.mark.alone

PAGE = Path(__file__).parents[2] / "ground_station/service/README.md"
NAME = "blimp-1"
CUT_S = 1.0
"""What a power cut may cost of a recording."""
NOISE_S = 2.0
"""More, where the machine is busy: a frame may be that late on its way to the disk."""


class Flying:
    """A service, and a payload that flies to it all along."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self._folder, self._stack = folder, stack
        self.service = stack.enter_context(Service(folder))
        self.fly()

    def fly(self) -> None:
        """Another payload of the same name takes off."""
        folder = self._folder / f"payload-{time.monotonic_ns()}"
        self.payload: PayloadProcess = self._stack.enter_context(self.service.fly(NAME, folder))


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flying]:
    with contextlib.ExitStack() as stack:
        one = Flying(tmp_path_factory.mktemp("flying"), stack)
        yield one
        one.payload.end().assert_in_order()
        assert one.service.end() < STOP_S


@pytest.fixture
def tracked(flying: Flying) -> Flying:
    """It is tracked, and nothing is left of the test before."""
    assert flying.payload.running
    eventually(lambda: flying.service.tracking(NAME))
    return flying


def frames(service: Service, fate: str = "received") -> int:
    view = service.payload(NAME)
    return int(view["payload"]["frames"].get(fate, 0)) if view and view["payload"] else 0


def processed(service: Service) -> int:
    estimate = service.payload(NAME).get("estimate")
    return int(estimate["processed"]) if estimate else 0


def metrics(service: Service) -> str:
    return str(service.client.get("/metrics").text)


def another(service: Service, before: Process) -> Process | None:
    """The process that came in place of one, or None."""
    now = service.processes().get(before.name)
    return now if now is not None and now != before else None


def seconds(condition: Callable[[], object]) -> float:
    began_s = time.monotonic()
    eventually(condition)
    return time.monotonic() - began_s


def test_the_demo_from_its_start_to_a_trajectory_and_its_end(tmp_path: Path) -> None:
    with Service(tmp_path, demo=True) as service:
        eventually(lambda: service.tracking("demo"))
        state = service.state()
        assert state["station"]["demo"] and state["payloads"]["demo"]["alive"]
        assert {"intake", "web", "foxglove", "localizer/demo"} <= {
            item["name"] for item in state["processes"]
        }
        assert "<html" in service.client.get("/").text
        with Viewer(service) as viewer:  # of nobody in particular
            service.record(active=True)
            wanted = {"hello", "state", "estimate", "video", "recording"}
            before = viewer.counts.get("video", 0)  # of what is not recorded
            eventually(lambda: wanted <= {*viewer.counts} and viewer.counts["video"] > before + 20)
            service.record(active=False)
            eventually(lambda: not service.state()["recording"]["active"])
        refuses_a_port_in_use(service)
        gives_poses_to_a_program_as_its_page_has_it(service)
        (listed,) = service.client.get("/api/recordings").json()
        path = service.recordings / listed["file"]
        assert listed["duration_s"] > 0 and not listed["active"]
        is_whole(path)
        over_http = service.client.get(f"/api/recordings/{path.name}/trajectory.txt").text
        assert service.client.get(f"/api/recordings/{path.name}").content == path.read_bytes()
        assert 'blimp_frames_total{fate="localized",payload="demo"}' in metrics(service)
        took_s = service.end()
        assert took_s < STOP_S
    out = tmp_path / "trajectory.txt"
    blimp = str(Path(sys.executable).with_name("blimp"))
    subprocess.run([blimp, "export", str(path), "--out", str(out)], check=True, timeout=60)
    assert out.read_text() == over_http
    assert len(read_tum(out).time_ns) == len(RecordingReader(path).poses(ESTIMATE_TOPIC)) > 5


def is_whole(path: Path) -> None:
    """For `mcap doctor`, MCAP's reader with CRCs checked, ours, and foxglove-sdk's."""
    assert complaints(path) == []
    with path.open("rb") as file:
        mcap = make_reader(file, validate_crcs=True)
        summary = mcap.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == sum(1 for _ in mcap.iter_messages()) > 20
    reader = RecordingReader(path)
    assert not reader.cut and reader.calibration() is not None
    pictures, poses = list(reader.video()), reader.poses(ESTIMATE_TOPIC)
    assert len(pictures) > 10 and len(poses) > 5
    read = [(schema.name, message) for schema, _, _, message in by_foxglove(path)]
    videos = [message.data for name, message in read if name == "foxglove.CompressedVideo"]
    assert videos == [sample.data for sample in pictures]
    frames = [m.frame_id for name, m in read if name == "foxglove.PoseInFrame"]
    assert frames == ["world"] * len(poses)


def gives_poses_to_a_program_as_its_page_has_it(service: Service) -> None:
    """The program of README, at this station's port, prints where the payload is."""
    program = re.search(r"^ +import json, zenoh\n(?: +.*\n)+", PAGE.read_text(), re.MULTILINE)
    assert program is not None
    typed = textwrap.dedent(program[0]).replace("tcp/127.0.0.1:7447", service.endpoint)
    words = [sys.executable, "-u", "-c", typed]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        solved = (line for line in reader.stdout if not line.endswith("None\n"))
        key, position_m = next(solved).split(maxsplit=1)
        reader.terminate()
    assert key == "blimp/demo/pose" and len(json.loads(position_m)) == 3


class OnDisk:
    """Recordings of this machine for foxglove-sdk's reader, and its messages' types."""

    def open(self, location: ObjectLocation) -> IO[bytes]:
        return Path(location.path).open("rb")

    def decoder_for(self, _: str, schema: Any) -> Callable[[bytes], Any]:
        of = {"foxglove.CompressedVideo": CompressedVideo, "foxglove.PoseInFrame": PoseInFrame}
        return of[schema.name].FromString


def by_foxglove(path: Path) -> Iterator[Any]:
    episode: Any = SimpleNamespace(
        id="",
        metadata={},
        start_time=datetime.fromtimestamp(0, UTC),
        end_time=datetime.fromtimestamp(2**32, UTC),
        locations=(ObjectLocation("", str(path)),),
    )
    reader = EpisodeReader(episode, (VIDEO_TOPIC, ESTIMATE_TOPIC), None, OnDisk())
    return reader.iter_messages(decoder_factories=[OnDisk()])


def refuses_a_port_in_use(service: Service) -> None:
    """Another service on one of its ports ends with one line that names it, and status 2."""
    environment = os.environ | {"XDG_RUNTIME_DIR": str(service.place)}
    taken = {
        f"http.port={service.http}": str(service.http),
        f"video.port={service.video}": str(service.video),
        f"telemetry.listen={json.dumps([service.endpoint])}": service.endpoint,
    }
    starting = []
    for setting, named in taken.items():  # all at once: each is hardly more than its imports
        command = list(service.command)
        for one in (
            "http.port=0",
            "foxglove.port=0",
            f"video.port={free_udp_port()}",
            'telemetry.listen=["tcp/127.0.0.1:0"]',
            setting,
        ):
            command += ["--set", one]
        program = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        starting.append((program, named))
    for program, named in starting:
        _, err = program.communicate(timeout=60)
        assert program.returncode == 2, err
        (said,) = err.splitlines()
        assert named in said and "in use" in said.lower()
    assert service.answers()


def test_after_sigkill_the_recording_opens_and_the_flight_goes_on(tracked: Flying) -> None:
    service = tracked.service
    service.record(active=True)
    eventually(lambda: service.state()["recording"]["duration_s"] > 4)
    ssrc, sent = service.payload(NAME)["payload"]["ssrc"], frames(service, "sent")
    file = service.recordings / service.state()["recording"]["file"]
    service.kill()
    killed_ns, killed_s = time.time_ns(), time.monotonic()
    service.assert_nobody_left()
    reader = RecordingReader(file)
    # Poses come late on a busy machine, pictures and telemetry do not.
    pictures, told = (
        [record.log_time for _, record in reader.messages({topic})]
        for topic in (VIDEO_TOPIC, "/" + keys.key(NAME, keys.GATE))
    )
    assert reader.cut
    lacks_s = [1e-9 * (killed_ns - times[-1]) for times in (pictures, told)]
    assert max(lacks_s) < CUT_S + NOISE_S
    assert len(pictures) > 60 and pictures == sorted(pictures)
    assert len(list(reader.json("/estimate/state"))) > 2
    began_s = time.monotonic()
    service.start()
    back = [stage(service, began_s, "page")]
    eventually(lambda: frames(service) > 0)
    back.append(stage(service, began_s, "video"))
    eventually(lambda: service.tracking(NAME))
    back.append(stage(service, began_s, "pose"))
    print(
        f"\nSIGKILL: lacks {lacks_s[0]:.2f} s of video, {lacks_s[1]:.2f} s of telemetry; after the"
        f" start ({began_s - killed_s:.1f} s later): {', '.join(back)};"
        f" load {os.getloadavg()[0]:.1f}"
    )
    goes_on_recording(service, file)
    view = service.payload(NAME)["payload"]
    # The payload was not touched: the same process sends the same stream.
    assert tracked.payload.running and view["ssrc"] == ssrc
    assert frames(service, "sent") > sent and frames(service, "lost") == 0
    assert len(list(service.place.glob("blimp-*"))) == 1  # not the killed one's, too
    service.assert_no_accident()


def stage(service: Service, began_s: float, name: str) -> str:
    """What is there now, and what it took: a busy machine stretches the one, hardly the other."""
    used_s = sum(one.cpu_s() for one in (*service.processes().values(), service.parent()))
    return f"{name} in {time.monotonic() - began_s:.1f} s ({used_s:.1f} s of a processor)"


def goes_on_recording(service: Service, cut: Path) -> None:
    """What was recorded when it was killed is, again, in another file; the page tells of both."""
    view = eventually(lambda: s if (s := service.state())["recording"]["active"] else None)
    recording = view["recording"]
    assert recording["file"] != cut.name and cut.name in recording["resumed"]
    (alarm,) = [one for one in view["alarms"] if one["id"] == "resumed"]
    assert cut.name in alarm["text"] and recording["file"] in alarm["text"]
    said = [event for event in view["events"] if event["name"] == "recording-resumed"]
    assert len(said) == 1 and recording["file"] in said[0]["text"]
    eventually(lambda: service.state()["recording"]["duration_s"] > 4)
    service.record(active=False)
    path = service.recordings / recording["file"]
    assert not RecordingReader(path).cut and len(list(RecordingReader(path).video())) > 60


def test_an_intake_that_dies_comes_back_to_the_same_streams(tracked: Flying) -> None:
    service = tracked.service
    before = service.processes()
    ssrc = service.payload(NAME)["payload"]["ssrc"]
    with Viewer(service, NAME) as viewer:
        eventually(lambda: viewer.counts.get("video", 0) > 5)
        os.kill(before["intake"].pid, signal.SIGKILL)
        back_s = seconds(lambda: another(service, before["intake"]))
        seen = viewer.counts["video"]
        video_s = back_s + seconds(lambda: viewer.counts["video"] > seen + 5)
        assert viewer.connections == 1
    pose_s = video_s + seconds(lambda: service.tracking(NAME))
    print(f"\nintake: back in {back_s:.1f} s, video in {video_s:.1f} s, pose in {pose_s:.1f} s")
    # The note that tells the stream may come after the first pictures.
    assert eventually(lambda: service.payload(NAME)["payload"]["ssrc"]) == ssrc
    only_this_one_fell(service, before, "intake")


def test_a_web_process_that_dies_disturbs_nobody(tracked: Flying) -> None:
    service = tracked.service
    before = service.processes()
    with service.bus() as bus, Viewer(service, NAME) as viewer:
        estimates = Estimates(bus)
        eventually(lambda: viewer.counts.get("estimate", 0) > 5 and estimates.done_ns)
        events = service.state()["events"]
        os.kill(before["web"].pid, signal.SIGKILL)
        taken = len(estimates.done_ns[NAME])
        page_s = seconds(lambda: another(service, before["web"]) and service.answers())
        # Poses went on in the meantime, and the viewer comes back by itself.
        assert len(estimates.done_ns[NAME]) > taken
        seen = dict(viewer.counts)
        eventually(lambda: viewer.connections == 2 and viewer.counts["video"] > seen["video"] + 5)
    print(f"\nweb: back in {page_s:.1f} s")
    assert events and service.state()["events"][: len(events)] == events
    eventually(lambda: service.tracking(NAME))
    only_this_one_fell(service, before, "web")


def test_a_localizer_that_dies_tracks_again(tracked: Flying) -> None:
    service = tracked.service
    before = service.processes()
    name = f"localizer/{NAME}"
    with Viewer(service, NAME) as viewer:
        eventually(lambda: viewer.counts.get("video", 0) > 5)
        seen = processed(service)
        os.kill(before[name].pid, signal.SIGKILL)
        pictures = viewer.counts["video"]
        pose_s = seconds(
            lambda: (
                another(service, before[name])
                and processed(service) > seen
                and service.tracking(NAME)
            )
        )
        assert viewer.counts["video"] > pictures and viewer.connections == 1
    print(f"\nlocalizer: tracks again in {pose_s:.1f} s")
    only_this_one_fell(service, before, name)


def test_a_foxglove_process_that_dies_is_not_missed(tracked: Flying) -> None:
    service = tracked.service
    before = service.processes()
    os.kill(before["foxglove"].pid, signal.SIGKILL)
    eventually(lambda: another(service, before["foxglove"]) and listens(service.foxglove))
    only_this_one_fell(service, before, "foxglove")


def listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


def only_this_one_fell(service: Service, before: dict[str, Process], name: str) -> None:
    now = service.processes()
    assert {n for n in before if now.get(n) != before[n]} == {name} and now.keys() == before.keys()
    eventually(
        lambda: (
            any(
                event["name"] == "process-restarted" and event["text"].startswith(name)
                for event in service.state()["events"]
            )
            or name == "web"
        )  # it was not there to hear it
    )
    service.assert_no_accident()


def test_a_payload_that_goes_and_comes_back_is_taken_up(tracked: Flying) -> None:
    service = tracked.service
    before = service.processes()
    ssrc = service.payload(NAME)["payload"]["ssrc"]
    with Viewer(service, NAME) as viewer:
        eventually(lambda: viewer.counts.get("state", 0) > 2)
        tracked.payload.end().assert_in_order()
        gone_s = seconds(lambda: viewer.counts.get("gone", 0) == 1)
        assert not service.payload(NAME)["alive"]
        tracked.fly()
        back_s = seconds(lambda: service.payload(NAME)["alive"] and service.tracking(NAME))
        assert viewer.connections == 1
    print(f"\npayload: gone in {gone_s:.1f} s, tracked {back_s:.1f} s after its start")
    # Its first health, which says so, may come after its first poses.
    eventually(lambda: service.payload(NAME)["payload"]["ssrc"] != ssrc)
    assert service.processes() == before
