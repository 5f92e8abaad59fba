"""KUKA Sunrise: a Java application that runs and records the motion."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from asbuilt.apps.programs.format import (
    DRY_RUN_SLOWDOWN,
    PROGRAM_FORMATS,
    ProgramFile,
    ProgramFormat,
    ProgramRequest,
)
from asbuilt.apps.programs.naming import make_class_name
from asbuilt.apps.programs.via_points import Segment, choose_spline_times, divide_point_to_point
from asbuilt.apps.programs.wording import (
    DRY_RUN_PART,
    comment_lines,
    compose_preamble,
    format_numbers,
    format_rounded_down,
    format_sheet,
    render,
)
from asbuilt.description import RobotModel
from asbuilt.errors import MotionError
from asbuilt.excitation import MotionBounds

PACKAGE = "application"
"""Java package of the application."""


MOST_POINTS = 1000
"""Most points of one Java class, whose constants one method of 64 KiB sets."""

ACCELERATION = 0.5
"""Acceleration and jerk given to the controller, as parts of what its axes can do."""

SIGN_NOTE = (
    "KUKA reports measured joint torques with the opposite sign, as what the link exerts on the"
    " drive, hence sign = -1. It turns external torques (tau_ext) as well, so that tau - tau_ext is"
    " what KUKA's own model predicts. `asbuilt check` finds a controller version that differs."
)


class SunriseFormat(ProgramFormat):
    """A RoboticsAPI application.

    SplineJP through points of the motion, or PTP from rest to rest where the motion is made of
    these.
    """

    key = "sunrise"
    title = "KUKA Sunrise application (Java)"
    default_rate = 500.0
    n_joints = 7

    def check_joints(self, model: RobotModel) -> None:
        """Raise `MotionError` unless the robot has 7 revolute joints with velocity limits."""
        super().check_joints(model)
        unknown = [joint.name for joint in model.joints if not np.isfinite(joint.limits.velocity)]
        if unknown:
            raise MotionError(
                "the format sunrise gives speeds as parts of the axes' maximum, but the"
                f" description of {model.name} has no velocity limit for {', '.join(unknown)};"
                " add it"
            )

    def files(self, request: ProgramRequest) -> tuple[ProgramFile, ...]:
        """Return the Java class and the sheet of its DataRecorder log."""
        segments = divide_point_to_point(request.motion)
        spline = segments is None
        segments = segments or _list_spline_segments(request)
        if len(segments) > MOST_POINTS:
            raise MotionError(
                f"the motion needs {len(segments)} points, more than the {MOST_POINTS} that"
                " fit into one application; split it, or give the format fri, which streams"
            )
        limit = MotionBounds.of(request.model).velocity
        speeds = [
            # The controller refuses a speed of zero.
            float(np.clip((segment.speed / limit).max(), 0.01, 1.0))
            for segment in segments
        ]
        approach = min(0.1, float((request.approach_speed / limit).min()))
        name = make_class_name(request.name, suffix="Excitation")
        path = (
            f"a joint spline (SplineJP) through {len(segments)} points of the motion and stays near"
            " it"
            if spline
            else f"the {len(segments)} point-to-point motions (PTP) that the motion is made of"
        )
        use = (
            (
                f"Add {name}.java to a Sunrise project (Sunrise.OS 1.x; package {PACKAGE}), with"
                " tool and load data set, and synchronise it."
            ),
            (
                "Select T1 on the smartPAD, start the application and choose the dry run. Then T2"
                " or AUT: the dry run again, to its end."
            ),
            (
                "Only then choose full speed. The enabling switch, a released start key or Cancel"
                " stops the robot."
            ),
            (
                f"Copy {request.stem}_log.txt from the DataRecorder folder of the controller and"
                f" keep {request.stem}_log.toml next to it: asbuilt identify ROBOT"
                f" {request.stem}_log.txt"
            ),
            f"The path is {path}; its timing between the points is the controller's own, so the"
            " margins of velocity hold; the margins of acceleration and torque are for the designed"
            " timing.",
        )
        text = render(
            "Sunrise.java.j2",
            preamble=comment_lines(compose_preamble(request, self.title, use), " *"),
            package=PACKAGE,
            spline=spline,
            class_name=name,
            dry_run=f"{1 / DRY_RUN_SLOWDOWN:g}",
            dry_run_percent=DRY_RUN_PART,
            approach=format_rounded_down(approach),
            acceleration=f"{ACCELERATION:g}",
            jerk=f"{ACCELERATION:g}",
            tolerance=f"{request.start_tolerance.min():g}",
            interval=request.period_ms,
            start=format_numbers(request.motion.start),
            step=f"{request.motion.duration / len(segments):.4f}",
            points=[format_numbers(segment.pose) for segment in segments],
            speeds=[format_rounded_down(speed) for speed in speeds],
            dwells=[10 * round(100 * segment.dwell) for segment in segments],
            log=f"{request.stem}_log.txt",
            dry_run_log=f"{request.stem}_dry_run_log.txt",
        )
        sheet = format_sheet(
            request,
            (
                (
                    "Written by KUKA's DataRecorder: two columns of time, then positions, measured"
                    " torques and external torques of A1 to A7."
                ),
                (
                    "Compare the columns with the first line of the log; other versions may order"
                    " them differently."
                ),
                SIGN_NOTE,
            ),
            {
                "rate": request.rate,
                "separator": " ",
                "joints": list(request.model.joint_names),
                "torque_source": "sensor",
                "sign": -1,
                "columns": {"position": "3-9", "torque": "10-16", "extra": {"tau_ext": "17-23"}},
                "units": {"position": "rad", "torque": "N m"},
            },
        )
        return (
            ProgramFile("program", f"{name}.java", text),
            ProgramFile("sheet", f"{request.stem}_log.toml", sheet),
        )


def _list_spline_segments(request: ProgramRequest) -> tuple[Segment, ...]:
    """Return a segment from point to point of a spline, with the top speeds in between."""
    motion = request.motion
    segments = []
    # How far the spline may leave the designed path [rad].
    for begin, end in pairwise(choose_spline_times(motion, 0.01)):
        speed = np.abs(motion.derivative(np.linspace(begin, end, 21), 1)).max(axis=0)
        segments.append(Segment(motion.derivative(end), speed, 0.0))
    return tuple(segments)


PROGRAM_FORMATS.register(SunriseFormat.key, SunriseFormat())
