"""Poses and Jacobians against Pinocchio and against finite differences."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model, random_robot

from asbuilt.dynamics.kinematics import link_jacobians, link_poses


@pytest.mark.parametrize("seed", range(4))
def test_link_poses_and_jacobians_are_those_of_pinocchio(seed):
    rng = np.random.default_rng(seed)
    model = random_robot(rng, 6)
    peer = pinocchio_model(model)
    data = peer.createData()
    q, qd = rng.normal(size=(2, 5, 6))
    poses, (jacobians, _) = link_poses(model, q), link_jacobians(model, q, qd)
    assert poses.shape == (5, 6, 4, 4)
    for s in range(5):
        pin.computeJointJacobians(peer, data, q[s])
        for i, joint in enumerate(model.joints):
            after = pin.SE3(np.array(joint.after))
            np.testing.assert_allclose(poses[s, i], (data.oMi[i + 1] * after).homogeneous, atol=1e-12)
            body = after.toActionMatrixInverse() @ pin.getJointJacobian(peer, data, i + 1, pin.ReferenceFrame.LOCAL)
            np.testing.assert_allclose(jacobians[s, i], np.concatenate([body[3:], body[:3]]), atol=1e-12)


def test_one_sample_has_no_sample_axis():
    model = random_robot(np.random.default_rng(0), 3)
    q = np.array([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(link_poses(model, q), link_poses(model, q[None])[0])
    assert link_jacobians(model, q, q)[0].shape == (3, 6, 3)


@pytest.mark.parametrize("seed", range(4))
def test_jacobian_rate_is_the_derivative_along_the_motion(seed):
    rng = np.random.default_rng(seed)
    model = random_robot(rng, 5)
    q, qd = rng.normal(size=(2, 3, 5))
    step = 1e-5
    ahead, behind = (link_jacobians(model, q + sign * step * qd, qd)[0] for sign in (1, -1))
    np.testing.assert_allclose(link_jacobians(model, q, qd)[1], (ahead - behind) / (2 * step), atol=1e-7)
