from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asbuilt.dynamics import observation_matrix, parameter_values
from asbuilt.errors import ResultError
from asbuilt.validation import validate_description, validate_samples
from asbuilt.validation.prediction import derive_cad_values
from asbuilt.writers import as_built


@pytest.mark.parametrize("which", ["example", "filtered_example"])
def test_torques_follow_the_full_observation_matrix(
    which: str, request: pytest.FixtureRequest
) -> None:
    example: Any = request.getfixturevalue(which)
    samples, result, model = example.held_out, example.result, example.model
    validation = validate_samples(result, samples)
    chi = np.nan_to_num(parameter_values(model, result.base.drive))
    W = observation_matrix(model, samples.q, samples.qd, samples.qdd, drive=result.base.drive)
    expected = samples.filtered((W @ chi).reshape(samples.q.shape))
    np.testing.assert_allclose(validation.predicted_cad, expected, atol=1e-9)
    np.testing.assert_allclose(validation.metrics_as_built.rms, result.validation[0].rms, rtol=1e-9)
    np.testing.assert_allclose(validation.metrics_cad.rms, result.cad.rms, rtol=1e-9)
    assert (
        validation.measured.shape
        == validation.velocity.shape
        == validation.drive.shape
        == (len(validation.t), 4)
    )
    assert validation.units == ("N m", "N m", "N", "N m")
    assert not validation.measured.flags.writeable


def test_friction_is_what_rigid_bodies_leave(example: Any) -> None:
    validation = validate_samples(example.result, example.held_out)
    rigid = example.truth.copy()
    rigid[40:] = 0.0
    samples = example.held_out
    W = observation_matrix(
        example.model, samples.q, samples.qd, samples.qdd, drive=example.result.base.drive
    )
    left = samples.tau - (W @ rigid).reshape(samples.q.shape)
    assert np.sqrt(np.mean((validation.friction - left) ** 2)) < 0.1
    curve = validation.friction_curves()[0]
    viscous, coulomb, offset = example.truth[40:43]
    busy = curve.count > 50
    law = viscous * curve.velocity + coulomb * np.sign(curve.velocity) + offset
    np.testing.assert_allclose(curve.median[busy], law[busy], atol=0.15)


def test_another_description_is_compared_only_if_its_geometry_fits(example: Any) -> None:
    other = example.model.with_parameters(example.truth[:40])
    validation = validate_samples(example.result, example.held_out, cad=other)
    assert (
        validation.metrics_cad.relative_error
        < validate_samples(example.result, example.held_out).metrics_cad.relative_error
    )
    np.testing.assert_allclose(
        derive_cad_values(example.result, example.model), example.result.cad_values
    )
    moved = example.model.joints[2].after.copy()
    moved[0, 3] += 0.01
    from dataclasses import replace

    joints = tuple(
        replace(joint, after=moved) if k == 2 else joint
        for k, joint in enumerate(example.model.joints)
    )
    with pytest.raises(ResultError, match=r"after translation of joint 'axis_3' by 0\.01"):
        validate_samples(
            example.result, example.held_out, cad=replace(example.model, joints=joints)
        )


def test_other_joints_are_refused(example: Any) -> None:
    from dataclasses import replace

    swapped = replace(example.held_out, joint_names=tuple(reversed(example.model.joint_names)))
    with pytest.raises(ResultError, match="has joints axis_4, axis_3"):
        validate_samples(example.result, swapped)


@pytest.mark.parametrize("which", ["example", "filtered_example"])
def test_the_robot_as_built_predicts_like_the_result_it_comes_from(
    which: str, request: pytest.FixtureRequest
) -> None:
    example: Any = request.getfixturevalue(which)
    found = validate_description(as_built(example.result).model, example.held_out)
    expected = validate_samples(example.result, example.held_out).metrics_as_built
    for name in ("rms", "max_abs", "rms_recorded", "relative_error"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-9)
    with pytest.raises(ResultError, match="has joints"):
        validate_description(
            example.model, replace(example.held_out, joint_names=("a", "b", "c", "d"))
        )
