"""Logs of robots with something that the model lacks, whose torque another engine computes.

40 s of a motion of its own each, bodies off from CAD as usual, torque noise of 0.1 N m correlated
over 0.1 s, encoders at the motors and torque sensors behind the gears.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.recording import Recording, TorqueSource
from asbuilt.workflow.study import Study, identify
from named_effects import named_effects
from outside_robot import Engine, OutsideRobot, Sensors, mean_inertia, other_bodies

Array = NDArray[np.float64]

SHARED_IIWA = Path("../shared/models/iiwa14.urdf")
ROBOTS = {
    "two-link": "two-link",
    "ur10e": "ur10e",
    "iiwa 14": str(SHARED_IIWA) if SHARED_IIWA.exists() else "kuka-iiwa7-r800",
}
"""Without the recordings' folder the iiwa 7 takes the place of the iiwa 14."""
PLANAR = "planar"
DURATION, RATE, HARMONICS = 40.0, 200.0, 40
NOISE = 0.1
VISCOUS, COULOMB, OFFSET = 1.0, 2.0, 0.3


@dataclass(frozen=True, slots=True)
class Lacking:
    """What a robot has: its effect by name, findings that name it too, counts and rate [Hz].

    `log` is what is done to its log.
    """

    effect: str
    change: Callable[[OutsideRobot, Array], OutsideRobot] = lambda robot, inertia: robot
    log: Callable[[Recording], Recording] = lambda log: log
    source: TorqueSource = "sensor"
    codes: tuple[str, ...] = ()
    counts: float = 2.0**20
    rate: float = RATE


def _all(value: float | tuple[float, float], robot: OutsideRobot) -> dict[int, object]:
    return dict.fromkeys(range(len(robot.coulomb)), value)


def _elastic(robot: OutsideRobot, inertia: Array) -> OutsideRobot:
    stiffness = (2.0 * np.pi * 7.0) ** 2 * inertia
    return replace(robot, stiffness=dict(enumerate(stiffness.tolist())))


def _uneven(q: Array, qd: Array) -> Array:
    """Return Coulomb friction that changes by 40 % over a turn, twice."""
    return np.asarray(0.4 * COULOMB * np.cos(2.0 * q + 1.0) * np.sign(qd))


def _ripple(q: Array, qd: Array) -> Array:
    """Return a torque of 12 waves a turn, a quarter of Coulomb friction."""
    return np.asarray(0.25 * COULOMB * np.sin(12.0 * q + 1.0))


def _hose(q: Array, qd: Array) -> Array:
    """Return the torque of hoses from link to link: a potential of neighbouring positions.

    `c cos(2 q_k - q_(k-1) + 1)` at each pair, c of half of Coulomb friction.
    """
    torque = np.zeros_like(q)
    force = 0.5 * COULOMB * np.sin(2.0 * q[:, 1:] - q[:, :-1] + 1.0)
    torque[:, 1:] += 2.0 * force
    torque[:, :-1] -= force
    return torque


def _mix_sensors(robot: OutsideRobot, inertia: Array) -> OutsideRobot:
    """Return the robot with 2 % of a neighbour's torque at every other sensor."""
    n = len(robot.coulomb)
    return replace(robot, crosstalk={(k, (k + 1) % n): 0.02 for k in range(0, n, 2)})


def _turn_in_plane(robot: OutsideRobot, inertia: Array) -> OutsideRobot:
    """Return the robot with its base turned by half a degree about the axis of joint 2."""
    return replace(robot, turn=np.deg2rad([0.0, 0.5, 0.0]))


def _hold_rows(log: Recording) -> Recording:
    """Return a log whose rows hold each second sample twice."""
    rows = np.arange(log.n_samples) // 2 * 2
    return replace(log, q=log.q[rows], tau=log.tau[rows])


NAMELESS = ("torque_nameless",)
LACKING = {
    "nothing": Lacking(""),
    "stribeck": Lacking(
        "stribeck", lambda r, _: replace(r, stribeck=_all((0.5 * COULOMB, 0.1), r))
    ),
    "tilt": Lacking("tilt", lambda r, _: replace(r, turn=np.deg2rad([0.5, 0.0, 0.0]))),
    "delay": Lacking("delay", lambda r, _: replace(r, delay=0.005)),
    "counts": Lacking(
        "counts",
        codes=("coarse_positions", "band_limited_by_noise", "position_noise_bias"),
        counts=4096.0,
        rate=1000.0,
    ),
    "load_friction": Lacking("load_friction", lambda r, _: replace(r, load_share=_all(0.05, r))),
    "elastic": Lacking("elastic", _elastic),
    "presliding": Lacking("presliding", lambda r, _: replace(r, bristle=_all(0.01, r))),
    "warming": Lacking("warming", lambda r, _: replace(r, warming=0.2), codes=("friction_drifts",)),
    "crosstalk": Lacking("crosstalk", _mix_sensors),
    "plane_tilt": Lacking("tilt", _turn_in_plane),
    "asymmetry": Lacking(
        "load_friction",
        lambda r, _: replace(r, efficiency=_all((0.08, 0.02), r)),
        source="motor",
    ),
    "backlash": Lacking("backlash", lambda r, _: replace(r, backlash=_all(1e-3, r))),
    "held_rows": Lacking("", log=_hold_rows, codes=("stale_samples",), rate=500.0),
    "uneven": Lacking("", lambda r, _: replace(r, nameless=_uneven), codes=NAMELESS),
    "ripple": Lacking("", lambda r, _: replace(r, nameless=_ripple), codes=NAMELESS),
    "hose": Lacking("", lambda r, _: replace(r, nameless=_hose), codes=NAMELESS),
}


@dataclass(frozen=True)
class Trial:
    """One study of a robot: parameters whose 95 % interval holds the truth, and what was named."""

    names: tuple[str, ...]
    errors: Array
    named: bool
    other_names: tuple[str, ...]

    @property
    def held(self) -> NDArray[np.bool_]:
        """Whether each 95 % interval holds the truth; `errors` are in standard errors."""
        return np.abs(self.errors) < 1.959964


def logged(
    cad: RobotModel, lacking: str, seed: int, engine: Engine = "pinocchio"
) -> tuple[OutsideRobot, Recording]:
    """Return a robot that has something, and its log."""
    rng, what, n = np.random.default_rng(seed), LACKING[lacking], cad.n_joints
    drives = (np.full(n, each) for each in (VISCOUS, COULOMB, OFFSET, 0.0))
    plain = OutsideRobot(other_bodies(cad, rng), *drives, engine=engine)
    motion = random_fourier(cad, rng=rng, duration=DURATION, n_harmonics=HARMONICS)
    robot = what.change(plain, mean_inertia(plain.bodies, motion.sample(2.0).q))
    turns = tuple(joint.is_revolute for joint in cad.joints)
    sensors = Sensors(np.full(n, NOISE), counts=what.counts, turns=turns)
    return robot, what.log(robot.log(motion, sensors, what.rate, rng, torque_source=what.source))


def planar_arm() -> RobotModel:
    """Return an arm of two links in a vertical plane, both axes along y."""
    links = ((0.4, 3.0, 0.2, 0.05), (0.3, 1.5, 0.15, 0.02))
    bodies, joints = [], []
    for k, (_, mass, centre, inertia) in enumerate(links):
        bodies.append(
            f'<link name="link_{k + 1}"><inertial><origin xyz="{centre} 0.02 0.01"/>'
            f'<mass value="{mass}"/><inertia ixx="{0.2 * inertia}" iyy="{inertia}"'
            f' izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        parent, place = ("base", 0.0) if k == 0 else (f"link_{k}", links[k - 1][0])
        joints.append(
            f'<joint name="joint_{k + 1}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{k + 1}"/><origin xyz="{place} 0 0"/><axis xyz="0 1 0"/>'
            '<limit lower="-2.5" upper="2.5" velocity="3" effort="60"/></joint>'
        )
    text = f'<robot name="planar"><link name="base"/>{"".join(bodies + joints)}</robot>'
    with TemporaryDirectory() as folder:
        path = Path(folder, "planar.urdf")
        path.write_text(text)
        return load_robot(str(path))


def trials(
    name: str, lacking: str, repetitions: int, engine: Engine = "pinocchio"
) -> Iterator[Trial]:
    """Yield what studies with default options hold and name."""
    model = planar_arm() if name == PLANAR else load_robot(ROBOTS[name])
    bare = tuple(replace(joint, drive=type(joint.drive)()) for joint in model.joints)
    cad = replace(model, joints=bare)
    for seed in range(repetitions):
        robot, log = logged(cad, lacking, seed, engine)
        yield trial(robot, identify(cad, log), LACKING[lacking])


def trial(robot: OutsideRobot, study: Study, what: Lacking) -> Trial:
    """Hold a study against the truth; parameters of effects, which have none, are left out."""
    base = study.result.base
    n_links = 10 * robot.bodies.n_links
    drives = {
        f"{symbol}{k + 1}": value
        for k in range(robot.bodies.n_joints)
        for symbol, value in zip(
            ("Fv", "Fc", "Fo"), robot.true_parameters()[n_links + 3 * k :][:3], strict=True
        )
    }
    names = base.standard_names
    known = [*robot.bodies.parameters, *(drives.get(name, np.nan) for name in names[n_links:])]
    error = study.result.estimates - base.values(np.nan_to_num(known))
    lacks = {name for name, value in zip(names, known, strict=True) if np.isnan(value)}
    kept = [j for j, name in enumerate(base.names) if name not in lacks]
    effects = {each.effect for each in named_effects(study)}
    codes = {finding.code for finding in study.findings}
    return Trial(
        tuple(base.names[j] for j in kept),
        error[kept] / study.result.std_errors[kept],
        what.effect in effects or bool(codes & {*what.codes}),
        tuple(sorted(effects - {what.effect})),
    )
