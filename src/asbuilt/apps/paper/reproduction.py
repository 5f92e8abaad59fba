"""The 2015 paper, table by table and figure by figure: our values and the printed ones."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from decimal import Decimal
from importlib.resources import files

import numpy as np

from asbuilt import (
    BaseParameters,
    DriveSet,
    IdentificationResult,
    LinkInertia,
    Recording,
    RobotModel,
    Samples,
    SignalChain,
    find_base_parameters,
    identify_samples,
    observation_matrix,
    prepare,
    simulate_recording,
)
from asbuilt.apps.paper.virtual_robot import make_simulation_motion, record_virtual_robot
from asbuilt.arrays import Array
from asbuilt.description import DHRow, bundled_robot, robot_from_dh
from asbuilt.excitation import Motion
from asbuilt.identification import consistency_margin
from asbuilt.validation import Validation, validate_samples
from asbuilt.workflow import Progress

_TERM = re.compile(r"([+-]?)\s*(?:([0-9.]+)\*)?(?:I(\d)([xyz]{2})|m(\d)\*d\5([xyz])|m(\d))(?=\s|$)")


@dataclass(frozen=True, slots=True)
class PublishedParameter:
    """Hold one row of Table 2.

    Parameters
    ----------
    id
        Id among the 70 standard parameters.
    expression
        Expression as corrected.
    cad, robot
        The two columns of values [SI].
    printed
        Expression as printed if that is a misprint.
    """

    id: int
    expression: str
    cad: float
    robot: float
    printed: str | None = None

    def coefficients(self, standard_names: Sequence[str]) -> Array:
        """Return the coefficients of the standard parameters, shape (n_standard,)."""
        row = np.zeros(len(standard_names))
        for sign, factor, *parts in _TERM.findall(self.expression):
            inertia_link, axes, moment_link, axis, mass_link = parts
            # A term has one of the three: I1yy, m1*d1x or m1, which are Iyy1, mx1 and m1 here.
            name = f"I{axes}{inertia_link}" if inertia_link else f"m{axis}{moment_link}{mass_link}"
            row[standard_names.index(name)] = float(f"{sign}{factor or 1.0}")
        unread = _TERM.sub("", self.expression).strip()
        if unread:
            raise ValueError(
                f"row {self.id} of Table 2: cannot read {unread!r} in {self.expression!r}"
            )
        return row


@dataclass(frozen=True, slots=True)
class Paper:
    """Hold what the paper prints: Tables 2 and 3, the number of samples, alpha_7 of Table 1 [deg].

    The paper highlights rows of Table 2 "having significantly larger values compared to the rest"
    in gray; its text does not list them. `highlighted` are the rows whose CAD value exceeds 1 [SI].
    """

    parameters: tuple[PublishedParameter, ...]
    table3_joints: tuple[int, ...]
    table3_cad: tuple[float, ...]
    table3_robot: tuple[float, ...]
    samples: int
    alpha_7_printed: float

    @property
    def cad(self) -> Array:
        """CAD column of Table 2, shape (43,)."""
        return np.array([row.cad for row in self.parameters])

    @property
    def robot(self) -> Array:
        """Robot column of Table 2, shape (43,)."""
        return np.array([row.robot for row in self.parameters])

    @property
    def highlighted(self) -> tuple[int, ...]:
        """Places of the gray rows of Table 2, counted from 0."""
        return tuple(np.flatnonzero(self.cad > 1.0).tolist())


def read_paper() -> Paper:
    """Return the paper's facts.

    >>> paper = read_paper()
    >>> len(paper.parameters), paper.parameters[0].expression
    (43, 'I1yy + I2zz')
    """
    facts = tomllib.loads(
        files("asbuilt.apps.paper").joinpath("facts.toml").read_text(encoding="utf-8")
    )
    return Paper(
        parameters=tuple(PublishedParameter(**row) for row in facts["table2"]),
        table3_joints=tuple(facts["table3"]["joints"]),
        table3_cad=tuple(facts["table3"]["cad"]),
        table3_robot=tuple(facts["table3"]["robot"]),
        samples=facts["paper"]["samples"],
        alpha_7_printed=facts["paper"]["alpha_7_printed_deg"],
    )


ROBOT = "kuka-iiwa7-r800"
SIMULATION_RATE = 100.0
"""Rate of noise-free simulated torque [Hz]."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ReproducedParameter(PublishedParameter):
    """Hold one row of Table 2, with our values [SI].

    Parameters
    ----------
    ours, same_expression
        Expression as found, and whether it equals the paper's as corrected.
    cad_ours
        CAD value as found.
    tolerance
        Largest difference that the rounding of Tables 1 and 2 allows.
    simulated
        Estimate from simulated noise-free torque (section 3.1).
    virtual_robot
        Estimate from the recording of the virtual robot.
    """

    ours: str
    same_expression: bool
    cad_ours: float
    tolerance: float
    simulated: float
    virtual_robot: float

    @property
    def difference(self) -> float:
        """Difference of our CAD value from the paper's."""
        return abs(self.cad_ours - self.cad)

    @property
    def same_value(self) -> bool:
        """Whether our CAD value is the paper's within rounding."""
        return self.difference <= self.tolerance


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTorque:
    """Hold the validation with simulated torque of section 4, torques (N, n) [N m] at `t` (N,) [s].

    `simulated` is inverse dynamics of the CAD model along the test motion; `from_cad` and
    `from_identified` are predicted from the CAD column of Table 2 and from the base parameters
    identified in simulation.
    """

    t: Array
    simulated: Array
    from_cad: Array
    from_identified: Array

    def rms(self, predicted: Array) -> Array:
        """Return the RMS error of a prediction, shape (n,) [N m]."""
        return np.asarray(np.sqrt(np.mean((self.simulated - predicted) ** 2, axis=0)))


@dataclass(frozen=True, slots=True, eq=False)
class Reproduction:
    """Hold all that the paper shows, reproduced.

    Parameters
    ----------
    parameters
        Table 2.
    ids_equal
        Number of ids equal to the paper's.
    mismatches_with_printed_alpha
        Number of CAD values that Table 1 as printed (alpha_7 = 90 deg) would not give.
    cad_margin, robot_margin
        Best attainable smallest eigenvalue of the pseudo-inertias for the two columns of Table 2.
    simulated_torque
        Validation with simulated torque.
    n_logged
        Number of samples of its recording.
    rigid, rigid_validation
        The method of the paper on the virtual robot (Table 3, Figures 3 and 4).
    full, full_validation
        The default method, with friction, on the same recordings.
    """

    model: RobotModel
    paper: Paper
    parameters: tuple[ReproducedParameter, ...]
    ids_equal: int
    mismatches_with_printed_alpha: int
    cad_margin: float
    robot_margin: float
    simulated_torque: SimulatedTorque
    n_logged: int
    rigid: IdentificationResult
    rigid_validation: Validation
    full: IdentificationResult
    full_validation: Validation

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
        return max(row.difference for row in self.parameters)


def reproduce_paper(progress: Progress | None = None) -> Reproduction:
    """Reproduce Hayat, Abhishek and Saha (2015) on the bundled iiwa 7 R800; takes seconds.

    Parameters
    ----------
    progress
        Called with the name of each step and the fraction done.
    """
    report = progress or (lambda what, fraction: None)
    report("reproduce Tables 1 and 2", 0.0)
    model = bundled_robot(ROBOT)
    paper = read_paper()
    base = find_base_parameters(model)
    simulated = _identify_from_simulation(model)
    cad_margin, robot_margin = (
        consistency_margin(base, column) for column in (paper.cad, paper.robot)
    )
    report("record the virtual robot", 0.0)
    training, test, test_motion = record_virtual_robot(model)
    report("identify the virtual robot", 0.0)
    rigid, rigid_validation = _identify_and_validate(
        model, training, test, SignalChain.preset("paper2015"), "ols", DriveSet()
    )
    full, full_validation = _identify_and_validate(
        model, training, test, None, "wls", DriveSet.parse("viscous,coulomb,offset")
    )
    report("identify the virtual robot", 1.0)
    same_ids = zip(base.ids, paper.parameters, strict=True)
    return Reproduction(
        model=model,
        paper=paper,
        parameters=_reproduce_table_2(model, base, paper, simulated, rigid.estimates),
        ids_equal=sum(int(ours) == theirs.id for ours, theirs in same_ids),
        mismatches_with_printed_alpha=_count_printed_alpha_mismatches(model, base, paper),
        cad_margin=cad_margin,
        robot_margin=robot_margin,
        simulated_torque=_simulate_torque(model, base, test_motion, paper.cad, simulated),
        n_logged=training.n_samples,
        rigid=rigid,
        rigid_validation=rigid_validation,
        full=full,
        full_validation=full_validation,
    )


def _identify_and_validate(
    model: RobotModel,
    training: Recording,
    test: Recording,
    chain: SignalChain | None,
    method: str,
    drive: DriveSet,
) -> tuple[IdentificationResult, Validation]:
    prepared = prepare(model, [training], validation=[test], chain=chain, checked=False)
    result = identify_samples(
        model, prepared.training, base=find_base_parameters(model, drive), method=method
    )
    return result, validate_samples(result, prepared.validation[0])


def _identify_from_simulation(model: RobotModel) -> Array:
    """Identify the base parameters from noise-free quintic motion, as in section 3.1."""
    motion = make_simulation_motion(model)
    moved = motion.sample(SIMULATION_RATE)
    samples = Samples(
        moved.t,
        moved.q,
        moved.qd,
        moved.qdd,
        simulate_recording(model, motion, rate=SIMULATION_RATE).tau,
        rate=SIMULATION_RATE,
        joint_names=model.joint_names,
        source="quintic motion",
    )
    return identify_samples(model, samples, method="ols").estimates


def _simulate_torque(
    model: RobotModel, base: BaseParameters, motion: Motion, cad: Array, identified: Array
) -> SimulatedTorque:
    moved = motion.sample(SIMULATION_RATE)
    W = observation_matrix(model, moved.q, moved.qd, moved.qdd)[:, base.columns]
    return SimulatedTorque(
        t=moved.t,
        simulated=simulate_recording(model, motion, rate=SIMULATION_RATE).tau,
        from_cad=(W @ cad).reshape(-1, model.n_joints),
        from_identified=(W @ identified).reshape(-1, model.n_joints),
    )


def _reproduce_table_2(
    model: RobotModel, base: BaseParameters, paper: Paper, simulated: Array, virtual_robot: Array
) -> tuple[ReproducedParameter, ...]:
    values = base.values(model.parameters)
    rounding = _bound_table_1_rounding(model, base)
    return tuple(
        ReproducedParameter(
            **asdict(row),
            ours=base.symbolic[k],
            same_expression=np.allclose(
                row.coefficients(base.standard_names), base.regrouping[k], rtol=0, atol=1e-12
            ),
            cad_ours=float(values[k]),
            tolerance=float(rounding[k]) + _halve_last_digit(row.cad),
            simulated=float(simulated[k]),
            virtual_robot=float(virtual_robot[k]),
        )
        for k, row in enumerate(paper.parameters)
    )


def _halve_last_digit(value: float) -> float:
    """Return half of the last decimal with which a number was typed."""
    exponent = Decimal(repr(value)).as_tuple().exponent
    assert isinstance(exponent, int)
    return 0.5 * 10.0**exponent


def _bound_table_1_rounding(model: RobotModel, base: BaseParameters) -> Array:
    """Return how far the rounding of Table 1 can move each base parameter, shape (n_base,)."""
    total = np.zeros(base.n_base)
    parameters = np.array(model.parameters)
    for i, link in enumerate(model.links):
        mass = link.inertia.mass
        com = np.array(link.inertia.com)
        inertia = np.array(link.inertia.inertia_about_com)

        def effect(changed: LinkInertia, i: int = i) -> Array:
            moved = parameters.copy()
            moved[10 * i : 10 * i + 10] = changed.parameters
            return np.abs(base.regrouping @ (moved - parameters))

        step = _halve_last_digit(round(mass, 10))
        total += effect(LinkInertia.from_com(mass + step, com, inertia))
        for axis in range(3):
            shifted = com.copy()
            shifted[axis] += _halve_last_digit(round(float(com[axis]), 10))
            total += effect(LinkInertia.from_com(mass, shifted, inertia))
            for other in range(axis, 3):
                changed = inertia.copy()
                changed[axis, other] += _halve_last_digit(round(float(inertia[axis, other]), 13))
                changed[other, axis] = changed[axis, other]
                total += effect(LinkInertia.from_com(mass, com, changed))
    return total


def _count_printed_alpha_mismatches(model: RobotModel, base: BaseParameters, paper: Paper) -> int:
    """Count the CAD values of Table 2 that alpha_7 as printed in Table 1 would not give."""
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
    return int(np.sum(~(other.ids == base.ids) | (difference > 1e-4)))
