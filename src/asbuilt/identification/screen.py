"""One screen of an identification: verdict, effects, joints, findings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True, slots=True)
class ScreenRules:
    """Say how much of a summary one screen shows.

    Parameters
    ----------
    lines
        Lines in all, of the 30 of a small terminal window; the others are for the files and the
        next command.
    effects, named_only
        Effects in the model, and others, that are listed.
    findings, finding_lines
        Findings that are shown, and lines of each.
    fewest
        Findings that are shown however long the rest is.
    joints
        Joints that the table lists.
    effect_width
        Characters of an effect next to its torque errors.
    """

    lines: int = 25
    effects: int = 5
    named_only: int = 2
    findings: int = 5
    finding_lines: int = 2
    fewest: int = 1
    joints: int = 12
    effect_width: int = WIDTH - 16


RULES = ScreenRules()
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
    lines += ["", *joints.as_text(most=RULES.joints).rstrip("\n").split("\n")]
    named = {(each.effect, each.joint) for each in effects}
    others = [each for each in findings if (each.effect, each.joint) not in named]
    left = len(findings) - len(others)
    lines += shorten_findings(others, RULES.lines - len(lines), cure_text, left=left)
    return "\n".join(lines) + "\n"


def _word_further_output(cure_text: Callable[[Cure], str]) -> str:
    """Return where everything is, with the option of an interface that has one."""
    option = cure_text(Cure("", {"full": True})).strip(" ()")
    return f"({', '.join(filter(None, (option, 'summary.txt')))})"


def format_effects(
    effects: Sequence[FoundEffect], cure_text: Callable[[Cure], str] = str
) -> list[str]:
    """Return a line for each effect: what is in the model that CAD lacks, then what is not.

    What is not in the model and would not change the torque error is left out.
    """
    ordered = sorted(effects, key=lambda each: each.error_after - each.error_before)
    ordered = [each for each in ordered if each.in_model or format_effect_errors(each)]
    lines: list[str] = []
    for head, most, part in (
        ("In the model, which CAD lacks", RULES.effects, [e for e in ordered if e.in_model]),
        ("Not in the model", RULES.named_only, [e for e in ordered if not e.in_model]),
    ):
        if part:
            rows = [(format_effect(each), format_effect_errors(each)) for each in part[:most]]
            width = max(len(text) for text, _ in rows)
            lines.append(f"{head} (torque error without it -> with it):")
            lines += [wrap_text(f"{text:<{width}}  {gain}", "  ") for text, gain in rows]
            if len(part) > most:
                lines.append(f"  ... {len(part) - most} more {_word_further_output(cure_text)}")
    return lines


def format_effect(each: FoundEffect) -> str:
    """Return an effect with its place and size, and its standard error if the line has room."""
    title = EFFECTS[each.effect].title if each.effect in EFFECTS else each.effect
    where = f"{title} at {each.joint}" if each.joint else title
    unit = "" if each.unit == "1" else each.unit
    short = f"{round_significant(each.estimate, 2)} {unit}".rstrip()
    texts = [f"{where} {size}" for size in (format_size(each), short)]
    return texts[0] if each.feasible or len(texts[0]) <= RULES.effect_width else texts[1]


def format_size(each: FoundEffect) -> str:
    """Return the size of an effect with its standard error, or its interval and what was chosen."""
    unit = "" if each.unit == "1" else each.unit
    if each.feasible is None:
        return f"{format_plus_minus(each.estimate, each.std_error)} {unit}".rstrip()
    chosen = round_significant(each.estimate)
    return f"{format_range(*each.feasible, unit)}, chosen {chosen}"


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
    for finding in warnings[: RULES.findings]:
        label = f"{finding.severity.upper():<7}  "
        # Lines end at spaces: each costs up to a word.
        width = RULES.finding_lines * (WIDTH - len(label)) - RULES.finding_lines * 8
        text = wrap_text(finding.brief(width, cure_text), label).split("\n")
        if shown >= RULES.fewest and len(lines) + len(text) + 1 > room:
            break
        lines += text
        shown += 1
    left += len(findings) - shown
    more = [f"... {left} more finding{'s' if left > 1 else ''} {_word_further_output(cure_text)}"]
    return [*([""] if lines and len(lines) + 2 <= room else []), *lines, *(more if left else [])]
