"""Conventions of the log that the torques show: signs and zeros of joints."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.experiment.quality.passes import position_limits
from asbuilt.experiment.quality.torque_fit import (
    CLEAR,
    FALL,
    TorqueFit,
    compare_by_any_masses,
)
from asbuilt.findings import Cure, Finding, join_names

QUARTERS = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)
"""Zero positions [rad] by which the conventions of two makers differ."""


DOUBTFUL = 0.75
"""Correlation, or cosine, from which a convention is not doubted; another one must be `CLEAR`."""
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
        fit = self.fit
        position, torque, zero = convention
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
    before, after = fit.compare_correlation(best.fit, fallen)
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


STEP = np.radians(10.0)
"""Zeros [rad] are tried so far apart and the best one is refined: gravity's torques are sines."""
PASSES = 3
"""Times that each joint's zero is tried with the others as found: wrists follow the arm."""


def check_zeros(fit: TorqueFit, *, of_encoders: bool) -> tuple[Finding, TorqueFit] | None:
    """Return a finding, and the fit that it explains, if positions count from another zero.

    One zero that all joints share is a matter of their encoders, as it explains several joints by
    one number. Zeros of single joints look like masses that CAD has elsewhere; they are asked only
    `of_encoders` whose counters begin again within the motion, as no encoder that was set to the
    description's zero does.
    """
    turning = np.array([joint.is_revolute for joint in fit.model.joints])
    doubtful = np.any(np.abs(fit.correlation[fit.decides]) < DOUBTFUL)
    if not (doubtful or of_encoders) or turning.sum() < 2:
        return None

    def cost(zeros: Array) -> float:
        shifted = replace(fit, q=fit.q - zeros)
        return shifted.cost + FALL * _count_joints_beyond(shifted)

    as_logged = np.zeros(turning.size)
    shared = _find_zero(cost, as_logged, turning)
    single = _find_zeros_of_joints(cost, as_logged) if of_encoders else as_logged
    costs = [cost(shared) + FALL, cost(single) + FALL * np.count_nonzero(single)]
    zeros = shared if costs[0] <= costs[1] else single
    after = replace(fit, q=fit.q - zeros)
    better = _find_improved_joints(fit, after)
    fewest = 1 if of_encoders else 2
    if not zeros.any() or min(costs) > cost(as_logged) or better.size < fewest:
        return None
    before, now = fit.compare_correlation(after, better)
    by_masses = compare_by_any_masses(fit, after)
    if now <= CLEAR or by_masses < 0:
        return None
    names = [fit.model.joint_names[k] for k in np.flatnonzero(zeros)]
    degrees = [f"{value:.1f}" for value in np.degrees(zeros[zeros != 0.0])]
    written = [float(f"{value:.4g}") for value in zeros]
    zero = written[0] if len(set(written)) == 1 else written
    return (
        Finding(
            "joint_zero",
            "error" if by_masses > 0 else "warning",
            f"{join_names(names)} read {join_names(list(dict.fromkeys(degrees)))} deg where the"
            " description has zero, to some degrees by its masses (mean correlation with the"
            f" model's torque {now:.3f} instead of {before:.3f})",
            Cure(
                f"write zero = {zero} in a recording sheet, or better what a calibration finds",
                sheet={"zero": zero},
            ),
            joint=names[0],
        ),
        after,
    )


def _find_zeros_of_joints(cost: Callable[[Array], float], zeros: Array) -> Array:
    """Return zeros (n,) with one for each joint, where it is worth it."""
    joints = np.eye(zeros.size, dtype=np.bool_)
    for _ in range(PASSES):
        for joint in joints:
            zeros = _find_zero(cost, zeros, joint)
    # Each number must be worth FALL; a joint whose zero shows in no torque keeps the described one.
    for joint in joints:
        kept = np.where(joint, 0.0, zeros)
        zeros = kept if cost(kept) < cost(zeros) + FALL else zeros
    return _refine_zeros(cost, zeros)


def _find_zero(cost: Callable[[Array], float], zeros: Array, moved: Mask) -> Array:
    """Return zeros (n,) whose `moved` joints have the one common zero that costs least."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - light start

    def with_zero(zero: float) -> Array:
        return np.where(moved, zero, zeros)

    tried = np.arange(-np.pi, np.pi, STEP)
    best = min(tried, key=lambda zero: cost(with_zero(zero)))
    bounds = (best - STEP, best + STEP)
    fine = minimize_scalar(lambda zero: cost(with_zero(zero)), bounds=bounds, method="bounded")
    found = with_zero(float(fine.x))
    return found if cost(found) < cost(zeros) else zeros


def _refine_zeros(cost: Callable[[Array], float], zeros: Array) -> Array:
    """Return zeros (n,) with those that are not zero moved together to where they cost least."""
    moved = np.flatnonzero(zeros)
    if not moved.size:
        return zeros

    from scipy.optimize import minimize  # noqa: PLC0415 - light start

    def with_zeros(values: Array) -> Array:
        changed = zeros.copy()
        changed[moved] = values
        return changed

    # Tens of steps a joint settle to a tenth of a degree, which masses do not reach.
    def misfit(values: Array) -> float:
        return cost(with_zeros(values))

    found: Any = minimize(
        misfit,
        zeros[moved],
        method="Nelder-Mead",
        options={"maxfev": 60 * moved.size, "xatol": 1e-3, "fatol": 1e-3},
    )
    return with_zeros(np.asarray(found.x))


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
