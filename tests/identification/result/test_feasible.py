"""Feasible intervals: one link by hand, any robot by CVXPY, and robots of Pinocchio's torque."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cvxpy as cp
import numpy as np
import pinocchio as pin
import pytest

from asbuilt import (
    FeasibleInterval,
    IdentificationResult,
    UsageError,
    feasible_intervals,
    identify,
    load_robot,
    random_fourier,
    simulate_recording,
)
from asbuilt.errors import DescriptionError
from asbuilt.identification import as_built_parameters

PENDULUM = """<robot name="pendulum"><link name="world"/><link name="bob">
<inertial><origin xyz="0.3 0.1 0.05"/><mass value="2"/>
<inertia ixx="0.02" iyy="0.03" izz="0.025" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pivot" type="revolute"><parent link="world"/><child link="bob"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" velocity="8" effort="100"/></joint></robot>"""
MASS, LEVER_X, LEVER_Z, INERTIA = 2.0, 2.0 * 0.3, 2.0 * 0.05, 0.03 + 2.0 * (0.3**2 + 0.05**2)
ROTOR = 0.04
CHI_SQUARE = 3.8415
"""95 % quantile of chi-square with one degree of freedom."""


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> IdentificationResult:
    """A pendulum with a rotor, whose torque is Pinocchio's, with little noise."""
    path = tmp_path_factory.mktemp("pendulum") / "pendulum.urdf"
    path.write_text(PENDULUM)
    model = pin.buildModelFromXML(PENDULUM)
    model.armature[:] = ROTOR
    data = model.createData()
    motion = random_fourier(load_robot(path), rng=1, duration=20.0).sample(500.0)
    states = zip(motion.q, motion.qd, motion.qdd, strict=True)
    tau = np.array([pin.rnea(model, data, *each) for each in states])
    noise = np.random.default_rng(1).normal(scale=0.02, size=tau.shape)
    log = {"t": motion.t, "q": motion.q, "tau": tau + noise}
    return identify(
        path, log, drive="armature", effects="none", method="wls", checked=False, holdout=None
    ).result


def test_one_link_by_hand(pendulum: IdentificationResult) -> None:
    """J = Iyy + Ia and the moments mx, mz are determined.

    A point at the distance h has Iyy = m h^2 and |mc| = m h, so that `m >= |mc|^2 / J`; a heavier
    one is nearer to the axis. A heavy body at the axis leaves all of J to the rotor, and one
    without rotor has all of it. The centre along the axis is free.
    """
    whole, moment = INERTIA + ROTOR, math.hypot(LEVER_X, LEVER_Z)
    mass = pendulum.feasible("mass")
    assert mass.least == pytest.approx(moment**2 / whole, rel=0.01)
    assert np.isinf([mass.least, mass.greatest]).tolist() == [False, True]
    assert mass.text.endswith("kg or more")
    rotor = pendulum.feasible("armature", "pivot")
    assert (rotor.least, rotor.greatest) == pytest.approx((0.0, whole), rel=0.01, abs=1e-6)
    assert rotor.confounded_with == ("Iyy1",)
    assert rotor.std_error is None
    across = pendulum.feasible("cy:bob")
    assert np.isinf([across.least, across.greatest]).all()
    centre = pendulum.feasible("cx", "bob")
    assert centre.least == pytest.approx(0.0, abs=1e-3)
    assert centre.greatest == pytest.approx(LEVER_X * whole / moment**2, rel=0.01)
    lever = pendulum.feasible("mx:bob")
    assert lever.determined
    assert lever.least <= LEVER_X <= lever.greatest
    assert "std_error" in lever.as_dict()


def test_what_is_stated_narrows(pendulum: IdentificationResult) -> None:
    near = pendulum.feasible("mass", prior="cad", tolerance=0.1)
    assert (near.least, near.greatest) == pytest.approx((0.9 * MASS, 1.1 * MASS), rel=1e-4)
    rotor = pendulum.feasible("armature:pivot", prior="cad", tolerance=0.1)
    assert rotor.greatest < pendulum.feasible("armature:pivot").greatest
    assert rotor.holds(ROTOR)


def test_wrong_names_are_refused(pendulum: IdentificationResult) -> None:
    with pytest.raises(UsageError, match=r"no moving link 'bop'.*did you mean 'bob'"):
        pendulum.feasible("mass", "bop")
    with pytest.raises(UsageError, match="no quantity 'weight'"):
        pendulum.feasible("weight")
    with pytest.raises(UsageError, match="names 3 quantities"):
        pendulum.feasible("com:bob")
    with pytest.raises(UsageError, match="tolerance of CAD is positive"):
        pendulum.feasible("mass", prior="cad", tolerance=0.0)
    with pytest.raises(DescriptionError, match="no link of pendulum has shapes"):
        pendulum.feasible("mass", geometry=True)


def test_open_ends_are_none_in_json(pendulum: IdentificationResult) -> None:
    document = json.loads(json.dumps(pendulum.feasible("mass").as_dict(), allow_nan=False))
    assert document["feasible"][1] is None
    assert document["feasible"][0] == pytest.approx(pendulum.feasible("mass").least)
    assert "std_error" not in document


def written_again(result: IdentificationResult) -> tuple[cp.Expression, list[cp.Constraint]]:
    """Return standard parameters and the constraints of the region, from definitions alone."""
    base, free = result.base, result.free
    assert free is not None
    names = list(base.standard_names)
    # In units of what was identified: the solver's numbers are then near one.
    unit = np.maximum(np.abs(as_built_parameters(result).parameters), 1e-2)
    chi = cp.multiply(unit, cp.Variable(len(names)))
    held: list[cp.Constraint] = []
    for k in range(1, result.model.n_links + 1):
        xx, xy, xz, yy, yz, zz, x, y, z, m = (
            chi[names.index(f"{symbol}{k}")]
            for symbol in ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
        )
        half = (xx + yy + zz) / 2
        held.append(
            cp.bmat(
                [
                    [half - xx, -xy, -xz, x],
                    [-xy, half - yy, -yz, y],
                    [-xz, -yz, half - zz, z],
                    [x, y, z, m],
                ]
            )
            >> 0
        )
    held += [chi[j] >= 0 for j, name in enumerate(names) if name[:2] in ("Ia", "Fv", "Fc")]
    size = np.sqrt(np.diag(free.covariance))
    root = np.linalg.inv(np.linalg.cholesky(free.covariance / np.outer(size, size))) / size
    distance = cp.norm(root @ (base.regrouping @ chi - free.estimates))
    nearest = cp.Problem(cp.Minimize(distance), held)
    nearest.solve(solver="CLARABEL")
    widened = max(1.0, nearest.value**2 / base.n_base)
    return chi, [*held, distance <= math.sqrt(nearest.value**2 + widened * CHI_SQUARE)]


def extreme(objective: cp.Expression, held: list[cp.Constraint]) -> float:
    problem = cp.Problem(cp.Minimize(objective), held)
    problem.solve(solver="CLARABEL")
    return math.inf if problem.value is None else float(problem.value)


@pytest.mark.study
def test_the_intervals_of_another_program_are_these() -> None:
    """Masses, inertias and armatures by CVXPY, a centre of mass by bisection on feasibility."""
    model = load_robot("scara")
    log = simulate_recording(model, random_fourier(model, rng=2, duration=20.0), rng=2)
    # With errors of a billionth the other program's solver finds no point at all.
    log = replace(log, tau=log.tau + 0.1 * np.random.default_rng(2).normal(size=log.tau.shape))
    result = identify(model, log, drive="armature,viscous,coulomb", effects="none").result
    chi, held = written_again(result)
    names, links = result.base.standard_names, result.model.link_names
    for quantity, symbol in (
        (f"mass:{links[1]}", "m2"),
        (f"mass:{links[3]}", "m4"),
        (f"Izz:{links[1]}", "Izz2"),
        (f"armature:{result.joint_names[1]}", "Ia2"),
    ):
        own = result.feasible(quantity)
        value = chi[names.index(symbol)]
        for end, other in (
            (own.least, extreme(value, held)),
            (-own.greatest, extreme(-value, held)),
        ):
            if np.isfinite(end):
                assert end == pytest.approx(other, rel=2e-3, abs=2e-5), quantity
    mass, moment = chi[names.index("m2")], chi[names.index("mx2")]
    low, high = -2.0, 2.0
    for _ in range(12):  # a centre below `middle` is possible if the least of this is negative
        middle = 0.5 * (low + high)
        below = extreme(moment - middle * mass, [*held, mass <= 100.0]) < 0.0
        low, high = (low, middle) if below else (middle, high)
    assert result.feasible("cx", links[1]).least == pytest.approx(high, abs=5e-3)


@pytest.mark.study
def test_the_truth_of_a_robot_of_the_field_is_in_every_interval(shared: Path) -> None:
    """Three links whose torque is Pinocchio's; their description has other masses."""
    folder = shared / "field/00_base"
    result = identify(folder / "tri.urdf", folder / "log.csv").result
    truth = load_robot(folder / "truth.urdf")
    for link in truth.links:
        body = link.inertia
        assert result.feasible("mass", link.name).holds(body.mass)
        for axis, value in zip("xyz", body.com.tolist(), strict=True):
            assert result.feasible(f"c{axis}", link.name).holds(value)
    for joint, rotor in zip(result.joint_names, (0.08, 0.06, 0.03), strict=True):
        assert result.feasible("armature", joint).holds(rotor)
    assert result.feasible("mass").holds(10.2)
    effects = {each.joint: each for each in result.effects if each.effect == "armature"}
    assert effects["j2"].std_error is None
    assert effects["j2"].feasible is not None
    assert effects["j2"].confounded_with == ("Izz2",)
    assert effects["j3"].std_error is not None


@pytest.mark.study
def test_the_exported_robot_is_one_of_the_bodies(shared: Path) -> None:
    """Near CAD by choice: least squares of these short logs alone would exclude its armature."""
    logs = [shared / f"data/schunk/m{k}.csv" for k in (9, 10, 11, 12)]
    if not logs[0].is_file():
        pytest.skip("the shared recordings are absent")
    result = identify(shared / "models/schunk/schunk_lwa4p.urdf", logs, checked=False).result
    for each in feasible_intervals(result, ("mass", "com", "Ixx", "armature")):
        assert each.chosen is None or each.holds(each.chosen), each
        assert "excludes" not in each.sentence


def test_values_that_no_robot_has_are_no_choice(pendulum: IdentificationResult) -> None:
    negative = tuple(
        replace(each, estimate=-each.estimate if each.name.startswith("Iyy") else each.estimate)
        for each in pendulum.parameters
    )
    inconsistent = replace(pendulum, parameters=negative)
    assert not as_built_parameters(inconsistent).consistent
    assert feasible_intervals(inconsistent, ("mass",))[0].chosen is None


def test_a_value_is_stated_alone_within_a_tenth() -> None:
    def interval(least: float, greatest: float) -> FeasibleInterval:
        return FeasibleInterval("mass", "kg", least, greatest, 10.0, 9.0)

    assert interval(9.1, 10.9).is_narrow
    assert not interval(9.1, 11.1).is_narrow
    assert not interval(9.1, math.inf).is_narrow
    assert interval(-math.inf, 2.0).text == "2.00 kg or less"


def test_the_default_is_masses_and_armatures(pendulum: IdentificationResult) -> None:
    names = [each.quantity for each in feasible_intervals(pendulum)]
    assert names == ["mass", "mass:bob", "armature:pivot"]
