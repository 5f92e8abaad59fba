"""Which causes explain how much of what CAD predicts wrongly.

Every combination of causes fitted, shares that do not depend on their order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import ResultError
from asbuilt.identification.information.cause_data import TILTS
from asbuilt.tables import Cell, Column, Shown, Table, significant, stacked
from asbuilt.tables import share as percentage
from asbuilt.validation.attribution.cause_fits import CauseFits, Step
from asbuilt.validation.attribution.cause_text import findings, reason, sentence
from asbuilt.validation.attribution.causes import CAUSES, shapley_values
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.prediction import torque_units

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


SHORT: dict[str, str] = {
    "payload": "body at flange",
    "mounting": "askew",
    "gain": "torque gain",
    "links": "links' mass",
}
"""What causes are called at the head of a column, where not by their own name."""


@dataclass(frozen=True, slots=True, eq=False)
class CauseShare:
    """What one cause explains of the squared CAD error of every joint, each (n,) as a fraction of
    it.

    `share` divides what the causes explain together, with the sizes found together; `refitted` is
    the Shapley value where every combination is fitted anew, so that causes stand in for each
    other; `alone` is what the cause explains by itself, `last` what it adds to all others.
    """

    cause: str
    share: Array
    refitted: Array
    alone: Array
    last: Array


@dataclass(frozen=True, slots=True, eq=False)
class Attribution:
    """Hold which causes the error of CAD has.

    `steps` are the nested models in the order of `CAUSES`; `chosen` is the combination with the
    fewest causes among those about as likely as the best; `shares` of the causes weighed (those
    chosen, and a payload where it could be part of what is put down to the links) add up, with
    `unexplained` (n,), to 1 for every joint. `alike` are pairs that this recording does not tell
    apart. `rms_cad` (n,) and `rms_chosen` (n,) are errors on `judged_by`, beside the `torque` (n,)
    there, all RMS. `findings` say in sentences what the causes amount to, `sentences` what each
    joint's error is made of, and `reasons` the same without the size of the error.
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
    alike: tuple[tuple[str, str], ...]
    findings: tuple[str, ...]
    sentences: tuple[str, ...]
    reasons: tuple[str, ...]
    values: dict[str, float]

    def joint_table(self, as_built: Array) -> Table:
        """Return, joint by joint, the RMS torque, how far CAD is off, how far the robot as built
        (n,) on the same data, and why CAD is.
        """
        heads = (
            Column("joint", width=20),
            Column("unit"),
            *(
                Column(name, align="decimal")
                for name in ("torque", "CAD off by", "as built off by")
            ),
            Column("why CAD is off"),
        )
        rows: list[tuple[Cell, ...]] = []
        for name, unit, *rms, why in zip(
            self.joint_names,
            self.units,
            self.torque,
            self.rms_cad,
            as_built,
            self.reasons,
            strict=True,
        ):
            rows.append(
                (
                    name,
                    unit,
                    *(Shown(float(value), significant(float(value))) for value in rms),
                    why,
                )
            )
        return Table(heads, tuple(rows), title=f"Joint by joint, RMS on {self.judged_by}")

    @property
    def tilt(self) -> float:
        """Angle [rad] by which the robot seems to stand askew, zero where that is not among the
        causes chosen.
        """
        return (
            float(np.linalg.norm([self.values.get(name, 0.0) for name in TILTS]))
            if "mounting" in self.chosen
            else 0.0
        )

    def share_table(self) -> Table:
        """Return, joint by joint, the RMS torque and error of CAD, the share of every cause in its
        square, what is left, and the error then.
        """
        heads = [
            Column("joint", width=20),
            Column("unit"),
            Column("torque", align="decimal"),
            Column("CAD off by", align="decimal"),
        ]
        heads += [Column(SHORT.get(each.cause, each.cause), align="right") for each in self.shares]
        heads += [Column("unexplained", align="right"), Column("left", align="decimal")]
        rows: list[tuple[Cell, ...]] = []
        for k, (name, unit) in enumerate(zip(self.joint_names, self.units, strict=True)):
            parts = [*(float(each.share[k]) for each in self.shares), float(self.unexplained[k])]
            torque, off, left = (
                Shown(float(rms[k]), significant(float(rms[k])))
                for rms in (self.torque, self.rms_cad, self.rms_chosen)
            )
            rows.append(
                (
                    name,
                    unit,
                    torque,
                    off,
                    *(Shown(part, percentage(part, 0)) for part in parts),
                    left,
                )
            )
        return Table(
            tuple(heads),
            tuple(rows),
            title="What the error of CAD is made of, shares of its square",
            notes=(
                (
                    f"RMS on {self.judged_by}. The shares of a joint and what is unexplained add up"
                    " to 100 %; one below 0 works against the others."
                ),
            ),
        )

    def step_table(self) -> Table:
        """Return the nested models.

        Parameters told, F-test of each step, BIC, RMS error of every joint on held-out data.
        """
        heads = [
            Column("model"),
            Column("parameters", align="right"),
            Column("F", align="decimal"),
            Column("p", align="right"),
        ]
        heads.append(Column("BIC", align="right"))
        heads += [
            Column(name, unit, "decimal", width=16)
            for name, unit in zip(self.joint_names, self.units, strict=True)
        ]
        rows: list[tuple[Cell, ...]] = []
        for number, step in enumerate(self.steps):
            errors = [Shown(float(error), significant(float(error))) for error in step.rms]
            tested = np.isfinite(step.f)
            rows.append(
                (
                    "CAD" if number == 0 else f"+ {CAUSES[step.cause]}",
                    step.parameters,
                    Shown(step.f, significant(step.f)) if tested else None,
                    (
                        Shown(
                            step.probability,
                            f"{step.probability:.1g}" if step.probability else "below 1e-300",
                        )
                        if tested
                        else None
                    ),
                    Shown(step.bic, f"{step.bic:.0f}"),
                    *errors,
                )
            )
        note = (
            "Each model has the causes above it too. F: what the step explains of the data used"
            " against what the last model leaves, with as many samples as are independent; BIC is"
            " of the data used, errors are those on data held out and may rise."
        )
        return Table(
            tuple(heads), tuple(rows), title="Nested models, held-out RMS error", notes=(note,)
        )

    def as_text(self) -> str:
        """Return sentences and both tables for a terminal."""
        said = [
            "Why CAD is off:",
            *(f"  {line}" for line in self.sentences),
            *(f"  {line}" for line in self.findings),
        ]
        return "\n".join(said) + "\n\n" + stacked([self.share_table(), self.step_table()])

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
                    "cause": each.cause,
                    "share": each.share.tolist(),
                    "refitted": each.refitted.tolist(),
                    "alone": each.alone.tolist(),
                    "last": each.last.tolist(),
                }
                for each in self.shares
            ],
            "unexplained": self.unexplained.tolist(),
            "not_told_apart": [list(pair) for pair in self.alike],
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
    """Attribute the torque error of CAD (or of `cad`, another description of the same geometry) to
    causes.

    Every combination of causes present is fitted to `tau - tau_CAD` by least squares with each
    joint weighted by its noise, and judged on data held out. Of those about as likely as the best
    the one with the fewest causes is chosen (`CauseFits.chosen`); within it the drop of each
    joint's squared error is divided by the Shapley value (Shapley, 1953) over the orders that take
    a special cause before the general one that contains it (Faigle & Kern, Int. J. Game Theory 21,
    1992). Tilt and gain are linearised at CAD. Raises `ResultError` where the result carries no
    cause data.
    """
    if result.cause_data is None:
        raise ResultError(
            f"this result of {result.robot} carries no cause data, which `asbuilt identify`"
            " and `run_study` gather from recordings of some seconds at least; identify again with"
            " either"
        )
    with one_blas_thread():
        return _attributed(CauseFits(result, result.cause_data, cad), result)


def _attributed(fits: CauseFits, result: IdentificationResult) -> Attribution:
    e = fits.cause_data
    weighed = fits.weighed
    cad, whole = fits.fit(frozenset()), fits.chosen
    energy = np.maximum(cad.rms, np.finfo(float).tiny) ** 2
    refitted = shapley_values(weighed, lambda some: 1.0 - fits.fit(some).rms ** 2 / energy)
    parts = fits.parts(weighed)
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
    alike = fits.alike(divided)
    unexplained = whole.rms**2 / energy
    values = {name: float(v) for name, v in zip(fits.names, fits.chosen.values, strict=True) if v}
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
        chosen=tuple(cause for cause in CAUSES if cause in fits.chosen.causes),
        weighed=weighed,
        shares=shares,
        unexplained=unexplained,
        alike=alike,
        findings=findings(fits, alike),
        sentences=tuple(
            sentence(fits, k, divided, float(unexplained[k])) for k in range(e.n_joints)
        ),
        reasons=tuple(reason(fits, k, divided, float(unexplained[k])) for k in range(e.n_joints)),
        values=values,
    )
