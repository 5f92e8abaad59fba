"""Which causes explain how much of what CAD predicts wrongly: every combination of causes fitted, shares that do not depend on their order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.blas import one_blas_thread
from asbuilt.errors import ResultError
from asbuilt.identification.cause_evidence import TILTS, CauseEvidence
from asbuilt.identification.triangular import triangular_factor
from asbuilt.tables import SIGNIFICANT_SIGMAS, Cell, Column, Shown, Table, plus_minus, significant, stacked
from asbuilt.tables import share as percentage
from asbuilt.validation.comparison import recording_name
from asbuilt.validation.prediction import design_values, torque_units

if TYPE_CHECKING:
    from asbuilt.identification.result import IdentificationResult

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Subset = frozenset[str]

CAUSES: dict[str, str] = {
    "offset": "torque offset",
    "friction": "viscous and Coulomb friction",
    "richer friction": "richer friction",
    "armature": "armature",
    "payload": "a body at the flange",
    "mounting": "mounting askew",
    "gain": "torque gain",
    "links": "mass distribution of the links",
}
"""The causes, in the order in which the nested models take them up, and what they are called in sentences."""
BEFORE: dict[str, str] = {"richer friction": "friction", "links": "payload"}
"""A general cause that contains a special one comes after it in every order."""
_OF_TERM = {"offset": "offset", "armature": "armature", "motor_armature": "armature", "viscous": "friction", "coulomb": "friction"}
_OF_TERM |= {"motor_viscous": "friction", "motor_coulomb": "friction"}

WEAKEST = 1e-10
"""Squared singular value of the fit, relative to the largest with columns scaled alike, below which a direction is left alone."""
MOST_EXCHANGES = 30
"""Rounds in which parameters that cannot be negative are set to zero or freed again."""
NEARLY = 6.0
"""Difference in score, as of a deviance, within which two combinations are about as likely (Kass & Raftery, J. Am. Stat. Assoc. 90, 1995: not strong evidence)."""
WORTH_SAYING = 0.05
"""Share of the error from which a cause is named."""
MOSTLY = 0.5
"""Share of the error left unexplained from which no cause is named."""
OWN = 0.5
"""Two causes cannot be told apart where without either one the error grows by less than this part of that cause's share."""
NOISE_FLOOR = 1e-9
"""Smallest RMS of a joint, as a fraction of its torque, that the fit distinguishes from none."""
USUAL_GAIN = 0.1
"""Standard deviation of torque gains from 1 that is believed before any measurement."""
USUAL_TILT = np.deg2rad(1.0)
"""Standard deviation of tilts of the mounting that is believed before any measurement [rad]."""
POSSIBLE_REACH = 1.0
"""Farthest that the centre of a body carried at the flange may be from the last joint's frame [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class CauseModel:
    """Hold the fit of one combination of causes.

    `rms` (n,) is the error of each joint on the data judged by, `rms_fitted` on the data used; `values` are the parameters by name; `rank` how many of them
    the data tell; `bic` the Bayesian information criterion with as many samples as are independent, who also set the `std_errors`; `possible` is False where
    the payload would be no body: without mass, or out of reach.
    """

    causes: Subset
    rms: Array
    rms_fitted: Array
    rank: int
    weighted_energy: float
    bic: float
    score: float
    values: Array
    std_errors: Array
    possible: bool


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One step of the nested models: the cause taken up, the errors then, and the F-test of it against the model before."""

    cause: str
    rms: Array
    rms_fitted: Array
    parameters: int
    bic: float
    f: float
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class CauseShare:
    """What one cause explains of the squared CAD error of every joint, each (n,) as a fraction of it.

    `share` divides what the causes explain together, with the sizes found together; `refitted` is the Shapley value where every combination is
    fitted anew, so that causes stand in for each other; `alone` is what the cause explains by itself, `last` what it adds to all others.
    """

    cause: str
    share: Array
    refitted: Array
    alone: Array
    last: Array


@dataclass(frozen=True, slots=True, eq=False)
class Attribution:
    """Hold which causes the error of CAD has.

    `steps` are the nested models in the order of `CAUSES`; `chosen` is the combination with the smallest BIC; `shares` of the causes weighed (those chosen, and a
    payload where it could be part of what is put down to the links) add up, with `unexplained` (n,), to 1 for every joint. `alike` are pairs that this recording
    does not tell apart. `rms_cad` (n,) and `rms_chosen` (n,) are errors on `judged_by`. `findings` say in sentences what the causes amount to, `sentences` what each
    joint's error is made of.
    """

    robot: str
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    judged_by: str
    rms_cad: Array
    rms_chosen: Array
    steps: tuple[Step, ...]
    chosen: tuple[str, ...]
    weighed: tuple[str, ...]
    shares: tuple[CauseShare, ...]
    unexplained: Array
    alike: tuple[tuple[str, str], ...]
    findings: tuple[str, ...]
    sentences: tuple[str, ...]
    values: dict[str, float]

    def share_table(self) -> Table:
        """Return the share of every cause in the squared CAD error of every joint, in percent, what is left, and the errors themselves."""
        heads = [Column("cause"), *(Column(name, align="right", width=16) for name in self.joint_names)]
        rows: list[tuple[Cell, ...]] = [
            (CAUSES[each.cause], *(Shown(float(part), percentage(float(part), 0)) for part in each.share)) for each in self.shares
        ]
        rows.append(("unexplained", *(Shown(float(part), percentage(float(part), 0)) for part in self.unexplained)))
        for what, errors in (("RMS error of CAD", self.rms_cad), ("RMS error explained", self.rms_chosen)):
            rows.append(
                (
                    what,
                    *(Shown(float(error), f"{significant(float(error))} {unit}") for error, unit in zip(errors, self.units, strict=True)),
                )
            )
        return Table(
            tuple(heads),
            tuple(rows),
            title="What the error of CAD is made of, shares of its square",
            notes=(f"Judged on {self.judged_by}.",),
        )

    def step_table(self) -> Table:
        """Return the nested models: RMS error of every joint on held-out data, parameters told, F-test of each step, BIC."""
        heads = [
            Column("model"),
            *(Column(name, unit, "decimal", width=16) for name, unit in zip(self.joint_names, self.units, strict=True)),
        ]
        heads += [
            Column("parameters", align="right"),
            Column("F", align="decimal"),
            Column("p", align="right"),
            Column("BIC", align="right"),
        ]
        rows: list[tuple[Cell, ...]] = []
        for number, step in enumerate(self.steps):
            errors = [Shown(float(error), significant(float(error))) for error in step.rms]
            tested = np.isfinite(step.f)
            rows.append(
                (
                    "CAD" if number == 0 else f"+ {CAUSES[step.cause]}",
                    *errors,
                    step.parameters,
                    Shown(step.f, significant(step.f)) if tested else None,
                    Shown(step.probability, f"{step.probability:.1g}") if tested else None,
                    Shown(step.bic, f"{step.bic:.0f}"),
                )
            )
        note = "F: what the step explains against what is left, with as many samples as are independent; errors are those on data held out and may rise."
        return Table(tuple(heads), tuple(rows), title="Nested models, held-out RMS error", notes=(note,))

    def as_text(self) -> str:
        """Return sentences and both tables for a terminal."""
        said = ["Why CAD is off:", *(f"  {line}" for line in self.sentences), *(f"  {line}" for line in self.findings)]
        return "\n".join(said) + "\n\n" + stacked([self.share_table(), self.step_table()])

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, texts and lists, ready for JSON."""
        return {
            "judged_by": self.judged_by,
            "joints": list(self.joint_names),
            "rms_cad": self.rms_cad.tolist(),
            "rms_chosen": self.rms_chosen.tolist(),
            "chosen": list(self.chosen),
            "shares": [
                {
                    "cause": each.cause,
                    "share": each.share.tolist(),
                    "refitted": each.refitted.tolist(),
                    "alone": each.alone.tolist(),
                    "last": each.last.tolist(),
                }
                for each in self.shares
            ],
            "unexplained": self.unexplained.tolist(),
            "not_told_apart": [list(pair) for pair in self.alike],
            "steps": [
                {
                    "cause": step.cause,
                    "rms": step.rms.tolist(),
                    "rms_fitted": step.rms_fitted.tolist(),
                    "parameters": step.parameters,
                    "bic": step.bic,
                    "f": step.f,
                    "p_value": step.probability,
                }
                for step in self.steps
            ],
            "values": self.values,
            "findings": list(self.findings),
            "sentences": list(self.sentences),
        }


def attribute(result: IdentificationResult, cad: RobotModel | None = None) -> Attribution:
    """Attribute the torque error of CAD (or of `cad`, another description of the same geometry) to causes.

    Every combination of causes present is fitted to `tau - tau_CAD` by least squares with each joint weighted by its noise, and judged on data held out. The
    combination with the smallest BIC is chosen; within it the drop of each joint's squared error is divided by the Shapley value (Shapley, 1953) over
    the orders that take a special cause before the general one that contains it (Faigle & Kern, Int. J. Game Theory 21, 1992). Tilt and gain are linearised
    at CAD. Raises `ResultError` where the result carries no evidence.
    """
    if result.evidence is None:
        raise ResultError(
            f"this result of {result.robot} carries no evidence of causes (streamed, or written by an earlier version); identify again from recordings"
        )
    with one_blas_thread():
        return _Fits(result, result.evidence, cad).attribution()


class _Fits:
    """Fit combinations of causes, each once."""

    def __init__(self, result: IdentificationResult, evidence: CauseEvidence, cad: RobotModel | None) -> None:
        self.result, self.evidence = result, evidence
        self.model = result.model if cad is None else cad
        n, p = evidence.n_joints, len(evidence.names)
        base = result.base
        design = np.nan_to_num(result.cad_values if cad is None else design_values(result, cad), nan=0.0)
        x = np.zeros(p)
        x[evidence.places(base.names)] = design
        self.design = np.concatenate([x, np.zeros(n + 10)])
        links = [name for name, j in zip(base.names, base.columns, strict=True) if j < 10 * n]
        self.rigid = evidence.places(links)
        K = base.regrouping[: len(links), 10 * (n - 1) : 10 * n]
        self.non_negative: NDArray[np.bool_] = np.zeros(0, dtype=bool)
        self.names = (*evidence.names, *(f"gain {k + 1}" for k in range(n)), *(f"payload {i}" for i in range(10)))
        self.fitted, self.judged = ([self._widened(factor, x, K, k) for k, factor in enumerate(evidence.whole(factors))] for factors in (
            evidence.fitted, evidence.judged))  # fmt: skip
        floor = NOISE_FLOOR * np.sqrt([float(f[:, -1] @ f[:, -1]) / evidence.n_fitted for f in evidence.fitted])
        self.floor = np.maximum(floor, np.finfo(float).tiny)
        self.weights = 1.0 / np.maximum(result.sigma, self.floor)
        self.independent = evidence.n_fitted * min(1.0, result.effective_samples / result.n_samples)
        stacked = triangular_factor(np.vstack([w * rows for w, rows in zip(self.weights, self.fitted, strict=True)]))
        self.length = np.linalg.norm(stacked[:, :-1], axis=0)
        self.present = self.length > 1e-9 * self.length.max(initial=0.0)
        self.length = np.where(self.present, self.length, 1.0)
        scaled = stacked[:, :-1] / self.length
        self.columns = self._columns()
        self.belief = np.zeros(len(self.names))
        self.belief[self.columns["gain"]], self.belief[self.columns["mounting"]] = 1.0 / USUAL_GAIN, 1.0 / USUAL_TILT
        belief = self.belief * np.sqrt(evidence.n_fitted / self.independent) / self.length
        self.gram, self.right = scaled.T @ scaled + np.diag(belief**2), scaled.T @ stacked[:, -1]
        self.causes = tuple(cause for cause in CAUSES if np.any(self.present[self.columns[cause]]))
        self._known: dict[Subset, CauseModel] = {}

    def _widened(self, rows: Array, x: Array, K: Array, joint: int) -> Array:
        """Columns of the evidence, a gain per joint, ten of a payload; last the torque less that of CAD."""
        A = rows[:, :-1]
        n = self.evidence.n_joints
        gains = np.zeros((len(rows), n))
        gains[:, joint] = A @ x
        return np.hstack([A, gains, A[:, self.rigid] @ K, (rows[:, -1] - A @ x)[:, None]])

    def _columns(self) -> dict[str, Indices]:
        n, names = self.evidence.n_joints, list(self.names)
        found: dict[str, list[int]] = {cause: [] for cause in CAUSES}
        found["links"] = self.rigid.tolist()
        for term in self.evidence.drive.terms:
            letters = [f"{letter}{k + 1}" for k in range(n) for letter in term.letters]
            found[_OF_TERM.get(term.key, "richer friction")] += [names.index(letter) for letter in letters]
        found["mounting"] = [names.index(name) for name in TILTS]
        found["gain"] = [names.index(f"gain {k + 1}") for k in range(n)]
        found["payload"] = [names.index(f"payload {i}") for i in range(10)]
        self.non_negative = np.zeros(len(names), dtype=bool)
        for term in self.evidence.drive.terms:
            if _OF_TERM.get(term.key) in ("friction", "armature"):
                self.non_negative[[names.index(f"{letter}{k + 1}") for k in range(n) for letter in term.letters]] = True
        return {cause: np.array(sorted(places), dtype=np.int64) for cause, places in found.items()}

    def fit(self, causes: Subset) -> CauseModel:
        """Fit a combination."""
        if causes not in self._known:
            places = np.concatenate([np.array([], dtype=np.int64), *(self.columns[cause] for cause in sorted(causes))])
            places = places[self.present[places]]
            x, spread, rank = np.zeros(len(self.names)), np.zeros(len(self.names)), 0
            free, bounded = np.ones(places.size, dtype=bool), self.non_negative[places]
            floor = np.where(bounded, -self.design[places] * self.length[places], 0.0)
            right = self.right[places] - self.gram[np.ix_(places, places)] @ floor
            for _ in range(MOST_EXCHANGES):
                some = places[free]
                eigenvalues, vectors = np.linalg.eigh(self.gram[np.ix_(some, some)])
                kept = eigenvalues > WEAKEST * eigenvalues.max(initial=0.0)
                V, y = vectors[:, kept], np.zeros(places.size)
                y[free], rank = V @ ((V.T @ right[free]) / eigenvalues[kept]), int(kept.sum())
                pull = right - self.gram[np.ix_(places, places)] @ y
                out = free & bounded & (y < 0)
                back = ~free & (pull > WEAKEST * np.abs(right).max(initial=0.0))
                if not (out | back).any():
                    break
                free ^= out | back
            x[places] = (np.where(bounded, np.maximum(y, 0.0), y) + floor) / self.length[places] if places.size else 0.0
            if places.size:
                spread[some] = np.sqrt(np.sum(V**2 / eigenvalues[kept], axis=1)) / self.length[some]
            self._known[causes] = self._judged(causes, x, spread, rank)
        return self._known[causes]

    def _judged(self, causes: Subset, x: Array, spread: Array, rank: int) -> CauseModel:
        e = self.evidence
        rms_fitted = _rms(self.fitted, x, e.n_fitted)
        n_rows = self.independent * e.n_joints
        energy = float(np.sum((self.weights * np.maximum(rms_fitted, self.floor)) ** 2)) * self.independent
        noise = energy / max(n_rows - rank, 1.0) * e.n_fitted / self.independent
        rms = _rms(self.judged, x, e.n_judged)
        independent_judged = self.independent * e.n_judged / e.n_fitted
        return CauseModel(
            causes=causes,
            rms=rms,
            score=float(2.0 * independent_judged * np.sum(np.log(np.maximum(rms, self.floor))) + rank + np.sum((self.belief * x) ** 2)),
            rms_fitted=rms_fitted,
            rank=rank,
            weighted_energy=energy,
            bic=float(2.0 * self.independent * np.sum(np.log(np.maximum(rms_fitted, self.floor))) + rank * np.log(max(n_rows, 2.0))),
            values=x,
            std_errors=spread * np.sqrt(noise),
            possible="payload" not in causes or "links" in causes or self._is_body(x[self.columns["payload"]]),
        )

    @staticmethod
    def _is_body(body: Array) -> bool:
        return bool(body[9] > 0 and np.linalg.norm(body[6:9]) <= POSSIBLE_REACH * body[9])

    def steps(self) -> tuple[Step, ...]:
        """Return the nested models."""
        before = self.fit(frozenset())
        found = [Step("CAD", before.rms, before.rms_fitted, 0, before.bic, np.nan, np.nan)]
        for place, cause in enumerate(self.causes):
            now = self.fit(frozenset(self.causes[: place + 1]))
            more, left = now.rank - before.rank, self.independent * self.evidence.n_joints - now.rank
            f, probability = np.nan, np.nan
            if more > 0 and left > 0 and now.weighted_energy > 0:
                f = max(0.0, (before.weighted_energy - now.weighted_energy) / more / (now.weighted_energy / left))
                probability = float(fdtrc(more, left, f))
            found.append(Step(cause, now.rms, now.rms_fitted, now.rank, now.bic, float(f), probability))
            before = now
        return tuple(found)

    @cached_property
    def rivals(self) -> tuple[CauseModel, ...]:
        """All combinations that could be, the best first: a payload is a body, and beside free links, to which it adds nothing, in none."""
        every = (frozenset(some) for size in range(len(self.causes) + 1) for some in combinations(self.causes, size))
        fits = [self.fit(some) for some in every if not {"payload", "links"} <= some]
        return tuple(sorted((fit for fit in fits if fit.possible), key=lambda fit: (round(fit.score, 6), len(fit.causes))))

    @cached_property
    def chosen(self) -> CauseModel:
        """The combination with the fewest causes among those about as likely as the best."""
        likely = [fit for fit in self.rivals if fit.score <= self.rivals[0].score + NEARLY]
        return min(likely, key=lambda fit: len(fit.causes))

    @cached_property
    def possible_payload(self) -> tuple[CauseModel, float, float, Array]:
        """The fit with a payload in place of free links, its mass and error [kg] and its centre [m]."""
        fit = self.fit((self.chosen.causes - {"links"}) | {"payload"})
        body, mass_error = fit.values[self.columns["payload"]], float(fit.std_errors[self.columns["payload"]][9])
        return fit, float(body[9]), mass_error, body[6:9] / body[9] if body[9] else np.full(3, np.inf)

    @cached_property
    def weighed(self) -> tuple[str, ...]:
        """The causes chosen, and a payload where it could be part of what is put down to the links: where such a body can be."""
        causes = self.chosen.causes
        if "links" in causes and "payload" in self.causes:
            fit, *_ = self.possible_payload
            without = self.fit(causes - {"links"})
            if fit.possible and fit.score < without.score:
                causes = causes | {"payload"}
        return tuple(cause for cause in CAUSES if cause in causes)

    def attribution(self) -> Attribution:
        e, result = self.evidence, self.result
        weighed = self.weighed
        cad, whole = self.fit(frozenset()), self.chosen
        energy = np.maximum(cad.rms, np.finfo(float).tiny) ** 2
        refitted = shapley_values(weighed, lambda some: 1.0 - self.fit(some).rms ** 2 / energy)
        parts = self._parts(weighed)
        shares = tuple(
            CauseShare(
                cause=cause,
                share=parts[cause] / energy,
                refitted=refitted[cause],
                alone=1.0 - self.fit(frozenset({cause})).rms ** 2 / energy,
                last=(self.fit(frozenset(weighed) - {cause}).rms ** 2 - whole.rms**2) / energy,
            )
            for cause in weighed
        )
        alike = self._alike(shares)
        values = {name: float(v) for name, v in zip(self.names, self.chosen.values, strict=True) if v}
        return Attribution(
            robot=result.robot,
            joint_names=e.joint_names,
            units=torque_units(result.model),
            judged_by=recording_name(e.judged_by),
            rms_cad=cad.rms,
            rms_chosen=whole.rms,
            steps=self.steps(),
            chosen=tuple(cause for cause in CAUSES if cause in self.chosen.causes),
            weighed=weighed,
            shares=shares,
            unexplained=whole.rms**2 / energy,
            alike=alike,
            findings=tuple(self._findings(weighed, alike)),
            sentences=tuple(self._sentence(k, shares, float(whole.rms[k] ** 2 / energy[k])) for k in range(e.n_joints)),
            values=values,
        )

    def sizes(self, weighed: tuple[str, ...]) -> dict[str, Array]:
        """Return the parameters of each cause weighed, (columns,); a general cause has what the special one that it contains leaves.

        Richer friction is what remains of it beside the plain friction nearest to the whole, joint by joint; links what remains beside the payload.
        """
        inside = {cause: np.isin(np.arange(len(self.names)), self.columns[cause]) for cause in weighed}
        found = {cause: np.where(inside[cause], self.chosen.values, 0.0) for cause in weighed}
        if {"payload", "links"} <= set(weighed):
            found["payload"] = np.where(inside["payload"], self.possible_payload[0].values, 0.0)
            found["links"] = found["links"] - found["payload"]
        if {"friction", "richer friction"} <= set(weighed):
            for rows in self.fitted:
                plain, rich = (
                    np.flatnonzero(inside[cause] & (np.abs(rows[:, :-1]) > 0).any(axis=0)) for cause in ("friction", "richer friction")
                )
                if plain.size and rich.size:
                    moved = np.linalg.lstsq(rows[:, plain], rows[:, rich] @ self.chosen.values[rich], rcond=None)[0]
                    found["friction"][plain] += moved
                    found["richer friction"][plain] -= moved
        return found

    def _parts(self, weighed: tuple[str, ...]) -> dict[str, Array]:
        """Divide the drop of the mean squared error of every joint among causes of the sizes found together.

        With the torques y_i of the causes, e = tau - tau_CAD and r = e - sum y, the Shapley value of the drop |e|^2 - |e - sum_S y|^2 is y_i . (e + r).
        """
        sizes = self.sizes(weighed)
        found = {cause: np.zeros(self.evidence.n_joints) for cause in weighed}
        for k, rows in enumerate(self.judged):
            torque = {cause: rows[:, :-1] @ size for cause, size in sizes.items()}
            e = rows[:, -1]
            both = 2.0 * e - np.sum(list(torque.values()), axis=0) if torque else e
            for cause, y in torque.items():
                found[cause][k] = float(y @ both) / self.evidence.n_judged
        return found

    def _alike(self, shares: Sequence[CauseShare]) -> tuple[tuple[str, str], ...]:
        """Pairs of which one does what the other would, seen over all joints, each joint's error in units of its noise."""
        size = self.weights**2 * self.fit(frozenset()).rms ** 2
        total = {each.cause: float(size @ each.share) for each in shares}
        causes = frozenset(total)

        def lost(*without: str) -> float:
            return float(self.weights**2 @ (self.fit(causes - set(without)).rms ** 2 - self.fit(causes).rms ** 2))

        worth = WORTH_SAYING * sum(size)
        found = []
        for one, two in combinations(total, 2):
            if BEFORE.get(two) == one or BEFORE.get(one) == two or min(total[one], total[two]) < worth:
                continue
            if lost(one) < OWN * total[one] and lost(two) < OWN * total[two] and lost(one, two) > 2.0 * (lost(one) + lost(two)):
                found.append((one, two))
        return tuple(found)

    def _findings(self, weighed: tuple[str, ...], alike: tuple[tuple[str, str], ...]) -> list[str]:
        found = []
        if "payload" in self.causes and {"payload", "links"} & set(weighed):
            _, mass, error, centre = self.possible_payload
            away = float(np.linalg.norm(centre))
            where = ", ".join(f"{round(1e3 * float(c))}" for c in centre)
            body = f"{plus_minus(mass, error)} kg with its centre at ({where}) mm in the frame of {self.result.model.link_names[-1]}"
            if "links" not in weighed:
                found.append(f"The last link carries {body}.")
            elif "payload" in weighed:
                found.append(
                    f"Part of what the links' mass distribution explains, {body} at the flange would explain as well; free links can imitate any payload, "
                    "so only simplicity speaks for it."
                )
            elif mass <= 0:
                found.append(f"A payload is no explanation: it would have a mass of {plus_minus(mass, error)} kg.")
            elif away > POSSIBLE_REACH:
                found.append(f"A payload is no explanation: its centre would lie {significant(away, 2)} m off the last joint.")
        if "mounting" in weighed:
            place = self.columns["mounting"]
            tilts = [plus_minus(*np.rad2deg([self.chosen.values[j], self.chosen.std_errors[j]]).tolist()) for j in place]
            turned = " and ".join(f"{tilt} about {_axis(axis)}" for tilt, axis in zip(tilts, self.evidence.tilt_axes, strict=True))
            sure = np.any(np.abs(self.chosen.values[place]) >= SIGNIFICANT_SIGMAS * self.chosen.std_errors[place])
            found.append(f"The root frame {'stands' if sure else 'may stand'} askew by {turned}, in degrees.")
        if "gain" in weighed:
            told = [
                (name, 100 * self.chosen.values[j], 100 * self.chosen.std_errors[j])
                for name, j in zip(self.evidence.joint_names, self.columns["gain"], strict=True)
            ]
            listed = ", ".join(f"{name} {g:+.1f} +/- {e:.1f} %" for name, g, e in told if abs(g) >= SIGNIFICANT_SIGMAS * e)
            found.append(f"Torques read larger or smaller than they are: {listed}.")
        for one, two in alike:
            found.append(
                f"This recording does not tell {CAUSES[one]} from {CAUSES[two]}: with either in the model the other adds little, and their shares are "
                "divided between them for want of better."
            )
        rival = next((fit for fit in self.rivals if self.chosen.causes - fit.causes and fit.score <= self.chosen.score + NEARLY), None)
        if rival is not None:
            instead = ", ".join(CAUSES[cause] for cause in CAUSES if cause in rival.causes - self.chosen.causes)
            replaced = ", ".join(CAUSES[cause] for cause in CAUSES if cause in self.chosen.causes - rival.causes)
            found.append(f"About as likely, for what this recording tells: {instead} in place of {replaced}.")
        missing = [CAUSES[cause] for cause in self.causes if cause not in weighed and not (cause == "payload" and "links" in weighed)]
        if missing:
            found.append(f"Not needed to explain this recording: {', '.join(missing)}.")
        return found

    def _sentence(self, k: int, shares: Sequence[CauseShare], left: float) -> str:
        unit = torque_units(self.result.model)[k]
        head = f"{self.evidence.joint_names[k]}: CAD is off by {significant(float(self.fit(frozenset()).rms[k]))} {unit} RMS"
        named = sorted((each for each in shares if abs(each.share[k]) >= WORTH_SAYING), key=lambda each: -each.share[k])
        if not named or named[0].share[k] < WORTH_SAYING or left > MOSTLY:
            return f"{head}, {'which' if left > 1.0 - WORTH_SAYING else 'most of which'} no cause explains."
        parts = [f"{percentage(float(each.share[k]), 0)} {self._amount(each.cause, k)}" for each in named]
        parts[0] = parts[0].replace(" % ", " % of the squared error is ", 1)
        return f"{head}; {', '.join(parts)}; {percentage(left, 0)} unexplained."

    def _amount(self, cause: str, k: int) -> str:
        """Say what a cause amounts to at a joint."""
        fit, names = self.chosen, list(self.names)
        unit = torque_units(self.result.model)[k]
        speed = "rad/s" if unit == "N m" else "m/s"

        size = self.sizes(self.weighed)[cause]

        def value(letter: str) -> float:
            name = f"{letter}{k + 1}"
            return float(size[names.index(name)]) if name in names else 0.0

        if cause == "payload":
            body = f"{significant(self.possible_payload[1], 2)} kg at the flange"
            return f"what {body} would do" if "links" in fit.causes else body
        if cause == "friction":
            return f"friction (Coulomb {significant(value('Fc'), 2)} {unit}, viscous {significant(value('Fv'), 2)} {unit} per {speed})"
        if cause == "offset":
            return f"an offset of {significant(value('Fo'), 2)} {unit}"
        if cause == "armature":
            return f"armature ({significant(value('Ia'), 2)} {'kg m^2' if unit == 'N m' else 'kg'})"
        if cause == "gain":
            return f"torque gain ({100 * value('gain '):+.0f} %)"
        if cause == "mounting":
            return f"mounting askew ({significant(float(np.rad2deg(np.hypot(*fit.values[self.columns['mounting']]))), 2)} deg)"
        return CAUSES[cause]


def _rms(rows: Sequence[Array], x: Array, n: int) -> Array:
    errors = [row[:, -1] - row[:, :-1] @ x for row in rows]
    return np.sqrt([float(error @ error) / n for error in errors])


def shapley_values(causes: tuple[str, ...], worth: Callable[[Subset], Array]) -> dict[str, Array]:
    """Divide worth(all) - worth(none), each (n,), over the orders that take `BEFORE[c]`, where present, before c: the mean of what a cause adds.

    >>> {cause: part.tolist() for cause, part in shapley_values(("payload", "links"), lambda some: np.array([float("links" in some) or 0.5 * len(some)])).items()}
    {'payload': [0.5], 'links': [0.5]}
    """
    ways_to, ways_from = _orders(causes)
    values = {some: worth(some) for some in ways_to}
    return {
        cause: np.asarray(
            sum(
                ways_to[some] * ways_from[some | {cause}] / ways_to[frozenset(causes)] * (values[some | {cause}] - values[some])
                for some in ways_to
                if cause not in some and some | {cause} in ways_to
            )
        )
        for cause in causes
    }


def _orders(causes: tuple[str, ...]) -> tuple[dict[Subset, int], dict[Subset, int]]:
    """Count, for every feasible set, the orders that lead to it from none and from it to all."""
    everything = frozenset(causes)
    feasible = [
        frozenset(some)
        for size in range(len(causes) + 1)
        for some in combinations(causes, size)
        if all(BEFORE.get(cause) not in everything or BEFORE[cause] in some for cause in some)
    ]
    ways_to: dict[Subset, int] = {frozenset(): 1}
    for some in feasible[1:]:
        ways_to[some] = sum(ways_to.get(some - {cause}, 0) for cause in some)
    ways_from: dict[Subset, int] = {everything: 1}
    for some in reversed(feasible[:-1]):
        ways_from[some] = sum(ways_from.get(some | {cause}, 0) for cause in everything - some)
    return ways_to, ways_from


def _axis(axis: Array) -> str:
    for name, unit in zip("xyz", np.eye(3), strict=True):
        if np.allclose(axis, unit, atol=1e-9):
            return name
    return f"({', '.join(f'{c:.2f}' for c in axis)})"
