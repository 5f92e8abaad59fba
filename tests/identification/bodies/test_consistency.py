"""Physical consistency against the paper's findings, an independent modelling of the same program,
and known bodies.
"""

from __future__ import annotations

import csv

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, parameter_values
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification import consistency_margin
from asbuilt.identification.bodies.consistency import decide_consistency


def pseudo_inertia(chi):
    xx, xy, xz, yy, yz, zz, hx, hy, hz, m = chi
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.block(
        [
            [0.5 * np.trace(inertia) * np.eye(3) - inertia, np.array([[hx], [hy], [hz]])],
            [np.array([[hx, hy, hz, m]])],
        ]
    )


def margin_by_modelling_language(base, beta):
    cp = pytest.importorskip("cvxpy")
    chi, t = cp.Variable(base.n_standard), cp.Variable()
    constraints = [base.regrouping @ chi == beta]
    basis = [pseudo_inertia(row) for row in np.eye(10)]
    for i in range(base.n_standard // 10):
        body = sum(chi[10 * i + c] * basis[c] for c in range(10))
        constraints.append(body >> t * np.eye(4))
    problem = cp.Problem(cp.Maximize(t), constraints)
    problem.solve(solver="SCS", eps=1e-7, max_iters=200000)
    return float(t.value)


@pytest.fixture(scope="module")
def iiwa():
    model = load_robot("kuka-iiwa7-r800")
    return model, find_base_parameters(model)


def column(shared, name):
    with (shared / "paper" / "table2.csv").open() as stream:
        return np.array([float(row[name]) for row in csv.DictReader(stream)])


def test_cad_column_of_the_paper_is_consistent(iiwa, shared):
    margin = consistency_margin(iiwa[1], column(shared, "cad"))
    assert margin == pytest.approx(8.4e-4, abs=1e-5)
    assert decide_consistency(iiwa[1], column(shared, "cad"))[1]


def test_robot_column_of_the_paper_is_not(iiwa, shared):
    beta = column(shared, "robot")
    margin = consistency_margin(iiwa[1], beta)
    assert margin == pytest.approx(-0.099, abs=5e-4)
    assert not decide_consistency(iiwa[1], beta)[1]


def test_agrees_with_another_solver(iiwa):
    model, base = iiwa
    beta = base.values(model.parameters) + np.random.default_rng(0).normal(
        scale=0.02, size=base.n_base
    )
    assert consistency_margin(base, beta) == pytest.approx(
        margin_by_modelling_language(base, beta), abs=1e-4
    )


@pytest.mark.parametrize("seed", range(4))
def test_real_bodies_always_pass_with_at_least_their_own_margin(iiwa, seed):
    base = iiwa[1]
    rng = np.random.default_rng(seed)
    chi, smallest = [], np.inf
    for _ in range(7):
        points, masses = rng.normal(scale=0.1, size=(8, 3)), rng.uniform(0.05, 0.5, 8)
        moments = np.einsum("p,pi,pj->ij", masses, points, points)
        inertia = np.trace(moments) * np.eye(3) - moments
        h = masses @ points
        chi.extend([*inertia[np.triu_indices(3)], *h, masses.sum()])
        smallest = min(smallest, np.linalg.eigvalsh(pseudo_inertia(chi[-10:]))[0])
    beta = base.values(np.array(chi))
    margin = consistency_margin(base, beta)
    assert margin >= smallest - 1e-7
    assert decide_consistency(base, beta)[1]


def test_negative_inertia_about_the_last_axis_is_impossible(iiwa):
    model, base = iiwa
    beta = base.values(model.parameters)
    beta[base.names.index("Izz7")] = -0.01
    assert consistency_margin(base, beta) <= -0.005 + 1e-6


def test_armature_may_explain_what_bodies_cannot_but_may_not_be_negative(iiwa):
    model, _ = iiwa
    drive = DriveSet.parse("armature,viscous")
    base = find_base_parameters(model, drive)
    chi = parameter_values(model, drive)
    chi[70:] = 0.0
    beta = base.values(chi)
    assert decide_consistency(base, beta)[1]
    beta[base.names.index("Ia7")] = -0.5
    assert consistency_margin(base, beta) == pytest.approx(-0.5, abs=1e-6)


def test_values_that_do_not_fit_are_refused(iiwa):
    with pytest.raises(IdentifiabilityError, match="43 finite base parameters"):
        consistency_margin(iiwa[1], np.zeros(12))
    with pytest.raises(IdentifiabilityError, match="finite"):
        consistency_margin(iiwa[1], np.full(43, np.nan))
