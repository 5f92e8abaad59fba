"""Momentum observer and its thresholds as C99, on top of the functions of `c_code`."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

import numpy as np

from asbuilt.apps.watch.causal_filter import filter_pole
from asbuilt.apps.watch.observed import ModelError
from asbuilt.apps.watch.observer import BANDWIDTH, LONGEST_STEP
from asbuilt.apps.watch.thresholds import HALF, Thresholds
from asbuilt.apps.watch.watched_log import read_thresholds
from asbuilt.arrays import Array
from asbuilt.identification import IdentificationResult
from asbuilt.writers import OBSERVERS, CCode


def make_observer_code(
    result: IdentificationResult, thresholds: Thresholds | str | os.PathLike[str] | None
) -> Callable[[str], CCode]:
    """Return what writes the observer of an identified robot, from the prefix of its names.

    `thresholds` are limits of the residual, or the file that `asbuilt watch` wrote them to.
    """
    limits = (
        read_thresholds(thresholds) if isinstance(thresholds, str | os.PathLike) else thresholds
    )
    if limits is not None:
        limits.check_joints(result.model.joint_names)
    factor = ModelError.of(result).factor
    n = result.model.n_joints
    return lambda name: generate_observer_code(name, n, thresholds=limits, factor=factor)


OBSERVERS.register("momentum", make_observer_code)


def generate_observer_code(
    name: str,
    n: int,
    *,
    thresholds: Thresholds | None = None,
    factor: Array | None = None,
) -> CCode:
    """Return the observer of n joints, all names beginning with `name`.

    Parameters
    ----------
    name
        Prefix of the functions of the robot.
    n
        Number of joints.
    thresholds, factor
        Limits of the residual, and L (p, k) with `L L^T` the covariance of the base parameters.
    """
    width = BANDWIDTH if thresholds is None else thresholds.bandwidth
    state = f"const double q[{n}], const double qd[{n}]"
    slow = f"    double slowness[{n}];     /* lagged nearness to standstill, 0 to 1 */\n"
    header = f"""
/*
 * Momentum observer (De Luca and Mattone, 2005) of bandwidth {width!r} Hz. Call the update once a
 * sample with the time [s] since the last one; the residual is the external torque of every joint
 * behind a first-order lag. After restart, and after more than {LONGEST_STEP!r} s, it starts at 0.
 * Velocities must not lag behind positions and torques.
 */
typedef struct {{
    double residual[{n}];     /* external torque [N m or N] */
    double momentum[{n}];
    double torque[{n}];
    double effort[{n}];       /* torque of the drives */
    double velocity[{n}];
    double acceleration[{n}]; /* lagged */
    double step[{n}];         /* lagged size of the steps of torque between samples */
    double least[{n}];        /* friction at the ends of the velocities that a sample stands for */
    double most[{n}];
    double unknown[{n}];      /* lagged largest error of friction of unknown direction */
{slow if thresholds else ""}    int started;
}} {name}_observer;

void {name}_observer_restart({name}_observer *observer);

void {name}_observer_update({name}_observer *observer, double dt, {state},
    const double tau[{n}]);
"""
    source = _write_update(name, n, width, thresholds)
    if thresholds is not None:
        header += _write_threshold_header(name, n, thresholds)
        source += _write_threshold_source(
            name, n, thresholds, np.zeros((0, 0)) if factor is None else factor
        )
    return CCode(name, header, source)


def _write_update(name: str, n: int, width: float, thresholds: Thresholds | None) -> str:
    slow_start = ""
    slow = ""
    if thresholds is not None:
        slow_start = "        observer->slowness[j] = 0.0;\n"
        slow = """            double least = fmin(fabs(observer->velocity[j]), fabs(qd[j]));
            if (observer->velocity[j]*qd[j] < 0.0) least = 0.0;
            least /= slow_speed[j];
            observer->slowness[j] += share*(exp(-least*least) - observer->slowness[j]);
"""
    tables = "" if thresholds is None else _write_table("slow_speed", thresholds.slow_speed) + "\n"
    errors = np.zeros(n) if thresholds is None else thresholds.velocity_error
    tables += _write_table("velocity_error", errors) + "\n"
    return f"""{tables}void {name}_observer_restart({name}_observer *observer)
{{
    for (int j = 0; j < {n}; j++) {{
        observer->residual[j] = 0.0;
        observer->momentum[j] = 0.0;
        observer->torque[j] = 0.0;
        observer->effort[j] = 0.0;
        observer->velocity[j] = 0.0;
        observer->acceleration[j] = 0.0;
        observer->step[j] = 0.0;
        observer->least[j] = 0.0;
        observer->most[j] = 0.0;
        observer->unknown[j] = 0.0;
{slow_start}    }}
    observer->started = 0;
}}

void {name}_observer_update({name}_observer *observer, double dt, const double q[{n}],
    const double qd[{n}], const double tau[{n}])
{{
    double momentum[{n}], gradient[{n}], gravity[{n}], slower[{n}], faster[{n}];
    double least[{n}], most[{n}];
    if (!(dt > 0.0 && dt <= {LONGEST_STEP!r})) {name}_observer_restart(observer);
    {name}_momentum(q, qd, momentum, gradient);
    {name}_gravity_torque(q, gravity);
    for (int j = 0; j < {n}; j++) {{
        slower[j] = qd[j] - velocity_error[j];
        faster[j] = qd[j] + velocity_error[j];
    }}
    {name}_friction(q, slower, least);
    {name}_friction(q, faster, most);
    const double share = -expm1(-{2.0 * np.pi * width!r}*dt);
    for (int j = 0; j < {n}; j++) {{
        const double torque = tau[j] + (gradient[j] - gravity[j]);
        if (observer->started) {{
            const double friction
                = 0.25*(least[j] + most[j] + observer->least[j] + observer->most[j]);
            const double above = fmax(fmax(least[j], most[j]),
                fmax(observer->least[j], observer->most[j])) - friction;
            const double below = friction - fmin(fmin(least[j], most[j]),
                fmin(observer->least[j], observer->most[j]));
            const double external = (momentum[j] - observer->momentum[j])/dt
                - 0.5*(torque + observer->torque[j]) + friction;
            const double rate = (qd[j] - observer->velocity[j])/dt;
            observer->residual[j] += share*(external - observer->residual[j]);
            observer->acceleration[j] += share*(rate - observer->acceleration[j]);
            observer->step[j] += share*(fabs(tau[j] - observer->effort[j]) - observer->step[j]);
            observer->unknown[j] += share*(fmax(above, below) - observer->unknown[j]);
{slow}        }}
        observer->momentum[j] = momentum[j];
        observer->torque[j] = torque;
        observer->effort[j] = tau[j];
        observer->least[j] = least[j];
        observer->most[j] = most[j];
        observer->velocity[j] = qd[j];
    }}
    observer->started = 1;
}}"""


def _write_threshold_header(name: str, n: int, thresholds: Thresholds) -> str:
    rate = thresholds.false_alarms_per_hour
    filtered = ""
    if thresholds.filtered:
        pole = filter_pole(thresholds.bandwidth, thresholds.rate)
        filtered = f"""
 * They were set on positions and torques behind one causal filter, x'' = w^2 (u - x) - 2 w x' with
 * w = {pole!r} rad/s: give the update both filtered, and x' of the positions as velocities."""
    return f"""
/*
 * Thresholds for {rate:g} false alarms per hour, all joints together, in motions like the
 * {3600.0 * thresholds.hours:.0f} s that they were set on: level times the scale of the errors at
 * this speed and pose, the covariance of the parameters included, half of the steps of torque,
 * and half of the friction whose direction is unknown.
 * q is the position of the last update.{filtered}
 */
void {name}_observer_threshold(const {name}_observer *observer, const double q[{n}],
    double threshold[{n}]);

/* Joints beyond their thresholds: bit j for joint j, 0 for none. */
unsigned {name}_observer_alarms(const {name}_observer *observer, const double threshold[{n}]);
"""


def _write_threshold_source(name: str, n: int, thresholds: Thresholds, factor: Array) -> str:
    p, k = factor.shape
    parts = {
        "level": thresholds.level,
        "floor_square": thresholds.floor**2,
        "slow_square": thresholds.slow_part**2,
        "fast": thresholds.fast,
        "model_square": thresholds.model_part**2,
    }
    tables = "\n".join(_write_table(key, values) for key, values in parts.items())
    spread = ""
    if k:
        tables += "\n" + _write_table("factor", factor.ravel())
        spread = f"""        for (int c = 0; c < {k}; c++) {{
            double sum = 0.0;
            for (int b = 0; b < {p}; b++) sum += Y[j*{p} + b]*factor[b*{k} + c];
            square += model_square[j]*sum*sum;
        }}
"""
    regressor = (
        f"    double Y[{n * p}];\n    {name}_regressor(q, observer->velocity,"
        " observer->acceleration, Y);\n"
        if k
        else "    (void)q;\n"
    )
    return f"""

{tables}

void {name}_observer_threshold(const {name}_observer *observer, const double q[{n}],
    double threshold[{n}])
{{
{regressor}    for (int j = 0; j < {n}; j++) {{
        const double speed = fast[j]*observer->velocity[j];
        double square = floor_square[j] + slow_square[j]*observer->slowness[j] + speed*speed;
{spread}        threshold[j] = level[j]*sqrt(square) + {HALF!r}*observer->step[j]
            + observer->unknown[j];
    }}
}}

unsigned {name}_observer_alarms(const {name}_observer *observer, const double threshold[{n}])
{{
    unsigned alarms = 0;
    for (int j = 0; j < {n}; j++)
        if (!(fabs(observer->residual[j]) <= threshold[j])) alarms |= 1u << j;
    return alarms;
}}"""


def _write_table(name: str, values: Sequence[float] | Array) -> str:
    numbers = [repr(float(value) + 0.0) for value in values]
    rows = [", ".join(numbers[k : k + 3]) for k in range(0, len(numbers), 3)]
    body = ",\n".join(f"    {row}" for row in rows)
    return f"static const double {name}[{len(numbers)}] = {{\n{body}\n}};\n"
