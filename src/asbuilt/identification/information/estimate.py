"""What estimators use, and what they return."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.errors import UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Finding
from asbuilt.identification.information.rows import KeptRows, Rows
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import FactorSolution

Refit = Callable[[Array], Array]
"""A fit of the triangular factor [R z] (p + 1, p + 1) of weighted rows: beta (p,)."""


SMALLEST_NOISE = 1e-9
"""Least noise of a joint in the largest torque RMS; simulations have none."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Hold an estimate of p base parameters from n joints.

    Parameters
    ----------
    method
        Name of the estimator.
    beta
        Base parameters, shape (p,).
    covariance
        Textbook covariance (p, p), `inverse_root inverse_root^T` times the residual variance.
    sigma
        Residual standard deviation of each joint, shape (n,); infinite for joints without torque.
    weights
        Factors of the rows of each joint, shape (n,); 0 for joints without torque.
    solution
        Rank, conditioning and the inverse root of the information.
    undetermined
        Directions that this recording does not determine, as text.
    determined
        False for the parameters in such directions, which keep the prior there, shape (p,).
    iterations, converged
        Of the weights, or whatever the estimator iterates.
    information
        What the solution solves, if not the information of the samples (such as reweighted rows).
    notes, findings
        What was decided, and what is wrong with it.
    dropped
        Parameters set to zero as insignificant, shape (p,); None if the method drops none.
    refit
        Gives beta for the triangular factor of other rows with equal weights, all choices fixed;
        None if beta is linear in the torque.
    rivals
        Base parameters (p,) of consistent fits of other kinds, by the kind that
        `EstimationData.kind` asks for, if the estimator chooses among some.
    kind
        The kind that was chosen; empty if there was no choice.
    of_kind
        Gives the estimate of another kind from what the choice has computed; None if none is left.
    """

    method: str
    beta: Array
    covariance: Array
    sigma: Array
    weights: Array
    solution: FactorSolution
    undetermined: tuple[str, ...]
    determined: Mask
    iterations: int
    converged: bool
    information: SquareRootInformation | None = None
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    dropped: Mask | None = None
    refit: Refit | None = None
    rivals: Mapping[str, Array] = field(default_factory=dict)
    kind: str = ""
    of_kind: Callable[[str], Estimate] | None = None

    @property
    def rank(self) -> int:
        """Rank of this recording."""
        return self.solution.rank

    @property
    def std_errors(self) -> Array:
        """Textbook standard errors, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def renewed(
        self,
        method: str,
        information: SquareRootInformation,
        solution: FactorSolution,
        *,
        beta: Array | None = None,
        inverse_root: Array | None = None,
        own_information: SquareRootInformation | None = None,
        notes: tuple[str, ...] = (),
        dropped: Mask | None = None,
    ) -> Estimate:
        """Return another method's estimate in the same directions, its errors by `information`."""
        found = solution.x if beta is None else beta
        root = solution.inverse_root if inverse_root is None else inverse_root
        error = information.stacked(self.weights) @ np.append(-found, 1.0)
        energy = float(error @ error)
        n_rows = information.n_rows
        return replace(
            self,
            method=method,
            beta=found,
            # As many degrees of freedom are spent as directions are determined.
            covariance=energy / max(n_rows - root.shape[1], 1) * root @ root.T,
            sigma=residual_deviation(information, found, solution.inverse_root, self.weights),
            solution=replace(solution, x=found, residual_energy=energy, inverse_root=root),
            information=own_information,
            notes=notes,
            dropped=dropped,
            refit=None,
        )


def noise_floor(information: SquareRootInformation) -> float:
    """Return the least noise: `SMALLEST_NOISE` of the largest torque RMS, 1 without torque."""
    largest = float(np.sqrt(information.torque_energy.max() / information.n_samples))
    # Logs of zero torque alone still need a positive scale.
    return SMALLEST_NOISE * largest or 1.0


def residual_deviation(
    information: SquareRootInformation, beta: Array, inverse_root: Array, weights: Array
) -> Array:
    """Return the standard deviation of each joint's residual (n,), infinite without torque.

    Joints whose rows were mixed, since reactions were projected away, have one noise.
    """
    roots = zip(information.support, information.joint_factors, weights, strict=True)
    parts = [weight * factor[:, :-1] @ inverse_root[own] for own, factor, weight in roots]
    # Traces of each joint's part of the hat matrix; their sum is the rank.
    spent = np.array([np.sum(part * part) for part in parts])
    return deviation_of(information, beta, spent)


def deviation_of(information: SquareRootInformation, beta: Array, spent: Array) -> Array:
    """Return what `residual_deviation` does, with the parameters (n,) that each joint spends."""
    # Joints without torque have infinite noise, and so no weight.
    energy = np.where(information.has_torque, information.residual_energy(beta), np.inf)
    if information.mixed:
        energy = np.full_like(energy, energy.mean())
        spent = np.full_like(spent, spent.mean())
    return np.asarray(np.sqrt(energy / np.maximum(information.n_samples - spent, 1.0)))


Undetermined = Literal["toward_prior", "refuse"]


@dataclass(frozen=True, eq=False)
class EstimationData:
    """Hold all that an estimator may use.

    Parameters
    ----------
    model
        The robot as designed.
    information
        Square-root information of the samples.
    samples
        The samples themselves, iterable more than once; None if only the information is at hand.
    prior
        Base parameters by design (p,), NaN where the description has no value.
    undetermined
        Whether directions without excitation are resolved toward `prior`, or refused.
    block_seconds
        Length of a time block [s].
    every
        Use the rows of every n-th time block alone.
    loading
        Robot whose rigid-body torque loads load-dependent friction; `model` if None.
    less
        Parameters of each joint (p_k,) whose torque was taken from the torque in `information`, and
        is taken from the torque of the rows; empty: none.
    kept
        Rows that are kept for others who ask for the same ones.
    kind
        The only kind of fit that an estimator which chooses among several makes, if it can; empty:
        its own choice.
    """

    model: RobotModel
    information: SquareRootInformation
    samples: Iterable[Samples] | None = None
    prior: Array | None = None
    undetermined: Undetermined = "toward_prior"
    block_seconds: float | None = None
    every: int = 1
    loading: RobotModel | None = None
    less: tuple[Array, ...] = ()
    kept: KeptRows | None = None
    kind: str = ""

    @property
    def base(self) -> BaseParameters:
        """The base parameters."""
        return self.information.base

    @property
    def prior_values(self) -> Array:
        """The prior with 0 where the description has no value, shape (p,)."""
        prior = np.zeros(self.base.n_base) if self.prior is None else self.prior
        return np.nan_to_num(prior, nan=0.0)

    @cached_property
    def rows(self) -> Rows:
        """The rows behind the information, by time block."""
        return self.rows_of(self.batches)

    def rows_of(self, samples: Iterable[Samples]) -> Rows:
        """Return the rows of other samples with the same time blocks."""
        return Rows(
            self.loading or self.model,
            self.base,
            samples,
            self.block_seconds,
            self.every,
            self.less,
            self.kept,
        )

    @property
    def batches(self) -> Iterable[Samples]:
        """The samples; raises `UsageError` if only the information is at hand."""
        if self.samples is None:
            raise UsageError(
                "this estimator needs the samples, and only their information is at hand; use an"
                " estimator that needs the information alone, such as wls"
            )
        return self.samples
