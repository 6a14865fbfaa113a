"""The live pose graph: the states of the last second, the observations of each, and the process
between.

A fixed-lag smoother on GTSAM's ISAM2 (Kaess et al., IJRR 2012). Its newest state is the causal
estimate; a state that is one lag old leaves it, and is the smoothed one. The two are never mixed.
"""

from __future__ import annotations

import contextlib
from collections import deque
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from ground_station.arrays import F64
from ground_station.localization import process
from ground_station.localization.kinematics import Kinematics, Solution
from ground_station.localization.process import Density, Step
from ground_station.localization.settings import MotionSettings

_ZERO = np.zeros(12)
_UNIT = gtsam.noiseModel.Unit.Create(12)
_ROTATION, _TRANSLATION = np.array([0, 1, 2, 6, 7, 8]), np.array([3, 4, 5, 9, 10, 11])

_QUIET_S = 1 / 30
"""The settings' densities are of a step so long."""

_VAGUE = np.array([0.3] * 3 + [1.0] * 3 + [1.0] * 3 + [2.0] * 3)
"""Standard deviations (rad, m, rad/s, m/s) of a start whose covariance can't be used."""


@dataclass(frozen=True)
class _Node:
    """A state of the graph: its key, and where its factors were made linear."""

    key: int
    anchor: Kinematics


class FixedLagSmoother:
    """Poses and twists of the last `smoother_lag_s`.

    Each state is one 12-vector of GTSAM: its step from the solution it came with. Factors are
    linear at that solution, a frame's observations as a Hessian, the process as a Jacobian, so that
    ISAM2 never calls back into Python. `failures` counts the updates that could not be used and
    restarted the graph. States that leave the lag are kept until `smoothed` is called; without
    `keep` they are forgotten, and what is held never grows."""

    def __init__(self, settings: MotionSettings, keep: bool = True) -> None:
        self.settings = settings
        self._keep = keep
        self.failures = 0
        self.latest: Kinematics | None = None
        """The newest state, estimated from its own frame and those before; None before a start."""
        self._expected: Step | None = None
        self._left: list[Kinematics] = []
        self._adaptation = _Adaptation(settings)
        self._clear()

    def density(self, dt_s: float) -> Density:
        """The process noise of a step so long, as the innovations have set it."""
        return self._adaptation.density(dt_s)

    def begin(self, state: Kinematics) -> None:
        """Forgets all, also the states not asked for, and starts from a state's covariance.

        A covariance that is none is replaced by a vague one.
        """
        self._left = []
        self._start(state)

    def predict(self, time_ns: int, wild: bool = False) -> Kinematics | None:
        """What the process expects at a time, from the newest state; None before a start.

        `wild`: with the densities at their limit, as a camera moves that nothing foretold. Nothing
        is changed: a frame that gives no solution stretches the next one's prediction.
        Raises `ValueError` when the time is before the newest state's.
        """
        if self.latest is None:
            return None
        if wild:
            return self._advance(self.latest, time_ns, wild).state
        return self._expect(self.latest, time_ns).state

    def update(self, solution: Solution, wild: bool = False) -> Kinematics:
        """Adds a solved frame and returns the newest state with its covariance, causal.

        `wild`: it was solved with the wild prediction, so the densities become what it needs.
        `solution.information` and `.gradient` are of the frame's observations alone, at
        `solution.state`. When they can't be used, or the graph becomes singular, it restarts from
        the solution's own state and covariance; when that is not finite either, from the
        prediction. Where nothing came before its time, it starts from the solution, too.
        """
        state, latest = solution.state, self.latest
        assert state is not None
        time_ns = state.time_ns
        if latest is None or time_ns <= latest.time_ns:
            # A given pose's own frame: the solution already holds what was given.
            self._left = []
            return self._start(state)
        self._leave(time_ns)
        try:
            return self._add(latest, state, solution, wild)
        except (RuntimeError, ValueError):
            # GTSAM raises RuntimeError for a singular system, and its graph is then unusable.
            self.failures += 1
            if not _finite(state):
                state = self._advance(latest, time_ns).state
            self._drain()
            return self._start(state)

    def smoothed(self) -> list[Kinematics]:
        """The states that have left the lag since last asked, oldest first: each used the frames of
        `smoother_lag_s` after it, fewer before a restart. Never to be published as causal."""
        left, self._left = self._left, []
        return left

    def flush(self) -> list[Kinematics]:
        """`smoothed()` and the states still within the lag; all is then forgotten.

        For a recording's end, or before a restart from elsewhere.
        """
        self._drain()
        self.latest = None
        return self.smoothed()

    def _clear(self) -> None:
        parameters = gtsam.ISAM2Params()
        # All factors are linear where they stay: nothing is to be made linear again, and all of
        # the lag is to hear of each frame. Cholesky takes two thirds of QR's time; it bears a start
        # that is 10⁷ times as uncertain as the process makes a step (a reason for the settings'
        # limits), QR would bear more.
        parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        parameters.setRelinearizeThreshold(1e12)
        parameters.relinearizeSkip = 1_000_000
        parameters.findUnusedFactorSlots = True  # or its list grows for as long as we fly
        # A little longer than ours: a state is read by us before GTSAM drops it.
        lag_s = self.settings.smoother_lag_s + 1e-3
        self._graph = gtsam.IncrementalFixedLagSmoother(lag_s, parameters)
        self._nodes: deque[_Node] = deque()  # those not yet read
        self._key = 0
        self._sound = True
        self._up: F64 | None = None

    def _start(self, state: Kinematics) -> Kinematics:
        self._clear()
        self._adaptation.restart()
        covariance, information = _usable(state.covariance)
        state = Kinematics(state.time_ns, state.wTc, state.twist, covariance)
        prior = gtsam.HessianFactor(X(0), information, _ZERO, 0.0)
        self._push(state, [prior])
        self.latest, self._expected = state, None
        self._up = state.wTc[2, :3].copy()
        return state

    def _expect(self, latest: Kinematics, time_ns: int) -> Step:
        """The step from the newest state: a frame asks for it twice, to predict and to update."""
        if self._expected is None or self._expected.state.time_ns != time_ns:
            self._expected = self._advance(latest, time_ns)
        return self._expected

    def _advance(self, state: Kinematics, time_ns: int, wild: bool = False) -> Step:
        adapted = self._adaptation
        density = adapted.limit if wild else adapted.density((time_ns - state.time_ns) / 1e9)
        return process.advance(state, time_ns, self.settings, density, self._up)

    def _add(
        self, latest: Kinematics, state: Kinematics, solution: Solution, wild: bool
    ) -> Kinematics:
        information = (solution.information + solution.information.T) / 2
        if not (np.isfinite(information).all() and np.isfinite(solution.gradient).all()):
            raise ValueError("the observations' information is not finite")
        step = self._expect(latest, state.time_ns)
        error = process.difference(step.state, state)
        if not (np.isfinite(error).all() and np.isfinite(step.noise).all()):
            raise ValueError("the step from the last state is not finite")
        if self._adaptation.learn(latest, step, error, information, wild):
            step = self._advance(latest, state.time_ns)
        by_state, by_latest = _error_jacobians(error, step.transition)
        whiten = np.linalg.inv(np.linalg.cholesky(step.noise))
        before = self._newest
        # The process starts from the last state's estimate, which lies a step from its anchor.
        offset = self._graph.calculateEstimateVector(before.key)
        key = X(self._key)
        process_factor = gtsam.JacobianFactor(
            before.key, whiten @ by_latest, key, whiten @ by_state,
            whiten @ (by_latest @ offset - error), _UNIT,
        )  # fmt: skip
        observations = gtsam.HessianFactor(key, information, -solution.gradient, 0.0)
        self._sound = False
        self._push(state, [process_factor, observations])
        result = self._estimate(self._newest)
        np.linalg.cholesky(result.covariance)  # raises where it is no covariance
        self._sound = True
        self.latest, self._expected = result, None
        self._learn_rest(result, (state.time_ns - latest.time_ns) / 1e9)
        return result

    def _push(self, anchor: Kinematics, factors: list[gtsam.GaussianFactor]) -> None:
        key = X(self._key)
        graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        start.insert(key, _ZERO)
        for factor in factors:
            graph.add(gtsam.LinearContainerFactor(factor))
        self._graph.update(graph, start, {key: anchor.time_ns / 1e9})
        self._key += 1
        self._newest = _Node(key, anchor)
        self._nodes.append(self._newest)

    def _estimate(self, node: _Node) -> Kinematics:
        step = self._graph.calculateEstimateVector(node.key)
        covariance = self._graph.marginalCovariance(node.key)
        state = process.moved(node.anchor, step, (covariance + covariance.T) / 2)
        if not (_finite(state) and (np.diag(covariance) > 0).all()):
            raise ValueError("the graph's estimate is not finite")
        return state

    def _leave(self, time_ns: int) -> None:
        """Reads the states that the coming frame pushes out: their lag is over."""
        oldest_ns = time_ns - self.settings.smoother_lag_s * 1e9
        while self._nodes and self._nodes[0].anchor.time_ns < oldest_ns:
            self._take(self._nodes.popleft())

    def _drain(self) -> None:
        # A graph that failed on its way answers anything, or nothing: its states are left out.
        for node in self._nodes if self._sound else ():
            self._take(node)
        self._nodes.clear()

    def _take(self, node: _Node) -> None:
        if not self._keep:
            return
        with contextlib.suppress(RuntimeError, ValueError):
            self._left.append(self._estimate(node))

    def _learn_rest(self, state: Kinematics, dt_s: float) -> None:
        """Where "up" lies in the camera at rest: a slow mean, for the blimp's swing."""
        assert self._up is not None
        share = min(1.0, dt_s / self.settings.rest_time_s)
        up = (1 - share) * self._up + share * state.wTc[2, :3]
        length = float(np.linalg.norm(up))
        if length > 1e-3:
            self._up = up / length


class _Adaptation:
    """The densities of the process, raised and lowered by what the innovations are.

    After Mehra's covariance matching (IEEE TAC 1972), in the form of the likelihood's score. The
    deviation e of a solution from its prediction has the covariance P − P⁺ when the filter is right
    (P predicted, P⁺ with the frame), so y = P⁻¹e has S = P⁻¹ − P⁻¹P⁺P⁻¹. Each density's noise Qᵢ
    weighs the directions in which it tells: yᵀQᵢy is expected to be tr(Qᵢ S).

    No one value serves: simulated blimps (plans loop, small-circle and mapping, seeds 1 to 10) have
    at most 4e-5 rad²/s³ and 5e-4 m²/s³ over a frame, 1e-3 and 8e-3 over 0.5 s; a runner has 3.5 and
    3 over a frame, 0.7 and 1.2 over 0.5 s. The settings' densities are the floor over a frame,
    twice the blimps'; it grows with the step as theirs does, whose accelerations last (0.035 rad/s²
    and 0.12 m/s² at either length). What all frames miss by alike tells nothing of how a camera
    turns, and hides it: of flights at 5 frames a second through two simulated interiors the mean
    error is 0.96 and 0.51 cm by that, 1.17 and 1.05 with one floor for all lengths.
    """

    _MOST = 30.0  # one frame's ratio: an outlier shall not open the filter at once

    def __init__(self, settings: MotionSettings) -> None:
        self.settings = settings
        self.restart()

    def restart(self) -> None:
        """Between quiet and wild: nothing is known yet."""
        self._factor = np.full(2, np.sqrt(self.settings.density_limit))

    def density(self, dt_s: float) -> Density:
        """Of a step so long."""
        return self._times(*np.maximum(self._factor, self._lasting(dt_s)))

    @property
    def limit(self) -> Density:
        """The highest that it is ever raised to."""
        return self._times(self.settings.density_limit, self.settings.density_limit)

    def _lasting(self, dt_s: float) -> float:
        """Times the floor over a frame, the floor over a step."""
        return min(max(1.0, dt_s / _QUIET_S), max(1.0, self.settings.density_limit))

    def _times(self, rotation: float, translation: float) -> Density:
        return Density(
            float(rotation * self.settings.rotation_density_rad2_s3),
            float(translation * self.settings.translation_density_m2_s3),
        )

    def learn(
        self, latest: Kinematics, step: Step, error: F64, information: F64, wild: bool
    ) -> bool:
        """Takes one frame's deviation (12,) into account; whether the densities have changed.

        A `wild` one is no outlier, the whole map says so: it counts in full.
        """
        limit = self.settings.density_limit
        dt_s = (step.state.time_ns - latest.time_ns) / 1e9
        # What is not carried on is no work of the densities.
        if limit <= 1.0 or self.settings.model == "static" or dt_s > self.settings.coast_s:
            return False
        precision = np.linalg.inv(step.state.covariance)
        # P⁻¹ − P⁻¹P⁺P⁻¹ with P⁺ = (P⁻¹ + I)⁻¹
        expected = precision - precision @ np.linalg.solve(precision + information, precision)
        pulled = precision @ error
        share = 1.0 if wild else min(0.5, dt_s / self.settings.density_time_s)
        self._factor = np.maximum(self._factor, self._lasting(dt_s))
        most = np.inf if wild else self._MOST
        for i, axes in enumerate((_ROTATION, _TRANSLATION)):
            noise = step.noise[axes[:, None], axes]
            seen = float(pulled[axes] @ noise @ pulled[axes])
            usual = float(np.sum(noise * expected[axes[:, None], axes]))
            ratio = min(seen / usual, most) if usual > 1e-9 else 1.0
            self._factor[i] = np.clip(self._factor[i] * (1 + share * (ratio - 1)), 1.0, limit)
        return True


def _error_jacobians(error: F64, transition: F64) -> tuple[F64, F64]:
    """(12, 12) each: how the error (12,) of a state against its prediction moves with steps of that
    state and, through the process, of the one before."""
    by_state, by_predicted = np.eye(12), -np.eye(12)
    by_state[:6, :6] = process.inverse_right_jacobian(error[:6])
    by_predicted[:6, :6] = -process.inverse_right_jacobian(-error[:6])
    return by_state, by_predicted @ transition


def _finite(state: Kinematics) -> bool:
    return bool(np.isfinite(state.wTc).all() and np.isfinite(state.twist).all())


def _usable(covariance: F64) -> tuple[F64, F64]:
    """A covariance (12, 12) and its inverse; a vague one when it has none."""
    if covariance.shape == (12, 12) and np.isfinite(covariance).all():
        covariance = (covariance + covariance.T) / 2
        with contextlib.suppress(np.linalg.LinAlgError):
            whiten = np.linalg.inv(np.linalg.cholesky(covariance))
            return covariance, whiten.T @ whiten
    return np.diag(_VAGUE**2), np.diag(_VAGUE**-2.0)
