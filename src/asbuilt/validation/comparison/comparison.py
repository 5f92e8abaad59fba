"""Comparison of CAD with the robot as built: parameters and torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import PurePath
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.description.model import RobotModel
from asbuilt.experiment.signal.samples import RECORDINGS, Blocks, parse_rule
from asbuilt.findings import join_names
from asbuilt.identification import CauseData, IdentificationResult, Identified, TorqueMetrics
from asbuilt.tables import Table, format_share, round_significant, stack_tables, wrap_text
from asbuilt.validation.comparison.cad_tolerance import CadTolerance, check_tolerance
from asbuilt.validation.comparison.compared_parameter import (
    ComparedParameter,
    Verdict,
    list_tests,
    rank_by_torque,
    tabulate_parameters,
)
from asbuilt.validation.comparison.equal_terms import select_tested_values
from asbuilt.validation.comparison.significance import RESOLUTION, ChiSquare, compare_each
from asbuilt.validation.comparison.torque_change import tabulate_named_errors
from asbuilt.validation.prediction import Validation, derive_cad_values, torque_units

FALSE_DISCOVERY_RATE = 0.05
"""Expected share of wrong ones among the parameters that differ (usual level)."""


HELD_OUT = ", held out "
"""What comes between a recording's name and the rule by which part of it was held out."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison:
    """Hold CAD and as built side by side, as in Tables 2 and 3 of the 2015 paper.

    | attribute | meaning |
    |---|---|
    | `parameters` | base parameters by design and as built |
    | `torque` | pairs of metrics (CAD, as built) on each recording, the one to validate on first |
    | `level` | false discovery rate at which a parameter differs |
    | `chi_square` | test of all parameters with a CAD value at once, by weighted least squares |
    | `tolerance`, `chi_square_tolerance` | tolerances of CAD, and the same test with them |
    | `tolerance_needed` | factor on the tolerances that covers the differences; None if 1 does |
    | `beyond_tolerance` | names of the parameters that exceed their tolerances |
    | `errors` | how standard errors were estimated |
    """

    robot: str
    cad_source: str
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    parameters: tuple[ComparedParameter, ...]
    torque: tuple[tuple[TorqueMetrics | None, TorqueMetrics], ...]
    level: float = FALSE_DISCOVERY_RATE
    chi_square: ChiSquare | None = None
    chi_square_tolerance: ChiSquare | None = None
    tolerance: CadTolerance | None = None
    tolerance_needed: float | None = None
    beyond_tolerance: tuple[str, ...] = ()
    judged_by: str = ""
    errors: str = ""

    def __repr__(self) -> str:
        return f"<Comparison of {self.robot} with {self.cad_source}: {self.verdict()}>"

    def _repr_html_(self) -> str:
        return self.parameter_table().as_html()

    @property
    def n_differing(self) -> int:
        """Number of parameters that differ significantly, and by more than `RESOLUTION`."""
        return sum(parameter.verdict == "differs" for parameter in self.parameters)

    @property
    def n_compared(self) -> int:
        """Number of parameters with a CAD value and a standard error."""
        return sum(parameter.verdict in ("differs", "agrees") for parameter in self.parameters)

    @property
    def n_mattering(self) -> int | None:
        """Number of parameters that differ and matter to the torque; None if that is unknown."""
        known = [
            parameter.matters and parameter.verdict == "differs"
            for parameter in self.parameters
            if parameter.matters is not None
        ]
        return sum(known) if known else None

    @property
    def ranked(self) -> tuple[ComparedParameter, ...]:
        """The parameters, those whose difference changes the torque most first."""
        return rank_by_torque(self.parameters)

    def relevance(self) -> str:
        """Return of how many differences the torque is their own; nothing if that is unknown."""
        n = self.n_mattering
        if n is None or not self.n_differing:
            return ""
        return (
            f"; other parameters cannot make up for the torque of {n}"
            if n
            else "; other parameters can make up for the torque of each"
        )

    def verdict(self) -> str:
        """Return the outcome in one or two sentences."""
        text = (
            f"The log contradicts {self.n_differing} of {self.n_compared} base parameters of CAD"
            f" ({self.rule()}){self.relevance()}."
            if self.n_compared
            else "No parameter has a CAD value."
        )
        if not self.torque:
            return text
        cad, built = self.torque[0]
        error = format_share(built.relative_error)
        source = recording_name(built.source)
        if cad is None or not self.n_compared:
            return f"{text} Torque error as built {error} on {source}."
        return (
            f"{text} Torque error on {source}: CAD {format_share(cad.relative_error)}, as"
            f" built {error}."
        )

    def rule(self) -> str:
        """Return the rule by which parameters are contradicted."""
        return (
            f"off by more than {format_share(RESOLUTION, 0)}, false discovery rate"
            f" {format_share(self.level, 0)}"
        )

    def tests(self) -> tuple[str, ...]:
        """Return the tests of all parameters at once, as sentences."""
        found = []
        if self.chi_square is not None and self.chi_square.degrees:
            found.append(f"All CAD values at once: {self.chi_square.text}.")
        if self.chi_square_tolerance is not None and self.tolerance is not None:
            claimed = (
                f"{format_share(self.tolerance.mass, 0)} of mass,"
                f" {format_share(self.tolerance.centre, 0)} of"
                f" the centre and {format_share(self.tolerance.inertia, 0)} of inertia"
            )
            within = self.chi_square_tolerance.probability > self.level
            found.append(
                f"With tolerances of {claimed}: {self.chi_square_tolerance.text}; CAD is"
                f" {'within' if within else 'beyond'} its tolerances."
            )
            if self.tolerance_needed is not None:
                found.append(
                    f"Tolerances {round_significant(self.tolerance_needed, 2)} times as wide"
                    " would cover"
                    " the differences."
                )
            if self.beyond_tolerance:
                found.append(
                    f"Parameters beyond their tolerances ({self.rule()}):"
                    f" {join_names(self.beyond_tolerance, 14)}."
                )
        return tuple(found)

    def parameter_table(self) -> Table:
        """Return the parameters as in Table 2 of the 2015 paper, the most torque first."""
        return tabulate_parameters(
            self.ranked, level=self.level, errors=self.errors, units=self.units
        )

    def torque_table(self) -> Table:
        """Return the RMS torque errors as in Table 3 of the 2015 paper, a column per recording."""
        return tabulate_paired_torques(self.torque, ("CAD", "as built"), self.units)

    def as_text(self, full: bool = False) -> str:
        """Return verdict and both tables for a terminal.

        Parameters
        ----------
        full
            Show all parameters and notes; else what fits one screen of 80 columns.
        """
        tables = [*([self.torque_table()] if self.torque else []), self.parameter_table()]
        return self.heading(full) + "\n" + stack_tables(tables, full)

    def heading(self, full: bool = False) -> str:
        """Return the verdict and the tests of all parameters as lines of 80 columns."""
        tests = self.tests() if full or self.tolerance is not None else ()
        lines = (f"{self.robot}: as built against {self.cad_source}", self.verdict(), *tests)
        return "\n".join(map(wrap_text, lines)) + "\n"

    def as_csv(self) -> str:
        """Return the parameter table as CSV."""
        return self.parameter_table().as_csv()

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, lists and None, ready for JSON."""
        return {
            "robot": self.robot,
            "cad": self.cad_source,
            "joints": list(self.joint_names),
            "false_discovery_rate": self.level,
            "n_compared": self.n_compared,
            "n_differing": self.n_differing,
            "n_mattering": self.n_mattering,
            "verdict": self.verdict(),
            "judged_by": self.judged_by,
            "errors": self.errors,
            "chi_square": None if self.chi_square is None else asdict(self.chi_square),
            "chi_square_tolerance": (
                None if self.chi_square_tolerance is None else asdict(self.chi_square_tolerance)
            ),
            "tolerance": None if self.tolerance is None else asdict(self.tolerance),
            "tolerance_needed": self.tolerance_needed,
            "beyond_tolerance": list(self.beyond_tolerance),
            "parameters": [parameter.as_dict() for parameter in self.ranked],
            "torque": [
                {"cad": None if cad is None else cad.as_dict(), "as_built": built.as_dict()}
                for cad, built in self.torque
            ],
        }


def compare(
    result: IdentificationResult | Identified,
    cad: RobotModel | None = None,
    validation: Validation | Sequence[Validation] | None = None,
    *,
    level: float = FALSE_DISCOVERY_RATE,
    tolerance: CadTolerance | None = None,
) -> Comparison:
    """Compare a result with CAD.

    Parameters
    ----------
    result
        The result, or its study.
    cad
        Another description of the same geometry; None: the one identified with.
    validation
        Torque errors to compare, made with the same `cad`; None: errors of the result, or for
        another `cad` errors on its cause data.
    level
        False discovery rate up to which a parameter differs.
    tolerance
        Tolerances of CAD to test.

    Returns
    -------
    Comparison
        Parameters, torque errors and tests.
    """
    result = result.result
    values = result.cad_values if cad is None else derive_cad_values(result, cad)
    determined = np.array(
        [p.determined and np.isfinite(p.std_error) and p.std_error > 0 for p in result.parameters]
    )
    tested = determined & np.isfinite(values)
    freedom = result.degrees_of_freedom
    difference = np.where(tested, result.estimates - values, np.nan)
    tests = compare_each(difference, result.std_errors, freedom, tested)
    # Without a CAD value there is no difference whose torque could matter.
    fields = list_tests(result, range(result.n_base), result.estimates - values, tests)
    compared = []
    for j, (parameter, test) in enumerate(zip(result.parameters, fields, strict=True)):
        verdict: Verdict = "no CAD value" if determined[j] else "not determined"
        if tested[j]:
            # Significant and large: many samples make any difference significant.
            beyond = abs(difference[j]) > RESOLUTION * abs(values[j])
            verdict = "differs" if test["false_discovery"] <= level and beyond else "agrees"
        elif parameter.dropped:
            verdict = "dropped"
        compared.append(
            ComparedParameter(
                cad=make_plain(values[j]),
                estimate=parameter.estimate,
                std_error=make_plain(parameter.std_error) or None,
                verdict=verdict,
                degrees_of_freedom=make_plain(freedom[j]) if tested[j] else None,
                **test,
            )
        )
    held, needed, beyond = (
        (None, None, ())
        if tolerance is None or not tested.any()
        else check_tolerance(
            tolerance,
            cad or result.model,
            result.base,
            difference,
            result.covariance,
            tested,
            level=level,
            degrees_of_freedom=freedom,
        )
    )
    return Comparison(
        robot=result.robot,
        cad_source="CAD" if cad is None else cad.name,
        joint_names=tuple(result.joint_names),
        units=torque_units(result.model),
        parameters=tuple(compared),
        torque=_pair_metrics(result, cad, values, validation),
        level=level,
        chi_square=select_tested_values(result).test_against(values) if tested.any() else None,
        chi_square_tolerance=held,
        tolerance=tolerance,
        tolerance_needed=needed,
        beyond_tolerance=beyond,
        errors=result.errors_sentence,
        judged_by="" if result.cause_data is None else recording_name(result.cause_data.judged_by),
    )


def tabulate_paired_torques(
    pairs: Sequence[tuple[TorqueMetrics | None, TorqueMetrics]],
    names: tuple[str, str],
    units: Sequence[str],
) -> Table:
    """Return the table of pairs of errors, a pair of named columns for each recording.

    Several recordings are numbered, with a legend.
    """
    named = [
        (f"{what} [{number}]" if len(pairs) > 1 else what, metrics)
        for number, pair in enumerate(pairs, start=1)
        for what, metrics in zip(names, pair, strict=True)
        if metrics is not None
    ]
    sources = tuple(recording_name(second.source) for _, second in pairs)
    if len(sources) == 1:
        return tabulate_named_errors(named, units, f"RMS torque error on {sources[0]}")
    return tabulate_named_errors(named, units, "RMS torque error", sources)


def recording_name(source: str) -> str:
    """Return the names of a recording's files without folders, and what of it was held out.

    >>> recording_name("data/a.csv, data/b.csv")
    'a.csv, b.csv'
    >>> recording_name("data/a.csv, held out blocks:3.3s:3")
    'a.csv (every third 3.3 s)'
    >>> recording_name("data/a.csv, held out recordings")
    'a.csv (left out)'
    """
    whole, _, rule = source.partition(HELD_OUT)
    names = ", ".join(PurePath(part).name or part for part in whole.split(", "))
    if not rule:
        return names
    if rule == RECORDINGS:
        return f"{names} (left out)"
    part = parse_rule(rule)
    if isinstance(part, Blocks):
        ordinal = {2: "second", 3: "third"}.get(part.every, f"{part.every}th")
        return f"{names} (every {ordinal} {part.seconds:g} s)"
    return f"{names} (the last {format_share(part.share, 0)})"


def _pair_metrics(
    result: IdentificationResult,
    cad: RobotModel | None,
    values: Array,
    validation: Validation | Sequence[Validation] | None,
) -> tuple[tuple[TorqueMetrics | None, TorqueMetrics], ...]:
    if validation is not None:
        several = [validation] if isinstance(validation, Validation) else list(validation)
        return tuple((item.metrics_cad, item.metrics_as_built) for item in several)
    measured = result.validation or (result.train,)
    if cad is None:
        # The recording on which CAD is measured comes first.
        measured = tuple(sorted(measured, key=lambda robot: robot.source != result.cad.source))
        return tuple(
            (result.cad if metrics.source == result.cad.source else None, metrics)
            for metrics in measured
        )
    # Another CAD has no errors of its own but those of the cause data.
    if result.cause_data is None or not result.validation:
        return tuple((None, metrics) for metrics in measured)
    beta = np.nan_to_num(values, nan=0.0)
    evident = _measure_from_sums(result, result.cause_data, beta, measured[0])
    return ((evident, measured[0]), *((None, metrics) for metrics in measured[1:]))


def _measure_from_sums(
    result: IdentificationResult, cause_data: CauseData, beta: Array, like: TorqueMetrics
) -> TorqueMetrics:
    """Return the metrics of a prediction on the validation motion, from sums of squares alone."""
    rms, torque = (
        cause_data.error_of(result.base.names, values_tried)
        for values_tried in (beta, np.zeros(len(beta)))
    )
    # Sums of squares hold no largest error.
    unknown = np.full(len(rms), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        return TorqueMetrics(
            source=like.source,
            joint_names=like.joint_names,
            n_samples=cause_data.n_judged,
            rms=rms,
            max_abs=unknown,
            r_squared=unknown,
            relative_error=float(np.linalg.norm(rms) / np.linalg.norm(torque)),
            relative_error_per_joint=rms / torque,
        )
