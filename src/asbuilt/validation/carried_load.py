"""A load that a recording carries and the model of the robot lacks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import shift_matrix
from asbuilt.description.model import RobotModel
from asbuilt.errors import IdentifiabilityError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification import (
    IdentificationResult,
    choose_payload_frame,
    identify_payload_samples,
)
from asbuilt.identification.calibration.added_moments import (
    AddedMoments,
    identify_added_moments,
)
from asbuilt.identification.result.torque_prediction import predict_torque
from asbuilt.tables import format_plus_minus, format_share

LOAD_NOISE = 4.0
"""Mean squared error in noise variances of the result below which no load is asked for: errors of
one model on two motions of one robot differ by less."""
LOAD_EXPLAINED = 0.8
"""Share of the squared error that four moments at the flange must explain: wrong masses of links
have their torques at other joints, and leave more."""


@dataclass(frozen=True, slots=True)
class CarriedLoad:
    """Hold the load that a recording carries beyond the model.

    Parameters
    ----------
    frame
        Frame that carries it.
    mass, std_error
        Mass [kg], negative where the model has a load that the recording lacks, and its error.
    relative_error
        Torque error of the model with the load, as a share of the torque.
    """

    frame: str
    mass: float
    std_error: float
    relative_error: float

    @property
    def text(self) -> str:
        """The load in words, after the name of the recording."""
        size = f"{format_plus_minus(abs(self.mass), self.std_error)} kg at {self.frame}"
        outcome = f"with it {format_share(self.relative_error, 0)} of the torque"
        if self.mass < 0.0:
            return f"lacks a load of {size} that the model has ({outcome} without it)"
        return f"carries a load of {size} that the model lacks ({outcome} unexplained)"


def find_carried_load(result: IdentificationResult, samples: Samples) -> CarriedLoad | None:
    """Return the load at the flange that explains most of a model's error; None if none does.

    The evidence is four moments of a weight beside the identified arm, which stays as it is. The
    mass is that of `identify_payload`, so that both say one number.
    """
    # Legs stand on what they carry, a torque that is computed explains itself, and a joint without
    # torque has no error.
    known = bool(np.all(samples.has_torque))
    if result.decided_by_motion or result.model.mixes_joints or not known:
        return None
    model = (result.model, result.base, result.estimates)
    bare = _mean_square(predict_torque(*model, samples).error * result.weights)
    if bare < LOAD_NOISE:
        return None
    try:
        moments = identify_added_moments(result, [samples])
    except IdentifiabilityError:
        return None
    if "m" not in moments.determined:
        return None
    loaded = predict_torque(*model, samples, added=_place_moments(result.model, moments))
    left = _mean_square(loaded.error * result.weights)
    if left > (1.0 - LOAD_EXPLAINED) * bare:
        return None
    mass = float(moments.values[3])
    if mass < 0.0:
        error = float(moments.std_errors[3])
        return CarriedLoad(moments.frame, mass, error, loaded.metrics().relative_error)
    try:
        payload = identify_payload_samples(result, samples)
    except IdentifiabilityError:
        return None
    return CarriedLoad(
        payload.frame,
        float(payload.values[0]),
        float(payload.std_errors[0]),
        payload.metrics[0].relative_error,
    )


def _place_moments(model: RobotModel, moments: AddedMoments) -> Array:
    """Return the link parameters (10 n,) of first moments and a mass in their frame."""
    _, link, placement = choose_payload_frame(model, moments.frame)
    body = np.concatenate([np.zeros(6), np.nan_to_num(moments.values)])
    added = np.zeros(10 * model.n_links)
    added[10 * link : 10 * link + 10] = shift_matrix(placement) @ body
    return added


def _mean_square(error: Array) -> float:
    return float(np.mean(error**2))
