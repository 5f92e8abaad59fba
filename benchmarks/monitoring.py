"""False alarms promised and found, and the smallest contact seen within 20 ms.

Virtual robots: identified from one motion, thresholds from some others, then hours of further
random motions between poses, watched without contact. With `--contacts`, how often the interval of
a force covers it.

    python benchmarks/monitoring.py --virtual 24 --calibrations 3     # hours per virtual robot
    python benchmarks/monitoring.py --contacts
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from asbuilt.apps.watch.causal_filter import largest_velocity_error
from asbuilt.apps.watch.events import find_events, find_smallest_forces, frame_jacobian
from asbuilt.apps.watch.observed import ModelError, Observed
from asbuilt.apps.watch.observer import Observer
from asbuilt.apps.watch.thresholds import Thresholds, bound_residual, set_thresholds
from asbuilt.apps.watch.watched_log import ELSEWHERE
from asbuilt.description.load import bundled_robot
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.excitation.motions.fourier import random_fourier, random_point_to_point
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.calibration.payload import choose_payload_frame
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.workflow.study import identify
from asbuilt.workflow.study_options import StudyOptions
from monitoring_real import interval

RATE = 100.0
CHUNK = 600.0
"""Seconds of a virtual motion that are held at once."""
PROMISED = 1.0
ROBOTS = ("kuka-iiwa7-r800", "ur10e", "franka-panda", "puma-560", "scara")
"""The form of the thresholds was settled on the iiwa and the Panda, that of its tail on the Panda
and on exponential maxima; the others are held out."""
CONTACTS = 180


class Site:
    """An observer with its thresholds, for one or more rates of false alarms."""

    def __init__(
        self,
        robot: Any,
        logs: Sequence[Recording],
        rates: Sequence[float] = (PROMISED,),
        observer: Observer | None = None,
    ) -> None:
        moved = [(log.t, log.q, log.qd) for log in logs]
        self.observer = observer or Observer(robot, velocity_error=largest_velocity_error(moved))
        self.error, seen = self.observer.model_error, [self.observed(log) for log in logs]
        self.thresholds: dict[float, Thresholds] = {
            rate: set_thresholds(
                seen,
                self.error,
                self.observer.model.joint_names,
                bandwidth=self.observer.bandwidth,
                velocity_error=self.observer.velocity_error,
                false_alarms_per_hour=rate,
            )
            for rate in rates
        }

    def observed(self, log: Recording) -> Observed:
        return self.observer.observe(log.t, log.q, log.tau, log.qd)

    def alarms(self, seen: Observed) -> list[int]:
        """Return the number of events of a log, for each rate."""
        return [self._events(seen, limits) for limits in self.thresholds.values()]

    def _events(self, seen: Observed, limits: Thresholds) -> int:
        """Count events; the model's error, which is most of the work, only where it matters."""
        least = limits.of_log(seen, ModelError.of(self.observer.model))[1]
        near = (np.abs(seen.residual) > least).any(axis=1)
        known = bound_residual(seen)[near]
        model = self.error.std(seen.q[near], seen.qd[near], seen.qdd[near])
        added = limits.level * limits.model_part * model
        limit = known + np.hypot(least[near] - known, added)
        beyond = seen.t[near][(np.abs(seen.residual[near]) > limit).any(axis=1)]
        return int(np.sum(np.diff(beyond, prepend=-np.inf) > limits.block_seconds))

    def smallest_force(self, log: Recording, rate: float = PROMISED) -> float:
        """Return the median of the smallest forces [N] at the tool that alarm within 20 ms."""
        seen = self.observed(log)
        limit = self.thresholds[rate].of_log(seen, self.error)[1]
        tool = choose_payload_frame(self.observer.model)[1:]
        return float(
            np.median(find_smallest_forces(self.observer, seen, limit, tool, filtered=False))
        )


def virtual(
    hours: float,
    promised: Sequence[float],
    minutes: float,
    names: Sequence[str],
    calibrations: int,
) -> None:
    """Print false alarms of virtual robots with friction that the model does not have.

    The band is where 95 % of counts lie if the promise is kept: a Poisson count whose own rate is
    uncertain as the number of such alarms in the time that the thresholds were set on. The mean is
    over thresholds from several calibrations, all on the same hours, with the observer of the
    first; its error is that of the calibrations and of the count.
    """
    print(f"virtual robots, {hours:g} h each, {RATE:g} Hz; thresholds from {minutes:g} min")
    print(
        "robot             promised   found  95 % band   rate/h (95 %)      mean of calibrations"
        "   within 20 ms: as built     CAD"
    )
    for name in names:
        robot, result, quiet = _watched_robot(name, minutes)
        site, cad = (Site(model, quiet, promised) for model in (result, result.model))
        sites = [site] + [
            Site(result, _quiet(robot, minutes, k), promised, site.observer)
            for k in range(1, calibrations)
        ]
        calibrated = sum(float(log.t[-1]) for log in quiet) / 3600.0
        found, watched, seed = np.zeros((calibrations, len(promised))), 0.0, 10_000
        while watched < hours:
            log, seed = _moves(robot, seed, CHUNK), seed + 1
            seen = site.observed(log)
            found += np.array([each.alarms(seen) for each in sites])
            watched += float(log.t[-1]) / 3600.0
        log = _moves(robot, 999, 120.0)
        for rate, counts in zip(promised, found.T, strict=True):
            low, high = band(rate, watched, calibrated)
            forces = [each.smallest_force(log, rate) for each in (site, cad)]
            least, most = interval(int(counts[0]), watched)
            error = np.sqrt(np.var(counts) / max(calibrations - 1, 1) + np.mean(counts)) / watched
            print(
                f"{name:18s} {rate:6g}/h {counts[0]:7.0f} {low:5.0f} -{high:4.0f}"
                f" {counts[0] / watched:8.2f} ({least:.2f} -{most:6.2f})"
                f" {np.mean(counts) / watched:8.2f} +- {error:.2f}"
                f" {np.round(counts / watched, 1).tolist()}"
                f" {forces[0]:14.1f} N {forces[1]:7.1f} N"
                f"   {watched:.1f} h after {calibrated:.2f} h",
                flush=True,
            )


def band(rate: float, watched: float, calibrated: float) -> tuple[float, float]:
    """Return the band of counts in `watched` hours if thresholds are from `calibrated` hours."""
    rng = np.random.default_rng(0)
    expected = rate * calibrated
    true = rng.gamma(expected + 0.5, 1.0 / (expected + 0.5), size=20000) * rate
    low, high = np.quantile(rng.poisson(true * watched), [0.025, 0.975])
    return float(low), float(high)


def _watched_robot(
    name: str, minutes: float
) -> tuple[VirtualRobot, IdentificationResult, list[Recording]]:
    """Return a virtual robot, its result, and recordings without contact to set thresholds on."""
    seed, model = list(ROBOTS).index(name), bundled_robot(name)
    robot = _rough(VirtualRobot.typical(model, rng=seed), seed)
    trained = _record(robot, random_fourier(model, rng=seed, duration=60.0), seed)
    options = StudyOptions(drive="armature,viscous,coulomb,offset", holdout="blocks:5s:3")
    result = identify(model, trained, options=options).result
    return robot, result, _quiet(robot, minutes, 0)


def _quiet(robot: VirtualRobot, minutes: float, number: int) -> list[Recording]:
    """Return recordings without contact of a calibration."""
    first = 100 + 100 * number
    return [_moves(robot, first + k, 300.0) for k in range(round(minutes / 5.0))]


def _rough(robot: VirtualRobot, seed: int) -> VirtualRobot:
    """Return a robot with Stribeck friction beside its drives, which the model lacks."""
    train = robot.train
    drive = DriveSet.parse(f"{','.join(train.drive.keys)},stribeck:velocity=0.05")  # type: ignore[union-attr]
    n = robot.model.n_joints
    known = train.values.reshape(n, -1)  # type: ignore[union-attr]
    places = {symbol: k for k, symbol in enumerate(train.drive.symbols)}  # type: ignore[union-attr]
    coulomb = known[:, places["Fc"]]
    values = np.zeros((n, drive.columns_per_joint))
    for k, symbol in enumerate(drive.symbols):
        values[:, k] = known[:, places[symbol]] if symbol in places else 0.2 * coulomb
    return robot.with_drive(drive, values.ravel())


def _moves(robot: VirtualRobot, seed: int, seconds: float) -> Recording:
    """Return random motion between poses."""
    motion = random_point_to_point(robot.model, rng=seed, n_poses=max(3, round(seconds / 2.0)))
    return _record(robot, motion, seed)


def _record(robot: VirtualRobot, motion: Any, seed: int) -> Recording:
    moved, rng = motion.sample(RATE), np.random.default_rng(seed)
    size = np.array([joint.limits.torque for joint in robot.model.joints])
    torque = robot.exact_torque(moved.q, moved.qd, moved.qdd)
    return Recording(
        t=moved.t,
        q=moved.q + 1e-5 * rng.normal(size=moved.q.shape),
        qd=moved.qd + 1e-3 * rng.normal(size=moved.q.shape),
        tau=torque + 2e-3 * size * rng.normal(size=torque.shape),
        joint_names=robot.model.joint_names,
        source=f"motion {seed}",
        torque_source="motor",
    )


def contacts(names: Sequence[str], minutes: float) -> None:
    """Print how often the interval of a force at the tool covers the force that acted.

    Forces of random direction and of one to four times the size that is seen within 20 ms act for
    half a second; three axes are counted together.
    """
    print(f"forces at the tool, {CONTACTS} contacts of 0.5 s; intervals of 95 %")
    print("robot               found   named at the tool   covered   median error   median force")
    for name in names:
        robot, result, quiet = _watched_robot(name, minutes)
        site, rng = Site(result, quiet), np.random.default_rng(1)
        model = result.model
        tool = choose_payload_frame(model)[1:]
        log = _moves(robot, 999, 10.0 * CONTACTS)
        usual = site.smallest_force(log)
        external, forces = np.zeros(log.q.shape), rng.normal(size=(CONTACTS, 3))
        forces *= (
            usual
            * rng.uniform(1.0, 4.0, (CONTACTS, 1))
            / np.linalg.norm(forces, axis=1, keepdims=True)
        )
        starts = np.linspace(2.0, float(log.t[-1]) - 2.0, CONTACTS)
        for start, force in zip(starts, forces, strict=True):
            for k in np.flatnonzero((log.t >= start) & (log.t < start + 0.5)):
                external[k] = frame_jacobian(model, log.q[k], *tool)[3:].T @ force
        seen = site.observed(replace(log, tau=log.tau - external))
        limits = site.thresholds[PROMISED]
        scale, limit = limits.of_log(seen, site.error)
        events = find_events(Observer(result, thresholds=limits), seen, scale, limit, tool)
        covered, errors, named, sizes = [], [], [], []
        for start, force in zip(starts, forces, strict=True):
            near = [event for event in events if -0.1 < event.start - start < 0.5]
            if near:
                contact = near[0].contact
                off = contact.force - force
                covered.append(np.abs(off) < 1.96 * contact.force_error)
                errors.append(np.linalg.norm(off))
                sizes.append(np.linalg.norm(force))
                named.append(not contact.p_value < ELSEWHERE)
        print(
            f"{name:18s} {len(named):3d}/{CONTACTS} {100.0 * np.mean(named):15.0f} %"
            f" {100.0 * np.mean(covered):13.0f} % {np.median(errors):11.1f} N"
            f" {np.median(sizes):11.1f} N",
            flush=True,
        )


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--virtual", type=float, metavar="HOURS")
    parser.add_argument("--contacts", action="store_true")
    parser.add_argument("--promised", type=float, nargs="+", default=[PROMISED], metavar="RATE")
    parser.add_argument("--calibrated", type=float, default=60.0, metavar="MINUTES")
    parser.add_argument("--calibrations", type=int, default=1, metavar="NUMBER")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=ROBOTS)
    chosen = parser.parse_args()
    if chosen.contacts:
        contacts(chosen.robots, chosen.calibrated)
    if chosen.virtual is not None:
        virtual(
            chosen.virtual,
            chosen.promised,
            chosen.calibrated,
            chosen.robots,
            chosen.calibrations,
        )


if __name__ == "__main__":
    main()
