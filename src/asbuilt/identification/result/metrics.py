"""How far a predicted torque is from the measured one, joint by joint and as a whole."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.codec import make_plain, store_as
from asbuilt.errors import ResultError


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

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, None for what is undefined, ready for JSON."""
        document: dict[str, Any] = make_plain(self)
        return document


class TorqueTally:
    """Gather torque errors batch by batch, with pairwise moments (Chan et al., 1983)."""

    def __init__(self, joint_names: Iterable[str]) -> None:
        self.joint_names = tuple(joint_names)
        n = len(self.joint_names)
        self._n = 0
        self._error = np.zeros(n)
        self._largest = np.zeros(n)
        self._mean = np.zeros(n)
        self._spread = np.zeros(n)

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
        known = np.isfinite(energy)
        with np.errstate(divide="ignore", invalid="ignore"):
            constant = self._spread <= 1e-24 * energy
            r_squared = np.where(constant, np.nan, 1.0 - self._error / self._spread)
            per_joint = np.sqrt(self._error / energy)
            relative = float(np.sqrt(self._error[known].sum() / energy[known].sum()))
        return TorqueMetrics(
            source=source,
            joint_names=self.joint_names,
            n_samples=self._n,
            rms=np.sqrt(self._error / self._n),
            max_abs=self._largest,
            r_squared=r_squared,
            relative_error=relative,
            relative_error_per_joint=per_joint,
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
    names = (
        tuple(joint_names) if joint_names is not None else tuple(f"joint {k + 1}" for k in range(n))
    )
    return TorqueTally(names).add(measured, predicted).metrics(source)
