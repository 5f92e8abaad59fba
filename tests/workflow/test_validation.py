"""Validation of a stored result gives the numbers of its study to the last digit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.errors import RecordingError, ResultError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, SignalChain, VirtualRobot, read_recording, resolve_chain
from asbuilt.validation import Validation
from asbuilt.workflow import (
    Study,
    StudyOptions,
    ValidationOptions,
    identify,
    read_result,
    read_study,
    validate,
    validate_robot,
)
from asbuilt.writers import write_result
from command_line import document

ARM = "scara"
WLS = StudyOptions(method="wls", holdout=None)


def recorded(seed: int, duration: float, harmonics: int) -> Recording:
    model = load_robot(ARM)
    robot = VirtualRobot.typical(model, rng=5)
    motion = random_fourier(model, rng=seed, duration=duration, n_harmonics=harmonics)
    return robot.record(motion, rate=400.0, rng=seed).recording


@pytest.fixture(scope="module")
def slow() -> Recording:
    return recorded(1, 20.0, 5)


@pytest.fixture(scope="module")
def slow_study(slow: Recording) -> Study:
    return identify(ARM, slow, options=WLS)


@pytest.fixture(scope="module")
def fast() -> Recording:
    """A recording of so much more bandwidth that another chain would be chosen for it alone."""
    return recorded(2, 10.0, 12)


def same(one: Validation, other: Validation) -> None:
    assert one.metrics_as_built.as_dict() == other.metrics_as_built.as_dict()
    assert one.metrics_cad.as_dict() == other.metrics_cad.as_dict()
    np.testing.assert_array_equal(one.predicted, other.predicted)


@pytest.mark.study
def test_a_result_keeps_its_chain(slow: Recording, fast: Recording, tmp_path: Path) -> None:
    study = identify(ARM, slow, validation=fast, options=WLS)
    alone = resolve_chain(SignalChain(), slow)
    together = replace(resolve_chain(SignalChain(), slow, fast), delay=None)
    assert study.result.chain == together != alone
    stored = read_result(write_result(tmp_path / "result.json", study))
    assert stored.chain == study.result.chain
    (validation,) = validate(stored, fast)
    same(validation, study.validations[0])
    (other,) = validate(stored, slow, options=ValidationOptions(chain=alone))
    assert other.metrics_as_built.n_samples != study.training[0].metrics_as_built.n_samples
    same(validate(study, [fast, slow])[1], study.training[0])


@pytest.mark.study
def test_of_a_training_recording_only_what_was_held_out_is_predicted(
    slow: Recording, fast: Recording, tmp_path: Path
) -> None:
    study = identify(ARM, slow, options=replace(WLS, holdout="blocks:3s:3"))
    stored = read_result(write_result(tmp_path / "result.json", study))
    assert stored.holdout == "blocks:3s:3"
    again, other = validate(stored, [replace(slow, source="renamed"), fast])
    assert again.source == "renamed, held out blocks:3s:3"
    np.testing.assert_array_equal(again.error, study.validations[0].error)
    assert "held out" not in other.source


@pytest.mark.study
def test_a_stored_study_keeps_its_findings(slow_study: Study, tmp_path: Path) -> None:
    study = slow_study
    again = read_study(write_result(tmp_path / "result.json", study))
    assert again.findings == study.findings
    assert {"nothing_held_out"} <= {finding.code for finding in again.findings}
    assert again.to_json() == study.to_json()
    assert again.result.findings == study.result.findings != study.findings
    whole = json.loads(study.to_json())
    said = [{"code": each.code, "message": each.text} for each in study.findings]
    assert whole["warnings"] == said
    alone = read_study(write_result(tmp_path / "alone.json", study.result))
    assert alone.findings == study.result.findings
    whole["study"]["findings"][0].pop("code")
    (tmp_path / "broken.json").write_text(json.dumps(whole))
    with pytest.raises(ResultError, match=r"broken.json.*damaged"):
        read_study(tmp_path / "broken.json")


def test_a_file_that_is_not_there_is_no_result(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="cannot be read") as caught:
        read_result(tmp_path / "nothing.json")
    assert caught.value.file == str(tmp_path / "nothing.json")


@pytest.mark.study
def test_a_spoilt_recording_is_refused_unless_unchecked(fast: Recording) -> None:
    study = identify(ARM, fast, options=WLS)
    with pytest.raises(RecordingError) as refused:
        validate(study, fast.flipped())
    assert refused.value.code == "torque_flipped"
    validate(study, fast.flipped(), options=ValidationOptions(checked=False))


@pytest.mark.study
def test_another_description_takes_the_place_of_cad(slow: Recording, slow_study: Study) -> None:
    study = slow_study
    model = load_robot(ARM)
    heavy = model.with_parameters(1.5 * model.parameters)
    (one,), (other,) = (
        validate(study, slow, options=ValidationOptions(cad=cad)) for cad in (ARM, heavy)
    )
    np.testing.assert_array_equal(one.predicted, other.predicted)
    assert one.metrics_cad.rms.tolist() == study.training[0].metrics_cad.rms.tolist()
    assert not np.allclose(other.predicted_cad, one.predicted_cad)


@pytest.mark.study
def test_a_robot_as_described_is_validated_too(slow: Recording, slow_study: Study) -> None:
    (metrics,) = validate_robot(ARM, slow)
    assert metrics.source == slow.source
    assert metrics.relative_error > slow_study.result.train.relative_error


@pytest.mark.study
def test_the_real_arm_of_two_bandwidths(
    shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Trained at 12 harmonics, validated on ten points: the same samples then and later."""
    robot, data = shared / "models/ur10e.urdf", shared / "data/ur10e"
    sheet = tmp_path / "ur10e.toml"
    sheet.write_text(
        'header = false\ntorque_source = "current"\n'
        "gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]\n"
        '[columns]\ntime = 1\nposition = "2-7"\nvelocity = "8-13"\ntorque = "14-19"\n'
    )
    train, held = (
        data / f"ur-20_{name}.csv" for name in ("02_10-30sec_12harm", "01_17-ptp_10_points")
    )
    study = document(
        capsys, "identify", robot, train, "--validate", held, "--sheet", sheet, "--out", tmp_path,
        "--method", "wls",
    )  # fmt: skip
    result = tmp_path / "result.json"
    again = document(capsys, "validate", result, held, "--sheet", sheet)
    assert again["validation"] == study["validation"]
    assert again["cad"] == [study["cad"]]
    n_samples = study["validation"][0]["n_samples"]
    assert n_samples > 300
    assert study["chain"]["cutoff"] > 0
    own = document(capsys, "validate", result, held, "--sheet", sheet, "--preset", "default")
    assert own["validation"] == study["validation"]
    cut = document(capsys, "validate", result, held, "--sheet", sheet, "--cutoff", "3")
    assert cut["validation"][0]["n_samples"] < n_samples
    assert read_recording(held, sheet=sheet).n_samples > n_samples
    assert isinstance(read_study(result), Study)
