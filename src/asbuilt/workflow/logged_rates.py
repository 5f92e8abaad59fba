"""Rates of a free base and its joints: those that the log holds, or derivatives of positions.

Feet that touch down turn joints faster than positions at the rate of a log resolve, so that high
frequencies are no measure of noise, as they are for an arm (`compare_velocities`). Which rates are
better is decided by what they are for: the torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import resolve_chain
from asbuilt.experiment.signal.prepared_motion import MotionFilters
from asbuilt.experiment.signal.signal_chain import SignalChain, Velocity
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.identification.information.triangular import triangular_factor


def settle_rates(
    model: RobotModel, heads: Sequence[Recording], chain: SignalChain, filters: MotionFilters
) -> SignalChain:
    """Return the chain with the rates from which the torque of a free base follows better.

    Rows, torques and parameters of both fits are the same, so that the smaller residual of least
    squares decides. The chain stays open where the root is fixed or a log holds no velocities.
    """
    if chain.velocity != "auto" or not model.n_floating or any(head.qd is None for head in heads):
        return chain
    alike = resolve_chain(chain, *heads, filters=filters)
    base = find_base_parameters(model, choose_usual_drive(model, heads[0].torque_source))

    def residual(velocity: Velocity) -> float:
        own = replace(alike, velocity=velocity, delay=None)
        samples = [filters.prepare(head, own).samples() for head in heads]
        factor = triangular_factor(accumulate_stream(model, base, samples).stacked())
        return float(factor[-1, -1])

    try:
        measured = residual("measured") < residual("derived")
    except (AsbuiltError, np.linalg.LinAlgError):
        return chain
    return replace(chain, velocity="measured" if measured else "derived")
