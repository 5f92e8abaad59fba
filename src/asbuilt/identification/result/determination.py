"""In plain words, what a recording determines.

Which parameters well, which hardly, which combinations trade off, and which motion would help.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.excitation.limits import MotionBounds
from asbuilt.identification.information.known_information import known_information
from asbuilt.tables import share, significant

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


WELL = 0.10
"""Standard error, as a fraction of the larger of estimate and CAD value, up to which a parameter is
determined well,
"""
HARDLY = 0.50
"""and from which hardly."""
TRADES = 2.5
"""How much larger the error of a combination must be than its parameters would have alone to be
called a trade-off.
"""
MOST_NAMED = 5
TAKES_PART = 0.35
"""Coefficient, relative to the largest, from which a parameter is named in a combination."""
MOST_COMBINATIONS = 6
EXTRA_SECONDS = 20.0
"""Length of the further motion whose help is judged [s]."""
DRAWS = 160
"""States drawn for each kind of motion."""
HELPS = 0.5
"""Ratio of errors after and before from which a motion helps a parameter."""
UNTOLD = 1e-8
"""Information, relative to a parameter's own, that every direction is taken to have, so that errors
of what nothing tells are large but finite.
"""
SLOW = 0.05
"""Fraction of the velocity limit of a slow motion."""


@dataclass(frozen=True, slots=True)
class Combination:
    """Parameters that this recording tells only together.

    `text` names them, `spread` is how much larger the error of the first is than if the others were
    known.
    """

    names: tuple[str, ...]
    text: str
    spread: float


@dataclass(frozen=True, slots=True)
class Advice:
    """A further motion, the parameters that it would determine better, and the mean ratio of their
    errors after and before.
    """

    motion: str
    names: tuple[str, ...]
    ratio: float


@dataclass(frozen=True, slots=True)
class Determination:
    """Say what a recording determines.

    `well` are the parameters known to 10 % or better, `fairly` to 50 %, `hardly` worse than that
    and `negligible` those of them whose error hardly changes the torque of this motion, so that the
    result does not call them poorly determined; `not_at_all` those that nothing in the recording
    tells; `dropped` those that the estimator set to zero as needless, which have no error.
    """

    well: tuple[str, ...]
    fairly: tuple[str, ...]
    hardly: tuple[str, ...]
    negligible: tuple[str, ...]
    not_at_all: tuple[str, ...]
    combinations: tuple[Combination, ...]
    advice: tuple[Advice, ...]
    dropped: tuple[str, ...] = ()

    @property
    def in_short(self) -> str:
        """One line for a summary."""
        total = sum(
            len(names)
            for names in (self.well, self.fairly, self.hardly, self.not_at_all, self.dropped)
        )
        parts = [
            f"Determined to {100 * WELL:g} % or better: {len(self.well)} of {total} parameters; to"
            f" {100 * HARDLY:g} %: {len(self.fairly)}; hardly: {len(self.hardly)}"
            + (
                f", {len(self.negligible)} of which make next to no torque in this motion"
                if self.negligible
                else ""
            )
        ]
        if self.not_at_all:
            parts.append(f"not at all: {len(self.not_at_all)}")
        if self.dropped:
            parts.append(f"dropped as needless: {len(self.dropped)}")
        return (
            "; ".join(parts)
            + "."
            + (
                f" What would help: {'; '.join(tip.motion for tip in self.advice[:2])}."
                if self.advice
                else ""
            )
        )

    @property
    def sentences(self) -> tuple[str, ...]:
        """The whole, in sentences."""
        found = [
            f"Determined to {100 * WELL:g} % or better ({len(self.well)}): {_listed(self.well)}."
        ]
        if self.fairly:
            found.append(
                f"To between {100 * WELL:g} and {100 * HARDLY:g} % ({len(self.fairly)}):"
                f" {_listed(self.fairly)}."
            )
        if self.hardly:
            text = f"Hardly ({len(self.hardly)}): {_listed(self.hardly)}"
            if self.negligible:
                text += f"; of these {len(self.negligible)} make next to no torque in this motion"
            found.append(text + ".")
        if self.not_at_all:
            found.append(f"Not at all ({len(self.not_at_all)}): {_listed(self.not_at_all)}.")
        if self.dropped:
            found.append(
                f"Dropped, set to zero because an F-test does not miss them ({len(self.dropped)}):"
                f" {_listed(self.dropped)}. They have no error; those of the others hold if they"
                " are zero."
            )
        for each in self.combinations:
            found.append(
                f"Trade-off: {each.text} hardly changes the torque of this recording; the error of"
                f" {each.names[0]} is {significant(each.spread, 2)} times what it would be if the"
                " others were known."
            )
        for tip in self.advice:
            found.append(
                f"{tip.motion[0].upper()}{tip.motion[1:]}, for {EXTRA_SECONDS:g} s, would bring the"
                f" errors of {_listed(tip.names)} to about {share(tip.ratio, 0)} of what they are."
            )
        return tuple(found)

    def as_dict(self) -> dict[str, Any]:
        """Return plain texts, numbers and lists, ready for JSON."""
        fields = {
            name: list(getattr(self, name))
            for name in ("well", "fairly", "hardly", "negligible", "not_at_all", "dropped")
        }
        return fields | {
            "combinations": [asdict(each) for each in self.combinations],
            "advice": [asdict(tip) for tip in self.advice],
            "in_short": self.in_short,
            "sentences": list(self.sentences),
        }


def determination(result: IdentificationResult, *, motions: bool = True) -> Determination:
    """Say what the recording behind a result determines and, unless `motions` is False, which
    further motion would help.

    The combinations are the directions of the largest variance, in parameters scaled to unit error
    if all others were known (Belsley, Kuh & Welsch, Regression Diagnostics, 1980). Help is judged
    by adding the information of 20 s of every kind of motion within the robot's limits: slow poses,
    steady fast travel and hard acceleration of each joint, and of all at once.
    """
    names = np.array(result.base.names)
    dropped = result.dropped
    told = np.array([parameter.determined for parameter in result.parameters]) & ~dropped
    size = np.fmax(np.abs(result.estimates), np.abs(np.nan_to_num(result.cad_values, nan=0.0)))
    error = result.std_errors
    well, hardly = told & (error <= WELL * size), told & (error > HARDLY * size)
    with one_blas_thread():
        information = known_information(result)
        negligible = hardly & ~np.array(
            [parameter.poorly_determined for parameter in result.parameters]
        )
        combinations = _combinations(result, information, told)
        weak = np.flatnonzero(~well & ~(negligible & told) & ~dropped)
        advice = _advice(result, information, weak) if motions and weak.size else ()
    return Determination(
        well=tuple(names[well]),
        fairly=tuple(names[told & ~well & ~hardly]),
        hardly=tuple(names[hardly]),
        negligible=tuple(names[negligible]),
        not_at_all=tuple(names[~told & ~dropped]),
        dropped=tuple(names[dropped]),
        combinations=combinations,
        advice=advice,
    )


def _combinations(
    result: IdentificationResult, information: Array, told: NDArray[np.bool_]
) -> tuple[Combination, ...]:
    """Directions of large variance in parameters scaled to unit diagonal information, the largest
    first, each parameter named first once.
    """
    seen = np.flatnonzero(told & (np.diag(information) > 0))
    scale = 1.0 / np.sqrt(np.diag(information)[seen])
    scaled = information[np.ix_(seen, seen)] * np.outer(scale, scale)
    eigenvalues, vectors = np.linalg.eigh(scaled)
    found: list[Combination] = []
    for value, vector in zip(eigenvalues, vectors.T, strict=True):
        if value > 1.0 / TRADES**2 or len(found) == MOST_COMBINATIONS:
            break
        if value <= 0:
            continue
        order = np.argsort(-np.abs(vector), kind="stable")
        part = [int(i) for i in order if abs(vector[i]) >= TAKES_PART * abs(vector[order[0]])]
        spread = float(abs(vector[order[0]]) / np.sqrt(value))
        if (
            len(part) < 2
            or spread < TRADES
            or any(result.base.names[seen[part[0]]] == each.names[0] for each in found)
        ):
            continue
        listed = [result.base.names[seen[i]] for i in part]
        text = ", ".join(
            f"{name} {'up' if vector[i] * vector[part[0]] > 0 else 'down'}"
            for i, name in zip(part[:MOST_NAMED], listed, strict=False)
        )
        if len(part) > MOST_NAMED:
            text += f" and {len(part) - MOST_NAMED} more"
        found.append(Combination(tuple(listed), text, spread))
    return tuple(found)


def _advice(
    result: IdentificationResult, information: Array, weak: NDArray[np.int64]
) -> tuple[Advice, ...]:
    """Return the motions that would help the weak parameters, the gentlest first.

    Slow poses, then one joint at a time, then all at once.
    """
    independent = result.effective_samples / max(result.duration, 1e-9) * EXTRA_SECONDS
    before, ceiling = _errors(information, weak)
    ratios, texts = [], []
    for text, q, qd, qdd in _motions(result.model):
        extra = _information_of(result, q, qd, qdd) * (independent / len(q))
        after, _ = _errors(information + extra, weak, ceiling)
        ratios.append(after / before)
        texts.append(text)
    table = np.array(ratios)
    left = np.ones(weak.size, dtype=bool)
    found: list[Advice] = []
    for some in (slice(0, 1), slice(1, -1), slice(1, -1), slice(-1, None)):
        served = left & (table[some] < HELPS)
        best = int(np.argmax(served.sum(axis=1)))
        if not served[best].any():
            continue
        row = table[some][best]
        mean = float(np.exp(np.mean(np.log(np.maximum(row[served[best]], 1e-6)))))
        found.append(
            Advice(texts[some][best], tuple(result.base.names[j] for j in weak[served[best]]), mean)
        )
        left &= ~served[best]
    return tuple(found)


def _errors(
    information: Array, weak: NDArray[np.int64], scale: Array | None = None
) -> tuple[Array, Array]:
    """Return the standard errors of the weak parameters, and the scaling used.

    What nothing tells has an error as large as the scaling allows.
    """
    diagonal = np.diag(information)
    size = scale if scale is not None else 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    whitened = information * np.outer(size, size) + UNTOLD * np.eye(len(size))
    return np.sqrt(np.diag(np.linalg.inv(whitened)))[weak] * size[weak], size


def _information_of(result: IdentificationResult, q: Array, qd: Array, qdd: Array) -> Array:
    plan = RegressorPlan.of(result.model, result.base.drive, result.base.columns)
    total = np.zeros((result.n_base, result.n_base))
    sigma = np.maximum(result.sigma, 1e-9 * max(float(result.sigma.max()), 1e-300))
    for support, rows, noise in zip(plan.support, plan.evaluate(q, qd, qdd), sigma, strict=True):
        total[np.ix_(support, support)] += rows @ rows.T / noise**2
    return total


def _motions(model: RobotModel) -> Iterator[tuple[str, Array, Array, Array]]:
    """Yield kinds of motion as states drawn within the limits.

    What it is called, q, qd and qdd, each (DRAWS, n).
    """
    bounds = MotionBounds.assumed(model)
    rng = np.random.default_rng(0)
    n = model.n_joints
    q = rng.uniform(bounds.lower, bounds.upper, size=(DRAWS, n))
    speed, acceleration = (rng.uniform(-1.0, 1.0, size=(DRAWS, n)) for _ in range(2))
    still = np.zeros_like(q)
    slow = SLOW * speed * bounds.velocity
    yield "slow travel through poses all over the joint ranges", q, slow, still
    for k, name in enumerate(model.joint_names):
        alone = np.zeros(n)
        alone[k] = 1.0
        yield (
            f"steady travel of {name} from slow to its fastest, both ways",
            q,
            slow + alone * speed * bounds.velocity,
            still,
        )
        yield (
            f"accelerating {name} hard, the others in changing poses",
            q,
            slow + alone * speed * bounds.velocity,
            alone * acceleration * bounds.acceleration,
        )
    yield (
        "accelerating all joints hard, at once and all over their ranges",
        q,
        speed * bounds.velocity,
        acceleration * bounds.acceleration,
    )


def _listed(names: tuple[str, ...], most: int = 14) -> str:
    return (
        ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
    ) or "none"
