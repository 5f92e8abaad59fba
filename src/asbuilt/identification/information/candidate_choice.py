"""The choice among estimates by their error on other motions, the closest to CAD first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import stdtrit

from asbuilt.arrays import Array
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import triangular_factor
from asbuilt.identification.statistics import exceeds

SMALLEST_INFORMATION = 1e-11
"""Scaled information, relative to the largest, below which least squares determine nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Describe an estimate: its name, and the fits without each group of blocks, (n_folds, p).

    `weight` is the weight of CAD in its covariance; 0: least squares. `certain` says that the
    values agree with what is certain, such as that masses are positive.
    """

    name: str
    weight: float
    betas: Array
    certain: bool = True


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
    novelty
        Leverage of held-out motions on the others, over the leverage of motion used: 1 if alike.
    reach
        Leverage of random motion within the joint limits over the leverage of held-out motions.
    """

    candidates: tuple[Candidate, ...]
    chosen: int
    best: int
    errors: Array
    extrapolation: Array
    novelty: float
    reach: float

    @property
    def totals(self) -> Array:
        """Error on other motions, (n_candidates, n_folds)."""
        return np.asarray(self.errors + self.extrapolation[:, None])

    def sentence(self, candidate: int) -> str:
        """Return the error of a candidate as text, and what is expected beyond it, if anything."""
        held, beyond = self.errors[candidate].mean(), self.extrapolation[candidate]
        more = f" + {beyond:.2g}" if beyond > 0.0 else ""
        return f"{self.candidates[candidate].name} {held:.3g}{more}"

    @property
    def motion_note(self) -> str:
        """How different the held-out motions are, as text."""
        return (
            f"Errors of parameters count {self.novelty:.2g} times as much in the"
            f" {self.errors.shape[1]} groups of motion held out as in the motion used, and"
            f" {self.reach:.2g} times as much again in random motion within the joint limits"
        )


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
                for beta, (_, held) in zip(each.betas, parts, strict=True)
            ]
            for each in candidates
        ]
    )
    root = information.stacked(joint_weights)[:-1, :-1]
    random_rows = triangular_factor(random_motion) / np.sqrt(len(random_motion))
    random_rows, whole = _project_determined(random_rows, root), root.T @ root
    roots = [training.stacked(joint_weights)[:-1, :-1] for training, _ in parts]
    used = [each.T @ each for each in roots]
    held_rows = [
        held.stacked(joint_weights)[:-1, :-1] / np.sqrt(held.n_samples * n) for _, held in parts
    ]
    own = root / np.sqrt(information.n_samples * n)
    beyond = np.empty(len(candidates))
    novelty, reach = 1.0, 1.0
    for c, each in enumerate(candidates):
        weighted = each.weight * prior_information
        on_groups = np.array(
            [
                _evaluate_leverage(rows, gram, weighted)
                for rows, gram in zip(held_rows, used, strict=True)
            ]
        )
        on_random = _evaluate_leverage(random_rows, whole, weighted)
        beyond[c] = extrapolation_variance * max(on_random - float(on_groups.mean()), 0.0)
        mean = max(float(on_groups.mean()), np.finfo(np.float64).tiny)
        novelty = mean / max(_evaluate_leverage(own, whole, weighted), np.finfo(np.float64).tiny)
        reach = on_random / mean
    totals = errors + beyond[:, None]
    consistent = [c for c, each in enumerate(candidates) if each.certain]
    best = consistent[int(np.argmin(totals[consistent].mean(axis=1)))] if consistent else 0
    # Probability by which physically inconsistent values that predict no better are chosen.
    surely = float(stdtrit(max(len(parts) - 1, 1), 1.0 - 0.05))
    for c in range(len(candidates)):
        if c not in consistent and exceeds(totals[best] - totals[c], surely):
            best = c
    chosen = next(
        c
        for c in range(len(candidates))
        if c == best or (c in consistent and not exceeds(totals[c] - totals[best], 1.0))
    )
    return MotionChoice(tuple(candidates), chosen, best, errors, beyond, novelty, reach)


def _project_determined(rows: Array, root: Array) -> Array:
    """Return rows without what they have in directions that no block excites."""
    length = np.linalg.norm(root, axis=0)
    scale = np.where(length > 0.0, length, 1.0)
    _, s, vt = np.linalg.svd(root / scale)
    kept = vt[s**2 > SMALLEST_INFORMATION * s[0] ** 2]
    return np.asarray(((rows / scale) @ kept.T) @ kept * scale)


def _evaluate_leverage(rows: Array, gram: Array, prior: Array) -> float:
    """Return the trace of `rows (gram + prior)^-1 rows^T`."""
    gram = gram + prior
    size = np.sqrt(np.diag(gram))
    size[size == 0.0] = 1.0
    scaled, seen = gram / np.outer(size, size), rows / size
    if np.any(prior):
        return float(np.sum(seen.T * cho_solve(cho_factor(scaled), seen.T)))
    values, axes = np.linalg.eigh(scaled)
    kept = values > SMALLEST_INFORMATION * values[-1]
    return float(np.sum((seen @ axes[:, kept]) ** 2 / values[kept]))
