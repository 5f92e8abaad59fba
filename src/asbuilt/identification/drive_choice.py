"""Which drive terms a recording supports, judged by time blocks held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base_parameters import find_base_parameters
from asbuilt.dynamics.blas import one_blas_thread
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.identification.drive_shapes import fit_shapes
from asbuilt.identification.identify import LARGE_CONDITION
from asbuilt.identification.least_squares import fit_least_squares, solve_factor
from asbuilt.identification.square_root_information import SquareRootInformation, accumulate_stream
from asbuilt.identification.torque_prediction import carrying
from asbuilt.identification.triangular import triangular_factor

if TYPE_CHECKING:
    from asbuilt.experiment.samples import Samples

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CANDIDATES = ("smooth_coulomb", "stribeck", "power", "cubic", "asymmetric_viscous", "load_friction", "spring", "balancer", "armature")
"""Terms that are tried beside the defaults."""
STANDS_FOR = {"smooth_coulomb": "coulomb", "asymmetric_viscous": "viscous", "asymmetric_coulomb": "coulomb"}
"""Terms that take the place of a simpler one."""
FOLDS = 8
FEWEST_BLOCKS = 4
"""With fewer time blocks nothing can be held out and the defaults stay."""
WORTH = 0.005
"""A term is worth taking where it lowers the held-out error by this fraction, as a geometric mean over joints."""
CERTAIN = 2.0
"""and by this many standard errors from fold to fold."""
HELPED = 0.02
"""A joint whose held-out error a term lowers by this fraction keeps it, where it does not help all."""
MOST_ADDED = 5


@dataclass(frozen=True, slots=True, eq=False)
class DriveTrial:
    """Hold a set of drive terms and what it makes of blocks held out: RMS error per joint (n,) and, as `error`, its geometric mean.

    `bic` is the Bayesian information criterion on all blocks, less that of the defaults. `gain` is the fraction by which the error fell against the set it
    was tried against, `gain_error` its standard error from fold to fold.
    """

    drive: DriveSet
    n_parameters: int
    rms: Array
    error: float
    bic: float
    gain: float
    gain_error: float


@dataclass(frozen=True, slots=True, eq=False)
class DriveChoice:
    """The drive terms chosen, with shapes stated, among `trials`; `sentences` say why, `warnings` what speaks against them."""

    drive: DriveSet
    trials: tuple[DriveTrial, ...] = ()
    sentences: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def settle_drive(model: RobotModel, samples: Sequence[Samples], drive: DriveSet | Literal["auto"] | None = None) -> DriveChoice:
    """Return the drive terms to identify with: by torque source where `drive` is None, chosen where it is "auto", else as given with its shapes fitted.

    Fitted shapes are judged on held-out blocks against the set without them, and stay whatever comes of it; a warning says where they are worse.
    """
    source = samples[0].torque_source
    if drive is None:
        return DriveChoice(DriveSet.default(source))
    if isinstance(drive, str):
        return choose_drive(model, samples)
    if drive.is_shaped:
        return DriveChoice(drive)
    shaped = [term.key for term in drive.terms if term.free_shapes]
    plain = drive.without(*shaped)
    for key in shaped:
        simple = STANDS_FOR.get(key)
        if simple is not None and simple not in plain.keys:
            plain = plain.with_term(available_terms()[simple])
    found = fit_shapes(model, drive, samples)
    pair = [accumulate_stream(model, find_base_parameters(model, each), samples) for each in (plain, found.drive)]
    if pair[0].n_blocks < FEWEST_BLOCKS:
        return DriveChoice(found.drive, (), found.sentences(model.joint_names))
    before, after = (BlockJudge(model, information).trial(information.base.drive) for information in pair)
    change = f"torque error on held-out blocks {100 * (after.error / before.error - 1):+.1f} % against {_named(plain)}"
    warnings = (
        () if after.error <= before.error else (f"Fitted {', '.join(shaped)} do not pay: {change}. Leave them out, or state their shapes.",)
    )
    return DriveChoice(found.drive, (before, after), (*found.sentences(model.joint_names), change), warnings)


def choose_drive(model: RobotModel, samples: Sequence[Samples], *, default: DriveSet | None = None) -> DriveChoice:
    """Choose drive terms by the error on held-out time blocks, starting from those that the torque source calls for.

    One pass gives the square-root information of all candidates together, shapes fitted to the same samples beforehand; then the term that lowers
    the held-out error most, as a geometric mean over joints, is added while it is worth it: by two standard errors from fold to fold, and where BIC agrees.
    A term goes to all joints or to those alone that it helps. The blocks of a fold are neighbours, so that residuals which last do not leak. Where the motion
    hardly tells the defaults apart (scaled condition number above 200) they stay.
    """
    start = default if default is not None else DriveSet.default(samples[0].torque_source)
    plain = accumulate_stream(model, find_base_parameters(model, start), samples)
    if plain.n_blocks < FEWEST_BLOCKS:
        said = f"drive terms {start}: {plain.n_blocks} time blocks are too few to choose among more by holding some out"
        return DriveChoice(start, (), (said,))
    fitted = fit_least_squares(plain, weights="joint", prior=np.zeros(plain.base.n_base))
    condition = fitted.solution.scaled_condition_number
    if not condition <= LARGE_CONDITION:
        said = (
            f"drive terms {start}: the motion hardly tells these apart (scaled condition number {condition:.3g}, above {LARGE_CONDITION:g}), so richer "
            "sets were not tried; record a richer motion"
        )
        return DriveChoice(start, (), (said,))
    loaded = carrying(model, plain.base, fitted.beta)
    wide = start
    for key in CANDIDATES:
        if key not in start.keys:
            term = available_terms()[key]
            if term.free_shapes:
                term = next(t for t in fit_shapes(loaded, start.with_term(term), samples).drive.terms if t.key == key)
            wide = wide.with_term(term)
    information = accumulate_stream(loaded, find_base_parameters(model, wide), samples)
    judge = BlockJudge(model, information)
    trials = [judge.trial(start)]
    chosen = start
    for _ in range(MOST_ADDED):
        tried = [
            trial for key in CANDIDATES if key not in chosen.keys and key in wide.keys for trial in _tried(judge, model, chosen, wide, key)
        ]
        if not tried:
            break
        trials += tried
        worthy = [trial for trial in tried if trial.gain > CERTAIN * trial.gain_error] or tried
        best = min(worthy, key=lambda trial: trial.error)
        previous = judge.trial(chosen)
        if best.gain < max(WORTH, CERTAIN * best.gain_error) or best.bic >= previous.bic:
            break
        chosen = best.drive
    return _concluded(model, samples, start, chosen, trials, judge, loaded)


def _tried(judge: BlockJudge, model: RobotModel, chosen: DriveSet, wide: DriveSet, key: str) -> list[DriveTrial]:
    """Try a term at all joints, then at those alone whose held-out error it lowered."""
    every = judge.trial(_with(model, chosen, wide, key, None), against=chosen)
    helped = np.flatnonzero(every.rms < (1.0 - HELPED) * judge.trial(chosen).rms)
    if helped.size in (0, model.n_joints):
        return [every]
    some = tuple(int(k) + 1 for k in helped)
    return [every, judge.trial(_with(model, chosen, wide, key, some), against=chosen)]


def _with(model: RobotModel, chosen: DriveSet, wide: DriveSet, key: str, joints: tuple[int, ...] | None) -> DriveSet:
    term = next(term for term in wide.terms if term.key == key)
    simple = next((term for term in chosen.terms if term.key == STANDS_FOR.get(key)), None)
    if simple is not None:
        left = tuple(k + 1 for k in range(model.n_joints) if simple.is_at(k) and joints is not None and k + 1 not in joints)
        chosen = chosen.without(simple.key)
        chosen = chosen.with_term(replace(simple, joints=left)) if left else chosen
    return chosen.with_term(replace(term, joints=joints))


def _concluded(
    model: RobotModel,
    samples: Sequence[Samples],
    start: DriveSet,
    chosen: DriveSet,
    trials: list[DriveTrial],
    judge: BlockJudge,
    loaded: RobotModel,
) -> DriveChoice:
    before, after = judge.trial(start), judge.trial(chosen)
    if chosen == start:
        rivals = [trial for trial in trials if trial.drive != start]
        best = min(rivals, key=lambda trial: trial.error)
        said = (
            f"drive terms {start} kept: on held-out blocks the best of {len(rivals)} richer sets ({_named(best.drive)}) lowers the torque error "
            f"by {100 * best.gain:.1f} +- {100 * best.gain_error:.1f} %"
        )
        return DriveChoice(start, tuple(trials), (said,))
    free = DriveSet(tuple(replace(available_terms()[term.key], joints=term.joints) if term.shapes else term for term in chosen.terms))
    refitted = fit_shapes(loaded, free, samples)
    if refitted.drive != chosen:
        again = BlockJudge(model, accumulate_stream(loaded, find_base_parameters(model, refitted.drive), samples)).trial(refitted.drive)
        if again.error < after.error:
            chosen, after = refitted.drive, replace(again, bic=after.bic)
            trials.append(after)
    per_joint = ", ".join(f"{name} {100 * (r - 1):+.0f} %" for name, r in zip(model.joint_names, after.rms / before.rms, strict=True))
    sentences = [
        f"drive terms {_named(chosen)} chosen on held-out blocks: torque error {100 * (after.error / before.error - 1):+.1f} % against "
        f"{_named(start)} ({per_joint}); BIC {after.bic - before.bic:+.0f}"
    ]
    if refitted.shapes:
        sentences.append(f"fitted shapes: {','.join(str(term) for term in chosen.terms if term.shapes)}")
    return DriveChoice(chosen, tuple(trials), tuple(sentences))


def _named(drive: DriveSet) -> str:
    """Return the keys of a set, with the joints of terms that only some have."""
    return ", ".join(
        term.key + ("" if term.joints is None else f" (joint{'s' if len(term.joints) > 1 else ''} {', '.join(map(str, term.joints))})")
        for term in drive.terms
    )


class BlockJudge:
    """Judge any subset of the drive terms of some square-root information by time blocks held out, without going back to the samples."""

    def __init__(self, model: RobotModel, information: SquareRootInformation) -> None:
        self._model, self._information = model, information
        base = information.base
        self._first = 10 * model.n_joints
        prior = base.values(np.nan_to_num(parameter_values(model, base.drive), nan=0.0))
        self._prior = np.where(base.columns < self._first, prior, 0.0)
        self._weights = 1.0 / fit_least_squares(information, weights="joint", prior=self._prior).sigma
        n_folds = min(FOLDS, information.n_blocks)
        self._folds = np.array_split(np.arange(information.n_blocks), n_folds)
        self._training = [
            [triangular_factor(np.delete(factors, fold, axis=0).reshape(-1, factors.shape[-1])) for factors in information.factors]
            for fold in self._folds
        ]
        self._held = [
            [triangular_factor(factors[fold].reshape(-1, factors.shape[-1])) for factors in information.factors] for fold in self._folds
        ]
        self._counts = np.array([sum(information.blocks[b].n_samples for b in fold) for fold in self._folds])
        self._known: dict[str, tuple[Array, Array, int]] = {}
        self._reference: float | None = None

    def trial(self, drive: DriveSet, against: DriveSet | None = None) -> DriveTrial:
        """Return what a set makes of held-out blocks; `against` is the set that its gain is measured from. The first set sets the zero of BIC."""
        held, energy, p = self._errors(drive)
        n = self._information.n_samples
        rms = np.sqrt(held.sum(axis=0) / self._counts.sum())
        gain, gain_error = 0.0, 0.0
        if against is not None:
            other = self._errors(against)[0]
            gain = 1.0 - float(np.exp(np.mean(0.5 * np.log(held.sum(axis=0) / other.sum(axis=0)))))
            steps = np.mean(0.5 * np.log(held / other), axis=1)
            gain_error = float(np.std(steps, ddof=1) / np.sqrt(len(steps)))
        bic = self._independent * float(np.sum(np.log(energy / n))) + p * float(np.log(self._independent * self._model.n_joints))
        if self._reference is None:
            self._reference = bic
        return DriveTrial(drive, p, rms, float(np.exp(np.mean(np.log(rms)))), bic - self._reference, gain, gain_error)

    @property
    def _independent(self) -> float:
        """Samples that are independent, taken as two per second: residuals last, and BIC would otherwise take every column."""
        return min(float(self._information.n_samples), 2.0 * self._information.duration)

    def _errors(self, drive: DriveSet) -> tuple[Array, Array, int]:
        """Return squared errors held out (folds, n) and on all blocks (n,), and how many parameters the set has."""
        key = str(drive)
        if key not in self._known:
            keep = self._mask(drive)
            with one_blas_thread():
                held = []
                for training, judged in zip(self._training, self._held, strict=True):
                    held.append(self._squared(judged, self._solved(training, keep)))
                factors = self._information.joint_factors
                energy = self._squared(factors, self._solved(factors, keep))
            self._known[key] = (np.array(held), energy, int(keep.sum()))
        return self._known[key]

    def _mask(self, drive: DriveSet) -> Mask:
        """Return which base parameters a subset of the terms has; one that stands for a simpler term shares its columns."""
        base = self._information.base
        wide = base.drive
        letters = [(k, letter) for k in range(self._model.n_joints) for letter in wide.letters]
        kept = {(k, letter) for term in drive.terms for letter in term.letters for k in range(self._model.n_joints) if term.is_at(k)}
        for term in drive.terms:
            simple = STANDS_FOR.get(term.key)
            if simple is not None and simple in wide.keys and not term.shapes:
                shared = available_terms()[simple].letters
                kept |= {(k, letter) for letter in shared for k in range(self._model.n_joints) if term.is_at(k)}
        return np.array([c < self._first or letters[c - self._first] in kept for c in base.columns.tolist()])

    def _solved(self, factors: Sequence[Array], keep: Mask) -> Array:
        information, p = self._information, int(keep.sum())
        place = np.cumsum(keep) - 1
        rows = np.zeros((sum(len(factor) for factor in factors), p + 1))
        top = 0
        for support, factor, weight in zip(information.support, factors, self._weights, strict=True):
            own = keep[support]
            rows[top : top + len(factor), place[support[own]]] = weight * factor[:, :-1][:, own]
            rows[top : top + len(factor), p] = weight * factor[:, -1]
            top += len(factor)
        beta = np.zeros(len(keep))
        beta[keep] = solve_factor(triangular_factor(rows), information.n_samples * information.n_joints, self._prior[keep]).x
        return beta

    def _squared(self, factors: Sequence[Array], beta: Array) -> Array:
        errors = [factor @ np.append(-beta[s], 1.0) for s, factor in zip(self._information.support, factors, strict=True)]
        return np.array([float(error @ error) for error in errors])
