"""Fits of any combination of causes to what CAD predicts wrongly, from triangular factors alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.identification.information.cause_data import TILTS, CauseData
from asbuilt.identification.information.triangular import triangular_factor
from asbuilt.validation.attribution.causes import BEFORE, CAUSE_OF_TERM, CAUSES, Subset
from asbuilt.validation.prediction import design_values

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


WEAKEST = 1e-10
"""Squared singular value of the fit, relative to the largest with columns scaled alike, below which
a direction is left alone.
"""
MOST_EXCHANGES = 30
"""Rounds in which parameters that cannot be negative are set to zero or freed again."""
NEARLY = 6.0
"""Difference in score, as of a deviance, within which two combinations are about as likely (Kass &
Raftery, J. Am. Stat. Assoc. 90, 1995: not strong evidence).
"""
WORTH_TELLING = 0.05
"""Share of the error from which a cause is held against others."""
MOSTLY_LEFT = 0.5
"""Share of the error below which a combination of causes has taken most of it away."""
OWN = 0.5
"""Two causes cannot be told apart where without either one the error grows by less than this part
of that cause's share.
"""
NOISE_FLOOR = 1e-4
"""Smallest RMS of a joint, as a fraction of its torque, that is worth explaining."""
USUAL_GAIN = 0.1
"""Standard deviation of torque gains from 1 that is believed before any measurement."""
USUAL_TILT = np.deg2rad(1.0)
"""Standard deviation of tilts of the mounting that is believed before any measurement [rad]."""
POSSIBLE_REACH = 1.0
"""Farthest that the centre of a body carried at the flange may be from the last joint's frame [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class CauseModel:
    """Hold the fit of one combination of causes.

    `rms` (n,) is the error of each joint on the data judged by, `rms_fitted` on the data used;
    `values` are the parameters by name; `told` how many of them the data tell, `rank` without those
    that would be negative and are zero; `bic` the Bayesian information criterion with as many
    samples as are independent, who also set the `std_errors`; `possible` is False where the payload
    would be no body: without mass, or out of reach.
    """

    causes: Subset
    rms: Array
    rms_fitted: Array
    rank: int
    told: int
    weighted_energy: float
    bic: float
    score: float
    values: Array
    std_errors: Array
    possible: bool


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One step of the nested models.

    The cause taken up, the errors then, and the F-test of what it explains beyond the model before.
    """

    cause: str
    rms: Array
    rms_fitted: Array
    parameters: int
    bic: float
    f: float
    probability: float


class CauseFits:
    """Fit combinations of causes, each once."""

    def __init__(
        self, result: IdentificationResult, cause_data: CauseData, cad: RobotModel | None
    ) -> None:
        self.result, self.cause_data = result, cause_data
        self.model = result.model if cad is None else cad
        n, p = cause_data.n_joints, len(cause_data.names)
        base = result.base
        design = np.nan_to_num(
            result.cad_values if cad is None else design_values(result, cad), nan=0.0
        )
        x = np.zeros(p)
        x[cause_data.places(base.names)] = design
        self.design = np.concatenate([x, np.zeros(n + 10)])
        links = [name for name, j in zip(base.names, base.columns, strict=True) if j < 10 * n]
        self.rigid = cause_data.places(links)
        K = base.regrouping[: len(links), 10 * (n - 1) : 10 * n]
        self.non_negative: NDArray[np.bool_] = np.zeros(0, dtype=bool)
        self.names = (
            *cause_data.names,
            *(f"gain {k + 1}" for k in range(n)),
            *(f"payload {i}" for i in range(10)),
        )
        self.fitted, self.judged = (
            [self._widened(factor, x, K, k) for k, factor in enumerate(cause_data.whole(factors))]
            for factors in (cause_data.fitted, cause_data.judged)
        )
        floor = NOISE_FLOOR * np.sqrt(
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
        self.columns = self._columns()
        self.belief = np.zeros(len(self.names))
        self.belief[self.columns["gain"]], self.belief[self.columns["mounting"]] = (
            1.0 / USUAL_GAIN,
            1.0 / USUAL_TILT,
        )
        belief = self.belief * np.sqrt(cause_data.n_fitted / self.independent)
        self.length = np.where(self.present, np.hypot(length, belief), 1.0)
        scaled, belief = stacked[:, :-1] / self.length, belief / self.length
        self.gram, self.right = scaled.T @ scaled + np.diag(belief**2), scaled.T @ stacked[:, -1]
        self.causes = tuple(cause for cause in CAUSES if np.any(self.present[self.columns[cause]]))
        self._known: dict[Subset, CauseModel] = {}

    def _widened(self, rows: Array, x: Array, K: Array, joint: int) -> Array:
        """Columns of the cause data, a gain per joint, ten of a payload.

        Last the torque less that of CAD.
        """
        A = rows[:, :-1]
        n = self.cause_data.n_joints
        gains = np.zeros((len(rows), n))
        gains[:, joint] = A @ x
        return np.hstack([A, gains, A[:, self.rigid] @ K, (rows[:, -1] - A @ x)[:, None]])

    def _columns(self) -> dict[str, Indices]:
        n, names = self.cause_data.n_joints, list(self.names)
        found: dict[str, list[int]] = {cause: [] for cause in CAUSES}
        found["links"] = self.rigid.tolist()
        for term in self.cause_data.drive.terms:
            symbols = [f"{symbol}{k + 1}" for k in range(n) for symbol in term.symbols]
            found[CAUSE_OF_TERM.get(term.key, "richer friction")] += [
                names.index(symbol) for symbol in symbols
            ]
        found["mounting"] = [names.index(name) for name in TILTS]
        found["gain"] = [names.index(f"gain {k + 1}") for k in range(n)]
        found["payload"] = [names.index(f"payload {i}") for i in range(10)]
        self.non_negative = np.zeros(len(names), dtype=bool)
        for term in self.cause_data.drive.terms:
            if CAUSE_OF_TERM.get(term.key) in ("friction", "armature"):
                self.non_negative[
                    [names.index(f"{symbol}{k + 1}") for k in range(n) for symbol in term.symbols]
                ] = True
        return {cause: np.array(sorted(places), dtype=np.int64) for cause, places in found.items()}

    def fit(self, causes: Subset) -> CauseModel:
        """Fit a combination."""
        if causes not in self._known:
            places = np.concatenate(
                [np.array([], dtype=np.int64), *(self.columns[cause] for cause in sorted(causes))]
            )
            places = places[self.present[places]]
            x, spread, rank, told = np.zeros(len(self.names)), np.zeros(len(self.names)), 0, 0
            free, bounded = np.ones(places.size, dtype=bool), self.non_negative[places]
            floor = np.where(bounded, -self.design[places] * self.length[places], 0.0)
            right = self.right[places] - self.gram[np.ix_(places, places)] @ floor
            for _ in range(MOST_EXCHANGES):
                some = places[free]
                eigenvalues, vectors = np.linalg.eigh(self.gram[np.ix_(some, some)])
                kept = eigenvalues > WEAKEST * eigenvalues.max(initial=0.0)
                V, y = vectors[:, kept], np.zeros(places.size)
                y[free], rank = V @ ((V.T @ right[free]) / eigenvalues[kept]), int(kept.sum())
                told = rank if free.all() else told
                pull = right - self.gram[np.ix_(places, places)] @ y
                out = free & bounded & (y < 0)
                back = ~free & (pull > WEAKEST * np.abs(right).max(initial=0.0))
                if not (out | back).any():
                    break
                free ^= out | back
            x[places] = (
                (np.where(bounded, np.maximum(y, 0.0), y) + floor) / self.length[places]
                if places.size
                else 0.0
            )
            if places.size:
                spread[some] = np.sqrt(np.sum(V**2 / eigenvalues[kept], axis=1)) / self.length[some]
            self._known[causes] = self._judged(causes, x, spread, rank, told)
        return self._known[causes]

    def _judged(self, causes: Subset, x: Array, spread: Array, rank: int, told: int) -> CauseModel:
        e = self.cause_data
        rms_fitted = _rms(self.fitted, x, e.n_fitted)
        n_rows = self.independent * e.n_joints
        energy = (
            float(np.sum((self.weights * np.maximum(rms_fitted, self.floor)) ** 2))
            * self.independent
        )
        noise = energy / max(n_rows - rank, 1.0) * e.n_fitted / self.independent
        rms = _rms(self.judged, x, e.n_judged)
        return CauseModel(
            causes=causes,
            rms=rms,
            score=float(
                2.0 * self.independent_judged * np.sum(np.log(np.maximum(rms, self.floor)))
                + rank
                + np.sum((self.belief * x) ** 2)
            ),
            rms_fitted=rms_fitted,
            rank=rank,
            told=told,
            weighted_energy=energy,
            bic=float(
                2.0 * self.independent * np.sum(np.log(np.maximum(rms_fitted, self.floor)))
                + rank * np.log(max(n_rows, 2.0))
            ),
            values=x,
            std_errors=spread * np.sqrt(noise),
            possible="payload" not in causes
            or "links" in causes
            or self._is_body(x[self.columns["payload"]]),
        )

    @staticmethod
    def _is_body(body: Array) -> bool:
        return bool(body[9] > 0 and np.linalg.norm(body[6:9]) <= POSSIBLE_REACH * body[9])

    def steps(self) -> tuple[Step, ...]:
        """Return the nested models, each step tested against what the whole of them leaves, so that
        causes not yet taken up do not hide it.
        """
        models = [self.fit(frozenset(self.causes[:place])) for place in range(len(self.causes) + 1)]
        n_rows = self.independent * self.cause_data.n_joints
        whole = next((model for model in reversed(models) if model.told < n_rows), models[0])
        left = n_rows - whole.told
        found = [Step("CAD", models[0].rms, models[0].rms_fitted, 0, models[0].bic, np.nan, np.nan)]
        for cause, (before, now) in zip(self.causes, pairwise(models), strict=True):
            more, f, probability = now.told - before.told, np.nan, np.nan
            if more > 0 and left > 0 and whole.weighted_energy > 0 and now.told <= whole.told:
                f = max(
                    0.0,
                    (before.weighted_energy - now.weighted_energy)
                    / more
                    / (whole.weighted_energy / left),
                )
                probability = float(fdtrc(more, left, f))
            found.append(
                Step(cause, now.rms, now.rms_fitted, now.told, now.bic, float(f), probability)
            )
        return tuple(found)

    @cached_property
    def rivals(self) -> tuple[CauseModel, ...]:
        """All combinations that could be, the best first.

        A payload is a body, and beside free links, to which it adds nothing, in none.
        """
        every = (
            frozenset(some)
            for size in range(len(self.causes) + 1)
            for some in combinations(self.causes, size)
        )
        fits = [self.fit(some) for some in every if not {"payload", "links"} <= some]
        return tuple(
            sorted(
                (fit for fit in fits if fit.possible),
                key=lambda fit: (round(fit.score, 6), len(fit.causes)),
            )
        )

    @cached_property
    def chosen(self) -> CauseModel:
        """The combination with the fewest causes among those about as likely as the best."""
        likely = [fit for fit in self.rivals if fit.score <= self.rivals[0].score + NEARLY]
        return min(likely, key=lambda fit: len(fit.causes))

    @cached_property
    def untold(self) -> CauseModel | None:
        """The combination that takes most of the error away, more than half, where none is chosen
        for want of independent samples; None elsewhere.
        """
        if self.chosen.causes:
            return None

        def left(fit: CauseModel) -> float:
            return float(self.weights**2 @ fit.rms**2)

        best = min(self.rivals, key=left)
        return best if left(best) < MOSTLY_LEFT * left(self.chosen) else None

    @property
    def tells_payload(self) -> bool:
        """Whether the torques of this robot feel the mass of a body at the flange at all.

        Those of a single hinge do not.
        """
        return bool(self.present[self.columns["payload"][9]])

    @cached_property
    def possible_payload(self) -> tuple[CauseModel, float, float, Array]:
        """The fit with a payload in place of free links, its mass and error [kg] and its centre
        [m].
        """
        fit = self.fit((self.chosen.causes - {"links"}) | {"payload"})
        body, mass_error = (
            fit.values[self.columns["payload"]],
            float(fit.std_errors[self.columns["payload"]][9]),
        )
        return (
            fit,
            float(body[9]),
            mass_error,
            body[6:9] / body[9] if body[9] else np.full(3, np.inf),
        )

    @cached_property
    def weighed(self) -> tuple[str, ...]:
        """The causes chosen, and a payload where it could be part of what is put down to the links.

        Where such a body can be.
        """
        causes = self.chosen.causes
        if "links" in causes and "payload" in self.causes:
            fit, *_ = self.possible_payload
            without = self.fit(causes - {"links"})
            if fit.possible and fit.score < without.score:
                causes = causes | {"payload"}
        return tuple(cause for cause in CAUSES if cause in causes)

    def sizes(self, weighed: tuple[str, ...]) -> dict[str, Array]:
        """Return the parameters of each cause weighed, (columns,).

        A general cause has what the special one that it contains leaves.

        Richer friction is what remains of it beside the plain friction nearest to the whole, joint
        by joint; links what remains beside the payload.
        """
        inside = {
            cause: np.isin(np.arange(len(self.names)), self.columns[cause]) for cause in weighed
        }
        found = {cause: np.where(inside[cause], self.chosen.values, 0.0) for cause in weighed}
        if {"payload", "links"} <= set(weighed):
            found["payload"] = np.where(inside["payload"], self.possible_payload[0].values, 0.0)
            found["links"] = found["links"] - found["payload"]
        if {"friction", "richer friction"} <= set(weighed):
            for rows in self.fitted:
                plain, rich = (
                    np.flatnonzero(inside[cause] & (np.abs(rows[:, :-1]) > 0).any(axis=0))
                    for cause in ("friction", "richer friction")
                )
                if plain.size and rich.size:
                    moved = np.linalg.lstsq(
                        rows[:, plain], rows[:, rich] @ self.chosen.values[rich], rcond=None
                    )[0]
                    found["friction"][plain] += moved
                    found["richer friction"][plain] -= moved
        return found

    def parts(self, weighed: tuple[str, ...]) -> dict[str, Array]:
        """Divide the drop of the mean squared error of every joint among causes of the sizes found
        together.

        With the torques y_i of the causes, e = tau - tau_CAD and r = e - sum y, the Shapley value
        of the drop |e|^2 - |e - sum_S y|^2 is y_i . (e + r).
        """
        sizes = self.sizes(weighed)
        found = {cause: np.zeros(self.cause_data.n_joints) for cause in weighed}
        for k, rows in enumerate(self.judged):
            torque = {cause: rows[:, :-1] @ size for cause, size in sizes.items()}
            e = rows[:, -1]
            both = 2.0 * e - np.sum(list(torque.values()), axis=0) if torque else e
            for cause, y in torque.items():
                found[cause][k] = float(y @ both) / self.cause_data.n_judged
        return found

    def alike(self, shares: Mapping[str, Array]) -> tuple[tuple[str, str], ...]:
        """Pairs of which one does what the other would, seen over all joints, each joint's error in
        units of its noise.
        """
        size = self.weights**2 * self.fit(frozenset()).rms ** 2
        total = {cause: float(size @ share) for cause, share in shares.items()}
        causes = frozenset(total)

        def lost(*without: str) -> float:
            return float(
                self.weights**2
                @ (self.fit(causes - set(without)).rms ** 2 - self.fit(causes).rms ** 2)
            )

        worth = WORTH_TELLING * sum(size)
        found = []
        for one, two in combinations(total, 2):
            if (
                BEFORE.get(two) == one
                or BEFORE.get(one) == two
                or min(total[one], total[two]) < worth
            ):
                continue
            if (
                lost(one) < OWN * total[one]
                and lost(two) < OWN * total[two]
                and lost(one, two) > 2.0 * (lost(one) + lost(two))
            ):
                found.append((one, two))
        return tuple(found)


def _rms(rows: Sequence[Array], x: Array, n: int) -> Array:
    errors = [row[:, -1] - row[:, :-1] @ x for row in rows]
    return np.sqrt([float(error @ error) / n for error in errors])
