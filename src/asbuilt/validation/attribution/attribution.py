"""What of the torque error of CAD each effect of a model explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.findings import join_names
from asbuilt.identification.effects.effect import EFFECTS, FoundEffect
from asbuilt.identification.effects.groups import GROUPS, name_group
from asbuilt.tables import Cell, Column, Shown, Table, round_significant, stack_tables, wrap_text
from asbuilt.tables import format_share as percentage


@dataclass(frozen=True, slots=True)
class ShownShares:
    """Say which shares of an error are named: from `share` on, unless more than `left` is open.

    In a table the `brief` largest are.
    """

    share: float = 0.05
    left: float = 0.5
    brief: int = 2


SHOWN = ShownShares()


@dataclass(frozen=True, slots=True, eq=False)
class EffectShare:
    """Hold what an effect explains of the squared CAD error of every joint, as fractions (n,).

    `sizes` (n,) are texts of its parameters at each joint; `named` whether it is no chance and
    explains more than little at some joint.
    """

    effect: str
    share: Array
    sizes: tuple[str, ...]
    named: bool


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Attribution:
    """Hold what of the torque error of CAD each effect in a model explains.

    | attribute | meaning |
    |---|---|
    | `judged_by` | recording on which errors are compared |
    | `torque`, `rms_cad`, `rms_chosen` | (n,) RMS torque, error of CAD, and as built |
    | `shares`, `unexplained` | share of each effect, the largest first, and (n,) of none |
    | `payload` | what the flange carries beyond CAD; None without a payload |
    | `masses` | links whose mass differs from CAD by more than others do |
    | `effects` | what else the recordings show, in the model or not |
    """

    robot: str
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    judged_by: str
    torque: Array
    rms_cad: Array
    rms_chosen: Array
    shares: tuple[EffectShare, ...]
    unexplained: Array
    payload: FoundEffect | None
    masses: tuple[FoundEffect, ...]
    effects: tuple[FoundEffect, ...]

    def __repr__(self) -> str:
        return f"<Attribution of {self.robot}: {', '.join(self.chosen)} on {self.judged_by}>"

    def _repr_html_(self) -> str:
        return self.share_table().as_html()

    @property
    def chosen(self) -> tuple[str, ...]:
        """The effects that are named."""
        return tuple(each.effect for each in self.shares if each.named)

    @property
    def bodies(self) -> tuple[FoundEffect, ...]:
        """The payload and the masses of links, as effects of the model."""
        return (*([] if self.payload is None else [self.payload]), *self.masses)

    @property
    def explained(self) -> float:
        """Fraction of the squared CAD error of all joints that the effects explain."""
        energy = self.rms_cad**2
        total = float(energy.sum())
        return 1.0 - float(self.unexplained @ energy) / total if total else 0.0

    @property
    def findings(self) -> tuple[str, ...]:
        """Sentences on the sizes of the effects, and on what the recordings cannot decide."""
        return report_attribution(self)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What explains the CAD error of each joint, with sizes."""
        return tuple(describe_joint_error(self, k) for k in range(len(self.joint_names)))

    def joint_table(self, as_built: Array) -> Table:
        """Return RMS torque, errors of CAD and as built (n,), and the effects, joint by joint."""
        rms = (self.torque, self.rms_cad, as_built)
        ends = (Column("causes of the CAD error"), Column("with their size", detail=True))
        texts = [
            (describe_joint_effects(self, k, brief=True), describe_joint_effects(self, k))
            for k in range(len(as_built))
        ]
        return Table(
            (*self._heads("torque", "CAD error", "as built"), *ends),
            tuple((*self._starts(k, rms), *text) for k, text in enumerate(texts)),
            title=f"RMS torque and errors on {self.judged_by}",
        )

    def share_table(self) -> Table:
        """Return the share of every effect in the squared CAD error, joint by joint."""
        columns = [(each.effect, each.share) for each in self.shares]
        columns.append(("unexplained", self.unexplained))
        rows = [
            (
                *self._starts(k, (self.torque, self.rms_cad, self.rms_chosen)),
                *(Shown(float(part[k]), percentage(float(part[k]), 0)) for _, part in columns),
            )
            for k in range(len(self.joint_names))
        ]
        return Table(
            (
                *self._heads("torque", "CAD error", "as built"),
                *(Column(name.replace("_", " "), align="right") for name, _ in columns),
            ),
            tuple(rows),
            title="Shares of the effects in the squared CAD error",
            details=(
                f"RMS on {self.judged_by}. Shares and the unexplained part of a joint add up to"
                " 100 %; a negative share works against the others.",
            ),
        )

    def _heads(self, *names: str) -> tuple[Column, ...]:
        """Return the heads of joints, of their units if these differ, and of RMS values."""
        unit = self.units[0] if len(set(self.units)) == 1 else ""
        joint = (Column("joint", width=20), *([] if unit else [Column("unit")]))
        return (*joint, *(Column(name, unit, "decimal") for name in names))

    def _starts(self, k: int, values: Sequence[Array]) -> tuple[Cell, ...]:
        unit = () if len(set(self.units)) == 1 else self.units[k : k + 1]
        shown = (Shown(float(v[k]), round_significant(float(v[k]))) for v in values)
        return (self.joint_names[k], *unit, *shown)

    def as_text(self, full: bool = False) -> str:
        """Return sentences and a table for a terminal; `full` has all joints' sentences."""
        lines = ["Causes of the torque error of CAD"]
        if full:
            lines += [wrap_text(line, "  ") for line in (*self.sentences, *self.findings)]
        else:
            lines += [wrap_text(line, "  ", lines=2) for line in self.findings[:3]]
        return "\n".join(lines) + "\n\n" + stack_tables([self.share_table()], full)

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, texts and lists, ready for JSON."""
        named: dict[str, Any] = make_plain(self)
        alike = [[e.effect, other] for e in self.effects for other in e.alternatives]
        return {
            **{key: value for key, value in named.items() if key not in ("robot", "joint_names")},
            "joints": list(self.joint_names),
            "chosen": list(self.chosen),
            "not_told_apart": alike,
            "findings": list(self.findings),
            "sentences": list(self.sentences),
        }


def report_attribution(found: Attribution) -> tuple[str, ...]:
    """Return sentences on the sizes of the effects, and on what the recordings cannot decide."""
    lines = []
    if found.payload is not None:
        caveat = ""
        if "links" in found.payload.alternatives:
            caveat = "; its error holds what the links differ from CAD by themselves"
        lines.append(f"The robot carries a {found.payload.text}{caveat}.")
    lines += [f"In this result: {each.text}." for each in found.masses]
    for each in found.effects:
        if each.in_model and not (each.effect in EFFECTS and EFFECTS[each.effect].removable):
            continue
        where = "Corrected in this result"
        if not each.in_model:
            where = "Not in the model, so that others may hold what it explains"
        lines.append(f"{where}: {each.text}.")
    lines += [
        f"This recording cannot separate {each.text.partition(':')[0]} from"
        f" {join_names(each.alternatives)}."
        for each in found.effects
        if each.alternatives
    ]
    missing = [title for key, title in GROUPS.items() if key not in found.chosen]
    missing += ["payload"] if found.payload is None else []
    return (
        (*lines, f"Not needed to explain this recording: {join_names(missing)}.")
        if missing
        else (*lines,)
    )


def describe_joint_error(found: Attribution, k: int) -> str:
    """Return the CAD error of joint k and what explains it."""
    error = f"{round_significant(float(found.rms_cad[k]))} {found.units[k]}"
    return f"{found.joint_names[k]}: RMS error of CAD {error}; {describe_joint_effects(found, k)}."


def _word_shares(shown: Sequence[EffectShare], k: int) -> str:
    """Return the largest effects with their share; all where some work against the others."""
    if all(each.share[k] > 0 for each in shown):
        named = [(e.effect.replace("_", " "), float(e.share[k])) for e in shown[: SHOWN.brief]]
        return ", ".join(f"{name} {percentage(share, 0)}" for name, share in named)
    total = sum(float(each.share[k]) for each in shown)
    return f"{percentage(total, 0)} {join_names([each.effect for each in shown])}"


def describe_joint_effects(found: Attribution, k: int, *, brief: bool = False) -> str:
    """Return the effects of joint k's CAD error with share and size, the largest first."""
    left = float(found.unexplained[k])
    shown = [e for e in found.shares if e.named and abs(e.share[k]) >= SHOWN.share]
    shown.sort(key=lambda each: -abs(float(each.share[k])))
    texts = {
        each.effect: (each.effect if brief else name_group(each.effect), each.sizes[k])
        for each in shown
    }
    if not any(each.share[k] > 0 for each in shown) or left > SHOWN.left:
        if brief:
            return "unexplained"
        return f"nothing explains {'it' if left > 1.0 - SHOWN.share else 'most of it'}"
    if brief:
        return _word_shares(shown, k)
    with_it, against = (
        [
            f"{percentage(float(each.share[k]), 0)} {name}{f' ({size})' if size else ''}"
            for each in shown
            for name, size in (texts[each.effect],)
            if sign * each.share[k] > 0
        ]
        for sign in (1, -1)
    )
    with_it[0] = with_it[0].replace(" % ", " % of the squared error is ", 1)
    opposed = [f"against that, {', '.join(against)}"] if against else []
    return "; ".join([", ".join(with_it), *opposed, f"{percentage(left, 0)} unexplained"])
