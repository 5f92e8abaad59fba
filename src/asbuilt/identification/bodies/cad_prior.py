"""CAD values: base parameters by design, and a prior with a distance free of frames and units."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.appearance import find_size_units
from asbuilt.description.inertia import LinkInertia, pseudo_inertias
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, parameter_names, parameter_values
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import join_factors

# Hold sizes and weights of a prior where CAD states none.

# Ratio of smallest to total second moment below which a link is flat (a plate 0.3 % thick)
PRIOR_NO_THICKNESS = 1e-5
PRIOR_USUAL_THICKNESS = 1e-3  # Least ratio that a flat link is given
# Total second moment in mass times squared reach below which a link is a point. It then gets the
# moments of a body a quarter as wide as its reach.
PRIOR_POINT_MASS = 1e-9
PRIOR_SMALLEST_REACH = 0.05  # Least size of a link, in the robot's unit of length
# Mass, in the robot's unit, of a link described without mass: consistent, without torque
PRIOR_NEGLIGIBLE = 1e-6
PRIOR_GUESSED_STRENGTH = 0.1  # Weight of a link without CAD values; links with CAD values have 1
# Weight of drive parameters without a scale from data, which matters only if data leave them open
PRIOR_UNSCALED = 1e-6


USUAL_DESIGN_EFFECT = 10.0
"""Samples per independent sample: the median of 14 recordings of four robots."""

PSEUDO_INERTIA_BASIS: Array = pseudo_inertias(np.eye(10))
"""`P = sum_a chi_a basis[a]`, shape (10, 4, 4)."""
PSEUDO_INERTIA_BASIS.setflags(write=False)

SVEC_ROW, SVEC_COLUMN = np.array([(i, j) for j in range(4) for i in range(j + 1)]).T
SVEC_LENGTH: Array = np.where(SVEC_ROW == SVEC_COLUMN, 1.0, np.sqrt(2.0))
"""Entries of a symmetric 4 x 4 matrix in its `svec`, and their factors."""


def svec(matrix: Array) -> Array:
    """Return symmetric 4 x 4 matrices as vectors of the same norm, (..., 4, 4) -> (..., 10).

    Upper triangle by columns, off-diagonal entries times sqrt(2).
    """
    return matrix[..., SVEC_ROW, SVEC_COLUMN] * SVEC_LENGTH


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
    """Hold the prior of n links and their drives.

    Parameters
    ----------
    robot, names
        Name of the robot and of its standard parameters.
    parameters
        Standard parameters (n_standard,), physically consistent; 0 for drives without CAD value.
    strength
        Weight of each link (n,): 1, or less for guessed links.
    reach
        Size of each link [m], shape (n,).
    non_negative
        Columns of drive parameters bounded by zero.
    notes
        What was corrected or guessed.
    mass_ranges
        What is known of masses: links together, counted from 0, with lower and upper limit [kg].
    drive_scale
        Scale of drive parameters (n_standard - 10 n,): by default the CAD value, or 1 without.
    drive_weight
        Weight of drive parameters toward CAD or zero at a distance of `drive_scale`, in squared
        weighted residuals: 1 for a scale that is a standard deviation.
    """

    robot: str
    names: tuple[str, ...]
    parameters: Array
    strength: Array
    reach: Array
    non_negative: NDArray[np.int64]
    notes: tuple[str, ...] = ()
    mass_ranges: tuple[tuple[tuple[int, ...], float, float], ...] = ()
    drive_scale: Array = field(default_factory=lambda: np.zeros(0))
    drive_weight: float = PRIOR_UNSCALED

    def __post_init__(self) -> None:
        if not self.drive_scale.size:
            stated = np.abs(self.parameters[10 * self.n_links :])
            # Frozen: the default depends on other fields.
            object.__setattr__(self, "drive_scale", np.where(stated > 0, stated, 1.0))
        for values in (
            *(self.parameters, self.strength, self.reach),
            *(self.non_negative, self.drive_scale),
        ):
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
        """Hessian of the divergence at CAD with the strength of each link, shape (n, 10, 10).

        `strength_i tr(P_i^-1 B_a P_i^-1 B_b)`, B_a the pseudo-inertias of unit parameters (Lee &
        Park, IEEE RA-L 3, 2018).
        """
        root = body_metric_root(self.parameters[: 10 * self.n_links], self.strength)
        return root.transpose(0, 2, 1) @ root

    def divergence(self, parameters: Array) -> Array:
        """Return `tr(P0^-1 P) - log det(P0^-1 P) - 4` of every link, shape (n,).

        The Bregman divergence of -log det: zero at CAD, infinite for physically inconsistent links,
        the same in all frames and units (Lee, Wensing & Park, IEEE Trans. Robotics 36, 2020,
        eq. 23).
        """
        whitened = self.relative_eigenvalues(parameters)
        # A negative eigenvalue has no logarithm: the divergence is infinite there.
        logarithms = np.log(np.where(whitened > 0, whitened, np.nan))
        value = np.sum(whitened - logarithms - 1.0, axis=1)
        return np.where(np.isnan(value), np.inf, value)

    def relative_eigenvalues(self, parameters: Array) -> Array:
        """Return the eigenvalues of `P0^-1 P` of every link, ascending, shape (n, 4); 1 at CAD."""
        # L^-1 P L^-T has the eigenvalues of P0^-1 P, and is symmetric.
        inverse = np.linalg.inv(np.linalg.cholesky(self.pseudo_inertias))
        P = pseudo_inertias(parameters[: 10 * self.n_links].reshape(-1, 10))
        return np.asarray(np.linalg.eigvalsh(inverse @ P @ inverse.transpose(0, 2, 1)))

    def made_consistent(self, parameters: Array, least: float) -> Array:
        """Return standard parameters whose links are consistent: each as far from CAD as it may be.

        A link stays where its relative eigenvalues are at least `least`, and else comes back along
        the line to CAD until they are.
        """
        smallest = self.relative_eigenvalues(parameters)[:, 0]
        # Along the line to CAD eigenvalues move linearly from `smallest` to 1.
        share = np.minimum(1.0, (1.0 - least) / np.maximum(1.0 - smallest, 1e-300))
        share[smallest >= least] = 1.0
        consistent = np.array(parameters)
        cad = self.parameters[: 10 * self.n_links]
        consistent[: len(cad)] = cad + np.repeat(share, 10) * (consistent[: len(cad)] - cad)
        return consistent


def body_metric_root(parameters: Array, strength: Array) -> Array:
    """Return S_i (n, 10, 10) with `S_i^T S_i` the metric: columns svec(L_i^-1 B_a L_i^-T)."""
    inverse = np.linalg.inv(np.linalg.cholesky(pseudo_inertias(parameters.reshape(-1, 10))))[
        :, None
    ]
    whitened = inverse @ PSEUDO_INERTIA_BASIS @ inverse.transpose(0, 1, 3, 2)
    return np.sqrt(strength)[:, None, None] * svec(whitened).transpose(0, 2, 1)


def build_cad_prior(model: RobotModel, drive: DriveSet) -> CadPrior:
    """Return the CAD values of a robot as a prior, made physically consistent.

    Flat links get a thickness. A link without mass gets its neighbours' mass, a centre between
    its joints and the size of its reach, with a tenth of the weight.
    """
    chi = np.nan_to_num(parameter_values(model, drive), nan=0.0)
    # Damping and friction of a simulator's model are no claim about the drive.
    if not model.drives_by_design:
        chi[10 * model.n_links :] = 0.0
    masses = np.array([link.inertia.mass if link.inertia_known else 0.0 for link in model.links])
    units = find_size_units(model)
    reach = np.empty(model.n_links)
    strength = np.ones(model.n_links)
    notes: list[str] = []
    for i, link in enumerate(model.links):
        points = _list_joint_points(model, i)
        farthest = float(np.max(np.linalg.norm(points, axis=1)))
        reach[i] = max(PRIOR_SMALLEST_REACH * units.length, farthest)
        if masses[i] > 0:
            mass = masses[i]
            com = link.inertia.com
            spread = _second_moment(link.inertia.inertia_about_com)
        elif link.negligible:
            # A frame without mass must stay a body, else the logarithm of its determinant has none.
            mass = PRIOR_NEGLIGIBLE * units.mass
            com = points.mean(axis=0)
            spread = np.zeros((3, 3))
        else:
            mass = _average_neighbouring_mass(model, masses, i)
            com = points.mean(axis=0)
            spread = (
                _second_moment(link.inertia.inertia) if link.inertia_known else np.zeros((3, 3))
            )
            # A guess holds a tenth as much as a CAD value.
            strength[i] = PRIOR_GUESSED_STRENGTH
        eigenvalues, axes = np.linalg.eigh(spread)
        total = float(np.sum(np.maximum(eigenvalues, 0.0)))
        # Eigenvalues of the second moment must all be positive: three of a point are zero.
        if total <= PRIOR_POINT_MASS * mass * reach[i] ** 2:
            corrected = np.full(3, mass * (reach[i] / 4.0) ** 2)
        elif eigenvalues[0] < PRIOR_NO_THICKNESS * total:
            corrected = np.maximum(eigenvalues, PRIOR_USUAL_THICKNESS * total)
        else:
            corrected = eigenvalues
        if masses[i] > 0 and np.array_equal(corrected, eigenvalues):
            # The CAD value itself, without the rounding of an eigenvalue decomposition.
            chi[10 * i : 10 * i + 10] = link.inertia.parameters
            continue
        # I = tr(S) 1 - S about the centre of mass.
        S = (axes * corrected) @ axes.T
        inertia = LinkInertia.from_com(mass, com, np.trace(S) * np.eye(3) - S)
        chi[10 * i : 10 * i + 10] = inertia.parameters
        if masses[i] > 0:
            notes.append(
                f"CAD inertia of {link.name} corrected to be physically consistent"
                f" ({link.inertia.inconsistency() or 'it has no thickness'})"
            )
        # `negligible` links are known to have none, which is no news.
        elif not link.negligible:
            given = f"a mass of {masses[i]:.3g} kg" if masses[i] < 0.0 else "no mass"
            notes.append(
                f"{link.name} has {given} in CAD; {mass:.3g} kg assumed from its neighbours"
            )
    if np.all(masses == 0.0):
        # The notes of all links say the same.
        notes = [f"No link has a mass in CAD; {chi[9]:.3g} kg assumed for each"]
    return CadPrior(
        robot=model.name,
        names=parameter_names(model, drive),
        parameters=chi,
        strength=strength,
        reach=reach,
        non_negative=find_non_negative_columns(model.n_links, model.n_joints, drive),
        notes=tuple(notes),
        drive_scale=_choose_drive_scale(model, drive, chi[10 * model.n_links :]),
        mass_ranges=tuple(
            (tuple(model.link_names.index(name) for name in known.links), known.lower, known.upper)
            for known in model.mass_ranges
        ),
    )


def _choose_drive_scale(model: RobotModel, drive: DriveSet, stated: Array) -> Array:
    """Return the scale of each drive parameter: what is stated, else the robot's unit of it."""
    units = find_size_units(model)
    usual = [
        # A share of the load has no unit.
        1.0 if unit == "1" else units.torque(revolute=joint.is_revolute)
        for joint in model.joints
        for term in drive.terms
        for unit in term.units(revolute=joint.is_revolute)
    ]
    return np.where(np.abs(stated) > 0.0, np.abs(stated), np.array(usual, dtype=np.float64))


def _second_moment(inertia: Array) -> Array:
    return np.asarray(0.5 * np.trace(inertia) * np.eye(3) - inertia)


def _list_joint_points(model: RobotModel, i: int) -> Array:
    """Return origins of the joints and frames of a link in link axes, shape (k, 3)."""
    return np.array(
        [
            # In link axes its joint lies where the placement behind the joint comes from.
            np.linalg.inv(model.moving_joints[i].after)[:3, 3],
            *(joint.before[:3, 3] for joint in model.moving_joints if joint.parent == i),
            *(frame.placement[:3, 3] for frame in model.frames if frame.link == i),
        ]
    )


def _average_neighbouring_mass(model: RobotModel, masses: Array, i: int) -> float:
    near = [masses[k] for k, joint in enumerate(model.moving_joints) if joint.parent == i]
    near += [masses[model.parents[i]]] if model.parents[i] >= 0 else []
    known = [m for m in near if m > 0] or [m for m in masses if m > 0] or [1.0]
    # Geometric mean, as masses of links differ by factors.
    return float(np.exp(np.mean(np.log(known))))


def find_non_negative_columns(n_links: int, n_joints: int, drive: DriveSet) -> NDArray[np.int64]:
    """Return the columns of standard parameters that are non-negative for passive drives."""
    bounded = [term.non_negative for term in drive.terms for _ in term.symbols] * n_joints
    return 10 * n_links + np.flatnonzero(bounded)


def with_drive_scale(prior: CadPrior, information: SquareRootInformation) -> CadPrior:
    """Return a prior whose drive parameters are normal about CAD or zero, at a scale of their own.

    The standard deviation of a parameter of joint k is `tau_k / c`: tau_k the RMS torque of the
    joint, c the RMS of the parameter's column at all joints that have one. With it the drive takes
    the whole torque of its joint in motion as fast as the robot's. Friction and armature are less,
    so a parameter that the data determine keeps its value; one of a joint that hardly moves, whose
    own column is small, stays next to zero. A larger CAD value is the scale itself; joints without
    torque take the scale of the largest torque. Like CAD's, the weight is for independent samples.
    """
    links = 10 * prior.n_links
    n = information.n_joints
    torque = np.sqrt(information.torque_energy / information.n_samples)
    # A joint without torque takes the largest scale: less would hold what nothing says.
    torque = np.where(torque > 0.0, torque, torque.max())
    K = information.base.regrouping[:, links:]
    # Energy of the column of each drive parameter, all joints.
    pairs = zip(information.support, information.joint_factors, strict=True)
    energy = sum(np.sum((R[:, :-1] @ K[support]) ** 2, axis=0) for support, R in pairs).reshape(
        n, -1
    )
    present = np.maximum(np.count_nonzero(energy, axis=0), 1)
    typical = np.sqrt(energy.sum(axis=0) / present / information.n_samples)
    # The parameter alone makes the whole torque of its joint at the motion of a usual one.
    whole = np.divide(torque[:, None], typical, out=np.zeros_like(energy), where=typical > 0.0)
    scale = np.maximum(whole.reshape(-1), np.abs(prior.parameters[links:]))
    scale = np.where(scale > 0.0, scale, prior.drive_scale)
    return replace(prior, drive_scale=scale, drive_weight=USUAL_DESIGN_EFFECT)


def with_drive_rows(factor: Array, base: BaseParameters, prior: CadPrior) -> Array:
    """Return the factor (p + 1, p + 1) of weighted rows and of the prior of drive parameters.

    The prior covers the base parameters that belong to one drive alone.
    """
    first = 10 * prior.n_links
    places = np.flatnonzero(base.columns >= first)
    weight = np.sqrt(prior.drive_weight) / prior.drive_scale[base.columns[places] - first]
    # Rows of the prior beside those of the data: their squares are the quadratic form.
    rows = np.zeros_like(factor)
    rows[places, places] = weight
    rows[places, -1] = weight * prior.parameters[base.columns[places]]
    return join_factors(factor, rows)


def design_values(model: RobotModel, base: BaseParameters) -> Array:
    """Return the base parameters by design, shape (p,), NaN where the description has no value.

    A drive value that the description lacks, or states for a simulator's sake, adds nothing to
    sums with links and is NaN by itself.
    """
    chi = parameter_values(model, base.drive)
    links = 10 * model.n_links
    for i, link in enumerate(model.links):
        if not link.inertia_known:
            chi[10 * i : 10 * i + 10] = np.nan
    silent = np.zeros(len(chi), dtype=bool)
    silent[links:] = np.isnan(chi[links:]) if model.drives_by_design else True
    # Sums of links and drives keep the links' part; a drive by itself has no value.
    values = base.values(np.where(silent, 0.0, chi))
    values[silent[base.columns]] = np.nan
    return values
