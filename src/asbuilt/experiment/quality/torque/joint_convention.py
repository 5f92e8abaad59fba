"""Joints whose positions turn the other way, or count from another zero, than the description's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.experiment.quality.first_pass import position_limits
from asbuilt.experiment.quality.torque.torque_fit import TorqueFit
from asbuilt.findings import Cure, Finding, joined

QUARTERS = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)
"""Zero positions [rad] by which the conventions of two makers differ."""


@dataclass(frozen=True, slots=True)
class ConventionThresholds:
    """Decide from correlations of measured with rigid-body torques, and the misfit's logarithm."""

    doubtful: float = 0.75
    """Correlation of each joint from which conventions are not doubted."""
    clear: float = 0.9
    """Mean correlation that the joints must reach that another convention fits better."""
    fall: float = 2.0
    """Fall of the misfit's logarithm, summed over joints, from which a convention is decisive."""
    beyond: float = 0.02
    """Share of positions outside the limits from which a joint leaves them."""
    kept: int = 5
    """Number of conventions to which another joint is added."""
    near: float = 1.0
    """Difference of that sum below which another convention fits about as well."""


THRESHOLDS = ConventionThresholds()


@dataclass(frozen=True, eq=False)
class Conventions:
    """Hold a fit and the convention of each joint in it.

    The position in the model is `position_sign (logged - zero)`, the torque `torque_sign` times the
    logged one; all are of shape (n,).
    """

    fit: TorqueFit
    position_sign: Array
    torque_sign: Array
    zero: Array

    @classmethod
    def as_logged(cls, fit: TorqueFit) -> Conventions:
        """Return the conventions of the description for every joint."""
        n = fit.model.n_joints
        return cls(fit, np.ones(n), np.ones(n), np.zeros(n))

    @property
    def changed(self) -> list[int]:
        """Joints whose convention is not the description's."""
        other = (self.position_sign < 0.0) | (self.torque_sign < 0.0) | (self.zero != 0.0)
        return [int(k) for k in np.flatnonzero(other)]

    @cached_property
    def cost(self) -> float:
        """Misfit of the torques; a changed joint, and one beyond its limits, must be worth it."""
        surplus = len(self.changed) + _joints_beyond(self.fit)
        return self.fit.cost + THRESHOLDS.fall * surplus

    @property
    def key(self) -> tuple[bytes, ...]:
        """What distinguishes conventions, in whichever order they were reached."""
        return tuple(each.tobytes() for each in (self.position_sign, self.torque_sign, self.zero))

    def with_joint(self, k: int, position: float, torque: float, zero: float) -> Conventions:
        """Return these conventions with joint k multiplied by two signs, from another zero."""
        fit = self.fit
        q, qd, qdd, tau = (np.array(each) for each in (fit.q, fit.qd, fit.qdd, fit.tau))
        moved, pulled = fit.motion_of[k], fit.torque_of[k]
        q[:, moved] = position * (q[:, moved] - zero)
        qd[:, moved] *= position
        qdd[:, moved] *= position
        tau[:, pulled] *= torque
        signs, torques, zeros = (
            np.array(each) for each in (self.position_sign, self.torque_sign, self.zero)
        )
        signs[k], torques[k], zeros[k] = position, torque, zero
        own = replace(fit, q=q, qd=qd, qdd=qdd, tau=tau)
        return Conventions(own, signs, torques, zeros)

    def changes(self) -> Iterator[Conventions]:
        """Yield the conventions with one more joint changed; a torque alone is another check's."""
        for k, joint in enumerate(self.fit.model.joints):
            if k in self.changed:
                continue
            zeros = QUARTERS if joint.is_revolute else QUARTERS[:1]
            for position, torque, zero in product((1.0, -1.0), (1.0, -1.0), zeros):
                if position < 0.0 or zero != 0.0:
                    yield self.with_joint(k, position, torque, zero)


def convention_finding(fit: TorqueFit) -> tuple[Finding, TorqueFit] | None:
    """Return a finding, and the fit that it explains, if other conventions fit the torques.

    Directions, and zeros by quarters of a turn, are tried for one joint more as long as the misfit
    falls decisively, and positions keep their limits. Small errors of a zero are those of
    `asbuilt.identification.effects`.
    """
    if not _doubtful(fit):
        return None
    logged = best = Conventions.as_logged(fit)
    front, near = [logged], []
    for _ in range(fit.model.n_joints):
        changes = {change.key: change for each in front for change in each.changes()}
        front = sorted(changes.values(), key=lambda each: each.cost)[: THRESHOLDS.kept]
        if not front or front[0].cost > best.cost:
            break
        best = front[0]
        limit = best.cost + THRESHOLDS.near
        near = [each for each in front[1:] if each.cost < limit]
    if best is logged or not _explained(fit, best.fit):
        return None
    before, after = (_mean_correlation(each, _fallen(fit, best.fit)) for each in (fit, best.fit))
    others = " or ".join(_text(each, each.changed) for each in near)
    return (
        Finding(
            "joint_convention",
            "error",
            f"the log follows another convention than the description: {_text(best, best.changed)}"
            f" (mean correlation with the model's torque {after:.3f} instead of {before:.3f})"
            + (f"; as likely: {others}" if others else ""),
            _cure(best),
            joint=fit.model.joint_names[best.changed[0]],
        ),
        best.fit,
    )


def _joints_beyond(fit: TorqueFit) -> int:
    """Return how many joints leave their limits, wherever their full turns are counted from."""
    lower, upper = position_limits(fit.model)
    turn = np.where([joint.is_revolute for joint in fit.model.joints], 2.0 * np.pi, 0.0)
    q = fit.q[:, list(fit.motion_of)]
    shares = [np.mean((q + n * turn < lower) | (q + n * turn > upper), axis=0) for n in (-1, 0, 1)]
    return int(np.count_nonzero(np.min(shares, axis=0) > THRESHOLDS.beyond))


def _doubtful(fit: TorqueFit) -> bool:
    return bool(np.any(np.abs(fit.correlation[fit.decides]) < THRESHOLDS.doubtful))


def _fallen(before: TorqueFit, after: TorqueFit) -> Indices:
    """Return the joints (k,) whose misfit has fallen to less than half."""
    least = [np.minimum(each.misfit(1), each.misfit(-1)) for each in (before, after)]
    return np.flatnonzero(after.decides & (least[1] < 0.5 * least[0]))


def _mean_correlation(fit: TorqueFit, joints: Indices) -> float:
    return float(np.mean(np.abs(fit.correlation[joints])))


def _explained(before: TorqueFit, after: TorqueFit) -> bool:
    fallen = _fallen(before, after)
    return fallen.size > 0 and _mean_correlation(after, fallen) > THRESHOLDS.clear


def _text(conventions: Conventions, joints: Sequence[int]) -> str:
    names = conventions.fit.model.joint_names
    said = []
    for k in joints:
        what = []
        if conventions.position_sign[k] < 0.0 and conventions.torque_sign[k] < 0.0:
            what.append("turns the other way, position and torque")
        elif conventions.position_sign[k] < 0.0:
            what.append("has the opposite sign of position")
        elif conventions.torque_sign[k] < 0.0:
            what.append("has the opposite sign of torque")
        if conventions.zero[k] != 0.0:
            degrees = np.degrees(conventions.zero[k])
            what.append(f"reads {degrees:.0f} deg where the description has zero")
        said.append(f"{names[k]} {' and '.join(what)}")
    return joined(said)


def _cure(conventions: Conventions) -> Cure:
    fields = {
        "position_sign": conventions.position_sign,
        "sign": conventions.torque_sign,
        "zero": conventions.zero,
    }
    written = [
        f"{name} = [{', '.join(f'{value:.6g}' for value in values)}]"
        for name, values in fields.items()
        if np.any(values != (0.0 if name == "zero" else 1.0))
    ]
    return Cure(
        "compare zero and direction of these joints with the robot's; if so, write"
        f" {', '.join(written)} in a recording sheet"
    )
