"""The outcome of an identification.

Every number with its uncertainty, its verdict and where it came from.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.formats.document import model_document, model_from_document
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import AsbuiltError, ResultError
from asbuilt.identification.errors.error_basis import ErrorBasis
from asbuilt.identification.information.cause_data import CauseData
from asbuilt.identification.result.free_values import FreeValues
from asbuilt.identification.result.metrics import TorqueMetrics
from asbuilt.identification.result.summary import Summary, summarise
from asbuilt.identification.result.torque_prediction import Prediction, predict_torque

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


FORMAT = "asbuilt identification result"
FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True)
class IdentificationWarning:
    """Something the user must know.

    A stable `code` for programs, a `message` with values and a way out for people.
    """

    code: str
    message: str


@dataclass(frozen=True, slots=True)
class IdentifiedParameter:
    """One base parameter: its value by design (`cad`, NaN where the description is silent) and as
    built, with standard errors.

    `std_error` is judged as the result's `errors` say, `textbook_std_error` takes residuals as
    white. `determined` is False where this recording does not tell the parameter and `estimate`
    leans on CAD; both errors then cover only the part that the recording tells. `poorly_determined`
    is True where the error is large beside the value and matters to the torque. `dropped` is True
    where the parameter was set to zero as needless (method `essential`): that is a choice, not a
    measurement, and both errors are NaN.
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
    poorly_determined: bool
    dropped: bool = False

    @property
    def relative_error(self) -> float:
        """Standard error as a fraction of the estimate."""
        if self.dropped:
            return np.nan
        return self.std_error / abs(self.estimate) if self.estimate else np.inf

    @property
    def difference_in_sigmas(self) -> float:
        """As built minus CAD, in standard errors; NaN where CAD is silent."""
        return (self.estimate - self.cad) / self.std_error if self.std_error > 0 else np.nan


@dataclass(frozen=True, slots=True, eq=False)
class IdentificationResult:
    """Hold what an identification found, of a robot with n joints and p base parameters (drive
    terms included).

    | attribute | what |
    |---|---|
    | `model`, `base` | the robot as designed and its base parameters |
    | `method` | `"ols"`, `"wls"`, ... |
    | `sources` | the recordings it was identified from |
    | `n_samples`, `rate`, `duration` | samples used (each gives n torques), Hz and s, after filtering and decimation |
    | `parameters` | p of `IdentifiedParameter` |
    | `errors` | how the standard errors were judged |
    | `covariance` | (p, p), judged that way; rows and columns of dropped parameters are zero |
    | `textbook_covariance` | (p, p), residuals taken as white |
    | `sigma` | (n,) standard deviation of the torque residual of each joint |
    | `effective_samples` | how many independent samples the recording is worth |
    | `rank`, `singular_values` | rank of this recording and the (p,) singular values of the weighted, column-scaled stack, largest first |
    | `condition_number`, `scaled_condition_number` | of the weighted stack, and with columns scaled to unit length |
    | `undetermined` | the combinations of parameters that this recording does not excite, readable |
    | `train`, `validation`, `cad` | torque metrics: on the data used, on other data, and of the CAD values |
    | `physically_consistent`, `consistency_margin` | whether any real bodies and passive drives have these base parameters, and how far inside the bodies are; None if unknown |
    | `warnings`, `provenance` | what to know, and how the samples were made |
    | `notes` | what the estimator decided, in sentences |
    | `cause_data` | what the recordings say of what CAD may have left out, for `attribute`; None where it was not gathered |
    | `free` | the parameters by weighted least squares alone, by which two results are compared; None where `method` is that |
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
    notes: tuple[str, ...] = ()
    cause_data: CauseData | None = None
    errors: ErrorBasis = field(default_factory=ErrorBasis)
    free: FreeValues | None = None

    def __post_init__(self) -> None:
        p, n = self.base.n_base, self.model.n_joints
        shapes = {
            "covariance": (p, p),
            "textbook_covariance": (p, p),
            "sigma": (n,),
            "singular_values": (p,),
        }
        for name, shape in shapes.items():
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != shape:
                raise ResultError(
                    f"{name} must have shape {shape} for {n} joints and {p} base parameters, got"
                    f" {values.shape}"
                )
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        if len(self.parameters) != p:
            raise ResultError(
                f"a result for {p} base parameters needs as many parameters, got"
                f" {len(self.parameters)}"
            )
        if self.free is not None and len(self.free.estimates) != p:
            raise ResultError(
                f"a result for {p} base parameters needs as many free values, got"
                f" {len(self.free.estimates)}"
            )

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
        """Number of base parameters, drive terms included.

        The rank that the robot's structure allows.
        """
        return self.base.n_base

    @property
    def estimates(self) -> Array:
        """Base parameters as built, shape (p,)."""
        return np.array([parameter.estimate for parameter in self.parameters])

    @property
    def weights(self) -> Array:
        """One over the standard deviation of the torque residual of each joint, (n,).

        Large but finite where there is none.
        """
        return np.asarray(1.0 / np.maximum(self.sigma, np.finfo(np.float64).tiny))

    @property
    def cad_values(self) -> Array:
        """Base parameters by design, shape (p,); NaN where the description is silent."""
        return np.array([parameter.cad for parameter in self.parameters])

    @property
    def std_errors(self) -> Array:
        """Standard errors, judged as `errors` says, shape (p,); NaN for dropped parameters."""
        return np.array([parameter.std_error for parameter in self.parameters])

    @property
    def dropped(self) -> NDArray[np.bool_]:
        """Which parameters were set to zero as needless, shape (p,)."""
        return np.array([parameter.dropped for parameter in self.parameters])

    @property
    def errors_sentence(self) -> str:
        """How the standard errors were judged, in a sentence."""
        return self.errors.sentence(self.effective_samples, self.n_samples)

    def predict(self, samples: Samples) -> Prediction:
        """Predict the torque of another recording from the values as built, on its filtered grid,
        beside what was measured there.
        """
        return predict_torque(self.model, self.base, self.estimates, samples)

    def predict_cad(self, samples: Samples) -> Prediction:
        """Predict the torque of a recording from the values by design.

        Terms on which the description is silent add nothing.
        """
        return predict_torque(
            self.model, self.base, np.nan_to_num(self.cad_values, nan=0.0), samples
        )

    def summary(self) -> Summary:
        """Return the result as text, HTML or CSV."""
        return summarise(self)

    def as_dict(self) -> dict[str, Any]:
        """Return what programs rely on, without the robot and the covariances.

        Plain numbers, texts and lists, None for what is undefined.
        """
        return {
            "robot": self.robot,
            "method": self.method,
            "drive": list(self.base.drive.specifications),
            "sources": list(self.sources),
            "n_samples": self.n_samples,
            "rate": self.rate,
            "duration": self.duration,
            "effective_samples": self.effective_samples,
            "errors": self.errors.as_dict(),
            "n_standard": self.n_standard,
            "n_base": self.n_base,
            "rank": self.rank,
            "condition_number": _finite(self.condition_number),
            "scaled_condition_number": _finite(self.scaled_condition_number),
            "joints": list(self.joint_names),
            "sigma": self.sigma.tolist(),
            "parameters": [
                {name: _finite(value) for name, value in asdict(parameter).items()}
                for parameter in self.parameters
            ],
            "undetermined": list(self.undetermined),
            "train": self.train.as_dict(),
            "validation": [metrics.as_dict() for metrics in self.validation],
            "cad": self.cad.as_dict(),
            "physically_consistent": self.physically_consistent,
            "consistency_margin": _finite(self.consistency_margin),
            "warnings": [asdict(warning) for warning in self.warnings],
            "provenance": list(self.provenance),
            "notes": list(self.notes),
        }

    def to_json(self) -> str:
        """Return the whole result, robot and covariances included, as JSON that `from_json` reads
        back to the last bit.
        """
        whole = {"format": FORMAT, "version": FORMAT_VERSION} | self.as_dict()
        whole |= {
            name: getattr(self, name).tolist()
            for name in ("singular_values", "covariance", "textbook_covariance")
        }
        whole |= {"cause_data": None if self.cause_data is None else self.cause_data.as_dict()}
        whole |= {"free": None if self.free is None else self.free.as_dict()}
        return (
            json.dumps(whole | {"model": model_document(self.model)}, allow_nan=False, indent=1)
            + "\n"
        )

    @classmethod
    def from_json(cls, text: str) -> IdentificationResult:
        """Read a result; raises `ResultError` where the text is not one, misses something, or was
        made with other base parameters than today's.
        """
        try:
            whole = json.loads(text)
        except ValueError as problem:
            raise ResultError(
                f"this is not a stored result, not even JSON ({problem}); expected the file that"
                " identify wrote"
            ) from problem
        if not isinstance(whole, Mapping) or whole.get("format") != FORMAT:
            raise ResultError(
                f"this JSON is not a stored result: its format should be {FORMAT!r}; expected the"
                " file that identify wrote"
            )
        if whole.get("version") != FORMAT_VERSION:
            raise ResultError(
                f"this result has format version {whole.get('version')}, this program reads"
                f" {FORMAT_VERSION}; identify again"
            )
        try:
            model = model_from_document(whole["model"])
            base = find_base_parameters(model, DriveSet.parse(whole["drive"]))
            parameters = tuple(_parameter(item, whole["method"]) for item in whole["parameters"])
            ids = [parameter.id for parameter in parameters]
            if ids != base.ids.tolist():
                odd = sorted(set(ids) ^ set(base.ids.tolist())) or ids
                raise ResultError(
                    f"the result of {model.name} has {len(ids)} base parameters, the robot has"
                    f" {base.n_base}; they differ in {odd[:10]}; identify again"
                )
            return cls(
                model=model,
                base=base,
                method=str(whole["method"]),
                sources=tuple(whole["sources"]),
                n_samples=int(whole["n_samples"]),
                rate=float(whole["rate"]),
                duration=float(whole["duration"]),
                parameters=parameters,
                covariance=whole["covariance"],
                textbook_covariance=whole["textbook_covariance"],
                sigma=whole["sigma"],
                effective_samples=float(whole["effective_samples"]),
                rank=int(whole["rank"]),
                singular_values=whole["singular_values"],
                condition_number=_number(whole["condition_number"]),
                scaled_condition_number=_number(whole["scaled_condition_number"]),
                undetermined=tuple(whole["undetermined"]),
                train=TorqueMetrics.from_dict(whole["train"]),
                validation=tuple(
                    TorqueMetrics.from_dict(metrics) for metrics in whole["validation"]
                ),
                cad=TorqueMetrics.from_dict(whole["cad"]),
                physically_consistent=whole["physically_consistent"],
                consistency_margin=whole["consistency_margin"],
                warnings=tuple(IdentificationWarning(**warning) for warning in whole["warnings"]),
                provenance=tuple(whole["provenance"]),
                notes=tuple(whole.get("notes", ())),
                cause_data=(
                    None
                    if whole.get("cause_data") is None
                    else CauseData.from_dict(whole["cause_data"])
                ),
                errors=ErrorBasis.from_dict(whole.get("errors") or {}),
                free=None if whole.get("free") is None else FreeValues.from_dict(whole["free"]),
            )
        except (KeyError, TypeError, AttributeError, ValueError) as problem:
            if isinstance(problem, ResultError):
                raise
            reason = (
                str(problem)
                if isinstance(problem, AsbuiltError)
                else f"{type(problem).__name__} {problem}"
            )
            raise ResultError(
                f"the stored result is damaged: {reason}; identify again"
            ) from problem


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _parameter(item: Mapping[str, Any], method: str) -> IdentifiedParameter:
    """Return a parameter as stored.

    Files of versions that gave dropped parameters an error of zero are read as they are meant.
    """
    numbers = {
        name: np.nan if item[name] is None else float(item[name])
        for name in ("cad", "estimate", "std_error", "textbook_std_error")
    }
    if (
        "dropped" not in item
        and method == "essential"
        and numbers["estimate"] == 0.0 == numbers["std_error"]
    ):
        numbers |= {"std_error": np.nan, "textbook_std_error": np.nan, "dropped": True}
    return IdentifiedParameter(**{**item, **numbers})


def _number(value: float | None) -> float:
    return np.inf if value is None else float(value)
