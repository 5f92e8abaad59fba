"""The next motion of a robot on legs: what is predicted of it is what its log brings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt import identify
from asbuilt.description.load import load_robot
from asbuilt.experiment.logs.readers import read_recording
from asbuilt.experiment.quality.checks import check_recording
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.identification.information.known_information import known_information
from asbuilt.identification.result.determination import (
    error_ratios,
    sample_information,
    weak_parameters,
)
from asbuilt.identification.result.leg_advice import standing_posture
from asbuilt.workflow.prepare import prepare


@pytest.mark.study
def test_the_gain_of_a_further_motion_is_predicted(shared: Path) -> None:
    """Solo12's second 10 s determine as much more as the states of that time say."""
    model = load_robot(
        shared / "models/solo12/solo12.urdf",
        base="free",
        contacts=",".join(f"{foot}:0.0186" for foot in ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")),
    )
    whole = read_recording(shared / "data/solo12/solo12.csv", model=model, torque_source="motor")
    half = len(whole.t) // 2
    settings = {"method": "wls", "effects": "none", "holdout": None}
    first = identify(model, whole.taken(slice(0, half)), **settings).result
    both = identify(model, whole, **settings).result
    (samples,) = prepare(model, [whole], chain=first.chain).training
    rest = slice(samples.t.size // 2, None)
    extra = sample_information(
        first,
        samples.q[rest],
        samples.qd[rest],
        samples.qdd[rest],
        samples.contact[rest],
        samples.noise,
    )
    weak = weak_parameters(first)
    # Of 20 s, of which half are recorded.
    (expected,) = error_ratios(first, known_information(first), weak, [0.5 * extra])
    found = (both.std_errors / first.std_errors)[weak]
    assert np.median(found) == pytest.approx(np.median(expected), rel=0.15)


def test_findings_of_legs_name_no_held_robot(shared: Path) -> None:
    model = load_robot(
        shared / "models/solo12/solo12.urdf",
        base="free",
        contacts="FL_FOOT,FR_FOOT,HL_FOOT,HR_FOOT",
    )
    whole = read_recording(shared / "data/solo12/solo12.csv", model=model, torque_source="motor")
    check = check_recording(model, whole)
    assert {"weak_excitation", "rank_deficient"}.isdisjoint(check.codes)
    assert all(f.cure is None or f.cure.call != "design_motion" for f in check.findings)
    study = identify(model, whole, effects="none", method="wls")
    (finding,) = (each for each in study.findings if each.code == "weak_excitation")
    assert "20 s of lifting one foot after the other" in finding.message
    assert finding.message.count("halve") == 1
    assert not study.determination.advice
    samples = prepare_samples(replace(whole, contact=0.0 * whole.contact), study.result.chain)
    assert np.all(standing_posture([samples])[4:6] == 0.0)
