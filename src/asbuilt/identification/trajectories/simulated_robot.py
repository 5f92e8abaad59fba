"""The robot that a simulation moves, what drives it, and what is fitted of its law."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from asbuilt.arrays import Array, Mask, find_finite_rows
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import DriveSet, PositionServo, described_drive
from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording
from asbuilt.findings import Cure
from asbuilt.identification.result.as_built_parameters import as_built_parameters
from asbuilt.identification.result.result import IdentificationResult

DrivenBy = Literal["command", "torque"]

BEYOND = 1e3
"""Time [s] for which the first and the last value are held before and after the log."""


@dataclass(frozen=True, eq=False)
class DriveSignal:
    """Hold a logged signal of n joints as a function of time.

    Parameters
    ----------
    kind
        A commanded position is held until the next one, a torque is interpolated.
    t
        Times [s], increasing, shape (K,).
    values
        Shape (K, n).
    goal
        What a servo that limits its goal makes of the command, as `derive_goal_path` returns it;
        None if the command is the goal.
    """

    kind: DrivenBy
    t: Array
    values: Array
    goal: tuple[Array, Array] | None = None

    @classmethod
    def of(cls, recording: Recording, kind: DrivenBy) -> DriveSignal:
        """Return the command or torque of a recording, without samples that are not finite."""
        logged = recording.tau if kind == "torque" else recording.command
        if logged is None:
            raise ValueError(f"{recording.source} has no {kind}")
        t, values = select_finite(recording.t, logged)
        servo = recording.servo
        limited = kind == "command" and servo is not None and servo.limits_goal
        return cls(kind, t, values, servo.goal(t, values) if limited and servo else None)

    @property
    def _held(self) -> tuple[Array, Array]:
        """Times (M,) and values (M, n) of what the servo holds until the next."""
        return (self.t, self.values) if self.goal is None else self.goal

    @cached_property
    def _sums(self) -> tuple[Array, Array]:
        """Times (M + 2,), and the integrals of the held signal up to them, (n, M + 2)."""
        times, values = self._held
        t = np.concatenate([[times[0] - BEYOND], times, [times[-1] + BEYOND]])
        held = np.concatenate([values[:1], values])
        sums = np.cumsum(held * np.diff(t)[:, None], axis=0)
        return t, np.vstack([np.zeros((1, held.shape[1])), sums]).T.copy()

    def means(self, starts: Array, steps: int, step: float, delay: float = 0.0) -> Array:
        """Return the mean of the delayed signal over each time step, shape (W, steps, n).

        Step k of window w lasts from `starts[w] + k step` to `starts[w] + (k + 1) step`. For a
        held signal the mean is exact, so it is continuous in the delay.
        """
        edges = starts[:, None] + step * np.arange(steps + 1) - delay
        if self.kind == "torque":
            middles = edges[:, :-1] + 0.5 * step
            return np.stack([np.interp(middles, self.t, x) for x in self.values.T], axis=-1)
        t, sums = self._sums
        integrals = np.stack([np.interp(edges, t, x) for x in sums], axis=-1)
        return np.diff(integrals, axis=1) / step

    def slopes(self, starts: Array, steps: int, step: float, delay: float = 0.0) -> Array:
        """Return the derivative of `means` of a held signal by the delay, shape (W, steps, n)."""
        edges = starts[:, None] + step * np.arange(steps + 1) - delay
        times, values = self._held
        at = np.clip(np.searchsorted(times, edges, side="right") - 1, 0, len(times) - 1)
        return -np.diff(values[at], axis=1) / step


def select_finite(t: Array, values: Array) -> tuple[Array, Array]:
    """Return times (K,), each once and in order, and values (K, n) of samples that are finite."""
    there = find_finite_rows(t, values)
    times, first = np.unique(t[there], return_index=True)
    return times, values[there][first]


def choose_driving_signal(recording: Recording) -> DriveSignal:
    """Return what drives a simulation of a recording: its command if it has one and a servo.

    Raises
    ------
    RecordingError
        If it has neither a command nor a torque.
    """
    kind: DrivenBy = "torque"
    if recording.driving_command is not None:
        kind = "command"
    elif not np.any(np.isfinite(recording.tau)):
        raise RecordingError(
            f"{recording.source} has neither torque nor the command of a position servo, so there"
            " is nothing to simulate its motion with",
            cure=Cure("name the command column", settings={"torque_source": "command"}),
            file=recording.source,
        )
    return DriveSignal.of(recording, kind)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRobot:
    """Hold a robot with n joints as a simulation needs it.

    Attributes
    ----------
    model
        The robot with the inertial parameters to simulate.
    drive
        Its drive terms.
    values
        Their parameters joint by joint, shape (n, columns_per_joint).
    servo
        The servo that follows a command; None if torques drive the robot.
    step
        Step [s] of the simulation whose first-order errors are undone; 0: as the steps have it.

    Notes
    -----
    The steps of `stepping.simulate`, and of MuJoCo, take velocities for those in the middle of a
    step: what drives them is early by half a step, and a damping D, which they have at the end,
    acts as `step / 2 D` more armature. With a signal that is later and an armature that is lower
    by as much, they become steps of the leapfrog method, whose errors are of second order (Hairer,
    Lubich & Wanner, Acta Numerica 12, 2003), so that the robot moves as with small steps. Coriolis
    forces, half a step early, and the damping of a servo at its torque limit keep first order.
    """

    model: RobotModel
    drive: DriveSet
    values: Array
    servo: PositionServo | None = None
    step: float = 0.0

    @property
    def _law(self) -> PositionServo:
        """The servo, or one that gives no torque."""
        none = (0.0,) * self.model.n_joints
        return PositionServo(kp=none, kd=none) if self.servo is None else self.servo

    @property
    def stiffness(self) -> tuple[Array, Array, Array]:
        """Gains kp, kd and torque limit of the servo, three (n,); unknown gains are zero."""
        kp, kd = (np.nan_to_num(np.array(x)) for x in (self._law.kp, self._law.kd))
        return kp, kd, np.array(self._law.torque_limit)

    @property
    def deviations(self) -> tuple[Array, Array]:
        """Deadband of the servo, and how much its torque limit falls per speed, two (n,)."""
        return np.nan_to_num(np.array(self._law.deadband)), self._law.falling

    @property
    def lead(self) -> Array:
        """Lead of the servo [s], shape (n,)."""
        return self._law.leads

    @property
    def delay(self) -> float:
        """Delay of what drives the simulation [s]."""
        return (self._law.delay or 0.0) + 0.5 * self.step

    def values_of(self, *keys: str) -> Array:
        """Return the columns of the values that belong to some terms, shape (n, columns)."""
        of = [term.key for term in self.drive.terms for _ in term.symbols]
        return self.values[:, np.isin(of, keys)]

    def value_of(self, key: str) -> Array:
        """Return the values (n,) of a term with one parameter, zero where a joint lacks it."""
        term = next((term for term in self.drive.terms if term.key == key), None)
        if term is None:
            return np.zeros(self.model.n_joints)
        there = [term.is_at(k) for k in range(self.model.n_joints)]
        return np.where(there, self.values_of(key)[:, 0], 0.0)

    def centred(self, step: float) -> SimulatedRobot:
        """Return the robot for steps [s] whose first-order errors are undone."""
        return replace(self, step=step)

    def driven_by(self, signal: DriveSignal) -> SimulatedRobot:
        """Return the robot as a signal drives it: its servo acts only where that is a command."""
        # A torque drives the robot directly: its servo would add to it.
        return self if signal.kind == "command" else replace(self, servo=None)


def choose_law(recording: Recording, result: IdentificationResult | None) -> PositionServo | None:
    """Return the law of the drives under commands: as identified, else as stated for a recording.

    None where torques were measured.
    """
    return recording.servo if result is None or result.servo is None else result.servo


def build_robot_as_built(
    result: IdentificationResult, servo: PositionServo | None = None
) -> SimulatedRobot:
    """Return the robot with the standard parameters closest to CAD that a result supports."""
    chi = as_built_parameters(result).parameters
    links = 10 * result.model.n_links
    return SimulatedRobot(
        result.model.with_parameters(chi[:links]),
        result.base.drive,
        chi[links:].reshape(result.model.n_joints, -1),
        servo,
    )


def build_robot_as_described(
    model: RobotModel, servo: PositionServo | None = None
) -> SimulatedRobot:
    """Return the robot with the inertias, drive terms and values of its description."""
    drive, values = described_drive(model)
    return SimulatedRobot(model, drive, values.reshape(model.n_joints, -1), servo)


TIME_SCALE = 1e-3
"""Unit of delay and lead in the coordinates [s]."""
STIFFNESS_SPREAD = 1.0
"""Prior standard deviation of the logarithm of a common stiffness that nothing determines."""
TIME_SPREAD = 20.0
"""Prior standard deviation of delay and lead, in units of `TIME_SCALE`."""


@dataclass(frozen=True, slots=True)
class ServoCoordinates:
    """Say what is fitted of a servo.

    The coordinates are, as far as they are free, the logarithm of a common factor of all
    stiffnesses, the delay, and a common addition to the leads. A lead is estimated if the torque
    seems to precede its command: a derivative gain advances it, and the delay itself, which causes
    nothing before the command, stays at or above zero.

    Parameters
    ----------
    stiffness, delay, lead
        What is free.
    spread
        Standard deviation of the logarithm of a common stiffness before the trajectories.
    """

    stiffness: bool = False
    delay: bool = False
    lead: bool = False
    spread: float = STIFFNESS_SPREAD

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        free = (("stiffness", self.stiffness), ("delay", self.delay), ("lead", self.lead))
        return tuple(name for name, there in free if there)

    @property
    def weights(self) -> Array:
        """Weights of the squared coordinates from the start, one each."""
        spreads = {"stiffness": self.spread, "delay": TIME_SPREAD, "lead": TIME_SPREAD}
        return np.array([spreads[name] ** -2.0 for name in self.names])


@dataclass(frozen=True, slots=True)
class FittedLaw:
    """Hold a servo at a point of a search, with its c coordinates; without one there are none.

    Parameters
    ----------
    servo
        The servo; None where torques drive the robot.
    free
        What is fitted of it.
    """

    servo: PositionServo | None = None
    free: ServoCoordinates = field(default_factory=ServoCoordinates)

    @classmethod
    def of(cls, servo: PositionServo | None, free: ServoCoordinates | None) -> FittedLaw:
        """Return the law with what is free of a servo, but its lead; None: its delay."""
        if servo is None:
            return cls()
        return cls(
            servo, ServoCoordinates(delay=True) if free is None else replace(free, lead=False)
        )

    @property
    def columns(self) -> Array:
        """How kp and kd of each joint, delay and lead follow the coordinates, (2 n + 2, c)."""
        if self.servo is None:
            return np.empty((1, 0))
        n = len(self.servo.kp)
        found = np.zeros((2 * n + 2, len(self.free.names)))
        for column, name in enumerate(self.free.names):
            if name == "stiffness":
                found[:n, column] = self.servo.kp
            else:
                found[2 * n + (name == "lead"), column] = TIME_SCALE
        return found

    def moved(self, step: Array) -> FittedLaw:
        """Return the law at coordinates `step` (c,) from it."""
        servo = self.servo
        if servo is None:
            return self
        by = dict(zip(self.free.names, step.tolist(), strict=True))
        if "stiffness" in by:
            factor = float(np.exp(by["stiffness"]))
            servo = replace(servo, kp=tuple(factor * kp for kp in servo.kp))
        if "delay" in by:
            late = (servo.delay or 0.0) + TIME_SCALE * by["delay"]
            servo = replace(servo, delay=max(late, 0.0) if self.free.lead else late)
        if "lead" in by:
            leads = np.maximum(servo.leads + TIME_SCALE * by["lead"], 0.0)
            servo = replace(servo, lead=tuple(leads.tolist()))
        return replace(self, servo=servo)

    def at_bound(self, gradient: Array) -> Mask:
        """Return which coordinates (c,) lie at their bound with the descent beyond it."""
        if self.servo is None:
            return np.empty(0, dtype=np.bool_)
        low = {
            "stiffness": False,
            "delay": self.free.lead and not (self.servo.delay or 0.0) > 0.0,
            "lead": not np.any(self.servo.leads > 0.0),
        }
        return np.array([low[name] for name in self.free.names], dtype=np.bool_) & (gradient > 0.0)

    def away(self, start: FittedLaw) -> Array:
        """Return the coordinates (c,) from another law."""
        if self.servo is None or start.servo is None:
            return np.zeros(len(self.free.names))
        distance = {
            "stiffness": np.log(self.stiffness_factor(start)),
            "delay": ((self.servo.delay or 0.0) - (start.servo.delay or 0.0)) / TIME_SCALE,
            "lead": float(np.mean(self.servo.leads - start.servo.leads)) / TIME_SCALE,
        }
        return np.array([distance[name] for name in self.free.names])

    def stiffness_factor(self, start: FittedLaw) -> float:
        """Return the factor of all stiffnesses from another law, 1 where none is fitted."""
        if self.servo is None or start.servo is None or not self.free.stiffness:
            return 1.0
        # A joint that the servo does not hold has none.
        return max(self.servo.kp) / max(start.servo.kp)
