from dataclasses import replace

import numpy as np
import pytest
from virtual_causes import identified, recorded

from asbuilt.description import load_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import RecordingError, ResultError
from asbuilt.experiment import SignalChain, hold_out, prepare_samples
from asbuilt.identification import predict_torque, widening
from asbuilt.validation import compare_results
from asbuilt.workflow import ControllerOptions, compare_controller
from asbuilt.writers.reports.compare_files import render_drift

ARM = "kuka-iiwa7-r800"
WORN = (1.0, 2.0, 1.0, 2.0, 1.4, 3.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0)


def test_wear_is_found_where_it_is() -> None:
    drift = compare_results(identified(ARM, "f"), identified(ARM, "f", seed=2, friction=WORN))
    changed = {change.name for change in drift.parameters if change.changed}
    assert {"Fv3", "Fc3"} <= changed
    assert len(changed) <= 6
    assert drift.chi_square.probability < 1e-6
    (sentence,) = [line for line in drift.sentences if line.startswith("A3")]
    assert "Coulomb friction 2.0" in sentence
    assert "N m (+49 %)" in sentence or "N m (+50 %)" in sentence
    assert drift.ranked[0].name in ("Fc3", "Fv3")
    assert [joint.joint for joint in drift.joints if joint.holm <= 0.05] == ["A3"]
    assert drift.sentences[0].startswith("The torque of the same motion changed: A3 by ")


@pytest.mark.study
def test_nothing_changed_between_two_recordings_of_the_same_robot() -> None:
    drift = compare_results(identified(ARM, "f"), identified(ARM, "f", seed=2))
    assert drift.n_changed <= 3
    assert drift.chi_square.probability > 1e-4
    assert not any(change.matters for change in drift.parameters)
    assert not any(joint.holm <= 0.05 for joint in drift.joints)
    assert all(joint.torque < 3.0 * joint.by_chance for joint in drift.joints)
    assert "changed significantly at no joint" in drift.as_text()


def test_torque_of_the_changes_is_that_of_two_predictions() -> None:
    before, after = identified(ARM, "f"), identified(ARM, "f", seed=2, friction=WORN)
    _, held = hold_out(
        prepare_samples(recorded(ARM, "f", seed=2, friction=WORN), SignalChain()), "blocks:2s:3"
    )
    one, two = (
        predict_torque(after.model, after.base, result.estimates, held).predicted
        for result in (before, after)
    )
    found = compare_results(before, after).joints
    np.testing.assert_allclose(
        [joint.torque for joint in found], np.sqrt(np.mean((two - one) ** 2, axis=0)), rtol=1e-6
    )
    rng = np.random.default_rng(0)
    covariance = sum(
        result.covariance / np.outer(wide, wide)
        for result in (before, after)
        for wide in (widening(result.degrees_of_freedom),)
    )
    draws = rng.multivariate_normal(np.zeros(after.n_base), covariance, size=40)
    chance = [
        np.mean(predict_torque(after.model, after.base, draw, held).predicted ** 2, axis=0)
        for draw in draws
    ]
    np.testing.assert_allclose(
        [joint.by_chance for joint in found], np.sqrt(np.mean(chance, axis=0)), rtol=0.25
    )


@pytest.mark.study
@pytest.mark.parametrize(
    ("drive", "said"),
    [
        pytest.param("viscous,offset", "only January has coulomb. ", marks=pytest.mark.study),
        pytest.param(
            "viscous,coulomb,load_friction,offset",
            "only July has load_friction. ",
            marks=pytest.mark.study,
        ),
        (
            "viscous,smooth_coulomb:width=0.3,offset",
            "only January has coulomb; only July has smooth_coulomb. ",
        ),
    ],
)
def test_other_drive_terms_are_not_taken_for_wear_without_a_word(drive: str, said: str) -> None:
    """The robot is the same.

    What the tests call changed comes of the terms, and the first sentence says so.
    """
    plain = "viscous,coulomb,offset"
    before, after = identified(ARM, "f"), identified(ARM, "f", seed=2, drive=drive)
    drift = compare_results(before, after, labels=("January", "July"))
    assert drift.sentences[0].startswith(f"DIFFERENT DRIVE TERMS: {said}")
    richer = max(plain, drive, key=lambda terms: terms.count(","))
    assert drift.sentences[0].endswith(f"identify both with {richer}.")
    assert drift.as_text().index("DIFFERENT") < drift.as_text().index(
        "The torque of the same motion"
    )
    assert "DIFFERENT" in render_drift(drift)
    if "coulomb" not in drive.split(","):
        assert drift.n_changed or drift.chi_square.probability < 0.01
    assert not any("DIFFERENT" in line for line in compare_results(after, after).sentences)


@pytest.mark.study
def test_other_shapes_of_a_term_are_said() -> None:
    one, two = (
        identified(ARM, "f", drive=f"viscous,coulomb,stribeck:velocity={velocity},offset")
        for velocity in (0.05, 0.1)
    )
    assert (
        compare_results(one, two)
        .sentences[0]
        .startswith(
            "DIFFERENT DRIVE TERMS: both have stribeck, with other nonlinear parameters or at other"
            " joints. What follows"
        )
    )


def test_results_of_different_robots_are_not_compared() -> None:
    with pytest.raises(ResultError, match="joints"):
        compare_results(identified(ARM, "f"), identified("scara", "f"))


def test_the_controllers_own_model_is_recovered() -> None:
    model = load_robot(ARM)
    recording = recorded(ARM, "pf")
    qd = np.gradient(recording.q, recording.t, axis=0, edge_order=2)
    qdd = np.gradient(qd, recording.t, axis=0, edge_order=2)
    external = recording.tau - inverse_dynamics(model, recording.q, qd, qdd)
    found = compare_controller(
        identified(ARM, "pf"),
        replace(recording, extra={"tau_ext": external}),
        options=ControllerOptions(holdout="blocks:2s:3"),
    )
    assert found.rebuilt.relative_error < 0.02
    np.testing.assert_allclose(found.controller.rms, found.cad.rms, rtol=0.05)
    assert np.all(found.as_built.rms < found.controller.rms)
    friction = {change.name: change for change in found.difference.parameters}
    for k in range(1, 8):
        assert abs(friction[f"Fc{k}"].before) < 0.1
        assert abs(friction[f"Fc{k}"].after - 2.0) < 0.1
    assert "controller" in found.as_text()
    assert "changed" not in found.as_text().lower()
    assert any("Coulomb friction" in line for line in found.difference.sentences)


def test_a_log_without_external_torque_is_refused() -> None:
    with pytest.raises(RecordingError, match="tau_ext"):
        compare_controller(identified(ARM, "pf"), recorded(ARM, "pf"))
