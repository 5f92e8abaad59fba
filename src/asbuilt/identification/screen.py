"""One screen of an identification: verdict, effects, joints, findings."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence

from asbuilt.findings import Cure, Finding
from asbuilt.identification.effects.effect import EFFECTS, FoundEffect
from asbuilt.tables import (
    WIDTH,
    Table,
    format_plus_minus,
    format_range,
    round_significant,
    wrap_text,
)

# Say how much of a summary one screen shows.

# Lines in all, of the 30 of a small terminal window; the others are for the files and the next
# command
SCREEN_LINES = 25
# SCREEN_EFFECTS, SCREEN_NAMED_ONLY: effects in the model, and others, that are listed
SCREEN_EFFECTS = 5
SCREEN_NAMED_ONLY = 2
# SCREEN_FINDINGS, SCREEN_FINDING_LINES: findings that are shown, and lines of each
SCREEN_FINDINGS = 5
SCREEN_FINDING_LINES = 2
SCREEN_FEWEST = 1  # Findings that are shown however long the rest is
SCREEN_JOINTS = 12  # Joints that the table lists
# Relative fall of the torque error from which an effect that is not in the model is listed
SCREEN_WORTH = 0.1
SCREEN_EFFECT_WIDTH = WIDTH - 16  # Characters of an effect next to its torque errors


IN_THE_FIRST_LINE = ("held_out_repeats", "nothing_held_out")
"""Findings that the verdict, which the screen begins with, and the next command repeat."""


def compose_screen(
    opening: str,
    effects: Sequence[FoundEffect],
    joints: Table,
    findings: Sequence[Finding],
    cure_text: Callable[[Cure], str] = str,
) -> str:
    """Return what a user decides by, in a screen of 80 columns.

    Parameters
    ----------
    opening
        The verdict, or a title; further lines are paragraphs of their own.
    effects, joints, findings
        What CAD lacks, the torque errors of the joints, and ranked findings.
    cure_text
        Function that writes a cure, for an interface that adds the names of its options.
    """
    lines = [line for each in opening.split("\n") for line in wrap_text(each).split("\n")]
    lines += format_effects(effects, cure_text)
    lines += ["", *joints.as_text(most=SCREEN_JOINTS).rstrip("\n").split("\n")]
    named = {(effect.effect, effect.joint) for effect in effects}
    others = [finding for finding in findings if (finding.effect, finding.joint) not in named]
    left = len(findings) - len(others)
    lines += shorten_findings(others, SCREEN_LINES - len(lines), cure_text, left=left)
    return "\n".join(lines) + "\n"


def _word_further_output(cure_text: Callable[[Cure], str]) -> str:
    """Return where everything is, with the option of an interface that has one."""
    option = cure_text(Cure("", {"full": True})).strip(" ()")
    return f"({', '.join(filter(None, (option, 'summary.txt')))})"


def format_effects(
    effects: Sequence[FoundEffect], cure_text: Callable[[Cure], str] = str
) -> list[str]:
    """Return a line for each effect: what is in the model that CAD lacks, then what is not.

    What is not in the model is listed if it is an error of the log, or would lower the torque error
    by `SCREEN_WORTH`: of anything else nobody would do anything.
    """
    ordered = sorted(effects, key=lambda each: each.error_after - each.error_before)
    ordered = [each for each in ordered if each.in_model or _is_worth_a_line(each)]
    lines: list[str] = []
    for head, most, part in (
        ("In the model, which CAD lacks", SCREEN_EFFECTS, [e for e in ordered if e.in_model]),
        ("Not in the model", SCREEN_NAMED_ONLY, [e for e in ordered if not e.in_model]),
    ):
        if part:
            rows = [(format_effect(each), format_effect_errors(each)) for each in part[:most]]
            lines.append(f"{head} (torque error without it -> with it):")
            lines += _align_effects(rows)
            if len(part) > most:
                lines.append(f"  ... {len(part) - most} more {_word_further_output(cure_text)}")
    return lines


def _is_worth_a_line(each: FoundEffect) -> bool:
    """Return whether an effect that is not in the model changes what a user does."""
    of_log = each.effect in EFFECTS and EFFECTS[each.effect].of_log
    large = each.error_after < (1.0 - SCREEN_WORTH) * each.error_before
    return bool(format_effect_errors(each)) and (of_log or large)


def _align_effects(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Return lines of effects with their torque errors in a column; long texts go on below."""
    gains = max(len(gain) for _, gain in rows)
    width = min(max(len(text) for text, _ in rows), WIDTH - gains - 4)
    lines = []
    for text, gain in rows:
        *before, last = textwrap.wrap(
            text, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
        )
        lines += [f"  {line}" for line in before]
        lines.append(f"  {last:<{width}}  {gain}".rstrip())
    return lines


def format_effect(each: FoundEffect) -> str:
    """Return an effect with its place and size, and its standard error if the line has room."""
    title = EFFECTS[each.effect].title if each.effect in EFFECTS else each.effect
    where = f"{title} at {each.joint}" if each.joint else title
    scale, unit = _read_unit(each)
    short = f"{round_significant(scale * each.estimate, 2)} {unit}".rstrip()
    texts = [f"{where} {size}" for size in (format_size(each), short)]
    return texts[0] if each.feasible or len(texts[0]) <= SCREEN_EFFECT_WIDTH else texts[1]


def format_size(each: FoundEffect) -> str:
    """Return the size of an effect with its standard error, or its interval and what was chosen."""
    scale, unit = _read_unit(each)
    if each.feasible is None:
        error = None if each.std_error is None else scale * each.std_error
        size = format_plus_minus(scale * each.estimate, error)
        return f"{size} {unit}".rstrip()
    chosen = round_significant(scale * each.estimate)
    least, greatest = (scale * bound for bound in each.feasible)
    return f"{format_range(least, greatest, unit)}, chosen {chosen}"


def _read_unit(each: FoundEffect) -> tuple[float, str]:
    """Return the factor and the unit in which a size is read: shares in percent."""
    if each.effect in EFFECTS and EFFECTS[each.effect].of_shares:
        return 100.0, "%"
    return 1.0, "" if each.unit == "1" else each.unit


def format_effect_errors(each: FoundEffect) -> str:
    """Return the relative torque errors without and with an effect; empty where they are alike."""
    before, after = (round_significant(100.0 * e, 2) for e in (each.error_before, each.error_after))
    return "" if before == after else f"{before} -> {after} %"


def shorten_findings(
    findings: Sequence[Finding],
    room: int,
    cure_text: Callable[[Cure], str] = str,
    *,
    left: int = 0,
) -> list[str]:
    """Return the first warnings, a sentence each, within `room` lines, and how many are left.

    `left` findings more are left already.
    """
    lines: list[str] = []
    shown = 0
    warnings = [e for e in findings if e.severity != "info" and e.code not in IN_THE_FIRST_LINE]
    for finding in warnings[:SCREEN_FINDINGS]:
        label = f"{finding.severity.upper():<7}  "
        # Lines end at spaces: each costs up to a word.
        width = SCREEN_FINDING_LINES * (WIDTH - len(label)) - SCREEN_FINDING_LINES * 8
        text = wrap_text(finding.brief(width, cure_text), label).split("\n")
        # Two lines more: an empty one before, and that on further findings behind.
        if shown >= SCREEN_FEWEST and len(lines) + len(text) + 2 > room:
            break
        lines += text
        shown += 1
    left += len(findings) - shown
    more = [f"... {left} more finding{'s' if left > 1 else ''} {_word_further_output(cure_text)}"]
    return [*([""] if lines else []), *lines, *(more if left else [])]
