"""Page of checked recordings: positions, torques, and what is wrong where."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from asbuilt.experiment.logs.long_recordings import head_of
from asbuilt.experiment.logs.recordings import Recorded
from asbuilt.experiment.quality.checks import RecordingCheck
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Finding
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.writers.figures.figure_style import figure_address
from asbuilt.writers.figures.recording_figure import recording_figure
from asbuilt.writers.files import atomic_write
from asbuilt.writers.reports.page import (
    Block,
    image_markup,
    list_markup,
    page,
    paragraph_markup,
)

DRAWN = (
    "Position and torque of every joint over time, with lines where findings begin; the findings"
    " are listed above"
)


def write_check_page(
    folder: Path,
    recordings: Sequence[Recorded],
    checks: Sequence[RecordingCheck],
    finding_text: Callable[[Finding], str] = str,
) -> dict[str, Path]:
    """Write check.html, which draws each recording with its findings; return its path by kind.

    Of a long recording the beginning is drawn. `finding_text` writes a finding, for an interface
    that adds the names of its options.
    """
    blocks = []
    for k, (recording, check) in enumerate(zip(recordings, checks, strict=True)):
        mood = "bad" if check.errors else "" if check.warnings else "good"
        parts = [
            paragraph_markup(check.headline, f"verdict {mood}"),
            list_markup((each.severity, finding_text(each)) for each in check.findings),
        ]
        if not isinstance(recording, Samples):
            address = figure_address(recording_figure(head_of(recording), check))
            parts.append(image_markup(address, DRAWN))
        blocks.append(Block(f"log-{k}", recording_name(check.source), parts))
    text = page(checks[0].robot, "recordings checked", blocks)
    return {"page": atomic_write(folder / "check.html", text)}
