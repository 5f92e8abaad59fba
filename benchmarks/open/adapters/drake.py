"""Drake: regressor by automatic differentiation of its inverse dynamics, fit with its own program.

As its users fit arms and payloads (N. Pfaff et al., arXiv 2503.01141): least squares with a
positive pseudo-inertia of each link, solved by Clarabel, the open solver that Drake brings.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from adapter import Facts, Fit
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces_, SpatialInertia_, UnitInertia_
from pydrake.solvers import ClarabelSolver, MathematicalProgram
from regression import Regression

PACKAGE = "drake"
REQUIRES = ["drake>=1.58", "scipy"]
PYTHON = "3.12"
TITLE = "Drake"
ADDRESS = "https://drake.mit.edu"
REGULARISATION = 1e-3
"""Weight of the squared distance from the description over the rows' mean."""


def fit(facts: Facts) -> Fit:
    """Identify consistent links."""
    tree, cad = tree_regressor(facts)
    regression = Regression(facts, tree)
    W, tau = regression.stacked(facts.plain())
    w = regression.weights(W, tau)
    R = np.linalg.qr(np.column_stack([W * w[:, None], tau * w]), mode="r") / np.sqrt(len(tau))
    program = MathematicalProgram()
    x = program.NewContinuousVariables(W.shape[1])
    program.Add2NormSquaredCost(R[:, :-1], R[:, -1], x)
    n = cad.size
    scale = np.sqrt(REGULARISATION) / np.maximum(np.abs(cad).ravel(), 1e-2)
    program.Add2NormSquaredCost(np.diag(scale), scale * cad.ravel(), x[:n])
    for k in range(len(cad)):
        program.AddPositiveSemidefiniteConstraint(pseudo(x[10 * k : 10 * k + 10]))
    for j, name in enumerate(regression.names):
        if name.startswith(("Fv", "Fc", "Ia")):
            program.AddBoundingBoxConstraint(0.0, np.inf, x[j])
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        raise RuntimeError(f"the solver stopped: {result.get_solution_result()}")
    values = result.GetSolution(x)
    links = values[:n].reshape(-1, 10)
    return Fit(lambda motion: regression.torque(motion, values), links=links, note="no std errors")


def pseudo(link: Any) -> Any:
    """Return the pseudo-inertia (4, 4) of parameters `Ixx Ixy Ixz Iyy Iyz Izz mx my mz m`."""
    Ixx, Ixy, Ixz, Iyy, Iyz, Izz, mx, my, mz, m = link
    half = 0.5 * (Ixx + Iyy + Izz)
    return np.array(
        [
            [half - Ixx, -Ixy, -Ixz, mx],
            [-Ixy, half - Iyy, -Iyz, my],
            [-Ixz, -Iyz, half - Izz, mz],
            [mx, my, mz, m],
        ]
    )


def tree_regressor(facts: Facts) -> tuple[Any, Any]:
    """Return the regressor of the tree, and the parameters (n_links, 10) of the description."""
    plant = MultibodyPlant(0.0)
    (instance,) = Parser(plant).AddModels(facts.urdf)
    joints = [plant.GetJointByName(name, instance) for name in facts.tree_joints]
    root = joints[0].parent_body()
    fixed = {plant.get_joint(k).child_body().index() for k in plant.GetJointIndices(instance)}
    if root.index() != plant.world_body().index() and root.index() not in fixed:
        plant.WeldFrames(plant.world_frame(), root.body_frame())
    plant.mutable_gravity_field().set_gravity_vector(facts.gravity)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    cad = np.array([described(j.child_body(), context) for j in joints])
    auto = plant.ToAutoDiffXd()
    scalar = auto.CreateDefaultContext()
    start = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], len(joints))
    seeds = InitializeAutoDiff(start).ravel()
    for k, joint in enumerate(joints):
        Ixx, Ixy, Ixz, Iyy, Iyz, Izz, mx, my, mz, m = seeds[10 * k : 10 * k + 10]
        unit = UnitInertia_[AutoDiffXd](Ixx / m, Iyy / m, Izz / m, Ixy / m, Ixz / m, Iyz / m)
        inertia = SpatialInertia_[AutoDiffXd](m, np.array([mx / m, my / m, mz / m]), unit)
        auto.get_body(joint.child_body().index()).SetSpatialInertiaInBodyFrame(scalar, inertia)
    place = [joint.velocity_start() for joint in joints]
    forces = MultibodyForces_[AutoDiffXd](auto)

    def regressor(q: Any, qd: Any, qdd: Any) -> Any:
        found = np.empty((len(q), len(place), 10 * len(joints)))
        ordered = np.zeros((3, len(place)))
        for i in range(len(q)):
            ordered[:, place] = q[i], qd[i], qdd[i]
            auto.SetPositions(scalar, ordered[0])
            auto.SetVelocities(scalar, ordered[1])
            auto.CalcForceElementsContribution(scalar, forces)
            tau = auto.CalcInverseDynamics(scalar, ordered[2], forces)
            found[i] = ExtractGradient(tau.reshape(-1, 1))[place]
        return found

    return regressor, cad


def described(body: Any, context: Any) -> Any:
    """Return the parameters (10,) of a body."""
    inertia = body.CalcSpatialInertiaInBodyFrame(context)
    m, I = inertia.get_mass(), inertia.CalcRotationalInertia().CopyToFullMatrix3()
    h = m * inertia.get_com()
    return np.array([I[0, 0], I[0, 1], I[0, 2], I[1, 1], I[1, 2], I[2, 2], *h, m])
