"""Attribution of the torque error of CAD to causes."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import ResultError
from asbuilt.findings import Cure
from asbuilt.identification.information.cause_data import TILTS
from asbuilt.tables import Cell, Column, Shown, Table, significant, stacked, wrapped
from asbuilt.tables import share as percentage
from asbuilt.validation.attribution.cause_choice import CauseChoice
from asbuilt.validation.attribution.cause_fits import CauseFits, Step
from asbuilt.validation.attribution.cause_text import (
    SHORT,
    reason,
    sentence,
    sentences_on_causes,
    short_reason,
)
from asbuilt.validation.attribution.causes import CAUSES, shapley_values
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.prediction import torque_units

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


@dataclass(frozen=True, slots=True, eq=False)
class CauseShare:
    """Hold what one cause explains of the squared CAD error of every joint, as fractions (n,).

    | attribute | share |
    |---|---|
    | `share` | with all causes fitted together; they and `unexplained` add up to 1 |
    | `refitted` | Shapley value with every combination of causes fitted anew |
    | `alone` | explained by the cause alone |
    | `last` | explained beyond all other causes |
    """

    cause: str
    share: Array
    refitted: Array
    alone: Array
    last: Array


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Attribution:
    """Hold the causes of the torque error of CAD.

    | attribute | meaning |
    |---|---|
    | `judged_by` | recording on which errors are compared |
    | `torque`, `rms_cad`, `rms_chosen` | (n,) RMS torque, error of CAD, and with the causes |
    | `steps` | nested models in the order of `CAUSES` |
    | `chosen` | combination with the fewest causes among those about as likely as the best |
    | `weighed` | those, and a payload if it explains part of what changed links explain |
    | `shares`, `unexplained` | share of each cause weighed, and (n,) of none |
    | `correlated` | pairs of causes that this recording cannot separate |
    | `findings` | sentences on the sizes of the causes |
    | `sentences`, `reasons`, `short_reasons` | causes of each joint's error, in full and in brief |
    | `values` | parameters of the causes chosen, by name |
    """

    robot: str
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    judged_by: str
    torque: Array
    rms_cad: Array
    rms_chosen: Array
    steps: tuple[Step, ...]
    chosen: tuple[str, ...]
    weighed: tuple[str, ...]
    shares: tuple[CauseShare, ...]
    unexplained: Array
    correlated: tuple[tuple[str, str], ...]
    findings: tuple[str, ...]
    sentences: tuple[str, ...]
    reasons: tuple[str, ...]
    short_reasons: tuple[str, ...]
    values: dict[str, float]

    def __repr__(self) -> str:
        causes = ", ".join(CAUSES[cause] for cause in self.chosen) or "no cause"
        return f"<Attribution of {self.robot}: {causes} on {self.judged_by}>"

    def _repr_html_(self) -> str:
        return self.share_table().as_html()

    @property
    def tilt(self) -> float:
        """Angle by which the base is tilted [rad]; zero if that is not among the causes chosen."""
        return (
            float(np.linalg.norm([self.values.get(name, 0.0) for name in TILTS]))
            if "mounting" in self.chosen
            else 0.0
        )

    @property
    def explained(self) -> float:
        """Fraction of the squared CAD error of all joints that the causes explain."""
        energy = self.rms_cad**2
        total = float(energy.sum())
        return 1.0 - float(self.unexplained @ energy) / total if total else 0.0

    def joint_table(self, as_built: Array) -> Table:
        """Return RMS torque, errors of CAD and as built (n,), and the causes, joint by joint."""
        unit, units = _unit_column(self.units)
        heads = (
            Column("joint", width=20),
            *([] if unit else [Column("unit")]),
            *(Column(name, unit, "decimal") for name in ("torque", "CAD error", "as built")),
            Column("causes of the CAD error"),
            Column("with their size", detail=True),
        )
        rows: list[tuple[Cell, ...]] = [
            (
                name,
                *units[k : k + 1],
                *(
                    Shown(float(rms[k]), significant(float(rms[k])))
                    for rms in (self.torque, self.rms_cad, as_built)
                ),
                self.short_reasons[k],
                self.reasons[k],
            )
            for k, name in enumerate(self.joint_names)
        ]
        return Table(heads, tuple(rows), title=f"RMS torque and errors on {self.judged_by}")

    def share_table(self) -> Table:
        """Return the share of every cause in the squared CAD error, joint by joint."""
        unit, units = _unit_column(self.units)
        heads = (
            Column("joint", width=20),
            *([] if unit else [Column("unit")]),
            Column("torque", unit, "decimal", detail=True),
            Column("CAD error", unit, "decimal"),
            *(Column(SHORT.get(each.cause, each.cause), align="right") for each in self.shares),
            Column("unexplained", align="right"),
            Column("left", unit, "decimal"),
        )
        rows: list[tuple[Cell, ...]] = []
        for k, name in enumerate(self.joint_names):
            parts = [*(float(each.share[k]) for each in self.shares), float(self.unexplained[k])]
            torque, off, left = (
                Shown(float(rms[k]), significant(float(rms[k])))
                for rms in (self.torque, self.rms_cad, self.rms_chosen)
            )
            rows.append(
                (
                    name,
                    *units[k : k + 1],
                    torque,
                    off,
                    *(Shown(part, percentage(part, 0)) for part in parts),
                    left,
                )
            )
        return Table(
            heads,
            tuple(rows),
            title="Shares of the causes in the squared CAD error",
            details=(
                f"RMS on {self.judged_by}. Shares and the unexplained part of a joint add up to"
                " 100 %; a negative share works against the others.",
            ),
        )

    def step_table(self) -> Table:
        """Return the nested models: parameters, F-test of each step, BIC, RMS error."""
        heads = (
            Column("model"),
            Column("parameters", align="right"),
            Column("F", align="decimal"),
            Column("p", align="right"),
            Column("BIC", align="right"),
            *(
                Column(name, unit, "decimal", width=16, detail=True)
                for name, unit in zip(self.joint_names, self.units, strict=True)
            ),
        )
        rows: list[tuple[Cell, ...]] = []
        for number, step in enumerate(self.steps):
            tested = np.isfinite(step.f)
            p = f"{step.probability:.1g}" if step.probability else "below 1e-300"
            rows.append(
                (
                    "CAD" if number == 0 else f"+ {CAUSES[step.cause]}",
                    step.parameters,
                    Shown(step.f, significant(step.f)) if tested else None,
                    Shown(step.probability, p) if tested else None,
                    Shown(step.bic, f"{step.bic:.0f}"),
                    *(Shown(float(error), significant(float(error))) for error in step.rms),
                )
            )
        note = (
            "Each model contains the causes above it. F compares the step with the residual of the"
            " last model, for as many samples as are independent. F and BIC are of the training"
            " data; RMS errors are of validation data and may rise."
        )
        return Table(heads, tuple(rows), title="Nested models, RMS torque error", details=(note,))

    def as_text(self, full: bool = False) -> str:
        """Return sentences and tables for a terminal.

        Parameters
        ----------
        full
            Show all joints' sentences and the nested models; else what fits one screen.
        """
        lines = ["Causes of the torque error of CAD"]
        if full:
            lines += [wrapped(line, "  ") for line in (*self.sentences, *self.findings)]
        else:
            lines += [wrapped(line, "  ", lines=2) for line in self.findings[:3]]
        tables = [self.share_table(), *([self.step_table()] if full else [])]
        return "\n".join(lines) + "\n\n" + stacked(tables, full)

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, texts and lists, ready for JSON."""
        return {
            "judged_by": self.judged_by,
            "joints": list(self.joint_names),
            "rms_cad": self.rms_cad.tolist(),
            "rms_chosen": self.rms_chosen.tolist(),
            "chosen": list(self.chosen),
            "shares": [
                {
                    name: value if isinstance(value, str) else value.tolist()
                    for name, value in asdict(each).items()
                }
                for each in self.shares
            ],
            "unexplained": self.unexplained.tolist(),
            "not_told_apart": [list(pair) for pair in self.correlated],
            "steps": [
                {
                    "cause": step.cause,
                    "rms": step.rms.tolist(),
                    "rms_fitted": step.rms_fitted.tolist(),
                    "parameters": step.parameters,
                    "bic": step.bic,
                    "f": step.f,
                    "p_value": step.probability,
                }
                for step in self.steps
            ],
            "values": self.values,
            "findings": list(self.findings),
            "sentences": list(self.sentences),
        }


def attribute(result: IdentificationResult, cad: RobotModel | None = None) -> Attribution:
    """Attribute the torque error of CAD to causes.

    Every combination of causes is fitted to `tau - tau_CAD` by least squares weighted by the noise
    of each joint, and validated on held-out data. Of those about as likely as the best, the one
    with the fewest causes is chosen. The drop of each joint's squared error is divided by the
    Shapley value (Shapley, 1953) over the orders that take a special cause before the general one
    that contains it (Faigle and Kern, Int. J. Game Theory 21, 1992). Tilt and gain are linearised
    at CAD.

    Parameters
    ----------
    result
        A result with `cause_data`.
    cad
        Another description of the same geometry; None: the one identified with.

    Returns
    -------
    Attribution
        Causes chosen, their shares and sizes.

    Raises
    ------
    ResultError
        If the result has no cause data.
    """
    if result.cause_data is None:
        raise ResultError(
            f"this result of {result.robot} has no cause data; `run_study` gathers them from"
            " recordings of at least some seconds",
            cure=Cure("identify again from a longer recording", call="run_study"),
        )
    with one_blas_thread():
        return _attributed(CauseChoice(CauseFits(result, result.cause_data, cad)), result)


def _attributed(choice: CauseChoice, result: IdentificationResult) -> Attribution:
    fits, weighed, whole = choice.fits, choice.weighed, choice.chosen
    e, cad = fits.cause_data, fits.fit(frozenset())
    energy = np.where(cad.rms > 0.0, cad.rms**2, np.inf)
    refitted = shapley_values(weighed, lambda some: 1.0 - fits.fit(some).rms ** 2 / energy)
    parts = choice.parts()
    shares = tuple(
        CauseShare(
            cause=cause,
            share=parts[cause] / energy,
            refitted=refitted[cause],
            alone=1.0 - fits.fit(frozenset({cause})).rms ** 2 / energy,
            last=(fits.fit(frozenset(weighed) - {cause}).rms ** 2 - whole.rms**2) / energy,
        )
        for cause in weighed
    )
    divided = {each.cause: each.share for each in shares}
    correlated = choice.correlated(divided)
    unexplained = whole.rms**2 / energy
    said, why, brief = (
        tuple(text(choice, k, divided, float(unexplained[k])) for k in range(e.n_joints))
        for text in (sentence, reason, short_reason)
    )
    return Attribution(
        robot=result.robot,
        joint_names=e.joint_names,
        units=torque_units(result.model),
        judged_by=recording_name(e.judged_by),
        torque=np.array([np.linalg.norm(factor[:, -1]) for factor in e.judged])
        / np.sqrt(e.n_judged),
        rms_cad=cad.rms,
        rms_chosen=whole.rms,
        steps=fits.steps(),
        chosen=tuple(cause for cause in CAUSES if cause in whole.causes),
        weighed=weighed,
        shares=shares,
        unexplained=unexplained,
        correlated=correlated,
        findings=sentences_on_causes(choice, correlated),
        sentences=said,
        reasons=why,
        short_reasons=brief,
        values={n: float(v) for n, v in zip(fits.names, whole.values, strict=True) if v},
    )


def _unit_column(units: tuple[str, ...]) -> tuple[str, tuple[str, ...]]:
    """Return the unit for the heads of columns, or a column of units if joints differ in it."""
    return (units[0], ()) if len(set(units)) == 1 else ("", units)
