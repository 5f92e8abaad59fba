"""Base tilt: the direction of gravity in the root frame, estimated with the links."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import axes_across
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.findings import Cure
from asbuilt.identification.bodies.body_bounds import BodyBounds, generous_bounds
from asbuilt.identification.bodies.cad_prior import CadPrior, cad_prior
from asbuilt.identification.bodies.conic_fit import ConicProblem
from asbuilt.identification.calibration.gravity_rows import GravityRows
from asbuilt.identification.estimators.consistent_fit import ConsistentEstimate, fit_consistent
from asbuilt.identification.information.rows import SampleBlock, sample_blocks
from asbuilt.identification.information.square_root_information import (
    MOST_BLOCKS,
    SquareRootInformation,
    accumulate_stream,
)
from asbuilt.identification.result.torque_prediction import parameter_torque

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


SEARCHES = (1e-4, 1e-7)
"""Relative falls of the cost at which two searches end; the second has the joint weights of the
first."""


@dataclass(frozen=True, slots=True)
class TiltRules:
    """Hold how a base tilt is searched, and when it is one."""

    most_tries: int = 80
    """Evaluations of the cost in a search of two angles."""
    step: float = 20e-3
    """Unit of the tilt in the search [rad]."""
    slope: float = 1e-5
    """Step [rad] of the slopes of the cost with the parameters held, which is quadratic there."""
    difference: float = 4e-3
    """Step [rad] of the finite differences of the cost."""
    farthest: float = 0.35
    """Largest tilt [rad] of the search; walls and ceilings belong into the description."""
    significant: float = 4.0
    """Standard errors that a base tilt must exceed."""
    noticeable: float = 1e-3
    """Angle [rad] that a base tilt must exceed: about the accuracy of a level floor."""


RULES = TiltRules()


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Hold the base tilt of a robot.

    Parameters
    ----------
    as_given
        The robot as described.
    axes, tilt
        Axes (2, 3) of the root frame and angles (2,) [rad] by which the base is turned.
    covariance
        Of the tilt (2, 2), for residuals that are correlated within a time block.
    gravity
        Estimated gravity in the root frame (3,) [m/s^2].
    rms_as_given, rms
        Torque residuals (n,) of consistent fits without and with the tilt [N m or N].
    """

    as_given: RobotModel
    axes: Array
    tilt: Array
    covariance: Array
    gravity: Array
    rms_as_given: Array
    rms: Array

    @property
    def std_errors(self) -> Array:
        """Standard errors of the tilt [rad], shape (2,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def angle(self) -> float:
        """Angle between described and estimated gravity [rad]."""
        return float(np.linalg.norm(self.tilt))

    @property
    def is_tilted(self) -> bool:
        """Whether the tilt exceeds 4 standard errors and the accuracy of a level floor.

        Of a singular covariance, as few time blocks give it, only the directions with an error
        count.
        """
        variances, directions = np.linalg.eigh(self.covariance)
        known = variances > np.finfo(float).eps * variances[-1]
        parts = (self.tilt @ directions[:, known]) ** 2 / variances[known]
        z = float(np.sum(parts)) if known.any() else np.inf
        return self.angle > RULES.noticeable and z > RULES.significant**2

    @property
    def relief(self) -> float:
        """Fraction by which the tilt lowers the torque residual of all joints."""
        before = float(np.linalg.norm(self.rms_as_given))
        return 1.0 - float(np.linalg.norm(self.rms)) / before if before > 0.0 else 0.0

    @property
    def model(self) -> RobotModel:
        """The robot with estimated gravity if it is tilted, else as described."""
        return self.as_given.with_gravity(self.gravity) if self.is_tilted else self.as_given

    @property
    def sentence(self) -> str:
        """The tilt with standard errors, as text."""
        degrees, errors = np.rad2deg(self.tilt), np.rad2deg(self.std_errors)
        turned = " and ".join(
            f"{angle:.2f} +- {error:.2f} deg about {_written(axis)}"
            for angle, error, axis in zip(degrees, errors, self.axes, strict=True)
        )
        before, after = (
            float(np.sqrt(np.mean(self.rms_as_given**2))),
            float(np.sqrt(np.mean(self.rms**2))),
        )
        if self.is_tilted:
            return (
                f"base tilt of {turned} relative to the description; torque residual"
                f" {before:.3g} -> {after:.3g} N m"
            )
        return f"no significant base tilt: {turned} relative to the description"


def find_mounting(
    model: RobotModel,
    samples: Samples | Sequence[Samples],
    *,
    drive: DriveSet = NO_DRIVE,
    block_seconds: float | None = None,
) -> Mounting:
    """Find the direction of gravity in the root frame, near that of the description.

    Minimises `V(theta) = min_chi |w (tau - W_theta K chi)|^2 / 2` over physically consistent chi,
    without which inconsistent inertias imitate a tilt. A quasi-Newton search on V (variable
    projection: Golub & Pereyra, Inverse Problems 19, 2003), whose slopes are those with the best
    chi held and continuous where its second derivatives jump, at active bounds; K
    is the same for all generic directions. Load-dependent drive terms are left out. The covariance
    is `H^-1 (sum_b g_b g_b^T) H^-1` with the slopes g_b of the blocks' parts of V and the Hessian H
    of V, by finite differences.

    Parameters
    ----------
    model
        The robot as described.
    samples
        Samples of one or more recordings.
    drive
        Drive terms.
    block_seconds
        Length of a time block [s].

    Raises
    ------
    IdentifiabilityError
        If the samples do not determine the direction, or it is far from that of the description.
    UsageError
        If there are no samples, or the description has no gravity.
    """
    batches = list(samples) if isinstance(samples, Sequence) else [samples]
    strength = float(np.linalg.norm(model.gravity))
    if not batches or strength == 0.0:
        raise UsageError(
            f"the base tilt of {model.name} needs samples and a description with gravity; got"
            f" {len(batches)} batches, {strength:g} m/s^2"
        )
    drive = DriveSet(tuple(term for term in drive.terms if not term.needs_load))
    axes = axes_across(model.gravity)
    base = find_base_parameters(_turned(model, axes, np.array([0.07, 0.11])), drive)
    prior = cad_prior(model, drive)
    bounds = generous_bounds(prior)
    problem = ConicProblem.of(prior, base.regrouping, bounds)

    def information(tilt: Array) -> SquareRootInformation:
        return accumulate_stream(
            _turned(model, axes, tilt), base, batches, block_seconds=block_seconds
        )

    def gravity(tilt: Array) -> Array:
        return np.array(_turned(model, axes, tilt).gravity)

    tilt = np.zeros(2)
    with one_blas_thread():
        rows = GravityRows.of(model, base, batches)

        def best(tilt: Array, weights: Array) -> Array:
            return problem.fit(rows.stacked(gravity(tilt), weights)).chi

        def cost(steps: Array, weights: Array) -> tuple[float, Array]:
            """Return V and its gradient, which is that with the best parameters held."""
            tilt = RULES.step * steps
            beta = base.regrouping @ best(tilt, weights)
            here, *moved = (
                rows.cost(gravity(tilt + step), weights, beta)
                for step in RULES.slope * np.eye(3, 2, -1)
            )
            return here, RULES.step * (np.array(moved) - here) / RULES.slope

        fit, as_given = _settled(information(tilt), prior, bounds)
        for enough in SEARCHES:
            found = minimize(
                cost,
                tilt / RULES.step,
                args=(fit.weights,),
                method="L-BFGS-B",
                jac=True,
                bounds=[(-RULES.farthest / RULES.step, RULES.farthest / RULES.step)] * 2,
                options={"ftol": enough, "maxfun": RULES.most_tries},
            )
            tilt = RULES.step * np.asarray(found.x)
            seen = information(tilt)
            fit, rms = _settled(seen, prior, bounds)
        if np.max(np.abs(tilt)) > 0.99 * RULES.farthest:
            raise IdentifiabilityError(
                f"gravity in the root frame of {model.name} is more than"
                f" {np.rad2deg(RULES.farthest):.0f} deg from that of the description",
                cure=Cure("correct gravity in the description"),
            )
        blocks = _blocks(model, batches, block_seconds, 2 * MOST_BLOCKS)

        def block_costs(tilt: Array, chi: Array | None = None) -> Array:
            chi = best(tilt, fit.weights) if chi is None else chi
            return _block_costs(_turned(model, axes, tilt), drive, chi, fit.weights, blocks)

        slopes, hessian = _differences(block_costs, tilt, block_costs(tilt, fit.standard))
        if np.linalg.eigvalsh(hessian)[0] <= 0.0:
            raise IdentifiabilityError(
                f"the recordings of {model.name} do not determine the base tilt: the torque error"
                " has no distinct minimum",
                cure=Cure("move joints whose axes are not parallel to gravity through their range"),
            )
        inverse = np.linalg.inv(hessian)
        covariance = inverse @ (slopes.T @ slopes) @ inverse
    return Mounting(
        as_given=model,
        axes=axes,
        tilt=tilt,
        covariance=covariance,
        gravity=_turned(model, axes, tilt).gravity,
        rms_as_given=as_given,
        rms=rms,
    )


def _settled(
    information: SquareRootInformation, prior: CadPrior, bounds: BodyBounds
) -> tuple[ConsistentEstimate, Array]:
    fit = fit_consistent(information, prior, bounds=bounds)
    return fit, np.sqrt(information.residual_energy(fit.beta) / information.n_samples)


def _block_costs(
    model: RobotModel, drive: DriveSet, chi: Array, weights: Array, blocks: Sequence[SampleBlock]
) -> Array:
    """Return each block's part of the cost (n_blocks,) of given standard parameters."""
    costs = np.zeros(len(blocks))
    for b, part in enumerate(blocks):
        given = part.samples

        def error(span: slice, given: Samples = given) -> Array:
            state = given.q[span], given.qd[span], given.qdd[span]
            return given.tau[span] - parameter_torque(model, drive, chi, *state)[1]

        costs[b] = 0.5 * float(np.sum((weights[:, None] * part.filtered(error)) ** 2))
    return costs


def _blocks(
    model: RobotModel, batches: Sequence[Samples], seconds: float | None, most: int
) -> list[SampleBlock]:
    """Return the time blocks, longer ones where there would be more than so many."""
    found = [*sample_blocks(model, batches, seconds)]
    if len(found) > most:
        time = sum(part.n_outputs * part.seconds for part in found) / sum(
            part.n_outputs for part in found
        )
        found = [*sample_blocks(model, batches, time * len(found) / most)]
    return found


def _differences(shares: Callable[[Array], Array], tilt: Array, here: Array) -> tuple[Array, Array]:
    """Return slopes (n_blocks, 2) and the Hessian (2, 2) of the sum, by central differences."""
    h = RULES.difference
    one, two = np.array([h, 0.0]), np.array([0.0, h])
    ahead, behind = (
        [shares(tilt + step) for step in (one, two)],
        [shares(tilt - step) for step in (one, two)],
    )
    slopes = np.column_stack(
        [(up - down) / (2 * h) for up, down in zip(ahead, behind, strict=True)]
    )
    value = here.sum()
    curved = [
        (up.sum() - 2 * value + down.sum()) / h**2 for up, down in zip(ahead, behind, strict=True)
    ]
    both = shares(tilt + one + two).sum() + shares(tilt - one - two).sum() - 2 * value
    mixed = (both / h**2 - curved[0] - curved[1]) / 2
    return slopes, np.array([[curved[0], mixed], [mixed, curved[1]]])


def _turned(model: RobotModel, axes: Array, tilt: Array) -> RobotModel:
    """Return a robot whose base is turned: gravity turns the other way in its root frame."""
    turn = Rotation.from_rotvec(tilt @ axes)
    return model.with_gravity(turn.inv().apply(np.array(model.gravity)))


def _written(axis: Array) -> str:
    for name, unit in zip("xyz", np.eye(3), strict=True):
        if np.allclose(axis, unit, atol=1e-9):
            return name
    return "(" + ", ".join(f"{value:.2f}" for value in axis) + ")"
