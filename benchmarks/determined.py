"""Whether what asbuilt prints is what the log determines: a table for each kind of statement.

    python benchmarks/determined.py [TABLE...] [--robots N] [--workers N] [--out FOLDER]

intervals
    Feasible intervals on virtual robots of five makes: 20 to 40 s of a motion of its own each,
    bodies off from CAD by a tenth, friction and rotors that CAD lacks, torque noise correlated over
    0.1 s. Truth and torque are Pinocchio's.
false_errors
    `check` on sound logs of virtual robots whose descriptions are wrong (`sound_logs`).
silent
    95 % intervals of robots with something that was once passed over in silence (`lacking`): hold
    the truth in 93 %, or it is named.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt import RobotModel, identify, load_robot, random_fourier
from asbuilt.identification import IdentificationResult, feasible_intervals
from lacking import PLANAR, Trial, trials
from measurements import Run, count, resume
from outside_robot import Array, OutsideRobot, Sensors, other_bodies
from sound_logs import false_errors

MAKES = ("kuka-iiwa7-r800", "franka-panda", "ur10e", "so-101", "scara")
ROBOTS = 200
LOGS = 4
"""Logs of each robot with something."""
RATE, HARMONICS = 200.0, 20
OFF = 0.1
"""Relative error of CAD masses, centres and shapes."""
NOISE = 0.02
"""Torque noise in the typical torque of a joint."""
QUANTITIES = ("mass", "com", "Ixx", "Iyy", "Izz", "armature")
REGIONS = ("each", "joint")
NORMAL_95 = 1.959964


@dataclass(frozen=True, slots=True)
class Held:
    """One interval of one robot, with the truth and the value that was chosen."""

    make: str
    seed: int
    kind: str
    region: str
    quantity: str
    least: float
    greatest: float
    chosen: float | None
    determined: bool
    truth: float

    def _has(self, value: float) -> bool:
        """Whether a value is in it, up to the solver's six digits."""
        rounding = 1e-5 * abs(value)
        return self.least - rounding <= value <= self.greatest + rounding

    @property
    def holds(self) -> bool:
        """Whether it holds the truth."""
        return self._has(self.truth)

    @property
    def misses_chosen(self) -> bool:
        """Whether the chosen value is outside."""
        return self.chosen is not None and not self._has(self.chosen)

    @property
    def width(self) -> float:
        """Width of the interval in the true value; infinite if it is open."""
        return (self.greatest - self.least) / max(abs(self.truth), 1e-9)

    @property
    def chosen_error(self) -> float:
        """Error of the chosen value in the true one."""
        chosen = np.nan if self.chosen is None else self.chosen
        return abs(chosen - self.truth) / max(abs(self.truth), 1e-9)


def virtual_robot(model: RobotModel, rng: np.random.Generator) -> OutsideRobot:
    """Return a robot off from its CAD, with friction and rotors of the size of its torques."""
    n, bodies = model.n_joints, other_bodies(model, rng, mass=OFF, centre=OFF, shape=OFF)
    scale = rng.uniform(0.5, 2.0, size=(4, n))
    about = np.array([link.inertia.mass for link in model.links])[::-1].cumsum()[::-1][:n]
    return OutsideRobot(
        bodies,
        viscous=0.1 * about * scale[0],
        coulomb=0.2 * about * scale[1],
        offset=0.02 * about * rng.normal(size=n),
        armature=0.01 * about * scale[3],
    )


def study(make: str, seed: int) -> tuple[OutsideRobot, IdentificationResult]:
    """Return a virtual robot and its identification with default options."""
    rng, described = np.random.default_rng(seed), load_robot(make)
    bare = tuple(replace(joint, drive=type(joint.drive)()) for joint in described.joints)
    model = replace(described, joints=bare)
    robot = virtual_robot(model, rng)
    motion = random_fourier(
        model, rng=rng, duration=float(rng.uniform(20.0, 40.0)), n_harmonics=HARMONICS
    )
    torque = robot.logged(motion).tau
    turns = tuple(joint.is_revolute for joint in model.joints)
    sensors = Sensors(NOISE * torque.std(axis=0), turns=turns)
    log = robot.log(motion, sensors, RATE, rng, torque_source="motor")
    return robot, identify(model, log).result


def true_values(robot: OutsideRobot) -> Mapping[str, float]:
    """Return the true value of every quantity by name."""
    truth = {"mass": float(sum(link.inertia.mass for link in robot.bodies.links))}
    for link in robot.bodies.links:
        body = link.inertia
        truth[f"mass:{link.name}"] = float(body.mass)
        for axis, moment in zip("xyz", body.com.tolist(), strict=True):
            truth[f"c{axis}:{link.name}"] = moment
        for name, value in zip(("Ixx", "Iyy", "Izz"), np.diag(body.inertia).tolist(), strict=True):
            truth[f"{name}:{link.name}"] = value
    for name, value in zip(robot.bodies.joint_names, robot.armature.tolist(), strict=True):
        truth[f"armature:{name}"] = value
    return truth


def true_base(robot: OutsideRobot, result: IdentificationResult) -> Array:
    """Return the true base parameters; what the robot does not have is zero."""
    own = {
        "Ia": robot.armature,
        "Fv": robot.viscous,
        "Fc": robot.coulomb,
        "Fo": robot.offset,
    }
    values = [*robot.bodies.parameters]
    for name in result.base.standard_names[len(values) :]:
        has = name[:2] in own and name[2:].isdigit()
        values.append(float(own[name[:2]][int(name[2:]) - 1]) if has else 0.0)
    return np.asarray(result.base.values(np.array(values)))


def intervals_of(task: tuple[str, int]) -> dict[str, Any]:
    """Return the intervals of one virtual robot, and the errors of its base parameters."""
    make, seed = task
    started = time.process_time()
    robot, result = study(make, seed)
    truth = true_values(robot)
    lacks = () if "armature" in result.base.drive.keys else ("armature",)
    names = [x for x in QUANTITIES if x not in lacks]
    names += [f"mass:{link.name}" for link in robot.bodies.links]
    found = []
    for region in REGIONS:
        for each in feasible_intervals(result, names, region=region):
            kind = {"c": "centre", "I": "inertia"}.get(each.quantity[0], "")
            kind = kind or each.quantity.replace("mass:", "link mass:").partition(":")[0]
            held = Held(
                *(make, seed, kind, region, each.quantity, each.least, each.greatest),
                *(each.chosen, each.determined, truth[each.quantity]),
            )
            found.append(asdict(held))
    errors = (result.estimates - true_base(robot, result)) / result.std_errors
    return {
        "intervals": found,
        "errors": dict(zip(result.base.names, errors.tolist(), strict=True)),
        "seconds": time.process_time() - started,
    }


def intervals(robots: int, run: Run, out: Path | None) -> None:
    """Print how many feasible intervals hold the truth."""
    tasks = [(MAKES[k % len(MAKES)], k) for k in range(robots)]
    path = None if out is None else out / "intervals.jsonl"
    documents = list(resume(path, tasks, intervals_of, run))
    found = [Held(**each) for document in documents for each in document["intervals"]]
    print(f"Feasible intervals of {robots} virtual robots of {len(MAKES)} makes")
    print(f"{'':>28} {'intervals':>9} {'hold':>6} {'open':>6} {'width':>7} {'chosen off':>10}")
    for region in REGIONS:
        own = [each for each in found if each.region == region]
        groups: dict[str, list[Held]] = {f"{region}: all": own}
        groups |= {
            f"{region}: determined": [each for each in own if each.determined],
            f"{region}: not determined": [each for each in own if not each.determined],
            f"{region}: chosen outside": [each for each in own if each.misses_chosen],
        }
        for key in ("make", "kind"):
            for value in dict.fromkeys(getattr(each, key) for each in own):
                groups[f"{region}: {value}"] = [x for x in own if getattr(x, key) == value]
        for name, group in groups.items():
            if not group:
                continue
            widths = np.array([each.width for each in group])
            hold = np.mean([each.holds for each in group])
            off = np.median([each.chosen_error for each in group])
            print(
                f"{name:>28} {len(group):9d} {hold:6.3f} {np.mean(np.isinf(widths)):6.2f}"
                f" {np.median(widths):7.2f} {off:10.2f}"
            )
        by_robot: dict[tuple[str, int], list[bool]] = {}
        for each in own:
            by_robot.setdefault((each.make, each.seed), []).append(each.holds)
        print(
            f"  {region}: robots whose intervals all hold {count([*map(all, by_robot.values())])}"
        )
    print("95 % intervals of base parameters")
    for make in ("", *MAKES):
        some = [each for each in documents if make in ("", each["task"][0])]
        errors = np.array([z for each in some for z in each["errors"].values()])
        if errors.size:
            print(
                f"{make or 'all':>28} {count(np.abs(errors) < NORMAL_95)}, RMS"
                f" {np.sqrt(np.mean(errors**2)):.2f}, farthest {np.abs(errors).max():.1f}"
            )


SILENT = {
    "nothing": ("two-link", "ur10e"),
    "plane_tilt": (PLANAR,),
    "crosstalk": ("two-link", "ur10e"),
    "asymmetry": ("two-link", "ur10e"),
    "backlash": ("two-link", "ur10e"),
    "held_rows": ("two-link", "ur10e"),
}
"""What robots have, and which ones."""


def silent_of(task: tuple[str, str, int]) -> tuple[str, str, list[Trial]]:
    """Return the trials of one robot."""
    robot, what, robots = task
    return robot, what, list(trials(robot, what, robots))


def silent(robots: int, run: Run, out: Path | None) -> None:
    """Print how many intervals hold the truth, and what was named."""
    tasks = [(robot, what, robots) for what, names in SILENT.items() for robot in names]
    print(f"95 % intervals of {robots} logs each, and in how many of these it is named")
    print(f"{'':<12} {'robot':<10} {'hold':>6} {'worst':>6} {'farthest':>9} {'named':>6}  others")
    for robot, what, found in run(silent_of, tasks):
        held: dict[str, list[bool]] = {}
        for trial in found:
            for name, inside in zip(trial.names, trial.held.tolist(), strict=True):
                held.setdefault(name, []).append(inside)
        shares = [float(np.mean(inside)) for inside in held.values()]
        farthest = max(float(np.abs(trial.errors).max()) for trial in found)
        others = Counter(name for trial in found for name in trial.other_names)
        listed = ", ".join(f"{name} {count}" for name, count in others.items())
        print(
            f"{what:<12} {robot:<10} {np.mean(shares):6.3f} {min(shares):6.2f} {farthest:9.1f}"
            f" {sum(trial.named for trial in found):6d}  {listed}",
            flush=True,
        )


TABLES = {"intervals": intervals, "false_errors": false_errors, "silent": silent}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tables", nargs="*", help=f"{', '.join(TABLES)} (default: all)")
    parser.add_argument("--robots", type=int, help=f"default: {ROBOTS}, of silent {LOGS} a row")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder of rows, which are continued")
    given = parser.parse_args()
    with ProcessPoolExecutor(given.workers) as pool:
        for name in given.tables or TABLES:
            robots = given.robots or (LOGS if name == "silent" else ROBOTS)
            TABLES[name](robots, pool.map, given.out)


if __name__ == "__main__":
    main()
