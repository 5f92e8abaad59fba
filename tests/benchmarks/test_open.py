"""The open benchmark: tasks, scores and the textbook regression, against closed forms."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

OPEN = Path(__file__).resolve().parents[2] / "benchmarks" / "open"
sys.path.append(str(OPEN))

pin = pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")

from adapter import Facts  # noqa: E402
from page import best_of, cell, read_results  # noqa: E402
from pinocchio_regressor import tree_regressor  # noqa: E402
from plain import Motion, low_pass  # noqa: E402
from regression import INERTIAL, Regression  # noqa: E402
from score import against_truth, agreement, consistent, coverage, relative_error  # noqa: E402
from task import RESULTS, sha256, tasks  # noqa: E402
from tool import tools  # noqa: E402
from virtual import virtual_problems  # noqa: E402

from asbuilt import load_robot  # noqa: E402


@pytest.mark.parametrize("name", tasks())
def test_a_task_says_what_it_rests_on(name: str) -> None:
    task = tasks()[name]
    assert not set(task.training) & set(task.test)
    assert {*task.training, *task.test} <= set(task.files)
    assert all(len(digest) == 64 for digest in task.files.values())
    assert task.cutoff > 0.0
    assert task.source.repository
    assert task.source.licence


@pytest.mark.parametrize("name", tasks())
def test_shared_files_have_the_digests_of_the_tasks(name: str, shared: Path) -> None:
    task = tasks()[name]
    assert not task.damaged(shared)
    if task.files:
        path = next(iter(task.files))
        assert replace(task, files={path: "0" * 64}).damaged(shared) == [path]


def test_asbuilt_and_at_least_three_peers_have_results() -> None:
    results = read_results(RESULTS)
    assert next(iter(tools())) == "asbuilt"
    peers = {tool for (_, tool), row in results.items() if row.get("error") is not None}
    assert len(peers - {"asbuilt", "cad"}) >= 3
    assert {task for task, _ in results} <= set(tasks())


def test_the_low_pass_halves_the_power_at_its_cutoff() -> None:
    t = np.arange(0.0, 20.0, 0.005)
    for frequency, gain in ((0.5, 1.0), (5.0, 0.5**0.5), (20.0, 0.0)):
        wave = np.sin(2 * np.pi * frequency * t)[:, None]
        out = low_pass(wave, 200.0, 5.0)[1000:-1000]
        assert np.sqrt(2 * np.mean(out**2)) == pytest.approx(gain, abs=5e-3)


def test_norms_in_closed_form() -> None:
    error, torque = np.array([3.0, 0.1]), np.array([30.0, 0.4])
    whole, each = relative_error([(error, torque)], "torque")
    assert whole == pytest.approx(np.hypot(3.0, 0.1) / np.hypot(30.0, 0.4))
    assert each == pytest.approx([0.1, 0.25])
    assert relative_error([(error, torque)], "joints")[0] == pytest.approx(0.175)


def test_only_links_that_can_exist_are_consistent() -> None:
    links = np.reshape(load_robot("kuka-iiwa7-r800").parameters, (-1, 10)).copy()
    assert consistent(links)
    links[2, 0] += links[2, 3] + links[2, 5]  # Ixx above Iyy + Izz: no body has it
    assert not consistent(links)


def test_errors_that_are_right_hold_in_nineteen_of_twenty() -> None:
    rng = np.random.default_rng(1)
    ones, others = (
        [{"name": str(k), "value": rng.normal(), "error": 1.0} for k in range(4000)]
        for _ in range(2)
    )
    found = coverage(agreement(ones, others))
    assert found["coverage"] == pytest.approx(0.95, abs=0.01)
    assert found["z_rms"] == pytest.approx(1.0, abs=0.03)
    too_small = coverage(agreement([each | {"error": 0.1} for each in ones], others))
    assert too_small["coverage"] < 0.9


def test_best_is_the_least_error_and_the_z_nearest_to_one() -> None:
    assert best_of("torque", [0.3, None, 0.1]) == 0.1
    assert best_of("halves", [4.0, 0.5, 2.5]) == 0.5
    assert best_of("torque", [None]) is None
    assert cell("torque", {"error": 0.1}, 0.1) == "**10.0 %**"
    assert cell("torque", {"note": "cannot"}, 0.1) == "–"


@pytest.fixture(scope="module")
def virtual(tmp_path_factory: pytest.TempPathFactory):
    """A virtual arm: its folder, facts and truth."""
    task = tasks()["virtual-plain"]
    one = replace(task, settings=task.settings | {"robots": ["ur10e"], "seeds": 1})
    (problem,) = virtual_problems(one, tmp_path_factory.mktemp("virtual"))
    document = json.loads((problem.folder / "facts.json").read_text())
    return problem, Facts(folder=problem.folder, **document)


def test_a_virtual_log_is_that_of_its_seed(virtual, tmp_path: Path) -> None:
    problem, _ = virtual
    task = tasks()["virtual-plain"]
    one = replace(task, settings=task.settings | {"robots": ["ur10e"], "seeds": 1})
    (again,) = virtual_problems(one, tmp_path)
    files = sorted(path.name for path in problem.folder.glob("*.npz"))
    for name in files:
        first, second = (np.load(each.folder / name) for each in (problem, again))
        assert all(np.array_equal(first[key], second[key]) for key in first.files)
    assert sha256(problem.folder / "facts.json") != sha256(problem.folder / "robot.urdf")


def test_the_textbook_recovers_the_truth_without_noise(virtual) -> None:
    """Torque of the true standard parameters in, base parameters out, to rounding."""
    problem, facts = virtual
    regression = Regression(facts, tree_regressor(facts))
    truth = np.array([problem.truth[name] for name in regression.names])
    (motion,) = facts.plain()
    clean = motion._replace(tau=regression.torque(motion, truth))
    W, tau = regression.stacked([clean])
    smooth = W @ truth
    assert np.linalg.norm(smooth - tau) < 0.05 * np.linalg.norm(tau)  # sign(qd) is low-passed in W
    facts_of_clean = Regression(facts, regression.tree)
    facts_of_clean.stacked = lambda _: (W, smooth + 1e-9 * np.sin(np.arange(len(smooth))))
    fit = facts_of_clean.weighted_fit()
    z = [
        each.value - sum(f * problem.truth[name] for name, f in each.of.items())
        for each in fit.parameters
    ]
    assert np.max(np.abs(z)) < 1e-5
    predicted = fit.predict(motion)
    assert np.max(np.abs(predicted - regression.torque(motion, truth))) < 1e-4


def test_the_truth_is_in_the_frames_of_the_urdf(virtual) -> None:
    """Pinocchio's inverse dynamics of the truth is the torque of Pinocchio's regressor."""
    problem, facts = virtual
    model = pin.buildModelFromUrdf(facts.urdf)
    regressor = tree_regressor(facts)
    links = np.array(
        [[problem.truth[f"{key}{k + 1}"] for key in INERTIAL] for k in range(model.njoints - 1)]
    )
    for k, (Ixx, Ixy, Ixz, Iyy, Iyz, Izz, mx, my, mz, m) in enumerate(links):
        own = np.array([m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz])
        model.inertias[k + 1] = pin.Inertia.FromDynamicParameters(own)
    rng = np.random.default_rng(3)
    q, qd, qdd = rng.normal(size=(3, 1, 6))
    tau = pin.rnea(model, model.createData(), q[0], qd[0], qdd[0])
    assert regressor(q, qd, qdd)[0] @ links.ravel() == pytest.approx(tau, rel=1e-9, abs=1e-9)


def test_estimates_at_the_truth_have_no_deviation(virtual) -> None:
    problem, _ = virtual
    parameters = [
        {"name": "a", "value": 2.0 * problem.truth["m3"], "error": 0.1, "of": {"m3": 2.0}},
        {"name": "b", "value": problem.truth["Fv1"] + 0.3, "error": 0.1, "of": {"Fv1": 1.0}},
        {"name": "c", "value": 0.0, "error": 0.1, "of": {"unknown": 1.0}},
    ]
    assert against_truth(parameters, problem.truth) == pytest.approx([0.0, 3.0])


def test_ends_of_a_log_are_not_scored() -> None:
    t = np.arange(0.0, 10.0, 0.01)
    motion = Motion(t, *(np.zeros((len(t), 1)) for _ in range(3)))
    assert t[motion.inner()][0] == pytest.approx(1.0)
    assert t[motion.inner()][-1] == pytest.approx(8.99)
