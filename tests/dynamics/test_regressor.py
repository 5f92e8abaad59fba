"""The regressor against inverse dynamics and Pinocchio, its structural zeros, plans, columns,
samples and threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model, random_robot

from asbuilt.dynamics import (
    DriveSet,
    DriveTerm,
    RegressorPlan,
    inverse_dynamics,
    observation_matrix,
    parameter_values,
    regressor,
)
from asbuilt.dynamics.drives.drive_set import NO_DRIVE
from asbuilt.dynamics.kernels.recursion import BLOCK
from asbuilt.dynamics.regressor import find_joint_support
from asbuilt.errors import UsageError

ALL = DriveSet.parse("armature,viscous,coulomb,offset")
CASES = [(style, n) for style in ("general", "distal", "proximal") for n in (1, 2, 7, 12)]


def drawn(seed, n, style="general", samples=9):
    rng = np.random.default_rng(seed)
    q, qd, qdd = rng.normal(scale=2.0, size=(3, samples, n))
    return random_robot(rng, n, style=style), q, qd, qdd


def close(found, expected, scale):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(1.0, scale))


@pytest.mark.parametrize(("style", "n"), CASES)
def test_regressor_times_parameters_is_inverse_dynamics(style, n):
    model, q, qd, qdd = drawn(n, n, style)
    torques = inverse_dynamics(model, q, qd, qdd)
    close(
        (observation_matrix(model, q, qd, qdd) @ model.parameters).reshape(-1, n),
        torques,
        np.abs(torques).max(),
    )


@pytest.mark.parametrize(("style", "n"), CASES)
def test_every_column_is_that_of_pinocchio(style, n):
    model, q, qd, qdd = drawn(100 + n, n, style)
    peer = pinocchio_model(model)
    data = peer.createData()
    for s in range(len(q)):
        theirs = pin.computeJointTorqueRegressor(peer, data, q[s], qd[s], qdd[s]).reshape(n, n, 10)
        theirs_about_links = np.zeros((n, n, 10))
        for i, joint in enumerate(model.joints):
            after = pin.SE3(np.array(joint.after))
            theirs_about_links[:, i] = theirs[:, i] @ carried(after)
        close(
            regressor(model, q[s], qd[s], qdd[s]),
            theirs_about_links.reshape(n, -1),
            np.abs(theirs).max(),
        )


def carried(after: pin.SE3) -> np.ndarray:
    """Parameters about the link frame, our order, to parameters about the joint frame, Pinocchio's
    order: 10 x 10, column by column.
    """
    r, p = after.rotation, after.translation
    columns = []
    for unit in np.eye(10):
        xx, xy, xz, yy, yz, zz, *h, m = unit
        tensor, h = r @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ r.T, r @ np.array(h)
        cross = np.dot(p, h) * np.eye(3) - np.outer(h, p)
        tensor = tensor + cross + cross.T + m * (p @ p * np.eye(3) - np.outer(p, p))
        moved = h + m * p
        columns.append(
            [
                m,
                *moved,
                tensor[0, 0],
                tensor[0, 1],
                tensor[1, 1],
                tensor[0, 2],
                tensor[1, 2],
                tensor[2, 2],
            ]
        )
    return np.array(columns).T


def test_drive_columns_follow_the_links_joint_by_joint():
    model, q, qd, qdd = drawn(1, 3)
    matrix = observation_matrix(model, q, qd, qdd, drive=ALL).reshape(9, 3, -1)
    expected = np.zeros((9, 3, 12))
    for k in range(3):
        expected[:, k, 4 * k : 4 * k + 4] = np.stack(
            [qdd[:, k], qd[:, k], np.sign(qd[:, k]), np.ones(9)], axis=1
        )
    np.testing.assert_array_equal(matrix[:, :, 30:], expected)
    np.testing.assert_array_equal(
        matrix[:, :, :30], observation_matrix(model, q, qd, qdd).reshape(9, 3, 30)
    )


@dataclass(frozen=True, slots=True)
class LoadFriction(DriveTerm):
    key = "load"
    position = 35
    symbols = ("Fl",)
    revolute_units = prismatic_units = ("1",)
    columns = ("abs(load)*sign(qd)",)


def test_a_term_that_needs_the_load_is_given_the_torque_of_the_bodies():
    model, q, qd, qdd = drawn(1, 3)
    drive = DriveSet((LoadFriction(), *ALL.terms))
    expected = np.abs(inverse_dynamics(model, q, qd, qdd)) * np.sign(qd)
    matrix = observation_matrix(model, q, qd, qdd, drive=drive).reshape(9, 3, -1)
    for k, rows in enumerate(RegressorPlan.of(model, drive, [33, 38, 43]).evaluate(q, qd, qdd)):
        np.testing.assert_array_equal(rows[-1], expected[:, k])
        np.testing.assert_array_equal(matrix[:, k, 30 + 5 * k + 3], expected[:, k])


def test_one_sample_is_a_row_of_the_stack():
    model, q, qd, qdd = drawn(1, 3)
    matrix = observation_matrix(model, q, qd, qdd, drive=ALL)
    np.testing.assert_array_equal(regressor(model, q[4], qd[4], qdd[4], ALL), matrix[12:15])
    assert regressor(model, q[4], qd[4], qdd[4], ALL).shape == (
        3,
        parameter_values(model, ALL).size,
    )
    with pytest.raises(UsageError, match="observation_matrix takes many"):
        regressor(model, q, qd, qdd)


@pytest.mark.parametrize("seed", range(6))
def test_joint_rows_put_back_in_place_are_the_observation_matrix(seed):
    model, q, qd, qdd = drawn(seed, 6, samples=BLOCK + 5)
    rng = np.random.default_rng(seed)
    drive = (ALL, NO_DRIVE, DriveSet.parse("coulomb"))[seed % 3]
    columns = rng.permutation(60 + 6 * drive.columns_per_joint)[: rng.integers(1, 50)]
    rebuilt = np.zeros((BLOCK + 5, 6, columns.size))
    for k, (support, rows) in enumerate(
        zip(
            find_joint_support(model, drive, columns),
            RegressorPlan.of(model, drive, columns).evaluate(q, qd, qdd),
            strict=True,
        )
    ):
        rebuilt[:, k, support] = rows.T
    whole = observation_matrix(model, q, qd, qdd, drive=drive)
    np.testing.assert_array_equal(rebuilt.reshape(-1, columns.size), whole[:, columns])
    np.testing.assert_array_equal(
        observation_matrix(model, q, qd, qdd, drive=drive, columns=columns), whole[:, columns]
    )


def test_support_leaves_out_links_a_joint_does_not_carry():
    model, *_ = drawn(7, 8)
    for k, support in enumerate(find_joint_support(model, ALL, np.arange(80 + 32))):
        carried_links = {int(position) // 10 for position in support if position < 80}
        assert carried_links == {i for i in range(8) if k in model.ancestors(i)}
        assert [int(position) for position in support if position >= 80] == list(
            range(80 + 4 * k, 84 + 4 * k)
        )


@pytest.mark.parametrize("samples", [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 4 * BLOCK + 3])
def test_reused_memory_and_cuts_do_not_change_a_bit(samples):
    model, q, qd, qdd = drawn(3, 5, samples=samples)
    plan = RegressorPlan.of(model, ALL)
    whole = [rows.copy() for rows in plan.evaluate(q, qd, qdd)]
    memory = plan.buffer(5 * BLOCK)
    memory[:] = np.nan
    for first in range(0, samples, 13):
        cut = slice(first, first + 13)
        for k, rows in enumerate(plan.evaluate(q[cut], qd[cut], qdd[cut], memory)):
            np.testing.assert_array_equal(rows, whole[k][:, cut])
    assert [rows.shape[1] for rows in whole] == [samples] * 5


@pytest.mark.parametrize("threads", [2, 5, None])
def test_threads_do_not_change_a_bit(threads):
    model, q, qd, qdd = drawn(3, 4, samples=17003)
    plan = RegressorPlan.of(model, ALL)
    for one, many in zip(
        plan.evaluate(q, qd, qdd), plan.evaluate(q, qd, qdd, threads=threads), strict=True
    ):
        np.testing.assert_array_equal(one, many)
    np.testing.assert_array_equal(plan.stack(q, qd, qdd), plan.stack(q, qd, qdd, threads=threads))


def test_samples_are_independent_of_their_order():
    model, q, qd, qdd = drawn(3, 4, samples=70)
    order = np.random.default_rng(0).permutation(70)
    shuffled = observation_matrix(model, q[order], qd[order], qdd[order], drive=ALL).reshape(
        70, 4, -1
    )
    np.testing.assert_array_equal(
        shuffled, observation_matrix(model, q, qd, qdd, drive=ALL).reshape(70, 4, -1)[order]
    )


def test_spare_rows_are_left_to_the_caller():
    model, q, qd, qdd = drawn(3, 4, samples=40)
    plain, roomy = RegressorPlan.of(model, ALL), RegressorPlan.of(model, ALL, spare_rows=1)
    memory = roomy.buffer(40)
    memory[:] = -7.0
    for bare, rows in zip(
        plain.evaluate(q, qd, qdd), roomy.evaluate(q, qd, qdd, memory), strict=True
    ):
        np.testing.assert_array_equal(rows[:-1], bare)
        np.testing.assert_array_equal(rows[-1], -7.0)


def test_rows_of_a_buffer_start_on_cache_lines_an_odd_number_of_lines_apart():
    plan = RegressorPlan.of(drawn(3, 4)[0])
    for samples in (1, 64, 1000, 4096):
        memory = plan.buffer(samples)
        assert memory.ctypes.data % 64 == 0
        assert memory.shape[1] >= samples
        assert memory.strides[0] // 64 % 2 == 1


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ([0, 30], "column 30 does not exist.*0 to 29"),
        ([-1], "column -1"),
        ([1, 1], "repeat"),
        ([0.5], "list of integers"),
    ],
)
def test_wrong_columns_are_refused(columns, said):
    model, *_ = drawn(0, 3)
    with pytest.raises(UsageError, match=said):
        RegressorPlan.of(model, NO_DRIVE, columns)


def test_wrong_memory_is_refused():
    model, q, qd, qdd = drawn(0, 3)
    plan = RegressorPlan.of(model)
    for memory in (
        np.empty((plan.n_rows, 8)),
        np.empty((plan.n_rows - 1, 9)),
        np.empty((9, plan.n_rows)).T,
    ):
        with pytest.raises(UsageError, match=f"{plan.n_rows} rows and at least 9 columns"):
            plan.evaluate(q, qd, qdd, memory)
    with pytest.raises(UsageError, match="must all have shape"):
        plan.evaluate(q[:3], qd, qdd)


def test_no_columns_are_no_work():
    model, q, qd, qdd = drawn(0, 3)
    assert [rows.shape for rows in RegressorPlan.of(model, NO_DRIVE, []).evaluate(q, qd, qdd)] == [
        (0, 9)
    ] * 3
    assert observation_matrix(model, q, qd, qdd, columns=[]).shape == (27, 0)
