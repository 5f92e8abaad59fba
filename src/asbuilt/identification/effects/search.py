"""Search for effects: one pass and one selection, repeated where an effect is not linear."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import axes_across
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.term import DriveTerm
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import AsbuiltError, IdentifiabilityError
from asbuilt.identification.bodies.cad_prior import cad_prior
from asbuilt.identification.drives.nonlinear_parameters import fit_nonlinear
from asbuilt.identification.effects.effect import EFFECTS, Described
from asbuilt.identification.effects.families.drive_terms import DriveEffect
from asbuilt.identification.effects.families.tilt import Tilt
from asbuilt.identification.effects.found_effect import FoundEffect
from asbuilt.identification.effects.gathering import Candidate, gather_equations
from asbuilt.identification.effects.selection import Prior, Selection, Trial
from asbuilt.identification.errors.nonlinear_errors import NonlinearPlace
from asbuilt.identification.estimators.auto import design_effect, prior_information
from asbuilt.identification.estimators.consistent_fit import fit_consistent
from asbuilt.identification.information.held_out import different_motions
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.tables import significant

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
    named: float = 0.03
    """Share of the torque error that effects which no model has must take away to be named."""
    rounds: int = 4
    settled: float = 1e-3
    """Passes for a tilt, and the step [rad] after which the next is of its square."""
    farthest: float = 0.35
    """Largest tilt [rad]; walls and ceilings belong into the description."""


LIMITS = SearchLimits()


@dataclass(frozen=True, slots=True, eq=False)
class Effects:
    """Hold what was found, the robot and drive terms with it, and what of them was fitted."""

    model: RobotModel
    drive: DriveSet
    found: tuple[FoundEffect, ...] = ()
    fitted: tuple[NonlinearPlace, ...] = ()

    def named_only(self, model: RobotModel, drive: DriveSet) -> Effects:
        """Return the same effects beside a robot without them."""
        return Effects(model, drive, tuple(replace(each, in_model=False) for each in self.found))


def find_effects(
    model: RobotModel,
    drive: DriveSet,
    samples: Sequence[Samples],
    *,
    keys: Collection[str] | None = None,
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
    keys
        Keys of the effects that are looked for; None: all that a model can have.
    """
    search = _Search(model, drive, _thinned(samples), keys)
    try:
        with one_blas_thread():
            return search.run()
    except (AsbuiltError, np.linalg.LinAlgError):
        return Effects(model, drive)


class _Search:
    """Search the effects of one robot."""

    def __init__(
        self,
        model: RobotModel,
        drive: DriveSet,
        samples: Sequence[Samples],
        keys: Collection[str] | None,
    ) -> None:
        self.model, self.drive, self.samples, self.keys = model, drive, samples, keys
        time = sum(each.n_samples / each.rate for each in samples)
        self.seconds = float(np.clip(time / LIMITS.blocks, LIMITS.shortest, LIMITS.longest))

    def run(self) -> Effects:
        """Return the effects, found on a robot with the tilt that they have."""
        turned, selection = self.model, self._selection(self.model)
        path = selection.run(selection.equations.candidates)
        first = next((each for each in path if each.candidate.effect.key == Tilt.key), None)
        of_tilt = {} if first is None else _errors(selection, path)
        taken = path
        if first is not None:
            tilt, turned, selection, path = self._settled(first, selection)
            both = selection.equations.candidates[selection.place_of(Tilt.key)]
            taken = [_turned_by(first, tilt, both), *path]
        errors = of_tilt | _errors(selection, path)
        added = [
            each.candidate for each in path if each.candidate.effect.in_model and each is not first
        ]
        drive, fitted, undetermined = self._fitted(turned, added)
        found = tuple(
            self._found(each, selection, errors[each.candidate.at])
            for each in taken
            if each.candidate.at not in undetermined
            and (each.candidate.effect.in_model or _matters(*errors[each.candidate.at]))
        )
        return Effects(turned, drive, found, fitted)

    def _settled(
        self, first: Trial, selection: Selection
    ) -> tuple[Array, RobotModel, Selection, list[Trial]]:
        """Return the tilt, the robot with it, and what is selected beside it.

        All effects are asked again beside a tilt that stays free, so that none takes what the first
        linearisation has left of it.
        """
        tilt, step = np.zeros(2), _about_axes(first.values, first.candidate, selection)
        for _ in range(LIMITS.rounds):
            tilt = tilt + step
            if np.max(np.abs(tilt)) > LIMITS.farthest:
                raise IdentifiabilityError(f"the base of {self.model.name} is on a wall or ceiling")
            turned = self._turned(tilt)
            selection = self._selection(turned)
            free = selection.equations.candidates[selection.place_of(Tilt.key)]
            own = selection.acting(free)
            selection.taken = [own]
            step = _about_axes(selection.values()[own.places], own, selection)
            if np.linalg.norm(step) < LIMITS.settled:
                break
        path = selection.run(selection.equations.candidates)
        step = _about_axes(selection.values()[own.places], own, selection)
        return tilt + step, self._turned(tilt + step), selection, path

    def _fitted(
        self, model: RobotModel, taken: Sequence[Candidate]
    ) -> tuple[DriveSet, tuple[NonlinearPlace, ...], set[tuple[str, int | None]]]:
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

    def _selection(self, model: RobotModel) -> Selection:
        """Return the selection on a robot, nothing taken yet."""
        base, prior = find_base_parameters(model, self.drive), cad_prior(model, self.drive)
        seen = accumulate_stream(model, base, self.samples, block_seconds=self.seconds)
        fit = fit_consistent(seen, prior)
        groups = different_motions(seen, fit.weights)
        if len(groups) < LIMITS.fewest_groups:
            raise IdentifiabilityError(
                f"{len(groups)} groups of motion of {model.name} are too few"
            )
        effect = design_effect(seen, fit)
        source = self.samples[0].torque_source
        speeds = tuple(each.qd for each in self.samples)
        robot = Described(model, self.drive, fit.standard, source, speeds)
        wanted = [each for each in EFFECTS.values() if self.keys is None or each.key in self.keys]
        equations = gather_equations(
            robot, base, self.samples, effects=wanted, block_seconds=self.seconds
        )
        cad = Prior(
            base.regrouping @ prior.parameters, effect * prior_information(seen, prior), effect
        )
        return Selection(equations, cad, fit.weights, groups)

    def _turned(self, tilt: Array) -> RobotModel:
        """Return the robot with its base turned by a tilt about the axes across gravity."""
        gravity = np.array(self.model.gravity)
        back = Rotation.from_rotvec(-tilt @ axes_across(gravity))
        return self.model.with_gravity(back.apply(gravity))

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
            in_model=effect.in_model,
            torque=selection.torque_of(trial),
            error_before=before,
            error_after=after,
            alternatives=others,
            text=effect.title
            + (f" at {joint}" if joint else "")
            + f" {effect.size_text(trial.values, trial.covariance, revolute=revolute)}:"
            f" torque error {significant(100 * before, 2)} -> {significant(100 * after, 2)} %",
        )


def _errors(
    selection: Selection, path: Sequence[Trial]
) -> dict[tuple[str, int | None], tuple[float, float]]:
    """Return the held-out errors before and after each effect was taken."""
    added = [each.candidate for each in path]
    given = [each for each in selection.taken if each not in added]
    steps = [selection.held_out_error([*given, *added[:k]]) for k in range(len(added) + 1)]
    return {each.at: (steps[k], steps[k + 1]) for k, each in enumerate(added)}


def _turned_by(first: Trial, tilt: Array, both: Candidate) -> Trial:
    """Return the tilt that was taken first with its final angles about both axes."""
    covariance = np.zeros((len(tilt),) * 2)
    felt = np.flatnonzero(tilt)
    if len(felt) == len(first.values):
        covariance[np.ix_(felt, felt)] = first.covariance
    return replace(first, candidate=both, values=tilt, covariance=covariance)


def _about_axes(values: Array, tilt: Candidate, selection: Selection) -> Array:
    """Return the angles of a tilt about both axes, 0 about one that the robot does not feel."""
    both = selection.equations.candidates[selection.place_of(Tilt.key)].places
    angles = np.zeros(len(both))
    angles[np.isin(both, tilt.places)] = values
    return angles


def _matters(before: float, after: float) -> bool:
    """Return whether an effect that stays out of the model is worth naming."""
    return after < (1.0 - LIMITS.named) * before


def with_terms(drive: DriveSet, candidates: Sequence[Candidate], n_joints: int) -> DriveSet:
    """Return drive terms with those of candidates, in place of the simpler terms they replace."""
    for effect in dict.fromkeys(each.effect for each in candidates):
        assert isinstance(effect, DriveEffect)
        own = {each.joint for each in candidates if each.effect is effect}
        term = effect.term
        had = next((each for each in drive.terms if each.key == term.key), None)
        joints = own | {k for k in range(n_joints) if had is not None and had.is_at(k)}
        drive = drive.with_term(_at(had or term, joints, n_joints))
        simple = next((each for each in drive.terms if each.key == term.stands_for), None)
        if simple is not None:
            left = {k for k in range(n_joints) if simple.is_at(k)} - own
            drive = drive.without(simple.key)
            drive = drive.with_term(_at(simple, left, n_joints)) if left else drive
    return drive


def _at(term: DriveTerm, joints: Collection[int | None], n_joints: int) -> DriveTerm:
    numbers = tuple(sorted(k + 1 for k in joints if k is not None))
    return replace(term, joints=None if len(numbers) == n_joints else numbers)


def _thinned(samples: Sequence[Samples]) -> list[Samples]:
    """Return spans of all recordings with about as many samples as are searched."""
    every = -(-sum(each.n_samples for each in samples) // LIMITS.samples)
    if every <= 1:
        return list(samples)
    return [each.select((each.t - each.t[0]) // LIMITS.span % every == 0.0) for each in samples]
