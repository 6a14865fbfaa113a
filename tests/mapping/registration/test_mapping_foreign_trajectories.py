"""A trajectory that is not the map's own flight's is refused, with the reason and no accuracy.

All are made of the sample map's own mapping flight and of the other flight in the same building.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import test_mapping_pose_similarity as made
from hand_made import content, run
from scipy.spatial.transform import Rotation

from ground_station.errors import BlimpError
from ground_station.geometry import poses
from ground_station.geometry.trajectory import Trajectory, write_tum
from ground_station.map import store
from ground_station.mapping.registration import command
from ground_station.mapping.registration.from_trajectory import by_trajectory
from ground_station.recording.flight import trajectory_of

SAMPLE = Path(__file__).parents[3] / "maps" / "atrium"


class Flights:
    """The mapping flight at 10 Hz and at the keyframes, and another in the same building."""

    def __init__(self) -> None:
        self.map = store.load(SAMPLE)
        sparse = trajectory_of(SAMPLE / "mapping.mcap")
        self.time_ns = np.arange(sparse.time_ns[0], sparse.time_ns[-1] + 1, 100_000_000)
        self.wTc = np.array([sparse.at(int(t)) for t in self.time_ns])
        self.keyframes = sparse
        self.other = trajectory_of(SAMPLE / "flight.mcap")

    def dense(self, wTc: np.ndarray | None = None, later_ns: int = 0) -> Trajectory:
        return Trajectory.from_poses(self.time_ns + later_ns, self.wTc if wTc is None else wTc)


@pytest.fixture(scope="module")
def flights() -> Flights:
    return Flights()


def positions(wTc: np.ndarray, position: np.ndarray) -> np.ndarray:
    return poses.pose(wTc[:, :3, :3], position)


def rotations(wTc: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return poses.pose(rotation, wTc[:, :3, 3])


def jumping(wTc: np.ndarray) -> np.ndarray:
    moved = wTc.copy()
    moved[len(wTc) * 3 // 5 :, :3, 3] += [3.0, 2.0, 0.0]
    return moved


def frozen(wTc: np.ndarray) -> np.ndarray:
    held = wTc.copy()
    held[len(wTc) * 3 // 5 :] = wTc[len(wTc) * 3 // 5]
    return held


def drifting(wTc: np.ndarray) -> np.ndarray:
    """Odometry that loses two degrees of heading a second."""
    steps = poses.inverse(wTc[:-1]) @ wTc[1:]
    steps[:, :3, :3] = Rotation.from_euler("y", 0.2, degrees=True).as_matrix() @ steps[:, :3, :3]
    made = [wTc[0]]
    for step in steps:
        made.append(made[-1] @ step)
    return np.array(made)


def wandering(count: int) -> np.ndarray:
    """Another building: a smooth path and smooth turns that have nothing to do with this map."""
    rng = np.random.default_rng(5)
    phase, rate = rng.uniform(0, 2 * np.pi, (2, 6))
    t = np.linspace(0, 12, count)[:, None]
    waves = np.sin(t * rate / 3 + phase)
    return poses.pose(Rotation.from_rotvec(2 * waves[:, :3]).as_matrix(), 6 * waves[:, 3:])


def another_time(f: Flights, factor: float) -> Trajectory:
    first = f.time_ns[0]
    time_ns = first + np.round((f.time_ns - first) * factor / 1e8).astype(np.int64) * 100_000_000
    return Trajectory.from_poses(time_ns, f.wTc)


def xyzw_as_wxyz(f: Flights) -> Trajectory:
    right = f.dense()
    return Trajectory(right.time_ns, right.position_m, right.quaternion_xyzw[:, [3, 0, 1, 2]])


def stretched_over_the_map(f: Flights) -> Trajectory:
    """The other flight, given the times of the mapping flight."""
    at = np.linspace(0, len(f.other) - 1, len(f.time_ns)).astype(int)
    return f.dense(f.other.wTc[at])


def level(f: Flights) -> np.ndarray:
    """Orientations that nobody measured."""
    return np.tile(np.eye(3), (len(f.wTc), 1, 1))


def even_line(f: Flights) -> np.ndarray:
    """A line that is flown evenly, looking one way."""
    line = np.linspace(0, 1, len(f.wTc))[:, None] * [9.0, 3.0, 0.5]
    return poses.pose(level(f), line)


SHIFT_NS = 1_500_000_000
FOREIGN: dict[str, tuple[Callable[[Flights], Trajectory], str]] = {
    "another flight in the building": (lambda f: f.other, "another flight"),
    "another flight at these times": (stretched_over_the_map, "another flight"),
    "another flight without orientations": (
        lambda f: f.dense(rotations(stretched_over_the_map(f).wTc, level(f))),
        "has not the shape",
    ),
    "another building": (lambda f: f.dense(wandering(len(f.wTc))), "another flight"),
    "shuffled": (
        lambda f: f.dense(f.wTc[np.random.default_rng(1).permutation(len(f.wTc))]),
        "has not the shape",
    ),
    "reversed": (lambda f: f.dense(f.wTc[::-1]), "in reverse it fits"),
    "a clock that is late": (
        lambda f: f.dense(later_ns=SHIFT_NS),
        r"1\.50 s earlier it fits",
    ),
    "a clock that is early": (lambda f: f.dense(later_ns=-SHIFT_NS), r"1\.50 s later it fits"),
    "a clock that runs 10 % fast": (lambda f: another_time(f, 1.1), "another flight or damaged"),
    "times in milliseconds": (
        lambda f: Trajectory.from_poses(f.time_ns * 1000, f.wTc),
        r"keyframes have a pose within .* the map's 1\.000 to",
    ),
    "mirrored": (
        lambda f: f.dense(positions(f.wTc, f.wTc[:, :3, 3] * [-1.0, 1.0, 1.0])),
        "mirrored it fits",
    ),
    "axes of positions changed round": (
        lambda f: f.dense(positions(f.wTc, f.wTc[:, [1, 2, 0], 3])),
        "orientations scatter",
    ),
    "millimetres": (
        lambda f: f.dense(positions(f.wTc, 1000 * f.wTc[:, :3, 3])),
        "is it in millimetres",
    ),
    "quaternions as w, x, y, z": (xyzw_as_wxyz, "write them as x, y, z, w"),
    "world to camera": (lambda f: f.dense(poses.inverse(f.wTc)), "invert them"),
    "rotations inverted": (
        lambda f: f.dense(rotations(f.wTc, np.swapaxes(f.wTc[:, :3, :3], 1, 2))),
        "with its rotations inverted",
    ),
    "orientations by chance": (
        lambda f: f.dense(
            rotations(f.wTc, Rotation.random(len(f.wTc), random_state=2).as_matrix())
        ),
        "orientations scatter",
    ),
    "a jump": (lambda f: f.dense(jumping(f.wTc)), "jumps|not the shape"),
    "lost and frozen": (lambda f: f.dense(frozen(f.wTc)), "jumps|not the shape"),
    "odometry that drifts": (lambda f: f.dense(drifting(f.wTc)), "another flight or damaged"),
    "one place": (
        lambda f: f.dense(np.repeat(f.wTc[:1], len(f.wTc), axis=0)),
        "lie in one place",
    ),
    "an even line": (lambda f: f.dense(even_line(f)), "another flight"),
    "the first seconds, with noise": (
        lambda f: Trajectory.from_poses(f.time_ns[:60], noisy(f, 0.06, 3.0)[:60]),
        "leave others of the map open",
    ),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_foreign_or_damaged_trajectory_is_refused(flights, name):
    make, words = FOREIGN[name]
    with pytest.raises(BlimpError) as caught:
        by_trajectory(flights.map, make(flights), 0)
    said = str(caught.value)
    assert "\n" not in said and "within" not in said.replace("pose within", "")
    assert re.search(words, said), said


def test_the_command_refuses_changes_nothing_and_prints_nothing_else(flights, tmp_path, capsys):
    ignored = shutil.ignore_patterns("*.mcap")
    folder = shutil.copytree(SAMPLE, tmp_path / "map", ignore=ignored)
    before = content(folder)
    other, damaged = tmp_path / "other.txt", tmp_path / "damaged.txt"
    write_tum(other, flights.other)
    write_tum(damaged, flights.dense())
    lines = damaged.read_text().splitlines()
    lines[40] = " ".join([lines[40].split()[0], *["nan"] * 7])
    damaged.write_text("\n".join(lines))
    for path, words in ((other, "another flight"), (damaged, "line 41: eight finite numbers")):
        with pytest.raises(BlimpError, match=words):
            run(command, folder, "--trajectory", path)
        assert capsys.readouterr() == ("", "") and content(folder) == before


def noisy(f: Flights, sigma_m: float, sigma_deg: float) -> np.ndarray:
    rng = np.random.default_rng(3)
    turn = Rotation.from_rotvec(np.radians(sigma_deg) * rng.normal(size=(len(f.wTc), 3)))
    position = f.wTc[:, :3, 3] + sigma_m * rng.normal(size=(len(f.wTc), 3))
    return poses.pose(turn.as_matrix() @ f.wTc[:, :3, :3], position)


def bending(wTc: np.ndarray) -> np.ndarray:
    """A path that is off by centimetres, and by ever more, from two thirds of its way on."""
    over = np.maximum(np.linspace(-2, 1, len(wTc)), 0.0)[:, None]
    return positions(wTc, wTc[:, :3, 3] + over * [0.15, -0.1, 0.05])


def turned(f: Flights, degrees: float) -> np.ndarray:
    return rotations(
        f.wTc, f.wTc[:, :3, :3] @ Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    )


def body_axes(f: Flights) -> np.ndarray:
    return rotations(f.wTc, f.wTc[:, :3, :3] @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]]))


OWN: dict[str, Callable[[Flights], Trajectory]] = {
    "as it is": lambda f: f.dense(),
    "at the keyframes only": lambda f: f.keyframes,
    "centimetres and degrees of noise": lambda f: f.dense(noisy(f, 0.05, 3.0)),
    "a depth camera's axes": lambda f: f.dense(turned(f, 5.0)),
    "a vehicle's axes": lambda f: f.dense(body_axes(f)),
    "without orientations": lambda f: f.dense(rotations(f.wTc, level(f))),
    "the first third": lambda f: Trajectory.from_poses(f.time_ns[:330], f.wTc[:330]),
    "every fourth keyframe": lambda f: Trajectory.from_poses(f.time_ns[::32], f.wTc[::32]),
    "by a map that bends over a third of its way": lambda f: f.dense(bending(f.wTc)),
    "in units of its own": lambda f: f.dense(positions(f.wTc, 0.37 * f.wTc[:, :3, 3])),
    "one pose in ten wrong": lambda f: f.dense(
        positions(f.wTc, f.wTc[:, :3, 3] + 5.0 * (np.arange(len(f.wTc)) % 80 == 8)[:, None])
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", OWN)
def test_a_trajectory_of_the_maps_own_flight_is_taken(flights, name):
    trajectory = OWN[name](flights)
    found = by_trajectory(flights.map, trajectory, 0)
    placed = found.fit.apply(flights.map.keyframes.wTc[:, :3, 3]) / found.fit.scale
    truth = flights.keyframes.position_m
    if "units" in name:
        metric = by_trajectory(flights.map, flights.dense(), 0)
        assert found.fit.scale == pytest.approx(0.37 * metric.fit.scale, rel=1e-6)
    else:
        assert np.median(np.linalg.norm(placed * found.fit.scale - truth, axis=1)) < 0.05


def test_an_evenly_flown_line_without_orientations_shows_nothing():
    """Any such flight would fit it: it is refused, as is a circle."""
    angle = np.linspace(0, 5, 40)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    wTc = poses.pose(np.tile(np.eye(3), (40, 1, 1)), circle)
    map_ = made.model_of(wTc, made.random_similarity(1))
    with pytest.raises(BlimpError, match="fits backwards as well"):
        by_trajectory(map_, made.trajectory_of(wTc), 0)
