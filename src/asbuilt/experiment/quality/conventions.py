"""Conventions of the log that the torques show: signs and zeros of joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from asbuilt.arrays import Indices
from asbuilt.experiment.quality.passes import position_limits
from asbuilt.experiment.quality.torque_fit import TorqueFit, compare_by_any_masses
from asbuilt.findings import Cure, Finding, join_names

QUARTERS = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)
"""Zero positions [rad] by which the conventions of two makers differ."""


DOUBTFUL = 0.75
CLEAR = 0.9
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
        q, qd, qdd, tau = (np.array(array) for array in (fit.q, fit.qd, fit.qdd, fit.tau))
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
                # A torque alone of the other sign is another check's finding.
                if k not in self.changed and (position < 0.0 or zero != 0.0):
                    yield self.with_joint(k, convention)

    def __str__(self) -> str:
        sentences = []
        for k, (position, torque, zero) in sorted(self.changed.items()):
            what = list(OTHER_SIGNS.get((position, torque), ()))
            if zero != 0.0:
                # 'has the opposite sign' and 'reads ...' may come together.
                what.append(f"reads {np.degrees(zero):.0f} deg where the description has zero")
            sentences.append(f"{self.fit.model.joint_names[k]} {' and '.join(what)}")
        return join_names(sentences)


def check_conventions(
    fit: TorqueFit, *, believed: bool = False
) -> tuple[Finding, TorqueFit] | None:
    """Return a finding, and the fit that it explains, if other conventions fit the torques.

    Directions, and zeros by quarters of a turn, are tried for one joint more as long as the misfit
    falls decisively, and positions keep their limits. An error needs that any masses, too, fit
    better so; `believed` conventions are stated in a sheet. Small errors of a zero are left to
    `asbuilt.identification.effects`.
    """
    if not np.any(np.abs(fit.correlation[fit.decides]) < DOUBTFUL):
        return None
    logged = best = Conventions(fit, {})
    front = [logged]
    near = []
    for _ in range(fit.model.n_joints):
        # The same conventions may be reached in several orders.
        changes = {
            frozenset(change.changed.items()): change for each in front for change in each.changes()
        }
        # Another joint is added to the five best.
        front = sorted(changes.values(), key=lambda each: each.cost)[:5]
        # A further joint must be worth FALL, which its cost includes.
        if not front or front[0].cost > best.cost:
            break
        best = front[0]
        # Less than 1 apart another convention fits about as well.
        near = [other for other in front[1:] if other.cost < best.cost + 1.0]
    fallen = _find_improved_joints(fit, best.fit)
    if best is logged or not fallen.size:
        return None
    before, after = (
        float(np.mean(np.abs(torque_fit.correlation[fallen]))) for torque_fit in (fit, best.fit)
    )
    # What 1 lacks must fall to half: a convention changes the sign or the form of a torque.
    if after <= CLEAR or 1.0 - after > 0.5 * (1.0 - before):
        return None
    by_masses = compare_by_any_masses(fit, best.fit)
    if by_masses < 0:
        return None
    others = f"; {len(near)} more fit about as well, such as: {near[0]}" if near else ""
    return (
        Finding(
            "joint_convention",
            "error" if by_masses > 0 and not believed else "warning",
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
    # A log may count full turns from elsewhere.
    shares = [np.mean((q < lower) | (q > upper), axis=0) for q in turned]
    # Share of positions outside the limits from which a joint leaves them.
    return int(np.count_nonzero(np.min(shares, axis=0) > 0.02))


def _find_improved_joints(before: TorqueFit, after: TorqueFit) -> Indices:
    """Return the joints (k,) whose misfit has fallen to less than half."""
    least = [np.minimum(each.misfit(1), each.misfit(-1)) for each in (before, after)]
    return np.flatnonzero(after.decides & (least[1] < 0.5 * least[0]))


def _make_cure(best: Conventions) -> Cure:
    of_joints = [best.changed.get(k, DESCRIBED) for k in range(best.fit.model.n_joints)]
    # Fields that are the usual ones for all joints are not written.
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
