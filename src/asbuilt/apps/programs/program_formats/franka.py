"""Franka: a libfranka program (C++) that runs the motion and records it."""

from __future__ import annotations

import numpy as np

from asbuilt.apps.programs.format import (
    DRY_RUN_SLOWDOWN,
    PROGRAM_FORMATS,
    ProgramFile,
    ProgramFormat,
    ProgramRequest,
)
from asbuilt.apps.programs.wording import (
    comment_lines,
    compose_preamble,
    format_numbers,
    format_sheet,
    format_streamed_motion,
    render,
    render_motion_class,
)
from asbuilt.errors import MotionError
from asbuilt.excitation import MotionBounds

CONTROL_RATE = 1000.0
"""Rate at which the robot takes positions and checks them for jumps [Hz]."""


class FrankaFormat(ProgramFormat):
    """A control callback of joint positions at 1 kHz, with a table of the motion."""

    key = "franka"
    title = "libfranka program (C++)"
    default_rate = 1000.0
    n_joints = 7
    smooth = True

    def files(self, request: ProgramRequest) -> tuple[ProgramFile, ...]:
        """Return the program, its table and the sheet of its log.

        Raises
        ------
        MotionError
            If the acceleration jumps more than the robot lets pass.
        """
        _check_smoothness(request)
        stem = request.stem
        source_name = f"{stem}_franka.cpp"
        table = f"{stem}_franka.csv"
        use = (
            (
                f"Build: g++ -std=c++17 -O2 {source_name} -lfranka -o {stem}_franka. Keep {table}"
                " in the folder where you run it. The computer needs a real-time kernel, as"
                " libfranka does."
            ),
            (
                "Set the mass and inertia of the tool in Desk, unlock the joints, activate FCI;"
                " have the stop button at hand."
            ),
            (
                f"./{stem}_franka ROBOT_ADDRESS asks, moves to the start pose, asks again and does"
                " the dry run."
            ),
            f"When the dry run reached its end: ./{stem}_franka ROBOT_ADDRESS --full",
            (
                f"The log is {stem}_log.csv, its sheet {stem}_log.toml: asbuilt identify ROBOT"
                f" {stem}_log.csv"
            ),
        )
        source = render(
            "franka.cpp.j2",
            preamble=comment_lines(compose_preamble(request, self.title, use), "//"),
            motion_class=render_motion_class(request),
            slowdown=f"{DRY_RUN_SLOWDOWN:.1f}",
            tolerance=f"{request.start_tolerance.min():g}",
            approach=format_numbers(request.approach_speed),
            table=table,
            log=f"{stem}_log.csv",
            dry_run_log=f"{stem}_dry_run_log.csv",
        )
        sheet = format_sheet(
            request,
            (
                (
                    f"Written by {source_name} at 1 kHz: tau is the measured link-side torque"
                    " tau_J, gravity included, with the sign of the drive's torque; tau_ext is"
                    " tau_ext_hat_filtered, so that tau - tau_ext is what the robot's own model"
                    " predicts."
                ),
            ),
            {
                "joints": list(request.model.joint_names),
                "torque_source": "sensor",
                "sign": 1,
                "columns": {
                    "time": "t",
                    "position": "q_1-q_7",
                    "velocity": "qd_1-qd_7",
                    "torque": "tau_1-tau_7",
                    "extra": {"tau_ext": "tau_ext_1-tau_ext_7"},
                },
                "units": {"time": "s", "position": "rad", "velocity": "rad/s", "torque": "N m"},
            },
        )
        return (
            ProgramFile("program", source_name, source),
            ProgramFile("motion", table, format_streamed_motion(request)),
            ProgramFile("sheet", f"{stem}_log.toml", sheet),
        )


def _check_smoothness(request: ProgramRequest) -> None:
    # Jerk limit where the description gives none [rad/s^3]. The least of the Panda's is 3750, of
    # the FR3's 5000.
    limit = np.nan_to_num(MotionBounds.of(request.model).jerk, posinf=5000.0)
    t = request.motion.sample_times(CONTROL_RATE)
    acceleration = np.pad(request.motion.derivative(t, 2), ((1, 1), (0, 0)))
    jerk = np.abs(np.diff(acceleration, axis=0)) * CONTROL_RATE
    k, j = (int(index) for index in np.unravel_index(int(np.argmax(jerk / limit)), jerk.shape))
    if jerk[k, j] > limit[j]:
        raise MotionError(
            f"the acceleration of {request.model.joint_names[j]} jumps by"
            f" {jerk[k, j] / CONTROL_RATE:.3g} rad/s^2 within one millisecond at t ="
            f" {t[min(k, t.size - 1)]:.3f} s, a jerk of {jerk[k, j]:.4g} rad/s^3 where the robot"
            f" stops above {limit[j]:g}; give a motion with continuous acceleration from rest to"
            " rest (fourier, bspline, quintic), or slow it down"
        )


PROGRAM_FORMATS.register(FrankaFormat.key, FrankaFormat())
