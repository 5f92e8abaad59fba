"""The model as designed beside the model as built, parameter by parameter and torque by torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.identification.metrics import TorqueMetrics
from asbuilt.tables import SIGNIFICANT_SIGMAS, Cell, Column, Shown, Table, beside, deviation, percent, rounded, share, significant, stacked
from asbuilt.validation.prediction import Validation, design_values, torque_units

if TYPE_CHECKING:
    from asbuilt.identification.result import IdentificationResult

Verdict = Literal["differs", "agrees", "no CAD value", "not determined"]


@dataclass(frozen=True, slots=True)
class ComparedParameter:
    """One base parameter by design and as built; `sigmas` is their difference in standard errors, None where it has no meaning."""

    id: int
    name: str
    expression: str
    unit: str
    cad: float | None
    estimate: float
    std_error: float | None
    sigmas: float | None
    verdict: Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Hold CAD against as built: parameters as in Table 2 of the 2015 paper, torque errors as in its Table 3.

    `torque` pairs the metrics (CAD, as built) on each recording; the first is the one to judge by.
    """

    robot: str
    cad_source: str
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    parameters: tuple[ComparedParameter, ...]
    torque: tuple[tuple[TorqueMetrics | None, TorqueMetrics], ...]
    threshold: float = SIGNIFICANT_SIGMAS

    @property
    def n_differing(self) -> int:
        """Number of parameters that differ beyond doubt."""
        return sum(parameter.verdict == "differs" for parameter in self.parameters)

    @property
    def n_compared(self) -> int:
        """Number of parameters with a CAD value and a standard error."""
        return sum(parameter.verdict in ("differs", "agrees") for parameter in self.parameters)

    def verdict(self) -> str:
        """Return the outcome in a sentence or two."""
        text = f"{self.n_differing} of {self.n_compared} parameters with a CAD value differ by {self.threshold:g} standard errors or more."
        if not self.torque:
            return text
        cad, built = self.torque[0]
        if cad is None:
            return f"{text} Torque error as built {share(built.relative_error)} on {recording_name(built.source)}."
        return f"{text} Torque error on {recording_name(built.source)}: CAD {share(cad.relative_error)}, as built {share(built.relative_error)}."

    def parameter_table(self) -> Table:
        """Return Table 2: id, expression, CAD, as built, standard error, difference in standard errors."""
        return parameter_table(self.parameters, threshold=self.threshold)

    def torque_table(self) -> Table:
        """Return Table 3: RMS torque error of each joint, CAD and as built, for each recording."""
        heads = [Column("recording", width=40), Column("parameters")]
        heads += [Column(name, unit, "decimal", width=16) for name, unit in zip(self.joint_names, self.units, strict=True)]
        heads.append(Column("relative error", align="decimal"))
        rows: list[tuple[Cell, ...]] = []
        for cad, built in self.torque:
            for what, metrics in (("CAD", cad), ("as built", built)):
                if metrics is not None:
                    rms = [Shown(float(value), significant(float(value))) for value in metrics.rms]
                    rows.append((recording_name(metrics.source), what, *rms, Shown(metrics.relative_error, share(metrics.relative_error))))
        return Table(tuple(heads), tuple(rows), title="RMS torque error")

    def as_text(self) -> str:
        """Return verdict and both tables for a terminal."""
        head = f"{self.robot}: as built against {self.cad_source}\n{self.verdict()}\n\n"
        return head + stacked([self.parameter_table(), *([self.torque_table()] if self.torque else [])])

    def as_csv(self) -> str:
        """Return the parameter table as CSV."""
        return self.parameter_table().as_csv()

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, lists and None, ready for JSON."""
        return {
            "robot": self.robot,
            "cad": self.cad_source,
            "joints": list(self.joint_names),
            "threshold_sigmas": self.threshold,
            "n_compared": self.n_compared,
            "n_differing": self.n_differing,
            "verdict": self.verdict(),
            "parameters": [
                {
                    "id": parameter.id,
                    "name": parameter.name,
                    "expression": parameter.expression,
                    "unit": parameter.unit,
                    "cad": parameter.cad,
                    "estimate": parameter.estimate,
                    "std_error": parameter.std_error,
                    "sigmas": parameter.sigmas,
                    "verdict": parameter.verdict,
                }
                for parameter in self.parameters
            ],
            "torque": [{"cad": None if cad is None else cad.as_dict(), "as_built": built.as_dict()} for cad, built in self.torque],
        }


def compare(
    result: IdentificationResult,
    cad: RobotModel | None = None,
    validation: Validation | Sequence[Validation] | None = None,
    *,
    threshold: float = SIGNIFICANT_SIGMAS,
) -> Comparison:
    """Compare a result with the description it started from, or with `cad`, another description of the same geometry.

    `validation` gives the torque errors to put side by side (made with the same `cad`); without it the result's own metrics serve.
    A parameter differs where CAD and estimate are `threshold` standard errors apart or more.
    """
    values = result.cad_values if cad is None else design_values(result, cad)
    compared = []
    for parameter, by_design in zip(result.parameters, values.tolist(), strict=True):
        known = by_design if np.isfinite(by_design) else None
        error = parameter.std_error if np.isfinite(parameter.std_error) and parameter.std_error > 0 else None
        sigmas = None if known is None or error is None or not parameter.determined else (parameter.estimate - known) / error
        verdict: Verdict = "differs" if sigmas is not None and abs(sigmas) >= threshold else "agrees"
        if sigmas is None:
            verdict = "not determined" if not parameter.determined or error is None else "no CAD value"
        compared.append(
            ComparedParameter(
                parameter.id, parameter.name, parameter.expression, parameter.unit, known, parameter.estimate, error, sigmas, verdict
            )
        )
    return Comparison(
        robot=result.robot,
        cad_source="CAD" if cad is None else cad.name,
        joint_names=tuple(result.joint_names),
        units=torque_units(result.model),
        parameters=tuple(compared),
        torque=_paired(result, cad, validation),
        threshold=threshold,
    )


def parameter_table(parameters: Sequence[ComparedParameter], *, threshold: float = SIGNIFICANT_SIGMAS, width: int | None = 44) -> Table:
    """Return the table of compared parameters; text cuts expressions at `width` characters, HTML and CSV have them whole."""
    heads = (
        Column("id", align="right"),
        Column("parameter", width=width),
        Column("unit"),
        Column("CAD", align="decimal"),
        Column("as built", align="decimal"),
        Column("std err", align="decimal"),
        Column("%", align="decimal"),
        Column("CAD vs built", align="right"),
    )
    rows = []
    for parameter in parameters:
        shown, error = rounded(parameter.estimate, parameter.std_error)
        cad = None if parameter.cad is None else Shown(parameter.cad, beside(parameter.cad, parameter.std_error))
        outcome = deviation(parameter.sigmas, threshold) if parameter.verdict in ("differs", "agrees") else parameter.verdict
        relative = None
        if parameter.std_error is not None and parameter.estimate:
            relative = 100.0 * abs(parameter.std_error / parameter.estimate)
        rows.append(
            (
                parameter.id,
                parameter.expression,
                parameter.unit,
                cad,
                Shown(parameter.estimate, shown),
                Shown(parameter.std_error, error),
                Shown(relative, percent(parameter.estimate, parameter.std_error)),
                Shown(parameter.sigmas, outcome) if parameter.sigmas is not None else outcome,
            )
        )
    note = f"DIFFERS: CAD and as built are {threshold:g} standard errors apart or more; standard errors allow for correlated torque errors."
    return Table(heads, tuple(rows), title="Base parameters", notes=(note,))


def recording_name(source: str) -> str:
    """Return the source of a recording without the folders of its files.

    >>> recording_name("data/a.csv, data/b.csv")
    'a.csv, b.csv'
    """
    return ", ".join(PurePath(part).name or part for part in source.split(", "))


def _paired(
    result: IdentificationResult, cad: RobotModel | None, validation: Validation | Sequence[Validation] | None
) -> tuple[tuple[TorqueMetrics | None, TorqueMetrics], ...]:
    if validation is not None:
        several = [validation] if isinstance(validation, Validation) else list(validation)
        return tuple((item.metrics_cad, item.metrics_as_built) for item in several)
    if cad is not None:
        return tuple((None, metrics) for metrics in (result.validation or (result.train,)))
    measured = result.validation or (result.train,)
    return tuple((result.cad if metrics.source == result.cad.source else None, metrics) for metrics in measured)
