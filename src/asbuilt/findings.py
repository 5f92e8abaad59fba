"""Findings: what is wrong, or worth knowing, with code, severity, message and cure."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from asbuilt.tables import WIDTH

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")


@dataclass(frozen=True, slots=True)
class Cure:
    """Say what to do about a finding or an error.

    Parameters
    ----------
    text
        Advice in the imperative, without a full stop and without names of options.
    settings
        Fields of an options class (`StudyOptions`, `ReadingOptions`, ...) with the value that
        cures, such as `{"flip_torque": True}`; a caller adds the spelling of its own interface.
    call
        Name of the public function that helps, in `asbuilt`, such as `"find_gains"` or
        `"experiment.read_recordings"`; empty if none does.
    sheet
        Fields of a recording sheet that cure, such as `{"units": {"time": "ms"}}`.
    """

    text: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    call: str = ""
    sheet: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.text

    @property
    def in_python(self) -> str:
        """The advice with the arguments and the function that follow it.

        Examples
        --------
        >>> Cure("flip the torque sign", settings={"flip_torque": True}).in_python
        'flip the torque sign (flip_torque=True)'
        >>> Cure("give the rate in Hz", settings={"rate": "HZ"}).in_python
        'give the rate in Hz (rate=HZ)'
        """
        # A value in capitals stands for one that only the user knows.
        spelled = [
            f"{name}={value if str(value).isupper() else repr(value)}"
            for name, value in self.settings.items()
        ]
        spelled += [f"asbuilt.{self.call}"] if self.call else []
        return f"{self.text} ({', '.join(spelled)})" if spelled else self.text


def undesigned(cure: Cure) -> Cure:
    """Return a cure without the design of a motion, as for legs, of which none is designed."""
    return replace(cure, call="") if cure.call == "design_motion" else cure


@dataclass(frozen=True, slots=True)
class Finding:
    """Name what is wrong (`message`: place and value) and what to do about it (`cure`).

    Parameters
    ----------
    code
        Stable name for programs, in snake_case; `docs/reference/findings.md` lists all.
    severity
        `"error"`: an identification would be wrong; `"warning"`: it would be poor; `"info"`: good
        to know.
    message
        One or two sentences without the final full stop.
    cure
        What to do.
    joint
        Name of the joint concerned.
    time
        First affected time [s].
    torque
        Share of the squared torque error that it concerns: what it explains, or all of its joint's;
        None: unknown.
    link
        Name of the link concerned.
    effect
        Key of the effect that it is about, which a list of effects names too.
    """

    code: str
    severity: Severity
    message: str
    cure: Cure | None = None
    joint: str | None = None
    time: float | None = None
    torque: float | None = None
    link: str | None = None
    effect: str | None = None

    def __str__(self) -> str:
        return self.as_line()

    def as_line(self, cure_text: Callable[[Cure], str] = str) -> str:
        """Return severity, code, message and cure; `cure_text` writes the cure."""
        return f"{self.severity.upper()} {self.code}: {self.advised(cure_text)}"

    def brief(self, room: int, cure_text: Callable[[Cure], str] = str) -> str:
        """Return the message, up to the end of a clause that fits the room, and a cure that fits.

        Nothing is cut inside a clause: a first clause that is longer is whole.

        Examples
        --------
        >>> finding = Finding("gap", "info", "a gap of 2 s at 4 s (row 9); others follow")
        >>> finding.brief(30)
        'a gap of 2 s at 4 s (row 9).'
        """
        message = self.message if len(self.message) < room else _cut_to_clauses(self.message, room)
        whole = replace(self, message=message).advised(cure_text)
        return whole if len(whole) <= room else f"{message}."

    def advised(self, cure_text: Callable[[Cure], str] = str) -> str:
        """Return message and cure as sentences; `cure_text` writes the cure."""
        advice = "" if self.cure is None else cure_text(self.cure)
        return f"{self.message}." + (f" {advice[:1].upper()}{advice[1:]}." if advice else "")

    @property
    def text(self) -> str:
        """Message and cure as sentences.

        Examples
        --------
        >>> Finding("gap", "info", "a gap of 2 s at 4 s", Cure("record again")).text
        'a gap of 2 s at 4 s. Record again.'
        """
        return self.advised()

    def as_dict(self) -> dict[str, Any]:
        """Return the finding as plain data."""
        return {
            "code": self.code,
            "severity": self.severity,
            "message": self.message,
            "cure": "" if self.cure is None else self.cure.text,
            "settings": {} if self.cure is None else dict(self.cure.settings),
            "call": "" if self.cure is None else self.cure.call,
            "joint": self.joint,
            "link": self.link,
            "time": self.time,
            "torque": self.torque,
            "effect": self.effect,
        }


def _cut_to_clauses(text: str, room: int) -> str:
    """Return a text up to the last end of a clause outside brackets within the room.

    The name of a recording, with which a text may begin, is no clause.
    """
    ends = [
        at
        for mark in ("; ", ". ", ": ", ", ", " (")
        for at in range(len(text))
        if text.startswith(mark, at) and text[:at].count("(") == text[:at].count(")")
        if " " in text[:at] and not (mark == " (" and _goes_on_behind(text, at))
    ]
    strong = [at for at in ends if not text.startswith((", ", " ("), at)]
    for kind in (strong, ends):
        if fitting := [at for at in kind if at < room]:
            return text[: max(fitting)]
    return text[: min(ends)] if ends else text


def _goes_on_behind(text: str, bracket: int) -> bool:
    """Return whether a clause goes on behind a bracket, so that it is none without the rest."""
    rest = text[text.find(")", bracket) + 1 :]
    return bool(rest) and rest[0] not in ";:,.)"


def rank_findings(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings by severity, errors first; equal severities keep their order."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


MOST_LISTED = 10
MOST_INFOS = 3
"""Number of findings, and of those for information, that are listed unless all are."""


def list_findings(
    findings: Sequence[Finding], cure_text: Callable[[Cure], str] = str, *, full: bool = False
) -> list[str]:
    """Return findings as lines of 80 columns, one paragraph each.

    Parameters
    ----------
    findings
        Findings; errors are listed first.
    cure_text
        Function that writes a cure, for an interface that adds the names of its options.
    full
        List every finding; by default findings of one code at several joints or links are one
        paragraph, which names the others, and ten paragraphs are listed, three of severity "info".
    """
    ranked = rank_findings(findings)
    groups = [[finding] for finding in ranked]
    hidden = 0
    if not full:
        merged: dict[Any, list[Finding]] = {}
        seen: Counter[Any] = Counter()
        for finding in ranked:
            kind = (finding.severity, finding.code)
            place = finding.joint or finding.link
            # The same joint again is of another log, which its message names.
            seen[kind, place] += 1
            alone = not place or finding.severity == "error"
            key = finding.message if alone else seen[kind, place]
            merged.setdefault((kind, key), []).append(finding)
        serious = [group for group in merged.values() if group[0].severity != "info"]
        infos = [group for group in merged.values() if group[0].severity == "info"]
        groups = [*serious, *infos[:MOST_INFOS]][:MOST_LISTED]
        hidden = len(ranked) - sum(map(len, groups))
    lines = [line for group in groups for line in _write_paragraph(group, cure_text)]
    return [*lines, *([f"... {hidden} more finding{'s' * (hidden > 1)}"] if hidden else [])]


def _write_paragraph(group: Sequence[Finding], cure_text: Callable[[Cure], str]) -> list[str]:
    """Return the lines of findings of one code: the first message, the other places by name."""
    first = group[0]
    names = [place for finding in group[1:] if (place := finding.joint or finding.link)]
    others = f"; the same holds for {join_names(names)}" if names else ""
    return textwrap.wrap(
        replace(first, message=first.message + others).as_line(cure_text),
        WIDTH,
        subsequent_indent="  ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def list_warnings(findings: Iterable[Finding]) -> list[dict[str, str]]:
    """Return the field `warnings` of a document: code and text of each finding."""
    return [{"code": finding.code, "message": finding.text} for finding in findings]


def join_names(names: Sequence[str], most: int = 7) -> str:
    """Join names with commas, the last with "and"; a list longer than `most` ends in "n more".

    >>> join_names(["A1", "A2", "A3"]), join_names(["A1", "A2", "A3"], most=1)
    ('A1, A2 and A3', 'A1 and 2 more')
    """
    listed = [*names[:most], *([f"{len(names) - most} more"] if len(names) > most else [])]
    return "".join(listed) if len(listed) < 2 else f"{', '.join(listed[:-1])} and {listed[-1]}"
