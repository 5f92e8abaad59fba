"""The page of checked recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from asbuilt.experiment import Recorded, RecordingCheck, Samples, head_of
from asbuilt.findings import Cure
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.writers.figures.figure_style import encode_figure
from asbuilt.writers.figures.recording_figures import draw_recording
from asbuilt.writers.files import atomic_write
from asbuilt.writers.reports.page import (
    Block,
    image_markup,
    list_markup,
    paragraph_markup,
    render_page,
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
