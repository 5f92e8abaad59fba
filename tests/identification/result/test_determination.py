import numpy as np

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples, VirtualRobot
from asbuilt.identification import IdentificationResult, determination, identify_samples


def samples(robot: str, *, duration: float = 20.0, still: tuple[int, ...] = ()) -> Samples:
    model = load_robot(robot)
    machine = VirtualRobot.ideal(model).with_drive(
        DriveSet.parse("viscous,coulomb"), np.tile([1.0, 2.0], model.n_joints)
    )
    motion = random_fourier(model, rng=3, duration=duration)
    sampled = motion.sample(100.0)
    q, qd, qdd = (np.array(x) for x in (sampled.q, sampled.qd, sampled.qdd))
    for k in still:
        q[:, k] = 0.3
        qd[:, k] = qdd[:, k] = 0.0
    tau = machine.exact_torque(q, qd, qdd) + np.random.default_rng(0).normal(
        scale=0.1, size=q.shape
    )
    return Samples(sampled.t, q, qd, qdd, tau, rate=100.0, joint_names=model.joint_names)


def identified(robot: str, **motion: object) -> IdentificationResult:
    model = load_robot(robot)
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb,offset"))
    return identify_samples(model, samples(robot, **motion), base=base)  # type: ignore[arg-type]


def test_every_parameter_is_in_one_class_by_its_error() -> None:
    result = identified("scara")
    told = determination(result)
    for parameter in result.parameters:
        size = max(abs(parameter.estimate), abs(np.nan_to_num(parameter.cad)))
        expected = (
            told.not_at_all
            if not parameter.determined
            else (
                told.well
                if parameter.std_error <= 0.1 * size
                else told.hardly
                if parameter.std_error > 0.5 * size
                else told.fairly
            )
        )
        assert parameter.name in expected
    assert (
        len(told.well) + len(told.fairly) + len(told.hardly) + len(told.not_at_all) == result.n_base
    )
    assert told.in_short.startswith(
        f"Standard error at most 10 %: {len(told.well)} of {result.n_base}"
    )


def test_what_is_hardly_known_is_poorly_determined_or_makes_next_to_no_torque() -> None:
    """Moving a negligible parameter by its error moves the torque by less than a twentieth of the
    residual, by a regressor of its own; the others by more.
    """
    model, taken = load_robot("ur10e"), samples("ur10e", duration=10.0)
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb,offset"))
    result = identify_samples(model, taken, base=base, method="entropic")
    told = determination(result, motions=False)
    W = observation_matrix(
        model, taken.q, taken.qd, taken.qdd, drive=base.drive, columns=base.columns
    )
    felt = (
        np.linalg.norm(W / np.tile(result.sigma, len(taken.t))[:, None], axis=0)
        / np.sqrt(len(taken.t))
        * result.std_errors
    )
    assert 0 < len(told.negligible) < len(told.hardly)
    for name in told.hardly:
        assert (felt[base.names.index(name)] < 0.05) == (name in told.negligible)
    assert f"{len(told.negligible)} of which change the torque of this motion" in told.in_short


def test_a_joint_that_stands_still_is_said_and_moving_it_is_advised() -> None:
    result = identified("scara", still=(0,))
    told = determination(result)
    assert {"Fv1", "Fc1"} & set(told.not_at_all)
    name = result.joint_names[0]
    assert any(name in tip.motion or "all joints" in tip.motion for tip in told.advice)
    assert any("Fv1" in tip.names for tip in told.advice)


def test_trade_offs_are_directions_that_hardly_change_the_torque() -> None:
    result = identified("kuka-iiwa7-r800", duration=4.0)
    told = determination(result)
    assert told.combinations
    information = np.linalg.inv(result.covariance)
    for each in told.combinations:
        j = result.base.names.index(each.names[0])
        inflation = np.sqrt(result.covariance[j, j] * information[j, j])
        assert inflation >= each.spread * 0.99 >= 2.0
    assert any("Correlated" in line for line in told.sentences)


def test_advised_motion_really_helps() -> None:
    """With the advised kind of motion added, drawn anew, the named errors must fall."""
    model = load_robot("scara")
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb,offset"))
    poor = samples("scara", still=(0,))
    before = identify_samples(model, poor, base=base)
    rich = samples("scara", duration=30.0)
    after = identify_samples(model, [poor, rich], base=base)
    helped = {name for tip in determination(before).advice for name in tip.names}
    assert helped
    for name in helped:
        j = base.names.index(name)
        assert after.parameters[j].determined
        if before.parameters[j].determined:
            assert after.std_errors[j] < before.std_errors[j]


def test_document_is_plain() -> None:
    document = determination(identified("scara")).as_dict()
    assert document["well"]
    assert all(isinstance(line, str) for line in document["sentences"])
