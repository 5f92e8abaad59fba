"""The outcome of an identification: every number with its uncertainty, its verdict and where it came from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.description.document import model_document, model_from_document
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import AsbuiltError, ResultError
from asbuilt.identification.metrics import TorqueMetrics
from asbuilt.identification.torque_prediction import Prediction, predict_torque

if TYPE_CHECKING:
    from asbuilt.experiment.samples import Samples
    from asbuilt.identification.summary import Summary

Array = NDArray[np.float64]

FORMAT = "asbuilt identification result"
FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True)
class IdentificationWarning:
    """Something the user must know: a stable `code` for programs, a `message` with values and a way out for people."""

    code: str
    message: str


@dataclass(frozen=True, slots=True)
class IdentifiedParameter:
    """One base parameter: its value by design (`cad`, NaN where the description is silent) and as built, with standard errors.

    `std_error` allows for correlated residuals, `textbook_std_error` takes them as white. `determined` is False where this recording does
    not tell the parameter and `estimate` leans on CAD; both errors then cover only the part that the recording tells.
    """

    id: int
    name: str
    expression: str
    symbolic: str
    unit: str
    cad: float
    estimate: float
    std_error: float
    textbook_std_error: float
    determined: bool

    @property
    def relative_error(self) -> float:
        """Standard error as a fraction of the estimate."""
        return self.std_error / abs(self.estimate) if self.estimate else np.inf

    @property
    def difference_in_sigmas(self) -> float:
        """As built minus CAD, in standard errors; NaN where CAD is silent."""
        return (self.estimate - self.cad) / self.std_error if self.std_error > 0 else np.nan


@dataclass(frozen=True, slots=True, eq=False)
class IdentificationResult:
    """Hold what an identification found, of a robot with n joints and p base parameters (drive terms included).

    | attribute | what |
    |---|---|
    | `model`, `base` | the robot as designed and its base parameters |
    | `method` | `"ols"`, `"wls"`, ... |
    | `sources` | the recordings it was identified from |
    | `n_samples`, `rate`, `duration` | samples used (each gives n torques), Hz and s, after filtering and decimation |
    | `parameters` | p of `IdentifiedParameter` |
    | `covariance` | (p, p), allowing for correlated residuals |
    | `textbook_covariance` | (p, p), residuals taken as white |
    | `sigma` | (n,) standard deviation of the torque residual of each joint |
    | `effective_samples` | how many independent samples the recording is worth |
    | `rank`, `singular_values` | rank of this recording and the (p,) singular values of the weighted, column-scaled stack, largest first |
    | `condition_number`, `scaled_condition_number` | of the weighted stack, and with columns scaled to unit length |
    | `undetermined` | the combinations of parameters that this recording does not excite, readable |
    | `train`, `validation`, `cad` | torque metrics: on the data used, on other data, and of the CAD values |
    | `physically_consistent`, `consistency_margin` | whether any standard parameters of real bodies have these base parameters; None if unknown |
    | `warnings`, `provenance` | what to know, and how the samples were made |
    """

    model: RobotModel
    base: BaseParameters
    method: str
    sources: tuple[str, ...]
    n_samples: int
    rate: float
    duration: float
    parameters: tuple[IdentifiedParameter, ...]
    covariance: Array
    textbook_covariance: Array
    sigma: Array
    effective_samples: float
    rank: int
    singular_values: Array
    condition_number: float
    scaled_condition_number: float
    undetermined: tuple[str, ...]
    train: TorqueMetrics
    validation: tuple[TorqueMetrics, ...]
    cad: TorqueMetrics
    physically_consistent: bool | None
    consistency_margin: float | None
    warnings: tuple[IdentificationWarning, ...]
    provenance: tuple[str, ...]

    def __post_init__(self) -> None:
        p, n = self.base.n_base, self.model.n_joints
        shapes = {"covariance": (p, p), "textbook_covariance": (p, p), "sigma": (n,), "singular_values": (p,)}
        for name, shape in shapes.items():
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != shape:
                raise ResultError(f"{name} must have shape {shape} for {n} joints and {p} base parameters, got {values.shape}")
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        if len(self.parameters) != p:
            raise ResultError(f"a result for {p} base parameters needs as many parameters, got {len(self.parameters)}")

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return self.model.name

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names in model order."""
        return self.model.joint_names

    @property
    def n_standard(self) -> int:
        """Number of standard parameters, drive terms included."""
        return self.base.n_standard

    @property
    def n_base(self) -> int:
        """Number of base parameters, drive terms included: the rank that the robot's structure allows."""
        return self.base.n_base

    @property
    def estimates(self) -> Array:
        """Base parameters as built, shape (p,)."""
        return np.array([parameter.estimate for parameter in self.parameters])

    @property
    def cad_values(self) -> Array:
        """Base parameters by design, shape (p,); NaN where the description is silent."""
        return np.array([parameter.cad for parameter in self.parameters])

    @property
    def std_errors(self) -> Array:
        """Standard errors that allow for correlated residuals, shape (p,)."""
        return np.array([parameter.std_error for parameter in self.parameters])

    def predict(self, samples: Samples) -> Prediction:
        """Predict the torque of another recording from the values as built, on its filtered grid, beside what was measured there."""
        return predict_torque(self.model, self.base, self.estimates, samples)

    def predict_cad(self, samples: Samples) -> Prediction:
        """Predict the torque of a recording from the values by design; terms on which the description is silent add nothing."""
        return predict_torque(self.model, self.base, np.nan_to_num(self.cad_values, nan=0.0), samples)
