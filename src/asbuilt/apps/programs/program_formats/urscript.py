"""Universal Robots: URScript that streams the motion with servoj, and what records it over RTDE."""

from __future__ import annotations

import re

from asbuilt.apps.programs.format import (
    DRY_RUN_SLOWDOWN,
    PROGRAM_FORMATS,
    ProgramFile,
    ProgramFormat,
    ProgramRequest,
)
from asbuilt.apps.programs.naming import make_lowercase_identifier, make_plain_text
from asbuilt.apps.programs.via_points import choose_hermite_knots
from asbuilt.apps.programs.wording import (
    DRY_RUN_PART,
    GAINS_TO_FILL_IN,
    comment_lines,
    compose_preamble,
    format_numbers,
    format_sheet,
    render,
)
from asbuilt.errors import MotionError

RATES = (125.0, 500.0)
"""Rates of the RTDE: CB3 and e-Series [Hz]."""

FIELDS = (
    "actual_q",
    "actual_qd",
    "actual_current",
    "target_q",
    "target_current",
    "target_moment",
    "joint_temperatures",
)
"""What is recorded: vectors of six."""


class UrScriptFormat(ProgramFormat):
    """A script per speed: cubics between points, servoj in every control cycle.

    It runs on CB3 and e-Series alike.
    """

    key = "urscript"
    title = "URScript program for Universal Robots"
    default_rate = 500.0
    n_joints = 6

    def files(self, request: ProgramRequest) -> tuple[ProgramFile, ...]:
        """Return both scripts, the RTDE recipe and the sheet of the log."""
        if (
            request.rate > RATES[1]
            or abs(RATES[1] / request.rate - round(RATES[1] / request.rate)) > 1e-9
        ):
            raise MotionError(
                "the RTDE of a UR delivers 500 Hz (e-Series) or 125 Hz (CB3), or a whole fraction;"
                f" {request.rate:g} Hz is none"
            )
        stem = request.stem
        recipe = f"{stem}_rtde.xml"
        use = (
            (
                f"Copy {stem}_dry_run.script and {stem}.script to the controller; in PolyScope add"
                " a Script node of type File with the one to run. Installation: payload and centre"
                " of gravity as mounted, safety limits active, speed slider at 100 % (a lower"
                " slider also works, and then the motion takes longer)."
            ),
            (
                f"{stem}_dry_run.script first, to its end. It stops and asks before it moves to the"
                " start pose, and again before the motion."
            ),
            (
                "Record with Universal Robots' RTDE client library: python record.py --host ROBOT"
                f" --frequency {request.rate:g} --config {recipe} --output {stem}_log.csv"
            ),
            (
                f"Then {stem}.script. The emergency stop and the stop button of the pendant stop"
                " the robot."
            ),
            (
                f"Keep {stem}_log.toml next to the log and enter the gains of your robot's joints:"
                f" asbuilt identify ROBOT {stem}_log.csv"
            ),
        )
        # How far the cubics between the points may leave the motion [rad].
        knots = choose_hermite_knots(request.motion, 1e-4)
        q = request.motion.derivative(knots[1:])
        v = request.motion.derivative(knots[1:], 1)
        values = {
            "preamble": comment_lines(compose_preamble(request, self.title, use), "#"),
            "approach_speed": f"{request.approach_speed.min():.4f}",
            "approach_acceleration": "0.3",  # rad/s^2
            "tolerance": f"{request.start_tolerance.min():g}",
            # servoj's lookahead_time [s] (0.03 to 0.2) and gain (100 to 2000).
            "look_ahead": "0.05",
            "gain": "600",
            "spacing": f"{knots[-1] / (knots.size - 1):.9f}",
            "start": format_numbers(request.motion.start, 7),
            "title": make_plain_text(request.name)[:40],
            "points": [
                (format_numbers(a, 7).replace(" ", ""), format_numbers(b, 7).replace(" ", ""))
                for a, b in zip(q, v, strict=True)
            ],
        }
        full = render(
            "urscript.script.j2",
            function=make_lowercase_identifier(request.name, prefix="asbuilt_"),
            kind="FULL SPEED",
            slowdown="1.0",
            duration=f"{request.motion.duration:.1f}",
            question="Did the dry run reach its end? Nobody within reach?",
            **values,
        )
        dry_run = render(
            "urscript.script.j2",
            function=make_lowercase_identifier(request.name, prefix="asbuilt_dry_run_"),
            kind=f"Dry run at {DRY_RUN_PART} of the speed",
            slowdown=f"{DRY_RUN_SLOWDOWN:.1f}",
            duration=f"{request.dry_run.duration:.1f}",
            question="Nobody within reach?",
            **values,
        )
        return (
            ProgramFile("program", f"{stem}.script", full),
            ProgramFile("dry_run", f"{stem}_dry_run.script", dry_run),
            ProgramFile("recipe", recipe, _write_recipe(request)),
            ProgramFile("sheet", f"{stem}_log.toml", _write_sheet(request)),
        )


def _write_recipe(request: ProgramRequest) -> str:
    fields = "\n".join(f'    <field name="{name}" type="VECTOR6D"/>' for name in FIELDS)
    name = make_plain_text(request.name)
    # No two hyphens together in a comment of XML.
    comment = re.sub(
        "-(?=-)",
        "- ",
        f"What to record of motion {name}, for Universal Robots' RTDE client library",
    )
    return (
        f'<?xml version="1.0"?>\n<!-- {comment} -->\n<rtde_config>\n  <recipe key="out">\n'
        f'    <field name="timestamp" type="DOUBLE"/>\n{fields}\n  </recipe>\n</rtde_config>\n'
    )


def _write_sheet(request: ProgramRequest) -> str:
    return format_sheet(
        request,
        (
            (
                "Written by record.py of Universal Robots' RTDE client library: joint currents [A],"
                " not torques."
            ),
            (
                "MISSING: the gains below. Without them torques stay in amperes and identify"
                " refuses them."
            ),
            (
                "With PolyScope 5.23 or later record actual_current_as_torque instead: N m already,"
                " torque_source is then motor."
            ),
        ),
        {
            "joints": list(request.model.joint_names),
            "torque_source": "current",
            "sign": 1,
            "columns": {
                "time": "timestamp",
                "position": "actual_q_0-actual_q_5",
                "velocity": "actual_qd_0-actual_qd_5",
                "torque": "actual_current_0-actual_current_5",
            },
            "units": {"time": "s", "position": "rad", "velocity": "rad/s", "torque": "A"},
        },
        gains=f"Gains: {GAINS_TO_FILL_IN}. Or give --gain g1,g2,...:",
    )


PROGRAM_FORMATS.register(UrScriptFormat.key, UrScriptFormat())
