"""Identification of a robot of a fleet from its ledger alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from asbuilt.apps.fleet.ledger.entry import Entry, join_entries
from asbuilt.apps.fleet.ledger.ledger import Ledger, open_ledger
from asbuilt.apps.fleet.options import FleetIdentification
from asbuilt.apps.fleet.siblings import (
    SIBLINGS,
    SiblingPrior,
    build_sibling_prior,
    derive_posterior_uncertainty,
    estimate_with_siblings,
)
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.findings import Cure, Finding, rank_findings
from asbuilt.identification import (
    EstimationData,
    IdentificationResult,
    conclude,
    design_values,
    estimate_block_uncertainty,
    methods,
)
from asbuilt.workflow import Study

MOST_BLOCKS = 96
"""Time blocks of all logs together; more are merged with their neighbours. Standard errors need
some dozens, and take a millisecond each."""


def fleet_identify(
    ledger: Ledger | str | Path,
    robot_id: str,
    *,
    since: datetime | None = None,
    until: datetime | None = None,
    options: FleetIdentification | None = None,
) -> Study:
    """Identify a robot from the ledger alone, in milliseconds.

    `identify` gives the same parameters, to rounding, on the same logs with the same method, signal
    chain and drive terms. Standard errors agree too if the logs are 80 s or shorter; longer ones
    have 16 time blocks each in the ledger.

    Parameters
    ----------
    ledger
        A ledger, its folder or URL.
    robot_id
        Identity of the robot.
    since, until
        Logs with `since <= date < until` count; None: all.
    options
        How to identify.

    Returns
    -------
    Study
        The result with findings; it has no predictions, since a ledger has no samples.

    Raises
    ------
    UsageError
        If there is no ledger or no such robot.
    IdentifiabilityError
        If it has no sound log in these dates, or the logs do not suffice.
    """
    opened = ledger if isinstance(ledger, Ledger) else open_ledger(str(ledger))
    entries = opened.entries(robot_id, since, until)
    if not entries:
        raise _make_missing_error(opened, robot_id, since, until)
    chosen = options or FleetIdentification()
    prior = build_sibling_prior(opened, robot_id, entries) if chosen.prior == "siblings" else None
    result = identify_entries(entries, chosen, prior)
    findings = [*result.findings, *opened.findings, *_report_logs(entries)]
    return Study(result, rank_findings(findings))


def identify_entries(
    entries: Sequence[Entry],
    options: FleetIdentification,
    prior: SiblingPrior | None = None,
) -> IdentificationResult:
    """Identify a robot from entries of one type, with a prior of its siblings if there is one.

    Raises
    ------
    IdentifiabilityError
        If the entries are of two types, or do not suffice.
    """
    first = entries[0]
    last = entries[-1]
    settings = first.settings
    odd = next((entry for entry in entries if entry.settings.digest != settings.digest), None)
    if odd is not None:
        raise IdentifiabilityError(
            f"{odd.robot_id} has logs of two types of robot: {settings.robot_type} and"
            f" {odd.settings.robot_type}",
            cure=Cure("give each robot an identity of its own, or choose dates of one of them"),
        )
    information = join_entries(entries, MOST_BLOCKS)
    design = design_values(settings.model, settings.base)
    data = EstimationData(settings.model, information, None, design, options.undetermined)
    estimate = None
    findings = tuple[Finding, ...]()
    if prior is not None:
        estimate, findings = estimate_with_siblings(first.robot_id, information, prior)
    if estimate is None:
        estimate = methods.find(options.method).estimate(data)
    return conclude(
        settings.model,
        information,
        estimate,
        rate=first.rate,
        uncertainty=(
            derive_posterior_uncertainty(information, estimate, prior)
            if prior is not None and estimate.method == SIBLINGS
            else estimate_block_uncertainty(estimate.information or information, estimate)
        ),
        provenance=(
            f"{len(entries)} logs of {first.robot_id} from {first.date:%Y-%m-%d} to"
            f" {last.date:%Y-%m-%d}, kept as information in a ledger",
            *settings.chosen,
        ),
        chain=settings.chain,
        findings=findings,
        digests=tuple(entry.source_sha256[:16] for entry in entries),
    )


def _report_logs(entries: Sequence[Entry]) -> list[Finding]:
    """Return a finding for each kind of warning of the logs, with their number."""
    counts = Counter(code for entry in entries for code in entry.warnings)
    return [
        Finding(
            code,
            "info",
            f"{count} of {len(entries)} logs had the warning {code} when they were added",
        )
        for code, count in sorted(counts.items())
    ]


def _make_missing_error(
    ledger: Ledger, robot_id: str, since: datetime | None, until: datetime | None
) -> UsageError | IdentifiabilityError:
    known = ledger.robot_ids()
    if robot_id not in known:
        shown = ", ".join(known[:10]) + (" ..." if len(known) > 10 else "") or "none yet"
        return UsageError(
            f"the ledger {ledger.root} has no robot {robot_id!r}; it has {shown}",
            value=robot_id,
            available=known[:100],
        )
    window = "".join(
        f" {word} {date:%Y-%m-%d %H:%M}"
        for word, date in (("since", since), ("before", until))
        if date
    )
    return IdentifiabilityError(
        f"the ledger {ledger.root} has no sound log of {robot_id}{window}"
        + "".join(f" ({finding.message})" for finding in ledger.findings[:1]),
        cure=Cure("choose other dates"),
    )
