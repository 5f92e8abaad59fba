"""Identification on line: the estimate renewed with every sample, at constant cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import lapack

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.identification.estimators.least_squares import check_weights
from asbuilt.identification.information.triangular import FactorSolution, solve_factor


@dataclass(frozen=True, slots=True, eq=False)
class RecursiveEstimate:
    """Hold the estimate after a sample.

    `beta` and `std_errors` (p,), `sigma` of a weighted residual and the samples that still count.

    Standard errors take residuals as independent; directions without excitation have zero,
    and `rank` says how many have some.
    """

    beta: Array
    std_errors: Array
    sigma: float
    rank: int
    n_effective: float


class RecursiveIdentification:
    """Keep the triangular factor R of [W | tau] and renew it sample by sample.

    `R <- triangle of [sqrt(f) R; weights [Y | tau]]`.

    With `forgetting` f = 1 the estimate is the fit of all samples at once; with f < 1 a sample
    counts f^age, a memory of 1 / (1 - f) samples, so that a change of load is followed. `weights`
    (n,) are one per joint, 1 / sigma of a batch fit say. `prior` (p,) holds values of what no
    sample excites. With `prior_strength` > 0 (how many samples of unit weighted torque it is worth)
    it is never forgotten, so that rest loses nothing. Friction that depends on load uses the load
    of `model`.

    Source: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter 5;
    square-root form of recursive least squares with forgetting.

    Examples
    --------
    >>> from asbuilt.description.load import load_robot
    >>> from asbuilt.dynamics.base.base_parameters import find_base_parameters
    >>> model = load_robot("kuka-iiwa7-r800")
    >>> line = RecursiveIdentification(model, find_base_parameters(model), forgetting=0.999)
    >>> line.update([0.1] * 7, [0.0] * 7, [0.0] * 7, [0.0] * 7).rank
    6
    """

    def __init__(
        self,
        model: RobotModel,
        base: BaseParameters,
        *,
        weights: ArrayLike | None = None,
        forgetting: float = 1.0,
        prior: ArrayLike | None = None,
        prior_strength: float = 0.0,
    ) -> None:
        n = model.n_joints
        p = base.n_base
        w = np.ones(n) if weights is None else check_weights(weights, np.ones(n, dtype=np.bool_))
        if not 0.0 < forgetting <= 1.0:
            raise UsageError(
                f"the forgetting factor must lie above 0 and be at most 1, got {forgetting}; 0.999"
                " remembers about 1000 samples"
            )
        if not 0.0 <= prior_strength < np.inf:
            raise UsageError(
                "the strength of the prior must be a number of samples and not negative, got"
                f" {prior_strength}"
            )
        toward = np.nan_to_num(np.zeros(p) if prior is None else np.array(prior, float), nan=0.0)
        if toward.shape != (p,):
            raise UsageError(
                f"the prior of {base.robot} needs {p} base parameters, got shape {toward.shape}"
            )
        self.model, self.base, self.forgetting = model, base, float(forgetting)
        self._weights, self._prior, self._strength = w, toward, float(prior_strength)
        self._plan = RegressorPlan.of(model, base.drive, base.columns)
        # Column-major, so that LAPACK overwrites the rows in place.
        self._rows = np.zeros((p + 1 + n, p + 1), order="F")
        self._counted = 0.0

    @property
    def factor(self) -> Array:
        """The triangular factor (p + 1, p + 1) of the weighted, forgotten stack."""
        return np.triu(self._rows[: self.base.n_base + 1])

    def update(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, tau: ArrayLike
    ) -> RecursiveEstimate:
        """Add one sample, each (n,), or a few at once, (m, n), and return the estimate after it.

        Raises `IdentifiabilityError` for NaN.
        """
        arrays = [np.atleast_2d(np.asarray(x, dtype=np.float64)) for x in (q, qd, qdd, tau)]
        n = self.model.n_joints
        p = self.base.n_base
        if any(x.shape != (len(arrays[0]), n) for x in arrays):
            raise UsageError(
                f"a sample of {self.model.name} needs q, qd, qdd and tau of {n} values each, got"
                f" {[x.shape for x in arrays]}"
            )
        if not all(np.all(np.isfinite(x)) for x in arrays):
            raise IdentifiabilityError("a sample holds NaN or infinite values; leave it out")
        stack = self._plan.stack(*arrays[:3]).reshape(-1, n, p)
        for columns, torque in zip(stack, arrays[3], strict=True):
            # The square of the factor is the information: it forgets by f.
            self._rows[: p + 1] *= np.sqrt(self.forgetting)
            self._rows[p + 1 :, :p] = self._weights[:, None] * columns
            self._rows[p + 1 :, p] = self._weights * torque
            self._rows, _, _, _ = lapack.dgeqrf(self._rows, overwrite_a=True)
            # Below the diagonal LAPACK leaves the reflections.
            self._rows[:] = np.triu(self._rows)
            self._counted = self.forgetting * self._counted + 1.0
        return self.estimate()

    def estimate(self) -> RecursiveEstimate:
        """Return the estimate from the samples so far."""
        solution = self.solution()
        variance = solution.residual_energy / max(
            self._counted * self.model.n_joints - solution.rank, 1.0
        )
        return RecursiveEstimate(
            beta=solution.x,
            std_errors=np.sqrt(variance * np.sum(solution.inverse_root**2, axis=1)),
            sigma=float(np.sqrt(variance)),
            rank=solution.rank,
            n_effective=self._counted,
        )

    def solution(self) -> FactorSolution:
        """Return the least-squares solution behind the estimate."""
        p = self.base.n_base
        factor = self.factor
        if self._strength > 0.0:
            # The mean length of a column per sample is what one sample says about its parameter.
            length = np.linalg.norm(factor[:, :p], axis=0) / np.sqrt(max(self._counted, 1.0))
            # A column that was never excited has no length; any positive one holds its parameter.
            pull = np.sqrt(self._strength) * np.where(length > 0, length, 1.0)
            # Stacked for the answer alone: a prior in the kept factor would be forgotten with it.
            rows = np.vstack([factor, np.column_stack([np.diag(pull), pull * self._prior])])
            factor = np.triu(np.asarray(lapack.dgeqrf(rows)[0])[: p + 1])
        return solve_factor(factor, max(1, round(self._counted)) * self.model.n_joints, self._prior)
