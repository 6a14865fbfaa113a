"""Flight plans: closed paths through a hall with the heading along them, at a given speed.

Flights are ellipses about the hall's middle that keep clear of pillars, furniture and lamps. Two
plans are of a person's camera: `headset` walks through the doorways of a scene that has walks, and
`stills` stands on a grid and looks around at each place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from ground_station.arrays import F64
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.simulator.scene import Scene, SimulatorError

Shape = Callable[[F64], tuple[F64, F64]]
"""From a path parameter (N,) in turns to positions (N, 3), metres, and yaw (N,), radians."""


_OFF_WALLS_M, _LOOKED_AT = 0.3, 400
"""How near a path may come to a scene's outermost walls, and at how many places it is looked at."""

WIDE_CAMERA = Camera(
    fx_px=343.2, fy_px=343.2, cx_px=322.4, cy_px=236.8, k1=-0.2171, k2=0.0523, k3=-0.0056
)
"""A wide lens, 100 degrees from side to side: what five parameters make of a stereographic one."""

HEADSET_CAMERA = Camera(
    fx_px=450.0, fy_px=450.0, cx_px=317.2, cy_px=243.5, k1=-0.12, k2=0.03, p1=0.0004, p2=-0.0003
)
"""A headset's camera, some 75 degrees wide, with a global shutter."""

PHONE_CAMERA = Camera(
    fx_px=560.0, fy_px=560.0, cx_px=318.6, cy_px=241.3, k1=0.06, k2=-0.1, readout_s=0.02
)
"""A phone's camera, some 60 degrees wide, with a rolling shutter."""

_CAMERAS = {"stills": WIDE_CAMERA, "headset": HEADSET_CAMERA, "walk": PHONE_CAMERA}

GRID_M, PLACES, HEADINGS = (3.8, 1.8), (4, 3), 8
"""Spacing and number of the stills' places along x and y; headings at each, evenly around."""

_EYE_M = 1.6
_ROUNDING_M = 0.35  # deviation of what rounds the corners of a walk


@dataclass(frozen=True)
class Plan:
    """A closed path: `shape` over `turns`, flown at `speed_m_s` and by hand or by the blimp.

    With `stands` it is not flown: pictures are taken at as many even steps of the one turn. By hand
    `bearer` says who carries the camera. `rate_hz` is what it is filmed at unless something else is
    asked for.
    """

    name: str
    shape: Shape
    turns: float
    speed_m_s: float
    by_hand: bool
    default_duration_s: float
    bearer: str = "runner"
    stands: int = 0
    rate_hz: float = 30.0

    @property
    def camera(self) -> Camera:
        """What it is filmed with unless something else is asked for."""
        return camera_of(self.name)


def camera_of(plan: str) -> Camera:
    """The camera of a plan by its name: a person's, or else the payload's."""
    return _CAMERAS.get(plan, THESIS_CAMERA)


class Reference:
    """Where a plan wants to be at a time: arc length grows at the plan's speed, forever."""

    def __init__(self, plan: Plan, phase: float, ramp_s: float = 0.0) -> None:
        s = np.linspace(0, plan.turns, 4000)
        position, yaw = plan.shape(s)
        steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
        length = np.concatenate([[0], np.cumsum(steps)])
        # The yaw of a lap differs by whole turns from its start: periodic but for that.
        self._lap_m, self._lap_yaw = float(length[-1]), float(yaw[-1] - yaw[0])
        self._position = CubicSpline(length, np.vstack([position[:-1], position[:1]]),
                                     bc_type="periodic")  # fmt: skip
        self._yaw = CubicSpline(length, yaw)
        self._phase_m = phase * self._lap_m
        self._speed, self._ramp_s = plan.speed_m_s, ramp_s

    def at(self, times_s: npt.ArrayLike) -> tuple[F64, F64]:
        """Positions (N, 3), metres, and yaw (N,), radians and unwrapped, at times (N,)."""
        t = np.asarray(times_s, dtype=np.float64)
        if self._ramp_s > 0:  # from rest: the integral of a smooth start
            x = np.clip(t / self._ramp_s, 0, 1)
            run = self._ramp_s * (x**3 - x**4 / 2) + np.maximum(t - self._ramp_s, 0)
        else:
            run = t
        distance = self._phase_m + self._speed * run
        laps = np.floor(distance / self._lap_m)
        rest = distance - laps * self._lap_m
        return self._position(rest), self._yaw(rest) + laps * self._lap_yaw


def _smooth(x: F64, a: float, b: float) -> F64:
    t = np.clip((x - a) / (b - a), 0, 1)
    return t * t * t * (10 - 15 * t + 6 * t * t)


def _ellipse(
    angle: F64, centre: tuple[float, float], rx: F64 | float, ry: F64 | float, z: F64
) -> F64:
    return np.stack([centre[0] + rx * np.cos(angle), centre[1] + ry * np.sin(angle), z], axis=1)


def plan_named(name: str, scene: Scene, rng: np.random.Generator) -> Plan:
    """The plan of that name for a scene; `rng` shifts its path a little.

    Raises `SimulatorError` naming the plans there are, and for one that leaves the scene.
    """
    plans: dict[str, Callable[[tuple[float, float], F64], Plan]] = {
        "mapping": _mapping,
        "loop": _loop,
        "small-circle": _small_circle,
        "fast": partial(_fast, scene),
        "corridor": _corridor,
        "stills": _stills,
        "headset": partial(_headset, scene),
        "walk": partial(_walk, scene),
        "tour": partial(_tour, scene),
        "board": partial(_board, scene),
    }
    if name not in plans:
        raise SimulatorError(f"plan '{name}' is unknown; there are: {', '.join(plans)}")
    centre = (scene.size_m[0] / 2, scene.size_m[1] / 2 - 0.1)
    shift = rng.uniform(-1, 1, 4)
    plan = plans[name](centre, shift)
    path, _ = plan.shape(np.linspace(0, plan.turns, _LOOKED_AT))
    if (path < _OFF_WALLS_M).any() or (path > np.array(scene.size_m) - _OFF_WALLS_M).any():
        size = " x ".join(f"{length:g}" for length in scene.size_m)
        raise SimulatorError(f"plan '{name}' does not fit into '{scene.name}' ({size} m)")
    return plan


def _mapping(centre: tuple[float, float], shift: F64) -> Plan:
    """A wide lap looking inwards, flown sideways, then a narrow one looking outwards."""

    def shape(s: F64) -> tuple[F64, F64]:
        inner = _smooth(s, 0.9, 1.2) - _smooth(s, 1.75, 2.0)
        angle = 2 * np.pi * s
        rx, ry = 7.9 - 4.5 * inner, 3.7 - 1.4 * inner
        z = 2.75 + 0.75 * np.sin(3 * angle + shift[0]) + 0.35 * np.sin(angle)
        # Outwards after half a turn more, which the return leg completes.
        turned = _smooth(s, 0.9, 1.2) + _smooth(s, 1.65, 2.0)
        yaw = angle + np.pi + np.pi * turned + 0.25 * np.sin(2 * angle)
        return _ellipse(angle, centre, rx, ry, z), yaw

    return Plan("mapping", shape, 2.0, 0.65, False, 100.0)


def _loop(centre: tuple[float, float], shift: F64) -> Plan:
    """A large loop facing inwards."""

    def shape(s: F64) -> tuple[F64, F64]:
        angle = 2 * np.pi * s
        z = 2.9 + 0.15 * shift[0] + 0.4 * np.sin(2 * angle + shift[1])
        rx, ry = 6.6 + 0.3 * shift[2], 3.0 + 0.2 * shift[3]
        yaw = angle + np.pi + 0.3 * np.sin(angle + 1.0)
        return _ellipse(angle, centre, rx, ry, z), yaw

    return Plan("loop", shape, 1.0, 0.65, False, 50.0)


def _small_circle(centre: tuple[float, float], shift: F64) -> Plan:
    """A small circle facing forwards, a little outwards."""

    def shape(s: F64) -> tuple[F64, F64]:
        angle = 2 * np.pi * s
        z = 2.8 + 0.15 * shift[0] + 0.25 * np.sin(angle + shift[1])
        r = 1.9 + 0.15 * shift[2]
        yaw = angle + np.pi / 2 - 0.5
        return _ellipse(angle, (centre[0] + 0.2 * shift[3], centre[1]), r, r, z), yaw

    return Plan("small-circle", shape, 1.0, 0.5, False, 40.0)


def _fast(scene: Scene, centre: tuple[float, float], shift: F64) -> Plan:
    """Run around the hall at 4 m/s, the camera in the hand: 4 m/s over 4.75 m is 48°/s."""
    middle, (rx, ry) = (centre[0], centre[1] - 0.15), (4.75, 4.75)
    if scene.ring_m is not None:
        middle, (rx, ry) = (scene.size_m[0] / 2, scene.size_m[1] / 2), scene.ring_m

    def shape(s: F64) -> tuple[F64, F64]:
        angle = 2 * np.pi * s
        z = np.full_like(angle, 1.65 + 0.03 * shift[0])
        yaw = angle + np.pi / 2 + 0.25 * np.sin(3 * angle + shift[1]) + 0.15
        return _ellipse(angle, middle, rx, ry, z), yaw

    return Plan("fast", shape, 1.0, 4.0, True, 30.0)


def _corridor(centre: tuple[float, float], shift: F64) -> Plan:
    """There and back along a corridor, flown sideways, the camera on its north wall."""
    half, r = centre[0] - 3.0, 0.5
    straight, arc = 2 * half, np.pi * r
    lap = 2 * (straight + arc)

    def shape(s: F64) -> tuple[F64, F64]:
        d = (np.asarray(s) % 1.0) * lap
        east, west = (d - straight) / r, (d - 2 * straight - arc) / r  # angles around the ends
        legs = [d < straight, east < np.pi, d < 2 * straight + arc]
        x = np.select(
            legs,
            [d - half, half + r * np.sin(east), half - (d - straight - arc)],
            -half - r * np.sin(west),
        )
        y = np.select(legs, [np.full_like(d, -r), -r * np.cos(east), np.full_like(d, r)],
                      r * np.cos(west))  # fmt: skip
        turn = 2 * np.pi * np.asarray(s)
        z = 1.95 + 0.12 * np.sin(3 * turn + shift[0])
        yaw = np.pi / 2 - 0.35 * np.sin(turn) + 0.1 * np.sin(5 * turn + shift[1])
        return np.stack([centre[0] + x, centre[1] - 0.6 + y, z], axis=1), yaw

    return Plan("corridor", shape, 1.0, 0.45, False, 105.0)


def _stills(centre: tuple[float, float], shift: F64) -> Plan:
    """A grid of places, at each of them pictures all around; no way leads from one to the next."""
    count = PLACES[0] * PLACES[1] * HEADINGS

    def shape(s: F64) -> tuple[F64, F64]:
        index = np.minimum((np.asarray(s) * count).astype(np.int64), count - 1)
        place, heading = np.divmod(index, HEADINGS)
        cell = np.stack(np.divmod(place, PLACES[1]), axis=1)
        spot = (cell - (np.array(PLACES) - 1) / 2) * GRID_M + np.array(centre) + 0.2 * shift[:2]
        z = np.full(len(spot), _EYE_M + 0.05 * shift[2])
        yaw = 2 * np.pi * heading / HEADINGS + 0.2 * shift[3]
        return np.column_stack([spot, z]), yaw

    return Plan("stills", shape, 1.0, 0.0, True, 2.0 * count, stands=count, rate_hz=0.5)


def _headset(scene: Scene, centre: tuple[float, float], shift: F64) -> Plan:
    """30 m on foot through rooms: once around a short walk, or part of a long one, at random."""
    if not scene.walks:
        raise SimulatorError(
            f"plan 'headset' walks through doorways; scene '{scene.name}' has none: --scene rooms"
        )
    corners = np.array(scene.walks[int(shift[0] > 0) % len(scene.walks)])
    corners = corners if shift[1] > 0 else corners[::-1]  # the other way round
    legs = np.diff(np.vstack([corners, corners[:1]]), axis=0)
    reach = np.concatenate([[0], np.cumsum(np.linalg.norm(legs, axis=1))])
    length_m, step_m = float(reach[-1]), 0.02
    along = np.arange(0, length_m, step_m)
    closed = np.vstack([corners, corners[:1]])
    raw = np.stack([np.interp(along, reach, column) for column in closed.T], axis=1)
    path = gaussian_filter1d(raw, _ROUNDING_M / step_m, axis=0, mode="wrap")
    path = np.vstack([path, path[:1]])
    spline = CubicSpline(np.linspace(0, 1, len(path)), path, bc_type="periodic")
    tangent = spline(np.linspace(0, 1, len(path)), 1)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    turning = CubicSpline(np.linspace(0, 1, len(path)), heading)

    def shape(s: F64) -> tuple[F64, F64]:
        place = spline(np.asarray(s))
        z = np.full(len(place), _EYE_M + 0.06 * shift[2])
        return np.column_stack([place, z]), turning(np.asarray(s))

    return Plan("headset", shape, 1.0, 0.8, True, 39.0, bearer="wearer", rate_hz=5.0)


def _ring(scene: Scene, name: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """The middle and half axes of a scene's free way; raises `SimulatorError` without one."""
    if scene.ring_m is None:
        raise SimulatorError(
            f"plan '{name}' goes round a scene's free way; '{scene.name}' has none: "
            "--scene interior-1"
        )
    return (scene.size_m[0] / 2, scene.size_m[1] / 2), scene.ring_m


def _walk(scene: Scene, _: tuple[float, float], shift: F64) -> Plan:
    """Twice round on foot with a phone: a lap that looks across, then one along the way."""
    middle, (rx, ry) = _ring(scene, "walk")

    def shape(s: F64) -> tuple[F64, F64]:
        angle = 2 * np.pi * s
        ahead = _smooth(s, 0.9, 1.1) - _smooth(s, 1.8, 2.0)
        yaw = angle + np.pi - 0.5 * np.pi * ahead + 0.2 * np.sin(3 * angle + shift[0])
        z = np.full_like(angle, _EYE_M + 0.05 * shift[1])
        return _ellipse(angle, middle, rx, ry, z), yaw

    length_m = 4 * np.pi * float(np.hypot(rx, ry)) / np.sqrt(2)
    return Plan("walk", shape, 2.0, 0.6, True, round(length_m / 0.6), bearer="walker", rate_hz=2.0)


def _tour(scene: Scene, _: tuple[float, float], shift: F64) -> Plan:
    """A blimp's round between 2 m and 7 m, as high as the ceiling lets it, looking half ahead."""
    middle, (rx, ry) = _ring(scene, "tour")
    low, high = 2.0, max(2.05, min(7.0, scene.size_m[2] - 0.9))

    def shape(s: F64) -> tuple[F64, F64]:
        angle = 2 * np.pi * s
        share = 0.8 + 0.15 * shift[0] + 0.1 * np.sin(3 * angle + shift[1])
        z = (low + high) / 2 + (high - low) / 2 * np.sin(2 * angle + 3 * shift[2])
        yaw = angle + 0.75 * np.pi + 0.5 * np.sin(2 * angle + 3 * shift[3])
        return _ellipse(angle, middle, share * rx, share * ry, z), yaw

    return Plan("tour", shape, 1.0, 0.6, False, 40.0)


def _board(scene: Scene, _: tuple[float, float], shift: F64) -> Plan:
    """About a printed board, to calibrate the camera by: `board.carry_about`."""
    if scene.name != "board":
        raise SimulatorError(
            f"plan 'board' films a board; scene '{scene.name}' has none: --scene board"
        )

    def shape(s: F64) -> tuple[F64, F64]:
        return np.tile(scene.centre_m, (len(s), 1)), np.zeros(len(s))

    return Plan("board", shape, 1.0, 0.0, True, 20.0)
