"""Every estimator that needs no samples, from the ledgers of three robots."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt import FleetIdentification, FleetOptions, add_logs, fleet_identify, open_ledger
from asbuilt.description import bundled_robot
from asbuilt.errors import IdentifiabilityError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot
from asbuilt.identification import methods
from asbuilt.workflow import StudyOptions, identify
from asbuilt.writers import write_recording

ROBOTS = ("two-link", "ur10e")
METHODS = sorted(name for name in methods if methods[name].needs == "information")
ON_LARGER = ("consistent", "wls")
"""Methods that are tried on every robot; the others read the ledger as these do."""
CASES = [
    *(
        pytest.param(ROBOTS[0], method, marks=[] if method in ON_LARGER else pytest.mark.study)
        for method in METHODS
    ),
    *(pytest.param(ROBOTS[1], method, marks=pytest.mark.study) for method in ON_LARGER),
]


@pytest.fixture(scope="module")
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory):
    """The name of a robot, its logs and a ledger of them."""
    name, folder = request.param, tmp_path_factory.mktemp(request.param)
    model, logs = bundled_robot(name), []
    for day in (1, 2):
        motion = random_fourier(model, rng=day, duration=20.0)
        found = VirtualRobot.typical(model, 1).record(motion, rate=100.0, rng=day).recording
        logs.append(folder / f"run_2026-03-{day:02d}.csv")
        write_recording(logs[-1], replace(found, torque_source="sensor"))
    ledger = folder / "ledger"
    here = FleetOptions(workers=0)
    assert not add_logs(ledger, model, logs, robot_id="R", fleet=here).failed
    return name, logs, ledger


@pytest.mark.parametrize(("robot", "method"), CASES, indirect=["robot"])
def test_the_result_is_that_of_the_logs(robot: tuple[str, list[Path], Path], method: str) -> None:
    """Where total least squares has no reliable solution, both say so."""
    name, logs, ledger = robot
    settings = next(iter(open_ledger(str(ledger)).types().values()))
    asked = FleetIdentification(method=method)
    options = StudyOptions(
        effects="none", method=method, chain=settings.chain, drive=settings.drive, holdout=None
    )
    expected = None
    with suppress(IdentifiabilityError):
        expected = identify(bundled_robot(name), logs, options=options).result
    if expected is None:
        assert method == "total"
        with pytest.raises(IdentifiabilityError, match="has no reliable solution"):
            fleet_identify(ledger, "R", options=asked)
        return
    found = fleet_identify(ledger, "R", options=asked).result
    np.testing.assert_allclose(found.estimates, expected.estimates, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(np.isfinite(found.std_errors), np.isfinite(expected.std_errors))
    assert found.method == expected.method
    assert found.physically_consistent == expected.physically_consistent


def test_a_ledger_has_the_delay_that_its_first_log_shows(tmp_path: Path) -> None:
    model = bundled_robot("two-link")
    motion = random_fourier(model, rng=1, duration=30.0)
    found = VirtualRobot.typical(model, 1).record(motion, rate=100.0, rng=1).recording
    logs = []
    for day, lag in ((1, 2), (2, 2)):
        late = replace(found, t=found.t[lag:], q=found.q[lag:], qd=None, tau=found.tau[:-lag])
        logs.append(tmp_path / f"run_2026-03-{day:02d}.csv")
        write_recording(logs[-1], replace(late, command=None, extra={}))
    here = FleetOptions(workers=0)
    done = add_logs(tmp_path / "ledger", model, logs[:1], robot_id="R", fleet=here)
    (delay,) = done.settings[0].chain.delays
    assert delay == pytest.approx(0.02, abs=0.002)
    assert "ms late" in done.settings[0].chosen[0]
    again = add_logs(tmp_path / "ledger", model, logs, robot_id="R", fleet=here)
    assert not again.failed
    assert again.settings[0].chain.delays == (delay,)
