"""Scale of the torques of a robot without masses, from arms of the same length."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from asbuilt.description.appearance import link_solids, stretched_length
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.experiment.quality.torque_fit import TorqueFit
from asbuilt.findings import Cure, Finding

DENSITY = 0.5, 800.0
"""Densities [kg/m^3] of rods `stretched_length` wide that a robot may have.

Mass of arms grows with the third power of length. These are a quarter of the lightest and nine
times the heaviest: 2 to 16 for the descriptions of thirteen robots whose torque of gravity varies
by 0.4 to 65 N m, 50 for the TX40 and 87 for the two-link arm; recordings of six real arms in N m
give 1.7 to 87.
"""


def replace_links_by_rods(model: RobotModel) -> RobotModel:
    """Return the robot with thin rods for links.

    Mass [kg] is `length * stretched_length(model)**2`, that is 1 kg/m^3.
    """
    bodies = [LinkInertia.zero() for _ in range(model.n_links)]
    for solid in link_solids(model):
        if solid.link == ROOT or solid.kind != "rod":
            continue
        span = solid.stop - solid.start
        mass = solid.length * stretched_length(model) ** 2
        inertia = mass / 12.0 * (span @ span * np.eye(3) - np.outer(span, span))
        rod = LinkInertia.from_com(mass, 0.5 * (solid.start + solid.stop), inertia)
        bodies[solid.link] = bodies[solid.link] + rod
    return model.with_parameters(np.concatenate([body.parameters for body in bodies]))


def infer_density(fit: TorqueFit) -> float | None:
    """Return the density of rods [kg/m^3] whose torques are as large as the measured ones.

    None where the torques are not mostly gravity's, or unlike the torques of rods.
    """
    rods = replace(fit, model=replace_links_by_rods(fit.model))
    predicted = rods.predicted
    k = int(np.argmax(predicted))
    # Least share of gravity in the largest torque, and its least correlation with the rods' torque.
    if not predicted[k] > 0 or rods.gravity[k] < 0.8 * predicted[k]:
        return None
    if abs(rods.correlation[k]) < 0.7:
        return None
    return float(np.linalg.norm(rods.measured) / np.linalg.norm(predicted))


def check_scale_without_masses(fit: TorqueFit) -> Iterator[Finding]:
    """Find torques of a size that no robot of this length has."""
    density, (low, high) = infer_density(fit), DENSITY
    if density is None or low < density < high:
        return
    length = stretched_length(fit.model)
    bound = (
        f"more than {low * length**3:.2g}" if density < low else f"less than {high * length**3:.0f}"
    )
    cure = Cure(
        "give the torque per logged unit, one per joint, as gains = [...] in a recording sheet; a"
        " payload of known mass determines it",
        call="find_gains",
    )
    if density > high:
        cure = Cure('write units = { torque = "mN m" } in a recording sheet, or the unit it has')
    yield Finding(
        "torque_scale",
        "warning",
        f"the torques look not to be N m: gravity's share of them fits an arm of about"
        f" {density * length**3:.2g} kg, and arms of this length ({length:.2g} m stretched) weigh"
        f" {bound} kg; masses and torques come out in the logged unit",
        cure,
    )
