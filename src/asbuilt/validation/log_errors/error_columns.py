"""Torque columns of errors that a log may have: what the residual would be, to first order.

A log with a wrong clock, zero position or gain is fitted by parameters that are wrong too, but not
entirely: the same mass moments act by gravity and by acceleration, and at several joints.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import axes_across
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.dynamics.drives.terms.spring import Spring
from asbuilt.dynamics.drives.torque import drive_columns
from asbuilt.dynamics.newton_euler import gravity_torque
from asbuilt.identification.information.cause_data import usual_terms
from asbuilt.identification.result.torque_prediction import all_parameters, parameter_torque

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

Kind = Literal["clock", "zero", "scale", "nonlinear", "drift", "warming", "tilt", "spring", "drive"]
ANGLE, LENGTH, SPEED = 1e-4, 1e-5, 1e-3
"""Steps of central differences: angle [rad], length [m], share of the speed."""
ALMOST_ALL = 99.5
"""Percentile of the torque that counts as its largest, so that a spike does not."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Name a column: the kind of error, and its joint (from 0; None: all).

    The value of `clock` is the share by which motion is faster than logged, of `zero` by how much
    positions are logged too large [rad or m], of `scale` the share by which torques are logged too
    large, of `nonlinear` the same at the largest torque, of `drift` the change of the torque offset
    over the recording [N m or N], of `warming` the relative change of drive torques over it, of
    `spring` its stiffness [N m/rad or N/m]. `tilt`, `spring` and `drive` are errors of the model
    that may explain the same residual.
    """

    kind: Kind
    joint: int | None


class ErrorColumns:
    """Evaluate the columns of all candidates about the values of base parameters."""

    def __init__(
        self, model: RobotModel, base: BaseParameters, values: ArrayLike, largest: Array
    ) -> None:
        """Take the model, its base parameters' values (p,) and the largest torques (n,)."""
        n = model.n_joints
        self._model, self._drive, self._largest = model, base.drive, largest
        self._chi = all_parameters(base, values)
        self._further = _lacking(base.drive)
        self._tilted = [
            model.with_gravity(np.cross(model.gravity, axis)) for axis in axes_across(model.gravity)
        ]
        joints = range(n)
        self.candidates: tuple[Candidate, ...] = (
            Candidate("clock", None),
            *(Candidate("tilt", None) for _ in self._tilted),
            *(Candidate("zero", k) for k in joints),
            *(
                Candidate(kind, k)
                for k in joints
                for kind in ("scale", "nonlinear", "drift", "warming")
            ),
            *(
                Candidate("spring" if name == spring else "drive", k)
                for k in joints
                for name in self._further.names(k + 1)
                for spring in (f"{Spring.symbols[0]}{k + 1}",)
            ),
        )

    def evaluate(self, samples: Samples, span: slice) -> list[Array]:
        """Return the column of each candidate, (L, n) each, on a span of samples."""
        q, qd, qdd = (np.asarray(x[span]) for x in (samples.q, samples.qd, samples.qdd))
        rigid, torque = self._torque(q, qd, qdd)
        time = progress(samples.t[span], samples.t)
        columns = [self._by_speed(q, qd, qdd)]
        columns += [gravity_torque(tilted, q) for tilted in self._tilted]
        columns += [self._by_position(q, qd, qdd, k) for k in range(q.shape[1])]
        for k in range(q.shape[1]):
            t = torque[:, k]
            own = [
                t,
                t * np.abs(t) / self._largest[k],
                time,
                time * (t - rigid[:, k]),
            ]
            columns += [_at(k, values, q.shape) for values in own]
        if self._further:
            shares = self._model.motor_shares
            for k in range(q.shape[1]):
                found = drive_columns(self._further, k, q, qd, qdd, load=rigid, shares=shares)
                columns += [_at(k, values, q.shape) for values in found]
        return columns

    def _torque(self, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
        """Return the torque of rigid bodies and of the model, (L, n) each."""
        return parameter_torque(self._model, self._drive, self._chi, q, qd, qdd)

    def _by_speed(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the derivative of the torque by the logarithm of the clock's rate."""
        up, down = (
            self._torque(q, qd * factor, qdd * factor**2)[1]
            for factor in (1.0 + SPEED, 1.0 - SPEED)
        )
        return np.asarray((up - down) / (2.0 * SPEED))

    def _by_position(self, q: Array, qd: Array, qdd: Array, k: int) -> Array:
        """Return minus the derivative of the torque by the position of joint k."""
        step = np.zeros(q.shape[1])
        step[k] = ANGLE if self._model.joints[k].is_revolute else LENGTH
        up, down = (self._torque(x, qd, qdd)[1] for x in (q + step, q - step))
        return np.asarray((down - up) / (2.0 * step[k]))


def progress(t: Array, whole: Array) -> Array:
    """Return times of a recording with the times `whole`, from -1/2 at its start to 1/2."""
    length = max(float(whole[-1] - whole[0]), 1e-9)
    return np.asarray((t - whole[0]) / length - 0.5)


def largest_torques(training: Iterable[Samples]) -> Array:
    """Return the torque that almost all samples keep, (n,), at least a small one."""
    found = [np.percentile(np.abs(samples.tau), ALMOST_ALL, axis=0) for samples in training]
    return np.asarray(np.maximum(np.max(found, axis=0), 1e-9))


def _lacking(drive: DriveSet) -> DriveSet:
    """Return the usual drive terms and the spring, without those of `drive`."""
    terms = (*usual_terms(), available_terms()[Spring.key])
    return DriveSet(tuple(term for term in terms if term.key not in drive.keys))


def _at(k: int, values: Array, shape: tuple[int, ...]) -> Array:
    column = np.zeros(shape)
    column[:, k] = values
    return column
