"""What CAD says of every body, made into a prior.

Positive definite, with a distance that does not depend on frames or units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia, pseudo_inertias
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.parameters import parameter_names, parameter_values

NO_THICKNESS = 1e-5
"""A body whose smallest principal second moment about the centre of mass is below this fraction of
their sum is no solid: a plate 0.3 % thick;
"""
USUAL_THICKNESS = 1e-3
"""every moment is then brought to at least this fraction."""
POINT_MASS = 1e-9
"""A body whose second moments add up to less than this, in mass times squared reach, is a point.

It gets those of a body a quarter as wide as its reach.
"""
SMALLEST_REACH = 0.05
"""Size [m] of a body whose joints leave it none."""
GUESSED_STRENGTH = 0.1
"""Weight of a guessed body, beside 1 for one that CAD describes."""

PSEUDO_INERTIA_BASIS: Array = pseudo_inertias(np.eye(10))
"""`P = sum_a chi_a basis[a]`, shape (10, 4, 4)."""
PSEUDO_INERTIA_BASIS.setflags(write=False)

SVEC_ROW, SVEC_COLUMN = np.array([(i, j) for j in range(4) for i in range(j + 1)]).T
SVEC_LENGTH: Array = np.where(SVEC_ROW == SVEC_COLUMN, 1.0, np.sqrt(2.0))
"""The entry of a symmetric 4 x 4 matrix that each entry of its `svec` holds, and the factor it
holds it by.
"""


def svec(matrix: Array) -> Array:
    """Return symmetric 4 x 4 matrices as vectors of the same norm, (..., 4, 4) -> (..., 10).

    Upper triangle by columns, off-diagonal entries times sqrt(2).
    """
    return np.asarray(matrix[..., SVEC_ROW, SVEC_COLUMN] * SVEC_LENGTH)


def smat(vector: Array) -> Array:
    """Return the symmetric matrices of vectors, (..., 10) -> (..., 4, 4); the inverse of `svec`."""
    matrix = np.zeros((*vector.shape[:-1], 4, 4))
    matrix[..., SVEC_ROW, SVEC_COLUMN] = matrix[..., SVEC_COLUMN, SVEC_ROW] = vector / SVEC_LENGTH
    return matrix


PSEUDO_INERTIA_SVEC: Array = svec(PSEUDO_INERTIA_BASIS).T
"""`svec(P) = PSEUDO_INERTIA_SVEC @ chi`, shape (10, 10)."""
IDENTITY_SVEC: Array = svec(np.eye(4))


@dataclass(frozen=True, eq=False)
class CadPrior:
    """Hold what is believed of n bodies and their drives before any measurement.

    `parameters` (n_standard,) are the standard parameters, positive definite for every link, 0 for
    drive terms on which CAD is silent; `strength` (n,) is 1 for links that CAD describes and less
    for guessed ones; `reach` (n,) is the size of each link [m]; `non_negative` are the drive
    columns bounded by zero; `notes` say what had to be mended or guessed.
    """

    robot: str
    names: tuple[str, ...]
    parameters: Array
    strength: Array
    reach: Array
    non_negative: NDArray[np.int64]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for values in (self.parameters, self.strength, self.reach, self.non_negative):
            values.setflags(write=False)

    @property
    def n_links(self) -> int:
        """Number of links."""
        return len(self.strength)

    @property
    def pseudo_inertias(self) -> Array:
        """Pseudo-inertias of the links, shape (n, 4, 4), positive definite."""
        return pseudo_inertias(self.parameters[: 10 * self.n_links].reshape(-1, 10))

    @property
    def metric(self) -> Array:
        """Hessian of the divergence at CAD, shape (n, 10, 10).

        `g_ab = tr(P0^-1 B_a P0^-1 B_b)`, with the strength of each link.
        """
        return body_metric(self.parameters[: 10 * self.n_links], self.strength)

    @property
    def drive_scale(self) -> Array:
        """Size against which drive parameters are held, shape (n_standard - 10 n,).

        What CAD says where that is not zero, else 1.
        """
        stated = np.abs(self.parameters[10 * self.n_links :])
        return np.where(stated > 0, stated, 1.0)

    def divergence(self, parameters: Array) -> Array:
        """Return the entropic divergence of every link from CAD, shape (n,).

        `tr(P0^-1 P) - log det(P0^-1 P) - 4`.

        It is the Bregman divergence of -log det, zero at CAD, infinite where a body becomes
        impossible, the same in all frames and units (Lee, Wensing & Park, IEEE Trans. Robotics 36,
        2020, eq. 23). Infinite for what no body has.
        """
        whitened = self.relative_eigenvalues(parameters)
        with np.errstate(divide="ignore", invalid="ignore"):
            value = np.sum(
                whitened - np.log(np.where(whitened > 0, whitened, np.nan)) - 1.0, axis=1
            )
        return np.where(np.isnan(value), np.inf, value)

    def relative_eigenvalues(self, parameters: Array) -> Array:
        """Return the eigenvalues of `P0^-1 P` of every link, ascending, shape (n, 4).

        1 at CAD, all positive for real bodies.
        """
        inverse = np.linalg.inv(np.linalg.cholesky(self.pseudo_inertias))
        P = pseudo_inertias(parameters[: 10 * self.n_links].reshape(-1, 10))
        return np.asarray(np.linalg.eigvalsh(inverse @ P @ inverse.transpose(0, 2, 1)))


def body_metric(parameters: Array, strength: Array) -> Array:
    """Return `strength_i tr(P_i^-1 B_a P_i^-1 B_b)` of every link, shape (n, 10, 10).

    The Hessian of -log det, a metric without frames or units.

    B_a are the pseudo-inertias of the unit parameters (Lee & Park, IEEE RA-L 3, 2018).
    """
    root = body_metric_root(parameters, strength)
    return np.asarray(root.transpose(0, 2, 1) @ root)


def body_metric_root(parameters: Array, strength: Array) -> Array:
    """Return roots S_i (n, 10, 10) of `body_metric`, S_i^T S_i.

    Column a is svec(L_i^-1 B_a L_i^-T) with P_i = L_i L_i^T, so that nothing is squared.
    """
    inverse = np.linalg.inv(np.linalg.cholesky(pseudo_inertias(parameters.reshape(-1, 10))))[
        :, None
    ]
    whitened = inverse @ PSEUDO_INERTIA_BASIS @ inverse.transpose(0, 1, 3, 2)
    return np.asarray(np.sqrt(strength)[:, None, None] * svec(whitened).transpose(0, 2, 1))


def cad_prior(model: RobotModel, drive: DriveSet) -> CadPrior:
    """Return what the description of a robot says of its bodies, mended where it is impossible and
    guessed where it is silent.

    A body without thickness, or less, gets some. A link without mass gets that of its neighbours,
    its centre between its joints, and the size of its reach; guesses count a tenth.
    """
    chi = np.nan_to_num(parameter_values(model, drive), nan=0.0)
    if not model.drives_by_design:
        chi[10 * model.n_joints :] = 0.0
    masses = np.array([link.inertia.mass if link.inertia_known else 0.0 for link in model.links])
    reach = np.empty(model.n_joints)
    strength = np.ones(model.n_joints)
    notes: list[str] = []
    for i, link in enumerate(model.links):
        points = _joint_points(model, i)
        reach[i] = max(SMALLEST_REACH, float(np.max(np.linalg.norm(points, axis=1))))
        if masses[i] > 0:
            mass, com = masses[i], link.inertia.com
            spread = _second_moment(link.inertia.inertia_about_com)
        else:
            mass, com = _neighbouring_mass(model, masses, i), points.mean(axis=0)
            spread = (
                _second_moment(link.inertia.inertia) if link.inertia_known else np.zeros((3, 3))
            )
            strength[i] = GUESSED_STRENGTH
        eigenvalues, axes = np.linalg.eigh(spread)
        total = float(np.sum(np.maximum(eigenvalues, 0.0)))
        if total <= POINT_MASS * mass * reach[i] ** 2:
            mended = np.full(3, mass * (reach[i] / 4.0) ** 2)
        elif eigenvalues[0] < NO_THICKNESS * total:
            mended = np.maximum(eigenvalues, USUAL_THICKNESS * total)
        else:
            mended = eigenvalues
        if masses[i] <= 0:
            given = f"an impossible mass of {masses[i]:.3g} kg" if masses[i] < 0.0 else "no mass"
            notes.append(
                f"CAD gives {link.name} {given}: {mass:.3g} kg guessed from its neighbours"
            )
        elif np.any(mended != eigenvalues):
            notes.append(
                f"CAD gives {link.name} an inertia of no solid body; mended"
                f" ({link.inertia.inconsistency() or 'it has no thickness'})"
            )
        if masses[i] > 0 and np.array_equal(mended, eigenvalues):
            chi[10 * i : 10 * i + 10] = link.inertia.parameters
        else:
            S = (axes * mended) @ axes.T
            chi[10 * i : 10 * i + 10] = LinkInertia.from_com(
                mass, com, np.trace(S) * np.eye(3) - S
            ).parameters
    return CadPrior(
        robot=model.name,
        names=parameter_names(model, drive),
        parameters=chi,
        strength=strength,
        reach=reach,
        non_negative=non_negative_columns(model.n_joints, drive),
        notes=tuple(notes),
    )


def _second_moment(inertia: Array) -> Array:
    return np.asarray(0.5 * np.trace(inertia) * np.eye(3) - inertia)


def _joint_points(model: RobotModel, i: int) -> Array:
    """Origins of the link's own joint, of the joints it carries and of the frames on it, in link
    axes, shape (k, 3).
    """
    points = [np.linalg.inv(model.joints[i].after)[:3, 3]]
    points += [joint.before[:3, 3] for joint in model.joints if joint.parent == i]
    points += [frame.placement[:3, 3] for frame in model.frames if frame.link == i]
    return np.array(points)


def _neighbouring_mass(model: RobotModel, masses: Array, i: int) -> float:
    near = [masses[k] for k, joint in enumerate(model.joints) if joint.parent == i] + [
        masses[j] for j in (model.joints[i].parent,) if j >= 0
    ]
    known = [m for m in near if m > 0] or [m for m in masses if m > 0] or [1.0]
    return float(np.exp(np.mean(np.log(known))))


def non_negative_columns(n_joints: int, drive: DriveSet) -> NDArray[np.int64]:
    """Return the standard parameters of drives that no passive drive has below zero, as columns of
    the standard regressor.
    """
    bounded = [term.non_negative for term in drive.terms for _ in term.symbols] * n_joints
    return 10 * n_joints + np.flatnonzero(bounded)
