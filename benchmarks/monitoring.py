"""False alarms promised and found, and the smallest contact seen within 20 ms.

Virtual robots: identified from one motion, thresholds from some others, then hours of further
random motions between poses, watched without contact. Real recordings: identified from one,
thresholds from a second, watched on a third.

    python benchmarks/monitoring.py --virtual 24     # hours per virtual robot
    python benchmarks/monitoring.py --real ../shared
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.catalogue import bundled_robot
from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.motions.random_motion import random_fourier, random_point_to_point
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.calibration.payload import payload_frame
from asbuilt.monitoring.contact import frame_jacobian
from asbuilt.monitoring.observed import Observed
from asbuilt.monitoring.observer import Observer
from asbuilt.monitoring.thresholds import Thresholds, set_thresholds
from asbuilt.workflow.options import StudyOptions
from asbuilt.workflow.study import identify
from asbuilt.workflow.watching.observation import uses_logged_velocities
from drive_terms import UR10E_SHEET

RATE = 100.0
CHUNK = 600.0
"""Seconds of a virtual motion that are held at once."""
PROMISED = 1.0
ROBOTS = ("kuka-iiwa7-r800", "ur10e", "franka-panda", "puma-560", "scara")
"""The rule of the thresholds was settled on the iiwa and the Panda."""
WITHIN = 0.020
PUSHES = 40


class Site:
    """An observer with its thresholds."""

    def __init__(
        self, robot: Any, logs: Sequence[Recording], *, velocities: bool, rate: float = PROMISED
    ) -> None:
        self.velocities = velocities
        plain = Observer(robot)
        seen = [self.observed(plain, log) for log in logs]
        self.thresholds: Thresholds = set_thresholds(
            seen,
            plain.model_error,
            plain.model.joint_names,
            bandwidth=plain.bandwidth,
            false_alarms_per_hour=rate,
        )
        self.observer = Observer(robot, thresholds=self.thresholds)

    def observed(self, observer: Observer, log: Recording) -> Observed:
        return observer.observe(log.t, log.q, log.tau, log.qd if self.velocities else None)

    def alarms(self, log: Recording) -> int:
        """Return the number of events of a log."""
        seen = self.observed(self.observer, log)
        limit = self.thresholds.of_log(seen, self.observer.model_error)[1]
        beyond = seen.t[(np.abs(seen.residual) > limit).any(axis=1)]
        return int(np.sum(np.diff(beyond, prepend=-np.inf) > self.thresholds.block_seconds))

    def smallest_force(self, log: Recording, rng: np.random.Generator) -> float:
        """Return the median of the smallest forces [N] at the tool that alarm within 20 ms.

        The residual is linear in the external torque, so a step of force adds its lagged share to
        the residual found without contact; directions are random, times are equally spaced.
        """
        seen, model = self.observed(self.observer, log), self.observer.model
        limit = self.thresholds.of_log(seen, self.observer.model_error)[1]
        _, link, placement = payload_frame(model)
        lag = 1.0 - np.exp(-2.0 * np.pi * self.thresholds.bandwidth * WITHIN)
        smallest = []
        for k in np.linspace(0.1 * len(seen.t), 0.9 * len(seen.t), PUSHES).astype(int):
            along = rng.normal(size=3)
            torque = frame_jacobian(model, seen.q[k], link, placement)[3:].T @ (
                along / np.linalg.norm(along)
            )
            sign = np.sign(torque)
            needed = (limit[k] - sign * seen.residual[k]) / np.maximum(lag * np.abs(torque), 1e-9)
            smallest.append(float(np.maximum(needed, 0.0).min()))
        return float(np.median(smallest))


def virtual(hours: float, promised: Sequence[float], minutes: float, names: Sequence[str]) -> None:
    """Print false alarms of virtual robots with friction that the model does not have.

    The band is where 95 % of counts lie if the promise is kept: a Poisson count whose own rate is
    uncertain as the number of such alarms in the time that the thresholds were set on.
    """
    print(f"virtual robots, {hours:g} h each, {RATE:g} Hz; thresholds from {minutes:g} min")
    print("robot             promised   found  95 % band   rate/h   within 20 ms: as built     CAD")
    for name in names:
        seed = list(ROBOTS).index(name)
        model = bundled_robot(name)
        robot = _rough(VirtualRobot.typical(model, rng=seed), seed)
        trained = _record(robot, random_fourier(model, rng=seed, duration=60.0), seed)
        result = identify(
            model,
            trained,
            options=StudyOptions(drive="armature,viscous,coulomb,offset", holdout="blocks:5s:3"),
        ).result
        quiet = [_moves(robot, 100 + k, 300.0) for k in range(round(minutes / 5.0))]
        sites = {rate: Site(result, quiet, velocities=True, rate=rate) for rate in promised}
        cads = {rate: Site(model, quiet, velocities=True, rate=rate) for rate in promised}
        found, watched = dict.fromkeys(promised, 0), 0.0
        for k in range(round(hours * 3600.0 / CHUNK)):
            log = _moves(robot, 1000 + k, CHUNK)
            for rate, site in sites.items():
                found[rate] += site.alarms(log)
            watched += float(log.t[-1]) / 3600.0
        log = _moves(robot, 999, 120.0)
        for rate in promised:
            low, high = band(rate, watched, minutes / 60.0)
            forces = [
                site[rate].smallest_force(log, np.random.default_rng(0)) for site in (sites, cads)
            ]
            print(
                f"{name:18s} {rate:6g}/h {found[rate]:7d} {low:5.0f} -{high:4.0f}"
                f" {found[rate] / watched:8.2f} {forces[0]:20.1f} N {forces[1]:7.1f} N",
                flush=True,
            )


def band(rate: float, watched: float, calibrated: float) -> tuple[float, float]:
    """Return the band of counts in `watched` hours if thresholds are from `calibrated` hours."""
    rng = np.random.default_rng(0)
    expected = rate * calibrated
    true = rng.gamma(expected + 0.5, 1.0 / (expected + 0.5), size=20000) * rate
    low, high = np.quantile(rng.poisson(true * watched), [0.025, 0.975])
    return float(low), float(high)


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


REAL: Mapping[str, dict[str, Any]] = {
    "LWR4+": {
        "robot": "kuka_lwr4.urdf",
        "train": ["kuka_lwr4/measurements_3.npz"],
        "quiet": ["kuka_lwr4/measurements_1.npz"],
        "watch": ["kuka_lwr4/measurements_2.npz"],
        "options": {"torque_source": "sensor"},
    },
    "UR10e": {
        "robot": "ur10e.urdf",
        "train": ["ur10e/ur-20_02_10-30sec_12harm.csv"],
        "quiet": ["ur10e/ur-20_02_12-40sec_12harm.csv", "ur10e/ur-20_02_19_14harm50sec.csv"],
        "watch": ["ur10e/ur-20_01_17-ptp_10_points.csv", "ur10e/ur-20_01_31-unload.csv"],
        "options": {"gain": [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]},
    },
    "LBR Med 7": {
        "robot": "lbrstack_med7.urdf",
        "train": ["lbr_med7/measurements_with_ext_tau_1_dgr.csv"],
        "parts": (0.0, 50.0, 75.0),
        "options": {"rate": 100.0, "flip_torque": True},
    },
}
"""Recordings to identify from, to set thresholds on, and to watch.

`parts`: one recording is divided at these times [s].
"""


def real(shared: Path) -> None:
    """Print false alarms of real recordings without contact, the residual, and smallest forces."""
    print("real recordings without contact; residual: RMS over all joints [N m]")
    print(
        "robot        watched  alarms as built  CAD   residual as built   CAD  maker"
        "   force within 20 ms as built      CAD"
    )
    for name, case in REAL.items():
        model = load_robot(str(shared / "models" / case["robot"]))
        options = dict(case["options"])
        with tempfile.TemporaryDirectory() as folder:
            if "gain" in options:
                options["sheet"] = Path(folder) / "sheet.toml"
                options["sheet"].write_text(UR10E_SHEET)

            def read(paths: Sequence[str], model: Any = model, options: Any = options) -> list[Any]:
                return [
                    read_recordings([shared / "data" / path], model=model, **options)[0]
                    for path in paths
                ]

            train = read(case["train"])
            if "parts" in case:
                start, middle, end = case["parts"]
                whole = train[0]
                train = [whole.between(start, middle)]
                quiet, watched = [whole.between(middle, end)], [whole.between(end, np.inf)]
            else:
                quiet, watched = read(case["quiet"]), read(case["watch"])
        result = identify(model, train, options=StudyOptions(checked=False)).result
        velocities = all(uses_logged_velocities(log) for log in (*quiet, *watched))
        sites = [Site(robot, quiet, velocities=velocities) for robot in (result, model)]
        alarms = [sum(site.alarms(log) for log in watched) for site in sites]
        sizes = [_size(site, watched) for site in sites]
        maker = [log.extra["tau_ext"] for log in watched if "tau_ext" in log.extra]
        made = f"{np.sqrt(np.mean(np.concatenate(maker) ** 2)):6.2f}" if maker else "     -"
        forces = [
            np.median([site.smallest_force(log, np.random.default_rng(0)) for log in watched])
            for site in sites
        ]
        seconds = sum(float(log.t[-1] - log.t[0]) for log in watched)
        print(
            f"{name:11s} {seconds:6.0f} s {alarms[0]:16d} {alarms[1]:4d} {sizes[0]:19.2f}"
            f" {sizes[1]:5.2f} {made} {forces[0]:26.1f} N {forces[1]:6.1f} N",
            flush=True,
        )


def _size(site: Site, logs: Sequence[Recording]) -> float:
    parts = [site.observed(site.observer, log).residual for log in logs]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--virtual", type=float, metavar="HOURS")
    parser.add_argument("--real", type=Path, metavar="DIR")
    parser.add_argument("--promised", type=float, nargs="+", default=[PROMISED], metavar="RATE")
    parser.add_argument("--calibrated", type=float, default=60.0, metavar="MINUTES")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=ROBOTS)
    chosen = parser.parse_args()
    if chosen.real is not None:
        real(chosen.real)
    if chosen.virtual is not None:
        virtual(chosen.virtual, chosen.promised, chosen.calibrated, chosen.robots)


if __name__ == "__main__":
    main()
