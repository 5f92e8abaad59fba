"""Whether `identify` names what acts on a robot, by 300 robots whose torque Pinocchio computes.

Four makes, of 2 to 7 joints, CAD off as usual, 20 to 60 s of a band-limited motion at 100 to 250
Hz, noise of torque and positions; on each robot nothing, one or two effects of ordinary size. What
is there should be named at its joint in 90 %, what is not there on 5 % of the robots; the sign of a
tilt is that of the world. Another motion of the same robot is predicted without and with effects.

    python benchmarks/effects.py --jobs 2 --out out/effects.jsonl
    python benchmarks/effects.py --robots 40 --only tilt,spring

Rows are added to the file, and robots that it has are not measured again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.errors import AsbuiltError
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.excitation.motions.motion import Motion
from asbuilt.experiment.recording import Recording, TorqueSource
from asbuilt.workflow.study import identify
from asbuilt.workflow.study_options import StudyOptions
from asbuilt.workflow.validation import validate
from effect_score import VISIBLE, Row, Score, Truth, by_family, score
from named_effects import APPLIED, named_effects
from outside_robot import (
    OutsideRobot,
    Sensors,
    configuration,
    mean_inertia,
    other_bodies,
    pinocchio_robot,
    with_body,
)

Array = NDArray[np.float64]

ROBOTS = 300
BAND = (0.3, 1.5)
"""Highest frequency of a motion [Hz]."""
COARSE = 100.0
"""Rate [Hz] at which sizes are drawn and effects are weighed."""
FELT = 0.3
"""Change of some joint's torque, in standard deviations of its noise, that makes an effect."""
SEEN_BY_CAD = ("gravity_spring", "balancer", "payload", "link_mass", "gain", "zero")
"""Families that bodies may imitate, at a distance from CAD; others must be visible without it."""
TRIES = 6
WEIGHED = 1500
"""Samples of the fit that weighs what no parameter imitates."""
OTHER_SECONDS = 20.0
SMALL = LinkInertia.from_com(1.0, np.zeros(3), 0.01 * np.eye(3))
"""Body of a link whose masses nobody has measured (the first of the Puma 560)."""


class Make(NamedTuple):
    """Robots of one kind: descriptions with the number of joints used, and their friction.

    `friction` is the range of Coulomb friction in torque limits, `noise` that of torque in RMS
    torque and in limits.
    """

    descriptions: tuple[tuple[str, int], ...]
    source: TorqueSource
    friction: tuple[float, float]
    noise: tuple[float, float]


MAKES = {
    "lightweight": Make(
        (("kuka-iiwa7-r800", 7), ("franka-panda", 7)), "sensor", (0.003, 0.01), (0.01, 5e-4)
    ),
    "industrial": Make((("ur10e", 6), ("puma-560", 6)), "motor", (0.01, 0.025), (0.015, 1e-3)),
    "scara": Make((("scara", 4),), "motor", (0.01, 0.025), (0.015, 1e-3)),
    "few joints": Make((("two-link", 2), ("ur10e", 3)), "motor", (0.01, 0.025), (0.015, 1e-3)),
}


@dataclass(frozen=True)
class Facts:
    """What sizes are drawn from: the motion's ranges, and torque and inertia of each joint (n,)."""

    model: RobotModel
    low: Array
    high: Array
    speed: Array
    torque: Array
    load: Array
    inertia: Array
    noise: Array

    @property
    def turning(self) -> list[int]:
        return [k for k, joint in enumerate(self.model.joints) if joint.is_revolute]


Drawn = tuple[OutsideRobot, int | None, float, str]
"""A robot with an effect, its joint, size and unit."""
Family = Callable[[OutsideRobot, Facts, np.random.Generator], Drawn]


def _joint(facts: Facts, rng: np.random.Generator, first: int = 0, turning: bool = False) -> int:
    places = facts.turning if turning else range(facts.model.n_joints)
    return int(rng.choice([k for k in places if k >= first]))


def _side(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _scaled(
    curve: Callable[[Array], Array], facts: Facts, k: int, rng: np.random.Generator
) -> tuple[Callable[[Array], Array], float]:
    """Return a torque over position of 8 to 25 % of the joint's RMS torque, and its RMS."""
    over = curve(np.linspace(facts.low[k], facts.high[k], 200))
    rms = rng.uniform(0.08, 0.25) * facts.torque[k]
    factor, mean = rms / float(np.std(over)), float(np.mean(over))
    return (lambda q: factor * (curve(q) - mean)), float(rms)


def _beside(robot: OutsideRobot, k: int, torque: Callable[[Array], Array]) -> OutsideRobot:
    return replace(robot, beside={**robot.beside, k: torque})


def tilt(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Turn the base about x or y of the world."""
    degrees, axis = _side(rng) * rng.uniform(1.0, 4.0), int(rng.integers(2))
    turned = replace(robot, turn=np.deg2rad(degrees) * np.eye(3)[axis])
    return turned, None, degrees, f"deg about {'xy'[axis]}"


def spring(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Add a torsion spring."""
    k = _joint(facts, rng)
    torque, rms = _scaled(lambda q: q, facts, k, rng)
    span = np.std(np.linspace(facts.low[k], facts.high[k], 200))
    return _beside(robot, k, torque), k, rms / float(span), "N m/rad"


def gravity_spring(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Add an extension spring between a point of the link and one of the link before.

    With `l^2 = a^2 + b^2 - 2 a b cos(q - q0)` the drive gives `c (l - l0) a b sin(q - q0) / l`.
    """
    k, start = _joint(facts, rng, 1, turning=True), rng.uniform(-np.pi, np.pi)
    a, b, free = 0.4, rng.uniform(0.1, 0.2), rng.uniform(0.1, 0.2)

    def curve(q: Array) -> Array:
        length = np.sqrt(a * a + b * b - 2 * a * b * np.cos(q - start))
        return np.asarray((length - free) * a * b * np.sin(q - start) / length)

    torque, rms = _scaled(curve, facts, k, rng)
    return _beside(robot, k, torque), k, rms, "N m"


def balancer(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Add a gas cylinder at joint 2, its force growing by the 1.3rd power as gas is compressed."""
    k, start = 1, rng.uniform(-np.pi, np.pi)
    a, b = 0.8, rng.uniform(0.15, 0.25)

    def curve(q: Array) -> Array:
        length = np.sqrt(a * a + b * b - 2 * a * b * np.cos(q - start))
        force = (1.0 - 0.5 * (length - a + b) / (2 * b)) ** -1.3
        return np.asarray(force * a * b * np.sin(q - start) / length)

    torque, rms = _scaled(curve, facts, k, rng)
    return _beside(robot, k, torque), k, rms, "N m"


def cable(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Add a smooth curve over position: Legendre polynomials of order 2 to 4."""
    k, shares = _joint(facts, rng), rng.normal(size=3)
    low, high = facts.low[k], facts.high[k]

    def curve(q: Array) -> Array:
        x = 2.0 * (q - low) / (high - low) - 1.0
        return np.asarray(np.polynomial.legendre.legval(x, [0.0, 0.0, *shares]))

    torque, rms = _scaled(curve, facts, k, rng)
    return _beside(robot, k, torque), k, rms, "N m"


def stribeck(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Add 30 to 60 % of Coulomb friction below a tenth of the top speed."""
    k = _joint(facts, rng)
    force = rng.uniform(0.3, 0.6) * robot.coulomb[k]
    speed = min(0.1, 0.1 * facts.speed[k]) * rng.uniform(0.4, 1.0)
    return replace(robot, stribeck={k: (force, speed)}), k, float(force), "N m"


def quadratic(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Add half to all of the friction at top speed, growing with speed squared."""
    k = _joint(facts, rng)
    top = robot.coulomb[k] + robot.viscous[k] * facts.speed[k]
    factor = float(rng.uniform(0.5, 1.0) * top / facts.speed[k] ** 2)
    return replace(robot, quadratic={k: factor}), k, factor, "N m s^2/rad^2"


def load_friction(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Add 4 to 10 % of the load to the friction of a joint that carries one."""
    loaded = np.flatnonzero(facts.load > 0.1 * facts.load.max())
    k, share = int(rng.choice(loaded)), float(rng.uniform(0.04, 0.1))
    return replace(robot, load_share={k: share}), k, share, ""


def coupling(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Let a motor turn with the joint before its own, too."""
    alike = [k for k in facts.turning if k - 1 in facts.turning]
    k, share = int(rng.choice(alike)), _side(rng) * rng.uniform(0.3, 0.9)
    return replace(robot, mix={(k, k - 1): share}), k, share, ""


def payload(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Put a body of 0.5 to 2 kg on the flange."""
    mass = float(rng.uniform(0.5, 2.0))
    centre = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.03, 0.12)])
    body = LinkInertia.from_com(mass, centre, mass * 0.4 * 0.05**2 * np.eye(3))
    link = facts.model.tool_link
    return replace(robot, bodies=with_body(robot.bodies, link, body)), None, mass, "kg"


def link_mass(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Make one link a fifth heavier, or lighter."""
    heavy = [k for k, link in enumerate(facts.model.links) if k and link.inertia.mass > 0.0]
    k, factor = int(rng.choice(heavy)), 1.0 + 0.2 * _side(rng)
    parameters = np.array(robot.bodies.parameters).reshape(-1, 10)
    parameters[k] *= factor
    more = float(parameters[k, 9] * (1.0 - 1.0 / factor))
    return replace(robot, bodies=robot.bodies.with_parameters(parameters.ravel())), k, more, "kg"


def gain(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Log one torque 10 to 20 % too large or small."""
    k, error = _joint(facts, rng), _side(rng) * rng.uniform(0.1, 0.2)
    return replace(robot, gain={k: 1.0 + error}), k, error, ""


def zero(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Log one position 1 to 3 degrees off."""
    k, degrees = _joint(facts, rng, turning=True), _side(rng) * rng.uniform(1.0, 3.0)
    return replace(robot, zero={k: np.deg2rad(degrees)}), k, degrees, "deg"


def delay(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Log torques 2 to 8 ms late."""
    late = float(rng.uniform(0.002, 0.008))
    return replace(robot, delay=late), None, 1e3 * late, "ms"


def elastic(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Let one link swing on its gear with 5 to 15 Hz."""
    k, frequency = _joint(facts, rng), rng.uniform(5.0, 15.0)
    stiffness = float((2.0 * np.pi * frequency) ** 2 * facts.inertia[k])
    return replace(robot, stiffness={k: stiffness}), k, stiffness, "N m/rad"


def presliding(robot: OutsideRobot, facts: Facts, rng: np.random.Generator) -> Drawn:
    """Let bristles bend by 0.1 to 0.5 % of the joint's range before they slide (Dahl)."""
    k = _joint(facts, rng)
    length = float(rng.uniform(0.001, 0.005) * (facts.high[k] - facts.low[k]))
    return replace(robot, bristle={k: length}), k, length, "rad"


FAMILIES: Mapping[str, Family] = {
    each.__name__: each
    for each in (
        *(tilt, spring, gravity_spring, balancer, cable, stribeck, quadratic, load_friction),
        *(coupling, payload, link_mass, gain, zero, delay, elastic, presliding),
    )
}


@dataclass(frozen=True)
class Case:
    """One robot with its CAD, what acts on it, and two logs of different motion."""

    number: int
    make: str
    cad: RobotModel
    truth: tuple[Truth, ...]
    log: Recording
    other: Recording


def case(number: int, families: Sequence[str] = ()) -> Case:
    """Draw robot `number`, which has one of some families if any are given."""
    rng = np.random.default_rng([20261123, number])
    name = list(MAKES)[number % len(MAKES)]
    make = MAKES[name]
    cad = described(*make.descriptions[int(rng.integers(len(make.descriptions)))])
    seconds, rate = rng.uniform(20.0, 60.0), float(rng.choice([100.0, 125.0, 200.0, 250.0]))
    band = rng.uniform(*BAND)
    motions = [
        random_fourier(cad, rng=rng, duration=length, n_harmonics=max(5, round(band * length)))
        for length in (seconds, OTHER_SECONDS)
    ]
    robot, facts = drawn_robot(cad, make, motions[0], rng)
    wanted = 1 if families else (number // len(MAKES)) % 3
    robot, truth = with_effects(robot, facts, motions[0], wanted, families or tuple(FAMILIES), rng)
    sensors = Sensors(
        facts.noise,
        counts=2.0 ** rng.integers(16, 21),
        turns=tuple(joint.is_revolute for joint in cad.joints),
        correlation_time=rng.uniform(0.02, 0.2),
        white=0.5,
        velocity=bool(rng.integers(2)),
    )
    logs = [
        robot.log(motion, sensors, rate, rng, source=source, torque_source=make.source)
        for motion, source in zip(motions, ("log", "other"), strict=True)
    ]
    return Case(number, name, cad, truth, *logs)


def described(name: str, n_joints: int) -> RobotModel:
    """Return the CAD of a bundled robot, or of its first joints; drives have no values."""
    model = load_robot(name)
    bare = tuple(replace(joint, drive=type(joint.drive)()) for joint in model.joints)
    links = tuple(
        link if link.inertia.mass > 0.0 else replace(link, inertia=SMALL)
        for link in model.links[:n_joints]
    )
    return replace(model, joints=bare[:n_joints], links=links, frames=(), motor_coupling=None)


def drawn_robot(
    cad: RobotModel, make: Make, motion: Motion, rng: np.random.Generator
) -> tuple[OutsideRobot, Facts]:
    """Return a robot as built, without effects, and what it does in a motion."""
    bodies, n = other_bodies(cad, rng), cad.n_joints
    still = OutsideRobot(bodies, *np.zeros((4, n)))
    move = still.logged(motion, COARSE)
    speed, largest = np.abs(move.qd).max(axis=0), np.abs(move.tau).max(axis=0)
    limits = np.array([joint.limits.torque for joint in cad.joints])
    limits = np.where(np.isfinite(limits), limits, 1.5 * largest)
    coulomb = rng.uniform(*make.friction, size=n) * limits
    inertia = mean_inertia(bodies, move.q[::50])
    robot = replace(
        still,
        coulomb=coulomb,
        viscous=rng.uniform(0.5, 1.5, size=n) * coulomb / speed,
        offset=rng.normal(scale=0.2, size=n) * coulomb,
        armature=(make.source == "motor") * rng.uniform(0.1, 0.3, size=n) * inertia,
    )
    torque = np.sqrt(np.mean(robot.logged(motion, COARSE).tau ** 2, axis=0))
    noise = make.noise[0] * torque + make.noise[1] * limits
    low, high = move.q.min(axis=0), move.q.max(axis=0)
    load = np.sqrt(np.mean(move.tau**2, axis=0))
    return robot, Facts(cad, low, high, speed, torque, load, inertia, noise)


def with_effects(
    robot: OutsideRobot,
    facts: Facts,
    motion: Motion,
    wanted: int,
    families: Sequence[str],
    rng: np.random.Generator,
) -> tuple[OutsideRobot, tuple[Truth, ...]]:
    """Return the robot with effects of different families at different joints, and what they are.

    An effect that no torque feels is drawn again, and one that friction imitates wholly.
    """
    truth: list[Truth] = []
    for family in rng.permutation(families).tolist():
        if len(truth) == wanted:
            break
        if family in ("coupling", "balancer") and len(facts.turning) < 2:
            continue
        taken = {each.joint for each in truth} - {None}
        for _ in range(TRIES):
            changed, k, size, unit = FAMILIES[family](robot, facts, rng)
            joint = None if k is None else facts.model.joint_names[k]
            if joint in taken or felt(robot, changed, facts, motion) < FELT:
                continue
            apart = [hidden_from_fit(each, facts, motion) for each in (changed, robot)]
            visible = round(apart[0] - apart[1], 3)
            if visible < VISIBLE and family not in SEEN_BY_CAD:
                continue
            beside = facts.model.joint_names[k - 1 : k] if family == "coupling" and k else ()
            truth.append(Truth(family, joint, float(size), unit, visible, beside))
            robot = changed
            break
    return robot, tuple(truth)


def felt(robot: OutsideRobot, changed: OutsideRobot, facts: Facts, motion: Motion) -> float:
    """Return the largest change of a torque at the logged states, in deviations of its noise."""
    log = changed.logged(motion, COARSE)
    before = robot.at_states(log)
    return float(np.max(np.sqrt(np.mean((log.tau - before) ** 2, axis=0)) / facts.noise))


def hidden_from_fit(robot: OutsideRobot, facts: Facts, motion: Motion) -> float:
    """Return the RMS residual of a fit of all parameters, in deviations of the noise.

    By Pinocchio's regressor, with viscous, Coulomb and offset torque and rotors.
    """
    log = robot.logged(motion, COARSE)
    some = np.linspace(0, len(log.t) - 1, WEIGHED).astype(int)
    model = pinocchio_robot(facts.model)
    data, n = model.createData(), facts.model.n_joints
    rows = []
    for q, qd, qdd in zip(log.q[some], log.qd[some], log.qdd[some], strict=True):
        bodies = pin.computeJointTorqueRegressor(model, data, configuration(model, q), qd, qdd)
        drives = [np.diag(x) for x in (qd, np.sign(qd), np.ones(n), qdd)]
        rows.append(np.hstack([bodies, *drives]) / facts.noise[:, None])
    W, tau = np.vstack(rows), (log.tau[some] / facts.noise).ravel()
    left = tau - W @ np.linalg.lstsq(W, tau, rcond=1e-9)[0]
    return float(np.sqrt(np.mean(left**2)))


def measured(number: int, families: Sequence[str] = ()) -> Row:
    """Identify one robot in every mode, and return what was named and how another motion fits."""
    drawn = case(number, families)
    errors: dict[str, float] = {}
    named, seconds, problem = (), np.nan, ""
    for mode, options in modes().items():
        start = time.process_time()
        try:
            study = identify(drawn.cad, drawn.log, options=options)
            seconds = time.process_time() - start
            named = named_effects(study)
            (other,) = validate(study, drawn.other)
            errors[mode] = float(other.metrics_as_built.relative_error)
        except AsbuiltError as error:
            problem = f"{mode}: {type(error).__name__}: {error}"
    return Row(number, drawn.make, drawn.truth, named, errors, seconds, problem)


def modes() -> dict[str, StudyOptions]:
    """Return the options by mode; the last one names effects."""
    if APPLIED:
        return {"none": StudyOptions(**{"effects": "none"}), "auto": StudyOptions()}
    return {"none": StudyOptions()}


def rows(
    numbers: Iterable[int], families: Sequence[str], jobs: int, out: Path | None
) -> Iterator[Row]:
    """Yield the rows of robots: those that the file has, then the others, which are added."""
    known = read_rows(out) if out is not None else {}
    wanted = list(numbers)
    yield from (known[number] for number in wanted if number in known)
    left = [number for number in wanted if number not in known]
    one = partial(measured, families=families)
    with ProcessPoolExecutor(jobs) as pool:  # starts no process before it is asked to work
        for row in pool.map(one, left) if jobs > 1 else map(one, left):
            if out is not None:
                out.parent.mkdir(parents=True, exist_ok=True)
                with out.open("a") as file:
                    file.write(json.dumps(row.as_json()) + "\n")
            yield row


def read_rows(path: Path) -> dict[int, Row]:
    """Return the rows of a file by robot."""
    lines = path.read_text().splitlines() if path.exists() else []
    every = [Row.from_json(json.loads(line)) for line in lines]
    return {row.robot: row for row in every}


def text_of(row: Row) -> str:
    """Return a row as one line."""
    truth = ", ".join(
        f"{t.effect}{'@' + t.joint if t.joint else ''} {t.size:.3g} {t.unit}"
        f" [{t.visible:.2f}] {row.found(t)}"
        for t in row.truth
    )
    false = ", ".join(f"{e.effect}{'@' + e.joint if e.joint else ''}" for e in row.false_names())
    errors = " ".join(f"{mode} {100 * error:.2f} %" for mode, error in row.errors.items())
    return (
        f"{row.robot:>4} {row.make:<12} {truth or 'nothing'}; false: {false or '-'}; {errors};"
        f" {row.seconds:.1f} s {row.problem}"
    )


def measure(robots: int = ROBOTS) -> dict[str, float | str]:
    """Return the scores of the first robots."""
    return report(list(rows(range(robots), (), 1, None)))


def report(measured_rows: Sequence[Row]) -> dict[str, float | str]:
    """Print the table by family, and return the scores."""
    print(f"{'':<16}{'acts':>6}{'named':>7}{'altern.':>9}{'falsely':>9}")
    for family, counts in by_family(measured_rows).items():
        print(f"{family:<16}{counts[0]:>6}{counts[1]:>7}{counts[2]:>9}{counts[3]:>9}")
    found: Score = score(measured_rows)
    numbers: dict[str, float | str] = {
        each.name: float(getattr(found, each.name))
        for each in fields(Score)
        if each.name != "errors"
    }
    return numbers | {f"error_{mode}_percent": 100 * e for mode, e in found.errors.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=ROBOTS, help="how many")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--only", default="", help=f"families, of {', '.join(FAMILIES)}")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="file of rows, which is continued")
    given = parser.parse_args()
    only = tuple(each for each in given.only.split(",") if each)
    numbers = range(given.first, given.first + given.robots)
    every = []
    for each in rows(numbers, only, given.jobs, given.out):
        every.append(each)
        print(text_of(each), flush=True)
    for key, value in report(every).items():
        print(f"{key:<24} {value:.3f}")
