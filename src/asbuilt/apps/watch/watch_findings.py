"""Statistics of a watched log, and what follows from them in addition to its events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from asbuilt.apps.watch import Observed, Observer
from asbuilt.apps.watch.events import Event, estimate_payload_change, find_smallest_forces
from asbuilt.apps.watch.options import Watched
from asbuilt.apps.watch.thresholds import Thresholds, sampling_rates
from asbuilt.arrays import Array
from asbuilt.experiment import Recording, RecordingStream, head_of
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification import IdentificationResult
from asbuilt.tables import format_plus_minus


@dataclass(slots=True)
class Tally:
    """Gather what is reported of a whole log.

    Parameters
    ----------
    joint_names
        The n joints.
    tool
        Link that carries the tool, counted from 0, and pose (4, 4) of the tool's frame in it.
    filtered
        Whether positions and torques went through the causal filter.
    n_samples, left_out, seconds
        Valid rows, others, and duration [s], gaps left out.
    """

    joint_names: tuple[str, ...]
    tool: tuple[int, Array]
    filtered: bool
    n_samples: int = 0
    left_out: int = 0
    seconds: float = 0.0
    tops: list[Array] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)
    sizes: list[Array] = field(default_factory=list)
    forces: list[Array] = field(default_factory=list)
    masses: list[tuple[float, float] | None] = field(default_factory=list)

    def add(self, observer: Observer, observed: Observed, scale: Array, limit: Array) -> None:
        """Count one more part, with scale and threshold (N, n) of its residual."""
        self.n_samples += len(observed.t)
        self.left_out += observed.left_out
        self.seconds += observed.seconds
        self.tops.append(np.abs(observed.qd).max(axis=0))
        if len(observed.t) < 2:
            return
        self.rates.append(float(np.median(sampling_rates(observed.t))))
        # Median of the absolute value of a standard normal variable.
        self.sizes.append(np.median(np.abs(observed.residual), axis=0) / 0.6745)
        self.forces.append(
            find_smallest_forces(observer, observed, limit, self.tool, filtered=self.filtered)
        )
        self.masses.append(estimate_payload_change(observer, observed, scale, self.tool[0]))

    @property
    def size(self) -> Array:
        """Robust standard deviation of the residual about 0 (n,) [N m or N]."""
        return np.asarray(np.median(self.sizes, axis=0))

    @property
    def smallest_force(self) -> float:
        """Median of the forces at the tool [N] that are found within 20 ms."""
        return float(np.median(np.concatenate(self.forces)))

    @property
    def mass(self) -> tuple[float, float] | None:
        """Change of mass [kg] and its error, if one explains every part of the log."""
        known = [mass for mass in self.masses if mass is not None]
        if len(known) < len(self.masses):
            return None
        values, errors = np.array(known).T
        return float(np.median(values)), float(max(np.median(errors), np.ptp(values) / 2.0))


# Hold when a log differs from what thresholds were set on.

WATCH_FASTER = 1.2  # Factor by which a joint may exceed the speeds that thresholds were set on
# Factor from which sampling rates differ: noise, steps of torque and the causal filter do
WATCH_OTHER_RATE = 1.25
# Size of the residual over most of a log and all joints, per RMS error that the identification
# found, from which the model is not this robot's. Between motions of one robot 1.06 to 1.56 was
# seen (LWR4+, Med 7, UR10e), with a log of another robot 19 and 28, with 3 kg on the flange of a
# UR10e 7.8.
WATCH_UNLIKE = 3.0
WATCH_SHORT = 120.0  # Duration [s] below which thresholds are mostly extrapolation


def report_velocities(log: Recording | RecordingStream, *, measured: bool) -> list[Finding]:
    """Return what to say of velocities that are not used."""
    if measured:
        return []
    why = "lag behind the positions or are noisy" if head_of(log).qd is not None else "are missing"
    return [
        Finding(
            "velocities_filtered",
            "info",
            f"logged velocities {why}; positions and torques go through one causal filter, which"
            " delays alarms by half of the observer's lag",
        )
    ]


def report_calibration(thresholds: Thresholds) -> list[Finding]:
    """Return what to say of the recordings that set thresholds."""
    seconds = 3600.0 * thresholds.hours
    if not thresholds.held_out or seconds >= WATCH_SHORT:
        return []
    return [
        Finding(
            "calibration_short",
            "warning",
            f"the thresholds follow from {seconds:.0f} s without contact; the tail of the residual"
            " is extrapolated, and the rate of false alarms is not verified",
            Cure(f"give recordings of at least {WATCH_SHORT:.0f} s"),
        )
    ]


def report_log(thresholds: Thresholds, log: Tally) -> list[Finding]:
    """Return in what a log differs from what its thresholds were set on, and what it lacks."""
    findings = []
    if log.left_out:
        findings.append(
            Finding(
                "rows_left_out",
                "warning",
                f"{log.left_out} rows were left out: values that are not finite, or times that do"
                " not advance; no contact is seen in gaps of more than 0.1 s",
                Cure("find out why the logger lost them", call="check_recording"),
            )
        )
    rate = np.median(log.rates)
    if not 1.0 / WATCH_OTHER_RATE < rate / thresholds.rate < WATCH_OTHER_RATE:
        findings.append(
            Finding(
                "rate_of_thresholds",
                "warning",
                f"the log has {rate:.4g} samples per second, the recordings that set the"
                f" thresholds {thresholds.rate:.4g}; noise differs, so the rate of false alarms"
                " is not verified",
                Cure("set the thresholds on recordings of this rate", {"calibrate": "LOG"}),
            )
        )
    top = np.max(log.tops, axis=0)
    faster = np.flatnonzero(top > WATCH_FASTER * thresholds.top_speed)
    if faster.size:
        worst = int(np.argmax(top / np.maximum(thresholds.top_speed, 1e-12)))
        names = join_names([thresholds.joint_names[k] for k in faster])
        findings.append(
            Finding(
                "faster_than_thresholds",
                "warning",
                f"{names}: up to {top[worst]:.3g} rad/s or m/s in this log,"
                f" {thresholds.top_speed[worst]:.3g} where the thresholds were set; false alarms"
                " may be more frequent",
                Cure("set the thresholds on motions as fast as those that are watched"),
                joint=thresholds.joint_names[worst],
            )
        )
    return findings


def predict_error_size(result: IdentificationResult, model: Watched) -> Array:
    """Return the RMS torque error (n,) that the identification found for a model."""
    metrics = [result.cad] if model == "cad" else [result.train, *result.validation]
    return np.asarray(np.max([metric.rms for metric in metrics], axis=0))


def report_model(
    log: Tally, expected: Array, units: Sequence[str], frame: str, events: Sequence[Event]
) -> list[Finding]:
    """Return whether most of a log is unlike its model, and whether a payload explains it.

    Parameters
    ----------
    log
        Statistics of the log.
    expected
        RMS torque error (n,) that the identification found.
    units
        Unit of each joint's torque.
    frame
        Name of the frame of the tool.
    events
        Events of the log.
    """
    unlike = float(np.linalg.norm(log.size) / np.linalg.norm(expected)) > WATCH_UNLIKE
    if log.mass is not None and (events or unlike):
        return [
            Finding(
                "payload_in_log",
                "warning",
                f"a change of mass of {format_plus_minus(*log.mass)} kg at {frame} explains the"
                " external torque of the whole log; contacts show only in addition to it",
                Cure("identify the payload, and watch the robot with it", call="identify_payload"),
            )
        ]
    if not unlike:
        return []
    ratio = log.size / np.maximum(expected, np.finfo(float).tiny)
    worst = int(np.argmax(ratio))
    return [
        Finding(
            "model_disagrees",
            "warning",
            f"{log.joint_names[worst]}: an external torque of {log.size[worst]:.3g}"
            f" {units[worst]} for most of this log, where the model was off by"
            f" {expected[worst]:.3g} when it was identified; it is not the model of this robot"
            " with its load, gains and units",
            Cure("check that log and result belong together, and validate the result on the log"),
            joint=log.joint_names[worst],
        )
    ]
