"""Search for effects: one pass and one selection, repeated where an effect is not linear."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.term import DriveTerm
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import AsbuiltError, IdentifiabilityError, UsageError
from asbuilt.findings import Cure, join_names
from asbuilt.identification.bodies.cad_prior import build_cad_prior
from asbuilt.identification.drives.nonlinear_parameters import fit_nonlinear
from asbuilt.identification.effects.effect import EFFECTS, Described, Effect
from asbuilt.identification.effects.families.drive_terms import DriveEffect
from asbuilt.identification.effects.found_effect import FoundEffect, describe_found_effect
from asbuilt.identification.effects.gathering import At, Candidate, gather_equations
from asbuilt.identification.effects.lacking import Lacking
from asbuilt.identification.effects.selection import RULES, Prior, Selection, Trial
from asbuilt.identification.errors.nonlinear_errors import NonlinearPlace
from asbuilt.identification.estimators.auto import design_effect, prior_information
from asbuilt.identification.estimators.consistent_fit import fit_consistent
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.held_out import group_different_motions
from asbuilt.identification.information.square_root_information import accumulate_stream

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


@dataclass(frozen=True, slots=True)
class SearchLimits:
    """Say what is searched."""

    samples: int = 30_000
    """Samples of long recordings that are searched, in spans of `span` seconds."""
    span: float = 10.0
    blocks: int = 30
    """Time blocks of a recording, each of `shortest` to `longest` seconds."""
    shortest: float = 1.0
    longest: float = 5.0
    fewest_groups: int = 3
    """Groups of different motion below which held-out errors have no usable standard error."""
    rounds: int = 8
    """Passes for effects that are taken out."""
    tried: int = 3000
    """Samples by which factors are tried."""
    far_off: float = 0.05
    """Fall of the logarithm of the residual, mean over joints, from which on a factor is."""
    almost_all: float = 99.5
    """Percentile of the torque that counts as its largest, so that a spike does not."""


LIMITS = SearchLimits()


@dataclass(frozen=True, slots=True, eq=False)
class Effects:
    """Hold what was found, the robot and drive terms with it, and what of them was fitted.

    `lacking` is what the model lacks still, `unseen` the size below which an effect at a joint
    would not be sure; `problem` says why nothing was looked for.
    """

    model: RobotModel
    drive: DriveSet
    found: tuple[FoundEffect, ...] = ()
    fitted: tuple[NonlinearPlace, ...] = ()
    lacking: Lacking | None = None
    unseen: Mapping[At, float] = field(default_factory=dict)
    problem: str = ""

    def beside_plateaus(self, joints: Collection[str]) -> Effects:
        """Return these without errors of the log at joints whose torque is known to saturate."""
        kept = [
            each
            for each in self.found
            if each.joint not in joints or not EFFECTS[each.effect].of_log
        ]
        return replace(self, found=tuple(kept))


def find_effects(
    model: RobotModel,
    drive: DriveSet,
    samples: Sequence[Samples],
    *,
    keys: Collection[str] | None = None,
    applied: Collection[str] | None = None,
    stated: Collection[str] = (),
) -> Effects:
    """Find the effects that a description lacks, and add them to its model.

    Each pass over the samples gives the normal equations of the model and of all effects, about a
    physically consistent fit; a selection takes effects one at a time (`Selection`). A base tilt is
    put into gravity, and everything is asked again.

    Parameters
    ----------
    model, drive
        The robot as described, and its drive terms.
    samples
        Samples of one or more recordings.
    keys, applied
        Keys of the effects that are looked for, and of those that may become part of the model;
        None: all that there are, and all that models can have.
    stated
        Keys of effects of the whole robot that can be taken out, such as its tilt, and that are in
        the model if they are sure, worth their torque or not.

    Raises
    ------
    IdentifiabilityError
        If the samples do not determine an effect that is stated, or it is larger than robots have.
    UsageError
        If this robot cannot have an effect that is stated.
    """
    wanted = [each for key, each in EFFECTS.items() if keys is None or key in keys]
    own = {e.key for e in wanted if e.in_model and (applied is None or e.key in applied)}
    search = _Search(model, drive, _thin_samples(samples, LIMITS.samples), wanted, own, stated)
    try:
        with use_one_blas_thread():
            return search.run()
    except (AsbuiltError, np.linalg.LinAlgError) as problem:
        if stated:
            raise
        return Effects(model, drive, problem=str(problem))


@dataclass(frozen=True, slots=True, eq=False)
class _Removed:
    """Hold an effect taken out at values, its column staying, and held-out errors around it."""

    at: At
    values: Array
    errors: tuple[float, float]
    alternatives: tuple[Candidate, ...] = ()

    @property
    def effect(self) -> Effect:
        return EFFECTS[self.at[0]]


class _Search:
    """Search the effects of one robot."""

    def __init__(
        self,
        model: RobotModel,
        drive: DriveSet,
        samples: Sequence[Samples],
        wanted: Sequence[Effect],
        applied: Collection[str],
        stated: Collection[str],
    ) -> None:
        self.model, self.drive, self.samples = model, drive, samples
        self.wanted, self.applied, self.stated = wanted, applied, stated
        self.impossible: set[At] = set()
        self.held = model.has_masses
        time = sum(each.n_samples / each.rate for each in samples)
        self.seconds = float(np.clip(time / LIMITS.blocks, LIMITS.shortest, LIMITS.longest))

    def run(self) -> Effects:
        """Return the effects, found on robot and log without those that can be taken out."""
        start = self._given if self.stated else self._far_off
        removed, selection = start(self._selection(()))
        path = selection.run()
        if self.held and selection.refutes_cad():
            self.held = selection.held = False
            selection.taken = [selection.own(each.at) for each in removed]
            path = selection.run()
        while (first := self._to_remove(path, removed)) is not None:
            own = first.candidate
            if own.effect.in_model and not selection.holds(own):
                self.impossible.add(own.at)
                selection.taken = [selection.own(each.at) for each in removed]
                path = selection.run()
                continue
            values, around = (
                _expand_values(first.values, own, selection),
                _collect_errors(selection, path)[own.at],
            )
            new = _Removed(own.at, values, around, first.alternatives)
            settled, beside = self._settled([*removed, new])
            robot = selection.equations.robot
            if own.effect.is_possible(settled[-1].values, own.joint, robot):
                removed, selection = settled, beside
            else:
                self.impossible.add(own.at)
                selection.taken = [selection.own(each.at) for each in removed]
            path = selection.run()
        errors = _collect_errors(selection, path)
        removed = [_advance_values(each, selection) for each in removed]
        taken = [(_make_trial(each, selection), each.errors) for each in removed]
        taken += [(each, errors[each.candidate.at]) for each in path]
        added = [each.candidate for each in path if each.candidate.effect.key in self.applied]
        turned, _ = self._without([each for each in removed if each.at[0] in self.applied])
        drive, fitted, undetermined = self._fitted(turned, added)
        right = not any(each.effect.of_log for each in removed)
        found = tuple(
            self._found(trial, selection, of_trial)
            for trial, of_trial in taken
            if trial.candidate.at not in undetermined
            and self._matters(trial, of_trial, selection, right)
        )
        out = [each for each in selection.taken if each not in added]
        known = {each.at: _select_acting(each, selection) for each in removed}
        lacking = Lacking.of(selection, out, known)
        unseen = {
            each.at: max(selection.smallest_seen(each), each.effect.least)
            for each in selection.equations.candidates
            if each.effect.shown
        }
        return Effects(turned, drive, found, fitted, lacking, unseen)

    def _to_remove(self, path: Sequence[Trial], removed: Sequence[_Removed]) -> Trial | None:
        """Return what is taken out next: what the model can have, or what the log shows first."""
        done = {each.at for each in removed}
        return next(
            (
                each
                for j, each in enumerate(path)
                if each.candidate.effect.removable
                and (each.candidate.effect.in_model or j == 0)
                and each.candidate.at not in done
            ),
            None,
        )

    def _matters(
        self, trial: Trial, errors: tuple[float, float], selection: Selection, right: bool
    ) -> bool:
        """Return whether an effect is named: in the model, or surely much of the torque error.

        Surely: by the fall of the cost, too, as no prediction tests what is only named. At a joint
        any such fall is much, however small its torques are, on a `right` log: with an error of the
        log, what that leaves would be named.
        """
        before, after = errors
        effect = trial.candidate.effect
        falls = after < (1.0 - 0.5 * RULES.named) * before
        asked = trial.candidate.joint is not None and (right or effect.of_log)
        # What is taken out of robot or log has no relief.
        sure = not len(trial.relief) or (
            after < before and trial.chance * selection.n_asked <= RULES.level
        )
        return effect.key in self.applied or (sure and (falls or asked))

    def _given(self, selection: Selection) -> tuple[list[_Removed], Selection]:
        """Return the stated effects that are sure and large enough, and the selection beside them.

        Raises `UsageError` for effects that this robot cannot have.
        """
        none = np.zeros(0)
        own = [_Removed((key, None), none, (0.0, 0.0)) for key in self.stated]
        acting = {each.at: len(each.places) for each in selection.equations.candidates}
        if missing := [each.effect.title for each in own if each.at not in acting]:
            raise UsageError(
                f"{self.model.name} can have no {join_names(missing)}: its gravity is"
                f" {self.model.gravity}"
            )
        found, beside = self._settled(
            [replace(each, values=np.zeros(acting[each.at])) for each in own]
        )
        around = selection.held_out_error([]), beside.held_out_error(beside.taken)
        kept = [replace(each, errors=around) for each in found if self._is_sure(each, beside)]
        return (kept, beside) if len(kept) == len(found) else self._settled(kept)

    def _is_sure(self, removed: _Removed, selection: Selection) -> bool:
        """Return whether an effect that is taken out is no chance, and large enough to matter."""
        own = selection.own(removed.at)
        values, covariance = _select_acting(removed, selection), selection.values_of([own])[1]
        square = float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)
        possible = removed.effect.is_possible(removed.values, None, selection.equations.robot)
        return possible and float(chdtrc(len(values), square)) < RULES.level

    def _far_off(self, selection: Selection) -> tuple[list[_Removed], Selection]:
        """Return the effect that is off by a factor, if one is, and the selection beside it.

        The robot is fitted better from there on, and the value settles near that factor.
        """
        start = self._best_start()
        if start is None:
            return [], selection
        try:
            (found,), beside = self._settled([start])
        except (AsbuiltError, np.linalg.LinAlgError):
            return [], selection
        before, after = selection.held_out_error([]), beside.held_out_error(beside.taken)
        possible = found.effect.is_possible(found.values, None, selection.equations.robot)
        if not possible or after > before:
            return [], selection
        return [replace(found, errors=(before, after))], beside

    def _best_start(self) -> _Removed | None:
        """Return the effect at the start that fits some of the samples best, if it does better."""
        few = _thin_samples(self.samples, LIMITS.tried)
        base = find_base_parameters(self.model, self.drive)
        bound = min(each.clock_bound for each in self.samples)

        def left(samples: Sequence[Samples]) -> float:
            seen = accumulate_stream(self.model, base, samples, block_seconds=self.seconds)
            sigma = fit_least_squares(seen, weights="joint", prior=np.zeros(base.n_base)).sigma
            return float(np.mean(np.log(sigma[np.isfinite(sigma)])))

        tried = [
            (left(each.without(self.model, few, None, np.array([start]))[1]), each.key, start)
            for each in self.wanted
            for start in each.starts
            if abs(start) <= bound
        ]
        if not tried:
            return None
        residual, key, start = min(tried)
        if left(few) - residual < LIMITS.far_off:
            return None
        return _Removed((key, None), np.array([start]), (0.0, 0.0))

    def _settled(self, removed: Sequence[_Removed]) -> tuple[list[_Removed], Selection]:
        """Return effects with values that leave next to nothing, and the selection about these.

        All others are asked again beside columns that stay free, so that none takes what the first
        linearisation has left. The last step, about the same values, is for `_advance_values`.
        """
        nearer = list(removed)
        for _ in range(LIMITS.rounds):
            own, selection = nearer, self._selection(nearer)
            nearer = [_advance_values(each, selection) for each in own]
            moved = [np.linalg.norm(a.values - b.values) for a, b in zip(nearer, own, strict=True)]
            if all(step < each.effect.settled for step, each in zip(moved, own, strict=True)):
                break
        return own, selection

    def _without(self, removed: Sequence[_Removed]) -> tuple[RobotModel, list[Samples]]:
        """Return the robot and its samples without effects."""
        model, samples = self.model, list(self.samples)
        for each in removed:
            model, samples = each.effect.without(model, samples, each.at[1], each.values)
        return model, samples

    def _fitted(
        self, model: RobotModel, taken: Sequence[Candidate]
    ) -> tuple[DriveSet, tuple[NonlinearPlace, ...], set[At]]:
        """Return drive terms with nonlinear parameters, those fitted, and what had none."""
        n = self.model.n_joints
        drive = with_terms(self.drive, taken, n)
        if drive.is_linear or not any(each.term and each.term.nonlinear for each in taken):
            return drive, (), set()
        fit = fit_nonlinear(model, drive, self.samples)
        undetermined = {
            each.at
            for each in taken
            for own in fit.nonlinear
            if own.term == each.effect.key
            and each.joint is not None
            and not own.determined[each.joint]
        }
        kept = [each for each in taken if each.at not in undetermined]
        drive = with_terms(self.drive, kept, n)
        for own in fit.nonlinear:
            term = next((each for each in drive.terms if each.key == own.term), None)
            if term is not None:
                drive = drive.with_term(term.with_nonlinear({own.parameter.name: own.values}))
        places = tuple(each for each in fit.places if (each.term, each.joint) not in undetermined)
        return drive, places, undetermined

    def _selection(self, removed: Sequence[_Removed]) -> Selection:
        """Return the selection on a robot without effects, whose columns are taken."""
        model, samples = self._without(removed)
        base, prior = find_base_parameters(model, self.drive), build_cad_prior(model, self.drive)
        seen = accumulate_stream(model, base, samples, block_seconds=self.seconds)
        fit = fit_consistent(seen, prior)
        groups = group_different_motions(seen, fit.weights)
        if len(groups) < LIMITS.fewest_groups:
            raise IdentifiabilityError(
                f"{len(groups)} groups of motion of {model.name} are too few"
            )
        effect = design_effect(seen, fit)
        robot = _describe_robot(model, self.drive, fit.standard, samples)
        equations = gather_equations(
            robot, base, samples, effects=self.wanted, block_seconds=self.seconds
        )
        cad = Prior(
            base.regrouping @ prior.parameters, effect * prior_information(seen, prior), effect
        )
        selection = Selection(equations, cad, fit.weights, groups, self.applied)
        selection.taken = [selection.candidate(each.at) for each in removed]
        selection.impossible, selection.held = self.impossible, self.held
        return selection

    def _found(
        self, trial: Trial, selection: Selection, errors: tuple[float, float]
    ) -> FoundEffect:
        candidate, names = trial.candidate, self.model.joint_names
        effect, k = candidate.effect, candidate.joint
        joint = None if k is None else names[k]
        revolute = k is None or self.model.joints[k].is_revolute
        size, error, unit = effect.size(trial.values, trial.covariance, revolute=revolute)
        before, after = errors
        others = tuple(
            each.effect.key + ("" if each.joint is None else f" at {names[each.joint]}")
            for each in trial.alternatives
        )
        return FoundEffect(
            effect=effect.key,
            joint=joint,
            estimate=size,
            std_error=error,
            unit=unit,
            in_model=effect.key in self.applied,
            torque=selection.torque_of(trial),
            error_before=before,
            error_after=after,
            alternatives=others,
            text=describe_found_effect(
                effect.title,
                joint,
                effect.size_text(trial.values, trial.covariance, revolute=revolute),
                before,
                after,
            ),
        )


def _collect_errors(selection: Selection, path: Sequence[Trial]) -> dict[At, tuple[float, float]]:
    """Return the held-out errors before and after each effect was taken."""
    added = [each.candidate for each in path]
    given = [each for each in selection.taken if each not in added]
    steps = [selection.held_out_error([*given, *added[:k]]) for k in range(len(added) + 1)]
    return {each.at: (steps[k], steps[k + 1]) for k, each in enumerate(added)}


def _advance_values(removed: _Removed, selection: Selection) -> _Removed:
    """Return an effect with the values that leave nothing of it, to first order."""
    own = selection.own(removed.at)
    step = _expand_values(selection.values()[own.places], own, selection)
    found = replace(removed, values=removed.effect.advanced(removed.values, step))
    effect = removed.effect
    if effect.in_model and np.linalg.norm(found.values) > effect.farthest:
        most, _, unit = effect.size(np.array([effect.farthest]), np.zeros((1, 1)), revolute=True)
        raise IdentifiabilityError(
            f"the {effect.title} of {selection.equations.robot.model.name} is more than {most:.0f}"
            f" {unit}",
            cure=Cure("correct gravity in the description"),
        )
    return found


def _select_acting(removed: _Removed, selection: Selection) -> Array:
    """Return the values of an effect that act on this robot."""
    own = selection.own(removed.at)
    return removed.values[np.isin(selection.every_place(own), own.places)]


def _make_trial(removed: _Removed, selection: Selection) -> Trial:
    """Return an effect that is taken out, with its errors as beside all others."""
    own = selection.own(removed.at)
    covariance = np.zeros((len(removed.values),) * 2)
    acts = np.flatnonzero(_expand_values(np.ones(len(own.places)), own, selection))
    slope = 1.0 + float(removed.values[0]) if removed.effect.of_shares else 1.0
    covariance[np.ix_(acts, acts)] = slope**2 * selection.values_of([own])[1]
    return Trial(
        replace(own, places=selection.every_place(own)),
        removed.values,
        covariance,
        alternatives=removed.alternatives,
    )


def _expand_values(values: Array, own: Candidate, selection: Selection) -> Array:
    """Return the values of all parameters of an effect, 0 for what does not act on this robot."""
    places = selection.every_place(own)
    found = np.zeros(len(places))
    found[np.isin(places, own.places)] = values
    return found


def _describe_robot(
    model: RobotModel, drive: DriveSet, chi: Array, samples: Sequence[Samples]
) -> Described:
    """Return what columns of effects are made of."""
    torque = np.vstack([np.abs(each.tau) for each in samples])
    return Described(
        model,
        drive,
        chi,
        samples[0].torque_source,
        tuple(each.qd for each in samples),
        np.maximum(np.percentile(torque, LIMITS.almost_all, axis=0), np.finfo(np.float64).tiny),
        min(each.clock_bound for each in samples),
    )


def with_terms(drive: DriveSet, candidates: Sequence[Candidate], n_joints: int) -> DriveSet:
    """Return drive terms with those of candidates, in place of the simpler terms they replace."""
    for effect in dict.fromkeys(each.effect for each in candidates):
        assert isinstance(effect, DriveEffect)
        found = {e.joint: e.term for e in candidates if e.effect is effect and e.joint is not None}
        own = set(found)
        term = effect.term
        had = next((each for each in drive.terms if each.key == term.key), None)
        joints = own | {k for k in range(n_joints) if had is not None and had.is_at(k)}
        drive = drive.with_term(
            _place_term(_formed(had or term, found, n_joints), joints, n_joints)
        )
        simple = next((each for each in drive.terms if each.key == term.stands_for), None)
        if simple is not None:
            left = {k for k in range(n_joints) if simple.is_at(k)} - own
            drive = drive.without(simple.key)
            drive = drive.with_term(_place_term(simple, left, n_joints)) if left else drive
    return drive


def _formed(term: DriveTerm, found: Mapping[int, DriveTerm | None], n_joints: int) -> DriveTerm:
    """Return a term in the form in which it was found at each joint."""
    for each in term.nonlinear:
        there = [(found.get(k) or term).at(k).value(each.name) for k in range(n_joints)]
        if not each.fitted and set(there) != {each.default}:
            term = term.with_nonlinear({each.name: tuple(there)})
    return term


def _place_term(term: DriveTerm, joints: Collection[int], n_joints: int) -> DriveTerm:
    numbers = tuple(sorted(k + 1 for k in joints))
    return replace(term, joints=None if len(numbers) == n_joints else numbers)


def _thin_samples(samples: Sequence[Samples], most: int) -> list[Samples]:
    """Return spans of all recordings with at most about so many samples."""
    every = -(-sum(each.n_samples for each in samples) // most)
    if every <= 1:
        return list(samples)
    return [each.select((each.t - each.t[0]) // LIMITS.span % every == 0.0) for each in samples]
