"""Page of checked recordings: positions, torques, and what is wrong where."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from asbuilt.experiment.logs.long_recordings import head_of
from asbuilt.experiment.logs.recordings import Recorded
from asbuilt.experiment.quality.checks import RecordingCheck
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Finding
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.writers.figures.figure_style import figure_address
from asbuilt.writers.figures.recording_figure import recording_figure
from asbuilt.writers.files import atomic_write
from asbuilt.writers.reports.page import page


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
    parts = []
    for recording, check in zip(recordings, checks, strict=True):
        head = None if isinstance(recording, Samples) else head_of(recording)
        parts.append(
            {
                "name": recording_name(check.source),
                "mood": "bad" if check.errors else "" if check.warnings else "good",
                "headline": check.headline,
                "findings": [(each.severity, finding_text(each)) for each in check.findings],
                "image": _drawn(head, check),
            }
        )
    text = page(
        "check.html.j2",
        title=f"{checks[0].robot}: recordings checked",
        heading=checks[0].robot,
        subject="recordings checked",
        subtitle="",
        contents=[(f"log-{k}", part["name"]) for k, part in enumerate(parts)],
        parts=parts,
    )
    return {"page": atomic_write(folder / "check.html", text)}


def _drawn(recording: Recording | None, check: RecordingCheck) -> str:
    return "" if recording is None else figure_address(recording_figure(recording, check))
