"""The 2015 paper, table by table and figure by figure: ours beside what it prints.

The recordings behind its Table 3 and Figures 3 and 4 were never published, so these are repeated on
a virtual installed robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from asbuilt.cli.hayat2015 import Paper, published
from asbuilt.description.catalogue import bundled_robot
from asbuilt.description.formats.dh import DHRow, robot_from_dh
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.concatenated import Concatenated
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.quintic import QuinticMotion
from asbuilt.excitation.motions.random_motion import random_point_to_point
from asbuilt.excitation.motions.spline import SplineMotion
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import SignalChain, prepare_samples
from asbuilt.experiment.virtual.simulation import InstalledRobot, simulate_recording
from asbuilt.identification.bodies.consistency import consistency_margin
from asbuilt.identification.identify import identify
from asbuilt.workflow.study import Study, StudyOptions, run_study

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

ROBOT = "kuka-iiwa7-r800"
RATE = 1000.0
SEED = 2015


@dataclass(frozen=True, slots=True, eq=False)
class ReproducedParameter:
    """One row of Table 2: ours beside the paper's.

    `tolerance` is what the rounding of Tables 1 and 2 allows.
    """

    id: int
    printed: str
    corrected: str
    ours: str
    same_expression: bool
    cad_printed: float
    cad_ours: float
    tolerance: float
    simulated: float
    robot: float

    @property
    def same_value(self) -> bool:
        """Whether our CAD value is the paper's within rounding."""
        return abs(self.cad_ours - self.cad_printed) <= self.tolerance


@dataclass(frozen=True, slots=True, eq=False)
class Reproduction:
    """Hold all that the paper shows, redone.

    `parameters` is Table 2; `ids_equal` counts equal ids; `mismatches_with_printed_alpha` how many
    CAD values Table 1 as printed (alpha_7 = 90 deg) would miss; `cad_margin` and `robot_margin` are
    the best attainable smallest eigenvalues of the links' pseudo-inertias for the two columns;
    `rigid` is the paper's method on the virtual robot (Table 3, Figures 3 and 4), `full` ours on
    the same recordings.
    """

    model: RobotModel
    paper: Paper
    parameters: tuple[ReproducedParameter, ...]
    ids_equal: int
    mismatches_with_printed_alpha: int
    cad_margin: float
    robot_margin: float
    installed: tuple[str, ...]
    n_logged: int
    rigid: Study
    full: Study

    @property
    def n_same_expressions(self) -> int:
        """Number of expressions equal to the paper's as corrected."""
        return sum(row.same_expression for row in self.parameters)

    @property
    def n_same_values(self) -> int:
        """Number of CAD values equal to the paper's within rounding."""
        return sum(row.same_value for row in self.parameters)

    @property
    def largest_difference(self) -> float:
        """Largest difference of a CAD value from the paper's."""
        return max(abs(row.cad_ours - row.cad_printed) for row in self.parameters)


def reproduce(progress: Progress | None = None) -> Reproduction:
    """Redo the paper on the bundled iiwa 7 R800; takes a few seconds."""
    report = progress or (lambda what, fraction: None)
    report("Tables 1 and 2", 0.0)
    model, paper = bundled_robot(ROBOT), published()
    base = find_base_parameters(model)
    simulated = _identified_from_simulation(model)
    parameters = _table_2(model, base, paper, simulated)
    margins = [consistency_margin(base, column) for column in (paper.cad, paper.robot)]
    report("Tables 1 and 2", 1.0)
    robot, installed = installed_robot(model)
    bounds = MotionBounds.assumed(model, 0.9)
    rng = np.random.default_rng(SEED)
    report("motions and recordings", 0.0)
    training = robot.record(_training_motion(model, bounds, rng), RATE, rng=SEED).recording
    test = robot.record(_test_motion(model, rng), RATE, rng=SEED + 1).recording
    report("motions and recordings", 1.0)
    rigid = _study(
        model,
        training,
        test,
        StudyOptions(
            drive=DriveSet(), method="ols", chain=SignalChain.preset("paper2015"), checked=False
        ),
    )
    full = _study(
        model,
        training,
        test,
        StudyOptions(drive=DriveSet.parse("viscous,coulomb,offset"), checked=False),
    )
    return Reproduction(
        model=model,
        paper=paper,
        parameters=parameters,
        ids_equal=sum(
            int(ours) == theirs.id for ours, theirs in zip(base.ids, paper.parameters, strict=True)
        ),
        mismatches_with_printed_alpha=_mismatches_with_printed_alpha(model, base, paper),
        cad_margin=margins[0],
        robot_margin=margins[1],
        installed=installed,
        n_logged=training.n_samples,
        rigid=rigid,
        full=full,
    )


def installed_robot(model: RobotModel) -> tuple[InstalledRobot, tuple[str, ...]]:
    """Return the virtual installed iiwa and, in sentences, what its CAD model does not know of it."""
    typical = InstalledRobot.typical(model, rng=SEED)
    gripper = LinkInertia.from_com(0.9, [0.01, -0.005, 0.05], np.diag([0.0014, 0.0012, 0.0007]))
    robot = (
        InstalledRobot.ideal(model)
        .with_drive(typical.drive, typical.drive_values)
        .with_noise(typical.noise)
        .with_tool(gripper)
    )
    return robot, (
        "a 0.9 kg gripper at the flange",
        f"friction and armature in every joint ({typical.drive})",
        "encoder quantisation, torque sensor noise, bias and resolution",
    )


def _identified_from_simulation(model: RobotModel) -> Array:
    """Return the base parameters found as in section 3.1.

    Quintic motions, noise-free torque, least squares.
    """
    bounds = MotionBounds.assumed(model, 0.8)
    rng = np.random.default_rng(SEED)
    poses = rng.uniform(bounds.lower, bounds.upper, size=(12, model.n_joints))
    motion = QuinticMotion.within(poses, velocity=bounds.velocity, acceleration=bounds.acceleration)
    moved = motion.sample(100.0)
    tau = simulate_recording(model, motion, rate=100.0).tau
    samples = Samples(
        moved.t,
        moved.q,
        moved.qd,
        moved.qdd,
        tau,
        rate=100.0,
        joint_names=model.joint_names,
        source="quintic motion",
    )
    return identify(model, samples, method="ols").estimates


def _table_2(
    model: RobotModel, base: BaseParameters, paper: Paper, simulated: Array
) -> tuple[ReproducedParameter, ...]:
    values = base.values(model.parameters)
    rounding = _table_1_rounding(model, base)
    rows = []
    for k, row in enumerate(paper.parameters):
        same = bool(
            np.allclose(
                row.coefficients(base.standard_names), base.regrouping[k], rtol=0, atol=1e-12
            )
        )
        tolerance = float(rounding[k]) + _half_digit(row.cad)
        rows.append(
            ReproducedParameter(
                row.id, row.printed or row.expression, row.expression, base.symbolic[k], same, row.cad, float(values[k]), tolerance,
                float(simulated[k]), row.robot,
            )
        )  # fmt: skip
    return tuple(rows)


def _half_digit(value: float) -> float:
    """Return half of the last decimal with which a number was typed."""
    exponent = Decimal(repr(value)).as_tuple().exponent
    assert isinstance(exponent, int)
    return 0.5 * 10.0**exponent


def _table_1_rounding(model: RobotModel, base: BaseParameters) -> Array:
    """Return how far half a unit in the last printed digit of every entry of Table 1 can move each
    base parameter, shape (n_base,).
    """
    total = np.zeros(base.n_base)
    parameters = np.array(model.parameters)
    for i, link in enumerate(model.links):
        com, inertia, mass = (
            np.array(link.inertia.com),
            np.array(link.inertia.inertia_about_com),
            link.inertia.mass,
        )

        def effect(changed: LinkInertia, i: int = i) -> Array:
            moved = parameters.copy()
            moved[10 * i : 10 * i + 10] = changed.parameters
            return np.abs(base.regrouping @ (moved - parameters))

        step = _half_digit(round(mass, 10))
        total += effect(LinkInertia.from_com(mass + step, com, inertia))
        for axis in range(3):
            shifted = com.copy()
            shifted[axis] += _half_digit(round(float(com[axis]), 10))
            total += effect(LinkInertia.from_com(mass, shifted, inertia))
            for other in range(axis, 3):
                changed = inertia.copy()
                changed[axis, other] += _half_digit(round(float(inertia[axis, other]), 13))
                changed[other, axis] = changed[axis, other]
                total += effect(LinkInertia.from_com(mass, com, changed))
    return total


def _mismatches_with_printed_alpha(model: RobotModel, base: BaseParameters, paper: Paper) -> int:
    """Count the CAD values of Table 2 that link 7 with alpha_7 as printed in Table 1 would not
    give.
    """
    offsets = [model.lengths.get(f"b{i + 1}", 0.0) for i in range(model.n_joints)]
    twists = [90.0, -90.0, -90.0, 90.0, 90.0, -90.0, paper.alpha_7_printed]
    rows = [
        DHRow(b=b, alpha=np.deg2rad(alpha), inertia=link.inertia)
        for b, alpha, link in zip(offsets, twists, model.links, strict=True)
    ]
    printed = robot_from_dh(rows, name="as printed")
    other = find_base_parameters(printed)
    if other.n_base != base.n_base:
        return base.n_base
    difference = np.abs(other.values(printed.parameters) - paper.cad)
    same_id = other.ids == base.ids
    return int(np.sum(~same_id | (difference > 1e-4)))


def _training_motion(model: RobotModel, bounds: MotionBounds, rng: np.random.Generator) -> Motion:
    """Return spline and point-to-point motion of about the paper's 53 s, as in its section 3.2.1."""
    points = rng.uniform(bounds.lower, bounds.upper, size=(14, model.n_joints))
    spline = SplineMotion.within(points, velocity=bounds.velocity, acceleration=bounds.acceleration)
    poses = rng.uniform(bounds.lower, bounds.upper, size=(12, model.n_joints))
    poses[0] = spline.end
    point_to_point = QuinticMotion.within(
        poses, velocity=bounds.velocity, acceleration=bounds.acceleration
    )
    return Concatenated([spline, point_to_point])


def _test_motion(model: RobotModel, rng: np.random.Generator) -> Motion:
    """Return another point-to-point motion, to judge by."""
    return random_point_to_point(model, rng, n_poses=8)


def _study(model: RobotModel, training: Recording, test: Recording, options: StudyOptions) -> Study:
    return run_study(
        model,
        [prepare_samples(training, options.chain)],
        validation=[prepare_samples(test, options.chain)],
        options=options,
    )
