"""Pages of commands other than identify: of checked recordings, a designed motion, rollouts."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from PIL import Image

from asbuilt.description.model import RobotModel
from asbuilt.dynamics import described_drive, drive_torque, inverse_dynamics
from asbuilt.excitation import Design, MotionBounds, StaticDesign, design_findings
from asbuilt.excitation.limits import complete_limits
from asbuilt.experiment import Recorded, RecordingCheck, Samples, head_of
from asbuilt.findings import Cure
from asbuilt.tables import format_share
from asbuilt.validation import Rollout, RolloutErrors, rollout_findings
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.rollout.rollout import tabulate_joint_errors
from asbuilt.writers.figures.figure_style import encode_figure, open_figure
from asbuilt.writers.figures.study_figures import draw_recording
from asbuilt.writers.files import data_address
from asbuilt.writers.pictures.rollout_animation import write_rollout_animation
from asbuilt.writers.pictures.skeleton import MotionView, draw_skeleton_frames
from asbuilt.writers.reports.page import (
    Block,
    Card,
    Mood,
    cards_markup,
    facts_markup,
    image_markup,
    list_markup,
    paragraph_markup,
    render_page,
    section_markup,
    table_markup,
)
from asbuilt.writers.reports.sections.prediction import rollout_markup
from asbuilt.writers.tables.design_tables import (
    describe_margins,
    design_facts,
    design_table,
    design_title,
    tabulate_margins,
)
from asbuilt.writing import atomic_write

POINTS = 400
"""Points of a curve; the page stays below 2 MB."""

JOINTS = """\
<div class="grid">
{% for name, image in joints %}
<figure><h3>{{ name }}</h3><img class="drawn" src="{{ image }}" alt="Position, velocity,\
 acceleration and torque of {{ name }} over time, with limits"></figure>
{% endfor %}
</div>
<p class="quiet">Dashed: limits. The torque follows the description, drive values included.</p>
"""
CURVE = "#0072b2"
LIMIT = "#b3261e"


def write_motion_report(path: str | os.PathLike[str], design: Design | StaticDesign) -> Path:
    """Write the page of a designed motion as a self-contained HTML file."""
    return atomic_write(path, render_motion(design))


def render_motion(design: Design | StaticDesign) -> str:
    """Return the page of a designed motion; it needs no network, and every name is escaped."""
    limits = design.limits
    remarks = [
        ("" if limits.is_respected else "bad", describe_margins(limits)),
        *(
            ("" if finding.severity == "info" else "bad", finding.message)
            for finding in design_findings(design)
        ),
    ]
    title = "Predicted standard errors" if isinstance(design, Design) else "Poses"
    drawn = zip(
        design.model.joint_names, map(encode_figure, draw_joint_figures(design)), strict=True
    )
    return render_page(
        design.model.name,
        design_title(design),
        [
            Block(
                "verdict",
                "Verdict",
                (
                    list_markup(remarks),
                    facts_markup(design_facts(design)),
                    table_markup(tabulate_margins(limits), "margins"),
                ),
            ),
            Block("path", "Path of the tool", (_draw_path(design),), "Path"),
            Block(
                "joints-drawn",
                "Joints and their limits",
                (section_markup(JOINTS, {"joints": drawn}),),
                "Joints",
            ),
            Block("parameters", title, (table_markup(design_table(design), "rows"),)),
        ],
        title=f"{design.model.name}: designed motion",
    )


def draw_joint_figures(design: Design | StaticDesign) -> list[Figure]:
    """Draw position, velocity, acceleration and torque of each joint against their limits."""
    model = design.model
    motion = design.motion
    bounds = MotionBounds.of(complete_limits(model)[0])
    t = np.linspace(0.0, motion.duration, POINTS)
    q, qd, qdd = motion.at(t)
    drive, values = described_drive(model)
    rigid = inverse_dynamics(model, q, qd, qdd)
    torque = rigid + drive_torque(drive, values, q, qd, qdd, load=rigid, shares=model.motor_shares)
    upper = (bounds.upper, bounds.velocity, bounds.acceleration, bounds.torque)
    lower = (bounds.lower, *(-limit for limit in upper[1:]))
    figures = []
    for j, joint in enumerate(model.joints):
        unit = joint.unit
        names = (
            f"position\n{unit}",
            f"velocity\n{unit}/s",
            f"acceleration\n{unit}/s\u00b2",
            f"torque\n{joint.torque_unit}",
        )
        with open_figure(4.6, 5.4, rows=4, sharex=True) as (figure, all_axes):
            curves = zip(all_axes, (q, qd, qdd, torque), lower, upper, names, strict=True)
            for axes, x, low, high, name in curves:
                axes.plot(t, x[:, j], color=CURVE, linewidth=1.1)
                for limit in (low[j], high[j]):
                    if np.isfinite(limit):
                        axes.axhline(limit, color=LIMIT, linewidth=0.9, linestyle=(0, (4, 2)))
                axes.set_ylabel(name)
                axes.margins(x=0.0)
            all_axes[-1].set_xlabel("time [s]")
            figure.align_ylabels(all_axes)
        figures.append(figure)
    return figures


def _draw_path(design: Design | StaticDesign) -> Markup:
    """Return a drawing of the skeleton at the start and the path of the tool."""
    view = MotionView.of_motion(design.model, design.motion, most=2).first()
    stream = io.BytesIO()
    Image.fromarray(next(draw_skeleton_frames(view, 900, 675))).save(stream, "PNG")
    return image_markup(
        data_address(stream.getvalue(), "image/png"),
        "The robot at the start of the motion, and the path of its tool in space",
    )


def write_check_page(
    folder: Path,
    recordings: Sequence[Recorded],
    checks: Sequence[RecordingCheck],
    cure_text: Callable[[Cure], str] = str,
) -> dict[str, Path]:
    """Write check.html, which draws each recording with its findings; return its path by kind.

    Of a long recording the beginning is drawn. `cure_text` writes a cure, for an interface
    that adds the names of its options.
    """
    blocks = []
    for k, (recording, check) in enumerate(zip(recordings, checks, strict=True)):
        mood = "bad" if check.errors else "" if check.warnings else "good"
        parts = [
            paragraph_markup(check.headline, f"verdict {mood}"),
            list_markup(
                (finding.severity, finding.as_line(cure_text)) for finding in check.findings
            ),
        ]
        if not isinstance(recording, Samples):
            parts.append(
                image_markup(
                    encode_figure(draw_recording(head_of(recording), check)),
                    "Position and torque of every joint over time, with lines where findings begin;"
                    " the findings are listed above",
                )
            )
        blocks.append(Block(f"log-{k}", recording_name(check.source), parts))
    text = render_page(checks[0].robot, "recordings checked", blocks)
    return {"page": atomic_write(folder / "check.html", text)}


def write_rollouts(
    model: RobotModel, rollouts: Sequence[Rollout], folder: Path | None, animation: Path | None
) -> dict[str, Path]:
    """Write the animation of the longest rollouts, and their page into a folder; paths by kind."""
    files: dict[str, Path] = {}
    if rollouts and animation is not None:
        files["animation"] = write_rollout_animation(animation, model, rollouts[-1])
    if rollouts and folder is not None:
        files["rollout"] = atomic_write(
            folder / "rollout.html", render_rollouts(model, rollouts, animation=animation)
        )
    return files


def render_rollouts(
    model: RobotModel, rollouts: Sequence[Rollout], *, animation: Path | None = None
) -> str:
    """Return the page of rollouts as text."""
    longest = rollouts[-1]
    logs = sorted({recording_name(recording.source) for recording in longest.by_recording})
    moving = []
    if animation is not None:
        kind = f"image/{animation.suffix.lower().removeprefix('.')}"
        words = "The measured robot in grey, the simulated one as lines"
        moving.append(image_markup(data_address(animation.read_bytes(), kind), words))
    joints = [
        table_markup(tabulate_joint_errors(model, rollout), f"joints-{k}")
        for k, rollout in enumerate(rollouts)
    ]
    findings = list_markup(finding.text for finding in rollout_findings(rollouts))
    return render_page(
        model.name,
        ", ".join(logs),
        [
            Block("verdict", "Verdict", (cards_markup(_make_cards(longest)), findings)),
            Block("animation", "Animation", moving),
            Block(
                "motion",
                "Measured and simulated motion",
                (rollout_markup(model, rollouts),),
                "Motion",
            ),
            Block("by-joint", "Joint by joint", joints, "Joints"),
        ],
        title=f"{model.name}: rollout",
    )


def _make_cards(rollout: Rollout) -> list[Card]:
    horizon = f"over {rollout.horizon:g} s"
    cad = rollout.cad
    built = rollout.as_built
    better = cad is not None and built is not None and built.rms_all_until < cad.rms_all_until
    rows: tuple[tuple[Mood, RolloutErrors | None, str], ...] = (
        ("neutral", cad, f"error of the simulation by CAD {horizon}"),
        ("good" if better else "bad", built, f"error of the simulation as built {horizon}"),
        (
            "neutral",
            rollout.no_physics,
            f"error of the delayed command without physics {horizon}",
        ),
        ("neutral", rollout.floor, "between repetitions of a command"),
    )
    cards = [Card(mood, errors.text, label) for mood, errors, label in rows if errors is not None]
    if better and cad is not None and built is not None:
        less = 1.0 - built.rms_all_until / cad.rms_all_until
        until = f" over {built.until:.2g} s" if cad.diverged or built.diverged else ""
        cards.append(Card("good", format_share(less), f"less error than CAD{until}"))
    return cards
