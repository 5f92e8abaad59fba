"""What of the torque error of CAD each effect of a model explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.findings import join_names
from asbuilt.identification.effects.effect import EFFECTS, GROUPS, FoundEffect, name_group
from asbuilt.tables import Column, Table, round_significant, stack_tables, wrap_text
from asbuilt.tables import format_share as percentage

NAMED_SHARE = 0.05
"""Share of an error from which on its cause is named."""
OPEN_SHARE = 0.5
"""Share of an error without a cause beyond which none is named."""
BRIEF_CAUSES = 2
"""Causes in a table: the largest."""


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
        return tuple(effect_share.effect for effect_share in self.shares if effect_share.named)

    @property
    def bodies(self) -> tuple[FoundEffect, ...]:
        """The payload and the masses of links, as effects of the model."""
        return (*([] if self.payload is None else [self.payload]), *self.masses)

    @property
    def explained(self) -> float:
        """Fraction of the squared CAD error of all joints that the effects explain."""
        energy = self.rms_cad**2
        total = float(energy.sum())
        # Without an error nothing is to be explained.
        return 1.0 - float(self.unexplained @ energy) / total if total else 0.0

    @property
    def findings(self) -> tuple[str, ...]:
        """Sentences on the sizes of the effects, and on what the recordings cannot decide."""
        lines = []
        if self.payload is not None:
            caveat = (
                "; its error holds what the links differ from CAD by themselves"
                if "links" in self.payload.alternatives
                else ""
            )
            lines.append(f"The robot carries a {self.payload.text}{caveat}.")
        lines += [f"In this result: {mass.text}." for mass in self.masses]
        for effect in self.effects:
            if not effect.in_model:
                where = "Not in the model, so that others may hold what it explains"
                lines.append(f"{where}: {effect.text}.")
            elif effect.effect in EFFECTS and EFFECTS[effect.effect].removable:
                lines.append(f"Corrected in this result: {effect.text}.")
        lines += [
            f"This recording cannot separate {effect.text.partition(':')[0]} from"
            f" {join_names(effect.alternatives)}."
            for effect in self.effects
            if effect.alternatives
        ]
        missing = [title for key, title in GROUPS.items() if key not in self.chosen]
        missing += ["payload"] if self.payload is None else []
        if missing:
            lines.append(f"Not needed to explain this recording: {join_names(missing)}.")
        return tuple(lines)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What explains the CAD error of each joint, with sizes."""
        return tuple(
            f"{name}: RMS error of CAD {round_significant(float(self.rms_cad[k]))} {unit};"
            f" {describe_joint_effects(self, k)}."
            for k, (name, unit) in enumerate(zip(self.joint_names, self.units, strict=True))
        )

    def joint_table(self, as_built: Array) -> Table:
        """Return RMS torque, errors of CAD and as built (n,), and the effects, joint by joint."""
        columns = (
            *self._list_columns(as_built),
            Column(
                "causes of the CAD error",
                of=lambda k: describe_joint_effects(self, k, brief=True),
            ),
            Column("with their size", detail=True, of=lambda k: describe_joint_effects(self, k)),
        )
        title = f"RMS torque and errors on {self.judged_by}"
        return Table.of(range(len(self.joint_names)), columns, title)

    def share_table(self) -> Table:
        """Return the share of every effect in the squared CAD error, joint by joint."""
        parts = {effect_share.effect: effect_share.share for effect_share in self.shares}
        parts["unexplained"] = self.unexplained
        whole = partial(percentage, digits=0)
        shares = (
            Column(name.replace("_", " "), "", "right", whole, of=part.__getitem__)
            for name, part in parts.items()
        )
        return Table.of(
            range(len(self.joint_names)),
            (*self._list_columns(self.rms_chosen), *shares),
            title="Shares of the effects in the squared CAD error",
            details=(
                f"RMS on {self.judged_by}. Shares and the unexplained part of a joint add up to"
                " 100 %; a negative share works against the others.",
            ),
        )

    def _list_columns(self, as_built: Array) -> list[Column]:
        """Return the columns of joints, of their units if these differ, and of RMS values."""
        # One unit stands in the heads; several have a column.
        unit = self.units[0] if len(set(self.units)) == 1 else ""
        rms = {"torque": self.torque, "CAD error": self.rms_cad, "as built": as_built}
        return [
            Column("joint", width=20, of=self.joint_names.__getitem__),
            *([] if unit else [Column("unit", of=self.units.__getitem__)]),
            *(
                Column(name, unit, "decimal", 3, of=values.__getitem__)
                for name, values in rms.items()
            ),
        ]

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


def _word_shares(shown: Sequence[EffectShare], k: int) -> str:
    """Return the largest effects with their share; all where some work against the others."""
    if all(effect.share[k] > 0 for effect in shown):
        named = [(e.effect.replace("_", " "), float(e.share[k])) for e in shown[:BRIEF_CAUSES]]
        return ", ".join(f"{name} {percentage(share, 0)}" for name, share in named)
    total = sum(float(effect.share[k]) for effect in shown)
    return f"{percentage(total, 0)} {join_names([effect.effect for effect in shown])}"


def describe_joint_effects(found: Attribution, k: int, *, brief: bool = False) -> str:
    """Return the effects of joint k's CAD error with share and size, the largest first."""
    left = float(found.unexplained[k])
    shown = [e for e in found.shares if e.named and abs(e.share[k]) >= NAMED_SHARE]
    # Against the others an effect counts by its size.
    shown.sort(key=lambda cause: -abs(float(cause.share[k])))
    if not any(effect.share[k] > 0 for effect in shown) or left > OPEN_SHARE:
        whole = "it" if left > 1.0 - NAMED_SHARE else "most of it"
        return "unexplained" if brief else f"nothing explains {whole}"
    if brief:
        return _word_shares(shown, k)
    with_it, against = (
        [
            f"{percentage(float(effect.share[k]), 0)} {name_group(effect.effect)}"
            f"{f' ({effect.sizes[k]})' if effect.sizes[k] else ''}"
            for effect in shown
            if sign * effect.share[k] > 0
        ]
        for sign in (1, -1)
    )
    # Only the first says what its percentage is of.
    with_it[0] = with_it[0].replace(" % ", " % of the squared error is ", 1)
    opposed = [f"against that, {', '.join(against)}"] if against else []
    return "; ".join([", ".join(with_it), *opposed, f"{percentage(left, 0)} unexplained"])
