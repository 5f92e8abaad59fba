"""trainnr's torque balance: armature, damping and friction loss of each joint, bodies as described.

Its bounds are those of the joints of a quadruped, and its gate lets joints pass that turn at
1 rad/s or more; here both follow the logs: bounds from torque and motion as in the adapter of
mujoco.sysid, a gate at a tenth of the logs' speed. Its smoothing is left out: states are low-passed
already.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from adapter import Estimate, Facts, Fit
from mujoco_rollout import without_limits
from plain import Motion
from trainnr.robot.torque_balance import (
    TERMS,
    Bandwidth,
    Coulomb,
    JointSamples,
    TermBounds,
    VelocityGate,
    fit_terms,
    rigid_torque,
)

PACKAGE = "trainnr"
REQUIRES = ["trainnr[sim]", "scipy"]
PYTHON = "3.12"
TITLE = "trainnr"
ADDRESS = "https://github.com/Trainnr-AI/trainnr"
SLOW = 0.1
"""Part of the joints' root mean square speed below which a sample is left out."""


def fit(facts: Facts) -> Fit:
    """Identify armature, damping and friction loss of the joints."""
    if facts.coupling is not None:
        raise NotImplementedError("no coupling of several joints with one motor in this adapter")
    spec = mujoco.MjSpec.from_file(facts.urdf)
    spec.compiler.balanceinertia, spec.compiler.boundinertia = True, 1e-6
    spec.option.gravity = facts.gravity
    without_limits(spec)
    model = spec.compile()
    samples = joined(facts)
    speed = float(np.sqrt(np.mean(samples.velocity**2)))
    top = 5.0 * np.abs(samples.torque).max()
    bounds = TermBounds(
        armature=(0.0, top / float(np.std(samples.acceleration))),
        damping=(0.0, top / speed),
        frictionloss=(0.0, top),
    )
    coulomb = Coulomb(knee=SLOW * speed)
    found = fit_terms(
        model,
        samples,
        bounds=bounds,
        gate=VelocityGate(SLOW * speed),
        bandwidth=Bandwidth(0.0),
        coulomb=coulomb,
    )
    values = np.array([[each.estimates[term] for term in TERMS] for each in found.joints])

    def predict(motion: Motion) -> Any:
        zero = np.zeros_like(motion.q)
        states = samples_of(facts, motion._replace(tau=zero), motion.t)
        inertia, damping, loss = values.T
        rate = motion.qd
        own = inertia * motion.qdd + damping * rate + loss * coulomb.column(rate)
        return rigid_torque(model, states) + own

    return Fit(predict, estimates(found, facts), note="bodies as described")


def joined(facts: Facts) -> JointSamples:
    """Return all logs away from their ends, one after another."""
    parts = [Motion(*(x[m.inner(facts.edge)] for x in m)) for m in facts.plain()]
    motion = Motion(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    return samples_of(facts, motion, np.arange(len(motion.q)) / facts.rate)


def samples_of(facts: Facts, motion: Motion, times: Any) -> JointSamples:
    """Return a motion as its samples."""
    _, q, qd, qdd, tau = motion
    return JointSamples(times, tuple(facts.joints), q, qd, qdd, tau)


def estimates(found: Any, facts: Facts) -> list[Estimate]:
    """Return parameters with the standard errors of its intervals."""
    symbols = {"damping": "Fv", "frictionloss": "Fc", "armature": "Ia"}
    number = {joint: k + 1 for k, joint in enumerate(facts.joints)}
    rows = []
    for each in found.result.parameters:
        joint, _, term = each.name.rpartition(".")
        own = f"{symbols[term]}{number[joint]}"
        rows.append(Estimate(each.name, each.estimate, each.half_width / 1.96, {own: 1.0}))
    return rows
