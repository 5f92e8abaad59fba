"""What a fit chose, tested by motion that was left out: the kind of fit, and its effects."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification import FoundEffect, SquareRootInformation, accumulate_stream
from asbuilt.identification.effects.effect_findings import list_term_places
from asbuilt.identification.identify import Fit
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.result.torque_prediction import set_link_parameters
from asbuilt.statistics import exceeds
from asbuilt.validation.generalisation.coverage import REPEATED, measure_repeated_share
from asbuilt.workflow.prepare import Prepared

FEWEST_BLOCKS = 3
"""Time blocks left out below which differences have no usable standard error."""


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """Hold a fit and the equations of other motion that it has not seen.

    A fit expects errors on other motion from its own motion alone. The squared torque error of each
    time block that was left out, as a share of its recording's squared torque, tests what it chose;
    better is a mean paired difference beyond one standard error. Recordings that repeat the
    training motion test no kind of fit: on the LWR4+ least squares predicts a repetition better
    than a fit toward CAD, and another motion three times worse. An effect that does not even help
    there is not shown.

    Parameters
    ----------
    fit
        The fit.
    samples, seen
        Each recording left out, and its square-root information.
    errors
        Squared errors of the fit on all their time blocks, (B,).
    """

    fit: Fit
    samples: Sequence[Samples]
    seen: Sequence[SquareRootInformation]
    errors: Array

    @classmethod
    def of(cls, fit: Fit, prepared: Prepared, *, even_repeated: bool = False) -> LeftOut | None:
        """Return the test of a fit to the training samples; None if too little was left out.

        Of other motion alone, or even of what repeats the motion fitted.
        """
        samples = [
            recording
            for recording in prepared.unseen
            if even_repeated or measure_repeated_share(prepared.training, recording) <= REPEATED
        ]
        seen = _accumulate_for(fit, samples)
        if sum(information.n_blocks for information in seen) < FEWEST_BLOCKS:
            return None
        return cls(fit, samples, seen, measure_block_errors(seen, fit.estimate.beta))

    def measure_gain_over(self, other: Fit) -> Array:
        """Return by how much another fit, of whatever drive terms, errs more, (B,)."""
        seen = _accumulate_for(other, self.samples)
        return measure_block_errors(seen, other.estimate.beta) - self.errors

    def find_better_kind(self) -> str:
        """Return the kind of consistent fit that predicts what was left out surely better, or "".

        Bodies are consistent: values that are not show what else the model lacks by predicting
        better, and no simulator takes them.
        """
        tried = [
            (measure_block_errors(self.seen, beta), kind)
            for kind, beta in self.fit.estimate.rivals.items()
        ]
        for errors, kind in sorted(tried, key=lambda pair: float(pair[0].sum())):
            if exceeds(self.errors - errors, 1.0):
                return kind
        return ""

    def list_harmful(self, found: Iterable[FoundEffect]) -> set[tuple[str, str]]:
        """Return key and joint of the effect without which other motion is predicted best.

        Empty if every effect is needed, or none is surely harmful.
        """
        base = self.fit.base
        tried = []
        for effect, places in list_term_places(found, base, self.fit.model.joint_names):
            without = drop_parameters(self.fit.estimate, places)
            gain = self.errors - measure_block_errors(self.seen, without)
            if exceeds(gain, 1.0):
                tried.append((float(gain.sum()), (effect.effect, str(effect.joint))))
        return {max(tried)[1]} if tried else set()


def _accumulate_for(fit: Fit, samples: Iterable[Samples]) -> list[SquareRootInformation]:
    """Return the information of each recording, friction loaded by the bodies of a fit."""
    model = fit.model
    if fit.base.drive.needs_load:
        model = set_link_parameters(model, fit.base, fit.estimate.beta)
    return [accumulate_stream(model, fit.base, [recording]) for recording in samples]


def drop_parameters(estimate: Estimate, places: Indices) -> Array:
    """Return beta (p,) with some parameters at zero, and the others fitted again.

    Without parameters J the others of a fit with the covariance C are `beta - C_J C_JJ^-1 beta_J`:
    exact for least squares, to second order where bodies are regularised.
    """
    root = estimate.solution.inverse_root
    across = root @ root[places].T
    return np.asarray(
        estimate.beta - across @ np.linalg.pinv(across[places]) @ estimate.beta[places]
    )


def measure_block_errors(seen: Iterable[SquareRootInformation], beta: Array) -> Array:
    """Return the squared error of each time block in its recording's squared torque, (B,)."""
    found: list[float] = []
    for recording in seen:
        # A recording without torque has no error to share.
        torque = max(float(recording.torque_energy.sum()), np.finfo(np.float64).tiny)
        blocks = (recording.select([block]) for block in range(recording.n_blocks))
        found += [float(block.residual_energy(beta).sum()) / torque for block in blocks]
    return np.array(found)
