"""Fits validated on time blocks held out in turn, and choices by their errors there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import stdtrit

from asbuilt.arrays import Array, Indices
from asbuilt.identification.bodies.entropic_path import DESCENT
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import join_factors, stack_factors
from asbuilt.scaled import Scaled
from asbuilt.statistics import exceeds

Fits = Callable[[Array, float], Array]
"""Fits `(factors (m, p + 1, p + 1), weight) -> chi (m, n_standard)`, by descending weight."""

FEWEST_GROUPS = 3
"""Groups below which `DEFAULT_WEIGHT` is taken."""
DEFAULT_WEIGHT = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class WeightChoice:
    """Hold a weight, and the mean squared errors on held-out groups (n_weights, n_groups)."""

    weight: float
    errors: Array
    reason: str


def choose_weight(
    information: SquareRootInformation,
    joint_weights: Array,
    regrouping: Array,
    fits: Fits,
    weights: tuple[float, ...] = DESCENT,
) -> WeightChoice:
    """Return the largest weight whose held-out error is within one standard error of the least.

    The blocks form up to 8 groups of neighbours; each is predicted from the others with every
    weight. The error of a group is `|w (tau - W beta)|^2 / (N n)`; the standard error is of
    the mean difference from the best weight, group by group (the one-standard-error rule of
    Breiman, Friedman, Olshen & Stone, 1984, section 3.4.3, on paired errors; Hastie, Tibshirani &
    Friedman, 2009, section 7.10).
    """
    # Groups of neighbouring blocks that are held out.
    n_groups = min(8, information.n_blocks)
    if n_groups < FEWEST_GROUPS:
        return WeightChoice(
            DEFAULT_WEIGHT,
            np.zeros((1, 0)),
            f"weight of CAD {DEFAULT_WEIGHT:g}, the default: {information.n_blocks} time blocks are"
            f" too few to choose it, {FEWEST_GROUPS} are needed",
        )
    groups = np.array_split(np.arange(information.n_blocks), n_groups)
    held = np.array([information.select(group).stacked(joint_weights) for group in groups])
    factors = _without_each(held)
    errors = np.empty((len(weights), n_groups))
    counts = [sum(information.blocks[b].n_samples for b in group) for group in groups]
    for row, weight in enumerate(weights):
        beta = fits(factors, weight) @ regrouping.T
        residuals = (held[:, :, :-1] @ beta[:, :, None])[:, :, 0] - held[:, :, -1]
        errors[row] = np.sum(residuals**2, axis=1) / (np.array(counts) * information.n_joints)
    means = errors.mean(axis=1)
    best = int(np.argmin(means))
    # Paired with the best group by group: hard groups are hard for every weight.
    excess = errors - errors[best]
    standard_error = excess.std(axis=1, ddof=1) / np.sqrt(n_groups)
    # Weights descend, so that the first one within a standard error is the largest.
    chosen = int(np.flatnonzero(excess.mean(axis=1) <= standard_error)[0])
    if chosen == best:
        why = f"the least error, {means[best]:.3g}, on {n_groups} groups of held-out time blocks"
    else:
        why = (
            f"the largest of {len(weights)} whose error on {n_groups} groups of held-out time"
            f" blocks, {means[chosen]:.3g}, is within one standard error"
            f" ({standard_error[chosen]:.2g}) of the least, {means[best]:.3g} at {weights[best]:g}"
        )
    return WeightChoice(weights[chosen], errors, f"weight of CAD {weights[chosen]:g}: {why}")


def _without_each(factors: Array) -> Array:
    """Return the triangular factors of all but each, (m, p + 1, p + 1)."""
    # Of prefixes and suffixes each factor without one group is a single join: 3 m instead of m^2.
    before = [*accumulate(factors[:-1], join_factors)]
    after = [*accumulate(factors[:0:-1], join_factors)][::-1]
    between = [join_factors(one, other) for one, other in zip(before[:-1], after[1:], strict=True)]
    return np.array([after[0], *between, before[-1]])


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Describe an estimate: its name, and the fits without each group of blocks, (n_folds, p).

    `weight` is the weight of CAD in its covariance; 0: least squares. `certain` says that the
    values agree with what is certain, such as that masses are positive. `fit` fits all blocks, and
    `beta` (p,) is what it gives, roughly; empty: unknown. Fits to other samples have a candidate
    of the same `kind`.
    """

    name: str
    weight: float
    betas: Array
    certain: bool = True
    fit: Callable[[], Estimate] | None = None
    kind: str = ""
    beta: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class MotionChoice:
    """Hold which candidate was chosen and the errors behind it.

    Parameters
    ----------
    candidates
        The candidates, the closest to CAD first.
    chosen, best
        The candidate chosen, and the candidate of the least error on other motions.
    errors
        Squared torque error in noise variances on each held-out group, (n_candidates, n_folds).
    extrapolation
        Error expected on random motion beyond the error on the groups, (n_candidates,).
    note
        How different the held-out motions are, as text.
    """

    candidates: tuple[Candidate, ...]
    chosen: int
    best: int
    errors: Array
    extrapolation: Array
    note: str

    @property
    def rivals(self) -> dict[str, Array]:
        """Parameters of the candidates that were not chosen, by kind, if consistent."""
        return {
            candidate.kind: candidate.beta
            for c, candidate in enumerate(self.candidates)
            if c != self.chosen and candidate.certain and candidate.beta.size
        }

    def of_kind(self, kind: str) -> MotionChoice:
        """Return the choice among the candidates of a kind; among all for a kind of none."""
        totals = self.errors + self.extrapolation[:, None]
        chosen, best = _choose_among(self.candidates, totals, kind)
        return replace(self, chosen=chosen, best=best)

    def sentence(self, candidate: int) -> str:
        """Return the error of a candidate as text, and what is expected beyond it, if anything."""
        held = self.errors[candidate].mean()
        beyond = self.extrapolation[candidate]
        more = f" + {beyond:.2g}" if beyond > 0.0 else ""
        return f"{self.candidates[candidate].name} {held:.3g}{more}"


def choose_candidate(
    candidates: Sequence[Candidate],
    parts: Sequence[tuple[SquareRootInformation, SquareRootInformation]],
    information: SquareRootInformation,
    joint_weights: Array,
    prior_information: Array,
    random_motion: Array,
    extrapolation_variance: float,
) -> MotionChoice:
    """Choose the first candidate that predicts other motions as well as the best.

    The error of a candidate is its squared torque error on groups of different motion, held out
    in turn, plus `extrapolation_variance * max(h_random - h_groups, 0)`, what the groups cannot
    show. h is the mean leverage of torques, the trace of `W (A + weight P)^-1 W^T` over their
    number: A the information of the rows fitted, P the `prior_information` of CAD (p, p). As well
    means within one standard error of the paired differences (Breiman, Friedman, Olshen & Stone,
    1984, section 3.4.3). Values that contradict what is certain must be better beyond chance, by
    Student's test of the paired differences: of few groups one standard error is little.

    Parameters
    ----------
    candidates
        The closest to CAD first.
    parts
        Blocks to train on and blocks held out, group by group.
    information, joint_weights
        All blocks, and the weights of the joints (n,).
    prior_information
        Information of CAD on the base parameters (p, p).
    random_motion
        Rows of random motion within the joint limits (m, p), weighted.
    extrapolation_variance
        Residual variance times the design effect, in units of the weighted residual.
    """
    n = information.n_joints
    errors = np.array(
        [
            [
                float(np.sum(held.residual_energy(beta) * joint_weights**2)) / (held.n_samples * n)
                for beta, (_, held) in zip(candidate.betas, parts, strict=True)
            ]
            for candidate in candidates
        ]
    )
    root = information.stacked(joint_weights)[:-1, :-1]
    # Only rows^T rows count: a triangle has the same, and p rows.
    random_rows = _reduce_motion(random_motion, information.support) / np.sqrt(len(random_motion))
    random_rows = _project_determined(random_rows, root)
    whole = root.T @ root
    roots = [training.stacked(joint_weights)[:-1, :-1] for training, _ in parts]
    used = [factor.T @ factor for factor in roots]
    held_rows = [
        held.stacked(joint_weights)[:-1, :-1] / np.sqrt(held.n_samples * n) for _, held in parts
    ]
    priors = [candidate.weight * prior_information for candidate in candidates]
    on_groups = np.array(
        [
            [
                _evaluate_leverage(rows, gram, prior)
                for rows, gram in zip(held_rows, used, strict=True)
            ]
            for prior in priors
        ]
    ).mean(axis=1)
    on_random = np.array([_evaluate_leverage(random_rows, whole, prior) for prior in priors])
    beyond = extrapolation_variance * np.maximum(on_random - on_groups, 0.0)
    # Motions are compared by the last candidate, least squares, on which CAD has no influence.
    own = _evaluate_leverage(root / np.sqrt(information.n_samples * n), whole, priors[-1])
    held_out = max(float(on_groups[-1]), np.finfo(np.float64).tiny)
    chosen, best = _choose_among(candidates, errors + beyond[:, None])
    return MotionChoice(
        tuple(candidates),
        chosen,
        best,
        errors,
        beyond,
        "Errors of parameters count"
        f" {held_out / max(own, np.finfo(np.float64).tiny):.2g} times as much in the"
        f" {len(parts)} groups of motion held out as in the motion used, and"
        f" {float(on_random[-1]) / held_out:.2g} times as much again in random motion within the"
        " joint limits",
    )


def _reduce_motion(rows: Array, support: Sequence[Indices]) -> Array:
    """Return the triangular factor (p, p) of sample-major rows (m, p) of joints with this support.

    Rows of a joint go into it in its own columns.
    """
    parts = []
    for k, own in enumerate(support):
        of_joint = rows[k :: len(support), own]
        parts.append((own, np.column_stack([of_joint, np.zeros(len(of_joint))])))
    return stack_factors(parts, rows.shape[1])[:-1, :-1]


def _choose_among(
    candidates: Sequence[Candidate], totals: Array, kind: str = ""
) -> tuple[int, int]:
    """Return the candidate chosen by errors on groups (n_candidates, n_folds), and the best."""
    open_to = [c for c, candidate in enumerate(candidates) if kind in ("", candidate.kind)]
    open_to = open_to or list(range(len(candidates)))
    consistent = [c for c in open_to if candidates[c].certain]
    # Without consistent candidates the first one, closest to CAD, is what is compared.
    best = open_to[0]
    if consistent:
        best = consistent[int(np.argmin(totals[consistent].mean(axis=1)))]
    surely = _surely_better(totals.shape[1])
    for c in open_to:
        if c not in consistent and exceeds(totals[best] - totals[c], surely):
            best = c
    # In order from CAD: the first as good as the best ends the search.
    chosen = next(
        c
        for c in open_to
        if c == best or (c in consistent and not exceeds(totals[c] - totals[best], 1.0))
    )
    return chosen, best


def _surely_better(n: int) -> float:
    """Return how many standard errors of n paired differences inconsistent values need.

    Student's quantile of 5 %: of few differences one standard error is little.
    """
    return float(stdtrit(max(n - 1, 1), 1.0 - 0.05))


def _project_determined(rows: Array, root: Array) -> Array:
    # Without units, in which the axes are orthonormal and the projection means something.
    """Return rows without what they have in directions that no block excites."""
    seen = Scaled(root.T @ root)
    return np.asarray(((rows / seen.size) @ seen.axes) @ seen.axes.T * seen.size)


def _evaluate_leverage(rows: Array, gram: Array, prior: Array) -> float:
    """Return the trace of `rows (gram + prior)^-1 rows^T`."""
    total = Scaled(gram + prior)
    if np.any(prior):
        # With a prior the matrix is positive definite; else only what is determined has a leverage.
        scaled = total.matrix / np.outer(total.size, total.size)
        seen = rows / total.size
        return float(np.sum(seen.T * cho_solve(cho_factor(scaled), seen.T)))
    return float(np.sum(total.whiten(rows.T) ** 2))


MOST_FOLDS = 8
MOST_SORTED = 500
"""Blocks whose distances are compared; of more, the others join the nearest group."""
DIFFERENT_MOTIONS = 6
"""Groups of different motion that are held out; each is then about a sixth of a recording."""


def group_neighbours(n_blocks: int) -> list[Indices]:
    """Return the blocks in groups of neighbours, so that lasting residuals do not leak."""
    count = min(MOST_FOLDS, n_blocks)
    # Parts that differ by one block at most.
    number = np.arange(n_blocks) * count // max(n_blocks, 1)
    return [np.flatnonzero(number == group) for group in range(count)]


def group_different_motions(
    information: SquareRootInformation, weights: Array, most: int = DIFFERENT_MOTIONS
) -> list[Indices]:
    """Return the blocks in groups of like motion, so that no twin of a held-out block is left.

    Blocks are alike if their information per sample is, in parameters scaled to equal torque
    (Ward's linkage; Ward, J. American Statistical Association 58, 1963).
    """
    known = most, weights.tobytes()
    if known not in information.motion_groups:
        roots = (information.rows_of_block(b, weights)[:, :-1] for b in range(information.n_blocks))
        information.motion_groups[known] = group_motions(
            np.array([root.T @ root for root in roots]),
            np.array([block.n_samples for block in information.blocks]),
            most,
        )
    return information.motion_groups[known]


def group_motions(grams: Array, n_samples: Array, most: int = DIFFERENT_MOTIONS) -> list[Indices]:
    """Return blocks of information (B, p, p) and so many samples (B,) in groups of like motion."""
    if len(grams) <= 2:
        return group_neighbours(len(grams))
    from scipy.cluster.hierarchy import fcluster, linkage  # noqa: PLC0415 - light start

    length = np.sqrt(np.diag(grams.sum(axis=0)))
    # Equal torque per parameter: a distance between informations then has no units.
    scale = np.where(length > 0.0, length, 1.0) / np.sqrt(n_samples.sum())
    # A column that is never excited has no length, and stays zero.
    scaled = grams / np.outer(scale, scale)
    features = scaled[:, *np.triu_indices(len(scale))] / n_samples[:, None]
    # Ward's linkage takes the square of the blocks in memory.
    every = -(-len(grams) // MOST_SORTED)
    group = fcluster(linkage(features[::every], "ward"), most, "maxclust")
    if every > 1:
        from scipy.spatial.distance import cdist  # noqa: PLC0415 - light start

        means = np.array([features[::every][group == k].mean(axis=0) for k in np.unique(group)])
        group = np.argmin(cdist(features, means), axis=1)
    return [np.flatnonzero(group == each) for each in np.unique(group)]


def divide_into_folds(
    information: SquareRootInformation, groups: Sequence[Indices] | None = None
) -> Iterator[tuple[SquareRootInformation, SquareRootInformation]]:
    """Yield the blocks to train on and those held out, group by group; nothing for one group."""
    every = np.arange(information.n_blocks)
    groups = group_neighbours(information.n_blocks) if groups is None else groups
    # Nothing is left to train on without another group.
    for group in groups if len(groups) > 1 else ():
        yield information.select(np.setdiff1d(every, group)), information.select(group)


def measure_held_out_errors(
    information: SquareRootInformation,
    fit: Callable[[SquareRootInformation], Array],
    groups: Sequence[Indices] | None = None,
) -> tuple[Array, Array]:
    """Return squared torque errors (n_folds, n) on held-out groups, and each beta (n_folds, p)."""
    betas = []
    errors = []
    for training, held in divide_into_folds(information, groups):
        betas.append(fit(training))
        errors.append(held.residual_energy(betas[-1]) / held.n_samples)
    return np.array(errors), np.array(betas)
