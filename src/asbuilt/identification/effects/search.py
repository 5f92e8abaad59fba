"""Search for effects: one pass and one selection, repeated where an effect is not linear.

What it finds may still go: `workflow/fits.py` drops what the final fit does not bear out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.special import chdtrc

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, find_base_parameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import AsbuiltError, IdentifiabilityError, UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, join_names
from asbuilt.identification.bodies.cad_prior import build_cad_prior
from asbuilt.identification.drives.nonlinear_parameters import NonlinearPlace, fit_nonlinear
from asbuilt.identification.effects.effect import EFFECTS, Described, Effect, FoundEffect
from asbuilt.identification.effects.families.drive_terms import with_terms
from asbuilt.identification.effects.gathering import At, Candidate, gather_rows
from asbuilt.identification.effects.selection import Lacking, Selection
from asbuilt.identification.effects.trials import RULES, Prior, Trial
from asbuilt.identification.estimators.auto import design_effect, prior_information
from asbuilt.identification.estimators.consistent_fit import fit_consistent
from asbuilt.identification.estimators.held_out_choice import group_different_motions
from asbuilt.identification.estimators.least_squares import (
    ROUGH_WEIGHTS,
    joint_noise,
)
from asbuilt.identification.information.rows import KeptRows
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
)
from asbuilt.scaled import Scaled

# Samples of long recordings that are searched, in spans of `SEARCH_SPAN` seconds
SEARCH_SAMPLES = 30_000
SEARCH_SPAN = 10.0
# Time blocks of a recording, each of `SEARCH_SHORTEST` to `SEARCH_LONGEST` seconds
SEARCH_BLOCKS = 30
SEARCH_SHORTEST = 1.0
SEARCH_LONGEST = 5.0
# Groups of different motion below which held-out errors have no usable standard error
SEARCH_FEWEST_GROUPS = 3
SEARCH_ROUNDS = 8  # Passes for effects that are taken out
SEARCH_TRIED = 3000  # Samples by which factors are tried
# Fall of the logarithm of the residual, mean over joints, from which on a factor is far off
SEARCH_FAR_OFF = 0.05
# Rise of that logarithm with rough weights, which are within half of that, from which on no factor
# is fitted further
SEARCH_HOPELESS = 0.3
# Percentile of the torque that counts as its largest, so that a spike does not
SEARCH_ALMOST_ALL = 99.5


LEAST_TORQUE = 1e-9
"""Torque [N m] that no drive resolves, in place of the largest of a joint without any."""


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

    def without(self, places: Collection[tuple[str, str]]) -> Effects:
        """Return these without effects of some keys at some joints."""
        kept = [
            found_effect
            for found_effect in self.found
            if (found_effect.effect, found_effect.joint) not in places
        ]
        return replace(self, found=tuple(kept))

    def beside_plateaus(self, joints: Collection[str]) -> Effects:
        """Return these without errors of the log at joints whose torque is known to saturate."""
        kept = [
            found_effect
            for found_effect in self.found
            if found_effect.joint not in joints or not EFFECTS[found_effect.effect].of_log
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
    kept: KeptRows | None = None,
) -> Effects:
    """Find the effects that a description lacks, and add them to its model.

    Each pass over the samples gives the rows of the model and of all effects, about a
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
    kept
        Rows that are kept for others who ask for the same ones.

    Raises
    ------
    IdentifiabilityError
        If the samples do not determine an effect that is stated, or it is larger than robots have.
    UsageError
        If this robot cannot have an effect that is stated.
    """
    wanted = [effect for key, effect in EFFECTS.items() if keys is None or key in keys]
    own = {e.key for e in wanted if e.in_model and (applied is None or e.key in applied)}
    searched = _thin_samples(samples, SEARCH_SAMPLES)
    search = _Search(model, drive, searched, wanted, own, stated, kept or KeptRows())
    try:
        with use_one_blas_thread():
            return search.run()
    # A search that fails is said in a finding; what a user states must not vanish in one.
    except (AsbuiltError, np.linalg.LinAlgError) as problem:
        if stated:
            raise
        return Effects(model, drive, problem=str(problem))


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
        kept: KeptRows,
    ) -> None:
        self.model = model
        self.drive = drive
        self.samples = samples
        self.kept = kept
        self.wanted = wanted
        self.applied = applied
        self.stated = stated
        self.impossible: set[At] = set()
        # Without masses CAD holds no bodies, so that held-out motion alone decides.
        self.held = model.has_masses
        time = sum(sample.n_samples / sample.rate for sample in samples)
        self.seconds = float(np.clip(time / SEARCH_BLOCKS, SEARCH_SHORTEST, SEARCH_LONGEST))

    def run(self) -> Effects:
        """Return the effects, found on robot and log without those that can be taken out."""
        start = self._take_out_stated if self.stated else self._take_out_factor
        removed, selection = start(self._begin_selection(()))
        path = _select_further(selection, removed)
        # Bodies that the data tear away from CAD are no witness for effects: ask again without
        # them.
        if self.held and selection.refutes_cad():
            self.held = selection.held = False
            path = _select_further(selection, removed)
        # One at a time: what is taken out moves the linearisation point of all others.
        while (first := self._next_removed(path, removed)) is not None:
            own = first.candidate
            settled = list[Trial]()
            # A tilt becomes the model's gravity: it must hold without effects that are only named.
            if not own.effect.in_model or selection.holds(own):
                new = replace(first, values=_expand_values(first.values, own, selection))
                settled, further = self._settle([*removed, new])
            robot = selection.robot
            if settled and own.effect.is_possible(settled[-1].values, own.joint, robot):
                removed = settled
                selection = further
            else:
                # Not asked again, else the search would not end.
                self.impossible.add(own.at)
            path = _select_further(selection, removed)
        removed = [_conclude(_advance_values(each, selection), selection) for each in removed]
        added = [each.candidate for each in path if each.candidate.effect.key in self.applied]
        # Errors of the log stay in the samples: only what a model can have turns the robot.
        turned, _ = self._take_out(
            [each for each in removed if each.candidate.effect.key in self.applied]
        )
        drive, fitted, undetermined = self._fit_terms(turned, added)
        # With an error of the log found, what it leaves at single joints would be named as effects.
        right = not any(each.candidate.effect.of_log for each in removed)
        found = tuple(
            self._describe_found(each, selection)
            for each in (*removed, *path)
            if each.candidate.at not in undetermined and self._matters(each, selection, right)
        )
        # Taken but not in the model: these bias the fit to first order.
        out = [each for each in selection.taken if each not in added]
        known = {each.candidate.at: _select_acting(each, selection) for each in removed}
        unseen = {
            candidate.at: max(selection.smallest_seen(candidate), candidate.effect.least)
            for candidate in selection.candidates
            if candidate.effect.shown
        }
        return Effects(turned, drive, found, fitted, Lacking.of(selection, out, known), unseen)

    def _next_removed(self, path: Sequence[Trial], removed: Sequence[Trial]) -> Trial | None:
        """Return what is taken out next: what the model can have, or what the log shows first."""
        done = {trial.candidate.at for trial in removed}
        return next(
            (
                trial
                for j, trial in enumerate(path)
                if trial.candidate.effect.removable
                and (trial.candidate.effect.in_model or j == 0)
                and trial.candidate.at not in done
            ),
            None,
        )

    def _matters(self, trial: Trial, selection: Selection, right: bool) -> bool:
        """Return whether an effect is named: in the model, or surely much of the torque error.

        Surely: by the fall of the cost, too, as no prediction tests what is only named. At a joint
        any such fall is much, however small its torques are, on a `right` log: with an error of the
        log, what that leaves would be named.
        """
        before, after = trial.errors
        effect = trial.candidate.effect
        # `named` is of squared errors, these are their roots.
        falls = after < (1.0 - 0.5 * RULES.named) * before
        asked = trial.candidate.joint is not None and (right or effect.of_log)
        # What is taken out of robot or log has no relief.
        sure = not len(trial.relief) or (
            after < before and trial.chance * selection.n_asked <= RULES.level
        )
        return effect.key in self.applied or (sure and (falls or asked))

    def _take_out_stated(self, selection: Selection) -> tuple[list[Trial], Selection]:
        """Return stated effects that are sure and large enough, and the selection without them.

        Raises `UsageError` for effects that this robot cannot have.
        """
        own = {candidate.at: candidate for candidate in selection.candidates}
        if missing := [EFFECTS[key].title for key in self.stated if (key, None) not in own]:
            raise UsageError(
                f"{self.model.name} can have no {join_names(missing)}: its gravity is"
                f" {self.model.gravity}"
            )
        stated = [own[key, None] for key in self.stated]
        found, without = self._settle([Trial(each, np.zeros(len(each.places))) for each in stated])
        errors = selection.held_out_error([]), without.held_out_error(without.taken)
        kept = [replace(each, errors=errors) for each in found if self._is_sure(each, without)]
        # Effects that are not sure go back into the robot, and the rest is settled without them.
        return (kept, without) if len(kept) == len(found) else self._settle(kept)

    def _is_sure(self, removed: Trial, selection: Selection) -> bool:
        """Return whether an effect that is taken out is no chance, and large enough to matter."""
        own = selection.own(removed.candidate.at)
        values = _select_acting(removed, selection)
        # Chi-square of the values by their own covariance: a tilt has two, about both axes.
        covariance = selection.values_of([own])[1]
        square = Scaled(covariance).square(values)
        possible = own.effect.is_possible(removed.values, None, selection.robot)
        return possible and float(chdtrc(len(values), square)) < RULES.level

    def _take_out_factor(self, selection: Selection) -> tuple[list[Trial], Selection]:
        """Return the effect that is off by a factor, if one is, and the selection without it.

        The robot is fitted better from there on, and the value settles near that factor.
        """
        start = self._find_best_start()
        if start is None:
            return [], selection
        key, value = start
        try:
            (found,), without = self._settle(
                [Trial(selection.candidate((key, None)), np.array([value]))]
            )
        except (AsbuiltError, np.linalg.LinAlgError):
            return [], selection
        # A factor that predicts other motion worse has only found another imitation.
        before = selection.held_out_error([])
        after = without.held_out_error(without.taken)
        possible = EFFECTS[key].is_possible(found.values, None, selection.robot)
        if not possible or after > before:
            return [], selection
        return [replace(found, errors=(before, after))], without

    def _find_best_start(self) -> tuple[str, float] | None:
        """Return effect and start that fit some samples best, if they do better than none."""
        few = _thin_samples(self.samples, SEARCH_TRIED)
        base = find_base_parameters(self.model, self.drive)
        bound = min(sample.clock_bound for sample in self.samples)

        def reduced(samples: Sequence[Samples]) -> SquareRootInformation:
            return accumulate_stream(self.model, base, samples, block_seconds=self.seconds)

        noise = partial(joint_noise, prior=np.zeros(base.n_base))

        def left(noise: Array) -> float:
            # The logarithm, so that joints of small torques count as much as others.
            return float(np.mean(np.log(noise[np.isfinite(noise)])))

        starts = [
            (each, start)
            for each in self.wanted
            # Logged velocities bound the clock: factors beyond are not tried.
            for start in each.starts
            if abs(start) <= bound
        ]
        if not starts:
            return None
        near = noise(reduced(few))
        plain = left(near)
        tried = []
        for each, start in starts:
            seen = reduced(each.without(self.model, few, None, np.array([start]))[1])
            # Most factors make the log much worse: that shows before the weights have converged.
            if left(noise(seen, settled=ROUGH_WEIGHTS, near=near)) < plain + SEARCH_HOPELESS:
                tried.append((left(noise(seen)), each.key, start))
        residual, key, start = min(tried, default=(plain, "", 0.0))
        return None if plain - residual < SEARCH_FAR_OFF else (key, start)

    def _settle(self, removed: Sequence[Trial]) -> tuple[list[Trial], Selection]:
        """Return effects with values that leave next to nothing, and the selection about these.

        All others are searched again next to columns that stay free, so that none takes what the
        first linearisation has left. The last step, about the same values, is for
        `_advance_values`.
        """
        nearer = list(removed)
        for _ in range(SEARCH_ROUNDS):
            own = nearer
            selection = self._begin_selection(nearer)
            nearer = [_advance_values(each, selection) for each in own]
            # About these values the equations are made; the step left is below `settled`.
            if all(
                np.linalg.norm(new.values - old.values) < old.candidate.effect.settled
                for new, old in zip(nearer, own, strict=True)
            ):
                break
        return own, selection

    def _take_out(self, removed: Sequence[Trial]) -> tuple[RobotModel, list[Samples]]:
        """Return the robot and its samples without effects."""
        model = self.model
        samples = list(self.samples)
        for trial in removed:
            own = trial.candidate
            model, samples = own.effect.without(model, samples, own.joint, trial.values)
        return model, samples

    def _fit_terms(
        self, model: RobotModel, taken: Sequence[Candidate]
    ) -> tuple[DriveSet, tuple[NonlinearPlace, ...], set[At]]:
        """Return drive terms with nonlinear parameters, those fitted, and what had none."""
        n = self.model.n_joints
        drive = with_terms(self.drive, taken, n)
        if drive.is_linear or not any(
            candidate.term and candidate.term.nonlinear for candidate in taken
        ):
            return drive, (), set()
        # Nonlinear parameters are searched where there are any: the others follow linearly.
        fit = fit_nonlinear(model, drive, self.samples)
        undetermined = {
            candidate.at
            for candidate in taken
            for own in fit.nonlinear
            if own.term == candidate.effect.key
            and candidate.joint is not None
            and not own.determined[candidate.joint]
        }
        # A form whose parameter is undetermined would be in the model at an arbitrary value.
        drive = with_terms(
            self.drive, [candidate for candidate in taken if candidate.at not in undetermined], n
        )
        for own in fit.nonlinear:
            term = next((term for term in drive.terms if term.key == own.term), None)
            if term is not None:
                drive = drive.with_term(term.with_nonlinear({own.parameter.name: own.values}))
        places = tuple(
            place for place in fit.places if (place.term, place.joint) not in undetermined
        )
        return drive, places, undetermined

    def _begin_selection(self, removed: Sequence[Trial]) -> Selection:
        """Return the selection on a robot without effects, whose columns are taken."""
        model, samples = self._take_out(removed)
        base = find_base_parameters(model, self.drive)
        prior = build_cad_prior(model, self.drive)
        seen = accumulate_stream(model, base, samples, block_seconds=self.seconds, kept=self.kept)
        fit = fit_consistent(seen, prior)
        groups = group_different_motions(seen, fit.weights)
        # Held-out errors of fewer groups have no usable standard error.
        if len(groups) < SEARCH_FEWEST_GROUPS:
            raise IdentifiabilityError(
                f"{len(groups)} groups of motion of {model.name} are too few"
            )
        effect = design_effect(seen, fit)
        robot = _describe_robot(model, base, fit.standard, samples)
        rows, candidates = gather_rows(robot, samples, self.wanted, self.seconds, self.kept)
        # CAD counts once per independent sample, as the data do.
        cad = Prior(
            base.regrouping @ prior.parameters, effect * prior_information(seen, prior), effect
        )
        selection = Selection(rows, candidates, robot, cad, fit.weights, groups, self.applied)
        # Columns of what is taken out stay free: they take what the linearisation left.
        selection.taken = [selection.candidate(trial.candidate.at) for trial in removed]
        selection.impossible = self.impossible
        selection.held = self.held
        return selection

    def _describe_found(self, trial: Trial, selection: Selection) -> FoundEffect:
        own = trial.candidate
        names = self.model.joint_names
        # A value whose column does not act on this robot has no name either.
        acts = np.isin(selection.every_place(own), own.places)
        parts = own.effect.name_parts(names, own.joint)
        return own.effect.found(
            None if own.joint is None else names[own.joint],
            trial.values,
            trial.covariance,
            revolute=own.joint is None or self.model.joints[own.joint].is_revolute,
            in_model=own.effect.key in self.applied,
            torque=selection.torque_of(trial),
            errors=trial.errors,
            alternatives=tuple(
                alternative.effect.key
                + ("" if alternative.joint is None else f" at {names[alternative.joint]}")
                for alternative in trial.alternatives
            ),
            parts=[part for part, acting in zip(parts, acts, strict=True) if acting]
            if parts
            else (),
        )


def _select_further(selection: Selection, removed: Sequence[Trial]) -> list[Trial]:
    """Return the effects taken after those removed, with held-out errors before and after each."""
    selection.taken = [selection.candidate(trial.candidate.at) for trial in removed]
    given = list(selection.taken)
    path = selection.run()
    added = [each.candidate for each in path]
    # Errors before and after each, in the order taken, as a reader adds them up.
    steps = [selection.held_out_error([*given, *added[:k]]) for k in range(len(added) + 1)]
    return [replace(each, errors=both) for each, both in zip(path, pairwise(steps), strict=True)]


def _advance_values(removed: Trial, selection: Selection) -> Trial:
    """Return an effect with the values that leave nothing of it, to first order."""
    own = selection.own(removed.candidate.at)
    effect = removed.candidate.effect
    step = _expand_values(selection.values()[own.places], own, selection)
    found = replace(removed, values=effect.advanced(removed.values, step))
    if effect.in_model and np.linalg.norm(found.values) > effect.farthest:
        # The message states the limit in the unit of the effect, degrees for a tilt.
        most, _, unit = effect.size(np.array([effect.farthest]), np.zeros((1, 1)), revolute=True)
        raise IdentifiabilityError(
            f"the {effect.title} of {selection.robot.model.name} is more than {most:.0f} {unit}",
            cure=Cure("correct gravity in the description"),
        )
    return found


def _select_acting(removed: Trial, selection: Selection) -> Array:
    """Return the values of an effect that act on this robot."""
    own = selection.own(removed.candidate.at)
    return removed.values[np.isin(selection.every_place(own), own.places)]


def _conclude(removed: Trial, selection: Selection) -> Trial:
    """Return an effect that is taken out, with its errors as next to all others."""
    own = selection.own(removed.candidate.at)
    covariance = np.zeros((len(removed.values),) * 2)
    acts = np.flatnonzero(_expand_values(np.ones(len(own.places)), own, selection))
    # A share is a factor 1 + v of which the columns are the logarithm: errors scale by it.
    slope = 1.0 + float(removed.values[0]) if own.effect.of_shares else 1.0
    covariance[np.ix_(acts, acts)] = slope**2 * selection.values_of([own])[1]
    return Trial(
        replace(own, places=selection.every_place(own)),
        removed.values,
        covariance,
        alternatives=removed.alternatives,
        errors=removed.errors,
    )


def _expand_values(values: Array, own: Candidate, selection: Selection) -> Array:
    """Return the values of all parameters of an effect, 0 for what does not act on this robot."""
    places = selection.every_place(own)
    found = np.zeros(len(places))
    found[np.isin(places, own.places)] = values
    return found


def _describe_robot(
    model: RobotModel, base: BaseParameters, chi: Array, samples: Sequence[Samples]
) -> Described:
    """Return what columns of effects are made of."""
    torque = np.vstack([np.abs(sample.tau) for sample in samples])
    return Described(
        model,
        base,
        chi,
        samples[0].torque_source,
        tuple(sample.qd for sample in samples),
        np.maximum(np.percentile(torque, SEARCH_ALMOST_ALL, axis=0), LEAST_TORQUE),
        min(sample.clock_bound for sample in samples),
    )


def _thin_samples(samples: Sequence[Samples], most: int) -> list[Samples]:
    """Return spans of all recordings with at most about so many samples."""
    # Ceiling division: at most `most` samples stay.
    every = -(-sum(sample.n_samples for sample in samples) // most)
    if every <= 1:
        return list(samples)
    # Whole spans, not single samples: derivatives and blocks need neighbours.
    return [
        sample.select((sample.t - sample.t[0]) // SEARCH_SPAN % every == 0.0) for sample in samples
    ]
