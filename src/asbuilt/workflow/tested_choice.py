"""What a fit chose, tested by motion that was left out: the kind of fit, and its effects."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.identification import FoundEffect, SquareRootInformation, accumulate_stream
from asbuilt.identification.effects.effect_findings import list_term_places
from asbuilt.identification.identify import Fit
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.result.torque_prediction import set_link_parameters
from asbuilt.identification.statistics import exceeds
from asbuilt.validation.generalisation.coverage import NEAR, measure_repeated_share
from asbuilt.workflow.prepare import Prepared

FEWEST_BLOCKS = 3
"""Time blocks left out below which differences have no usable standard error."""


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """Hold a fit and the equations of other motion that it has not seen.

    A fit expects errors on other motion from its own motion alone. The squared torque error of each
    time block that was left out, as a share of its recording's squared torque, tests what it chose;
    better is a mean paired difference beyond one standard error. Recordings that repeat the
    training motion test nothing: on the LWR4+ least squares predicts a repetition better than a fit
    toward CAD, and another motion three times worse.

    Parameters
    ----------
    fit
        The fit.
    seen
        Square-root information of each recording left out.
    errors
        Squared errors of the fit on all their time blocks, (B,).
    """

    fit: Fit
    seen: Sequence[SquareRootInformation]
    errors: Array

    @classmethod
    def of(cls, fit: Fit, prepared: Prepared) -> LeftOut | None:
        """Return the test of a fit to the training samples; None if too little was left out."""
        base = fit.base
        model = fit.model
        if base.drive.needs_load:
            model = set_link_parameters(model, base, fit.estimate.beta)
        seen = [
            accumulate_stream(model, base, [samples])
            for samples in prepared.unseen
            if measure_repeated_share(prepared.training, samples) <= NEAR.repeated
        ]
        if sum(each.n_blocks for each in seen) < FEWEST_BLOCKS:
            return None
        return cls(fit, seen, measure_block_errors(seen, fit.estimate.beta))

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
