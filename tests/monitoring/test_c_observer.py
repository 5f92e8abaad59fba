"""The observer in C against the one in Python."""

import ctypes
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asbuilt.cli.app import main
from asbuilt.dynamics.newton_euler import coriolis_torque
from asbuilt.monitoring.observer import Observer
from asbuilt.writers.models.c.observer_files import write_observer
from asbuilt.writers.reports.study_files import write_result
from watched_robot import WatchedRobot

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1")
SAME = 1e-12


def pointer(values: np.ndarray) -> Any:
    return values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


class Compiled:
    """A shared library made from the C files."""

    def __init__(self, source: Path) -> None:
        library = source.with_suffix(".so")
        subprocess.run(
            ["gcc", *FLAGS, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"], check=True
        )
        self.library = ctypes.CDLL(str(library))

    def call(self, function: str, *arrays: Any) -> None:
        getattr(self.library, f"robot_{function}")(*arrays)


@pytest.fixture(scope="module")
def compiled(watched: WatchedRobot, tmp_path_factory: pytest.TempPathFactory) -> Compiled:
    source = tmp_path_factory.mktemp("c") / "observer.c"
    made, header = write_observer(source, watched.result, thresholds=watched.thresholds)
    text = made.read_text()
    prefix = header.read_text().split("_JOINTS")[0].split("#define ")[-1].lower()
    plain = {path: path.read_text().replace(prefix, "robot") for path in (made, header)}
    for path, content in plain.items():
        path.write_text(content)
    assert "malloc" not in text
    return Compiled(source)


def test_observer_in_c_is_that_in_python(watched: WatchedRobot, compiled: Compiled) -> None:
    log, n = watched.quiet[0], watched.model.n_joints
    observer = Observer(watched.result, thresholds=watched.thresholds)
    state = np.zeros(8 * n + 1)
    compiled.call("observer_restart", pointer(state))
    threshold, last, alarms = np.zeros(n), -np.inf, 0
    for t, q, qd, quiet in zip(log.t[:600], log.q, log.qd, log.tau, strict=False):
        tau = quiet - (5.0 if 2.0 < t < 2.2 else 0.0)
        expected = observer.update(t, q, tau, qd)
        step = ctypes.c_double(t - last if np.isfinite(last) else 0.0)
        arrays = [pointer(np.ascontiguousarray(x)) for x in (q, qd, tau)]
        compiled.call("observer_update", pointer(state), step, *arrays)
        compiled.call("observer_threshold", pointer(state), arrays[0], pointer(threshold))
        assert np.abs(state[:n] - expected).max() <= SAME * np.abs(tau).max()
        assert np.abs(threshold / observer.threshold - 1.0).max() <= 1e-10
        found = compiled.library.robot_observer_alarms(pointer(state), pointer(threshold))
        names = tuple(name for j, name in enumerate(watched.model.joint_names) if found >> j & 1)
        assert names == observer.alarms
        alarms, last = alarms + bool(names), t
    assert alarms > 10


def test_functions_for_controllers_add_up(watched: WatchedRobot, compiled: Compiled) -> None:
    """Mass matrix, Coriolis, gravity and friction against Python, and against inverse dynamics."""
    result, n, rng = watched.result, watched.model.n_joints, np.random.default_rng(3)
    model = result.torque_model
    for q, qd, qdd in rng.normal(size=(20, 3, n)):
        M, c, g, f, tau = np.zeros((n, n)), *np.zeros((4, n))
        compiled.call("mass_matrix", pointer(q), pointer(M))
        compiled.call("coriolis", pointer(q), pointer(qd), pointer(c))
        compiled.call("gravity_torque", pointer(q), pointer(g))
        compiled.call("friction", pointer(q), pointer(qd), pointer(f))
        compiled.call("inverse_dynamics", pointer(q), pointer(qd), pointer(qdd), pointer(tau))
        p, gradient = np.zeros((2, n))
        compiled.call("momentum", pointer(q), pointer(qd), pointer(p), pointer(gradient))
        size = np.abs(tau).max()
        assert np.allclose(tau, M @ qdd + c + g + f, rtol=0, atol=SAME * size)
        assert np.allclose(p, M @ qd, rtol=0, atol=SAME * size)
        assert np.allclose(g, result.gravity(q), rtol=0, atol=SAME * size)
        assert np.allclose(f, result.friction(qd, q), rtol=0, atol=SAME * size)
        expected = coriolis_torque(watched.model, q, qd, parameters=model.parameters)
        assert np.allclose(c, expected, rtol=0, atol=SAME * size)
        rotors = M - result.mass_matrix(q)
        assert np.allclose(rotors, np.diag(np.diag(rotors)), rtol=0, atol=SAME * size)


def test_export_writes_an_observer_that_compiles(
    watched: WatchedRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = write_result(tmp_path / "result.json", watched.result)
    with pytest.raises(SystemExit) as done:
        main(["export", str(stored), "--observer", str(tmp_path / "watch.c")])
    assert done.value.code in (0, None), capsys.readouterr().err
    Compiled(tmp_path / "watch.c")
    with pytest.raises(SystemExit) as done:
        main(["export", str(stored), "--c", str(tmp_path / "a.c"), "--thresholds", "none.json"])
    assert done.value.code in (1, 2)
