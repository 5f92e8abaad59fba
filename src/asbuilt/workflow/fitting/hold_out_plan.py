"""What a study holds out by default, and what it says of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from asbuilt.experiment.logs.recordings import Recorded
from asbuilt.experiment.signal.hold_out import SHORTEST_DIVIDED
from asbuilt.findings import Cure, Finding
from asbuilt.workflow.options import AUTOMATIC, StudyOptions
from asbuilt.workflow.prepare import Prepared, measure_shortest, settle_rule


def with_settled_holdout(
    options: StudyOptions, recordings: Sequence[Recorded], validation: Sequence[Recorded]
) -> StudyOptions:
    """Return options whose `holdout` stays automatic only if a part can be held out by default.

    Other recordings to validate on take the place of what would be held out. A refinement, which
    would take twice as long, is fitted to the training part alone.
    """
    if options.holdout != AUTOMATIC:
        return options
    if validation or settle_rule(recordings, AUTOMATIC) is None:
        return replace(options, holdout=None)
    if options.refine is not None:
        return replace(options, holdout=settle_rule(recordings, AUTOMATIC))
    return options


def hold_out_findings(
    wanted: StudyOptions, prepared: Prepared, recordings: Sequence[Recorded], validated: bool
) -> tuple[Finding, ...]:
    """Return what a study with such options says of what it held out by default.

    `validated` says whether there is anything to validate on.
    """
    if wanted.holdout != AUTOMATIC:
        return ()
    if prepared.whole:
        return (
            Finding(
                "final_fit",
                "info",
                f"Held-out errors are of a fit without what was held out ({prepared.holdout});"
                " parameters, their errors and the training error are of the final fit to"
                " everything",
            ),
        )
    if validated:
        return ()
    seconds = measure_shortest(recordings)
    why = (
        f"{seconds:.3g} s are too short to hold out a part ({SHORTEST_DIVIDED:g} s)"
        if seconds < SHORTEST_DIVIDED
        else f"too little of {seconds:.3g} s is left if a part is held out and filtered"
    )
    return (
        Finding(
            "nothing_held_out",
            "warning",
            f"No validation data: {why}; errors are those of the training data and are too small",
            Cure("validate on another recording, or record longer"),
        ),
    )
