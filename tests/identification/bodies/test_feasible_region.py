"""What is confounded with a quantity, against the linear program in all directions at once."""

import numpy as np
import pytest
from scipy.optimize import linprog

from asbuilt import load_robot
from asbuilt.dynamics import DriveSet
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.identification.bodies.body_bounds import bound_with_certainty
from asbuilt.identification.bodies.cad_prior import build_cad_prior
from asbuilt.identification.bodies.conic_fit import scale_near_one
from asbuilt.identification.bodies.feasible_region import FeasibleRegion

DRIVE = DriveSet.parse("viscous,coulomb,armature")


@pytest.mark.parametrize("unseen", [0, 1, 4])
@pytest.mark.parametrize("parameter", ["m1", "m2", "mx2", "Iyy3"])
def test_confounded_parameters_solve_the_program_of_all_directions(
    unseen: int, parameter: str
) -> None:
    model = load_robot("ur10e")
    base = find_base_parameters(model, DRIVE)
    rng = np.random.default_rng(unseen)
    root = rng.normal(size=(base.n_base - unseen, base.n_base))
    prior = build_cad_prior(model, DRIVE)
    region = FeasibleRegion(
        prior, base, np.zeros(base.n_base), root, bound_with_certainty(prior), 4.0
    )
    value = np.zeros(base.n_standard)
    value[base.standard_names.index(parameter)] = 1.0

    scales = np.linalg.norm(scale_near_one(prior)[0], axis=1)
    rows = root @ base.regrouping * scales
    rows /= np.linalg.norm(rows, axis=1)[:, None]
    rows = np.vstack([rows, scales * value / np.linalg.norm(scales * value)])
    plain = linprog(
        np.ones(2 * len(value)),
        A_eq=np.hstack([rows, -rows]),
        b_eq=np.append(np.zeros(len(root)), 1.0),
        bounds=(0.0, None),
    )
    change = np.abs(plain.x[: len(value)] - plain.x[len(value) :])
    named = {base.standard_names[j] for j in np.flatnonzero(change > 1e-3 * change.max())}

    others, own = region.find_confounded(value)
    assert set(others) | set(own) == named
    assert own == (parameter,)


@pytest.mark.parametrize("errors", [1e-3, 0.3, 0.6, 3.0])
def test_a_value_that_excludes_zero_has_no_zero_in_its_interval(errors: float) -> None:
    model = load_robot("ur10e")
    base = find_base_parameters(model, DRIVE)
    prior = build_cad_prior(model, DRIVE)
    parameters = prior.parameters.copy()
    place = base.standard_names.index("Fv2")
    parameters[place] = 1.0
    # Of the friction alone: its standard error, in units of its value.
    size = np.maximum(np.abs(base.regrouping @ parameters), 1.0)
    region = FeasibleRegion(
        prior,
        base,
        base.regrouping @ parameters,
        np.diag(1.0 / (errors * size)),
        bound_with_certainty(prior),
        4.0,
    )
    value = np.zeros(base.n_standard)
    value[place] = 1.0

    least, greatest = region.find_interval(value)
    assert region.excludes_zero(value) == region.excludes_zero(-value) == (2.0 * errors < 1.0)
    assert not region.excludes_zero(value) or least > 0.0
    assert greatest >= 1.0
