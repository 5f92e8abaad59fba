"""The open benchmark: tasks, scores and the textbook regression, against closed forms."""

from __future__ import annotations

import importlib.util
import json
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

OPEN = Path(__file__).resolve().parents[2] / "benchmarks" / "open"
sys.path.append(str(OPEN))

pin = pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")

from adapter import Facts  # noqa: E402
from bench import Servo  # noqa: E402
from commanded import windows_of  # noqa: E402
from flyer import BASE, Flyer, described, flyer_model, projections  # noqa: E402
from legged import against_torques, legged_problem, read_legged_log  # noqa: E402
from loops import ClosedChains  # noqa: E402
from page import best_of, cell, read_results  # noqa: E402
from pinocchio_regressor import tree_regressor  # noqa: E402
from plain import Motion, closed_contacts, low_pass  # noqa: E402
from prepare import Problem, cut_logs  # noqa: E402
from regression import INERTIAL, Regression  # noqa: E402
from score import (  # noqa: E402
    against_truth,
    agreement,
    consistent,
    coverage,
    relative_error,
    weight_ratio,
)
from task import RESULTS, sha256, tasks  # noqa: E402
from tool import interpreter, tools  # noqa: E402
from twin import CYCLE, ERROR, REPEATED, Twin, errors  # noqa: E402
from virtual import closed_facts, virtual_problems  # noqa: E402

from asbuilt import Recording, load_robot  # noqa: E402
from asbuilt.dynamics import inverse_dynamics  # noqa: E402
from asbuilt.excitation import random_fourier  # noqa: E402
from asbuilt.experiment import VirtualRobot, check_recording  # noqa: E402

_spec = importlib.util.spec_from_file_location("open_run", OPEN / "run.py")
assert _spec is not None
assert _spec.loader is not None
runner = importlib.util.module_from_spec(_spec)  # `run` is the name of another one
_spec.loader.exec_module(runner)


@pytest.mark.parametrize("name", tasks())
def test_a_task_says_what_it_rests_on(name: str) -> None:
    task = tasks()[name]
    assert not set(task.training) & set(task.test)
    named = {*task.files, *(str(Path(each).parent) for each in task.files)}
    assert {*task.training, *task.test} <= named
    assert set(task.addresses) <= set(task.files)
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


def test_a_ratio_of_weights_has_the_scatter_that_it_states() -> None:
    """First moments with noise of known size, drawn 2000 times."""
    rng, moments = np.random.default_rng(0), np.array([0.045, -0.051, 0.02])

    def weighed(factor: float) -> list[dict[str, float]]:
        return [{"value": factor * m + rng.normal(scale=1e-3), "error": 1e-3} for m in moments]

    found = np.array([weight_ratio(weighed(1.0), weighed(1.95)) for _ in range(2000)])
    assert found[:, 0].mean() == pytest.approx(1.95, abs=5e-3)
    assert found[:, 0].std() == pytest.approx(found[:, 1].mean(), rel=0.06)


def test_contacts_close_for_half_a_period_around_a_change() -> None:
    contact = np.zeros((60, 1))
    contact[20:30] = 1.0
    closed = closed_contacts(contact, rate=100.0, cutoff=10.0)[:, 0]
    assert np.flatnonzero(closed).tolist() == list(range(15, 35))


def test_windows_follow_each_other_from_the_measured_state() -> None:
    t = np.arange(0.0, 8.0, 0.02)
    q = np.column_stack([np.sin(t), np.cos(t)])
    log = Recording(t=t, q=q, tau=np.zeros_like(q), joint_names=("a", "b"), source="log")
    windows, measured = windows_of(log, rate=50.0, cutoff=8.0, horizon=0.5)
    assert np.diff(windows["start"]) == pytest.approx(0.5)
    assert measured.shape == (len(windows["start"]), 25, 2)
    start = windows["start"][:, None]
    assert windows["q"] == pytest.approx(np.hstack([np.sin(start), np.cos(start)]), abs=1e-4)
    assert windows["qd"] == pytest.approx(np.hstack([np.cos(start), -np.sin(start)]), abs=1e-3)
    assert measured[:, 0] == pytest.approx(windows["q"], abs=1e-4)


def test_projected_torques_hold_no_force_of_the_feet(shared: Path, tmp_path: Path) -> None:
    """Inverse dynamics with forces at closed contacts, against the regressor without them."""
    problem = legged_problem(tasks()["solo12"], shared, tmp_path)
    facts = Facts(folder=tmp_path, **json.loads((tmp_path / "facts.json").read_text()))
    assert problem.mass == pytest.approx(described(facts)[:, 9].sum())
    stored = np.load(tmp_path / "test_0.npz")
    rows = slice(200, 240)
    motion = Motion(*(stored[key][rows] for key in ("t", "q", "qd", "qdd")))
    model, contact = flyer_model(facts), stored["contact"][rows]
    data, rng = model.createData(), np.random.default_rng(2)
    tau = np.array([pin.rnea(model, data, *each) for each in zip(*motion[1:4], strict=True)])
    flyer = Flyer(facts)
    links = described(facts).ravel()
    standard = np.concatenate([links, np.zeros(len(flyer.names) - links.size)])
    assert flyer.torque(motion, standard) == pytest.approx(tau, abs=1e-9)
    for i, q in enumerate(motion.q):
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        for name, on in zip(facts.contacts, contact[i], strict=True):
            frame = model.getFrameId(name)
            whole = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
            below = np.array([0.0, 0.0, -facts.settings["radius"]])  # of a foot, a ball
            J = whole[:3] - pin.skew(below) @ whole[3:]
            tau[i] -= on * J.T @ rng.normal(scale=10.0, size=3)
    P = projections(facts, motion.q, contact)
    left = np.einsum("tij,tj->ti", P, tau - flyer.torque(motion, standard))
    assert np.abs(left).max() < 1e-9
    assert np.abs(tau[:, BASE:] - flyer.torque(motion, standard)[:, BASE:]).max() > 0.1


def test_the_limit_norm_is_over_twice_the_limit() -> None:
    pairs = [(np.array([0.2, 0.3]), np.array([9.0, 9.0]))]
    whole, each = relative_error(pairs, "limits", np.array([10.0, 30.0]))
    assert each == pytest.approx([0.01, 0.005])
    assert whole == pytest.approx(0.0075)


def test_logs_are_cut_in_parts_or_blocks() -> None:
    t = np.arange(0.0, 20.0, 0.1)
    x = np.column_stack([np.sin(t)])
    log = Recording(t=t, q=x, tau=x, joint_names=("a",), source="log")
    task = replace(tasks()["med7-blocks"], settings={"blocks": [5.0, 3]})
    training, test = cut_logs(task, [log])
    assert [(each.t[0], each.t[-1]) for each in test] == [pytest.approx((10.0, 14.9))]
    assert [(each.t[0], each.t[-1]) for each in training] == [
        *(pytest.approx((0.0, 9.9)), pytest.approx((15.0, 19.9)))
    ]
    halves = replace(task, settings={"trained": 0.25})
    (first,), (rest,) = cut_logs(halves, [log])
    assert (first.t[-1], rest.t[0]) == pytest.approx((4.9, 5.0))


def test_loops_are_closed_by_pinocchio_as_by_asbuilt(tmp_path: Path) -> None:
    """Joints of the tree and torque at the motors along a motion."""
    model = load_robot(OPEN / "mechanisms" / "lever-arm.toml")
    motion = random_fourier(model, rng=np.random.default_rng(1), duration=4.0).sample(100.0)
    chains = ClosedChains(closed_facts(model, tmp_path, np.array(model.gravity)))
    states = chains.motion(motion.q, motion.qd, motion.qdd)
    own = model.link_motion(motion.q, motion.qd, motion.qdd)
    for found, expected in zip(states, (own.q, own.qd, own.qdd, own.shares), strict=True):
        assert found == pytest.approx(expected, abs=1e-6)
    tau = inverse_dynamics(model, motion.q, motion.qd, motion.qdd)
    assert chains.torque(motion.q, motion.qd, motion.qdd) == pytest.approx(tau, abs=1e-6)


def test_checks_of_a_closed_chain_try_no_posture_out_of_reach() -> None:
    """Columns swapped or zeros shifted would leave the reach of the loops: no error of motion."""
    model = load_robot(OPEN / "mechanisms" / "lever-arm.toml")
    motion = random_fourier(model, rng=np.random.default_rng(1), duration=12.0)
    log = VirtualRobot.preset("lab", model, rng=1).record(motion, rng=1, rate=100.0).recording
    assert not [each for each in check_recording(model, log).findings if each.severity == "error"]


def test_a_row_takes_the_place_of_its_own_and_is_written_whole(tmp_path: Path) -> None:
    """Of many writers at a time every row stays, and no part of a file is left."""
    path = tmp_path / "results.jsonl"
    names = [f"tool{k}" for k in range(40)]
    with ThreadPoolExecutor(8) as pool:
        for error in (0.2, 0.1):
            list(
                pool.map(
                    lambda n, e=error: runner.store({"task": "t", "tool": n, "error": e}, path),
                    names,
                )
            )
    found = read_results(path)
    assert sorted(tool for _, tool in found) == sorted(names)
    assert {row["error"] for row in found.values()} == {0.1}
    assert [each.name for each in tmp_path.iterdir()] == ["results.jsonl"]


def test_a_row_is_of_its_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What an interrupted run has measured is of the same digest, until its adapter changes."""
    task, tool = tasks()["lwr4"], tools()["wls"]
    assert runner.code_of(task, tool) == runner.code_of(task, tool)
    assert runner.code_of(task, tool) != runner.code_of(tasks()["med7"], tool)
    other = tmp_path / "wls.py"
    other.write_text(tool.path.read_text() + "\n")
    assert runner.code_of(task, replace(tool, path=other)) != runner.code_of(task, tool)


def test_a_tool_that_was_ended_from_outside_leaves_no_row(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its old row stays, and the run ends."""
    adapter = tmp_path / "wls.py"
    adapter.write_text("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\n")
    (tmp_path / "facts.json").write_text(json.dumps(dict.fromkeys(("a",), 1)))
    tool = replace(tools()["asbuilt"], path=adapter)
    problem = Problem(tmp_path, load_robot("two-link"), ())
    with pytest.raises(InterruptedError, match="--resume"):
        runner.answered(tool, problem, tmp_path)


def test_a_python_is_one_that_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for folder, status in (("shim", 127), ("real", 0)):
        path = tmp_path / folder / "python9.9"
        path.parent.mkdir()
        path.write_text(f"#!/bin/sh\nexit {status}\n")
        path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}/shim:{tmp_path}/real")
    assert interpreter("9.9") == str(tmp_path / "real" / "python9.9")
    assert interpreter("9.8") is None


def test_what_took_longest_is_measured_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "problems_of", lambda task, data, folder: [])
    monkeypatch.setattr(
        runner, "row", lambda task, tool, *_: {"task": task.name, "tool": tool.name}
    )
    known = [
        (tasks()[name], [tools()[each] for each in ("cad", "wls")]) for name in ("lwr4", "med7")
    ]
    took = {("lwr4", "wls"): 1.0, ("med7", "wls"): 5.0, ("med7", "cad"): 9.0}
    found = [(each["task"], each["tool"]) for each in runner.rows(known, Path(), 1, took)]
    assert sorted(found) == sorted((task.name, tool.name) for task, own in known for tool in own)
    assert found[0] == ("med7", "cad")


@pytest.fixture(scope="module")
def twin(shared: Path, tmp_path_factory: pytest.TempPathFactory):
    """The twin of Solo12: its problem and facts."""
    folder = tmp_path_factory.mktemp("twin")
    problem = legged_problem(tasks()["solo12-twin"], shared, folder)
    facts = json.loads((folder / "facts.json").read_text())
    return problem, Facts(folder=folder, **facts)


def test_feet_alone_hold_the_twin(shared: Path, tmp_path: Path) -> None:
    """Forces at closed feet give what the base needs: no row of the projected torque is left."""
    task = tasks()["solo12-twin"]
    source, feet = shared / task.description, task.settings["contacts"]
    robot = load_robot(source, base="free", contacts=",".join(feet))
    whole = read_legged_log(shared / task.training[0], robot.joint_names[robot.n_floating :], task)
    log = {key: x[::40] for key, x in whole.items()}
    model = pin.buildModelFromUrdf(str(source), pin.JointModelFreeFlyer())
    still = Twin.draw(robot, 12, np.random.default_rng(3))
    bare = replace(
        still, **{key: np.zeros(12) for key in ("coulomb", "viscous", "armature", "offset")}
    )
    qdd, tau = bare.torque(model, log, feet, task.settings["radius"])
    for k, row in enumerate(bare.bodies):
        Ixx, Ixy, Ixz, Iyy, Iyz, Izz, mx, my, mz, m = row
        own = np.array([m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz])
        model.inertias[k + 1] = pin.Inertia.FromDynamicParameters(own)
    data = model.createData()
    (tmp_path / "robot.urdf").write_text(source.read_text())
    told = {"joints": list(robot.joint_names[robot.n_floating :]), "gravity": [0.0, 0.0, -9.81]}
    empty = {key: [] for key in ("tree_joints", "tree_links", "training", "test")}
    facts = Facts(
        folder=tmp_path,
        cutoff=task.cutoff,
        rate=100.0,
        torque_source="motor",
        contacts=feet,
        settings=task.settings,
        **told,
        **empty,
    )
    P = projections(facts, log["q"], log["contact"])
    load = np.array([pin.rnea(model, data, *x) for x in zip(log["q"], log["qd"], qdd, strict=True)])
    driven = np.hstack([np.zeros((len(tau), BASE)), tau])
    left = np.einsum("tij,tj->ti", P, load - driven)
    assert np.abs(left).max() < 1e-9 * np.abs(load).max()
    change = (qdd - log["qdd"])[:, :BASE]
    assert np.linalg.norm(change) < 0.03 * np.linalg.norm(log["qdd"][:, :BASE])
    assert np.array_equal(qdd[:, BASE:], log["qdd"][:, BASE:])


def test_the_truth_of_the_twin_leaves_what_was_added(twin) -> None:
    """The true torques score the errors of the log, and none from themselves."""
    problem, _ = twin
    found = against_torques(problem, problem.clean[0])
    assert found["true_error"] < 1e-12
    assert found["error"] == found["floor"]
    assert 0.005 < found["floor"] < 0.03


def test_errors_of_the_twin_come_again_as_far_as_they_say() -> None:
    """Over a whole cycle the correlation is the share that repeats."""
    t = np.arange(0.0, 100.0, 0.01)
    tau = np.tile([1.0, 3.0], (len(t), 1))
    e = errors(t, tau, np.random.default_rng(1))
    lag = round(CYCLE / 0.01)
    again = np.sum(e[lag:] * e[:-lag], axis=0) / np.sum(e**2, axis=0)
    assert np.sqrt(np.mean(e**2, axis=0)) == pytest.approx(ERROR * tau[0], rel=0.35)
    assert again == pytest.approx(REPEATED, abs=0.25)


def test_a_servo_rests_where_friction_holds_it() -> None:
    """Torque of the motor and weight differ by less than the friction at rest of that load."""
    pendulum = tasks()["virtual-servo"].settings["pendulum"]
    servo = Servo()
    for goal in (-1.0, 0.4, 1.2):
        q = servo.moved(np.r_[np.linspace(0.0, goal, 40), np.full(160, goal)], pendulum)
        assert np.ptp(q[-30:]) < 1e-6
        rest = float(q[-1])
        motor = servo.kt / servo.resistance * pendulum["vin"] * pendulum["gain"] * (goal - rest)
        length = pendulum["length"]
        weight = (pendulum["load"] + pendulum["arm"] / 2) * 9.80665 * length * np.sin(rest)
        held = servo.friction + servo.at_rest + servo.load_share * abs(motor + weight)
        assert abs(motor - weight) <= held * (1.0 + 1e-9)


def test_a_servo_without_friction_swings_as_its_inertia_says() -> None:
    """A motor without torque: small swings of a pendulum with the rotor's inertia."""
    pendulum = tasks()["virtual-servo"].settings["pendulum"] | {"vin": 0.0}
    free = Servo(friction=0.0, at_rest=0.0, load_share=0.0, viscous=0.0, kt=1e-9)
    q = free.moved(np.full(300, 0.05), pendulum)
    length, arm = pendulum["length"], pendulum["arm"]
    inertia = free.rotor + (pendulum["load"] + arm / 3) * length**2
    stiffness = (pendulum["load"] + arm / 2) * 9.80665 * length
    t = np.arange(len(q)) / 100.0
    assert q == pytest.approx(0.05 * np.cos(np.sqrt(stiffness / inertia) * t), abs=2e-4)
