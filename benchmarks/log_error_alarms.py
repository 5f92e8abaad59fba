"""How often `identify` names an error of the log where the log has none.

Virtual recordings of robots of four makes whose model is right, or lacks Stribeck friction of half
the Coulomb friction or a base tilt of 0.5 degrees, or whose positions come in 4096 counts: all that
is wrong is in the model, or has a finding of its own.
"""

from __future__ import annotations

import argparse
from collections import Counter

import faults
from asbuilt.description.load import load_robot

ROBOTS = ("kuka-iiwa7-r800", "ur10e", "scara", "franka-panda")
FAULTS = ("none", "stribeck", "tilt", "counts")
REPETITIONS = 10
CODES = (
    "clock_wrong",
    "zero_position_wrong",
    "joint_gain_wrong",
    "torque_does_not_follow",
    "torque_saturates",
    "torque_drifts",
    "friction_drifts",
    "torque_unexplained",
)


def measure(repetitions: int = REPETITIONS) -> dict[str, float | str]:
    """Return the logs with a false alarm by robot and fault, and of how many."""
    numbers: dict[str, float | str] = {}
    for robot in ROBOTS:
        model = load_robot(robot)
        for fault in FAULTS:
            named = [
                {finding.code for finding in study.findings if finding.code in CODES}
                for study in faults.studies(model, fault, repetitions)
            ]
            codes = Counter(code for each in named for code in sorted(each))
            listed = ", ".join(f"{code} {count}" for code, count in codes.items())
            alarms = sum(map(bool, named))
            numbers[f"{robot}_{fault}_alarms"] = float(alarms)
            print(f"{robot:<18}{fault:<10}{alarms} of {repetitions}  {listed}", flush=True)
    return numbers


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("repetitions", nargs="?", type=int, default=REPETITIONS)
    found = measure(parser.parse_args().repetitions)
    print(f"{sum(float(value) for value in found.values()):.0f} false alarms")
