"""Findings of a study in few: one for each cause, the most consequential first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from asbuilt.findings import SEVERITIES, Finding, join_names

CAUSES = (
    "effect_found",
    "clock_wrong",
    "zero_position_wrong",
    "joint_gain_wrong",
    "sensor_crosstalk",
    "torque_does_not_follow",
    "torque_saturates",
)
EXPLAINED: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "consistent_fit_costly": CAUSES,
        "consistent_fit_rejected": CAUSES,
        "weak_excitation": ("ill_conditioned", "poorly_determined"),
        "ill_conditioned": ("poorly_determined",),
        "few_blocks": ("poorly_determined",),
        "joints_correlated": ("poorly_determined",),
        "link_mass_differs": CAUSES,
        "not_excited": ("joint_without_torque",),
        **dict.fromkeys(
            ("does_not_generalise", "cad_predicts_better", "error_at_standstill"),
            ("payload_in_log",),
        ),
        "joint_masses_differ": ("payload_in_log",),
    }
)
"""Findings that follow from another one, or repeat it; with it they are good to know only."""

WEIGHT: tuple[str, ...] = (
    "payload_in_log",
    "joint_without_torque",
    "gravity_absent",
    "gravity_partial",
    "gravity_direction",
    "torque_scale",
    "joint_torque_scale",
    "clock_wrong",
    "torque_does_not_follow",
    "zero_position_wrong",
    "joint_gain_wrong",
    "sensor_crosstalk",
    "torque_saturates",
    "torque_unexplained",
    "consistent_fit_rejected",
    "consistent_fit_costly",
    "effect_found",
    "does_not_generalise",
    "cad_predicts_better",
    "link_mass_differs",
    "poorly_determined",
)
"""Warnings that change torques or parameters most, in this order; others follow them."""
MOST_NAMED = 4
APART = ("note", "effect_found", "sensor_crosstalk")
"""Findings of one code that each say something else."""


def consolidate_findings(
    findings: Sequence[Finding], shares: Mapping[str, float] = MappingProxyType({})
) -> tuple[Finding, ...]:
    """Return findings merged by cause and ranked: errors first, then by torque.

    Of warnings and information of one code, at several joints or in several recordings, one is
    left that names them. What another warning explains (`EXPLAINED`) is information.

    Parameters
    ----------
    findings
        The findings.
    shares
        Share of the squared torque error at each joint, by name, for findings at a joint
        which has none of its own.
    """
    merged = _merge_findings(findings)
    present = {finding.code for finding in merged if finding.severity != "info"}
    # What is explained by another warning is good to know, and no alarm.
    kept_findings = [
        replace(finding, severity="info")
        if finding.severity == "warning" and present.intersection(EXPLAINED.get(finding.code, ()))
        else finding
        for finding in (_add_torque(finding, shares) for finding in merged)
    ]
    return tuple(sorted(kept_findings, key=_rank_finding))


def _add_torque(finding: Finding, shares: Mapping[str, float]) -> Finding:
    if finding.torque is not None or finding.joint is None:
        return finding
    return replace(finding, torque=shares.get(finding.joint))


def _rank_finding(finding: Finding) -> tuple[int, float, int]:
    weight = WEIGHT.index(finding.code) if finding.code in WEIGHT else len(WEIGHT)
    return SEVERITIES.index(finding.severity), -(finding.torque or 0.0), weight


def _merge_findings(findings: Sequence[Finding]) -> list[Finding]:
    """Return one finding for all but errors of a code and severity at joints or in recordings."""
    groups: dict[object, list[Finding]] = {}
    for number, finding in enumerate(findings):
        # Errors are said one by one: each must be cured.
        apart = finding.severity == "error" or finding.code in APART
        repeats = not apart and (finding.joint is not None or _name_source(finding))
        groups.setdefault((finding.code, finding.severity) if repeats else number, []).append(
            finding
        )
    return [_merge_group(group) for group in groups.values()]


def _merge_group(group: Sequence[Finding]) -> Finding:
    """Return the first finding of a group with the joints and recordings of the others."""
    first = group[0]
    others = group[1:]
    source_of_first = _name_source(first)
    elsewhere = list(
        dict.fromkeys(s for s in map(_name_source, others) if s not in ("", source_of_first))
    )
    joints = list(
        dict.fromkeys(
            merged.joint
            for merged in others
            if _name_source(merged) == source_of_first and merged.joint not in (None, first.joint)
        )
    )
    named = [name for name in joints if name is not None]
    more = [
        *([f"likewise {join_names(named, MOST_NAMED)}"] if named else []),
        *([f"likewise in {join_names(elsewhere, MOST_NAMED)}"] if elsewhere else []),
    ]
    return replace(first, message="; ".join([first.message, *more]))


def _name_source(finding: Finding) -> str:
    """Return the recording that a finding of a check begins with, empty if it names none."""
    # A name of a file has no blanks; a sentence before a colon has.
    name, found, _ = finding.message.partition(": ")
    return name if found and " " not in name else ""
