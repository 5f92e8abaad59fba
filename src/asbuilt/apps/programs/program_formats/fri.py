"""KUKA FRI: a C++ client that streams the motion, and the Java application of the session."""

from __future__ import annotations

import numpy as np

from asbuilt.apps.programs.format import (
    DRY_RUN_SLOWDOWN,
    PROGRAM_FORMATS,
    ProgramFile,
    ProgramFormat,
    ProgramRequest,
)
from asbuilt.apps.programs.naming import make_class_name
from asbuilt.apps.programs.program_formats.sunrise import PACKAGE, SIGN_NOTE
from asbuilt.apps.programs.wording import (
    comment_lines,
    compose_preamble,
    format_numbers,
    format_rounded_down,
    format_sheet,
    format_streamed_motion,
    render,
    render_motion_class,
)
from asbuilt.excitation import MotionBounds


class FriFormat(ProgramFormat):
    """Client for KUKA's FRI SDK that commands joint positions in every cycle."""

    key = "fri"
    title = "KUKA FRI client (C++) with its Sunrise application (Java)"
    default_rate = 200.0
    n_joints = 7

    def files(self, request: ProgramRequest) -> tuple[ProgramFile, ...]:
        """Return client, table, Java application and the sheet of the client's log."""
        stem = request.stem
        java = make_class_name(request.name, suffix="FriHold")
        client = f"{stem}_fri.cpp"
        table = f"{stem}_fri.csv"
        use = (
            (
                "Build the client against KUKA's FRI client SDK: g++ -std=c++11 -O2 -I FRI/include"
                f" {client} -L FRI/lib -lFRIClient -o {stem}_fri. Keep {table} in the folder where"
                " you run it."
            ),
            (
                f"Add {java}.java to a Sunrise project (Sunrise.OS 1.x), set CLIENT to the address"
                " of the client, tool and load data as mounted."
            ),
            (
                f"Start ./{stem}_fri (the dry run), then {java} on the smartPAD in T1: it moves to"
                " the start pose and hands over to the client."
            ),
            (
                f"When the dry run reached its end: ./{stem}_fri --full. The enabling switch or the"
                " emergency stop stops the robot."
            ),
            (
                f"The log is {stem}_log.csv, its sheet {stem}_log.toml: asbuilt identify ROBOT"
                f" {stem}_log.csv"
            ),
        )
        head = compose_preamble(request, self.title, use)
        limit = MotionBounds.of(request.model).velocity
        known = np.isfinite(limit)
        # Speeds to the start pose as parts of the axes' maximum, 0.1 without a velocity limit.
        parts = request.approach_speed[known] / limit[known]
        tolerance = f"{request.start_tolerance.min():g}"
        source = render(
            "fri_client.cpp.j2",
            preamble=comment_lines(head, "//"),
            motion_class=render_motion_class(request),
            slowdown=f"{DRY_RUN_SLOWDOWN:.1f}",
            tolerance=tolerance,
            # A command may be faster than the motion by this factor, and by `fade_speed` [rad/s]
            # for the offset from the start pose that fades meanwhile.
            top_speed=format_numbers(1.05 * request.motion.peaks(1) + 1e-6),
            fade_speed="0.02",
            table=table,
            java_class=java,
            log=f"{stem}_log.csv",
            dry_run_log=f"{stem}_dry_run_log.csv",
        )
        application = render(
            "FriHold.java.j2",
            preamble=comment_lines(head, " *"),
            package=PACKAGE,
            class_name=java,
            interval=request.period_ms,
            approach=format_rounded_down(float(parts.min(initial=0.1))),
            tolerance=tolerance,
            start=format_numbers(request.motion.start),
        )
        sheet = format_sheet(
            request,
            (f"Written by {client} in every cycle of the FRI.", SIGN_NOTE),
            {
                "joints": list(request.model.joint_names),
                "torque_source": "sensor",
                "sign": -1,
                "columns": {
                    "time": "t",
                    "position": "q_1-q_7",
                    "torque": "tau_1-tau_7",
                    "extra": {"tau_ext": "tau_ext_1-tau_ext_7"},
                },
                "units": {"time": "s", "position": "rad", "torque": "N m"},
            },
        )
        return (
            ProgramFile("program", client, source),
            ProgramFile("motion", table, format_streamed_motion(request)),
            ProgramFile("application", f"{java}.java", application),
            ProgramFile("sheet", f"{stem}_log.toml", sheet),
        )


PROGRAM_FORMATS.register(FriFormat.key, FriFormat())
