"""Page of rollouts: errors, and measured and simulated motion joint by joint."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from asbuilt.description.model import RobotModel
from asbuilt.tables import format_share
from asbuilt.validation import Rollout, RolloutErrors, recording_name, rollout_findings
from asbuilt.validation.rollout.rollout import tabulate_joint_errors
from asbuilt.writers.files import atomic_write, data_address
from asbuilt.writers.pictures.rollout_animation import write_rollout_animation
from asbuilt.writers.reports.page import (
    Block,
    Card,
    Mood,
    cards_markup,
    image_markup,
    list_markup,
    render_page,
    section_markup,
    table_markup,
)
from asbuilt.writers.reports.sections.prediction import ROLLOUT, fill_rollout_fields


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
    logs = sorted({recording_name(each.source) for each in longest.by_recording})
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
    motion = section_markup(ROLLOUT, fill_rollout_fields(model, rollouts))
    return render_page(
        model.name,
        ", ".join(logs),
        [
            Block("verdict", "Verdict", (cards_markup(_make_cards(longest)), findings)),
            Block("animation", "Animation", moving),
            Block("motion", "Measured and simulated motion", (motion,), "Motion"),
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
