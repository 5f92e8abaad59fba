"""Fits of combinations of causes to the torque error of CAD, from triangular factors alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import nnls
from scipy.special import fdtrc

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.model import RobotModel
from asbuilt.identification.information.cause_data import TILTS, CauseData
from asbuilt.identification.information.triangular import triangular_factor
from asbuilt.validation.attribution.causes import CAUSES, Subset
from asbuilt.validation.prediction import cad_values

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


@dataclass(frozen=True, slots=True)
class FitAssumptions:
    """Numerical limits of the fits, and what is assumed before any measurement."""

    weakest: float = 1e-10
    """Squared singular value, relative to the largest with columns scaled alike, below which a
    direction is not fitted."""
    noise_floor: float = 1e-4
    """Smallest RMS error of a joint worth explaining, as a fraction of its torque."""
    gain: float = 0.1
    """Standard deviation of torque gains from 1 (catalogue tolerances of torque constants)."""
    tilt: float = float(np.deg2rad(1.0))
    """Standard deviation of tilts of the base [rad]; a robot on an unlevelled table."""
    reach: float = 1.0
    """Farthest centre of a payload from the frame of the link that carries it [m]."""


ASSUMED = FitAssumptions()


@dataclass(frozen=True, slots=True, eq=False)
class CauseModel:
    """Hold the fit of one combination of causes.

    | attribute | meaning |
    |---|---|
    | `causes` | the combination |
    | `rms`, `rms_fitted` | (n,) error of each joint on the validation and on the training data |
    | `rank`, `n_free` | number of parameters determined, with and without bounds |
    | `weighted_energy` | sum of squared errors in units of the noise |
    | `bic` | Bayesian information criterion of the training data |
    | `score` | deviance of the validation data, with a penalty for parameters |
    | `values`, `std_errors` | parameters by place, and their standard errors |
    | `possible` | False if the payload has no mass or is out of reach |
    """

    causes: Subset
    rms: Array
    rms_fitted: Array
    rank: int
    n_free: int
    weighted_energy: float
    bic: float
    score: float
    values: Array
    std_errors: Array
    possible: bool


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """Hold one step of the nested models: the cause added, the errors, and the F-test."""

    cause: str
    rms: Array
    rms_fitted: Array
    parameters: int
    bic: float
    f: float
    probability: float


class CauseFits:
    """Fit combinations of causes, each once.

    The unknowns are the parameters of the links and drives, two tilts of the base, a torque gain of
    each joint and the ten inertial parameters of a payload, all as changes from CAD.
    """

    def __init__(
        self, result: IdentificationResult, cause_data: CauseData, cad: RobotModel | None
    ) -> None:
        self.result, self.cause_data = result, cause_data
        n, p = cause_data.n_joints, len(cause_data.names)
        base = result.base
        design = np.nan_to_num(
            result.cad_values if cad is None else cad_values(result, cad), nan=0.0
        )
        x = np.zeros(p)
        x[cause_data.places(base.names)] = design
        self.design = np.concatenate([x, np.zeros(n + 10)])
        inertial = 10 * base.n_links
        links = [name for name, j in zip(base.names, base.columns, strict=True) if j < inertial]
        self.rigid = cause_data.places(links)
        tool = result.model.tool_link
        K = base.regrouping[: len(links), 10 * tool : 10 * tool + 10]
        self.names = (
            *cause_data.names,
            *(f"gain {k + 1}" for k in range(n)),
            *(f"payload {i}" for i in range(10)),
        )
        self.fitted, self.judged = (
            [self._widened(factor, x, K, k) for k, factor in enumerate(cause_data.whole(factors))]
            for factors in (cause_data.fitted, cause_data.judged)
        )
        floor = ASSUMED.noise_floor * np.sqrt(
            [float(f[:, -1] @ f[:, -1]) / cause_data.n_fitted for f in cause_data.fitted]
        )
        self.floor = np.maximum(floor, np.finfo(float).tiny)
        self.weights = 1.0 / np.maximum(result.sigma, self.floor)
        self.independent = cause_data.n_fitted * min(
            1.0, result.effective_samples / result.n_samples
        )
        self.independent_judged = self.independent * cause_data.n_judged / cause_data.n_fitted
        stacked = triangular_factor(
            np.vstack([w * rows for w, rows in zip(self.weights, self.fitted, strict=True)])
        )
        length = np.linalg.norm(stacked[:, :-1], axis=0)
        self.present = length > 1e-9 * length.max(initial=0.0)
        self.columns, self.non_negative = self._columns()
        self.prior = np.zeros(len(self.names))
        self.prior[self.columns["gain"]] = 1.0 / ASSUMED.gain
        self.prior[self.columns["mounting"]] = 1.0 / ASSUMED.tilt
        prior = self.prior * np.sqrt(cause_data.n_fitted / self.independent)
        self.length = np.where(self.present, np.hypot(length, prior), 1.0)
        whole = np.zeros((len(self.names), len(self.names) + 1))
        whole[:, :-1] = np.diag(prior / self.length)
        stacked[:, :-1] /= self.length
        factor = triangular_factor(np.vstack([stacked, whole]))
        self.matrix, self.target = factor[:, :-1], factor[:, -1]
        self.causes = tuple(cause for cause in CAUSES if np.any(self.present[self.columns[cause]]))
        self._known: dict[Subset, CauseModel] = {}

    def _widened(self, rows: Array, x: Array, K: Array, joint: int) -> Array:
        """Return the columns with those of gains and payload, and the torque less that of CAD."""
        A = rows[:, :-1]
        n = self.cause_data.n_joints
        gains = np.zeros((len(rows), n))
        gains[:, joint] = A @ x
        return np.hstack([A, gains, A[:, self.rigid] @ K, (rows[:, -1] - A @ x)[:, None]])

    def _columns(self) -> tuple[dict[str, Indices], Mask]:
        """Return the places of each cause's parameters, and which parameters cannot be negative."""
        n, names = self.cause_data.n_joints, list(self.names)
        found: dict[str, list[int]] = {cause: [] for cause in CAUSES}
        found["links"] = self.rigid.tolist()
        non_negative = np.zeros(len(names), dtype=bool)
        for term in self.cause_data.drive.terms:
            places = [names.index(f"{symbol}{k + 1}") for k in range(n) for symbol in term.symbols]
            cause = term.cause or "richer friction"
            found[cause] += places
            non_negative[places] = cause in ("friction", "armature")
        found["mounting"] = [names.index(name) for name in TILTS]
        found["gain"] = [names.index(f"gain {k + 1}") for k in range(n)]
        found["payload"] = [names.index(f"payload {i}") for i in range(10)]
        return {
            cause: np.array(sorted(places), dtype=np.int64) for cause, places in found.items()
        }, non_negative

    def fit(self, causes: Subset) -> CauseModel:
        """Fit a combination by least squares; friction and armature are not negative."""
        if causes not in self._known:
            inside = self.present & np.isin(
                np.arange(len(self.names)), [j for cause in causes for j in self.columns[cause]]
            )
            self._known[causes] = self._judged(causes, *self._solved(np.flatnonzero(inside)))
        return self._known[causes]

    def _solved(self, places: Indices) -> tuple[Array, Array, int, int]:
        """Return values, their spread, rank, and rank without bounds of some parameters.

        Directions that the data hardly determine are left out of the free parameters.
        """
        x, spread = np.zeros(len(self.names)), np.zeros(len(self.names))
        if not places.size:
            return x, spread, 0, 0
        lower = np.where(
            self.non_negative[places], -self.design[places] * self.length[places], -np.inf
        )
        start = np.where(np.isfinite(lower), lower, 0.0)
        A = self.matrix[:, places]
        b = self.target - A @ start
        y, variance, n_free = _least_squares(A, b)
        rank, free = n_free, np.ones(places.size, dtype=bool)
        if np.any(np.isfinite(lower) & (y < 0)):
            free = _inactive(A, b, np.isfinite(lower))
            y, variance = np.zeros(places.size), np.zeros(places.size)
            y[free], variance[free], rank = _least_squares(A[:, free], b)
        x[places] = (y + start) / self.length[places]
        spread[places] = np.sqrt(variance) / self.length[places]
        return x, spread, rank, n_free

    def _judged(
        self, causes: Subset, x: Array, spread: Array, rank: int, n_free: int
    ) -> CauseModel:
        e = self.cause_data
        rms_fitted, rms = _rms(self.fitted, x, e.n_fitted), _rms(self.judged, x, e.n_judged)
        n_rows = self.independent * e.n_joints
        energy = (
            float(np.sum((self.weights * np.maximum(rms_fitted, self.floor)) ** 2))
            * self.independent
        )
        noise = energy / max(n_rows - rank, 1.0) * e.n_fitted / self.independent
        payload = x[self.columns["payload"]]
        return CauseModel(
            causes=causes,
            rms=rms,
            score=float(
                2.0 * self.independent_judged * np.sum(np.log(np.maximum(rms, self.floor)))
                + rank
                + np.sum((self.prior * x) ** 2)
            ),
            rms_fitted=rms_fitted,
            rank=rank,
            n_free=n_free,
            weighted_energy=energy,
            bic=float(
                2.0 * self.independent * np.sum(np.log(np.maximum(rms_fitted, self.floor)))
                + rank * np.log(max(n_rows, 2.0))
            ),
            values=x,
            std_errors=spread * np.sqrt(noise),
            possible="payload" not in causes
            or "links" in causes
            or bool(payload[9] > 0 and np.linalg.norm(payload[6:9]) <= ASSUMED.reach * payload[9]),
        )

    def steps(self) -> tuple[Step, ...]:
        """Return the nested models, each step tested against the residual of the last of them."""
        models = [self.fit(frozenset(self.causes[:place])) for place in range(len(self.causes) + 1)]
        n_rows = self.independent * self.cause_data.n_joints
        whole = next((model for model in reversed(models) if model.n_free < n_rows), models[0])
        left = n_rows - whole.n_free
        found = [Step("CAD", models[0].rms, models[0].rms_fitted, 0, models[0].bic, np.nan, np.nan)]
        for cause, (before, now) in zip(self.causes, pairwise(models), strict=True):
            more, f, probability = now.n_free - before.n_free, np.nan, np.nan
            if more > 0 and left > 0 and whole.weighted_energy > 0 and now.n_free <= whole.n_free:
                f = max(
                    0.0,
                    (before.weighted_energy - now.weighted_energy)
                    / more
                    / (whole.weighted_energy / left),
                )
                probability = float(fdtrc(more, left, f))
            found.append(
                Step(cause, now.rms, now.rms_fitted, now.n_free, now.bic, float(f), probability)
            )
        return tuple(found)


def _least_squares(A: Array, b: Array) -> tuple[Array, Array, int]:
    """Return min |A y - b| without weak directions, the variances for unit noise, and the rank."""
    eigenvalues, vectors = np.linalg.eigh(A.T @ A)
    kept = eigenvalues > ASSUMED.weakest * eigenvalues.max(initial=0.0)
    V = vectors[:, kept]
    return (
        V @ ((V.T @ (A.T @ b)) / eigenvalues[kept]),
        np.sum(V**2 / eigenvalues[kept], axis=1),
        int(kept.sum()),
    )


def _inactive(A: Array, b: Array, bounded: Mask) -> Mask:
    """Return which parameters min |A y - b| leaves above 0, if `bounded` may not be below it.

    The others are eliminated (Lawson & Hanson, Solving Least Squares Problems, 1974, ch. 23);
    directions that the data hardly determine are held near 0.
    """
    weak = np.sqrt(ASSUMED.weakest) * np.linalg.norm(A, 2)
    rows = np.vstack([A, weak * np.eye(A.shape[1])])
    Q = np.linalg.qr(rows[:, ~bounded])[0]
    left = np.column_stack([rows[:, bounded], np.append(b, np.zeros(A.shape[1]))])
    left -= Q @ (Q.T @ left)
    free = ~bounded
    free[bounded] = nnls(left[:, :-1], left[:, -1])[0] > 0.0
    return free


def _rms(rows: Sequence[Array], x: Array, n: int) -> Array:
    errors = [row[:, -1] - row[:, :-1] @ x for row in rows]
    return np.sqrt([float(error @ error) / n for error in errors])
