"""A joint whose torque channel is dead or missing costs its own rows and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import asbuilt
from asbuilt.arrays import Array
from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.errors import RecordingError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    Recording,
    SignalChain,
    check_recording,
    prepare_samples,
    read_recording,
    simulate_recording,
)
from asbuilt.identification import IdentificationResult, identify_samples
from asbuilt.validation import validate_samples
from asbuilt.workflow import Study, identify
from studied_cases import first_of

DRIVE = DriveSet.parse("viscous,coulomb,offset")
DEAD = 4


@pytest.fixture(scope="module")
def recording() -> Recording:
    model = load_robot("kuka-iiwa7-r800")
    motion = random_fourier(model, rng=3, duration=20.0)
    exact = simulate_recording(model, motion, rate=100.0, rng=3)
    noise = 0.1 * np.random.default_rng(3).normal(size=exact.tau.shape)
    return replace(exact, tau=exact.tau + noise)


def with_channel(recording: Recording, joint: int, value: float) -> Recording:
    tau = np.array(recording.tau)
    tau[:, joint] = value
    return replace(recording, tau=tau)


def columns_of(recording: Recording, without: int) -> dict[str, Array]:
    """The recording as named columns, without the torque of one joint."""
    columns = {"t": recording.t}
    for k in range(recording.n_joints):
        columns[f"q_{k}"] = recording.q[:, k]
        if k != without:
            columns[f"tau_{k}"] = recording.tau[:, k]
    return columns


def test_nan_constant_and_absent_channels_are_one_and_the_same(recording: Recording) -> None:
    model = load_robot("kuka-iiwa7-r800")
    whole = replace(recording, qd=None, qdd=None, extra={})
    forms = (
        with_channel(whole, DEAD, np.nan),
        with_channel(whole, DEAD, 0.0),
        with_channel(whole, DEAD, -1.25),
        read_recording(columns_of(whole, DEAD), model=model),
    )
    results = [
        identify_samples(model, prepare_samples(each, SignalChain(cutoff=6.0)), drive=DRIVE)
        for each in forms
    ]
    for each in results[1:]:
        np.testing.assert_array_equal(each.estimates, results[0].estimates)
        np.testing.assert_array_equal(each.covariance, results[0].covariance)


def test_rows_of_the_other_joints_are_fitted_as_numpy_fits_them(recording: Recording) -> None:
    model = load_robot("kuka-iiwa7-r800")
    chain = SignalChain(cutoff=6.0, parallel_cutoff=None, velocity="derived")
    samples = prepare_samples(with_channel(recording, DEAD, np.nan), chain)
    result = identify_samples(model, replace(samples, parallel=None), drive=DRIVE, method="ols")
    base = find_base_parameters(model, DRIVE)
    W = observation_matrix(
        model, samples.q, samples.qd, samples.qdd, drive=DRIVE, columns=base.columns
    ).reshape(*samples.q.shape, base.n_base)
    used = np.arange(model.n_joints) != DEAD
    rows, tau = W[:, used].reshape(-1, base.n_base), samples.tau[:, used].reshape(-1)
    scale = np.linalg.norm(rows, axis=0)
    seen = scale > 0.0
    expected = np.linalg.lstsq(rows[:, seen] / scale[seen], tau, rcond=None)[0] / scale[seen]
    determined = np.array([each.determined for each in result.parameters])
    assert {base.names[j] for j in np.flatnonzero(~determined)} == {"Fv5", "Fc5", "Fo5"}
    np.testing.assert_allclose(result.estimates[seen], expected, rtol=1e-6, atol=1e-8)
    error = rows[:, seen] @ expected - tau
    variance = error @ error / (len(tau) - np.count_nonzero(seen))
    gram = np.linalg.inv((rows[:, seen] / scale[seen]).T @ (rows[:, seen] / scale[seen]))
    textbook = np.sqrt(variance * np.diag(gram)) / scale[seen]
    found = np.array([each.textbook_std_error for each in result.parameters])
    np.testing.assert_allclose(found[seen], textbook, rtol=1e-6)


@pytest.mark.parametrize("method", first_of(1, ["auto", "huber", "consistent", "ml"]))
def test_good_joints_are_predicted_and_the_dead_one_is_unknown(
    recording: Recording, method: str
) -> None:
    model = load_robot("kuka-iiwa7-r800")
    chain = SignalChain(cutoff=6.0)
    whole = prepare_samples(recording, chain)
    dead = prepare_samples(with_channel(recording, DEAD, 0.0), chain)
    result = identify_samples(model, dead, drive=DRIVE, method=method)
    good = np.arange(model.n_joints) != DEAD
    reference = identify_samples(model, whole, drive=DRIVE, method=method)
    seen, wanted = (validate_samples(each, whole).metrics_as_built for each in (result, reference))
    assert np.all(seen.rms[good] < 1.1 * wanted.rms[good])
    unseen = validate_samples(result, dead).metrics_as_built
    assert np.isnan(unseen.rms[DEAD])
    assert np.isfinite(unseen.relative_error)
    again = IdentificationResult.from_json(result.to_json())
    np.testing.assert_array_equal(again.sigma, result.sigma)
    assert np.isinf(again.sigma[DEAD])


def test_one_warning_names_the_joint_the_value_and_the_cure(recording: Recording) -> None:
    model = load_robot("kuka-iiwa7-r800")
    name = model.joint_names[DEAD]
    for value, said in ((0.0, "is 0 N m in all 2001 samples"), (np.nan, "is not logged in any of")):
        dead = with_channel(recording, DEAD, value)
        (found,) = [
            each for each in check_recording(model, dead).findings if each.severity != "info"
        ]
        assert (found.code, found.joint) == ("joint_without_torque", name)
        assert said in found.message
        assert "columns" in str(found.cure)


def test_a_joint_at_rest_with_a_constant_torque_has_a_channel() -> None:
    t, q = np.arange(0.0, 1.0, 0.01), np.zeros((100, 2))
    q[:, 1] = np.sin(t)
    assert Recording(t=t, q=q, tau=np.ones_like(q)).has_torque.tolist() == [True, False]


def test_no_torque_at_all_is_an_error(recording: Recording) -> None:
    model = load_robot("kuka-iiwa7-r800")
    silent = replace(recording, tau=np.full_like(recording.tau, np.nan))
    assert "no_torque" in [each.code for each in check_recording(model, silent).errors]


def of_lwr4(shared: Path, channel: float) -> tuple[Study, Study]:
    """Studies of a KUKA LWR4+, whole and with joint 5's torque replaced."""
    model = load_robot(str(shared / "models/kuka_lwr4.urdf"))
    log = read_recording(shared / "data/kuka_lwr4/measurements_1.npz", model=model)
    return identify(model, log), identify(model, with_channel(log, 4, channel))


@pytest.mark.study
@pytest.mark.parametrize("channel", [0.0, np.nan])
def test_a_dead_channel_of_a_real_arm_leaves_the_others(shared: Path, channel: float) -> None:
    whole, dead = of_lwr4(shared, channel)
    good = np.arange(7) != 4
    before, after = (each.validations[0].metrics_as_built.rms for each in (whole, dead))
    # All together: what the torque of one joint told of links is gone, and no effect stands at a
    # joint without torque that could imitate it, so that single joints may get worse.
    assert np.linalg.norm(after[good]) < 1.15 * np.linalg.norm(before[good])
    assert not [effect for effect in dead.effects if effect.joint == dead.findings[0].joint]
    assert dead.findings[0].code == "joint_without_torque"
    assert np.isnan(after[4])
    friction = [each for each in dead.result.parameters if each.name in ("Fv5", "Fc5", "Fo5")]
    assert len(friction) == 3
    assert not any(each.determined for each in friction)
    largest = float(np.max(np.abs(dead.validations[0].measured[:, good])))
    assert all(abs(each.estimate) < 0.2 * largest for each in friction)


@pytest.mark.study
def test_an_absent_column_of_a_real_arm_leaves_the_others(shared: Path, tmp_path: Path) -> None:
    lines = (shared / "data/lbr_med7/measurements.csv").read_text().splitlines()
    table = [line.split(",") for line in lines]
    kept = [k for k, name in enumerate(table[0]) if name != "tau_1"]
    log = tmp_path / "log.csv"
    log.write_text("\n".join(",".join(row[k] for k in kept) for row in table))
    model = load_robot(str(shared / "models/lbrstack_med7.urdf"))
    read = read_recording(log, model=model, rate=100.0, flip_torque=True)
    assert read.has_torque.tolist() == [True, False, True, True, True, True, True]
    study = identify(model, read)
    assert study.findings[0].joint == model.joint_names[1]
    assert np.isfinite(study.result.train.relative_error)


def test_a_sliding_joint_in_millimetres_is_named_with_its_cure() -> None:
    model = load_robot("scara")
    k = next(k for k, joint in enumerate(model.joints) if not joint.is_revolute)
    motion = random_fourier(model, rng=2, duration=10.0)
    log = simulate_recording(model, motion, rate=100.0, rng=2)
    q = np.array(log.q)
    q[:, k] *= 1e3
    wrong = replace(log, q=q, qd=None, qdd=None)
    (found,) = [each for each in check_recording(model, wrong).errors if each.code == "millimetres"]
    assert found.joint == model.joint_names[k]
    assert f'[joint_units] {found.joint} = "mm"' in str(found.cure)
    assert "millimetres" not in check_recording(model, log).codes


@pytest.mark.apps("watch")
def test_an_observer_needs_the_torque_of_every_joint(recording: Recording) -> None:
    model = load_robot("kuka-iiwa7-r800")
    result = identify_samples(model, prepare_samples(recording, SignalChain(cutoff=6.0)))
    with pytest.raises(RecordingError, match=model.joint_names[DEAD]):
        asbuilt.watch(result, with_channel(recording, DEAD, np.nan))
