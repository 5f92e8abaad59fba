"""Torque predicted from base parameters, and how far it is from the torque measured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Mask
from asbuilt.codec import make_plain, store_as
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, drive_torque, inverse_dynamics
from asbuilt.errors import ResultError
from asbuilt.experiment.signal.samples import Samples


@dataclass(frozen=True, slots=True, eq=False)
class TorqueMetrics:
    r"""Measure a prediction by its error `e = measured - predicted` at each of n joints.

    Units are N m for a revolute joint and N for a prismatic one. All are taken in the band that the
    samples' filter passes, except `rms_recorded`. What is unknown is NaN, such as all of a joint
    without a torque channel; `relative_error` is over the other joints.

    | attribute | shape | definition |
    |---|---|---|
    | `rms` | (n,) | sqrt(mean(e^2)) |
    | `max_abs` | (n,) | max \|e\| |
    | `r_squared` | (n,) | 1 - sum e^2 / sum (tau - mean tau)^2, NaN for a constant torque |
    | `relative_error` | () | \|e\| / \|tau\|, norms over all samples and joints |
    | `relative_error_per_joint` | (n,) | the same joint by joint |
    | `rms_recorded` | (n,) | RMS error against the torque as logged, unfiltered |
    """

    source: str
    joint_names: tuple[str, ...] = field(metadata=store_as(key="joints"))
    n_samples: int
    rms: Array
    max_abs: Array
    r_squared: Array
    relative_error: float
    relative_error_per_joint: Array
    rms_recorded: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if np.size(self.rms_recorded) == 0:
            object.__setattr__(self, "rms_recorded", np.full(len(self.joint_names), np.nan))
        for name in ("rms", "max_abs", "r_squared", "relative_error_per_joint", "rms_recorded"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (len(self.joint_names),):
                raise ResultError(
                    f"{name} of {self.source!r} must have one value for each of"
                    f" {len(self.joint_names)} joints, got shape {values.shape}"
                )
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @classmethod
    def of_sums(
        cls,
        source: str,
        joint_names: tuple[str, ...],
        n_samples: int,
        *,
        error: Array,
        energy: Array,
        spread: Array,
        constant: Mask,
        max_abs: Array,
    ) -> TorqueMetrics:
        """Return the metrics by sums over samples of each joint, (n,).

        `error` and `energy` are sums of e^2 and tau^2, `spread` that of the torque about its mean,
        which is rounding where it is `constant`. Joints without a torque channel are NaN.
        """
        known = np.isfinite(energy)
        with np.errstate(divide="ignore", invalid="ignore"):
            return cls(
                source=source,
                joint_names=joint_names,
                n_samples=n_samples,
                rms=np.sqrt(error / n_samples),
                max_abs=max_abs,
                r_squared=np.where(constant, np.nan, 1.0 - error / spread),
                relative_error=float(np.sqrt(error[known].sum() / energy[known].sum())),
                relative_error_per_joint=np.sqrt(error / energy),
            )

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, None for what is undefined, ready for JSON."""
        return cast("dict[str, Any]", make_plain(self))


class TorqueTally:
    """Gather torque errors batch by batch, with pairwise moments (Chan et al., 1983)."""

    def __init__(self, joint_names: Iterable[str]) -> None:
        self.joint_names = tuple(joint_names)
        self._n = 0
        zeros = np.zeros((4, len(self.joint_names)))
        self._error, self._largest, self._mean, self._spread = zeros

    def add(self, measured: ArrayLike, predicted: ArrayLike) -> TorqueTally:
        """Add a batch, both (n_samples, n_joints); returns itself.

        Raises `ResultError` for other shapes.
        """
        tau = np.asarray(measured, dtype=np.float64)
        hat = np.asarray(predicted, dtype=np.float64)
        if tau.shape != hat.shape or tau.ndim != 2 or tau.shape[1] != len(self.joint_names):
            raise ResultError(
                f"measured torque has shape {tau.shape} and predicted {hat.shape}; both must be"
                f" (n_samples, {len(self.joint_names)})"
            )
        if len(tau) == 0:
            return self
        error = tau - hat
        self._error += np.einsum("tk,tk->k", error, error)
        self._largest = np.maximum(self._largest, np.abs(error).max(axis=0))
        mean = tau.mean(axis=0)
        spread = np.einsum("tk,tk->k", tau - mean, tau - mean)
        total = self._n + len(tau)
        self._spread += spread + (mean - self._mean) ** 2 * (self._n * len(tau) / total)
        self._mean += (mean - self._mean) * (len(tau) / total)
        self._n = total
        return self

    def metrics(self, source: str) -> TorqueMetrics:
        """Return the metrics of everything added so far.

        Raises `ResultError` where that is nothing.
        """
        if self._n == 0:
            raise ResultError(
                f"no samples to measure the prediction of {source!r} on; is the recording shorter"
                " than the filter's edges?"
            )
        energy = self._spread + self._n * self._mean**2
        return TorqueMetrics.of_sums(
            source,
            self.joint_names,
            self._n,
            error=self._error,
            energy=energy,
            spread=self._spread,
            constant=self._spread <= 1e-24 * energy,
            max_abs=self._largest,
        )


def torque_metrics(
    measured: ArrayLike, predicted: ArrayLike, source: str, joint_names: Iterable[str] | None = None
) -> TorqueMetrics:
    """Measure `predicted` against `measured`, both (n_samples, n_joints).

    Joints are numbered from 1 where no names are given.

    >>> torque_metrics([[3.0], [-4.0]], [[3.0], [-3.0]], "bench").rms.round(4).tolist()
    [0.7071]
    """
    n = np.asarray(measured).shape[-1]
    numbered = (f"joint {k + 1}" for k in range(n))
    return (
        TorqueTally(numbered if joint_names is None else joint_names)
        .add(measured, predicted)
        .metrics(source)
    )


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
    links = chi[: 10 * model.n_links]
    drives = chi[10 * model.n_links :]
    links = links if added is None else links + added
    rigid = inverse_dynamics(model, q, qd, qdd, parameters=links)
    if not drive:
        return rigid, rigid
    friction = drive_torque(drive, drives, q, qd, qdd, load=rigid, shares=model.motor_shares)
    return rigid, rigid + friction


def pair_with_measured(model: RobotModel, samples: Samples, torque: Iterable[Array]) -> Prediction:
    """Put a predicted torque, given on each of the samples' spans (L, n), next to the one measured.

    Both go through the filter of the samples, less what reactions explain. Torques of
    joints without a torque channel are NaN.
    """
    # Torques are compared in their unit, not in that of the noise.
    plain = samples.reactions.in_units_of(())
    squares = np.zeros((1, len(samples.joint_names)))

    def project(values: Iterable[Array]) -> Iterator[Array]:
        for span, own in zip(samples.spans(), values, strict=True):
            yield plain.at(span).project_torque(model, samples.q[span], own)

    def compare() -> Iterator[Array]:
        nonlocal squares
        recorded = project(samples.tau_raw[span] for span in samples.spans())
        for raw, found in zip(recorded, project(torque), strict=True):
            # row by row, so that the sum equals the sum of all rows at once to the last bit
            squares = np.vstack([squares, (raw - found) ** 2]).sum(axis=0, keepdims=True)
            yield found

    predicted = samples.filtered_spans(compare())
    count = sum(b - a for a, b in samples.segments)
    logged = project(samples.tau[span] for span in samples.spans())
    measured = np.where(samples.has_torque, 1.0, np.nan)
    return Prediction(
        samples.filtered_times,
        measured * samples.filtered_spans(logged),
        predicted,
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
    spans = predict_in_spans(model, base, values, samples, added=added)
    return pair_with_measured(model, samples, (torque for _, _, torque in spans))
