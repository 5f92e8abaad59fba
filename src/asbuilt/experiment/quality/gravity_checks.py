"""Gravity in the torques: whether they follow it wholly, in part or not at all, and its direction.

What the description lacks is asked after this: without gravity in the log, a payload, springs and
balancers take away the gravity of masses that accelerations need.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import USUAL_GRAVITY
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.quality.conventions import DOUBTFUL
from asbuilt.experiment.quality.torque_fit import (
    BETTER,
    CLEAR,
    FALL,
    TorqueFit,
    measure_any_masses,
)
from asbuilt.findings import Cure, Finding

FREE_FALL = float(np.linalg.norm(USUAL_GRAVITY))
AXES = {
    f"{sign}{axis}": factor * FREE_FALL * np.eye(3)[k]
    for k, axis in enumerate("xyz")
    for sign, factor in (("+", 1.0), ("-", -1.0))
}
ABSENT = 0.1
PARTIAL = 0.8
"""Share of gravity by the masses of CAD, in that of accelerations, below which a log has none, and
below which it may have a part. Armatures and gains change both: the share is 0.45 to 2 in 35 logs
of nine real robots whose torques these masses explain, and 0.01 in logs without gravity."""
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of gravity that are tried with any masses."""


def measure_gravity_share(fit: TorqueFit) -> float:
    """Return the share of gravity by CAD in that of accelerations; NaN if it is not clear."""
    return _TorqueParts.of(fit).measure_share(fit.model.gravity)


def check_gravity(fit: TorqueFit) -> tuple[Finding, TorqueFit] | None:
    """Return a finding, and the fit that it explains, if the torques follow another gravity.

    Whether they follow it wholly is asked first, then its direction.
    """
    return (_check_share(fit) if np.any(fit.model.gravity) else None) or _check_direction(fit)


def _check_share(fit: TorqueFit) -> tuple[Finding, TorqueFit] | None:
    """Return a finding, and the fit with the gravity of the log, if it has only a part of gravity.

    Two roads: the share by the masses of CAD, and the share with which any masses fit best, which
    their accelerations decide. Both halves of the log must agree; an error needs both roads.
    """
    # Halves first and the whole last, whose figures are said.
    parts = (*fit.halves(), fit)
    of_cad = [measure_gravity_share(part) for part in parts]
    # One part that follows gravity refutes its absence.
    if any(share >= PARTIAL for share in of_cad):
        return None
    absent = all(share < ABSENT for share in of_cad)
    of_any = [_measure_costs(part) for part in parts]
    best = {int(np.argmin(costs)) for costs in of_any}
    # Halves that disagree show nothing: the whole gravity is kept.
    share = SHARES[best.pop()] if len(best) == 1 else 1.0
    # A fit that is hardly better is chance.
    if of_any[-1][-1] - min(of_any[-1]) < BETTER:
        share = 1.0
    known = not any(np.isnan(of_cad))
    if absent or share == 0.0:
        finding = _report_absent(fit, absent=absent, fits=share == 0.0, measured=of_cad[-1])
        share = 0.0
    elif known and share < 1.0:
        finding = _report_part(fit, share)
    else:
        return None
    return finding, replace(fit, model=fit.model.with_gravity(share * np.array(fit.model.gravity)))


def _measure_costs(fit: TorqueFit) -> list[float]:
    """Return the mean logarithm of what any masses leave unexplained, by share of gravity."""
    weightless = fit.observe(np.zeros(3))
    # The columns are linear in gravity: two evaluations give all shares.
    of_gravity = fit.observe(np.array(fit.model.gravity)) - weightless
    return [measure_any_masses(fit, weightless + share * of_gravity) for share in SHARES]


def _report_absent(fit: TorqueFit, *, absent: bool, fits: bool, measured: float) -> Finding:
    """Return the finding of a log without gravity: an error where both roads agree."""
    by_cad = (
        f"the masses of {fit.model.name} show in accelerations, and"
        f" {100 * max(measured, 0.0):.0f} % of them in weight"
        if absent
        else ""
    )
    by_any = "any masses fit better without gravity, in both halves of the log" if fits else ""
    reasons = "; ".join(filter(None, (by_cad, by_any)))
    return Finding(
        "gravity_absent",
        "error" if absent and fits else "warning",
        f"the torques {'' if absent and fits else 'seem to '}follow no gravity, as efforts from"
        f" which a driver subtracts it ({reasons})",
        Cure(
            "log the whole torque, or identify a model without gravity",
            settings={"gravity": "0,0,0"},
        ),
    )


def _report_part(fit: TorqueFit, share: float) -> Finding:
    gravity = ",".join(f"{share * g:.3g}" for g in fit.model.gravity)
    return Finding(
        "gravity_partial",
        "warning",
        f"the torques seem to follow a part of gravity, about {100 * share:.0f} %: any masses fit"
        " both halves of the log best so. A sensor or driver that subtracts the weight of some"
        " bodies, springs, or a wrong rate do that",
        Cure("log the whole torque; or state what remains", settings={"gravity": gravity}),
    )


def _check_direction(fit: TorqueFit) -> tuple[Finding, TorqueFit] | None:
    """Return a finding, and the fit with the gravity of the torques, if it has another direction.

    The torques without gravity and gravity's torques along each axis are compared with the measured
    ones, offset and friction taken out of all. The sign of friction distinguishes a flipped torque
    from a robot upside down; without it, torques that gravity does not dominate do. If they do
    not decide, the torque is taken as flipped. A description without gravity is doubted where the
    torques show some.
    """
    given = np.asarray(fit.model.gravity)
    cosines = _TorqueParts.of(fit)
    now = cosines.at(given)
    if now > DOUBTFUL:
        return None
    # Axes first: robots are mounted on floors, walls and ceilings.
    along = max((np.asarray(axis) for axis in AXES.values()), key=cosines.at)
    if max(-now, cosines.at(along)) < CLEAR:
        along = cosines.estimated()
        # A direction that is no axis must fit better.
        if cosines.at(along) < 0.97:
            return None
    elif -now > CLEAR:
        # Exactly opposite: upside down, or all torques flipped.
        along = -given
    if not along.any():
        return None
    mounted = replace(fit, model=fit.model.with_gravity(along))
    sign = find_friction_sign(mounted)
    parallel = abs(float(given @ along)) > 0.99 * float(np.linalg.norm(given)) * FREE_FALL
    # Friction that acts along the motion shows flipped torques: not gravity's matter.
    if parallel and (sign < 0.0 or (sign == 0.0 and mounted.cost > fit.cost - FALL)):
        return None
    # With flipped torques the direction that fits is the opposite of gravity's.
    gravity = along if sign >= 0.0 else -along
    cosine = abs(cosines.at(along))
    named = (axis_name for axis_name, axis in AXES.items() if np.array_equal(axis, gravity))
    name = next(named, ",".join(f"{g:.3g}" for g in gravity))
    direction = ", ".join(f"{g:.3g}" for g in given)
    finding = Finding(
        "gravity_direction",
        "error",
        f"gravity is ({direction}) m/s^2 in the root frame of {fit.model.name}, but the torques fit"
        f" {name} (cosine with the model's torque {cosine:.3f} instead of {now:.3f}), as of a robot"
        " mounted in another way than its description",
        Cure("give the direction of gravity", settings={"gravity": name}),
    )
    return finding, replace(fit, model=fit.model.with_gravity(gravity))


def find_friction_sign(fit: TorqueFit) -> float:
    """Return the sign of the torques that friction of most joints shows, 0 if it shows none."""
    friction = fit.friction_correlation
    shown = friction[friction != 0.0]
    # Most joints must show friction: one alone may be driven.
    mean = float(np.mean(shown)) if 2 * shown.size > friction.size else 0.0
    # Joints that contradict each other decide nothing.
    return float(np.sign(mean)) if abs(mean) > 0.5 else 0.0


@dataclass(frozen=True, eq=False)
class _TorqueParts:
    """Hold torques (N, n): measured, modelled without gravity, and of 1 m/s^2 along each axis."""

    measured: Array
    motion: Array
    gravity: Array

    @classmethod
    def of(cls, fit: TorqueFit) -> _TorqueParts:
        def torque(gravity: Array) -> Array:
            mounted = fit.model.with_gravity(gravity)
            return inverse_dynamics(mounted, fit.q, fit.qd, fit.qdd, threads=1)

        still = torque(np.zeros(3))
        # Linear in gravity: three axes give every direction.
        x, y, z = (torque(axis) - still for axis in np.eye(3))
        measured, motion, *axes = map(fit.without_friction, (fit.tau, still, x, y, z))
        return cls(measured, motion, np.stack(axes))

    def at(self, gravity: Array) -> float:
        """Return the cosine of measured and modelled torques under a gravity [m/s^2]."""
        x = self.motion + np.tensordot(gravity, self.gravity, 1)
        norms = float(np.linalg.norm(x) * np.linalg.norm(self.measured))
        return float(np.sum(x * self.measured)) / norms if norms > 0 else 0.0

    def measure_share(self, gravity: ArrayLike) -> float:
        """Return the least-squares share of a gravity, in that of accelerations; NaN if unclear."""
        whole = np.tensordot(np.asarray(gravity), self.gravity, 1)
        columns = np.stack([self.motion.ravel(), whole.ravel()], axis=1)
        y = self.measured.ravel()
        # A vertical axis has no gravity, a robot at rest no acceleration.
        size = np.linalg.norm(columns, axis=0)
        if not np.all(size > 0.0):
            return np.nan
        of_motion, of_gravity = np.linalg.lstsq(columns / size, y, rcond=None)[0] / size
        explained = np.linalg.norm(columns @ [of_motion, of_gravity])
        # A fit that leaves much has no shares to compare.
        clear = explained > CLEAR * np.linalg.norm(y) and of_motion != 0.0
        return abs(float(of_gravity / of_motion)) if clear else np.nan

    def estimated(self) -> Array:
        """Return the gravity of free fall in the direction of least squares, to three digits."""
        columns = self.gravity.reshape(3, -1).T
        # The length is that of free fall; least squares would take in errors of masses.
        g = np.linalg.lstsq(columns, (self.measured - self.motion).ravel(), rcond=None)[0]
        norm = float(np.linalg.norm(g)) or np.inf
        return np.array([float(f"{value:.3g}") for value in FREE_FALL * g / norm])
