"""Errors of fitted nonlinear parameters, and what they add to all others.

Against the full Jacobian, and against what fits to fresh noise do.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet, drive_torque, inverse_dynamics, observation_matrix
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples
from asbuilt.identification import (
    EstimationData,
    IdentificationResult,
    estimate_wls,
    identify_samples,
    settle_drive,
)
from asbuilt.identification.drives.nonlinear_parameters import (
    estimate_nonlinear_errors,
    fit_nonlinear,
)
from asbuilt.identification.identify import set_link_parameters
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.identification.uncertainty.error_kinds import ErrorKind
from asbuilt.tables import round_with_error
from asbuilt.workflow import StudyOptions, identify

NONLINEAR = {
    "power": ("coulomb,power:exponent=0.6,offset", [1.0, 2.0, 0.3], "coulomb,power,offset"),
    "stribeck": (
        "viscous,coulomb,stribeck:velocity=0.1,offset",
        [1.0, 2.0, 1.0, 0.3],
        "viscous,coulomb,stribeck,offset",
    ),
    "load_stribeck": (
        "viscous,coulomb,load_stribeck:velocity=0.1,offset",
        [1.0, 2.0, 0.2, 0.3],
        "viscous,coulomb,load_stribeck,offset",
    ),
    "smooth_coulomb": (
        "viscous,smooth_coulomb:width=0.1,offset",
        [1.0, 2.0, 0.3],
        "viscous,smooth_coulomb,offset",
    ),
}


def samples_of(
    robot: str, term: str, *, noise: float = 0.2, seed: int = 1, joint_noise: float = 0.0
) -> Samples:
    model = bundled_robot(robot)
    drive, values, _ = NONLINEAR[term]
    motion = random_fourier(model, 3, duration=20.0).sample(100.0)
    state = motion.q, motion.qd, motion.qdd
    load = inverse_dynamics(model, *state)
    tau = load + drive_torque(
        DriveSet.parse(drive), np.tile(values, model.n_joints), *state, load=load
    )
    spread = noise * (1.0 + joint_noise * np.arange(model.n_joints))
    tau = tau + spread * np.random.default_rng(seed).normal(size=tau.shape)
    return Samples(
        motion.t, *state, tau, rate=100.0, joint_names=model.joint_names, torque_source="sensor"
    )


def fitted(
    robot: str, samples: Samples, term: str, method: str = "wls", errors: ErrorKind = "blocks"
) -> IdentificationResult:
    return identify_samples(
        bundled_robot(robot),
        samples,
        drive=DriveSet.parse(NONLINEAR[term][2]),
        method=method,
        errors=errors,
    )


@pytest.mark.parametrize(
    ("robot", "term"),
    [
        *product(("two-link",), ("power", "stribeck", "smooth_coulomb", "load_stribeck")),
        *(
            pytest.param(*case, marks=pytest.mark.study)
            for case in product(("scara", "ur10e"), ("power", "stribeck", "smooth_coulomb"))
        ),
    ],
)
def test_errors_are_those_of_the_full_jacobian(robot: str, term: str) -> None:
    """Nonlinear parameters as further unknowns beside everything linear.

    Dense columns, differenced on another road, and one inverse.
    """
    model, samples = bundled_robot(robot), samples_of(robot, term, joint_noise=0.5)
    result = fitted(robot, samples, term, errors="textbook")
    drive, base = result.base.drive, result.base
    assert drive.is_linear
    nonlinear = next(each for each in drive.terms if each.key == term)
    name, state, n = (
        nonlinear.nonlinear[0].name,
        (samples.q, samples.qd, samples.qdd),
        model.n_joints,
    )

    def columns(parameters: np.ndarray) -> np.ndarray:
        moved = drive.with_term(nonlinear.with_nonlinear({name: tuple(parameters.tolist())}))
        return observation_matrix(loading, *state, drive=moved, columns=base.columns)

    loading = set_link_parameters(model, base, result.estimates) if drive.needs_load else model
    at = np.array([nonlinear.at(k).value(name) for k in range(n)])
    weights = np.tile(1.0 / result.sigma, samples.t.size)
    told = [
        place.joint
        for place in fit_nonlinear(model, DriveSet.parse(NONLINEAR[term][2]), [samples]).places
    ]
    assert len(told) >= n - 1
    steps = [1e-5 * np.eye(n)[k] for k in told]
    changes = np.column_stack(
        [(columns(at + step) - columns(at - step)) @ result.estimates / 2e-5 for step in steps]
    )
    J = np.column_stack([columns(at), changes]) * weights[:, None]
    size = np.linalg.norm(J, axis=0)
    expected = np.sqrt(np.diag(np.linalg.inv((J / size).T @ (J / size)))) / size
    np.testing.assert_allclose(result.std_errors, expected[: base.n_base], rtol=2e-3)
    note = next(note for note in result.notes if "nonlinear parameters" in note)
    for k, error in zip(told, expected[base.n_base :], strict=True):
        assert f"{model.joint_names[k]} {' +- '.join(round_with_error(at[k], error))}" in note


@pytest.mark.parametrize(("robot", "method"), [("scara", "wls"), ("two-link", "huber")])
@pytest.mark.study
def test_intervals_hold_the_truth_although_the_exponent_was_fitted(robot: str, method: str) -> None:
    """Twelve recordings that differ in their noise alone.

    Without what the exponent leaves open, Coulomb friction would lie two errors off as a rule.
    """
    n, sigmas, alone = bundled_robot(robot).n_joints, [], []
    for seed in range(12):
        samples = samples_of(robot, "power", noise=0.4, seed=seed)
        result = fitted(robot, samples, "power", method)
        stated = identify_samples(result.model, samples, base=result.base, method=method)
        for found, kept in ((result, sigmas), (stated, alone)):
            values = {parameter.name: parameter for parameter in found.parameters}
            kept.append(
                [
                    (values[f"Fc{k}"].estimate - 1.0) / values[f"Fc{k}"].std_error
                    for k in range(1, n + 1)
                ]
            )
        np.testing.assert_allclose(stated.estimates, result.estimates)
    assert np.sqrt(np.mean(np.square(sigmas))) < 1.3
    assert np.sqrt(np.mean(np.square(alone))) > 1.4


@pytest.mark.study
def test_a_study_counts_them_and_so_does_what_is_compared() -> None:
    model, samples = bundled_robot("scara"), samples_of("scara", "power")
    found = [
        identify(
            model, [samples], options=StudyOptions(drive=drive, method="consistent", holdout=None)
        ).result
        for drive in (
            DriveSet.parse(NONLINEAR["power"][2]),
            settle_drive(model, [samples], DriveSet.parse(NONLINEAR["power"][2])).drive,
        )
    ]
    grown = found[0].std_errors / found[1].std_errors
    assert found[0].base.names == found[1].base.names
    coulomb = [found[0].base.names.index(f"Fc{k}") for k in range(1, 5)]
    # Bodies apart: what each fit may lack, and so the scatter of its blocks, is its own.
    friction = [name.startswith("F") for name in found[0].base.names]
    assert np.all(grown[friction] > 1.0 - 1e-9)
    assert np.all(grown[coulomb] > 1.3)
    free = [result.free for result in found]
    assert free[0] is not None
    assert free[1] is not None
    assert np.all((free[0].std_errors / free[1].std_errors)[coulomb] > 1.3)
    assert any("exponent of power" in note for note in found[0].notes)
    assert not any("exponent of power" in note for note in found[1].notes)


def test_a_nonlinear_parameter_without_effect_is_not_told() -> None:
    model, samples = bundled_robot("two-link"), samples_of("two-link", "power")
    choice = settle_drive(model, [samples], DriveSet.parse(NONLINEAR["power"][2]))
    result = identify_samples(model, samples, drive=choice.drive)
    still = replace(samples, qd=np.zeros_like(samples.qd))
    information = accumulate(model, result.base, still)
    estimate = estimate_wls(
        EstimationData(model, information, [still], np.zeros(result.n_base), "toward_prior", None)
    )
    found = estimate_nonlinear_errors(model, result.base, estimate, [still], choice.fitted)
    assert np.all(np.isnan(found.std_errors))
    assert not found.covariance.any()
    assert "undetermined" in found.sentence(model.joint_names)
