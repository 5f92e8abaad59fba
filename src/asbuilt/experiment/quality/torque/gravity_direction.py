"""Direction of gravity that the measured torques show, of a robot on a wall or a ceiling."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import USUAL_GRAVITY
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.quality.torque.torque_fit import TorqueFit
from asbuilt.findings import Cure, Finding

FREE_FALL = float(np.linalg.norm(USUAL_GRAVITY))
AXES = {
    f"{sign}{axis}": factor * FREE_FALL * np.eye(3)[k]
    for k, axis in enumerate("xyz")
    for sign, factor in (("+", 1.0), ("-", -1.0))
}


@dataclass(frozen=True, slots=True)
class GravityThresholds:
    """Decide from cosines of measured with rigid-body torques, over all samples and joints.

    In recordings of seven real robots the cosine is at least 0.92 in the right direction, and at
    most 0.69 in directions across it.
    """

    doubtful: float = 0.75
    """Cosine in the described direction from which it is not doubted."""
    clear: float = 0.9
    """Least cosine in another direction that is right."""
    oblique: float = 0.97
    """Least cosine in a direction that is no axis."""
    friction: float = 0.5
    """Mean correlation of torques with the directions of motion that shows their sign."""
    fall: float = 2.0
    """Fall of the misfit's logarithm, summed over joints, from which a robot is upside down, and
    its torque not flipped, by its inertia alone."""


THRESHOLDS = GravityThresholds()


def gravity_finding(fit: TorqueFit) -> tuple[Finding, Array] | None:
    """Return a finding and the gravity (3,) [m/s^2] if the torques show another direction.

    The torques without gravity and those of gravity along each axis are compared with the measured
    ones, offset and friction taken out of all. The sign of friction distinguishes a flipped torque
    from a robot upside down; without it, torques that gravity does not dominate do. If they do
    not decide, the torque is taken as flipped. A description without gravity is doubted where the
    torques show some.
    """
    given = np.asarray(fit.model.gravity)
    cosines = _Cosines.of(fit)
    now = cosines.at(given)
    if now > THRESHOLDS.doubtful:
        return None
    along = max((np.asarray(axis) for axis in AXES.values()), key=cosines.at)
    if max(-now, cosines.at(along)) < THRESHOLDS.clear:
        along = cosines.estimated()
        if cosines.at(along) < THRESHOLDS.oblique:
            return None
    elif -now > THRESHOLDS.clear:
        along = -given
    if not along.any():
        return None
    mounted = replace(fit, model=fit.model.with_gravity(along))
    sign = _friction_sign(mounted)
    parallel = abs(float(given @ along)) > 0.99 * float(np.linalg.norm(given)) * FREE_FALL
    if parallel and (sign < 0.0 or (sign == 0.0 and mounted.cost > fit.cost - THRESHOLDS.fall)):
        return None
    gravity = along if sign >= 0.0 else -along
    cosine = abs(cosines.at(along))
    name = next((each for each, axis in AXES.items() if np.array_equal(axis, gravity)), "")
    name = name or ",".join(f"{g:.3g}" for g in gravity)
    direction = ", ".join(f"{g:.3g}" for g in given)
    finding = Finding(
        "gravity_direction",
        "error",
        f"gravity is ({direction}) m/s^2 in the root frame of {fit.model.name}, but the torques fit"
        f" {name} (cosine with the model's torque {cosine:.3f} instead of {now:.3f}), as of a robot"
        " mounted in another way than its description",
        Cure("give the direction of gravity", settings={"gravity": name}),
    )
    return finding, gravity


def _friction_sign(fit: TorqueFit) -> float:
    """Return the sign of the torques that friction of most joints shows, 0 if it shows none."""
    friction = fit.friction_correlation
    shown = friction[friction != 0.0]
    mean = float(np.mean(shown)) if 2 * shown.size > friction.size else 0.0
    return float(np.sign(mean)) if abs(mean) > THRESHOLDS.friction else 0.0


@dataclass(frozen=True, eq=False)
class _Cosines:
    """Hold torques (N, n): measured, modelled without gravity, and of gravity of 1 m/s^2 (3)."""

    measured: Array
    motion: Array
    gravity: tuple[Array, Array, Array]

    @classmethod
    def of(cls, fit: TorqueFit) -> _Cosines:
        q, qd, qdd = (values[:, list(fit.motion_of)] for values in (fit.q, fit.qd, fit.qdd))

        def torque(gravity: Array) -> Array:
            return inverse_dynamics(fit.model.with_gravity(gravity), q, qd, qdd, threads=1)

        still = torque(np.zeros(3))
        x, y, z = (torque(axis) - still for axis in np.eye(3))
        measured = fit.tau[:, list(fit.torque_of)]
        y_, m, gx, gy, gz = (fit.without_friction(each) for each in (measured, still, x, y, z))
        return cls(y_, m, (gx, gy, gz))

    def at(self, gravity: Array) -> float:
        """Return the cosine of measured and modelled torques under a gravity [m/s^2]."""
        parts = zip(gravity, self.gravity, strict=True)
        x = self.motion + sum((g * part for g, part in parts), np.zeros_like(self.motion))
        norms = float(np.linalg.norm(x) * np.linalg.norm(self.measured))
        return float(np.sum(x * self.measured)) / norms if norms > 0 else 0.0

    def estimated(self) -> Array:
        """Return the gravity of free fall in the direction of least squares, to three digits."""
        columns = np.stack([part.ravel() for part in self.gravity], axis=1)
        rest = (self.measured - self.motion).ravel()
        g = np.linalg.lstsq(columns, rest, rcond=None)[0]
        norm = float(np.linalg.norm(g))
        if norm == 0.0:
            return np.zeros(3)
        return np.array([float(f"{value:.3g}") for value in FREE_FALL * g / norm])
