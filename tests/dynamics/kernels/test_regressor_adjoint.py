"""The adjoint of the regressor against Pinocchio's derivatives of inverse dynamics, one set of
parameters per joint.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model, random_inertia, random_robot

from asbuilt.description import LinkInertia
from asbuilt.dynamics import RegressorPlan, inverse_dynamics
from asbuilt.dynamics.kernels.regressor_adjoint import regressor_adjoint
from asbuilt.errors import UsageError


def weighted(model, parameters):
    """The robot in Pinocchio with other inertial parameters."""
    links = [
        replace(link, inertia=LinkInertia(values), parts=())
        for link, values in zip(model.links, parameters, strict=True)
    ]
    return pinocchio_model(replace(model, links=tuple(links)))


@pytest.mark.parametrize("style", ["general", "distal", "proximal"])
@pytest.mark.parametrize("n", [1, 2, 5, 9])
def test_derivatives_are_those_of_pinocchio(style: str, n: int) -> None:
    """sum_kc G_kc Y_kc is the sum over joints of the torque of joint k of a robot with the
    parameters G_k.
    """
    rng = np.random.default_rng(n)
    model, samples = random_robot(rng, n, chain=True, style=style), 37
    q, qd, qdd = rng.normal(size=(3, samples, n))
    plan = RegressorPlan.of(model)
    weights = plan.buffer(samples)
    weights[:] = 0.0
    given = np.array([[random_inertia(rng).parameters for _ in range(n)] for _ in range(n)])
    for k in range(n):
        for i in range(n):
            for c in range(10):
                if plan.places[k, i, c] >= 0:
                    weights[plan.places[k, i, c], :samples] = given[k, i, c]
    found = regressor_adjoint(plan, q, qd, qdd, weights)
    expected = np.zeros((3, samples, n))
    for k in range(n):
        peer = weighted(model, given[k])
        data = peer.createData()
        for s in range(samples):
            for order, slope in enumerate(
                pin.computeRNEADerivatives(peer, data, q[s], qd[s], qdd[s])
            ):
                whole = np.array(slope)
                if order == 2:
                    whole = np.triu(whole) + np.triu(whole, 1).T
                expected[order, s] += whole[k]
    for order in range(3):
        np.testing.assert_allclose(
            found[order], expected[order], rtol=0, atol=1e-11 * max(1.0, np.abs(expected).max())
        )


def test_loads_add_the_derivatives_of_weighted_torques() -> None:
    rng = np.random.default_rng(3)
    model, samples = random_robot(rng, 6, chain=True), 45
    q, qd, qdd = rng.normal(size=(3, samples, 6))
    loads = rng.normal(size=(samples, 6))
    plan = RegressorPlan.of(model, columns=np.zeros(0, dtype=np.int64))
    found = regressor_adjoint(plan, q, qd, qdd, np.zeros((1, samples)), loads, model.parameters)
    peer = pinocchio_model(model)
    data = peer.createData()
    for s in range(samples):
        by_q, by_qd, by_qdd = (
            np.array(slope) for slope in pin.computeRNEADerivatives(peer, data, q[s], qd[s], qdd[s])
        )
        by_qdd = np.triu(by_qdd) + np.triu(by_qdd, 1).T
        for order, slope in enumerate((by_q, by_qd, by_qdd)):
            np.testing.assert_allclose(found[order][s], loads[s] @ slope, rtol=0, atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_branches_are_no_exception(seed: int) -> None:
    """Pinocchio's derivatives want chains in depth-first order.

    Trees are held against central differences of inverse dynamics.
    """
    rng = np.random.default_rng(seed)
    model = random_robot(rng, 7)
    state, loads = rng.normal(size=(3, 20, 7)), rng.normal(size=(20, 7))
    plan = RegressorPlan.of(model, columns=np.zeros(0, dtype=np.int64))
    found = regressor_adjoint(plan, *state, np.zeros((1, 20)), loads, model.parameters)
    for order in range(3):
        for j in range(7):
            sides = []
            for step in (1e-6, -1e-6):
                moved = state.copy()
                moved[order, :, j] += step
                sides.append((loads * inverse_dynamics(model, *moved)).sum(axis=1))
            np.testing.assert_allclose(
                found[order][:, j],
                (sides[0] - sides[1]) / 2e-6,
                rtol=0,
                atol=1e-6 * np.abs(found[order]).max(),
            )


def test_samples_do_not_depend_on_their_neighbours() -> None:
    rng = np.random.default_rng(4)
    model, samples = random_robot(rng, 4), 70
    q, qd, qdd = rng.normal(size=(3, samples, 4))
    plan = RegressorPlan.of(model)
    weights = plan.buffer(samples)
    weights[:] = rng.normal(size=weights.shape)
    whole = regressor_adjoint(plan, q, qd, qdd, weights)
    part = regressor_adjoint(
        plan, q[33:50], qd[33:50], qdd[33:50], np.ascontiguousarray(weights[:, 33:50])
    )
    for complete, cut in zip(whole, part, strict=True):
        np.testing.assert_array_equal(complete[33:50], cut)


def test_arrays_that_do_not_fit_are_refused() -> None:
    """The kernel does not check its indices: what is too small would be read beyond its end."""
    rng = np.random.default_rng(5)
    model = random_robot(rng, 3)
    plan = RegressorPlan.of(model)
    state, weights = rng.normal(size=(3, 40, 3)), plan.buffer(40)
    with pytest.raises(
        UsageError, match=rf"at least {plan.n_rows} rows and 40 columns, got \({plan.n_rows - 1}, "
    ):
        regressor_adjoint(plan, *state, weights[:-1])
    with pytest.raises(UsageError, match=r"at least \d+ rows and 40 columns"):
        regressor_adjoint(plan, *state, weights[:, :39])
    with pytest.raises(UsageError, match=r"loads must have shape \(40, 3\).* got \(39, 3\)"):
        regressor_adjoint(plan, *state, weights, np.zeros((39, 3)), model.parameters)
    with pytest.raises(UsageError, match=r"got \(40, 3\), \(39, 3\)"):
        regressor_adjoint(plan, state[0], state[1][:39], state[2], weights)
