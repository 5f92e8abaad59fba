"""The observer in C against the one in Python, and against MuJoCo."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compiled_observer import Compiled, CompiledObserver
from reload_oracle import as_if_identified, two_armed
from test_export import result_of
from test_rich_drives import coupled, rich_result
from watched_robot import WatchedRobot

from asbuilt import Observer, Thresholds
from asbuilt.cli import main
from asbuilt.description import RobotModel, bundled_robot
from asbuilt.dynamics import coriolis_torque, gravity_torque
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.identification import IdentificationResult
from asbuilt.writers import write_result
from asbuilt.writers.models.as_built import draw_sample_states
from asbuilt.writers.models.export import write_observer

SAME = 1e-12


def as_built(model: RobotModel) -> IdentificationResult:
    return result_of(model, as_if_identified(model, 3))


RESULTS: dict[str, Callable[[], IdentificationResult]] = {
    "iiwa, load friction": lambda: rich_result("kuka-iiwa7-r800"),
    "SCARA, a sliding joint": lambda: rich_result("scara"),
    "UR10e, coupled wrist": lambda: rich_result("ur10e"),
    "two arms on a slide": lambda: as_built(two_armed()),
}


SIMILAR = ("iiwa, load friction", "SCARA, a sliding joint")
"""Whose parts the others have too."""


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, marks=pytest.mark.study if name in SIMILAR else ()) for name in RESULTS
    ],
)
def result(request: pytest.FixtureRequest) -> IdentificationResult:
    return RESULTS[request.param]()


@pytest.fixture(scope="module")
def in_c(
    result: IdentificationResult, tmp_path_factory: pytest.TempPathFactory
) -> CompiledObserver:
    return CompiledObserver(tmp_path_factory.mktemp("c"), result, some_thresholds(result.model))


def some_thresholds(model: RobotModel) -> Thresholds:
    n, rng = model.n_joints, np.random.default_rng(0)
    parts = rng.uniform(0.1, 1.0, size=(7, n))
    shares = np.ones((2, n))
    return Thresholds(model.joint_names, 8.0, 1.0, 1.0, 1.0, 100.0, *parts, *shares)


def check_same(observer: Observer, other: CompiledObserver, log: Any) -> int:
    """Compare residuals, thresholds and alarms sample by sample; return samples with an alarm."""
    alarms = 0
    for t, q, qd, tau in log:
        expected, found = observer.update(t, q, tau, qd), other.update(t, q, tau, qd)
        assert np.abs(found - expected).max() <= SAME * max(1.0, np.abs(tau).max())
        assert np.abs(other.threshold(q) / observer.threshold - 1.0).max() <= 1e-10
        assert other.alarms(observer.threshold) == observer.alarms
        alarms += bool(observer.alarms)
    return alarms


@pytest.mark.study
def test_observer_of_a_recording_is_that_in_python(watched: WatchedRobot, tmp_path: Path) -> None:
    log = watched.quiet[0]
    assert log.qd is not None
    tau = log.tau - np.where((log.t > 2.0) & (log.t < 2.2), 5.0, 0.0)[:, None]
    in_c = CompiledObserver(tmp_path, watched.result, watched.thresholds)
    observer = Observer(watched.result, thresholds=watched.thresholds)
    samples = list(zip(log.t[:600], log.q, log.qd, tau, strict=False))
    assert check_same(observer, in_c, samples) > 10
    assert "alloc" not in in_c.text


def test_header_gives_the_filter_that_thresholds_count_on(
    watched: WatchedRobot, tmp_path: Path
) -> None:
    given = replace(watched.thresholds, filtered=True)
    for thresholds, named in ((watched.thresholds, False), (given, True)):
        header = write_observer(tmp_path / "a.c", watched.result, thresholds=thresholds)[1]
        assert ("causal filter" in header.read_text()) is named


@pytest.mark.study
def test_observer_is_that_in_python(result: IdentificationResult, in_c: CompiledObserver) -> None:
    """An irregular clock with a gap; joints that slide, branch and share motors."""
    rng, n = np.random.default_rng(1), result.model.n_joints
    t = np.cumsum(np.where(np.arange(80) == 50, 0.5, rng.uniform(0.001, 0.02, 80)))
    phase, rate = rng.uniform(0, 6.0, n), rng.uniform(0.5, 3.0, n)
    q, qd = 0.2 * np.sin(np.outer(t, rate) + phase), 0.2 * rate * np.cos(np.outer(t, rate) + phase)
    tau = result.torque(q, qd, np.zeros(q.shape)) + rng.normal(size=q.shape)
    observer = Observer(result, thresholds=some_thresholds(result.model))
    check_same(observer, in_c, zip(t, q, qd, tau, strict=True))


def test_functions_for_controllers_are_those_in_python(
    result: IdentificationResult, in_c: CompiledObserver
) -> None:
    """Mass matrix, Coriolis, gravity and friction, which add up to inverse dynamics."""
    model, code, n = result.model, in_c.code, result.model.n_joints
    loaded = any(key.endswith("load_friction") for key in result.base.drive.keys)
    for q, qd, qdd in zip(*draw_sample_states(model, 20), strict=True):
        M = code.filled("mass_matrix", (n, n), q)
        c, f = (code.filled(name, n, q, qd) for name in ("coriolis", "friction"))
        g = code.filled("gravity_torque", n, q)
        tau = code.filled("inverse_dynamics", n, q, qd, qdd)
        p, gradient = np.zeros((2, n))
        code.call("momentum", *map(np.ascontiguousarray, (q, qd)), p, gradient)
        near = {"rtol": 0, "atol": SAME * max(1.0, np.abs(tau).max())}
        assert np.allclose(p, M @ qd, **near)
        assert np.allclose(M, M.T, **near)
        assert np.allclose(g, result.gravity(q), **near)
        assert np.allclose(f, result.friction(qd, q), **near)
        chi = result.torque_model.parameters
        assert np.allclose(c, coriolis_torque(model, q, qd, parameters=chi), **near)
        assert np.allclose(tau, result.torque(q, qd, qdd), **near)
        if not loaded:
            assert np.allclose(tau, M @ qdd + c + g + f, **near)
        assert np.allclose(gradient + c, _rate_of_mass(code, q, qd) @ qd, rtol=0, atol=1e-6 * n)


def _rate_of_mass(code: Compiled, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return dM/dt by differences: `dM/dt = C + C^T`."""
    step, n = 1e-5, q.size
    ahead, behind = (code.filled("mass_matrix", (n, n), q + s * qd) for s in (step, -step))
    return (ahead - behind) / (2.0 * step)


def rotors(shares: np.ndarray, armature: np.ndarray, viscous: np.ndarray) -> Any:
    """Return what adds to MuJoCo tendons that turn as `shares @ q`, with inertia and friction."""

    def extend(spec: Any) -> None:
        names = [joint.name for joint in spec.joints]
        for row, a, d in zip(shares, armature, viscous, strict=True):
            tendon = spec.add_tendon(armature=a, damping=[d, 0.0, 0.0]) if row.any() else None
            for name, share in zip(names, row, strict=True):
                if tendon is not None and share:
                    tendon.wrap_joint(name, share)

    return extend


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(bundled_robot("scara"), id="sliding joint"),
        pytest.param(two_armed(), id="branches", marks=pytest.mark.study),
        pytest.param(coupled(bundled_robot("ur10e")), id="coupled wrist"),
    ],
)
def test_torque_that_another_engine_applies_is_found(model: RobotModel, tmp_path: Path) -> None:
    """MuJoCo moves the robot under constant drive torques and a constant external one."""
    rng, n, step = np.random.default_rng(2), model.n_joints, 5e-4
    drives = rng.uniform(0.2, 0.6, (n, 4))
    drives[:, 2:] *= model.motor_shares.any(axis=1)[:, None]
    armature, viscous, *shared = drives.T
    extend = rotors(model.motor_shares, *shared)
    physics = Physics(model, armature=armature, viscous=viscous, extend=extend, timestep=step)
    q = rng.uniform(-0.5, 0.5, n)
    tau = gravity_torque(model, q) + rng.normal(size=n)
    external = np.where(np.arange(n) % 2, 2.0, -3.0)
    observer = CompiledObserver(tmp_path, _with_drives(model, drives))
    physics.start(q, np.zeros(n))
    for k in range(400):
        observer.update(step * k, physics.state[0].copy(), tau, physics.state[1].copy())
        physics.advance(tau + external)
    assert np.abs(physics.state[1]).max() > 0.1
    lagged = 1.0 - np.exp(-2.0 * np.pi * 8.0 * step * 399)
    assert np.allclose(observer.state[:n], lagged * external, rtol=0, atol=1e-4)


def _with_drives(model: RobotModel, drives: np.ndarray) -> IdentificationResult:
    """Return the result that found these armatures and viscous frictions, (n, 4)."""
    keys = "armature,viscous" + ",motor_armature,motor_viscous" * bool(model.motor_shares.any())
    found = result_of(model, model, keys)
    values = {"Ia": drives[:, 0], "Fv": drives[:, 1], "Iam": drives[:, 2], "Fvm": drives[:, 3]}
    ordered = np.column_stack([values[symbol] for symbol in found.base.drive.symbols])
    truth = found.base.values(np.concatenate([model.parameters, ordered.ravel()]))
    return replace(
        found,
        parameters=tuple(
            replace(p, estimate=float(v)) for p, v in zip(found.parameters, truth, strict=True)
        ),
    )


def test_export_writes_an_observer_that_compiles(
    watched: WatchedRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = write_result(tmp_path / "result.json", watched.result)
    with pytest.raises(SystemExit) as done:
        main(["export", str(stored), "--observer", str(tmp_path / "watch.c")])
    assert done.value.code in (0, None), capsys.readouterr().err
    Compiled(tmp_path / "watch.c", "kuka_iiwa7_r800")
    with pytest.raises(SystemExit) as done:
        main(["export", str(stored), "--c", str(tmp_path / "a.c"), "--thresholds", "none.json"])
    assert done.value.code in (1, 2)
