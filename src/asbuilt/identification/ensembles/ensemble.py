"""Draws of a robot from the joint uncertainty of its result, physically consistent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics import BaseParameters, PositionServo, parameter_names, parameter_units
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import IdentifiabilityError, InertiaError, UsageError
from asbuilt.executor import Workers, run_in_order
from asbuilt.findings import Cure, join_names
from asbuilt.identification.bodies.body_bounds import bound_generously
from asbuilt.identification.bodies.cad_prior import CadPrior, build_cad_prior
from asbuilt.identification.bodies.entropic_path import TO_THE_DATA, EntropicPath
from asbuilt.identification.information.triangular import factor_distance
from asbuilt.identification.result.as_built_parameters import (
    as_built_parameters,
    scale_covariance,
)
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.servo.servo_rows import ServoErrors
from asbuilt.identification.uncertainty.block_scatter import FEWEST_DEGREES, mean_degrees, widening

FAITHFUL = 0.1
"""Distance of a fit from its draw, in standard errors, that changes no distribution; and share of
its distance by which the robot next to an impossible draw may be farther."""
AT_ONCE = 50
"""Draws that are fitted together, whoever does it, so that the numbers do not depend on that."""


Seed = np.random.Generator | int | None
QUANTILES = (0.05, 0.5, 0.95)
"""Quantiles of the range of a parameter."""
UNLIKE = 2.5
"""Factor of the mass of a link from which a range is unlike CAD; own choice."""
MOST = 100_000


def make_draws_consistent(
    cad: CadPrior,
    base: BaseParameters,
    drawn: Array,
    information_root: Array,
    *,
    workers: Workers | None = None,
) -> tuple[Array, Array]:
    """Return the consistent parameters next to many draws, and their chi-squares.

    Draw i is `min |R (K chi - beta_i)|^2 / 2 + weight D(chi || CAD)` with the largest weight of CAD
    at which it is not a tenth of a standard error, or of its distance, farther from its draw than
    without CAD. Where physics does not allow a draw (a negative friction, an impossible link), the
    nearest possible one takes its place. What the recordings do not determine stays at CAD.

    Parameters
    ----------
    cad, base
        CAD values, and the base parameters.
    drawn
        Base parameters (N, p).
    information_root
        R (r, p) with `R^T R` the inverse covariance.
    workers
        Share the parts, to the same bits; None: this process.

    Returns
    -------
    tuple
        Standard parameters (N, n_standard), and chi-squares `|R (K chi - beta_i)|^2` (N,).

    Raises
    ------
    IdentifiabilityError
        If no fit converges.
    """
    parts = np.split(drawn, range(AT_ONCE, len(drawn), AT_ONCE))
    fit = partial(_fit_draws, cad, base, information_root)
    chi, chi_square = zip(*run_in_order(fit, parts, workers), strict=True)
    return np.concatenate(chi), np.concatenate(chi_square)


@use_one_blas_thread()
def _fit_draws(
    cad: CadPrior, base: BaseParameters, information_root: Array, drawn: Array
) -> tuple[Array, Array]:
    """Return the consistent parameters next to the draws of a part, and their chi-squares."""
    factors = np.stack([factor_distance(information_root, beta) for beta in drawn])
    fits = list[Array]()
    distances = list[Array]()
    path = EntropicPath(cad, base, bound_generously(cad))
    for weight in TO_THE_DATA:
        try:
            chi = path.fit_unbarred(factors, weight)
        except IdentifiabilityError:
            continue
        moved = (chi @ base.regrouping.T - drawn) @ information_root.T
        fits.append(chi)
        distances.append(np.linalg.norm(moved, axis=1))
        if np.max(distances[-1]) <= FAITHFUL:
            break
    if not fits:
        raise IdentifiabilityError(
            f"no physically consistent parameters of {base.robot} were found for the draws"
        )
    distance = np.stack(distances)
    nearest = distance.min(axis=0)
    first = np.argmax(distance <= nearest + FAITHFUL * np.maximum(nearest, 1.0), axis=0)
    place = first, np.arange(len(drawn))
    return np.stack(fits)[place], distance[place] ** 2


@dataclass(frozen=True, slots=True, eq=False)
class DrawnGains:
    """Hold N draws of a position servo, in columns beside those of the robot; none for torques.

    Attributes
    ----------
    names, units, joints
        Names of the columns, `kp1 ... kd1 ... delay`, their units, and the joint of each, "all" of
        the delay.
    table
        The columns of every draw, shape (N, columns).
    middle
        The same as identified, shape (columns,).
    servo
        The servo as identified; None where torques were measured.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    joints: tuple[str, ...]
    table: Array
    middle: Array
    servo: PositionServo | None

    def law(self, draw: int) -> PositionServo | None:
        """Return the servo of a draw, counted from 0; None where torques were measured."""
        if self.servo is None:
            return None
        *gains, delay = self.table[draw].tolist()
        n = len(self.servo.kp)
        return replace(self.servo, kp=tuple(gains[:n]), kd=tuple(gains[n:]), delay=delay)


def draw_gains(
    result: IdentificationResult, n: int, random: np.random.Generator
) -> tuple[DrawnGains, Array | None, list[str]]:
    """Draw the servo of a result: stiffness and delay with their errors, damping as identified.

    Returns the draws, factors (N, 1 or n) by which the torques of joints follow the stiffness,
    None where torques were measured, and what the draws leave out.
    """
    servo = result.servo
    if servo is None:
        return DrawnGains((), (), (), np.empty((n, 0)), np.empty(0), None), None, []
    errors = result.servo_errors or ServoErrors()
    kp, kd = np.nan_to_num([servo.kp, servo.kd])
    factors, notes = _draw_stiffness(result, kp, errors, n, random)
    delay = servo.delay or 0.0
    late = np.maximum(delay + errors.delay * random.normal(size=n), 0.0)
    if errors.lead:
        notes.append(
            "the lead of the servo is the identified one in every draw; its standard error is"
            f" {1e3 * errors.lead:.2g} ms"
        )
    turning = [joint.is_revolute for joint in result.model.joints]
    numbers = range(1, len(kp) + 1)
    drawn = DrawnGains(
        (*(f"kp{k}" for k in numbers), *(f"kd{k}" for k in numbers), "delay"),
        (
            *("N m/rad" if revolute else "N/m" for revolute in turning),
            *("N m s/rad" if revolute else "N s/m" for revolute in turning),
            "s",
        ),
        (*result.joint_names, *result.joint_names, "all"),
        np.column_stack([kp * factors, np.tile(kd, (n, 1)), late]),
        np.concatenate([kp, kd, [delay]]),
        servo,
    )
    return drawn, factors, notes


def _draw_stiffness(
    result: IdentificationResult,
    kp: Array,
    errors: ServoErrors,
    n: int,
    random: np.random.Generator,
) -> tuple[Array, list[str]]:
    """Return factors of the stiffness kp (n_joints,), (N, 1 or n_joints), and notes."""
    joints = result.model.n_joints
    error = np.array(errors.kp) if errors.kp else np.zeros(joints)
    relative = np.divide(error, kp, out=np.zeros(joints), where=kp > 0)
    unknown = ~np.isfinite(relative)
    relative[unknown] = 0.0
    factors = np.exp(relative * random.normal(size=(n, 1 if errors.shared else joints)))
    if not np.any(unknown):
        return factors, []
    names = [result.joint_names[k] for k in np.flatnonzero(unknown)]
    note = (
        f"the stiffness of the servo of {join_names(names)} is undetermined: every draw has the"
        " same one, and only ratios to it mean something"
    )
    return factors, [note]


@dataclass(frozen=True, slots=True, eq=False)
class Ensemble:
    """Hold N robots that a result allows, equally probable.

    Attributes
    ----------
    result
        The result.
    parameters
        Standard parameters of the links and drives, shape (N, n_standard).
    centre
        The same of the estimates themselves, made as every draw is, shape (n_standard,).
    gains
        What was drawn of the law that made torques of commands; empty where they were measured.
    chi_square
        Squared distance (N,) of each robot from the draw that it stands for, in standard errors:
        large where the draw was physically impossible.
    notes
        What the draws leave out.
    """

    result: IdentificationResult
    parameters: Array
    centre: Array
    gains: DrawnGains
    chi_square: Array
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns of `table`: `Ixx1 ... m1 ... Ia1 Fv1 ... kp1 ... delay`."""
        model = self.result.model
        return (*parameter_names(model, self.result.base.drive), *self.gains.names)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the columns of `table`."""
        model = self.result.model
        return (*parameter_units(model, self.result.base.drive), *self.gains.units)

    @property
    def table(self) -> Array:
        """Every parameter of every robot, shape (N, columns)."""
        return np.column_stack([self.parameters, self.gains.table])

    @property
    def middle(self) -> Array:
        """The same of the estimates themselves, shape (columns,)."""
        return np.concatenate([self.centre, self.gains.middle])

    @property
    def quantiles(self) -> Array:
        """The 5, 50 and 95 % quantiles of each column, shape (3, columns)."""
        return np.quantile(self.table, QUANTILES, axis=0)

    @property
    def moved(self) -> int:
        """Number of draws that were physically impossible, so that the nearest robot stands in."""
        return count_impossible(self.chi_square)


def draw_ensemble(
    result: IdentificationResult, n: int, *, rng: Seed = None, workers: Workers | None = None
) -> Ensemble:
    """Draw robots from the joint uncertainty of a result.

    Base parameters are drawn from `N(estimates, covariance)`, and if few time blocks gave the
    covariance from Student's distribution with their degrees of freedom. Where commands made the
    torques, `draw_gains` draws their law, and parameters follow the torque scale that it gives: all
    of them if the joints share it, else the parameters of the joint's drive, since the links have
    their scale from CAD. Every draw becomes
    a physically consistent robot (`make_draws_consistent`), with friction and armature not below
    zero.

    Parameters
    ----------
    result
        The identified robot.
    n
        Number of robots.
    rng
        Seed or generator.
    workers
        Workers of `open_workers` that make the draws consistent, to the same bits; None: this
        process.

    Raises
    ------
    UsageError
        If n is not from 1 to 100 000, or the result has dropped parameters, without errors.
    InertiaError
        If the identified parameters are physically inconsistent.
    """
    if not 1 <= n <= MOST:
        raise UsageError(f"an ensemble has 1 to {MOST} robots, got {n}", value=n)
    if np.any(result.dropped):
        raise UsageError(
            f"the method {result.method!r} set parameters to zero and gives them no errors to draw"
            " from",
            cure=Cure("identify with a method that keeps all parameters", {"method": "auto"}),
        )
    if not as_built_parameters(result).consistent:
        raise InertiaError(
            f"no ensemble of {result.robot} is drawn: its parameters are physically inconsistent",
            cure=Cure("identify with physical consistency", {"method": "consistent"}),
        )
    random = np.random.default_rng(rng)
    covariance = scale_covariance(result)
    drawn = result.estimates + _draw_tails(result, n, random)[:, None] * (
        random.normal(size=(n, covariance.rank)) @ covariance.root
    )
    gains, factors, notes = draw_gains(result, n, random)
    if factors is not None:
        drawn = _scale_draws(result, drawn, factors)
    root = covariance.inverse_root.T
    prior = build_cad_prior(result.model, result.base.drive)
    chi, chi_square = make_draws_consistent(
        prior, result.base, np.vstack([result.estimates, drawn]), root, workers=workers
    )
    centre = chi[0]
    chi = chi[1:]
    chi_square = chi_square[1:]
    if any(term.nonlinear for term in result.base.drive.terms):
        notes.append("nonlinear parameters of drive terms are the identified ones in every draw")
    if far := count_impossible(chi_square):
        notes.append(
            f"{far} of {n} draws were physically impossible; the nearest possible robot stands for"
            " each"
        )
    notes += _note_odd_masses(result, chi)
    return Ensemble(result, chi, centre, gains, chi_square, tuple(notes))


def count_impossible(chi_square: Array) -> int:
    """Return how many draws are more than a standard error from any possible robot."""
    return int(np.sum(chi_square > 1.0))


def _note_odd_masses(result: IdentificationResult, drawn: Array) -> list[str]:
    """Return a note on links whose mass in the draws (N, n_standard) is far from its CAD value."""
    masses = np.quantile(drawn[:, 9 : 10 * result.model.n_links : 10], QUANTILES, axis=0)
    cad = [link.inertia.mass for link in result.model.links]
    unlike = [
        f"{link.name} {low:.3g} to {high:.3g} kg, CAD {mass:.3g} kg"
        for link, mass, (low, _, high) in zip(result.model.links, cad, masses.T, strict=True)
        if link.has_mass and (high > UNLIKE * mass or low < mass / UNLIKE)
    ]
    if not unlike:
        return []
    return [
        "the recordings allow masses unlike CAD's (5 to 95 % of the draws):"
        f" {'; '.join(unlike)}. Give masses that are known, or record more motion"
    ]


def _draw_tails(result: IdentificationResult, n: int, random: np.random.Generator) -> Array:
    """Return the factor of each draw (N,) that makes a normal distribution Student's.

    Standard errors of nu degrees of freedom are wider than the estimate's, so that 1.96 of them
    hold 95 % of Student's distribution. The 5 and 95 % quantiles of a normal distribution of
    that width are 7 % too far out with five.
    """
    nu = max(mean_degrees(result.degrees_of_freedom), FEWEST_DEGREES)
    if not np.isfinite(nu):
        return np.ones(n)
    return np.sqrt(nu / random.chisquare(nu, n)) / widening(np.array([nu]))


def _scale_draws(result: IdentificationResult, drawn: Array, factors: Array) -> Array:
    """Return draws of base parameters that follow the torque scale of the joints."""
    if np.all(factors == factors[:, :1]):
        return drawn * factors[:, :1]
    columns = np.asarray(result.base.columns)
    links = 10 * result.model.n_links
    scaled = drawn.copy()
    of_drive = columns >= links
    joints = (columns[of_drive] - links) // result.base.drive.columns_per_joint
    scaled[:, of_drive] *= factors[:, joints]
    return scaled
