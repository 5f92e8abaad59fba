"""The same samples under two names are no second recording."""

from dataclasses import replace

import numpy as np
import pytest

from asbuilt import UsageError, identify, load_robot, random_fourier, simulate_recording

MODEL = load_robot("two-link")


@pytest.fixture(scope="module")
def log():
    return simulate_recording(MODEL, random_fourier(MODEL, rng=1, duration=5.0), rng=1)


@pytest.mark.parametrize("place", ["recordings", "validation"])
def test_a_log_given_twice_is_refused_by_content(log, place) -> None:
    copy = replace(log, t=log.t + 7.0, q=np.array(log.q), source="copy.csv", notes=("a copy",))
    given = ([log, copy], None) if place == "recordings" else (log, copy)
    others = {} if given[1] is None else {"validation": given[1]}
    with pytest.raises(UsageError, match=r"copy\.csv is the same samples as") as caught:
        identify(MODEL, given[0], **others)
    assert "give every log once" in str(caught.value)
    with pytest.raises(UsageError, match="given twice"):
        identify(MODEL, [log, log])


def test_files_and_arrays_of_the_same_log_are_one(log, tmp_path) -> None:
    arrays = {"t": log.t, "q": log.q, "tau": log.tau}
    with pytest.raises(UsageError, match="give every log once"):
        identify(MODEL, [arrays, log])
    path = tmp_path / "log.csv"
    names = ["t", *(f"{kind}_{joint}" for kind in ("q", "tau") for joint in log.joint_names)]
    rows = np.column_stack([log.t, log.q, log.tau])
    np.savetxt(path, rows, delimiter=",", header=",".join(names), comments="", fmt="%.17g")
    with pytest.raises(UsageError, match=r"log\.csv is given twice"):
        identify(MODEL, [path, path])


def test_another_log_of_the_same_motion_is_a_second_recording(log) -> None:
    noise = np.random.default_rng(3).normal(scale=1e-3, size=log.tau.shape)
    other = replace(log, tau=log.tau + noise, source="again.csv")
    assert identify(MODEL, [log, other], method="wls").result.rank > 0
