"""Page of rollouts: errors, and measured beside simulated motion joint by joint."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

from asbuilt.description.model import RobotModel
from asbuilt.tables import share
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.rollout.rollout import Rollout, rollout_findings
from asbuilt.writers.files import atomic_write
from asbuilt.writers.pictures.rollout_animation import write_rollout_animation
from asbuilt.writers.reports.page import page, section_markup, table_markup
from asbuilt.writers.reports.report_verdict import Card, Mood
from asbuilt.writers.reports.sections.rollout import TEMPLATE, rollout_fields
from asbuilt.writers.tables.rollout_tables import error_text, joint_table, position_unit


def write_rollouts(
    model: RobotModel, rollouts: Sequence[Rollout], folder: Path | None, animation: Path | None
) -> dict[str, Path]:
    """Write the animation of the longest rollouts, and their page into a folder; paths by kind."""
    files: dict[str, Path] = {}
    if rollouts and animation is not None:
        files["animation"] = write_rollout_animation(animation, model, rollouts[-1])
    if rollouts and folder is not None:
        path = folder / "rollout.html"
        files["rollout"] = write_rollout_page(path, model, rollouts, animation=animation)
    return files


def write_rollout_page(
    path: str | Path,
    model: RobotModel,
    rollouts: Sequence[Rollout],
    *,
    animation: Path | None = None,
) -> Path:
    """Write the page of rollouts as a self-contained HTML file, with an animation if given."""
    return atomic_write(path, rollout_html(model, rollouts, animation=animation))


def rollout_html(
    model: RobotModel, rollouts: Sequence[Rollout], *, animation: Path | None = None
) -> str:
    """Return the page of rollouts as text."""
    longest = rollouts[-1]
    logs = sorted({recording_name(each.source) for each in longest.by_recording})
    moving = "" if animation is None else _address(animation)
    return page(
        "rollout.html.j2",
        title=f"{model.name}: rollout",
        heading=model.name,
        subject=", ".join(logs),
        subtitle="",
        contents=[
            ("verdict", "Verdict"),
            *([("animation", "Animation")] if moving else []),
            ("motion", "Motion"),
            ("by-joint", "Joints"),
        ],
        cards=_cards(model, longest),
        findings=[each.text for each in rollout_findings(rollouts)],
        animation=moving,
        motion=section_markup(TEMPLATE, rollout_fields(model, rollouts)),
        joints=[
            table_markup(joint_table(model, each), f"joints-{k}") for k, each in enumerate(rollouts)
        ],
    )


def _cards(model: RobotModel, rollout: Rollout) -> list[Card]:
    unit, horizon = position_unit(model), f"over {rollout.horizon:g} s"
    cad, built = rollout.cad, rollout.as_built
    better = cad is not None and built is not None and built.rms_all_until < cad.rms_all_until
    cards = []
    for name, errors in (("by CAD", rollout.cad), ("as built", rollout.as_built)):
        if errors is not None:
            mood: Mood = "neutral" if name == "by CAD" else "good" if better else "bad"
            said = f"error of the simulation {name} {horizon}"
            cards.append(Card(mood, error_text(errors, unit), said))
    if rollout.no_physics is not None:
        said = f"error of the delayed command without physics {horizon}"
        cards.append(Card("neutral", error_text(rollout.no_physics, unit), said))
    if rollout.floor is not None:
        said = "between repetitions of a command"
        cards.append(Card("neutral", error_text(rollout.floor, unit), said))
    if better and cad is not None and built is not None:
        less = 1.0 - built.rms_all_until / cad.rms_all_until
        until = f" over {built.until:.2g} s" if cad.diverged or built.diverged else ""
        cards.append(Card("good", share(less), f"less error than CAD{until}"))
    return cards


def _address(path: Path) -> str:
    """Return a file as the address of a picture that a page holds itself."""
    kind = path.suffix.lower().removeprefix(".")
    return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
