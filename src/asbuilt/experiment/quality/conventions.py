"""Conventions of the log that the torques show: direction of gravity, signs and zeros of joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import USUAL_GRAVITY
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.quality.passes import position_limits
from asbuilt.experiment.quality.torque_fit import TorqueFit
from asbuilt.findings import Cure, Finding, join_names

QUARTERS = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)
"""Zero positions [rad] by which the conventions of two makers differ."""


DOUBTFUL, CLEAR = 0.75, 0.9
"""Correlation, or cosine, of measured with rigid-body torques from which a convention is not
doubted, and that another one must reach. In recordings of seven real robots the cosine is at least
0.92 in the right direction of gravity, and at most 0.69 in directions across it.
"""
FALL = 2.0
"""Fall of the misfit's logarithm, summed over joints, from which a convention is decisive."""
Convention = tuple[float, float, float]
"""Signs of position and torque, and zero: `sign (logged - zero)` is the model's position."""
DESCRIBED: Convention = (1.0, 1.0, 0.0)
OTHER_SIGNS = {
    (-1.0, -1.0): ["turns the other way, position and torque"],
    (-1.0, 1.0): ["has the opposite sign of position"],
    (1.0, -1.0): ["has the opposite sign of torque"],
}


@dataclass(frozen=True, eq=False)
class Conventions:
    """Hold a fit, and the joints whose convention in it is not the description's."""

    fit: TorqueFit
    changed: Mapping[int, Convention]

    @cached_property
    def cost(self) -> float:
        """Misfit of the torques; a changed joint, and one beyond its limits, must be worth it."""
        return self.fit.cost + FALL * (len(self.changed) + _count_joints_beyond(self.fit))

    def with_joint(self, k: int, convention: Convention) -> Conventions:
        """Return these conventions with another one of joint k."""
        fit, (position, torque, zero) = self.fit, convention
        q, qd, qdd, tau = (np.array(each) for each in (fit.q, fit.qd, fit.qdd, fit.tau))
        q[:, k] = position * (q[:, k] - zero)
        qd[:, k] *= position
        qdd[:, k] *= position
        tau[:, k] *= torque
        changed = {**self.changed, k: convention}
        return Conventions(replace(fit, q=q, qd=qd, qdd=qdd, tau=tau), changed)

    def changes(self) -> Iterator[Conventions]:
        """Yield the conventions with one more joint changed; a torque alone is another check's."""
        for k, joint in enumerate(self.fit.model.joints):
            zeros = QUARTERS if joint.is_revolute else QUARTERS[:1]
            for convention in product((1.0, -1.0), (1.0, -1.0), zeros):
                position, _, zero = convention
                if k not in self.changed and (position < 0.0 or zero != 0.0):
                    yield self.with_joint(k, convention)

    def __str__(self) -> str:
        sentences = []
        for k, (position, torque, zero) in sorted(self.changed.items()):
            what = list(OTHER_SIGNS.get((position, torque), ()))
            if zero != 0.0:
                what.append(f"reads {np.degrees(zero):.0f} deg where the description has zero")
            sentences.append(f"{self.fit.model.joint_names[k]} {' and '.join(what)}")
        return join_names(sentences)


def check_conventions(fit: TorqueFit) -> tuple[Finding, TorqueFit] | None:
    """Return a finding, and the fit that it explains, if other conventions fit the torques.

    Directions, and zeros by quarters of a turn, are tried for one joint more as long as the misfit
    falls decisively, and positions keep their limits. Small errors of a zero are left to
    `asbuilt.identification.effects`.
    """
    if not np.any(np.abs(fit.correlation[fit.decides]) < DOUBTFUL):
        return None
    logged = best = Conventions(fit, {})
    front, near = [logged], []
    for _ in range(fit.model.n_joints):
        # The same conventions may be reached in several orders.
        changes = {
            frozenset(change.changed.items()): change for each in front for change in each.changes()
        }
        # Another joint is added to the five best.
        front = sorted(changes.values(), key=lambda each: each.cost)[:5]
        if not front or front[0].cost > best.cost:
            break
        best = front[0]
        # Less than 1 apart another convention fits about as well.
        near = [each for each in front[1:] if each.cost < best.cost + 1.0]
    fallen = _find_improved_joints(fit, best.fit)
    if best is logged or not fallen.size:
        return None
    before, after = (float(np.mean(np.abs(each.correlation[fallen]))) for each in (fit, best.fit))
    if after <= CLEAR:
        return None
    others = f"; {len(near)} more fit about as well, such as: {near[0]}" if near else ""
    return (
        Finding(
            "joint_convention",
            "error",
            f"the log follows another convention than the description: {best}"
            f" (mean correlation with the model's torque {after:.3f} instead of {before:.3f})"
            f"{others}",
            _make_cure(best),
            joint=fit.model.joint_names[min(best.changed)],
        ),
        best.fit,
    )


def _count_joints_beyond(fit: TorqueFit) -> int:
    """Return how many joints leave their limits, wherever their full turns are counted from."""
    lower, upper = position_limits(fit.model)
    turn = np.where([joint.is_revolute for joint in fit.model.joints], 2.0 * np.pi, 0.0)
    turned = [fit.q + n * turn for n in (-1, 0, 1)]
    shares = [np.mean((q < lower) | (q > upper), axis=0) for q in turned]
    # Share of positions outside the limits from which a joint leaves them.
    return int(np.count_nonzero(np.min(shares, axis=0) > 0.02))


def _find_improved_joints(before: TorqueFit, after: TorqueFit) -> Indices:
    """Return the joints (k,) whose misfit has fallen to less than half."""
    least = [np.minimum(each.misfit(1), each.misfit(-1)) for each in (before, after)]
    return np.flatnonzero(after.decides & (least[1] < 0.5 * least[0]))


def _make_cure(best: Conventions) -> Cure:
    of_joints = [best.changed.get(k, DESCRIBED) for k in range(best.fit.model.n_joints)]
    written = [
        f"{name} = [{', '.join(f'{value:.6g}' for value in values)}]"
        for name, values, usual in zip(
            ("position_sign", "sign", "zero"), zip(*of_joints, strict=True), DESCRIBED, strict=True
        )
        if any(value != usual for value in values)
    ]
    return Cure(
        "compare zero and direction of these joints with the robot's, and that the log is of this"
        " robot; if so, write"
        f" {', '.join(written)} in a recording sheet"
    )


FREE_FALL = float(np.linalg.norm(USUAL_GRAVITY))
AXES = {
    f"{sign}{axis}": factor * FREE_FALL * np.eye(3)[k]
    for k, axis in enumerate("xyz")
    for sign, factor in (("+", 1.0), ("-", -1.0))
}


def check_gravity(fit: TorqueFit) -> tuple[Finding, TorqueFit] | None:
    """Return a finding, and the fit with the gravity of the torques if it has another direction.

    The torques without gravity and gravity's torques along each axis are compared with the measured
    ones, offset and friction taken out of all. The sign of friction distinguishes a flipped torque
    from a robot upside down; without it, torques that gravity does not dominate do. If they do
    not decide, the torque is taken as flipped. A description without gravity is doubted where the
    torques show some.
    """
    given = np.asarray(fit.model.gravity)
    cosines = _Cosines.of(fit)
    now = cosines.at(given)
    if now > DOUBTFUL:
        return None
    along = max((np.asarray(axis) for axis in AXES.values()), key=cosines.at)
    if max(-now, cosines.at(along)) < CLEAR:
        along = cosines.estimated()
        # A direction that is no axis must fit better.
        if cosines.at(along) < 0.97:
            return None
    elif -now > CLEAR:
        along = -given
    if not along.any():
        return None
    mounted = replace(fit, model=fit.model.with_gravity(along))
    sign = _find_friction_sign(mounted)
    parallel = abs(float(given @ along)) > 0.99 * float(np.linalg.norm(given)) * FREE_FALL
    if parallel and (sign < 0.0 or (sign == 0.0 and mounted.cost > fit.cost - FALL)):
        return None
    gravity = along if sign >= 0.0 else -along
    cosine = abs(cosines.at(along))
    named = (each for each, axis in AXES.items() if np.array_equal(axis, gravity))
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


def _find_friction_sign(fit: TorqueFit) -> float:
    """Return the sign of the torques that friction of most joints shows, 0 if it shows none."""
    friction = fit.friction_correlation
    shown = friction[friction != 0.0]
    mean = float(np.mean(shown)) if 2 * shown.size > friction.size else 0.0
    return float(np.sign(mean)) if abs(mean) > 0.5 else 0.0


@dataclass(frozen=True, eq=False)
class _Cosines:
    """Hold torques (N, n): measured, modelled without gravity, and of gravity of 1 m/s^2 (3)."""

    measured: Array
    motion: Array
    gravity: Sequence[Array]

    @classmethod
    def of(cls, fit: TorqueFit) -> _Cosines:
        def torque(gravity: Array) -> Array:
            mounted = fit.model.with_gravity(gravity)
            return inverse_dynamics(mounted, fit.q, fit.qd, fit.qdd, threads=1)

        still = torque(np.zeros(3))
        x, y, z = (torque(axis) - still for axis in np.eye(3))
        measured, m, *g = (fit.without_friction(each) for each in (fit.tau, still, x, y, z))
        return cls(measured, m, g)

    def at(self, gravity: Array) -> float:
        """Return the cosine of measured and modelled torques under a gravity [m/s^2]."""
        parts = zip(gravity, self.gravity, strict=True)
        x = self.motion + sum((g * part for g, part in parts), np.zeros_like(self.motion))
        norms = float(np.linalg.norm(x) * np.linalg.norm(self.measured))
        return float(np.sum(x * self.measured)) / norms if norms > 0 else 0.0

    def estimated(self) -> Array:
        """Return the gravity of free fall in the direction of least squares, to three digits."""
        columns = np.stack([part.ravel() for part in self.gravity], axis=1)
        g = np.linalg.lstsq(columns, (self.measured - self.motion).ravel(), rcond=None)[0]
        norm = float(np.linalg.norm(g)) or np.inf
        return np.array([float(f"{value:.3g}") for value in FREE_FALL * g / norm])
