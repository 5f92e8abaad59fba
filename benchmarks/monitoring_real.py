"""Contact in real recordings: false alarms, and forces that are found, CAD beside as built.

Each robot is identified from one recording, thresholds for one false alarm per hour are set on
others, and further ones are watched. Contacts are made by adding the torque `-J^T f` of a force at
the tool to the measured torque from a random time on; everything else is as logged.

    python benchmarks/monitoring_real.py ../shared
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from asbuilt.apps.watch.events import WITHIN, frame_jacobian
from asbuilt.apps.watch.observed import ModelError, Observed
from asbuilt.apps.watch.observer import BANDWIDTH, Observer
from asbuilt.apps.watch.thresholds import HALF, Thresholds, delay_velocities, set_thresholds
from asbuilt.apps.watch.watching import estimate_doubtful_speed, uses_logged_velocities
from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.momentum import apply_lag
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.recording import Recording
from asbuilt.identification.calibration.payload import choose_payload_frame
from asbuilt.workflow.study import identify
from asbuilt.workflow.study_options import StudyOptions
from drive_terms import UR10E_SHEET

SIZES = (10.0, 20.0, 40.0, 80.0, 160.0)
"""Forces of the contacts [N]."""
LASTS = 0.3
"""Duration of a contact [s]."""
CONTACTS = 60
BEFORE = 1.5
"""Time before a contact in which observer and filter settle [s]."""

ROBOTS: Mapping[str, dict[str, Any]] = {
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


@dataclass(frozen=True)
class Detector:
    """What finds contacts: external torques of a log, and thresholds for them."""

    observe: Callable[[Recording], Observed]
    error: ModelError
    thresholds: Thresholds

    @classmethod
    def of(cls, robot: Any, quiet: Sequence[Recording], *, velocities: bool) -> Detector:
        """Return the momentum observer of a robot."""
        error = estimate_doubtful_speed(quiet, BANDWIDTH, measured=velocities)
        observer = Observer(robot, velocity_error=error)

        def observe(log: Recording) -> Observed:
            return observer.observe(log.t, log.q, log.tau, log.qd if velocities else None)

        return cls._set(observe, observer, quiet)

    @classmethod
    def of_maker(cls, robot: RobotModel, quiet: Sequence[Recording]) -> Detector:
        """Return the external torque that the log carries, which follows contacts without lag."""
        observer = Observer(robot)

        def observe(log: Recording) -> Observed:
            seen = observer.observe(log.t, log.q, log.tau)
            unknown = np.zeros(log.q.shape)
            return replace(seen, residual=log.extra["tau_ext"], unknown_friction=unknown)

        return cls._set(observe, observer, quiet)

    @classmethod
    def _set(
        cls,
        observe: Callable[[Recording], Observed],
        observer: Observer,
        quiet: Sequence[Recording],
    ) -> Detector:
        thresholds = set_thresholds(
            [observe(log) for log in quiet],
            observer.model_error,
            quiet[0].joint_names,
            bandwidth=observer.bandwidth,
            velocity_error=observer.velocity_error,
        )
        return cls(observe, observer.model_error, thresholds)

    def beyond(self, log: Recording) -> tuple[Array, Array]:
        """Return times (N,) and whether any joint is beyond its threshold (N,)."""
        seen = self.observe(log)
        limit = self.thresholds.of_log(seen, self.error)[1]
        return seen.t, (np.abs(seen.residual) > limit).any(axis=1)

    def alarms(self, log: Recording) -> int:
        """Return the number of events of a log."""
        t, beyond = self.beyond(log)
        return int(np.sum(np.diff(t[beyond], prepend=-np.inf) > self.thresholds.block_seconds))

    def size(self, logs: Sequence[Recording]) -> float:
        """Return the RMS of the external torque over all joints [N m or N]."""
        return float(
            np.sqrt(np.mean(np.concatenate([self.observe(log).residual for log in logs]) ** 2))
        )

    def parts(self, logs: Sequence[Recording]) -> list[str]:
        """Return what makes the thresholds, RMS over the logs, a line per joint."""
        limits, seen = self.thresholds, [self.observe(log) for log in logs]
        slow = [
            apply_lag(each.share, limits.slow(delay_velocities(each), each.qd)) ** 0.5
            for each in seen
        ]
        known = {
            "floor": [limits.floor + np.zeros(each.qd.shape) for each in seen],
            "slow": [limits.slow_part * each for each in slow],
            "fast": [limits.fast * each.qd for each in seen],
            "model": [self.error.std(each.q, each.qd, each.qdd) for each in seen],
            "step": [HALF * each.step for each in seen],
            "unknown": [each.unknown_friction for each in seen],
            "residual": [each.residual for each in seen],
        }
        rms = {key: np.sqrt(np.mean(np.vstack(x) ** 2, axis=0)) for key, x in known.items()}
        return [
            f"  {name:20s} level {limits.level[j]:5.2f}   "
            + "  ".join(f"{key} {size[j]:.3g}" for key, size in rms.items())
            for j, name in enumerate(limits.joint_names)
        ]

    def delay(self, log: Recording, start: float) -> float:
        """Return the time from a contact to its alarm [s], infinite for none while it lasts."""
        t, beyond = self.beyond(log)
        found = t[beyond & (t >= start) & (t <= start + LASTS)]
        return float(found[0] - start) if found.size else np.inf


def touched(model: RobotModel, log: Recording, start: float, force: Array) -> Recording:
    """Return the log around a contact: a force (3,) [N] at the tool from `start` [s] on."""
    near = log.between(start - BEFORE, start + LASTS)
    _, link, placement = choose_payload_frame(model)
    external = np.zeros(near.tau.shape)
    for k in np.flatnonzero(near.t >= start):
        external[k] = frame_jacobian(model, near.q[k], link, placement)[3:].T @ force
    extra = dict(near.extra)
    if "tau_ext" in extra:
        extra["tau_ext"] = extra["tau_ext"] + external
    return replace(near, tau=near.tau - external, extra=extra)


def recordings(shared: Path, case: Mapping[str, Any]) -> tuple[RobotModel, list[list[Recording]]]:
    """Return the robot, and the recordings to train, to set thresholds and to watch."""
    model = load_robot(str(shared / "models" / case["robot"]))
    options = dict(case["options"])
    with tempfile.TemporaryDirectory() as folder:
        if "gain" in options:
            options["sheet"] = Path(folder) / "sheet.toml"
            options["sheet"].write_text(UR10E_SHEET)
        read = {
            key: [
                read_recordings([shared / "data" / path], model=model, **options)[0]
                for path in case.get(key, ())
            ]
            for key in ("train", "quiet", "watch")
        }
    if "parts" in case:
        (whole,), edges = read["train"], [*case["parts"], np.inf]
        return model, [[whole.between(a, b)] for a, b in pairwise(edges)]
    return model, [read["train"], read["quiet"], read["watch"]]


def interval(count: int, hours: float) -> tuple[float, float]:
    """Return the 95 % interval of the rate of a Poisson count [1/h] (Garwood, 1936)."""
    low = chi2.ppf(0.025, 2 * count) / 2.0 if count else 0.0
    return float(low / hours), float(chi2.ppf(0.975, 2 * count + 2) / 2.0 / hours)


def smallest(delays: Mapping[float, Array]) -> float:
    """Return the force [N] that half of the contacts are found at within 20 ms, interpolated."""
    sizes = np.array([0.0, *delays])
    shares = np.array([0.0, *(np.mean(each <= WITHIN + 1e-9) for each in delays.values())])
    above = np.flatnonzero(shares >= 0.5)
    if not above.size:
        return np.inf
    k = int(above[0])
    return float(np.interp(0.5, shares[k - 1 : k + 1], sizes[k - 1 : k + 1]))


def main(shared: Path) -> None:
    """Print a table per robot."""
    for name, case in ROBOTS.items():
        model, (train, quiet, watched) = recordings(shared, case)
        result = identify(model, train, options=StudyOptions(checked=False)).result
        velocities = all(uses_logged_velocities(log) for log in (*quiet, *watched))
        detectors = {
            "as built": Detector.of(result, quiet, velocities=velocities),
            "CAD": Detector.of(model, quiet, velocities=velocities),
        }
        if "tau_ext" in watched[0].extra:
            detectors["maker"] = Detector.of_maker(model, quiet)
        hours = sum(float(log.t[-1] - log.t[0]) for log in watched) / 3600.0
        filtered = "" if velocities else ", velocities by the causal filter"
        print(f"\n{name}: {3600.0 * hours:.0f} s watched{filtered}")
        print(
            "           false alarms  95 % per hour  RMS [N m]  half found in 20 ms   found within"
            " 0.3 s (median delay [ms]) at " + " ".join(f"{size:g}" for size in SIZES) + " N"
        )
        print("what makes the thresholds, RMS [N m or N], all but the last three times the level:")
        print("\n".join(detectors["as built"].parts(watched)))
        for label, detector in detectors.items():
            delays = {size: _delays(detector, model, watched, size) for size in SIZES}
            count = sum(detector.alarms(log) for log in watched)
            low, high = interval(count, hours)
            shares = "  ".join(
                f"{100.0 * np.mean(np.isfinite(each)):.0f} %"
                + (f" ({1e3 * np.median(each):.0f})" if np.isfinite(np.median(each)) else " (-)")
                for each in delays.values()
            )
            print(
                f"{label:10s} {count:12d} {low:7.0f} -{high:5.0f} {detector.size(watched):10.2f}"
                f" {smallest(delays):17.0f} N   {shares}",
                flush=True,
            )


def _delays(detector: Detector, model: RobotModel, logs: Sequence[Recording], size: float) -> Array:
    """Return the delays of contacts (m,) at random times in random directions, alike for all."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(CONTACTS):
        log = logs[int(rng.integers(len(logs)))]
        latest = float(log.t[-1]) - LASTS
        start = float(rng.uniform(float(log.t[0]) + BEFORE, latest))
        along = rng.normal(size=3)
        force = size * along / np.linalg.norm(along)
        found.append(detector.delay(touched(model, log, start, force), start))
    return np.array(found)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
