"""The da Vinci research arms against the errors that Wang et al. published, RA-L 4, 2019."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.errors import IdentifiabilityError
from asbuilt.experiment import SignalChain, as_recordings
from asbuilt.identification.calibration.added_moments import identify_added_moments
from asbuilt.workflow import StudyOptions, identify, identify_payload, prepare

SHEET = """rate = 200
header = false
torque_source = "motor"
[columns]
position = "1-7"
velocity = "8-14"
torque = "15-21"
"""
PUBLISHED = {
    "psm": (5.56, 5.4, [0.093, 0.178, 0.191, 0.134, 0.239, 0.211, 0.264]),
    "mtm": (10.0, 1.8, [0.077, 0.149, 0.170, 0.209, 0.263, 0.234, 0.340]),
}
WANTED = {
    "psm": [0.071, 0.142, 0.165, 0.134, 0.229, 0.202, 0.214],
    "mtm": [0.065, 0.148, 0.170, 0.209, 0.183, 0.233, 0.308],
}


def log(shared: Path, folder: Path, arm: str, name: str, stop: float | None = None) -> Path:
    """A log of the publication with the sheet that reads its 21 columns."""
    source = shared / "data" / "dvrk" / arm / f"{name}.csv"
    if not source.is_file():
        pytest.skip("the shared recordings are absent")
    copy = folder / f"{name}.csv"
    copy.write_bytes(source.read_bytes())
    window = "" if stop is None else f"[[windows]]\nstart = 0.0\nstop = {stop}\n"
    (folder / f"{name}.csv.toml").write_text(SHEET + window)
    return copy


@pytest.mark.study
@pytest.mark.parametrize("arm", PUBLISHED)
def test_errors_on_the_first_period_are_below_those_published(
    arm: str, shared: Path, tmp_path: Path
) -> None:
    period, cutoff, published = PUBLISHED[arm]
    study = identify(
        bundled_robot(f"dvrk-{arm}"),
        log(shared, tmp_path, arm, "one"),
        validation=log(shared, tmp_path, arm, "two", period),
        options=StudyOptions(
            chain=SignalChain(cutoff=cutoff), holdout=None, method="wls", effects="none"
        ),
    )
    (found,) = study.validations
    error = np.array(found.metrics_as_built.relative_error_per_joint)
    assert np.all(error < published)
    assert np.all(error <= WANTED[arm])


@pytest.mark.study
def test_two_weights_change_first_moments_in_their_ratio(shared: Path, tmp_path: Path) -> None:
    robot, chain = bundled_robot("dvrk-psm"), SignalChain(cutoff=5.4)
    bare = log(shared, tmp_path, "psm", "one_no_weight")
    options = StudyOptions(chain=chain, holdout=None, method="wls")
    result = identify(robot, bare, options=options).result
    found = []
    for grams in (105, 205):
        loaded = log(shared, tmp_path, "psm", f"one_{grams}_grams_parallel")
        both = [
            prepare(robot, as_recordings(robot, each), chain=chain, holdout=None).training
            for each in (loaded, bare)
        ]
        found.append(identify_added_moments(result, both[0], unloaded=both[1], frame="link_1"))
    for each in found:
        assert each.determined == ("mx", "my")
        assert each.not_determined == ("mz", "m")
    (light, heavy) = (each.values[0] for each in found)
    (spread, more) = (each.std_errors[0] for each in found)
    ratio = heavy / light
    error = ratio * np.hypot(spread / light, more / heavy)
    assert error < 0.1
    assert abs(ratio - 205 / 105) < 2.0 * error


@pytest.mark.study
def test_a_weight_at_the_tip_has_no_mass_but_first_moments(shared: Path, tmp_path: Path) -> None:
    robot = bundled_robot("dvrk-psm")
    options = StudyOptions(chain=SignalChain(cutoff=5.4), holdout=None, method="wls")
    result = identify(robot, log(shared, tmp_path, "psm", "one_no_weight"), options=options)
    loaded = log(shared, tmp_path, "psm", "one_205_grams_parallel")
    with pytest.raises(IdentifiabilityError, match=r"first moments are: mx .* g m") as caught:
        identify_payload(result, loaded)
    assert caught.value.cure.settings == {"moments": True}
