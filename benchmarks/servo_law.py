"""Which law the servos of an SO-101 have: three laws fitted to simulated windows, joint by joint.

    python benchmarks/servo_law.py [JOINT ...]

A joint is simulated alone, in windows of 0.5 s from the measured state, under its command and the
torque of all links by CAD at the measured motion of the other joints. `plain` is
`kp (u(t - d) - q)`; `goal` passes the command through a limit of its acceleration; `derivative` is
`clip(kp e + kr de/dt, -L, L)` of the error e, with the lead `kr / kp`. Each has armature, viscous
and dry friction, and the stiffness that gravity gives lift and elbow. `chirp_sweep` has its limit
of 39 rad/s^2 throughout. Fitted to six motions with equal, bounded weight of windows; printed are
the parameters, the cost and the RMS error [mrad] of all motions. Recordings are those of
`../shared`; without them nothing is measured.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.goal_profile import derive_goal_path
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.logs.reading_options import ReadingOptions
from asbuilt.experiment.logs.recordings import read_fitted_recordings
from asbuilt.experiment.recording import Recording
from commands import JOINTS, OTHERS, TRAINED
from drive_terms import SHARED

Array = NDArray[np.float64]
FITTED = (*TRAINED[:3], "coupled_joints", "prbs_excitation", "static_holding")
CHIRP_LIMIT = 38.96
KP = 11.5
STEP, LENGTH, USUAL = 1e-3, 25, 3.0
SCALES = {"Ia": 0.02, "Fv": 0.1, "Fc": 0.05, "delay": 5e-3, "kr": 0.2, "limit": 0.5, "goal": 50.0}
COMMON = {"Ia": 5e-3, "Fv": 0.6, "Fc": 0.13, "delay": 0.0}
LAWS: dict[str, dict[str, float]] = {
    "plain": COMMON,
    "goal": COMMON | {"goal": 350.0},
    "derivative": COMMON | {"Fv": 0.5, "delay": 0.015, "kr": 0.3, "limit": 2.5},
}


@dataclass(frozen=True, eq=False)
class Joint:
    """Hold a joint's log in one motion; `rest` is the torque of the links without its own inertia.

    `inertia` (N,) is that of the links about the joint, `start` and `speed` the filtered state.
    """

    t: Array
    command: Array
    q: Array
    start: Array
    speed: Array
    rest: Array
    inertia: Array
    limit: float


@njit(cache=True)
def _simulated(goal, rate, joint_q, start, speed, rest, inertia, first, ticks, steps, p, error):
    """Write simulated minus measured positions of windows; p is kp, Ia, Fv, Fc, kr, limit."""
    kp, armature, viscous, dry, kr, limit = p
    for w in range(first.size):
        x, v = start[first[w]], speed[first[w]]
        for s in range(error.shape[1]):
            i = first[w] + s
            J = inertia[i] + armature
            for k in range(steps):
                share, at = k / steps, min(ticks[w] + s * steps + k, goal.size - 1)
                drive = kp * (goal[at] - x) + kr * (rate[at] - v)
                drive = min(max(drive, -limit), limit)
                load = rest[i] * (1.0 - share) + rest[i + 1] * share
                free = (v * J + 1e-3 * (drive - load)) / (J + 1e-3 * viscous)
                held = 1e-3 * dry / (J + 1e-3 * viscous)
                v = free - held if free > held else free + held if free < -held else 0.0
                x += 1e-3 * v
            error[w, s] = x - joint_q[i + 1]


def errors(joint: Joint, law: Mapping[str, float]) -> Array:
    """Return the errors [mrad] of all windows under a law, (W, 25)."""
    limit = joint.limit if np.isfinite(joint.limit) else law.get("goal", np.inf)
    fine, goal = derive_goal_path(joint.t, joint.command[:, None], limit)
    ticks = joint.t[0] + STEP * np.arange(round((joint.t[-1] - joint.t[0]) / STEP))
    held = np.clip(
        np.searchsorted(fine, ticks + STEP / 2 - law["delay"], side="right") - 1, 0, None
    )
    acting = goal[held, 0]
    rate = np.diff(acting, prepend=acting[0]) / STEP
    first = np.arange(10, joint.t.size - LENGTH - 2, LENGTH)
    found = np.empty((first.size, LENGTH))
    numbers = [law.get("kp", KP), law["Ia"], law["Fv"], law["Fc"]]
    steps = round(float(np.median(np.diff(joint.t))) / STEP)
    parts = (joint.q, joint.start, joint.speed, joint.rest, joint.inertia)
    p = np.array([*numbers, law.get("kr", 0.0), law.get("limit", np.inf)])
    begin = np.round((joint.t[first] - joint.t[0]) / STEP).astype(np.int64)
    _simulated(acting, rate, *parts, first, begin, steps, p, found)
    return 1e3 * np.nan_to_num(found, nan=1.0)


def bounded(joints: Mapping[str, Joint], law: Mapping[str, float]) -> Array:
    """Return what windows count: `log(1 + r^2)` of their RMS errors r in the usual ones, root."""
    every = [np.sqrt(np.mean(errors(joints[name], law) ** 2, axis=1)) for name in FITTED]
    return np.asarray(USUAL * np.sqrt(np.log1p((np.concatenate(every) / USUAL) ** 2)))


def fitted(joints: Mapping[str, Joint], start: Mapping[str, float]) -> dict[str, float]:
    """Return the law that fits best from a start."""
    names, sizes = list(start), np.array([SCALES.get(name, 2.0) for name in start])
    begin = np.array(list(start.values()))

    def law(z: Array) -> dict[str, float]:
        return dict(zip(names, (begin + (z - 1.0) * sizes).tolist(), strict=True))

    least = np.array([-np.inf if name == "delay" else 0.0 for name in names])
    at = np.ones(len(names))
    for step in (2e-2, 5e-3):
        at = least_squares(
            lambda z: bounded(joints, law(z)),
            at,
            bounds=(1.0 + (least - begin) / sizes - 1e-9, np.inf),
            diff_step=step,
            max_nfev=30,
        ).x
    return law(at)


def joints_of(model: RobotModel, recording: Recording, name: str) -> list[Joint]:
    """Return what each joint logged, with the torques of the links at the measured motion."""
    h, q = float(np.median(np.diff(recording.t))), recording.q
    smooth, qd = savgol_filter(q, 7, 3, axis=0), savgol_filter(q, 9, 3, deriv=1, delta=h, axis=0)
    qdd, none = savgol_filter(q, 15, 3, deriv=2, delta=h, axis=0), np.zeros_like(q)
    whole, still = (
        inverse_dynamics(model, smooth, qd, qdd),
        inverse_dynamics(model, smooth, none, none),
    )
    found = []
    for k in range(q.shape[1]):
        unit = none.copy()
        unit[:, k] = 1.0
        inertia = (inverse_dynamics(model, smooth, none, unit) - still)[:, k]
        rest = whole[:, k] - inertia * qdd[:, k]
        parts = (recording.command[:, k], q[:, k], smooth[:, k], qd[:, k], rest, inertia)
        limit = CHIRP_LIMIT if name == "chirp_sweep" else np.inf
        found.append(Joint(recording.t, *map(np.ascontiguousarray, parts), limit))
    return found


def main(asked: list[str]) -> None:
    """Print the laws of some joints."""
    names = sorted((*TRAINED, *OTHERS))
    folder = SHARED / "data" / "so101_sage"
    model, (recordings,) = read_fitted_recordings(
        load_robot(SHARED / "models" / "so101" / "so101_new_calib.xml"),
        ([folder / each for each in names],),
        options=ReadingOptions(torque_source="command", sheet={"joints": JOINTS}, lock="gripper=0"),
    )
    logs = {Path(item.source).name: item for item in recordings if isinstance(item, Recording)}
    each = {name: joints_of(model, log, name) for name, log in logs.items()}
    for joint in asked or ["wrist_flex", "wrist_roll"]:
        k = model.joint_names.index(joint)
        own = {name: logged[k] for name, logged in each.items()}
        for label, start in LAWS.items():
            heavy = joint in ("shoulder_lift", "elbow_flex")
            law = fitted(own, start | ({"kp": KP} if heavy else {}))
            cost = float(np.sum(bounded(own, law) ** 2))
            print(f"{joint} {label}: cost {cost:.0f}")
            print("  " + "  ".join(f"{name} {value:.4g}" for name, value in law.items()))
            rms = {name: np.sqrt(np.mean(errors(log, law) ** 2)) for name, log in own.items()}
            print("  " + "  ".join(f"{name} {value:.1f}" for name, value in rms.items()))


if __name__ == "__main__":
    if not (SHARED / "data").is_dir():
        sys.exit(f"no recordings in {SHARED / 'data'}")
    main(sys.argv[1:])
