"""KUKA FRI: a C++ client that streams the motion, and the Java application of the session."""

from __future__ import annotations

import numpy as np

from asbuilt.excitation.limits import MotionBounds
from asbuilt.writers.programs.format import (
    DRY_RUN_SLOWDOWN,
    PROGRAM_FORMATS,
    ProgramFile,
    ProgramFormat,
    ProgramRequest,
)
from asbuilt.writers.programs.formats.sunrise import PACKAGE, SIGN_NOTE
from asbuilt.writers.programs.naming import make_class_name
from asbuilt.writers.programs.program_text import (
    STREAMED_DECIMALS,
    comment_lines,
    compose_preamble,
    format_numbers,
    format_rounded_down,
    format_sheet,
    format_streamed_motion,
    render,
)

SPEED_ALLOWANCE = 1.05
"""A command may be faster than the motion by this factor ..."""

FADE_SPEED = 0.02
"""... and by this much for the offset from the start pose that fades meanwhile [rad/s]."""

APPROACH_PART = 0.1
"""Speed to the start pose as a part of the axes' maximum where the description gives no velocity
limit.
"""


class FriFormat(ProgramFormat):
    """Client for KUKA's FRI SDK that commands joint positions in every cycle."""

    key = "fri"
    title = "KUKA FRI client (C++) with its Sunrise application (Java)"
    default_rate = 200.0
    n_joints = 7

    def files(self, request: ProgramRequest) -> tuple[ProgramFile, ...]:
        """Return client, table, Java application and the sheet of the client's log."""
        stem, java = request.stem, make_class_name(request.name, suffix="FriHold")
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
        approach = (
            min(APPROACH_PART, float((request.approach_speed[known] / limit[known]).min()))
            if np.any(known)
            else APPROACH_PART
        )
        values = {
            "start": format_numbers(request.motion.start, STREAMED_DECIMALS),
            "tolerance": f"{request.start_tolerance.min():g}",
        }
        table_class = render(
            "motion_table.hpp.j2",
            n_joints=request.model.n_joints,
            duration=f"{request.motion.duration:.9f}",
            start=values["start"],
        )
        source = render(
            "fri_client.cpp.j2",
            preamble=comment_lines(head, "//"),
            motion_class=table_class,
            slowdown=f"{DRY_RUN_SLOWDOWN:.1f}",
            tolerance=values["tolerance"],
            top_speed=format_numbers(SPEED_ALLOWANCE * request.motion.peaks(1) + 1e-6),
            fade_speed=f"{FADE_SPEED:g}",
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
            approach=format_rounded_down(approach),
            tolerance=values["tolerance"],
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
