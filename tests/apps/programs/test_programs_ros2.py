"""ROS 2 programs: the YAML against the motion, and the script run against stand-ins for ROS."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from asbuilt import make_program
from asbuilt.apps.programs import write_program
from asbuilt.description import bundled_robot
from asbuilt.excitation import Motion, random_fourier
from studied_cases import first_of

ROBOTS = ("ur10e", "scara")

STAND_INS = {
    "rclpy/__init__.py": (
        """
import json, os, sys
from types import SimpleNamespace
from . import signals
STATE = json.loads(open(os.environ['ROBOT']).read())
nodes = []
def init(**options): assert options['signal_handler_options'] is signals.SignalHandlerOptions.NO
def try_shutdown(): pass
def spin_once(node, timeout_sec):
    for kind, topic, callback in node.subscriptions_made:
        callback(SimpleNamespace(name=STATE['names'][::-1], position=STATE['pose'][::-1]))
def spin_until_future_complete(node, future, timeout_sec=None):
    if STATE.get('interrupt') and future.kind == 'result' and STATE['goals'] == 2:
        raise KeyboardInterrupt
"""
    ),
    "rclpy/signals.py": (
        "import enum\nclass SignalHandlerOptions(enum.Enum):\n    NO = 0\n    ALL = 1\n"
    ),
    "rclpy/node.py": (
        """
class Node:
    def __init__(self, name): self.subscriptions_made = []
    def create_subscription(self, kind, topic, callback, depth):
        self.subscriptions_made.append((kind, topic, callback))
"""
    ),
    "rclpy/action.py": (
        """
import json, os
from types import SimpleNamespace
import rclpy
class Future:
    def __init__(self, kind, value): self.kind, self.value = kind, value
    def result(self): return self.value
class ActionClient:
    def __init__(self, node, action, name): self.name = name
    def wait_for_server(self, timeout_sec): return True
    def send_goal_async(self, goal):
        state, trajectory = rclpy.STATE, goal.trajectory
        state['goals'] = state.get('goals', 0) + 1
        rows = [[p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec,
            p.positions, p.velocities, p.accelerations] for p in trajectory.points]
        with open(os.environ['GOALS'], 'a') as file:
            file.write(json.dumps({'server': self.name, 'names': trajectory.joint_names,
                'rows': rows}) + '\\n')
        if not state.get('stuck'):
            state['pose'] = [dict(zip(trajectory.joint_names, trajectory.points[-1].positions))[n]
                for n in state['names']]
        code = state.get('error', 0)
        answer = SimpleNamespace(result=SimpleNamespace(error_code=code, error_string='a reason'))
        return Future('goal', SimpleNamespace(accepted=not state.get('refuse'),
            get_result_async=lambda: Future('result', answer),
            cancel_goal_async=self.cancel))
    def cancel(self):
        with open(os.environ['GOALS'], 'a') as file: file.write('"cancelled"\\n')
        return Future('cancel', None)
"""
    ),
    "control_msgs/action.py": (
        """
from types import SimpleNamespace
class FollowJointTrajectory:
    class Goal(SimpleNamespace): pass
    class Result: SUCCESSFUL = 0
"""
    ),
    "builtin_interfaces/msg.py": (
        """
class Duration:
    def __init__(self, sec=0, nanosec=0):
        assert isinstance(sec, int) and isinstance(nanosec, int) and 0 <= nanosec < 10**9
        self.sec, self.nanosec = sec, nanosec
"""
    ),
    "sensor_msgs/msg.py": "class JointState: pass\n",
    "trajectory_msgs/msg.py": (
        """
class JointTrajectoryPoint:
    def __init__(self, positions, velocities, accelerations, time_from_start):
        for values in (positions, velocities, accelerations):
            assert all(isinstance(x, float) for x in values)
        self.positions, self.velocities, self.accelerations = positions, velocities, accelerations
        self.time_from_start = time_from_start
class JointTrajectory:
    def __init__(self, joint_names=None, points=None):
        self.joint_names, self.points = joint_names or [], points or []
"""
    ),
}


@dataclass(frozen=True)
class Made:
    """The files of a program and the motion they are for."""

    motion: Motion
    names: tuple[str, ...]
    folder: Path

    def run(
        self, *arguments: str, offset: float = 0.3, answers: str = "yes\nyes\n", **robot: Any
    ) -> tuple[subprocess.CompletedProcess[str], list[Any]]:
        fakes, goals, state = (
            self.folder / "fakes",
            self.folder / "goals.jsonl",
            self.folder / "robot.json",
        )
        goals.unlink(missing_ok=True)
        state.write_text(
            json.dumps(
                {"names": list(self.names), "pose": (self.motion.start + offset).tolist(), **robot}
            )
        )
        environment = {
            **os.environ,
            "PYTHONPATH": str(fakes),
            "PATH": f"{fakes}:{os.environ['PATH']}",
            "ROBOT": str(state),
            "GOALS": str(goals),
        }
        script = self.folder / "run_run.py"
        text = (
            script.read_text()
            .replace("time.sleep(2.0 + PAUSE)", "time.sleep(0.3)")
            .replace("time.sleep(PAUSE)", "pass")
        )
        quick = self.folder / "quick.py"
        quick.write_text(text)
        done = subprocess.run(
            [sys.executable, str(quick), *arguments],
            input=answers,
            capture_output=True,
            text=True,
            check=False,
            env=environment,
            cwd=self.folder,
        )
        return done, (
            [json.loads(line) for line in goals.read_text().splitlines()] if goals.exists() else []
        )


@pytest.fixture(params=ROBOTS)
def made(request: pytest.FixtureRequest, tmp_path: Path) -> Made:
    model = bundled_robot(request.param)
    motion = random_fourier(model, rng=6, duration=4.01, n_harmonics=3)
    write_program(tmp_path, make_program(model, motion, "ros2", name="run", rate=25.0))
    for name, text in STAND_INS.items():
        path = tmp_path / "fakes" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        (path.parent / "__init__.py").touch()
        path.write_text(text)
    recorder = tmp_path / "fakes" / "ros2"
    recorder.write_text(
        f"#!{sys.executable}\nimport pathlib, signal, sys, time\n"
        f"bag = pathlib.Path({str(tmp_path / 'recorder.txt')!r})\n"
        'def stop(*_):\n    bag.write_text(bag.read_text() + "\\nclosed")\n    sys.exit(0)\n'
        'bag.write_text(" ".join(sys.argv[1:]))\nsignal.signal(signal.SIGINT, stop)\n'
        "time.sleep(30)\n"
    )
    recorder.chmod(0o755)
    return Made(motion, model.joint_names, tmp_path)


def test_yaml_holds_the_motion_to_the_printed_digits(made: Made) -> None:
    for name, motion, rate in (
        ("run.yaml", made.motion, 25.0),
        ("run_dry_run.yaml", made.motion.slowed(10), 2.5),
    ):
        document = yaml.safe_load((made.folder / name).read_text())
        assert document["joint_names"] == list(made.names)
        stamps = [point["time_from_start"] for point in document["points"]]
        t = np.array([stamp["sec"] + 1e-9 * stamp["nanosec"] for stamp in stamps])
        assert t[-1] == pytest.approx(motion.duration, abs=1e-9)
        np.testing.assert_allclose(np.diff(t)[:-1], 1 / rate, atol=1.1e-9)
        for key, values in zip(
            ("positions", "velocities", "accelerations"),
            motion.at(np.minimum(t, motion.duration)),
            strict=True,
        ):
            np.testing.assert_allclose(
                [point[key] for point in document["points"]],
                values,
                atol=0.51e-9 + 1e-9 * np.abs(motion.peaks(3)).max(),
            )


@pytest.mark.parametrize("arguments", [(), ("--full", "--controller", "/arm_controller")])
def test_script_approaches_records_and_runs(made: Made, arguments: tuple[str, ...]) -> None:
    done, goals = made.run(*arguments)
    assert done.returncode == 0, done.stderr
    approach, motion = goals
    meant = made.motion if arguments else made.motion.slowed(10)
    np.testing.assert_allclose(approach["rows"][0][1], made.motion.start + 0.3, atol=1e-9)
    np.testing.assert_allclose(approach["rows"][-1][1], made.motion.start, atol=1e-9)
    assert approach["rows"][-1][0] >= 1.875 * 0.3 / 0.2
    assert approach["rows"][-1][0] == int(approach["rows"][-1][0])
    assert motion["rows"][-1][0] == pytest.approx(meant.duration)
    np.testing.assert_allclose(
        [row[1] for row in motion["rows"]],
        meant.derivative([min(row[0], meant.duration) for row in motion["rows"]]),
        atol=1e-7,
    )
    assert {goal["server"] for goal in goals} == {
        ("/arm_controller" if arguments else "/joint_trajectory_controller")
        + "/follow_joint_trajectory"
    }
    folder = made.folder / ("run_bag" if arguments else "run_dry_run_bag")
    assert (
        made.folder / "recorder.txt"
    ).read_text() == f"bag record -o {folder} /joint_states\nclosed"
    assert ("FULL SPEED" in done.stdout) == bool(arguments)


@pytest.mark.parametrize(
    ("robot", "answers", "said", "n_goals"),
    first_of(
        5,
        [
            ({}, "no\n", "", 0),
            ({}, "yes\nno\n", "", 1),
            ({"stuck": True}, "yes\nyes\n", "the start pose has", 1),
            ({"refuse": True}, "yes\nyes\n", "refused the trajectory", 1),
            ({"error": -4}, "yes\nyes\n", "error -4: a reason", 1),
        ],
    ),
)
def test_script_stops_where_something_is_wrong(
    made: Made, robot: dict[str, Any], answers: str, said: str, n_goals: int
) -> None:
    done, goals = made.run("--full", answers=answers, **robot)
    assert done.returncode == 1
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert len(goals) == n_goals
    assert not (made.folder / "recorder.txt").exists()


def test_interrupting_cancels_the_motion_and_closes_the_bag(made: Made) -> None:
    done, goals = made.run("--full", interrupt=True)
    assert done.returncode == 130
    assert goals[-1] == "cancelled"
    assert (made.folder / "recorder.txt").read_text().endswith("closed")
    (made.folder / "run_bag").mkdir()
    again, nothing = made.run("--full")
    assert again.returncode == 1
    assert "exists" in again.stderr
    assert nothing == []
