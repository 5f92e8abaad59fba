"""Full robots from base parameters: exact, real, closest to CAD.

And the nearest where nothing real is exact.
"""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import bundled_robot, robot_names
from asbuilt.description.plausibility import find_inconsistencies
from asbuilt.dynamics import DriveSet, find_base_parameters, inverse_dynamics
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.bodies.entropic_fit import Coordinates
from asbuilt.identification.bodies.standard_parameters import find_standard_parameters


@pytest.mark.parametrize("robot", [*robot_names()])
@pytest.mark.parametrize("drive", ["none", "armature,viscous,coulomb,offset"])
def test_real_bodies_with_exactly_the_torques_and_closer_to_cad_than_the_truth(trial, robot, drive):
    case = trial(robot, drive, seed=8, duration=2.0)
    found = find_standard_parameters(case.model, case.base, case.beta)
    assert found.exact
    assert found.consistent
    assert found.part > 0.0
    np.testing.assert_allclose(case.base.values(found.parameters), case.beta, rtol=0, atol=1e-11)
    assert not find_inconsistencies(
        case.model.with_parameters(found.parameters[: 10 * case.model.n_links])
    )
    assert case.prior.strength @ found.divergence <= case.prior.strength @ case.prior.divergence(
        case.chi
    )
    q, qd, qdd = np.random.default_rng(0).uniform(-1.5, 1.5, (3, 40, case.model.n_joints))
    # Links that a description calls negligible keep their values, whatever the truth's are.
    kept = np.repeat([not link.negligible for link in case.model.links], 10)
    bodies = [
        np.where(kept, chi[: 10 * case.model.n_links], found.parameters[: 10 * case.model.n_links])
        for chi in (found.parameters, case.chi)
    ]
    if drive == "none":
        one, other = (inverse_dynamics(case.model, q, qd, qdd, parameters=chi) for chi in bodies)
        np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.parametrize("robot", ["kuka-iiwa7-r800", "ur10e", "two-link"])
def test_no_other_bodies_with_these_torques_are_closer(trial, robot):
    case = trial(robot, "none", seed=9, duration=2.0)
    found = find_standard_parameters(case.model, case.base, case.beta)
    directions = Coordinates.of(case.base).dependent
    rng = np.random.default_rng(1)
    least = found.divergence.sum()
    for size in (1e-4, 1e-3, 1e-2):
        for _ in range(20):
            step = directions @ rng.normal(size=directions.shape[1])
            step *= size / np.sqrt(
                np.einsum(
                    "na,nab,nb->", step.reshape(-1, 10), case.prior.metric, step.reshape(-1, 10)
                )
            )
            assert case.prior.divergence(found.parameters + step).sum() >= least - 1e-9


@pytest.mark.parametrize("robot", [*robot_names()])
def test_design_values_give_the_design_back(robot):
    model = bundled_robot(robot)
    base = find_base_parameters(model)
    found = find_standard_parameters(model, base, base.values(model.parameters))
    assert found.exact
    if not found.notes:
        np.testing.assert_allclose(found.parameters, model.parameters, atol=1e-6)


def test_nearest_in_the_metric_of_an_estimate(trial):
    """With the identity as information, no real robot tried is nearer in base parameters."""
    case = trial("two-link", "none", seed=10, duration=2.0)
    beta = case.beta.copy()
    beta[0] = -0.05
    found = find_standard_parameters(
        case.model, case.base, beta, nearest=True, information=1e6 * np.eye(len(beta))
    )
    distance = np.linalg.norm(found.beta - beta)
    rng = np.random.default_rng(2)
    others = [
        found.parameters + scale * rng.normal(size=20)
        for scale in (1e-3, 1e-2, 1e-1)
        for _ in range(100)
    ]
    real = [each for each in others if np.all(case.prior.relative_eigenvalues(each) > 1e-3)]
    assert len(real) > 20
    for other in real:
        assert np.linalg.norm(case.base.values(other) - beta) >= distance * (1 - 1e-4)


def test_negative_friction_stays_unless_the_nearest_is_asked_for(trial):
    case = trial("ur10e", "viscous,coulomb", seed=11, duration=2.0)
    beta = case.beta.copy()
    place = case.base.names.index("Fv3")
    beta[place] = -0.5
    found = find_standard_parameters(case.model, case.base, beta)
    assert found.exact
    assert found.parameters[case.base.standard_names.index("Fv3")] == -0.5
    passive = find_standard_parameters(case.model, case.base, beta, nearest=True)
    assert not passive.exact
    assert passive.parameters[case.base.standard_names.index("Fv3")] == pytest.approx(0.0, abs=1e-6)
    assert passive.torque_rms[2] > 0.1


def test_shape_and_finiteness_are_checked():
    model = bundled_robot("two-link")
    base = find_base_parameters(model, DriveSet.parse("viscous"))
    with pytest.raises(IdentifiabilityError, match="finite base parameters"):
        find_standard_parameters(model, base, np.zeros(3))
    with pytest.raises(IdentifiabilityError, match="finite base parameters"):
        find_standard_parameters(model, base, np.full(base.n_base, np.nan))
