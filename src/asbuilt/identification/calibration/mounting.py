"""How the robot stands: the direction of gravity in its root frame, found along with its bodies."""

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
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.identification.bodies.body_bounds import BodyBounds, generous_bounds
from asbuilt.identification.bodies.cad_prior import CadPrior, cad_prior
from asbuilt.identification.bodies.conic_fit import fit_consistent_bodies
from asbuilt.identification.estimators.consistent_fit import ConsistentEstimate, fit_consistent
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
)

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


SEARCHES = ((20e-3, 2e-3), (4e-3, 1e-4))
"""First steps and last ones [rad] of the two searches, the second with joint weights settled by the
first.
"""
MOST_TRIES = 80
DIFFERENCE = 4e-3
"""Tilt [rad] by which costs are differenced for the errors."""
FARTHEST = 0.35
"""A robot on a wall or a ceiling must be described so.

This tilt [rad] is as far as the search goes.
"""
SIGNIFICANT = 4.0
"""A tilt counts where it exceeds so many standard errors,"""
NOTICEABLE = 1e-3
"""and this angle [rad]: the better part of what a floor is level to."""


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Hold how a robot was found to stand.

    `tilt` (2,) [rad] turns gravity about `axes` (2, 3) of the root frame; `gravity` (3,) is the
    turned one.

    `covariance` (2, 2) allows for residuals that are alike within a time block. `rms_as_given` and
    `rms` (n,) are the torque residuals of the best real bodies, standing as described and as found.
    `is_tilted` says whether the tilt is more than its error and more than a floor's.
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
        """Angle between gravity as described and as found [rad]."""
        return float(np.linalg.norm(self.tilt))

    @property
    def is_tilted(self) -> bool:
        """Whether the robot stands otherwise than described."""
        z = (
            float(self.tilt @ np.linalg.solve(self.covariance, self.tilt))
            if np.all(np.diag(self.covariance) > 0)
            else np.inf
        )
        return self.angle > NOTICEABLE and z > SIGNIFICANT**2

    @property
    def relief(self) -> float:
        """Part of the torque residual of the best real bodies, joints together, that standing as
        found takes away.
        """
        before = float(np.linalg.norm(self.rms_as_given))
        return 1.0 - float(np.linalg.norm(self.rms)) / before if before > 0.0 else 0.0

    @property
    def model(self) -> RobotModel:
        """The robot standing as found; as described where that is not askew."""
        return self.as_given.with_gravity(self.gravity) if self.is_tilted else self.as_given

    @property
    def sentence(self) -> str:
        """Say how the robot stands."""
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
                f"gravity is turned by {turned} from where the description has it: the robot stands"
                f" askew; torque residual {before:.3g} -> {after:.3g} N m"
            )
        return (
            f"gravity points where the description has it: turned by {turned}, which is not told"
            " from nothing"
        )


def find_mounting(
    model: RobotModel,
    samples: Samples | Sequence[Samples],
    *,
    drive: DriveSet = NO_DRIVE,
    block_seconds: float | None = None,
) -> Mounting:
    """Find the direction of gravity in the root frame, near that of the description, from the
    samples of a recording.

    Least torque error over direction and real bodies: `V(theta) = min_chi |w (tau - W_theta K
    chi)|^2 / 2` with bodies as in `fit_consistent`, which alone keeps a tilt and impossible
    inertias apart. A simplex search on V (variable projection: Golub & Pereyra, Inverse Problems
    19, 2003), whose second derivatives jump where bodies reach their bounds; K is the same for all
    directions that are not special. Drive terms that depend on the load are left out. The
    covariance is `H^-1 (sum_b g_b g_b^T) H^-1` with the slopes g_b of the blocks' shares in V along
    the fitted bodies and the Hessian H of V, by differences.

    Raises
    ------
    IdentifiabilityError
        If the samples do not tell the direction, or it is far from that of the description.
    UsageError
        If there are no samples, or the description has no gravity.
    """
    batches = list(samples) if isinstance(samples, Sequence) else [samples]
    strength = float(np.linalg.norm(model.gravity))
    if not batches or strength == 0.0:
        raise UsageError(
            f"finding how {model.name} stands takes samples and a description with gravity; got"
            f" {len(batches)} batches, {strength:g} m/s^2"
        )
    drive = DriveSet(tuple(term for term in drive.terms if not term.needs_load))
    axes = axes_across(model.gravity)
    base = find_base_parameters(_turned(model, axes, np.array([0.07, 0.11])), drive)
    prior = cad_prior(model, drive)
    bounds = generous_bounds(prior)

    def information(tilt: Array) -> SquareRootInformation:
        return accumulate_stream(
            _turned(model, axes, tilt), base, batches, block_seconds=block_seconds
        )

    def shares(tilt: Array, weights: Array) -> Array:
        told = information(tilt)
        chi = fit_consistent_bodies(
            prior, base.regrouping, factor=told.stacked(weights), bounds=bounds
        ).chi
        return _shares(told, base, weights, chi)

    def cost(tilt: Array, weights: Array) -> float:
        return float(shares(tilt, weights).sum())

    tilt = np.zeros(2)
    with one_blas_thread():
        fit, as_given = _settled(information(tilt), prior, bounds)
        for first, last in SEARCHES:
            found = minimize(
                cost,
                tilt,
                args=(fit.weights,),
                method="Nelder-Mead",
                bounds=[(-FARTHEST, FARTHEST)] * 2,
                options={
                    "initial_simplex": (
                        tilt + first * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
                    ),
                    "xatol": last,
                    "fatol": 1e-2,
                    "maxfev": MOST_TRIES,
                },
            )
            tilt = np.asarray(found.x)
            told = information(tilt)
            fit, rms = _settled(told, prior, bounds)
        if np.max(np.abs(tilt)) > 0.99 * FARTHEST:
            raise IdentifiabilityError(
                f"gravity in the root frame of {model.name} lies more than"
                f" {np.rad2deg(FARTHEST):.0f} deg from where the description has it; describe how"
                " the robot stands"
            )
        here = _shares(told, base, fit.weights, fit.standard)
        slopes, hessian = _differences(lambda other: shares(other, fit.weights), tilt, here)
        if np.linalg.eigvalsh(hessian)[0] <= 0.0:
            raise IdentifiabilityError(
                f"the recordings of {model.name} do not tell how it stands: the torque error has no"
                " distinct least value over the tilt; move joints whose axes are not parallel to"
                " gravity through their range"
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


def _shares(
    information: SquareRootInformation, base: BaseParameters, weights: Array, chi: Array
) -> Array:
    """Return each block's share in the cost, shape (n_blocks,)."""
    residual = np.append(-(base.regrouping @ chi), 1.0)
    errors = [information.block_stacked(b, weights) @ residual for b in range(information.n_blocks)]
    return np.array([0.5 * float(error @ error) for error in errors])


def _differences(shares: Callable[[Array], Array], tilt: Array, here: Array) -> tuple[Array, Array]:
    """Return the slopes of the blocks' shares (n_blocks, 2) and the Hessian (2, 2) of their sum, by
    central differences.
    """
    h = DIFFERENCE
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
    return model.with_gravity(Rotation.from_rotvec(tilt @ axes).apply(np.array(model.gravity)))


def _written(axis: Array) -> str:
    for name, unit in zip("xyz", np.eye(3), strict=True):
        if np.allclose(axis, unit, atol=1e-9):
            return name
    return "(" + ", ".join(f"{value:.2f}" for value in axis) + ")"
