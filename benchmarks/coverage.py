"""Whether 95 % intervals cover the truth in 95 % of cases.

200 virtual recordings of each robot, torque noise of several colours; of real bodies 100, some near
what is possible. Then 20 of each of three robots whose torque Pinocchio or MuJoCo computes, where
the model is right and where it lacks something (`lacking.py`). There either it is named, or
intervals hold 93 %. Gains of drives and delays of the torque have truth by the same engines
(`calibrations.py`), and so have robots that stand, trot, jump and fall on legs (`legs.py`), from
torques and from commands.

    python benchmarks/coverage.py [PART...] [--workers N | --scheduler tcp://...]
    python benchmarks/coverage.py lacking --only ur10e,elastic --engine mujoco --repetitions 4
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.executor import open_workers
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.bodies.cad_prior import CadPrior, build_cad_prior, design_values
from asbuilt.identification.estimators.consistent_fit import fit_consistent, fit_toward_cad
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate,
)
from asbuilt.identification.uncertainty.uncertainty import (
    estimate_block_uncertainty,
    estimate_bootstrap_uncertainty,
    redraw,
)
from calibrations import Setting, delay_errors, gain_errors
from lacking import LACKING, ROBOTS, trials
from legs import Walk, parameter_errors
from outside_robot import Engine

Array = NDArray[np.float64]

REPETITIONS = 200
REPETITIONS_OF_BODIES = 100
RATE = 200.0
NOISE = 0.3
NORMAL_95 = 1.959964
DRAWS = 200
DRAWS_OF_BODIES = 100
DRIVE = DriveSet.parse("viscous,coulomb,offset")
STUDIES = (
    ("kuka-iiwa7-r800", 0.2, 20.0),
    ("kuka-iiwa7-r800", 1.0, 60.0),
    ("franka-panda", 0.1, 30.0),
    ("franka-panda", 0.5, 60.0),
    ("ur10e", 0.05, 20.0),
    ("scara", 0.3, 30.0),
    ("puma-560", 0.3, 40.0),
)
"""Robot, correlation time of the torque noise [s], length of the recording [s]."""
STUDIES_OF_BODIES = (
    ("kuka-iiwa7-r800", 0.3, 30.0, 0.3, 1.0),
    ("kuka-iiwa7-r800", 0.3, 30.0, 0.3, 0.004),
    ("kuka-iiwa7-r800", 0.3, 30.0, 2.0, 0.004),
    ("kuka-iiwa7-r800", 0.3, 60.0, 0.3, 0.004),
    ("franka-panda", 0.5, 60.0, 0.3, 0.004),
    ("ur10e", 0.05, 30.0, 0.3, 0.004),
)
"""The same, then the noise [N m] and the smallest eigenvalue of `P0^-1 P` of every other link.

The fit allows no less than 0.001.
"""
STUDIES_OF_PULLS = (
    ("kuka-iiwa7-r800", 0.3, 30.0, 0.3, 0.004),
    ("kuka-iiwa7-r800", 0.3, 30.0, 2.0, 1.0),
)
"""The same for the fit with an entropic prior around CAD."""
SPREAD = 0.25
"""Spread of the logarithm of the other eigenvalues: how far CAD is off."""
SMALL_FRICTION = 0.03
REPETITIONS_WHERE_LACKING = 20
CALIBRATIONS = {"gain": gain_errors, "delay": delay_errors}
REPETITIONS_OF_CALIBRATIONS = 40
STUDIES_OF_CALIBRATIONS = (
    ("gain", Setting("ur10e", 20.0)),
    ("gain", Setting("kuka-iiwa7-r800", 30.0, noise=0.3, correlation_time=0.5)),
    ("gain", Setting("franka-panda", 60.0, rate=1000.0, counts=2.0**14)),
    ("delay", Setting("two-link", 20.0)),
    ("delay", Setting("ur10e", 10.0, rate=125.0)),
    ("delay", Setting("ur10e", 40.0, rate=500.0, counts=2.0**13)),
    ("delay", Setting("ur10e", 10.0, noise=0.3, correlation_time=0.5)),
    ("delay", Setting("kuka-iiwa7-r800", 20.0, noise=0.3, correlation_time=0.5)),
)
REPETITIONS_OF_WALKS = 4
STUDIES_OF_WALKS = (
    *(
        Walk(robot, (motion,))
        for robot in ("solo12", "go2")
        for motion in ("squat", "step", "hop", "flight")
    ),
    Walk("g1", ("squat",)),
    Walk("g1", ("flight",)),
    Walk("go2", ("squat", "step")),
    Walk("go2", ("step",), forces=True),
    Walk("go2", ("step",), method="auto"),
    Walk("go2", ("flight",), method="auto"),
    *(
        Walk(robot, (motion,), method="auto", command=True)
        for robot in ("go2", "solo12")
        for motion in ("squat", "step", "hop", "flight")
    ),
    Walk("g1", ("squat",), method="auto", command=True),
    Walk("g1", ("flight",), method="auto", command=True),
)
PARTS = ("noise", "bodies", "lacking", "calibrations", "legs")


def recordings(
    machine: VirtualRobot,
    model: RobotModel,
    correlation_time: float,
    duration: float,
    noise: float,
    repetitions: int,
) -> Iterator[SquareRootInformation]:
    """Yield the information of one motion recorded again and again, first-order noise of that
    correlation time [s] on the torque.
    """
    base = find_base_parameters(model, DRIVE)
    recording = machine.record(
        random_fourier(model, rng=11, duration=duration, n_harmonics=10), rate=RATE
    ).recording
    recording = replace(recording, qd=None, qdd=None)
    chain, rng = resolve_chain(SignalChain(), recording), np.random.default_rng(0)
    forget, warm_up = np.exp(-1.0 / (RATE * correlation_time)), int(20 * RATE * correlation_time)
    for _ in range(repetitions):
        white = rng.normal(size=(recording.n_samples + warm_up, model.n_joints))
        coloured = lfilter([np.sqrt(1.0 - forget**2)], [1.0, -forget], white, axis=0)[warm_up:]
        yield accumulate(
            model,
            base,
            prepare_samples(replace(recording, tau=recording.tau + noise * coloured), chain),
        )


def shares(
    seen: Iterator[SquareRootInformation],
    truth: Array,
    fit: Callable[[SquareRootInformation], Estimate],
    draws: int,
) -> dict[str, float]:
    """Return the share of 95 % intervals that contain the truth, over all parameters and of the
    worst, for every kind of error.
    """
    held: dict[str, list[Array]] = {"": [], "_bootstrap": [], "_textbook": []}
    for repetition, information in enumerate(seen):
        estimate = fit(information)
        error = np.abs(estimate.beta - truth)
        drawn = redraw(information, estimate, n_draws=draws, rng=repetition)
        held[""].append(
            error < NORMAL_95 * estimate_block_uncertainty(information, estimate).std_errors
        )
        held["_bootstrap"].append(
            error
            < NORMAL_95 * estimate_bootstrap_uncertainty(information, estimate, drawn).std_errors
        )
        held["_textbook"].append(error < NORMAL_95 * estimate.std_errors)
    found = {}
    for kind, each in held.items():
        per_parameter = np.mean(each, axis=0)
        found[kind], found[f"{kind}_worst_parameter"] = (
            float(per_parameter.mean()),
            float(per_parameter.min()),
        )
    return found


def coverage(
    robot: str, correlation_time: float, duration: float, repetitions: int = REPETITIONS
) -> dict[str, float]:
    """Return the shares of weighted least squares."""
    model = load_robot(robot)
    base = find_base_parameters(model, DRIVE)
    machine = VirtualRobot.ideal(model).with_drive(DRIVE, np.tile([1.0, 2.0, 0.3], model.n_joints))
    design = design_values(model, base)
    return shares(
        recordings(machine, model, correlation_time, duration, NOISE, repetitions),
        base.values(machine.truth),
        lambda seen: fit_least_squares(seen, weights="joint", prior=design),
        DRAWS,
    )


def coverage_of_bodies(
    robot: str,
    correlation_time: float,
    duration: float,
    noise: float,
    edge: float,
    repetitions: int = REPETITIONS_OF_BODIES,
    *,
    pulled: bool = False,
) -> dict[str, float]:
    """Return the shares of the physically consistent fit, `pulled` to CAD or not, of a robot with
    other bodies than CAD's, every other one near what is possible.
    """
    model = load_robot(robot)
    base, prior = find_base_parameters(model, DRIVE), build_cad_prior(model, DRIVE)
    machine = off_from_cad(model, base, prior, edge)
    return shares(
        recordings(machine, model, correlation_time, duration, noise, repetitions),
        base.values(machine.truth),
        lambda seen: fit_toward_cad(seen, prior) if pulled else fit_consistent(seen, prior),
        DRAWS_OF_BODIES,
    )


def off_from_cad(
    model: RobotModel, base: BaseParameters, prior: CadPrior, edge: float
) -> VirtualRobot:
    """Return a robot of other real bodies.

    Where `edge` is small that is the smallest eigenvalue of every other, and one joint has next to
    no viscous friction.
    """
    rng = np.random.default_rng(5)
    bodies = []
    for i, pseudo_inertia in enumerate(prior.pseudo_inertias):
        root = np.linalg.cholesky(pseudo_inertia)
        axes, _ = np.linalg.qr(rng.normal(size=(4, 4)))
        size = np.exp(SPREAD * rng.normal(size=4))
        if edge < 0.1 and i % 2 == 1:
            size[int(np.argmin(size))] = edge
        bodies.append(
            LinkInertia.from_pseudo_inertia(root @ (axes * size) @ axes.T @ root.T).parameters
        )
    friction = np.tile([1.0, 2.0, 0.3], (model.n_joints, 1))
    if edge < 0.1:
        friction[-2, 0] = SMALL_FRICTION
    return VirtualRobot.ideal(model.with_parameters(np.concatenate(bodies))).with_drive(
        base.drive, friction.ravel()
    )


def coverage_where_lacking(
    robot: str, lacking: str, repetitions: int, engine: Engine
) -> dict[str, float]:
    """Return the shares where the model lacks something, and of recordings that name it.

    Also the shares of recordings that do not, and how many name something else.
    """
    every = list(trials(robot, lacking, repetitions, engine))
    held: dict[str, list[bool]] = {}
    for each in every:
        for name, inside in zip(each.names, each.held.tolist(), strict=True):
            held.setdefault(name, []).append(inside)
    per_parameter = [float(np.mean(each)) for each in held.values()]
    silent = [inside for each in every if not each.named for inside in each.held.tolist()]
    others = Counter(name for each in every for name in each.other_names)
    print(
        f"{robot} with {lacking}: {np.mean(per_parameter):.3f} ({min(per_parameter):.2f}), named in"
        f" {sum(each.named for each in every)} of {len(every)},"
        f" {np.mean(silent) if silent else np.nan:.3f} where not; also named {dict(others)}",
        flush=True,
    )
    return {
        "": float(np.mean(per_parameter)),
        "_worst_parameter": min(per_parameter),
        "_named": float(np.mean([each.named for each in every])),
        "_where_not_named": float(np.mean(silent)) if silent else np.nan,
        "_other_names": float(np.mean([bool(each.other_names) for each in every])),
    }


def coverage_of_calibrations(
    what: str, setting: Setting, repetitions: int, engine: Engine
) -> dict[str, float]:
    """Return the share of 95 % intervals that hold the truth, and the RMS error in them."""
    return shares_of_errors(CALIBRATIONS[what](setting, repetitions, engine))


def shares_of_errors(pairs: Iterable[tuple[Array, Array]]) -> dict[str, float]:
    """Return the same of errors and their standard errors."""
    z = np.concatenate([error / std_error for error, std_error in pairs])
    known = z[np.isfinite(z)]
    return {
        "": float(np.mean(np.abs(known) < NORMAL_95)),
        "_rms_of_standard_errors": float(np.sqrt(np.mean(known**2))),
        "_determined": known.size / z.size,
    }


def measure(
    repetitions: int | None = None,
    parts: Sequence[str] = PARTS,
    workers: int | None = 0,
    scheduler: str | None = None,
    only: Sequence[str] = (),
    engine: Engine = "pinocchio",
) -> dict[str, float | str]:
    """Return shares; each study is a task, whose numbers do not depend on who does it."""
    studies: dict[str, list[tuple[Any, ...]]] = {
        "noise": list(STUDIES),
        "bodies": [(False, *each) for each in STUDIES_OF_BODIES]
        + [(True, *each) for each in STUDIES_OF_PULLS],
        "lacking": [
            (robot, what, engine)
            for robot in chosen(ROBOTS, only)
            for what in chosen(LACKING, only)
        ],
        "calibrations": [(*each, engine) for each in STUDIES_OF_CALIBRATIONS],
        "legs": [(each,) for each in STUDIES_OF_WALKS],
    }
    tasks = [(part, study) for part in PARTS if part in parts for study in studies[part]]
    found: dict[int, dict[str, float]] = {}
    with open_workers(workers, scheduler) as pool:
        for done in pool.run(_measured, [(k, repetitions, *task) for k, task in enumerate(tasks)]):
            if done.result is None:
                raise RuntimeError(f"{done.task}: {done.problem}")
            found[done.task[0]] = done.result
            for name, value in done.result.items():
                print(f"{name:<72} {value:.3f}", flush=True)
    return {name: value for k in sorted(found) for name, value in found[k].items()}


def chosen(names: Iterable[str], only: Sequence[str]) -> list[str]:
    """Return the names that are among `only`, or all if none is."""
    return [name for name in names if name in only] or list(names)


def _measured(task: tuple[int, int | None, str, tuple[Any, ...]]) -> dict[str, float]:
    """Return the shares of one study."""
    _, repetitions, part, study = task
    if part == "noise":
        robot, correlation_time, duration = study
        name = f"{robot}_{correlation_time:g}s_noise_{duration:g}s"
        shares = coverage(robot, correlation_time, duration, repetitions or REPETITIONS)
    elif part == "bodies":
        pulled, robot, correlation_time, duration, noise, edge = study
        name = (
            f"{'entropic' if pulled else 'bodies'}_{robot}_{correlation_time:g}s"
            f"_noise_of_{noise:g}_{duration:g}s_edge_{edge:g}"
        )
        shares = coverage_of_bodies(
            robot,
            correlation_time,
            duration,
            noise,
            edge,
            repetitions or REPETITIONS_OF_BODIES,
            pulled=pulled,
        )
    elif part == "calibrations":
        what, setting, engine = study
        name = f"{what}_{setting.name}"
        shares = coverage_of_calibrations(
            what, setting, repetitions or REPETITIONS_OF_CALIBRATIONS, engine
        )
    elif part == "legs":
        (walk,) = study
        name = walk.name
        shares = shares_of_errors(parameter_errors(walk, repetitions or REPETITIONS_OF_WALKS))
    else:
        robot, lacking, engine = study
        name = f"{robot}_with_{lacking}"
        shares = coverage_where_lacking(
            robot, lacking, repetitions or REPETITIONS_WHERE_LACKING, engine
        )
    return {f"{name}{kind}": value for kind, value in shares.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, help="recordings of each study")
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--scheduler")
    parser.add_argument("--only", default="", help="of lacking: robots, and what they have")
    parser.add_argument("--engine", choices=("pinocchio", "mujoco"), default="pinocchio")
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)} (default: all)")
    given = parser.parse_args()
    measure(
        given.repetitions,
        given.parts or PARTS,
        given.workers,
        given.scheduler,
        given.only.split(","),
        given.engine,
    )
