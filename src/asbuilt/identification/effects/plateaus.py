"""Torques that stay at one value where the motion asks for more: a drive or sensor saturates.

A plateau alone is no proof: friction at constant speed is one. So the model is fitted to the rest
of the log, and what it implies on the plateau has to exceed it and vary, while the torque does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, find_base_parameters
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.bodies.cad_prior import design_values
from asbuilt.identification.estimators.least_squares import fit_least_squares, solve_squares
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.rows import KeptRows, Rows, divide_into_blocks
from asbuilt.identification.information.square_root_information import (
    reduce_rows,
)
from asbuilt.identification.information.triangular import triangular_factor
from asbuilt.identification.result.torque_prediction import Prediction, predict_torque
from asbuilt.scaled import Scaled

# Say what a plateau is: settled on virtual UR10e, Panda and iiwa, with noise of 1 %.

PLATEAU_HIGHEST = 99.5  # Percentile of a torque that counts as its level, so that a spike does not
# PLATEAU_NEAR, PLATEAU_LEFT_OUT: parts of the level from which samples are close to it, and from
# which they are left out of the fit
PLATEAU_NEAR = 0.97
PLATEAU_LEFT_OUT = 0.93
PLATEAU_FEWEST = 10  # Filtered samples of a plateau
# Slope of the torque by what the model implies, from which it follows the model
PLATEAU_FOLLOWS = 0.3
# Part of the scatter of what is implied below which the scatter of the torque lies
PLATEAU_FLAT = 0.3
PLATEAU_EXCEEDS = 0.06  # Excess of the largest torque implied, as a part of the level
# Error of the fit to the whole log there, relative to the fit to the rest, up to which the model
# explains it: a load that hardly varies leaves nothing else to fit
PLATEAU_EXPLAINED = 0.2
PLATEAU_MATTERS = 0.3  # Level, as a part of the joint's largest torque, below which it is not one


MOST_HELD = 100e6
"""Memory [bytes] of the normal equations that one walk over the samples makes."""


@dataclass(frozen=True, slots=True)
class Plateau:
    """Hold a torque that saturates: the joint (from 0), its level, and the largest torque implied.

    Both [N m or N] with the sign of the torque.
    """

    joint: int
    level: float
    implied: float


def find_plateaus(
    model: RobotModel,
    drive: DriveSet,
    training: Sequence[Samples],
    block_seconds: float | None = None,
    kept: KeptRows | None = None,
) -> tuple[Plateau, ...]:
    """Return the torques that saturate, both signs of a joint as two, in the order of joints.

    Rows are shared with others by `kept`.

    Empty where the samples cannot be fitted.
    """
    base = find_base_parameters(model, drive)
    try:
        fits = _Fits(model, base, training, block_seconds, kept)
        values = fits.whole.beta
    except (AsbuiltError, np.linalg.LinAlgError):
        return ()
    logged = [predict_torque(model, base, values, samples) for samples in training]
    crowded = [_Crowded.of(training, logged, joint, sign) for joint, sign in _find_crowded(logged)]
    rests = fits.without_each([each.left_out for each in crowded])
    return tuple(
        found
        for each, values in zip(crowded, rests, strict=True)
        if (found := _find_plateau(model, base, training, each, values, fits))
    )


def report_plateaus(model: RobotModel, found: Sequence[Plateau]) -> Iterator[Finding]:
    """Yield a finding for each joint whose torque saturates."""
    for joint in sorted({plateau.joint for plateau in found}):
        plateaus = [plateau for plateau in found if plateau.joint == joint]
        levels, implied = (
            join_names([f"{x:.4g}" for x in values])
            for values in (
                [plateau.level for plateau in plateaus],
                [plateau.implied for plateau in plateaus],
            )
        )
        name = model.joint_names[joint]
        unit = model.joints[joint].torque_unit
        yield Finding(
            "torque_saturates",
            "warning",
            f"The torque of {name} stays at {levels} {unit} where its motion, by a fit to the rest"
            f" of the log, asks for up to {implied} {unit}: the drive or the sensor saturates",
            Cure(
                "leave these times out by [[windows]] in a recording sheet, record a gentler"
                " motion, or check the range of the sensor"
            ),
            joint=name,
        )


def drop_plateaus(training: Sequence[Samples], found: Sequence[Plateau]) -> tuple[Samples, ...]:
    """Return the samples at which no torque saturates, of recordings that have any."""
    kept = []
    for samples in training:
        keep = np.ones(samples.n_samples, dtype=np.bool_)
        for plateau in found:
            # The sign of the level turns the comparison for negative torques.
            keep &= samples.tau[:, plateau.joint] / plateau.level < PLATEAU_LEFT_OUT
        if keep.any():
            kept.append(samples if keep.all() else samples.select(keep))
    return tuple(kept)


def _find_crowded(logged: Sequence[Prediction]) -> Iterator[tuple[int, float]]:
    """Yield joints and signs with more samples near the level than below it."""
    tau = np.concatenate([prediction.measured for prediction in logged])
    for joint in range(tau.shape[1]):
        for sign in (1.0, -1.0):
            x = sign * tau[:, joint]
            level = float(np.percentile(x, PLATEAU_HIGHEST))
            # A level far below the largest torque is no limit.
            if level <= PLATEAU_MATTERS * np.abs(x).max():
                continue
            near = int(np.sum(x > PLATEAU_NEAR * level))
            # As wide a band just below: more samples near the level than there are unusual.
            below = int(np.sum(x > (2.0 * PLATEAU_NEAR - 1.0) * level)) - near
            if near >= max(PLATEAU_FEWEST, below):
                yield joint, sign


@dataclass(frozen=True, slots=True, eq=False)
class _Crowded:
    """Name a torque, times `sign`, that stays long near its `level`.

    `logged` are the recordings and what a fit makes of them; `left_out` the samples of each near
    the level.
    """

    joint: int
    sign: float
    level: float
    logged: Sequence[Prediction]
    left_out: tuple[Mask, ...]

    @classmethod
    def of(
        cls, training: Sequence[Samples], logged: Sequence[Prediction], joint: int, sign: float
    ) -> _Crowded:
        """Return the torque of a joint as logged and predicted."""
        torque = [sign * prediction.measured[:, joint] for prediction in logged]
        level = float(np.percentile(np.concatenate(torque), PLATEAU_HIGHEST))
        left_out = tuple(
            # Filtered torques are compared at their own times.
            np.interp(samples.t, log.t, x) >= PLATEAU_LEFT_OUT * level
            for samples, log, x in zip(training, logged, torque, strict=True)
        )
        return cls(joint, sign, level, logged, left_out)

    @property
    def torque(self) -> Array:
        """The torque (N,) of all recordings, times the sign."""
        return self.sign * np.concatenate([log.measured[:, self.joint] for log in self.logged])

    @property
    def error(self) -> Array:
        """What the fit leaves of it (N,)."""
        return np.concatenate(
            [log.measured[:, self.joint] - log.predicted[:, self.joint] for log in self.logged]
        )


def _find_plateau(
    model: RobotModel,
    base: BaseParameters,
    training: Sequence[Samples],
    crowded: _Crowded,
    rest: Array | None,
    fits: _Fits,
) -> Plateau | None:
    """Return a plateau if the model that is fitted to the rest exceeds it, and it does not."""
    joint = crowded.joint
    implied = np.zeros(0)
    # Few of the joints that stay long near their largest torque saturate: a fit with the weights
    # of the whole tells, one step of the thirty that weights of its own take.
    for known in (rest, None):
        try:
            values = fits.fit_without(crowded.left_out) if known is None else known
        except (AsbuiltError, np.linalg.LinAlgError):
            return None
        # Of each recording one column is kept, as a long one takes much memory.
        predicted = (predict_torque(model, base, values, samples) for samples in training)
        implied = crowded.sign * np.concatenate([each.predicted[:, joint] for each in predicted])
        if not _saturates(crowded, implied):
            return None
    highest = float(implied[implied > crowded.level].max())
    return Plateau(joint, crowded.sign * crowded.level, crowded.sign * highest)


def _saturates(crowded: _Crowded, implied: Array) -> bool:
    """Return whether a torque is flat where the one implied (N,) asks for more than its level."""
    # Only where the model asks for more than the level.
    beyond = implied > crowded.level
    x = crowded.torque[beyond]
    y = implied[beyond]
    if x.size < PLATEAU_FEWEST or y.max() < (1.0 + PLATEAU_EXCEEDS) * crowded.level:
        return False
    # The whole fit explains the torque there: nothing saturates.
    if np.mean(crowded.error[beyond] ** 2) <= PLATEAU_EXPLAINED**2 * np.mean((y - x) ** 2):
        return False
    scatter = float(np.std(y))
    # Slope of the logged torque by the implied one: 1 follows, 0 is flat.
    slope = float(np.mean((x - x.mean()) * (y - y.mean()))) / scatter**2
    return abs(slope) <= PLATEAU_FOLLOWS and bool(np.std(x) <= PLATEAU_FLAT * scatter)


class _Fits:
    """Fit samples by weighted least squares, all of them or without some, after one walk."""

    def __init__(
        self,
        model: RobotModel,
        base: BaseParameters,
        training: Sequence[Samples],
        block_seconds: float | None,
        kept: KeptRows | None,
    ) -> None:
        self._rows = Rows(model, base, training, block_seconds, kept=kept)
        self._blocks = list(divide_into_blocks(model, training, block_seconds))
        support = self._rows.support
        whole = reduce_rows(base, model.joint_names, support, self._rows)
        self._whole = whole.together()
        self._design = design_values(model, base)

    @cached_property
    def whole(self) -> Estimate:
        """The fit of all samples."""
        return fit_least_squares(self._whole, weights="joint", prior=self._design)

    def without_each(self, left_out: Sequence[Sequence[Mask]]) -> Iterator[Array | None]:
        """Yield base parameters (p,) fitted without each choice, with the weights of the whole.

        A choice are samples (N,) of each recording; filtered samples that have any part in them go.
        None where they are not well determined. One walk serves as many choices as `MOST_HELD` has
        room for.
        """
        weights = self.whole.weights
        whole = self._whole.summed(weights)
        size = sum(gram.nbytes for gram in self._whole.joint_grams)
        at_once = max(1, int(MOST_HELD // size))
        for first in range(0, len(left_out), at_once):
            for gone in self._gather(left_out[first : first + at_once]):
                found = solve_squares(whole - self._whole.sum_grams(gone, weights))
                yield None if found is None else found[0]

    def fit_without(self, left_out: Sequence[Mask]) -> Array:
        """Return base parameters (p,) without a choice, with weights of its own.

        They are as exact as normal equations, half the digits, enough for a comparison.
        """
        (gone,) = self._gather([left_out])
        every = zip(self._whole.joint_grams, gone, strict=True)
        factors = tuple(_take_root(gram - own)[None] for gram, own in every)
        n_samples = self._whole.n_samples - int(np.sum(self._mark(left_out)))
        time = replace(self._whole.blocks[0], n_samples=n_samples)
        rest = replace(self._whole, factors=factors, blocks=(time,))
        return fit_least_squares(rest, weights="joint", prior=self._design).beta

    def _gather(self, left_out: Sequence[Sequence[Mask]]) -> list[list[Array]]:
        """Return the normal equations of each joint that go with each choice, after one walk."""
        marks = [self._mark(choice) for choice in left_out]
        found = [[np.zeros_like(gram) for gram in self._whole.joint_grams] for _ in left_out]
        start = 0
        # Rows that are kept are one part: a product of few rows takes longer to begin than to do.
        for part in self._rows.parts() if self._rows.are_kept else self._rows.by_block():
            stop = start + part[0].shape[1]
            for grams, mark in zip(found, marks, strict=True):
                gone = np.flatnonzero(mark[start:stop])
                if not gone.size:
                    continue
                for gram, rows in zip(grams, part, strict=True):
                    own = rows[:, gone]
                    np.add(gram, own @ own.T, out=gram)
            start = stop
        return found

    def _mark(self, left_out: Sequence[Mask]) -> Mask:
        """Return which filtered samples take any part in what is left out, of all blocks."""
        # Recordings by identity: blocks of one share its samples.
        places = {id(samples): place for place, samples in enumerate(self._samples())}
        parts = (part.touches(left_out[places[id(part.samples)]]) for part in self._blocks)
        return np.concatenate(list(parts))

    def _samples(self) -> list[Samples]:
        """Return the recordings, in order."""
        return list({id(block.samples): block.samples for block in self._blocks}.values())


INDEPENDENT = 1e-4
"""Length of what a column of unit length has of its own, from which a Cholesky factor is as good as
axes: its square is far above rounding."""


def _take_root(gram: Array) -> Array:
    """Return a triangular R (q, q) with `R^T R` the normal equations."""
    # Rounding of a column that nothing moves may be negative.
    length = np.sqrt(np.maximum(np.diag(gram), 0.0))
    # A decomposition into axes takes ten times as long; it is for columns that are not independent.
    if np.all(length > 0.0):
        factor, problem = lapack.dpotrf(gram / np.outer(length, length), clean=1)
        if problem == 0 and np.diag(factor).min() > INDEPENDENT:
            return np.asarray(factor * length)
    root = Scaled(gram).root
    # A row of zeros makes the root square.
    return triangular_factor(np.vstack([root, np.zeros((1, len(gram)))]))
