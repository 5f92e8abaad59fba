"""Final fit to all data, after a part of them was held out for the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Finding, ranked
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.validation.generalisation.effect_bias import with_effects
from asbuilt.validation.generalisation.missing_effects import MissingEffect
from asbuilt.workflow.options import StudyOptions

KEPT = ("Cutoff: ", "base tilt of ", "no significant base tilt")
"""How notes on choices begin that both fits share."""


def fitted_to_everything(
    trained: IdentificationResult,
    findings: Sequence[Finding],
    whole: Sequence[Samples],
    options: StudyOptions,
    effects: Sequence[MissingEffect] = (),
) -> dict[str, Any]:
    """Return result and findings of a study whose parameters are of a fit to all samples.

    What was chosen on the training part stays: mounting, drive terms with their nonlinear
    parameters, signal chain. Validation metrics stay those of the training fit, whose values the
    result keeps as `trained`, since the final fit has seen what was held out.

    Parameters
    ----------
    trained, findings
        The result of the training part, and all that was said of it.
    whole
        All samples, nothing held out.
    options
        How to identify.
    effects
        Effects that the model lacks, whose bias the standard errors include.
    """
    fit = fit_samples(
        trained.model,
        whole,
        base=trained.base,
        method=options.method,
        undetermined=options.undetermined,
        errors=options.errors,
        block_seconds=options.block_seconds,
        threads=options.threads,
    )
    fit = with_effects(fit, whole, effects, block_seconds=options.block_seconds)
    train, _ = fit.metrics(whole)
    note = (
        f"Held-out errors are of a fit without what was held out ({trained.holdout},"
        f" {trained.method}); parameters, their errors and the training error are of the final fit"
        " to everything."
    )
    final = fit.concluded(
        train,
        trained.cad,
        validation=trained.validation,
        cause_data=trained.cause_data,
        chain=trained.chain,
        holdout=trained.holdout,
        digests=trained.digests,
        delay=trained.delay,
        servo=trained.servo,
        servo_errors=trained.servo_errors,
        notes=(note, *(line for line in trained.notes if line.startswith(KEPT))),
        corrected=trained.corrected,
        trained=trained.estimates,
    )
    further = [line for line in trained.provenance if line not in final.provenance]
    final = replace(final, provenance=(*final.provenance, *further))
    said = [finding for finding in findings if finding not in trained.findings]
    return {"result": final, "findings": ranked((*final.findings, *said))}
