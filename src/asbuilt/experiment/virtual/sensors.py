"""Sensors of a virtual robot: errors of encoders and torque sensors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError
from asbuilt.excitation.motions.motion import Trajectory

PerJoint = float | tuple[float, ...]
"""One number for all joints, or one per joint."""


class JointFields:
    """Give fields that are one number or one per joint; those of `signed` may be negative."""

    __slots__ = ()
    signed: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def list_per_joint(cls) -> list[str]:
        """Return the fields that may have one number per joint."""
        return [name for name, kind in cls.__annotations__.items() if "PerJoint" in str(kind)]

    def of(self, name: str, n: int) -> Array:
        """Return a field for n joints, shape (n,).

        Raises `UsageError` for another number of joints, and for a negative one unless it is
        `signed`.
        """
        value = getattr(self, name)
        array = np.atleast_1d(np.asarray(value, dtype=np.float64))
        signed = name in self.signed
        fits = array.shape in ((1,), (n,)) and np.all(np.isfinite(array))
        if not fits or (not signed and np.any(array < 0)):
            raise UsageError(
                f"{name} must be one {'' if signed else 'non-negative '}number or one per joint"
                f" ({n}), got {value}",
                value=value,
                parameter=name,
            )
        return np.broadcast_to(array, (n,))

    def check(self, model: RobotModel) -> None:
        """Raise `UsageError` unless every field fits a robot and no magnitude is negative."""
        for name in self.list_per_joint():
            if getattr(self, name) is not None:
                self.of(name, model.n_joints)


@dataclass(frozen=True, slots=True)
class SensorNoise(JointFields):
    """Describe the errors of the sensors.

    Every field is one number or one per joint; the defaults are a perfect sensor. A position is
    `round_to(q + N(0, position_noise), 2 pi / encoder_counts)`, a torque `round_to(torque_gain tau
    + torque_bias + ripple + N(0, torque_noise), torque_resolution)` with `ripple = torque_ripple
    sin(ripple_cycles q + ripple_phase)`. Noise is white and independent.

    Parameters
    ----------
    position_noise, velocity_noise, torque_noise
        Standard deviations; velocities are logged only if theirs is given.
    encoder_counts
        Counts per turn at the joint, or per metre; 0 for no quantisation.
    torque_bias, torque_gain, torque_resolution
        Offset, factor and step of the torque.
    torque_ripple, ripple_cycles, ripple_phase
        Amplitude, cycles per turn (or per metre) and phase [rad] of the ripple.
    torque_delay
        Time [s] by which the torque is late; before that much has passed the first one holds.
    """

    signed: ClassVar[tuple[str, ...]] = (
        "torque_bias",
        "torque_gain",
        "ripple_phase",
        "torque_delay",
    )

    position_noise: PerJoint = 0.0
    encoder_counts: PerJoint = 0.0
    torque_noise: PerJoint = 0.0
    torque_bias: PerJoint = 0.0
    torque_resolution: PerJoint = 0.0
    velocity_noise: PerJoint | None = None
    torque_gain: PerJoint = 1.0
    torque_ripple: PerJoint = 0.0
    ripple_cycles: PerJoint = 200.0
    ripple_phase: PerJoint = 0.0
    torque_delay: PerJoint = 0.0

    def delayed(self, t: Array, tau: Array) -> Array:
        """Return torques (N, n) at times t (N,) [s] as late as `torque_delay` says."""
        delay = self.of("torque_delay", tau.shape[1])
        if not np.any(delay):
            return tau
        return np.stack(
            [
                PchipInterpolator(t, x)(np.clip(t - late, t[0], t[-1]))
                for x, late in zip(tau.T, delay, strict=True)
            ],
            axis=1,
        )

    def measured(
        self, model: RobotModel, truth: Trajectory, tau: Array, rng: np.random.Generator
    ) -> tuple[Array, Array | None, Array]:
        """Return measured position, velocity (None if not logged) and torque, each (N, n).

        Raises
        ------
        UsageError
            If a field does not fit the joints, or a magnitude is negative.
        """
        n = model.n_joints
        of = partial(self.of, n=n)
        turn = np.where([joint.is_revolute for joint in model.joints], 2 * np.pi, 1.0)
        counts = of("encoder_counts")
        ripple = of("torque_ripple")
        step = np.divide(turn, counts, out=np.zeros(n), where=counts > 0)
        q = truth.q + of("position_noise") * rng.standard_normal(truth.q.shape)
        torque = (
            tau * of("torque_gain")
            + of("torque_bias")
            + of("torque_noise") * rng.standard_normal(tau.shape)
        )
        if np.any(ripple > 0):
            waves = of("ripple_cycles") * 2 * np.pi / turn
            torque = torque + ripple * np.sin(waves * truth.q + of("ripple_phase"))
        qd = None
        if self.velocity_noise is not None:
            qd = truth.qd + of("velocity_noise") * rng.standard_normal(truth.qd.shape)
        return _round_to_step(q, step), qd, _round_to_step(torque, of("torque_resolution"))


PERFECT_SENSORS = SensorNoise()
"""Sensors that add nothing."""


def _round_to_step(values: Array, step: Array) -> Array:
    """Return the nearest multiples of `step` (n,); a step of 0 leaves values as they are."""
    safe = np.where(step > 0, step, 1.0)
    return np.where(step > 0, np.round(values / safe) * safe, values)


@dataclass(frozen=True, slots=True, kw_only=True)
class DataLogger:
    """Describe a logger.

    Parameters
    ----------
    rate
        Sampling rate [Hz].
    clock_jitter
        Standard deviation of the error of a time stamp [s].
    dropped, burst
        Fraction of the samples that is lost, and mean length of a burst of lost samples.
    accelerations
        Whether true velocities and accelerations are logged too, with perfect sensors only.

    Raises
    ------
    UsageError
        If a value is outside its range.
    """

    rate: float = 1000.0
    clock_jitter: float = 0.0
    dropped: float = 0.0
    burst: float = 3.0
    accelerations: bool = False

    def __post_init__(self) -> None:
        half = 0.5 / self.rate if self.rate > 0 else np.inf
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise UsageError(
                f"the rate of the logger must be a positive number of Hz, got {self.rate}",
                value=self.rate,
                lower=0.0,
            )
        if not 0.0 <= self.clock_jitter < half:
            raise UsageError(
                f"clock_jitter must be below half a sampling period, {half:g} s at"
                f" {self.rate:g} Hz, got {self.clock_jitter}",
                value=self.clock_jitter,
                lower=0.0,
                upper=half,
            )
        if not (0.0 <= self.dropped < 1.0 and self.burst >= 1.0):
            raise UsageError(
                "dropped must be from 0 to below 1 and burst at least 1, got"
                f" {self.dropped} and {self.burst}",
                value=(self.dropped, self.burst),
            )

    def logged(
        self,
        model: RobotModel,
        sensors: SensorNoise,
        truth: Trajectory,
        tau: Array,
        command: Array,
        rng: np.random.Generator,
    ) -> dict[str, Array]:
        """Return the log of a motion and its torque (N, n), sampled at a multiple of the rate.

        Its columns are `t` (N,), `q`, `tau`, `q_command` and, if logged, `qd` and `qdd` (N, n).
        """
        pick = slice(None, None, round(1.0 / self.rate / (truth.t[1] - truth.t[0])))
        seen = Trajectory(truth.t[pick], truth.q[pick], truth.qd[pick], truth.qdd[pick])
        q, qd, torque = sensors.measured(model, seen, sensors.delayed(truth.t, tau)[pick], rng)
        t = seen.t.copy()
        if self.clock_jitter:
            most = 0.45 / self.rate  # so that no time stamp overtakes the next
            slips = np.clip(self.clock_jitter * rng.standard_normal(t.size), -most, most)
            t = t + slips - slips[0]
        columns = {"t": t, "q": q, "tau": torque, "q_command": command[pick]}
        if sensors == PERFECT_SENSORS and self.accelerations:
            columns |= {"qd": seen.qd, "qdd": seen.qdd}
        elif qd is not None:
            columns["qd"] = qd
        kept = self._draw_kept(t.size, rng) if self.dropped else slice(None)
        return {name: values[kept] for name, values in columns.items()}

    def _draw_kept(self, n: int, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Return which samples are kept; bursts start at random and have geometric lengths."""
        keep = np.ones(n, dtype=np.bool_)
        starts = np.flatnonzero(rng.random(n) < self.dropped / self.burst)
        for start, length in zip(starts, rng.geometric(1.0 / self.burst, starts.size), strict=True):
            keep[start : start + length] = False
        keep[[0, -1]] = True
        return keep
