"""Findings on recordings spoilt on purpose, on Pinocchio's torques, and on real robots."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import RobotModel, bundled_robot, load_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import RecordingError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    Recording,
    RecordingSheet,
    check_recording,
    prepare_samples,
    read_recording,
    read_recordings,
)
from fourier_recording import record

HARD_STOPS = ("20_01_31", "14harm50sec")
"""Parts of the names of logs that end with a single current of 4 to 13 A as the robot stops."""
ERRORS_OF_CLEAN = {"weak_excitation"}


@pytest.fixture(scope="module")
def iiwa() -> RobotModel:
    return bundled_robot("kuka-iiwa7-r800")


@pytest.fixture(scope="module")
def clean(iiwa: RobotModel) -> Recording:
    return record(iiwa, 3)


def swapped(values: np.ndarray, i: int, j: int) -> np.ndarray:
    order = np.arange(values.shape[1])
    order[[i, j]] = order[[j, i]]
    return values[:, order]


def finding(model: RobotModel, recording: Recording, code: str):
    check = check_recording(model, recording)
    found = [item for item in check.findings if item.code == code]
    assert found, check.as_text()
    assert found[0].cure
    assert any(character.isdigit() for character in found[0].message)
    return found[0]


@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "ur10e", "franka-panda", "puma-560"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.study)])
def test_no_false_alarm(name: str, seed: int) -> None:
    model = bundled_robot(name)
    check = check_recording(model, record(model, seed))
    assert set(check.codes) <= ERRORS_OF_CLEAN, check.as_text()
    assert check.ok
    check.raise_errors()


def test_single_torques_that_stand_out_are_named_and_not_used(
    iiwa: RobotModel, clean: Recording
) -> None:
    tau, rows = np.array(clean.tau), np.arange(50, clean.n_samples - 20, 40)
    tau[rows, 3] += 80.0
    spoilt = replace(clean, tau=tau)
    found = finding(iiwa, spoilt, "torque_spikes")
    assert found.joint == iiwa.joint_names[3]
    assert found.message.startswith(f"{len(rows)} of {clean.n_samples} torques")
    used, wanted = prepare_samples(spoilt).tau, prepare_samples(clean).tau
    np.testing.assert_allclose(used, wanted, atol=0.02 * np.abs(wanted[:, 3]).max())


def test_noise_of_joints_at_rest_is_no_velocity(iiwa: RobotModel, clean: Recording) -> None:
    """Encoder noise of 1e-5 rad and independent noise of the velocities, on all joints but two."""
    rng = np.random.default_rng(0)
    q, qd = clean.q.copy(), np.gradient(clean.q, clean.t, axis=0)
    q[:, 2:], qd[:, 2:] = clean.q[0, 2:], 0.0
    q += 1e-5 * rng.normal(size=q.shape)
    qd += 1e-3 * rng.normal(size=q.shape)
    tau = inverse_dynamics(iiwa, q, qd, np.gradient(qd, clean.t, axis=0))
    check = check_recording(iiwa, replace(clean, q=q, qd=qd, tau=tau))
    assert not {code for code in check.codes if code.startswith("velocity_")}, check.as_text()


@pytest.mark.study
def test_pinocchio_torques_pass_and_flipped_ones_do_not(shared: Path) -> None:
    pin = pytest.importorskip("pinocchio")
    path = shared / "models" / "lbrstack_med7.urdf"
    oracle = pin.buildModelFromUrdf(str(path))
    data = oracle.createData()
    model = load_robot(path)
    recording = record(model, 4, lambda q, qd, qdd: pin.rnea(oracle, data, q, qd, qdd))
    assert check_recording(model, recording).ok
    check = check_recording(model, replace(recording, tau=-recording.tau))
    assert [item.code for item in check.errors] == ["torque_flipped"]
    with pytest.raises(
        RecordingError, match=r"torque sign looks flipped.*flip the torque sign"
    ) as error:
        check.raise_errors()
    assert error.value.cure.settings == {"flip_torque": True}
    assert error.value.code == "torque_flipped"
    for i in range(6):
        both = replace(
            recording,
            q=swapped(recording.q, i, i + 1),
            qd=swapped(recording.qd, i, i + 1),
            tau=swapped(recording.tau, i, i + 1),
        )
        torques = replace(recording, tau=swapped(recording.tau, i, i + 1))
        if i < 5:
            assert {
                item.code
                for spoilt in (both, torques)
                for item in check_recording(model, spoilt).errors
            } == {"joints_swapped"}


@pytest.mark.parametrize("joint", [1, 3])
def test_one_joint_flipped(iiwa: RobotModel, clean: Recording, joint: int) -> None:
    sign = np.ones(7)
    sign[joint] = -1
    found = finding(iiwa, replace(clean, tau=clean.tau * sign), "joint_torque_flipped")
    assert found.joint == iiwa.joint_names[joint]
    assert f"sign = [{', '.join('-1' if k == joint else '1' for k in range(7))}]" in str(found.cure)


@pytest.mark.parametrize("flipped", [(1, 3), (0, 1, 2, 4, 5, 6)])
def test_the_cure_of_one_flipped_joint_corrects_all(
    iiwa: RobotModel, clean: Recording, flipped: tuple[int, ...]
) -> None:
    sign = np.where(np.isin(np.arange(7), flipped), -1.0, 1.0)
    spoilt = replace(clean, tau=clean.tau * sign)
    found = [
        item
        for item in check_recording(iiwa, spoilt).findings
        if item.code in ("torque_flipped", "joint_torque_flipped")
    ]
    (cure,) = {str(item.cure) for item in found if item.severity == "error"}
    signs = np.array([float(each) for each in cure.split("[")[1].split("]")[0].split(",")])
    cured = check_recording(iiwa, replace(spoilt, tau=spoilt.tau * signs))
    assert not {"torque_flipped", "joint_torque_flipped"} & set(cured.codes)


@pytest.mark.parametrize("joint", [0, 2, 6])
def test_friction_decides_the_sign_of_joints_without_load(shared: Path, joint: int) -> None:
    lwr = load_robot(shared / "models" / "kuka_lwr4.urdf")
    recording = read_recording(shared / "data" / "kuka_lwr4" / "measurements_1.npz", model=lwr)
    check = check_recording(
        lwr, replace(recording, tau=recording.tau * np.where(np.arange(7) == joint, -1, 1))
    )
    assert [item.joint for item in check.findings if item.code == "joint_torque_flipped"] == [
        lwr.joint_names[joint]
    ]


def test_without_friction_unloaded_joints_pass(iiwa: RobotModel, clean: Recording) -> None:
    rng = np.random.default_rng(8)
    built = iiwa.parameters * np.repeat(1 + 0.5 * rng.uniform(-1, 1, 7), 10)
    qdd = np.gradient(clean.qd, clean.t, axis=0)
    check = check_recording(
        iiwa, replace(clean, tau=inverse_dynamics(iiwa, clean.q, clean.qd, qdd, parameters=built))
    )
    assert "joint_torque_flipped" not in check.codes


def test_swapped_joints_are_named(iiwa: RobotModel, clean: Recording) -> None:
    found = finding(iiwa, replace(clean, tau=swapped(clean.tau, 1, 3)), "joints_swapped")
    assert "A2 fits the position of A2 and the torque of A4" in found.message
    both = replace(
        clean, q=swapped(clean.q, 1, 3), qd=swapped(clean.qd, 1, 3), tau=swapped(clean.tau, 1, 3)
    )
    assert (
        "A2 fits position and torque logged for A4" in finding(iiwa, both, "joints_swapped").message
    )


def test_a_whole_shuffle_is_found(iiwa: RobotModel, clean: Recording) -> None:
    order = [1, 2, 3, 0, 4, 5, 6]
    assert (
        finding(iiwa, replace(clean, tau=clean.tau[:, order]), "joints_swapped").severity == "error"
    )


def test_flipped_and_swapped_at_once(iiwa: RobotModel, clean: Recording) -> None:
    check = check_recording(iiwa, replace(clean, tau=-swapped(clean.tau, 1, 3)))
    assert {"joints_swapped", "torque_flipped"} <= set(check.codes)


def test_units(iiwa: RobotModel, clean: Recording) -> None:
    degree = np.pi / 180
    assert (
        "as degrees every joint keeps its limits"
        in finding(
            iiwa, replace(clean, q=clean.q / degree, qd=clean.qd / degree), "degrees"
        ).message
    )
    assert (
        "degrees per second"
        in finding(iiwa, replace(clean, qd=clean.qd / degree), "velocity_units").message
    )
    assert "mN m" in finding(iiwa, replace(clean, tau=clean.tau * 1000), "torque_scale").message
    cure = finding(iiwa, replace(clean, tau=clean.tau / 12), "torque_scale").cure
    assert (cure.settings, cure.call) == ({"torque_source": "current"}, "find_gains")


def test_a_joint_at_rest_does_not_hide_the_unit_of_velocities(
    iiwa: RobotModel, clean: Recording
) -> None:
    """The derivative of a joint at rest is noise, which no velocity follows."""
    assert clean.qd is not None
    noise = np.random.default_rng(1).normal(size=(2, clean.n_samples))
    q = np.array(clean.q)
    qd = 60.0 / (2.0 * np.pi) * clean.qd
    q[:, 0] = 1e-5 * noise[0]
    qd[:, 0] = 1e-3 * noise[1]
    unit = finding(iiwa, replace(clean, q=q, qd=qd), "velocity_units")
    assert unit.cure.sheet == {"units": {"velocity": "rpm"}}


def test_parameters_of_a_joint_at_rest_are_named_as_undetermined(
    iiwa: RobotModel, clean: Recording
) -> None:
    q = np.array(clean.q)
    q[:, 0] = 0.3
    assert "Fv1" in finding(iiwa, replace(clean, q=q, qd=None), "rank_deficient").message


def test_degrees_do_not_hide_a_flipped_sign(iiwa: RobotModel, clean: Recording) -> None:
    check = check_recording(iiwa, replace(clean, q=np.degrees(clean.q), qd=None, tau=-clean.tau))
    assert [item.code for item in check.errors] == ["degrees", "torque_flipped"]


def test_velocities(iiwa: RobotModel, clean: Recording) -> None:
    assert clean.qd is not None
    assert (
        "velocity of A3 belongs to A6"
        in finding(iiwa, replace(clean, qd=swapped(clean.qd, 2, 5)), "velocity_swapped").message
    )
    # Positions of one joint with velocities of another say nothing of the order of the torques.
    mixed = check_recording(iiwa, replace(clean, q=swapped(clean.q, 3, 4)))
    assert [item.code for item in mixed.errors] == ["velocity_swapped"]
    late = finding(iiwa, replace(clean, qd=np.roll(clean.qd, 4, axis=0)), "velocity_lag")
    assert "lag behind the derivative of the positions by 20 ms" in late.message
    sign = np.array([1, 1, -1, 1, 1, 1, 1])
    assert finding(iiwa, replace(clean, qd=clean.qd * sign), "velocity_mismatch").joint == "A3"
    assert finding(iiwa, replace(clean, qd=np.zeros_like(clean.qd)), "velocity_zero")


def test_one_factor_of_all_velocities_is_a_wrong_rate(iiwa: RobotModel, clean: Recording) -> None:
    assert clean.qd is not None
    for factor in (0.5, 2.0):
        found = finding(iiwa, replace(clean, t=clean.t / factor), "rate_wrong")
        assert found.cure is not None
        assert found.cure.settings["rate"] == pytest.approx(200.0, rel=0.02)
        assert found.severity == "error"
    one = np.where(np.arange(7) == 2, 0.5, 1.0)
    check = check_recording(iiwa, replace(clean, qd=clean.qd * one))
    assert "rate_wrong" not in check.codes
    assert "velocity_mismatch" in check.codes
    assert "rate_wrong" not in check_recording(iiwa, replace(clean, qd=clean.qd * 9.549)).codes


def test_the_scale_of_a_gravity_torque_is_doubted(iiwa: RobotModel, clean: Recording) -> None:
    less = np.where(np.arange(7) == 3, 0.4, 1.0)
    found = finding(iiwa, replace(clean, tau=clean.tau * less), "torque_scale")
    assert (found.joint, found.severity) == ("A4", "warning")
    assert found.cure is not None
    assert found.cure.call == "find_gains"


@pytest.mark.parametrize("name", ["franka-panda", "so-101", "puma-560"])
def test_the_scale_of_torques_is_doubted_without_masses(name: str) -> None:
    known = bundled_robot(name)
    recording = record(known, 3)
    model = known.with_parameters(np.zeros(10 * known.n_links))
    assert "torque_scale" not in check_recording(model, recording).codes
    lost = finding(model, replace(recording, tau=recording.tau / 60), "torque_scale")
    assert (lost.severity, lost.cure.call) == ("warning", "find_gains")
    assert "mN m" in str(
        finding(model, replace(recording, tau=recording.tau * 1e3), lost.code).cure
    )


@pytest.mark.parametrize("robot", ["two-link", "four-bar"])
def test_a_joint_without_any_position_is_told(robot: str) -> None:
    model = bundled_robot(robot)
    t = np.arange(200) / 100.0
    q = 0.1 * np.sin(t)[:, None] * np.ones(model.n_joints)
    q[:, 0] = np.nan
    check = check_recording(model, Recording(t, q, np.cos(q) + t[:, None]))
    assert "200 of 200" in next(item for item in check.errors if item.code == "not_finite").message


def test_missing_values(iiwa: RobotModel, clean: Recording) -> None:
    tau, q = clean.tau.copy(), clean.q.copy()
    tau[123, 4] = np.nan
    q[7, 0] = np.inf
    first = finding(iiwa, replace(clean, q=q), "not_finite")
    assert (first.joint, first.time) == ("A1", pytest.approx(0.035))
    assert "the first infinite at sample 8" in first.message
    assert (
        "1 of 4000 values of the torque of A5"
        in finding(iiwa, replace(clean, tau=tau), "not_finite").message
    )


def test_clock(iiwa: RobotModel, clean: Recording) -> None:
    t = clean.t.copy()
    t[2000:] += 0.3
    assert (
        "the longest 0.305 s after 9.995 s"
        in finding(iiwa, replace(clean, t=t), "clock_gap").message
    )
    t = clean.t.copy()
    t[1000] = t[999]
    assert finding(iiwa, replace(clean, t=t), "clock_repeated").severity == "warning"
    t = clean.t.copy()
    t[1000:] -= 0.1
    assert (
        "from 4.995 s to 4.9 s at sample 1001"
        in finding(iiwa, replace(clean, t=t), "clock_backward").message
    )
    jitter = clean.t + 0.001 * np.random.default_rng(0).uniform(-1, 1, clean.t.size)
    assert finding(iiwa, replace(clean, t=jitter), "clock_irregular").severity == "info"


def test_stale_samples(iiwa: RobotModel, clean: Recording) -> None:
    held = np.repeat(np.arange(0, 4000, 2), 2)
    found = finding(
        iiwa,
        replace(clean, q=clean.q[held], qd=clean.qd[held], tau=clean.tau[held]),
        "stale_samples",
    )
    assert "about every 2 samples (100 Hz)" in found.message


def test_saturation(iiwa: RobotModel, clean: Recording) -> None:
    ceiling = float(np.percentile(clean.tau[:, 1], 95))
    found = finding(
        iiwa,
        replace(clean, tau=np.minimum(clean.tau, np.where(np.arange(7) == 1, ceiling, np.inf))),
        "saturation",
    )
    assert found.joint == "A2"
    assert f"{ceiling:.5g} N m in 200 of 4000 samples" in found.message


def test_coarse_torques_are_not_saturated(iiwa: RobotModel, clean: Recording) -> None:
    assert (
        "saturation" not in check_recording(iiwa, replace(clean, tau=np.round(clean.tau, 1))).codes
    )


def test_joints_at_rest_or_in_step(iiwa: RobotModel, clean: Recording) -> None:
    q = clean.q.copy()
    q[:, 2] = 0.4 + 0.005 * np.sin(clean.t)
    assert (
        "A3 hardly moves: its position range is 0.01 rad"
        in finding(iiwa, replace(clean, q=q, qd=None), "joint_still").message
    )
    in_step = np.outer(np.sin(clean.t), np.ones(7))
    assert (
        finding(iiwa, replace(clean, q=in_step, qd=None), "joints_correlated").severity == "warning"
    )


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("quantity", ["q", "tau", "qd"])
@pytest.mark.parametrize("value", [1e300, -1e20, np.inf, np.nan])
def test_values_that_no_robot_logs(
    iiwa: RobotModel, clean: Recording, quantity: str, value: float
) -> None:
    values = getattr(clean, quantity).copy()
    values[500, 2] = value
    found = finding(iiwa, replace(clean, **{quantity: values}), "not_finite")
    assert (found.severity, found.joint) == ("error", "A3")
    assert "1 of 4000 values of the" in found.message
    assert "at sample 501, t = 2.5 s" in found.message


def test_a_row_cut_short_is_one_finding(iiwa: RobotModel, clean: Recording) -> None:
    q, tau = clean.q.copy(), clean.tau.copy()
    q[-1, 5:], tau[-1] = np.nan, np.nan
    check = check_recording(iiwa, replace(clean, q=q, tau=tau))
    assert [item.code for item in check.errors] == ["not_finite"]
    assert (
        "the position of A6 and A7 and the torque of A1, A2, A3, A4, A5, A6 and A7"
        in check.errors[0].message
    )


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_clocks_in_other_units(
    iiwa: RobotModel, clean: Recording, unit: str, factor: float
) -> None:
    found = finding(iiwa, replace(clean, t=clean.t * factor), "clock_unit")
    assert f"look like {unit}" in found.message
    assert f'time = "{unit}"' in str(found.cure)
    assert finding(iiwa, replace(clean, t=clean.t / 1e3), "clock_unit").severity == "error"
    beyond = finding(iiwa, replace(clean, t=clean.t * 1e300), "clock_unit")
    assert "no known unit" in beyond.message
    flipped = check_recording(iiwa, replace(clean, t=clean.t * factor, tau=-clean.tau))
    assert [item.code for item in flipped.errors] == ["clock_unit"]


def test_a_robot_that_stands_still_is_refused(iiwa: RobotModel, clean: Recording) -> None:
    found = finding(iiwa, replace(clean, q=np.full_like(clean.q, 0.3), qd=None), "nothing_moves")
    assert found.severity == "error"


def test_limits_and_filtering(iiwa: RobotModel, clean: Recording) -> None:
    q = clean.q.copy()
    q[:, 1] += 1.5
    assert finding(iiwa, replace(clean, q=q), "position_limit").joint == "A2"
    smooth = replace(
        clean,
        tau=inverse_dynamics(
            iiwa, clean.q * 0 + np.sin(clean.t)[:, None], clean.q * 0, clean.q * 0
        ),
    )
    assert (
        "low-pass filtered before, or simulated without noise"
        in finding(iiwa, smooth, "already_filtered").message
    )


def test_too_little(iiwa: RobotModel, clean: Recording) -> None:
    assert (
        "40 samples are fewer than the 64 parameters"
        in finding(iiwa, clean.taken(slice(0, 40)), "too_few_samples").message
    )
    assert (
        finding(iiwa, replace(clean, tau=np.zeros_like(clean.tau)), "no_torque").severity == "error"
    )
    with pytest.raises(RecordingError, match=r"has 7 joints .* but ur10e has 6"):
        check_recording(bundled_robot("ur10e"), clean)


def test_joints_in_another_order_are_sorted_by_name(iiwa: RobotModel, clean: Recording) -> None:
    assert (
        check_recording(iiwa, clean.reordered(iiwa.joint_names[::-1])).findings
        == check_recording(iiwa, clean).findings
    )


def test_text_starts_with_the_verdict_and_fits_a_terminal(
    iiwa: RobotModel, clean: Recording
) -> None:
    check = check_recording(iiwa, clean.flipped())
    lines = check.as_text().splitlines()
    assert lines[0].startswith("NOT READY: the torque sign looks flipped.")
    assert "(1 ERROR in log.csv, 20 s of 7 joints at 200 Hz)" in check.headline
    assert "log.csv on kuka-iiwa7-r800, 4000 samples" in lines
    assert any(line.startswith("ERROR torque_flipped: the torque sign") for line in lines)
    assert check_recording(iiwa, clean).headline.startswith("READY")
    assert max(map(len, check.as_text(full=True).splitlines())) <= 80
    assert "torque_flipped" in repr(check)
    assert "ERROR torque_flipped" in check._repr_html_().replace("  ", " ")


def test_findings_of_one_code_are_one_paragraph(iiwa: RobotModel, clean: Recording) -> None:
    q = clean.q.copy()
    q[:, [1, 3]] += 1.5
    check = check_recording(iiwa, replace(clean, q=q, qd=None))
    assert [f.joint for f in check.findings if f.code == "position_limit"] == ["A2", "A4"]
    assert check.as_text().count("position_limit") == 1
    assert "the same holds for A4" in " ".join(check.as_text().split())
    assert check.as_text(full=True).count("position_limit") == 2


def codes(model: RobotModel, recording: Recording) -> set[str]:
    return set(check_recording(model, recording).codes) - {"note"}


@pytest.mark.study
def test_real_recordings(shared: Path) -> None:
    data, models = shared / "data", shared / "models"
    med7 = load_robot(models / "lbrstack_med7.urdf")
    folder = data / "lbr_med7"
    assert codes(
        med7, read_recording(folder / "measurements_with_ext_tau_1_dgr.csv", model=med7, rate=100)
    ) == {"torque_flipped", "band_limited_by_noise"}
    assert codes(
        med7,
        read_recording(
            folder / "measurements_with_ext_tau_1_dgr.csv",
            model=med7,
            rate=100,
            flip_torque=True,
        ),
    ) == {"band_limited_by_noise"}
    fast = read_recording(folder / "measurements.csv", model=med7, rate=100, flip_torque=True)
    assert codes(med7, fast) == {"weak_excitation"}
    (states,) = read_recordings(
        sorted(folder.glob("joint_states_*.csv")), model=med7, flip_torque=True
    )
    assert codes(med7, states) - {"band_limited_by_noise", "coarse_positions"} == {
        "stale_samples",
        "joints_correlated",
        "weak_excitation",
    }
    lwr = load_robot(models / "kuka_lwr4.urdf")
    for k in (1, 2):
        recording = read_recording(data / "kuka_lwr4" / f"measurements_{k}.npz", model=lwr)
        assert codes(lwr, recording) == {
            "joints_correlated",
            "velocity_lag",
            "end_transient",
            "already_filtered",
            "inertia_too_large",  # link 7 of this file: 2 kg with the inertia of a wheel
        }
    ur10 = load_robot(models / "ur10.urdf")
    assert codes(ur10, read_recording(data / "ur10_rosbag2", model=ur10)) == {"already_filtered"}


@pytest.mark.study
def test_real_currents(shared: Path) -> None:
    ur10e = load_robot(shared / "models" / "ur10e.urdf")
    columns = {"time": 1, "position": "2-7", "velocity": "8-13", "torque": "14-19"}
    sheet = RecordingSheet.model_validate(
        {"header": False, "torque_source": "current", "columns": columns}
    )
    for path in sorted((shared / "data" / "ur10e").glob("*.csv")):
        amperes = read_recording(path, model=ur10e, sheet=sheet)
        scaled = amperes.scaled([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])
        steps = {"coarse_positions"} if "30sec" not in path.name else set()
        steps = steps if "40sec" not in path.name else set()
        stops = {"torque_spikes"} if any(part in path.name for part in HARD_STOPS) else set()
        assert codes(ur10e, scaled) == {"clock_irregular"} | steps | stops
        assert codes(ur10e, amperes) == {"clock_irregular", "torque_scale"} | steps | stops


@pytest.mark.parametrize("seed", range(3))
def test_torque_beneath_noise_is_no_torque_of_another_robot(seed: int) -> None:
    """A SCARA without gravity, its torques as small as the noise of its sensors.

    The same noise around torques of another time is called unlike.
    """
    model = bundled_robot("scara")
    recording = record(model, seed)
    rng = np.random.default_rng(seed)
    smooth = np.array(
        [
            np.convolve(noise, np.ones(40) / 40, mode="same")
            for noise in rng.normal(size=recording.tau.T.shape)
        ]
    ).T
    noise = 1.5 * smooth / smooth.std(axis=0) * recording.tau.std(axis=0)
    codes = {
        finding.code
        for finding in check_recording(
            model, replace(recording, tau=recording.tau + noise)
        ).findings
    }
    assert "torque_uncorrelated" not in codes
    codes = {
        finding.code
        for finding in check_recording(
            model, replace(recording, tau=np.roll(recording.tau, 700, axis=0) + noise)
        ).findings
    }
    assert "torque_uncorrelated" in codes


def test_a_rate_too_high_is_no_unit(iiwa: RobotModel, clean: Recording) -> None:
    """Too fast by the clock alone: the torques still follow gravity at positions in radians."""
    fast = replace(clean, t=clean.t / 6.0, qd=None, qdd=None)
    check = check_recording(iiwa, fast)
    assert [item.code for item in check.errors] == ["rate_wrong"]
    assert "too high" in check.errors[0].message
    assert "follow gravity" in check.errors[0].message
    # Limits alone, which may be placeholders, do not tell.
    weightless = iiwa.with_gravity(np.zeros(3))
    rows = inverse_dynamics(weightless, clean.q, clean.qd, np.gradient(clean.qd, 0.005, axis=0))
    unclear = check_recording(weightless, replace(fast, tau=rows))
    assert "degrees" not in unclear.codes
    assert "velocity_limit" in unclear.codes


def test_speeds_beyond_the_limits_are_named(iiwa: RobotModel, clean: Recording) -> None:
    assert "velocity_limit" not in check_recording(iiwa, clean).codes
    fast = replace(clean, t=clean.t / 2.0, qd=None, qdd=None)
    assert "the rate of 400 Hz is too high" in finding(iiwa, fast, "velocity_limit").message
    slow = replace(clean, t=clean.t * 2.0, qd=None, qdd=None)
    assert "velocity_limit" not in check_recording(iiwa, slow).codes


def test_positions_of_another_robot_are_no_degrees() -> None:
    """The joints of a UR10e turn farther than those of a Puma, whose gravity they do not fit."""
    puma, arm = bundled_robot("puma-560"), bundled_robot("ur10e")
    samples = random_fourier(arm, rng=0, duration=20.0).sample(100.0)
    tau = inverse_dynamics(arm, samples.q, samples.qd, samples.qdd)
    log = Recording(t=samples.t, q=samples.q, tau=tau, joint_names=puma.joint_names)
    check = check_recording(puma, log)
    assert "degrees" not in check.codes
    assert check.codes[:7] == (*["position_limit"] * 6, "torque_uncorrelated")
    assert "check robot" in str(check.warnings[6].cure)


def test_flips_that_cancel_are_named(iiwa: RobotModel, clean: Recording) -> None:
    twice = check_recording(iiwa, clean.flipped().flipped())
    assert [item.code for item in twice.warnings] == ["flips_cancel"]
    assert "the same holds for" not in twice.as_text()
    (error,) = check_recording(iiwa, replace(clean, tau=-clean.tau).flipped().flipped()).errors
    assert "keep one of the two flips" in str(error.cure)
    (error,) = check_recording(iiwa, clean.flipped()).errors
    assert "flip the torque sign back" in str(error.cure)
