"""The torque that a set of base parameters predicts for a recording, beside the torque that was
measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.torque import drive_torque
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import ResultError

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Hold measured and predicted torque, both (N, n), at the times `t` (N,) of the filtered and
    decimated grid.
    """

    t: Array
    measured: Array
    predicted: Array
    joint_names: tuple[str, ...]
    source: str

    def __post_init__(self) -> None:
        for values in (self.t, self.measured, self.predicted):
            values.setflags(write=False)

    @property
    def error(self) -> Array:
        """Measured minus predicted torque, (N, n)."""
        return self.measured - self.predicted


def carrying(model: RobotModel, base: BaseParameters, values: ArrayLike) -> RobotModel:
    """Return the robot with link parameters that give the rigid-body torque of these base
    parameters, though no real bodies need have them.
    """
    chi = np.zeros(base.n_standard)
    chi[base.columns] = np.asarray(values, dtype=np.float64)
    return model.with_parameters(chi[: 10 * model.n_joints])


def predict_torque(
    model: RobotModel,
    base: BaseParameters,
    values: ArrayLike,
    samples: Samples,
    *,
    added: Array | None = None,
) -> Prediction:
    """Predict `F(Y_b beta)` beside `F(tau)`, F being the parallel filter of the samples, if any.

    The kept columns of Y reproduce every torque alone, so Newton-Euler runs once with beta in their
    places and zero elsewhere. `added` (10 n,) are link parameters that come on top, such as those
    of a payload. Raises `ResultError` where the samples belong to other joints or `values` is not
    of shape (p,).
    """
    beta = np.asarray(values, dtype=np.float64)
    if beta.shape != (base.n_base,):
        raise ResultError(
            f"{base.robot} with drive terms {base.drive} has {base.n_base} base parameters, got"
            f" shape {beta.shape}"
        )
    if samples.joint_names != model.joint_names:
        raise ResultError(
            f"samples of {samples.source} have joints {list(samples.joint_names)}, {model.name} has"
            f" {list(model.joint_names)}"
        )
    chi = np.zeros(base.n_standard)
    chi[base.columns] = beta
    links, drives = chi[: 10 * model.n_joints], chi[10 * model.n_joints :]
    if added is not None:
        links = links + added
    torque = inverse_dynamics(model, samples.q, samples.qd, samples.qdd, parameters=links)
    if base.drive:
        torque = torque + drive_torque(
            base.drive,
            drives,
            samples.q,
            samples.qd,
            samples.qdd,
            load=torque,
            shares=model.motor_shares,
        )
    return Prediction(
        samples.filtered_times,
        samples.filtered_torque,
        samples.filtered(torque),
        model.joint_names,
        samples.source,
    )
