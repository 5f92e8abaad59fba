"""The next motion of a robot on legs: what is predicted of it is what its log brings."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt import identify
from asbuilt.description import load_robot
from asbuilt.experiment import check_recording, prepare_samples, read_recording
from asbuilt.identification import known_information
from asbuilt.identification.result.determination import (
    FURTHER_SECONDS,
    error_ratios,
    sample_information,
    weak_parameters,
)
from asbuilt.identification.result.legs import standing_posture
from asbuilt.workflow import prepare


@pytest.mark.study
def test_the_gain_of_a_further_motion_is_predicted() -> None:
    """A virtual Solo12 trots; its fall determines as much more as the states of it say."""
    pytest.importorskip("mujoco")
    sys.path.append(str(Path(__file__).parents[3] / "benchmarks"))
    from legged_robots import LEGGED
    from legs import described, recorded

    model, legged, rng = described("solo12"), LEGGED["solo12"], np.random.default_rng(5)
    trot, fall = (recorded(legged, model, kind, 20.0, rng) for kind in ("step", "flight"))
    settings = {"method": "wls", "effects": "none", "holdout": None, "torque_source": "motor"}
    first = identify(model, trot, **settings).result
    both = identify(model, [trot, fall], **settings).result
    chain = first.chain
    own = read_recording(trot, model=model, torque_source="motor")
    other = read_recording(fall, model=model, torque_source="motor")
    noise = prepare(model, [own], chain=chain).training[0].reactions.noise
    states = prepare(model, [other], chain=chain).training[0]
    reactions = states.reactions.in_units_of(noise)
    extra = sample_information(first, states.q, states.qd, states.qdd, reactions)
    weak = weak_parameters(first)
    (expected,) = error_ratios(
        first, known_information(first), weak, [extra * fall["t"].size / 500.0 / FURTHER_SECONDS]
    )
    found = np.median((both.std_errors / first.std_errors)[weak])
    assert found < 0.2
    assert 0.5 < found / np.median(expected) < 2.0


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
    assert "lifting one foot after the other" in finding.message
    assert finding.message.count("halve") == 1
    assert not study.determination.advice
    samples = prepare_samples(replace(whole, contact=0.0 * whole.contact), study.result.chain)
    assert np.all(standing_posture([samples])[4:6] == 0.0)
