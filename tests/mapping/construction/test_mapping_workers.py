"""Threads and a Dask cluster give the same results, in order, and say what stops them in a line."""

from __future__ import annotations

import dataclasses
import operator
import os
import signal
import threading
from concurrent.futures import CancelledError
from pathlib import Path

import numpy as np
import pytest

from ground_station.errors import InputError, MapError
from ground_station.mapping.construction import cluster as dask
from ground_station.mapping.construction.build import structure_key
from ground_station.mapping.construction.dask_option import open_workers, parse_cluster
from ground_station.mapping.construction.images import extract
from ground_station.mapping.construction.verification import match
from ground_station.mapping.construction.workers import (
    Threads,
    in_order,
    under_way,
)
from ground_station.mapping.settings import MappingSettings
from ground_station.recording.open import open_input, parse_range

SETTINGS = MappingSettings(max_features=300, threads=2)


def test_threads_give_results_in_order_with_few_items_in_memory():
    threads, taken, most = Threads(3), 0, 0
    later = threading.Event()

    def slow(k):
        if k == 0:
            assert later.wait(30)  # the first is ready last
        elif k == 7:
            later.set()
        return 2 * k

    def items():
        nonlocal taken
        for k in range(100):
            taken += 1
            yield (k,)

    for given, result in enumerate(threads.map(slow, items())):
        assert result == 2 * given
        most = max(most, taken - given)
    assert given == 99 and most <= under_way(3)


def test_what_came_before_an_input_that_fails_is_received():
    def items():
        yield from ((k,) for k in range(5))
        raise InputError("image 5 cannot be read")

    received = []
    with pytest.raises(InputError, match="image 5"):
        for result in Threads(2).map(abs, items()):
            received.append(result)
    assert received == list(range(5))


def test_a_call_that_fails_ends_the_others():
    calls = []

    def call(k):
        calls.append(k)
        if k == 3:
            raise MapError("3")
        return k

    with pytest.raises(MapError, match="3"):
        list(Threads(1).map(call, ((k,) for k in range(1000))))
    assert len(calls) <= 3 + under_way(1) + 1


def test_items_are_sent_before_the_first_result_is_waited_for():
    sent = []
    results = in_order(((k,) for k in range(9)), lambda item: sent.append(item), lambda _: None, 4)
    next(results)
    assert len(sent) == 4


@pytest.mark.parametrize("text", ["tcp://10.0.0.1:8786", "tls://[fe80::1]:8786", "tls://hall:1"])
def test_a_cluster_is_an_address(text):
    assert parse_cluster(text) == text


@pytest.mark.parametrize(
    "text", ["", "0", "257", "-1", "http://hall:80", "tcp://hall", "hall:8786", "tcp://a b:1", "²"]
)
def test_what_is_no_cluster_is_refused_in_one_line(text):
    with pytest.raises(InputError, match=r"--dask is .*; allowed: tcp://HOST:PORT") as caught:
        open_workers(text, 2, SETTINGS)
    assert "\n" not in str(caught.value)
    assert parse_cluster("8") == 8


def test_where_no_scheduler_is_it_is_said_in_one_line(monkeypatch):
    monkeypatch.setattr(dask, "_CONNECT_S", 1)
    with (
        pytest.raises(MapError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler answers") as caught,
        open_workers("tcp://127.0.0.1:9", 2, SETTINGS),
    ):
        pass
    assert "\n" not in str(caught.value)


class _Client:
    """A client whose workers answer what they are told to."""

    def __init__(self, **answers):
        self._answers = answers

    def run(self, *_, **__):
        return {f"tcp://{name}": answer for name, answer in self._answers.items()}


def test_workers_with_another_program_are_refused_by_name():
    ours = dask.versions(SETTINGS)
    assert set(ours) == {"blimp", "OpenCV", "rootsift"}
    dask._check_workers(_Client(one=ours, two=ours), "tcp://hall:1", SETTINGS)
    for name in ours:
        with pytest.raises(
            MapError, match=rf"tcp://two has {name} 0\.0, this machine {ours[name]}"
        ):
            dask._check_workers(
                _Client(one=ours, two=ours | {name: "0.0"}), "tcp://hall:1", SETTINGS
            )
    with pytest.raises(MapError, match="tcp://two lacks something: no module named x"):
        dask._check_workers(
            _Client(one=ours, two=ImportError("no module named x")), "tcp://hall:1", SETTINGS
        )
    # One that joins later is found by its first call.
    assert dask.checked(ours, SETTINGS, operator.add, 1, 2) == 3
    with pytest.raises(MapError, match="a worker has blimp"):
        dask.checked(ours | {"blimp": "9"}, SETTINGS, operator.add, 1, 2)


class _Failing(_Client):
    """A client whose every call fails in one way."""

    def __init__(self, error, status="running"):
        self.error, self.status, self.sent = error, status, 0

    def nthreads(self):
        return {"tcp://one": 1}

    def submit(self, *_, **__):
        self.sent += 1
        return self

    def result(self, timeout):
        raise self.error


@pytest.mark.parametrize(
    ("error", "status", "words", "sent"),
    [
        (
            dask.distributed.KilledWorker("task", None, 3),
            "running",
            "one task ended every worker",
            1,
        ),
        (CancelledError("lost"), "running", r"the cluster is gone \(lost\)", 4),
        (CancelledError("lost"), "closed", r"the cluster is gone \(lost\)", 1),
        (OSError("closed"), "running", r"the cluster is gone \(closed\)", 1),
        (ModuleNotFoundError("no ground_station"), "running", "another program: no ground_st", 1),
        (MapError("a worker has blimp 9"), "running", "^a worker has blimp 9$", 1),
    ],
)
def test_what_stops_a_cluster_is_said_in_one_line(error, status, words, sent):
    client = _Failing(error, status)
    workers = dask.Cluster(client, "tls://hall:8786", SETTINGS)
    with pytest.raises(MapError, match=words) as caught:
        list(workers.map(abs, [(1,)]))
    assert "\n" not in str(caught.value) and client.sent == sent


def test_a_mistake_of_ours_in_a_worker_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        list(dask.Cluster(_Failing(ZeroDivisionError()), "x", SETTINGS).map(abs, [(1,)]))


def test_a_large_array_goes_beside_the_call_and_small_ones_within():
    """Dask's scheduler keeps what a call carries: pictures would fill it."""

    class Recording(_Client):
        def __init__(self):
            self.scattered, self.called = [], []

        status = "running"

        def nthreads(self):
            return {"tcp://one": 1}

        def scatter(self, values, hash):
            self.scattered += values
            return [_Done(f"scattered {len(self.scattered)}")]

        def submit(self, *args, pure):
            self.called.append(args[4:])
            return _Done(0)

    client = Recording()
    picture, few = np.zeros((480, 640), np.uint8), np.zeros((3, 3))
    workers = dask.Cluster(client, "tls://hall:8786", SETTINGS)
    assert not workers.here
    assert list(workers.map(abs, [(1, picture), (2, few)])) == [0, 0]
    assert len(client.scattered) == 1 and client.scattered[0] is picture
    (one, sent), (two, within) = client.called
    assert (one, two) == (1, 2) and sent.value == "scattered 1" and within is few


class _Done:
    """A future that is ready."""

    status = "finished"

    def __init__(self, value):
        self.value = value

    def result(self, timeout):
        return self.value


def _lost_while_under_way(workers, died):
    """Sums with a shared value that dies, with every worker that has it, when a third are sent."""
    with workers.shared([1000]) as (value,):

        def items():
            for k in range(48):
                if k == 16:
                    client = workers._client
                    died.extend(client.who_has([value.future])[value.future.key])
                    for pid in client.run(os.getpid, workers=died).values():
                        os.kill(pid, signal.SIGKILL)
                yield value, k

        return list(workers.map(operator.add, items()))


def test_two_processes_make_the_same_as_threads_and_one_may_die(sample_frames, tmp_path):
    frames, camera = sample_frames
    alone = extract(frames, camera, SETTINGS, Threads(2), None)
    pairs = match(alone, camera, SETTINGS, Threads(2))
    assert len(pairs) > 3
    expected = structure_key(alone, pairs, camera, SETTINGS)
    with open_workers("2", 2, SETTINGS) as workers:
        assert workers.name == "Dask on this machine, 2 workers"
        assert workers.here
        for folder in (None, tmp_path):
            images = extract(frames, camera, SETTINGS, workers, None, folder=folder)
            found = match(images, camera, SETTINGS, workers)
            # Structure from motion would start from the same, to the bit.
            assert structure_key(images, found, camera, SETTINGS) == expected
        masks = workers._client.run(signal.pthread_sigmask, signal.SIG_BLOCK, [])
        assert [signal.SIGINT in mask for mask in masks.values()] == [True, True]  # Ctrl-C is ours
        died = []
        assert _lost_while_under_way(workers, died) == [1000 + k for k in range(48)]
        assert died
        with pytest.raises(InputError, match="at least 2 frames"):
            extract(frames[:1], camera, SETTINGS, workers, None)


@pytest.fixture
def sample_frames():
    """A few frames of the sample's mapping flight, and its camera."""
    source = open_input(
        Path(__file__).parents[3] / "maps/atrium/mapping.mcap", 30.0, parse_range("0:6")
    )
    frames = list(source)
    assert source.camera is not None
    return frames, dataclasses.replace(source.camera)
