"""Texts of every program: templates filled in, header, and the sheet of its log."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from math import floor
from typing import Any

import numpy as np
import tomli_w
from jinja2 import Environment, PackageLoader, StrictUndefined

from asbuilt.apps.programs.format import DRY_RUN_SLOWDOWN, ProgramRequest
from asbuilt.apps.programs.naming import make_plain_text
from asbuilt.excitation import Motion, times_to_end

ENVIRONMENT = Environment(
    loader=PackageLoader("asbuilt.apps.programs"),
    undefined=StrictUndefined,
    autoescape=False,
    keep_trailing_newline=True,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(template: str, **values: Any) -> str:
    """Return a template filled in.

    A value that the template needs and does not get is an error.
    """
    return ENVIRONMENT.get_template(template).render(**values)


def format_numbers(values: Iterable[float], decimals: int = 6) -> str:
    """Return numbers with a fixed count of decimals, separated by commas; no minus before zero.

    Examples
    --------
    >>> format_numbers([1.0, -0.25, -1e-9], 3)
    '1.000, -0.250, 0.000'
    """
    return ", ".join(f"{round(float(value), decimals) + 0.0:.{decimals}f}" for value in values)


def format_rounded_down(value: float) -> str:
    """Return a positive number with four decimals, rounded down as a limit must be.

    Examples
    --------
    >>> format_rounded_down(0.06999), format_rounded_down(0.5)
    ('0.0699', '0.5000')
    """
    return f"{floor(value * 10**4 + 1e-9) / 10**4:.4f}"


def format_motion_csv(motion: Motion, columns: Sequence[str], rate: float, decimals: int) -> str:
    """Return times and the first `columns` of positions, velocities, accelerations as CSV.

    The end of the motion is the last line whatever the rate.
    """
    t = times_to_end(motion, rate)
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(["t", *columns])
    rows = np.round(np.hstack(motion.at(t))[:, : len(columns)], decimals) + 0.0
    for time, row in zip(t, rows, strict=True):
        text.write(f"{time:.6f}," + ",".join(f"{value:.{decimals}f}" for value in row) + "\n")
    return text.getvalue()


def format_streamed_motion(request: ProgramRequest) -> str:
    """Return the table that programs in C++ read: `t,q1,...,qn,qd1,...,qdn`."""
    numbers = [*range(1, request.model.n_joints + 1)]
    names = [f"{symbol}{j}" for symbol in ("q", "qd") for j in numbers]
    return format_motion_csv(request.motion, names, request.rate, STREAMED_DECIMALS)


def render_motion_class(request: ProgramRequest) -> str:
    """Return the class with which programs in C++ read and interpolate that table."""
    return render(
        "motion_table.hpp.j2",
        n_joints=request.model.n_joints,
        duration=f"{request.motion.duration:.9f}",
        start=format_numbers(request.motion.start, STREAMED_DECIMALS),
    )


STREAMED_DECIMALS = 12
"""Decimals of streamed positions and velocities: differences at 1 kHz give a clean jerk."""

EMPTY = ("", "")
"""Line between two paragraphs of the header."""

WIDTH = 100
"""Longest line of the header."""

DRY_RUN_PART = f"{100 / DRY_RUN_SLOWDOWN:g} %"
"""Speed of the dry run as text."""


def compose_preamble(request: ProgramRequest, title: str, use: Sequence[str]) -> tuple[str, ...]:
    """Return the lines of the header; `use` says step by step how the program is run.

    ASCII, no line longer than `WIDTH`.
    """
    model = request.model
    motion = request.motion
    names = [make_plain_text(name) for name in model.joint_names]
    start = ", ".join(f"{q:.4f}" for q in motion.start)
    degrees = ", ".join(f"{q:.2f}" for q in np.rad2deg(motion.start))
    length = "m" if not any(request.revolute) else "rad" if all(request.revolute) else "rad or m"
    facts = [
        ("", f"{title}, written by asbuilt"),
        (
            "Robot:    ",
            f"{make_plain_text(model.name)}, {model.n_joints} joints: {', '.join(names)}",
        ),
        (
            "Motion:   ",
            f"{make_plain_text(request.name)} ({make_plain_text(motion.parametrisation)})",
        ),
        (
            "Duration: ",
            (
                f"{motion.duration:.3f} s; the dry run takes"
                f" {DRY_RUN_SLOWDOWN * motion.duration:.1f} s ({DRY_RUN_PART} of the speed)"
            ),
        ),
        ("Rate:     ", f"{request.rate:g} Hz"),
        (
            "Start:    ",
            f"{start} {length}" + (f" ({degrees} deg)" if all(request.revolute) else ""),
        ),
        ("Approach: ", f"to the start pose at no more than {_describe_approach(request)}"),
    ]
    limits = [
        (
            "",
            "Smallest margins to the limits of the description on a 1 kHz grid (0 %: limit):",
        )
    ]
    for quantity, margin in request.report.worst.items():
        label = f"  {quantity + ':':<14}"
        if margin is None:
            limits.append((label, "NOT CHECKED, the description gives no limit"))
            continue
        place = (
            f"{make_plain_text(margin.joint)} at {margin.time:.2f} s: {margin.value:.4g}, limit"
            f" {margin.limit:.4g} {margin.unit}"
        )
        limits.append((label, f"{100 * margin.margin:5.1f} %  {place}"))
        known = {margin.joint for margin in request.report.margins if margin.quantity == quantity}
        missing = [make_plain_text(name) for name in model.joint_names if name not in known]
        if missing:
            limits.append((" " * len(label), f"NOT CHECKED for {', '.join(missing)}"))
    safety = [
        ("", "SAFETY"),
        ("- ", _describe_checks(request)),
        (
            "- ",
            (
                "The description must have the robot's own zero positions and directions of motion:"
                " jog each joint a little and compare its sign and value with the controller's."
            ),
        ),
        (
            "- ",
            (
                "Keep the whole motion range clear and everybody out of reach. One person at the"
                " emergency stop watches the robot, not the screen."
            ),
        ),
        (
            "- ",
            (
                "Run the dry run first, to its end, each time anything has changed: the robot, its"
                " tool, its mounting, its surroundings, this file."
            ),
        ),
    ]
    steps = [
        ("", "HOW TO RUN"),
        *((f"{k}. ", make_plain_text(step)) for k, step in enumerate(use, start=1)),
    ]
    return tuple(
        line
        for label, text in (*facts, EMPTY, *limits, EMPTY, *safety, EMPTY, *steps)
        for line in wrap_lines(text, label) or [""]
    )


def _describe_approach(request: ProgramRequest) -> str:
    """Return the top speeds of the approach, with their joints if they differ."""
    speeds = [
        f"{speed:.3g} {'rad/s' if turns else 'm/s'}"
        for turns, speed in zip(request.revolute, request.approach_speed, strict=True)
    ]
    if len(set(speeds)) == 1:
        return f"{speeds[0]} per joint"
    named = [*zip(map(make_plain_text, request.model.joint_names), speeds, strict=True)]
    return "; ".join(
        f"{speed} ({', '.join(name for name, own in named if own == speed)})"
        for speed in dict.fromkeys(speeds)
    )


def _describe_checks(request: ProgramRequest) -> str:
    """Return what is checked and what is not."""
    limits = "Checked: the joint limits above, on the description of the robot."
    load = "nor the load of a tool that is not in the description."
    known = request.clearance
    if known is None:
        return (
            f"{limits} NOT checked: collisions of the robot with itself, with its tool, with cables"
            " or with anything around it, neither on the motion nor on the approach to its start"
            f" pose; {load}"
        )
    around = f" and the obstacles {', '.join(known.obstacles)}" if known.obstacles else ""
    touching = (
        f" Pairs that touch in nearly every pose were left out: {', '.join(known.left_out)}."
        if known.left_out
        else ""
    )
    return make_plain_text(
        f"{limits} Checked on the motion: bodies of the robot{around}, as {known.source} has them,"
        f" keep at least {1000 * known.distance:.0f} mm from each other.{touching} NOT checked:"
        f" collisions on the approach to the start pose; collisions with anything that"
        f" {known.source} does not contain, such as tool, cables and surroundings; {load}"
    )


def wrap_lines(text: str, label: str = "") -> list[str]:
    """Return the text in lines of at most `WIDTH` characters behind a label; names stay whole."""
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=label,
        subsequent_indent=" " * len(label),
        break_on_hyphens=False,
    )


def comment_lines(lines: Sequence[str], mark: str) -> str:
    """Return the lines as comments that begin with `mark`."""
    return "\n".join(f"{mark} {line}".rstrip() for line in lines)


GAINS_TO_FILL_IN = (
    "fill in the N m per ampere of your robot's joints and take away the mark; `asbuilt gains`"
    " finds them from a payload of known mass"
)


def format_sheet(
    request: ProgramRequest,
    comments: Sequence[str],
    fields: Mapping[str, Any],
    *,
    gains: str | None = None,
) -> str:
    """Return a recording sheet (TOML) for the log of the program, with comments above.

    `gains` says what belongs into the line of gains that waits to be filled in.
    """
    title = f"Recording sheet for the log of motion {request.name} on {request.model.name}."
    lines = [
        line for comment in (title, *comments) for line in wrap_lines(make_plain_text(comment))
    ]
    scalars, tables = (
        {key: value for key, value in fields.items() if isinstance(value, Mapping) == nested}
        for nested in (False, True)
    )
    text = tomli_w.dumps(scalars)
    if gains is not None:
        places = ", ".join(f"g{k}" for k in range(1, request.model.n_joints + 1))
        text += (
            comment_lines([*wrap_lines(make_plain_text(gains)), f"gains = [{places}]"], "#") + "\n"
        )
    parts = [comment_lines(lines, "#") + "\n", text, *([tomli_w.dumps(tables)] if tables else [])]
    return "\n".join(parts)
