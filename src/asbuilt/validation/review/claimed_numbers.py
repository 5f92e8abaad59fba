"""Numbers that a description claims of links and drives, and what a recording says of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import LinkInertia, RobotModel
from asbuilt.dynamics import DriveSet, parameter_units, parameter_values
from asbuilt.scaled import Scaled
from asbuilt.validation.comparison.cad_tolerance import CadTolerance

DRIVE_WORDS = {"armature": "armature", "viscous": "damping", "coulomb": "friction loss"}
"""What simulators call the parameter of a drive term."""
ClaimStatus = Literal["supported", "contradicted", "undetermined"]
AXES = "xyz"
UPPER = tuple((a, b) for a in range(3) for b in range(a, 3))
WIDEST = 1e3
"""Standard deviation, in its size, of a number that nothing holds."""
UNTOUCHED = 1e-9
"""Part of the variance by which the recording must reduce what is plausible to say anything."""
LOOSE = 100.0
"""Factor by which a number is less held while its aliases are searched."""
ALIKE = 0.5
"""Correlation of two numbers from which one is an alias of the other."""
MOST_ALIASES = 3
_Number = tuple[str, str, float, float, float, Array]


@dataclass(frozen=True, slots=True)
class Claim:
    """Hold the verdict on one number of a description.

    Attributes
    ----------
    what, joint, unit
        What it is, of which joint (or of the link that this joint moves).
    claimed
        The number in the description.
    estimate, std_error
        What the recording says, with nothing that pulls it to the claim; None where it says
        nothing.
    verdict
        Supported, contradicted, or undetermined.
    alias_of
        Numbers that could take its place: the torque determines them together only.
    torque
        RMS torque of the difference on the recording, over all joints [N m]; None if unknown.
    p_value, false_discovery
        Probability of as large a difference by chance, and the same for as many tests.
    alike
        Whether the estimate is within a tenth of the claim.
    note
        What else there is to say.
    """

    what: str
    joint: str
    unit: str
    claimed: float
    estimate: float | None = None
    std_error: float | None = None
    verdict: ClaimStatus = "undetermined"
    alias_of: tuple[str, ...] = ()
    torque: float | None = None
    p_value: float | None = None
    false_discovery: float | None = None
    alike: bool = False
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ClaimedNumber:
    """Hold one number of a description.

    Attributes
    ----------
    what, joint, unit
        What it is, of which joint (or of the link that this joint moves).
    claimed
        The value; NaN where the description is silent.
    size
        What its error is compared with: its magnitude, for a centre the radius of
        gyration, for an inertia the mean moment.
    spread
        Plausible standard deviation of its error; infinite for drive parameters.
    column
        Change of the standard parameters with the number, shape (n_standard,).
    """

    what: str
    joint: str
    unit: str
    claimed: float
    size: float
    spread: float
    column: Array


def list_claimed_numbers(
    model: RobotModel, drive: DriveSet, tolerance: CadTolerance
) -> tuple[ClaimedNumber, ...]:
    """Return the numbers of links and drives, those included on which the description is silent.

    The numbers of a link are its mass, its centre [m] and its inertia about the centre [kg m^2] in
    the axes of its frame; a link without mass properties has its ten standard parameters, which
    nothing holds.
    """
    found: list[ClaimedNumber] = []
    count = 10 * model.n_links + drive.columns_per_joint * model.n_joints
    for i, (link, joint) in enumerate(zip(model.links, model.moving_joints, strict=True)):
        numbers = (
            _list_link_numbers(link.inertia, tolerance)
            if link.has_mass
            else [("unknown", "", np.nan, 1.0, np.inf, change) for change in np.eye(10)]
        )
        for what, unit, claimed, size, spread, change in numbers:
            column = np.zeros(count)
            column[10 * i : 10 * i + 10] = change
            found.append(ClaimedNumber(what, joint.name, unit, claimed, size, spread, column))
    return (*found, *_list_drive_numbers(model, drive, count))


def _list_link_numbers(inertia: LinkInertia, tolerance: CadTolerance) -> list[_Number]:
    """Return mass, centre and inertia of a link with their changes of its parameters (10,)."""
    m = inertia.mass
    c = inertia.com
    about = inertia.inertia_about_com
    one = np.eye(3)
    # A point mass has no moment to compare with.
    moment = max(float(np.trace(about)), 1e-12)
    gyration = float(np.sqrt(moment / (2.0 * m)))
    # d(inertia, first moment, mass) / d mass at a constant centre and inertia about it.
    change = _pack_change((c @ c) * one - np.outer(c, c), c, 1.0)
    found: list[_Number] = [("mass", "kg", m, m, tolerance.mass * m, change)]
    for k, e in enumerate(one):
        # Parallel axes: m (2 c_k 1 - e c^T - c e^T) per shift of the centre.
        turned = m * (2.0 * c[k] * one - np.outer(e, c) - np.outer(c, e))
        change = _pack_change(turned, m * e, 0.0)
        spread = tolerance.centre * gyration
        found.append((f"centre {AXES[k]}", "m", float(c[k]), gyration, spread, change))
    for a, b in UPPER:
        entry = np.zeros((3, 3))
        entry[a, b] = entry[b, a] = 1.0
        change = _pack_change(entry, np.zeros(3), 0.0)
        spread = tolerance.inertia * moment / 3.0
        what = f"inertia {AXES[a]}{AXES[b]}"
        claimed = float(about[a, b])
        found.append((what, "kg m^2", claimed, moment / 3.0, spread, change))
    return found


def _pack_change(inertia: Array, first_moment: Array, mass: float) -> Array:
    return np.array([*(inertia[a, b] for a, b in UPPER), *first_moment, mass])


def _list_drive_numbers(model: RobotModel, drive: DriveSet, count: int) -> list[ClaimedNumber]:
    values = parameter_values(model, drive)
    units = parameter_units(model, drive)
    words = [
        DRIVE_WORDS.get(term.key, f"{term.key} {symbol}")
        for term in drive.terms
        for symbol in term.symbols
    ]
    found = []
    for j, (joint, what) in enumerate(product(model.joints, words), start=10 * model.n_links):
        claimed = float(values[j])
        column = np.eye(1, count, j)[0]
        # A claim of zero has no size of its own: one unit stands for it.
        size = abs(claimed) if np.isfinite(claimed) and claimed else 1.0
        found.append(ClaimedNumber(what, joint.name, units[j], claimed, size, np.inf, column))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Hold k numbers, each estimated with nothing that pulls it to its claimed value.

    `change` (k,) is estimate minus claim, `std_error` (k,) infinite where the recording says
    nothing, `aliases` the places of the numbers that could take its place, `misfit` the root mean
    square of what no plausible numbers explain, in standard errors (Birge, Phys. Rev. 40, 1932).
    """

    change: Array
    std_error: Array
    aliases: tuple[tuple[int, ...], ...]
    misfit: float


def profile_numbers(
    numbers: Sequence[ClaimedNumber], regrouping: Array, difference: Array, covariance: Array
) -> Profile:
    """Estimate each number, the others free within what is plausible.

    With `J` the changes of the base parameters with the numbers and `S` the plausible variances,
    the numbers follow from `(J^T C^-1 J + S^-1) x = J^T C^-1 d`. Without its own row of `S^-1`, a
    number has the estimate `x_j / (1 - P_jj / S_jj)` and the variance `P_jj / (1 - P_jj / S_jj)`,
    `P` the inverse of the matrix (Sherman & Morrison, Annals of Math. Statistics 21, 1950).

    Parameters
    ----------
    numbers
        The numbers, k of them.
    regrouping
        Of the base parameters that are used, shape (p, n_standard).
    difference
        Base parameters as built minus claimed, shape (p,).
    covariance
        Theirs, shape (p, p), positive definite.
    """
    size = np.array([number.size for number in numbers])
    spread = np.minimum(np.array([number.spread for number in numbers]) / size, WIDEST)
    J = regrouping @ np.column_stack([number.column for number in numbers]) * size
    # Raised by a little, so that directions without error do not decide alone.
    errors = Scaled(covariance).raised()
    A = errors.whiten(J)
    d = errors.whiten(difference)
    P = _invert_information(A, spread)
    x = P @ (A.T @ d)
    held = spread < WIDEST
    # 1 - P_jj / S_jj is what the recording adds to the plausible.
    kept = np.where(held, 1.0 - np.diag(P) / spread**2, 1.0)
    determined = kept > UNTOUCHED
    part = np.where(determined, kept, 1.0)
    variance = np.where(determined, np.diag(P) / part, np.inf)
    # A free number that stays as wide as its bound is held by that bound alone.
    variance[~held & (np.diag(P) > 0.25 * WIDEST**2)] = np.inf
    left = d - A @ x
    # Numbers without bounds spend degrees of freedom; plausible ones bring their own.
    freedom = max(len(d) - int(np.sum(~held)), 1)
    chi_square = float(left @ left + np.sum((x / spread)[held] ** 2))
    # Birge: errors grow where plausible numbers do not explain the rest.
    misfit = max(1.0, np.sqrt(chi_square / freedom))
    return Profile(
        np.where(determined, x / part, np.nan) * size,
        np.sqrt(variance) * size * misfit,
        tuple(_find_aliases(P, np.where(held, 1.0 / spread**2, 0.0), j) for j in range(len(size))),
        misfit,
    )


def _invert_information(A: Array, spread: Array) -> Array:
    """Return `(A^T A + diag(spread)^-2)^-1`, by the singular values of `A diag(spread)`."""
    _, s, Vt = np.linalg.svd(A * spread, full_matrices=True)
    # Directions that the recording does not see keep the plausible variance.
    left = np.ones(len(spread))
    left[: len(s)] = 1.0 / (1.0 + s**2)
    return np.asarray((Vt.T @ (left[:, None] * Vt)) * np.outer(spread, spread))


def _find_aliases(P: Array, weight: Array, j: int) -> tuple[int, ...]:
    """Return the numbers most correlated with number j where it is held `LOOSE` times less."""
    # Sherman and Morrison: row j of S^-1 made weaker by LOOSE squared.
    released = weight[j] * (1.0 - LOOSE**-2)
    kept = 1.0 - released * P[j, j]
    variance = np.diag(P) + P[j] ** 2 * released / kept
    correlation = np.abs(P[j] / kept) / np.sqrt(np.maximum(variance * P[j, j] / kept, 1e-300))
    correlation[j] = 0.0
    return tuple(int(k) for k in np.argsort(-correlation)[:MOST_ALIASES] if correlation[k] >= ALIKE)
