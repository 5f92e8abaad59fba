"""Record an episode that is made for identification, on an SO-101 or a virtual one.

    python examples/10_record_an_episode.py                         # a virtual arm
    python examples/10_record_an_episode.py --port /dev/ttyACM0     # with LeRobot, your arm

Motion: designed, within half of the range of each joint; length: 40 s; rate: 50 Hz. The arm first
moves to its start in 4 s. Clear the table: nothing checks for obstacles.
"""

import argparse
import importlib
import tempfile
import time
from pathlib import Path

import numpy as np

import asbuilt

RATE, DURATION, APPROACH = 50.0, 40.0, 4.0

parser = argparse.ArgumentParser()
parser.add_argument("--port", help="serial port of the arm; without it a virtual one is recorded")
parser.add_argument("--id", help="name of the arm's calibration in LeRobot")
parser.add_argument("--out", type=Path, default=Path(tempfile.mkdtemp()) / "episode.csv")
given, _ = parser.parse_known_args()

model = asbuilt.load_robot("so-101")
options = asbuilt.DesignOptions(duration=DURATION, fraction=0.5, starts=1)
motion = asbuilt.design_motion(model, options).motion


def record_arm(commands):
    """Send commands (N, n) [rad] to a real arm and return times and positions."""
    follower = importlib.import_module("lerobot.robots.so101_follower")
    settings = follower.SO101FollowerConfig(port=given.port, id=given.id, use_degrees=True)
    arm = follower.SO101Follower(settings)
    arm.connect()

    def read():
        state = arm.get_observation()
        return np.deg2rad([state[f"{name}.pos"] for name in model.joint_names])

    def send(command):
        pairs = zip(model.joint_names, np.rad2deg(command), strict=True)
        arm.send_action({f"{name}.pos": float(value) for name, value in pairs})

    try:
        start = read()
        for share in np.linspace(0.0, 1.0, int(APPROACH * RATE)):
            send(start + share * (commands[0] - start))
            time.sleep(1.0 / RATE)
        times, positions = [], []
        begin = time.perf_counter()
        for k, command in enumerate(commands):
            time.sleep(max(0.0, begin + k / RATE - time.perf_counter()))
            positions.append(read())
            times.append(time.perf_counter() - begin)
            send(command)
        return np.array(times), np.array(positions)
    finally:
        arm.disconnect()


if given.port:
    commands = motion.sample(RATE).q
    times, positions = record_arm(commands)
else:
    robot = asbuilt.VirtualRobot.preset("servo", model, rng=1).logging(RATE)
    episode = robot.record(motion, rng=1).recording
    times, positions, commands = episode.t, episode.q, episode.command

names = [f"{label}_{name}" for label in ("q", "command") for name in model.joint_names]
table = np.column_stack([times, positions, commands])
np.savetxt(given.out, table, delimiter=",", header=",".join(["t", *names]), comments="")

study = asbuilt.identify(model, given.out, kp=17.8, torque_limit=3.35)
print(str(study.summary()).splitlines()[0])
asbuilt.export_result(study.result, mjcf=given.out.with_suffix(".xml"))
print(f"{given.out} and {given.out.with_suffix('.xml')}")
assert given.port or study.rollouts[0].as_built.rms_all < study.rollouts[0].cad.rms_all
