"""Poses and Jacobians against Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model, random_robot

from asbuilt.dynamics import link_jacobians, link_poses


@pytest.mark.parametrize("seed", range(4))
def test_link_poses_and_jacobians_are_those_of_pinocchio(seed):
    rng = np.random.default_rng(seed)
    model = random_robot(rng, 6)
    peer = pinocchio_model(model)
    data = peer.createData()
    q = rng.normal(size=(5, 6))
    poses, jacobians = link_poses(model, q), link_jacobians(model, q)
    assert poses.shape == (5, 6, 4, 4)
    for s in range(5):
        pin.computeJointJacobians(peer, data, q[s])
        for i, joint in enumerate(model.joints):
            after = pin.SE3(np.array(joint.after))
            np.testing.assert_allclose(
                poses[s, i], (data.oMi[i + 1] * after).homogeneous, atol=1e-12
            )
            body = after.toActionMatrixInverse() @ pin.getJointJacobian(
                peer, data, i + 1, pin.ReferenceFrame.LOCAL
            )
            np.testing.assert_allclose(
                jacobians[s, i], np.concatenate([body[3:], body[:3]]), atol=1e-12
            )


def test_one_sample_has_no_sample_axis():
    model = random_robot(np.random.default_rng(0), 3)
    q = np.array([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(link_poses(model, q), link_poses(model, q[None])[0])
    assert link_jacobians(model, q).shape == (3, 6, 3)
