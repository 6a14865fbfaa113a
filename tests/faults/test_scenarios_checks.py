"""The checks of the invariants themselves: each holds for what is right, and fails for what is not.

And the walks: what a seed draws, how a scenario is kept, and how it is shrunk.
"""

from __future__ import annotations

import socket
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from numbered_flight import GOP, encoded, stamped
from payload_process import Ended
from scenarios import accounts
from scenarios.background import Background
from scenarios.camera import FLIGHT, Camera, Truth
from scenarios.heard import Heard, Told
from scenarios.hostile_steps import Garbage
from scenarios.judge import OFF_M, poses
from scenarios.link_steps import Loss, Outage
from scenarios.matrix import BRIEF, MATRIX
from scenarios.payload_run import UNBORN_S, PayloadRun, Watch
from scenarios.play import _end
from scenarios.recordings import CUT_S, NOISE_S, Came, Recorded, lacking, read
from scenarios.step import KINDS, Scenario, Step, StepError, as_json, from_json
from scenarios.tcp_wire import TcpWire
from scenarios.walk import DRAWS, WALK_S, drawn, shrunk
from scenarios.world import combined

from ground_station.service import bus_messages
from ground_station.service.bus_messages import EstimateMessage, FrameMessage
from pi_firmware.wire.recording import RecordingWriter

COUNTS = {"captured": 100, "gated": 10, "sent": 88, "discarded": 2}


def test_a_payload_that_lost_a_frame_is_told() -> None:
    assert accounts.of_payload(COUNTS) == []
    for name in COUNTS:
        assert accounts.of_payload(COUNTS | {name: COUNTS[name] + 1})
    assert accounts.of_payload({})


def test_a_payload_that_was_killed_may_have_a_few_inside_and_never_fewer_than_none() -> None:
    assert accounts.of_killed_payload(COUNTS | {"captured": 103}) == []
    assert accounts.of_killed_payload({}) == []
    assert accounts.of_killed_payload(COUNTS | {"captured": 99})
    assert accounts.of_killed_payload(COUNTS | {"captured": 200})


@pytest.mark.parametrize(
    ("status", "out", "ended_s", "unborn"),
    [
        (-15, "", 0.3, True),
        (-15, "", UNBORN_S + 0.1, False),
        (-15, "payload blimp-1: test: -> 127.0.0.1:5600", 0.3, False),
        (-11, "", 0.3, False),
        (1, "", 0.3, False),
    ],
)
def test_only_an_interpreter_that_was_just_starting_may_end_without_a_word(
    status: int, out: str, ended_s: float, unborn: bool
) -> None:
    process: Any = None
    run = PayloadRun(Camera("test:", None), process, 100.0, Watch({"blimp-1": bytes(30)}), [])
    assert not run.unborn
    run.ended, run.ended_s = Ended(status, out, "", ended_s), 100.0 + ended_s
    assert run.unborn is unborn


@pytest.mark.parametrize("frame_first", [True, False])
def test_an_estimate_has_its_frame_whichever_is_heard_first(frame_first: bool) -> None:
    """Two processes tell of them: on a busy machine a pose was of a stream that nobody knew."""
    heard, ears = Heard(), {}
    bus: Any = SimpleNamespace(subscribe=lambda key, kind, take: ears.setdefault(key, take))
    heard.listen(bus, 1)
    frame = FrameMessage(0, 0, 153, 5, 6, 7, 640, 480, ssrc=99)
    said = [
        (bus_messages.FRAME, frame),
        (bus_messages.ESTIMATE, EstimateMessage(153, 5, 6, 8, "TRACKING")),
    ]
    for key, note in said if frame_first else reversed(said):
        ears[key]("blimp-1", note)
    ears[bus_messages.ESTIMATE]("blimp-1", EstimateMessage(154, 5, 9, 9, "TRACKING"))
    assert [(told.at, told.ssrc) for told in heard.estimates()] == [(0, 99), (-1, 0)]


def test_what_came_to_the_link_is_what_was_sent() -> None:
    assert accounts.of_link(10, 10, 0) == accounts.of_link(10, 9, 3) == []
    assert accounts.of_link(10, 9, 0) and accounts.of_link(9, 10, 0)
    assert accounts.of_link(9, 10, 3)


def test_the_intakes_account_is_held_against_the_payloads() -> None:
    frames = {"sent": 88, "received": 80, "withheld": 5, "lost": 3, "dropped": 1}
    assert accounts.of_intake(frames, 88) == []
    assert accounts.of_intake(frames, 89)
    for name in ("received", "withheld", "lost"):
        assert accounts.of_intake(frames | {name: frames[name] - 1}, 88)
    # An intake that began on the way does not count the 30 frames before it.
    began = frames | {"received": 50}
    assert accounts.of_intake(began, 88, (28, 31)) == []
    assert accounts.of_intake(began, 88, (20, 29)) and accounts.of_intake(began, 88, (31, 40))
    assert accounts.of_received(79, 80, 1) == []
    assert accounts.of_received(78, 80, 1) and accounts.of_received(80, 80, 1)


def test_a_frame_that_is_shown_twice_or_damaged_is_told() -> None:
    assert accounts.of_shown([1, 2, 4, 5], [5], [1, 2, 3, 4], "it") == []
    assert "more than once" in accounts.of_shown([1, 2, 2], [], [1, 2], "it")[0]
    assert "damaged" in accounts.of_shown([1, 5], [], [1, 2], "it")[0]


def test_a_frame_that_the_localizer_neither_processed_nor_skipped_is_told() -> None:
    # Frames 3, 4, 7, 8 were processed, 5 and 6 skipped; 3 came before it counted any.
    taken = [(3, 1), (4, 2), (7, 5), (8, 6)]
    assert accounts.of_localizer(taken) == []
    assert accounts.of_localizer([(3, 1), (4, 4), (7, 5), (8, 6)]) == []  # skipped ones told early
    assert "1 frames are neither" in accounts.of_localizer([(3, 1), (4, 2), (7, 4), (8, 5)])[0]
    assert accounts.of_localizer([(3, 1), (4, 2), (7, 6), (8, 7)])  # one that nobody saw
    assert accounts.of_localizer([(3, 1), (3, 2)])


def test_each_localizer_process_counts_from_its_own_beginning() -> None:
    told = [(0, 5, 4), (0, 6, 5), (0, 9, 1), (0, 10, 2), (1, 12, 30)]
    assert accounts.by_process(told) == [[(5, 4), (6, 5)], [(9, 1), (10, 2)], [(12, 30)]]


def told(state: str, position_m: list[float] | None, time_ns: int, ssrc: int = 7) -> Told:
    note = EstimateMessage(1, time_ns, time_ns, time_ns, state, position_m=position_m)
    return Told("blimp-1", note, 0, ssrc, 0.0, 0)


def test_a_pose_that_is_called_tracking_elsewhere_is_told() -> None:
    truth = Truth(FLIGHT)
    time_ns = 5_000_000_000
    here = truth.at(time_ns)
    off = [here[0] + 1.1 * OFF_M, here[1], here[2]]
    truths = {7: truth, 8: None}
    assert poses([told("TRACKING", [*here], time_ns)], truths) == (0.0, [])
    assert poses([told("DEGRADED", off, time_ns)], truths) == (0.0, [])
    farthest_m, wrong = poses([told("TRACKING", off, time_ns)], truths)
    assert farthest_m == pytest.approx(1.1 * OFF_M) and len(wrong) == 1
    # Of a picture that is in no map, of a stranger's, and of none.
    for ssrc, position_m in ((8, [*here]), (99, [*here]), (7, None)):
        assert poses([told("TRACKING", position_m, time_ns, ssrc)], truths)[1]
    assert poses([told("TRACKING", [float("nan")] * 3, time_ns)], truths)[1]


def test_the_truth_goes_on_from_round_to_round() -> None:
    """The recording has 960 frames at 30 Hz: its loop shifts times by 32 s."""
    truth = Truth(FLIGHT)
    assert truth.round_ns == pytest.approx(32e9, abs=100)
    for time_ns in (1_000_000_000, 17_000_000_000, 32_966_666_667):
        assert (truth.at(time_ns + 3 * truth.round_ns) == truth.at(time_ns)).all()
    assert (truth.at(1_000_000_000) != truth.at(2_000_000_000)).any()


CAME = [Came((n, 1000 + n), 0.1 * n) for n in range(200)]
FRAMES = [one.frame for one in CAME]
END = [[20.0, 20.0]]


def test_a_recording_that_lacks_a_frame_is_told() -> None:
    whole = Recorded("a", FRAMES)
    assert lacking([whole], CAME, END) == []
    holed = FRAMES[:50] + FRAMES[51:]
    assert lacking([Recorded("a", holed)], CAME, END)
    assert lacking([Recorded("a", holed, left_out=1)], CAME, END) == []
    assert lacking([Recorded("a", [*FRAMES[:9], (7, 7), *FRAMES[9:]])], CAME, END)
    assert lacking([Recorded("a", [(7, 7), *FRAMES, (8, 8)])], CAME, END) == []
    assert lacking([Recorded("a", FRAMES, problem="a: broken")], CAME, END) == ["a: broken"]


def test_a_cut_costs_the_last_second_and_no_more() -> None:
    last = round(10 * (20.0 - CUT_S - NOISE_S))
    assert lacking([Recorded("a", FRAMES[: last + 1], cut=True)], CAME, END) == []
    assert lacking([Recorded("a", FRAMES[: last - 3], cut=True)], CAME, END)
    # The next file goes on where it was cut, or does not.
    cut = [[8.0, 8.0], *END]
    first = Recorded("a", FRAMES[:80], cut=True)
    assert lacking([first, Recorded("b", FRAMES[90:])], CAME, cut) == []
    assert lacking([first, Recorded("b", FRAMES[90:])], CAME, END)
    # A full disk ended it at some moment of a window.
    assert lacking([first], CAME, [[7.0, 12.0]]) == []


def test_a_file_is_read_to_its_last_whole_chunk(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    units = [stamped(unit, n) for n, unit in enumerate(encoded(2 * GOP))]
    with RecordingWriter(path, chunk_bytes=20_000) as recording:
        for number, unit in enumerate(units):
            recording.write_video(number, unit)
    found = read(path)
    assert [frame[0] for frame in found.frames] == [*range(len(units))] and not found.cut
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    half = read(path)
    assert half.cut and 0 < len(half.frames) < len(units) and not half.problem
    path.write_bytes(b"nothing of the kind")
    assert read(path).problem


def test_a_seed_draws_the_same_walk_and_each_step_is_mended_in_time() -> None:
    walks = [drawn(seed) for seed in range(200)]
    assert walks == [drawn(seed) for seed in range(200)]
    assert len({walk.steps for walk in walks}) == len(walks)
    assert all(walk.until_s <= WALK_S for walk in walks)
    assert all(drawn(seed, 120.0).until_s > 60.0 for seed in range(5))
    kinds = {type(step) for walk in walks for step in walk.steps}
    assert len(kinds) >= len(DRAWS) - 1  # an SSRC and a session are one kind


def test_a_scenario_is_run_again_from_what_was_kept() -> None:
    for scenario in (*MATRIX, drawn(3)):
        assert from_json(as_json(scenario)) == scenario
    for text in ("", "[]", "{}", '{"name": "a", "steps": [{"step": "Nothing"}]}'):
        with pytest.raises(StepError):
            from_json(text)
    for at_s in ("-1", "1e9", "NaN", '"x"'):
        step = f'{{"step": "Loss", "at_s": {at_s}, "for_s": 1}}'
        with pytest.raises(StepError):
            from_json(f'{{"name": "a", "steps": [{step}]}}')


def test_the_matrix_has_its_thirty_and_those_of_the_tests_are_in_it() -> None:
    names = [scenario.name for scenario in MATRIX]
    assert len(set(names)) == len(names) >= 30 and set(BRIEF) <= set(names)
    assert all(scenario.steps for scenario in MATRIX)


def test_the_least_that_fails_is_found() -> None:
    walk = Scenario("all", tuple(Loss(float(n), 1.0) for n in range(9)))
    guilty = {walk.steps[2], walk.steps[7]}
    tried: list[int] = []

    def fails(scenario: Scenario) -> bool:
        tried.append(len(scenario.steps))
        return guilty <= set(scenario.steps)

    assert set(shrunk(walk, fails).steps) == guilty
    assert len(tried) < 40
    assert shrunk(walk, lambda _: False).steps == walk.steps
    assert len(shrunk(walk, lambda _: True).steps) == 1


def test_impairments_of_several_steps_add_up() -> None:
    both = combined([Loss(0, 1, 0.1).impairment(), Loss(0, 1, 0.2).impairment()])
    assert both.loss == pytest.approx(0.3)
    assert combined([Loss(0, 1, 0.9).impairment()] * 3).loss < 1.0
    assert combined([]).loss == 0.0


def test_a_wire_carries_is_cut_and_is_repaired() -> None:
    with socket.create_server(("127.0.0.1", 0)) as there:
        there.settimeout(5.0)
        with TcpWire(there.getsockname()[1]) as wire:
            near = socket.create_connection(("127.0.0.1", wire.port), 5.0)
            far, _ = there.accept()
            near.sendall(b"one")
            assert far.recv(10) == b"one"
            wire.cut()
            near.settimeout(5.0)
            assert near.recv(10) == b""
            wire.fix()
            with socket.create_connection(("127.0.0.1", wire.port), 5.0) as again:
                far, _ = there.accept()
                far.settimeout(0.3)
                wire.block()
                again.sendall(b"two")
                with pytest.raises(TimeoutError):
                    far.recv(10)
                wire.fix()
                far.settimeout(5.0)
                assert far.recv(10) == b"two"


def test_a_step_that_does_nothing_breaks_the_matrix() -> None:
    assert all(kind.lacking is not Step.lacking for kind in KINDS.values())

    def world_of(peer: Background | None) -> Any:
        said: list[str] = []
        kept = {} if peer is None else {id(step): peer}
        return SimpleNamespace(kept=kept, complaints=said, complain=said.append, say=lambda _: None)

    def raising() -> None:
        raise OSError("no such port")

    step = Garbage(0.0, 2.0)
    for act, found in ((raising, "after 0 times: no such port"), (lambda: False, "after 0 times")):
        peer = Background(act, 0.001).start()
        peer._thread.join(0.05)
        world = world_of(peer)
        _end(world, step, alone=True)
        assert found in world.complaints[0]
    for peer, alone, complaints in ((None, True, 1), (None, False, 0)):
        world = world_of(peer)
        _end(world, step, alone=alone)
        assert len(world.complaints) == complaints
    busy = Background(lambda: None, 0.001).start()
    while not busy.acts:
        time.sleep(0.001)
    world = world_of(busy)
    _end(world, step, alone=True)
    assert world.complaints == []


def test_a_fault_is_alone_where_none_overlaps_it() -> None:
    first, second, third = Loss(0.0, 4.0), Outage(3.0, 4.0), Loss(8.0, 1.0)
    scenario = Scenario("three", (first, second, third))
    assert [scenario.alone(step) for step in scenario.steps] == [False, False, True]


def test_a_step_says_what_it_does() -> None:
    assert str(Outage(2.0, 3.5, telemetry=True)) == "2 s: Outage(telemetry=True) for 3.5 s"
    assert str(Loss(0.0, 1.0)) == "0 s: Loss() for 1 s"
