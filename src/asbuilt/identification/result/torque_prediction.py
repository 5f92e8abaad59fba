"""Torque predicted from base parameters, next to the torque measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.contact import without_contact_forces
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.torque import drive_torque
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import ResultError
from asbuilt.identification.result.metrics import TorqueMetrics, torque_metrics

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Hold measured and predicted torque of a recording.

    `measured` and `predicted` (N, n) are in the band of the samples' filter, at the times `t` (N,)
    of the filtered grid; `rms_recorded` (n,) is the error against the torque as logged.
    """

    t: Array
    measured: Array
    predicted: Array
    rms_recorded: Array
    joint_names: tuple[str, ...]
    source: str

    def __post_init__(self) -> None:
        for values in (self.t, self.measured, self.predicted):
            values.setflags(write=False)

    @property
    def error(self) -> Array:
        """Measured minus predicted torque, (N, n)."""
        return self.measured - self.predicted

    def metrics(self) -> TorqueMetrics:
        """Measure the prediction."""
        metrics = torque_metrics(self.measured, self.predicted, self.source, self.joint_names)
        return replace(metrics, rms_recorded=self.rms_recorded)


def expand_parameters(base: BaseParameters, values: ArrayLike) -> Array:
    """Return standard parameters (n_standard,) that give the torque of base parameters (p,).

    The kept columns of the regressor reproduce every torque alone, so the base parameters take
    their places and all others are zero. Such links need not be physically consistent.
    """
    beta = np.asarray(values, dtype=np.float64)
    if beta.shape != (base.n_base,):
        raise ResultError(
            f"{base.robot} with drive terms {base.drive} has {base.n_base} base parameters, got"
            f" shape {beta.shape}"
        )
    chi = np.zeros(base.n_standard)
    chi[base.columns] = beta
    return chi


def set_link_parameters(model: RobotModel, base: BaseParameters, values: ArrayLike) -> RobotModel:
    """Return the robot with link parameters that give the rigid-body torque of base parameters."""
    return model.with_parameters(expand_parameters(base, values)[: 10 * model.n_links])


def predict_in_spans(
    model: RobotModel,
    base: BaseParameters,
    values: ArrayLike,
    samples: Samples,
    *,
    added: Array | None = None,
) -> Iterator[tuple[slice, Array, Array]]:
    """Yield spans of samples with the torque of the rigid bodies and of the whole model, (L, n).

    `added` (10 n,) are link parameters that come on top, such as a payload's.

    Raises
    ------
    ResultError
        If the samples belong to other joints or `values` is not of shape (p,).
    """
    chi = expand_parameters(base, values)
    if samples.joint_names != model.joint_names:
        raise ResultError(
            f"the recording {samples.source!r} has joints {', '.join(samples.joint_names)};"
            f" {model.name} needs {', '.join(model.joint_names)} in this order",
            expected=model.joint_names,
            joints=samples.joint_names,
        )
    for span in samples.spans():
        state = samples.q[span], samples.qd[span], samples.qdd[span]
        yield span, *parameter_torque(model, base.drive, chi, *state, added=added)


def parameter_torque(
    model: RobotModel,
    drive: DriveSet,
    chi: Array,
    q: Array,
    qd: Array,
    qdd: Array,
    *,
    added: Array | None = None,
) -> tuple[Array, Array]:
    """Return the torque of rigid bodies and of the whole model, (N, n) each, of states (N, n).

    `chi` are standard parameters as `expand_parameters` returns them, `added` (10 n,) link
    parameters on top.
    """
    links, drives = chi[: 10 * model.n_links], chi[10 * model.n_links :]
    parameters = links if added is None else links + added
    rigid = inverse_dynamics(model, q, qd, qdd, parameters=parameters)
    if not drive:
        return rigid, rigid
    shares = model.motor_shares
    return rigid, rigid + drive_torque(drive, drives, q, qd, qdd, load=rigid, shares=shares)


def pair_with_measured(model: RobotModel, samples: Samples, torque: Array) -> Prediction:
    """Put a predicted torque (N, n), given at every sample, next to the one measured.

    Both go through the filter of the samples, less what forces at contacts explain. Torques of
    joints without a torque channel are NaN.
    """
    if samples.contact is not None:
        tau, raw, torque = (
            without_contact_forces(model, samples.q, samples.contact, each)
            for each in (samples.tau, samples.tau_raw, torque)
        )
        samples = replace(samples, tau=tau, tau_raw=raw)
    squares, count = np.zeros((1, len(samples.joint_names))), 0
    for span in samples.spans():
        error = samples.tau_raw[span] - torque[span]
        # row by row, so that the sum equals the sum of all rows at once to the last bit
        squares = np.vstack([squares, error**2]).sum(axis=0, keepdims=True)
        count += len(error)
    measured = np.where(samples.has_torque, 1.0, np.nan)
    return Prediction(
        samples.filtered_times,
        measured * samples.filtered_torque,
        samples.filtered(torque),
        measured * np.sqrt(squares[0] / count),
        samples.joint_names,
        samples.source,
    )


def predict_torque(
    model: RobotModel,
    base: BaseParameters,
    values: ArrayLike,
    samples: Samples,
    *,
    added: Array | None = None,
) -> Prediction:
    """Predict `F(Y_b beta)` next to `F(tau)`, F being the filter of the samples, if any.

    Parameters
    ----------
    model, base
        The robot and its base parameters.
    values
        The base parameters, shape (p,).
    samples
        Prepared samples of a recording.
    added
        Link parameters (10 n,) that come on top, such as a payload's.

    Raises
    ------
    ResultError
        If the samples belong to other joints or `values` is not of shape (p,).
    """
    torque = np.zeros(samples.q.shape)
    for span, _, part in predict_in_spans(model, base, values, samples, added=added):
        torque[span] = part
    return pair_with_measured(model, samples, torque)
