"""Which parameters a recording determines, how well, and which further motion would help.

The rank, and with it what is undetermined, comes with the result: `solve_factor` has decided it.
Here parameters are classed by their standard errors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import lapack

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.codec import make_plain
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.kinematics import draw_postures_within
from asbuilt.dynamics.reactions import Reactions
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.excitation.limits import MotionBounds
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.result.as_built_parameters import known_information
from asbuilt.identification.result.estimate_to_result import POOR_RELATIVE_ERROR
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.scaled import Scaled
from asbuilt.tables import format_share, round_significant

WELL = 0.10
"""Largest standard error of a parameter determined well, relative to estimate or CAD: a convention
of this program, which serves simulation. `POOR_RELATIVE_ERROR` says what is determined hardly."""
CORRELATED = 2.5
"""Smallest ratio of an error to its value with the other parameters known (the square root of
the variance inflation factor, 6; Belsley, Kuh and Welsch, 1980, warn from 5 to 10)."""
SHOWN = 3.0
"""Errors, with the other parameters known, from which a spring differs from none."""
NAMED = 0.35
"""Smallest coefficient, relative to the largest, of a parameter named in a combination."""
COMBINATIONS = 6
"""Most combinations."""
FURTHER_SECONDS = 20.0
"""Length of a further motion [s]."""
DRAWS = 160
"""States drawn of each kind of motion."""
HELPS = 0.5
"""Largest ratio of the errors after and before with which a motion is advised."""
ADDED = 1e-8
"""Information added in every direction, relative to a parameter's own, so errors are finite."""
SLOW = 0.05
"""Speed of a slow motion as a fraction of the velocity limit."""
MOST_NAMED = 5
MOST_LISTED = 14


@dataclass(frozen=True, slots=True)
class Combination:
    """Hold parameters that this recording determines only in combination.

    `text` names them, and `spread` is the error of the first relative to its error with the others
    known.
    """

    names: tuple[str, ...]
    text: str
    spread: float


@dataclass(frozen=True, slots=True)
class Advice:
    """Hold a further motion, the parameters it improves, and their mean ratio of errors."""

    motion: str
    names: tuple[str, ...]
    ratio: float


@dataclass(frozen=True, slots=True)
class Determination:
    """Hold which parameters a recording determines.

    | attribute | parameters |
    |---|---|
    | `well` | with a standard error of at most 10 % |
    | `fairly` | of at most 50 % |
    | `hardly` | of more than 50 % |
    | `negligible` | members of `hardly` whose error changes the torque of this motion little |
    | `not_at_all` | undetermined |
    | `dropped` | set to zero by the estimator, without an error |
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
        """One sentence for a summary."""
        classes = (self.well, self.fairly, self.hardly, self.not_at_all, self.dropped)
        little = f", {len(self.negligible)} of which change the torque of this motion little"
        worse = f"worse: {len(self.hardly)}{little if self.negligible else ''}"
        parts = [
            f"Standard error at most {100 * WELL:g} %: {len(self.well)} of"
            f" {sum(map(len, classes))} parameters",
            f"at most {100 * POOR_RELATIVE_ERROR:g} %: {len(self.fairly)} more",
            *([worse] if self.hardly else []),
            *([f"undetermined: {len(self.not_at_all)}"] if self.not_at_all else []),
            *([f"dropped: {len(self.dropped)}"] if self.dropped else []),
        ]
        return f"{'; '.join(parts)}."

    @property
    def sentences(self) -> tuple[str, ...]:
        """Classes, correlated parameters and advice, in sentences."""
        well = f"{100 * WELL:g} %"
        poor = f"{100 * POOR_RELATIVE_ERROR:g} %"
        classes = (
            (f"Standard error at most {well}", self.well, ""),
            (f"Standard error of {well} to {poor}", self.fairly, ""),
            (
                f"Standard error above {poor}",
                self.hardly,
                f" {len(self.negligible)} of these change the torque of this motion little."
                if self.negligible
                else "",
            ),
            ("Undetermined", self.not_at_all, ""),
            (
                "Dropped, set to zero after an F-test",
                self.dropped,
                " Errors of the others hold if these are zero.",
            ),
        )
        found = [
            f"{what} ({len(names)}): {join_names(names, MOST_LISTED)}.{remark}"
            for what, names, remark in classes
            if names
        ]
        found += [
            f"Correlated: {combination.text} hardly changes the torque of this recording. The error"
            f" of {combination.names[0]} is {round_significant(combination.spread, 2)} times its"
            " error with the others known."
            for combination in self.combinations
        ]
        found += [
            f"{FURTHER_SECONDS:g} s more of {tip.motion} would reduce the errors of"
            f" {join_names(tip.names, MOST_LISTED)} to about {format_share(tip.ratio, 0)}."
            for tip in self.advice
        ]
        return tuple(found)

    def as_dict(self) -> dict[str, Any]:
        """Return plain texts, numbers and lists, ready for JSON."""
        fields: dict[str, Any] = make_plain(self)
        return fields | {"in_short": self.in_short, "sentences": list(self.sentences)}


@use_one_blas_thread()
def determination(result: IdentificationResult, *, motions: bool = True) -> Determination:
    """Class the parameters of a result by how well its recordings determine them.

    Correlated parameters are the directions of largest variance, in parameters scaled to unit error
    with all others known (Belsley, Kuh and Welsch, Regression Diagnostics, 1980).

    Parameters
    ----------
    result
        The result.
    motions
        Find the further motion that helps: slow poses, steady fast motion or hard acceleration of
        each joint, or of all, within the limits, by the information that 20 s of it add. Of a robot
        whose base floats, a finding of its study has it (`weak_excitation`).

    Returns
    -------
    Determination
        Classes, correlated parameters and advice.
    """
    names = np.array(result.base.names)
    classes = _classify_parameters(result)
    determined = classes["well"] | classes["fairly"] | classes["hardly"]
    information = known_information(result)
    combinations = _find_combinations(result, information, determined)
    weak = weak_parameters(result)
    # Where equations mix joints none moves alone: `legs` has the motions of legs.
    advice = (
        _choose_advice(result, information, weak)
        if (motions and weak.size and not result.model.mixes_joints)
        else ()
    )
    members = {key: tuple(names[mask].tolist()) for key, mask in classes.items()}
    return Determination(**members, combinations=combinations, advice=advice)


def _classify_parameters(result: IdentificationResult) -> dict[str, Mask]:
    """Return which parameters are in each class of `Determination`."""
    size = np.fmax(np.abs(result.estimates), np.abs(np.nan_to_num(result.cad_values, nan=0.0)))
    dropped = result.dropped
    error = result.std_errors
    determined = np.array([parameter.determined for parameter in result.parameters]) & ~dropped
    well = determined & (error <= WELL * size)
    hardly = determined & (error > POOR_RELATIVE_ERROR * size)
    return {
        "well": well,
        "fairly": determined & ~well & ~hardly,
        "hardly": hardly,
        "negligible": hardly
        & ~np.array([parameter.poorly_determined for parameter in result.parameters]),
        "not_at_all": ~determined & ~dropped,
        "dropped": dropped,
    }


def report_springs(result: IdentificationResult) -> tuple[Finding, ...]:
    """Report springs, with the masses that look the same in all motions of this recording."""
    base = result.base
    names = result.model.joint_names
    springs = {
        f"{symbol}{k + 1}": names[k]
        for k in range(result.model.n_joints)
        for term in base.drive.terms
        for symbol in term.symbols
        if term.by_construction and term.by_position and term.is_at(k)
    }
    masses = np.flatnonzero((base.columns < 10 * result.model.n_links) & (result.std_errors > 0))
    found = [
        (parameter.name, join_names([base.names[j] for j in instead]))
        for k, parameter in enumerate(result.parameters)
        if parameter.name in springs and parameter.std_error > WELL * abs(parameter.estimate)
        if (instead := _find_replacements(result, k, masses)).size
    ]
    return tuple(
        Finding(
            "spring_or_mass",
            "info",
            f"This recording determines {spring}, a spring, together with {bodies} only: one takes"
            " the place of the other",
            Cure(
                "move the joint over more of its range, with other joints in other poses, or state"
                " the stiffness of the spring"
            ),
            joint=springs[spring],
        )
        for spring, bodies in found
    )


def _find_replacements(result: IdentificationResult, k: int, others: Indices) -> Indices:
    """Return which of the other parameters take the place of parameter k, the closest first.

    None do if its error with the others known is not much smaller, or too large to tell it from 0.
    """
    error = result.std_errors
    if not (error[k] > 0.0 and others.size):
        return others[:0]
    own = result.covariance[others, k] / error[k]
    explained = Scaled(result.covariance[np.ix_(others, others)]).square(own)
    own = own / error[others]
    left = float(np.sqrt(max(1.0 - explained, 0.0)))
    alone = abs(result.estimates[k]) > SHOWN * left * error[k]
    if left > 1.0 / CORRELATED or not alone:
        return others[:0]
    order = np.argsort(-np.abs(own), kind="stable")
    close = np.abs(own[order]) >= (1.0 - NAMED) * np.abs(own).max()
    return np.asarray(others[order[close][:MOST_NAMED]])


def _find_combinations(
    result: IdentificationResult, information: Array, determined: Mask
) -> tuple[Combination, ...]:
    """Return directions of large variance with unit diagonal information, the largest first."""
    seen = np.flatnonzero(determined & (np.diag(information) > 0))
    scale = 1.0 / np.sqrt(np.diag(information)[seen])
    eigenvalues, vectors = np.linalg.eigh(information[np.ix_(seen, seen)] * np.outer(scale, scale))
    found: list[Combination] = []
    for value, vector in zip(eigenvalues, vectors.T, strict=True):
        if value > 1.0 / CORRELATED**2 or len(found) == COMBINATIONS:
            break
        if value <= 0:
            continue
        order = np.argsort(-np.abs(vector), kind="stable")
        part = [int(i) for i in order if abs(vector[i]) >= NAMED * abs(vector[order[0]])]
        spread = float(abs(vector[order[0]]) / np.sqrt(value))
        if (
            len(part) < 2
            or spread < CORRELATED
            or any(result.base.names[seen[part[0]]] == each.names[0] for each in found)
        ):
            continue
        listed = [result.base.names[seen[i]] for i in part]
        moves = [
            f"{name} {'up' if vector[i] * vector[part[0]] > 0 else 'down'}"
            for i, name in zip(part, listed, strict=True)
        ]
        found.append(Combination(tuple(listed), join_names(moves, MOST_NAMED), spread))
    return tuple(found)


def weak_parameters(result: IdentificationResult) -> Indices:
    """Return the base parameters with an error above 10 % that matters, or undetermined."""
    classes = _classify_parameters(result)
    return np.flatnonzero(~(classes["well"] | classes["negligible"] | classes["dropped"]))


def error_ratios(
    result: IdentificationResult, information: Array, weak: Indices, extras: Iterable[Array]
) -> Array:
    """Return the errors of weak parameters after further motions over those before, a row each.

    `extras` are mean information matrices (p, p) of a sample of each motion, of which 20 s are as
    independent as those recorded.
    """
    independent = result.effective_samples / max(result.duration, 1e-9) * FURTHER_SECONDS
    before, ceiling = _predict_errors(information, weak)
    return np.array(
        [
            _predict_errors(information + independent * extra, weak, ceiling)[0] / before
            for extra in extras
        ]
    )


def _choose_advice(
    result: IdentificationResult, information: Array, weak: Indices
) -> tuple[Advice, ...]:
    """Return the motions that help the weak parameters: slow poses, one joint at a time, all."""
    texts, *states = zip(*_draw_motions(result.model), strict=True)
    extras = map(partial(sample_information, result), *states)
    table = error_ratios(result, information, weak, extras)
    some = (slice(0, 1), slice(1, -1), slice(1, -1), slice(-1, None))
    return best_motions(result, weak, table, texts, some)


def best_motions(
    result: IdentificationResult,
    weak: Indices,
    table: Array,
    texts: Sequence[str],
    choices: Sequence[slice],
    nearly: float = 1.0,
) -> tuple[Advice, ...]:
    """Return the motion of each choice that helps most of the parameters that are left.

    `table` holds their ratios of errors, a row for each motion of `texts`. The first one is taken
    that helps `nearly` as many as the best.
    """
    left = np.ones(weak.size, dtype=bool)
    found: list[Advice] = []
    for some in choices:
        served = left & (table[some] < HELPS)
        helped = served.sum(axis=1)
        best = int(np.argmax(helped >= nearly * helped.max()))
        if not served[best].any():
            continue
        ratios = np.maximum(table[some][best][served[best]], 1e-6)
        names = tuple(result.base.names[j] for j in weak[served[best]])
        found.append(Advice(texts[some][best], names, float(np.exp(np.mean(np.log(ratios))))))
        left &= ~served[best]
    return tuple(found)


def _predict_errors(
    information: Array, weak: Indices, scale: Array | None = None
) -> tuple[Array, Array]:
    """Return the standard errors of the weak parameters, and the scaling used."""
    diagonal = np.diag(information)
    size = scale if scale is not None else 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    whitened = information * np.outer(size, size)
    whitened[np.diag_indices_from(whitened)] += ADDED
    root, failed = lapack.dpotrf(whitened)
    # Rounding of a motion that shows others much better may exceed what is added.
    if failed:
        return np.sqrt(np.diag(np.linalg.inv(whitened)))[weak] * size[weak], size
    # The inverse of R^T R has the squared rows of R^-1 on its diagonal, in a third of the time.
    inverse, _ = lapack.dtrtri(root)
    return np.linalg.norm(inverse[weak], axis=1) * size[weak], size


def sample_information(
    result: IdentificationResult,
    q: Array,
    qd: Array,
    qdd: Array,
    reactions: Reactions = Reactions(),  # noqa: B008 - frozen
) -> Array:
    """Return the mean information (p, p) of states (N, n), less what reactions explain."""
    plan = RegressorPlan.of(result.model, result.base.drive, result.base.columns)
    buffer = plan.buffer(len(q))
    rows = plan.evaluate(q, qd, qdd, buffer)
    reactions.project_rows(result.model, q, rows, buffer)
    total = np.zeros((result.n_base, result.n_base))
    largest = float(result.sigma[np.isfinite(result.sigma)].max(initial=0.0))
    sigma = np.maximum(result.sigma, 1e-9 * max(largest, 1e-300))
    for support, own, sd in zip(plan.support, rows, sigma, strict=True):
        # Columns first, then whole rows: places by pairs would take five times as long.
        wide = np.zeros((len(support), result.n_base))
        wide[:, support] = own @ own.T / sd**2
        total[support] += wide
    return total / len(q)


def _draw_motions(model: RobotModel) -> Iterator[tuple[str, Array, Array, Array]]:
    """Yield kinds of motion: name, and states q, qd and qdd (draws, n) within the limits."""
    bounds = MotionBounds.assumed(model)
    rng = np.random.default_rng(0)
    n = model.n_joints
    q = draw_postures_within(model, bounds.lower, bounds.upper, rng, DRAWS)
    speed, acceleration = (rng.uniform(-1.0, 1.0, size=(DRAWS, n)) for _ in range(2))
    still = np.zeros_like(q)
    slow = SLOW * speed * bounds.velocity
    yield "slow motion through poses all over the joint ranges", q, slow, still
    for name, alone in zip(model.joint_names, np.eye(n), strict=True):
        yield (
            f"steady motion of {name} at all speeds, both ways",
            q,
            slow + alone * speed * bounds.velocity,
            still,
        )
        yield (
            f"hard acceleration of {name} with the others in changing poses",
            q,
            slow + alone * speed * bounds.velocity,
            alone * acceleration * bounds.acceleration,
        )
    yield (
        "hard acceleration of all joints at once, all over their ranges",
        q,
        speed * bounds.velocity,
        acceleration * bounds.acceleration,
    )
