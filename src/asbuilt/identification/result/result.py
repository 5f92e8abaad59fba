"""The result of an identification: estimates with errors and verdicts, and how they were made."""

from __future__ import annotations

import json
from collections.abc import Callable, Container
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.arrays import Array
from asbuilt.codec import FieldError, decode_fields, make_plain, store_as
from asbuilt.description.formats.document import model_document, model_from_document
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import (
    BaseParameters,
    DriveSet,
    PositionServo,
    TorqueModel,
    find_base_parameters,
)
from asbuilt.errors import AsbuiltError, ResultError, UsageError
from asbuilt.experiment import Recording, Samples, SignalChain, prepare_samples
from asbuilt.findings import Cure, Finding, list_warnings
from asbuilt.identification.calibration.encoders import EncoderPair
from asbuilt.identification.effects.effect import FoundEffect
from asbuilt.identification.information.cause_data import CauseData
from asbuilt.identification.result.stored_document import (
    AGAIN,
    FORMAT,
    FORMAT_VERSION,
    parse_stored_document,
)
from asbuilt.identification.result.torque_prediction import (
    Prediction,
    TorqueMetrics,
    expand_parameters,
    predict_torque,
)
from asbuilt.identification.servo.servo_rows import ServoErrors
from asbuilt.identification.uncertainty.block_scatter import (
    FEWEST_DEGREES,
    BlockScatter,
    ErrorBasis,
    widening,
)
from asbuilt.identification.uncertainty.delay_errors import RecordingDelay
from asbuilt.identification.uncertainty.uncertainty import FreeValues
from asbuilt.registry import Registry
from asbuilt.statistics import USUAL_ALPHA, confidence_intervals

if TYPE_CHECKING:
    import polars as pl

FIGURES: Registry[Any] = Registry("figure", "asbuilt.writers.figures.kinds", "asbuilt.figures")
"""Functions of a result, a prediction or None, and axes or None, that draw and return the axes."""
SUMMARY = "asbuilt.identification.result.summary"
"""Module that summarises results; it imports this one for its types, so it is loaded late."""
FEASIBLE = "asbuilt.identification.result.feasible"
"""Module of feasible intervals, loaded late for the same reason."""

REBUILT = ("model", "base")
"""Fields that are stored as the robot and its drive terms."""
MATRICES = (
    *("covariance", "textbook_covariance", "singular_values", "cause_data"),
    *("free", "scatter", "trained", "bias"),
)
"""Fields that are stored and not printed: matrices, and what errors are derived from."""


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class IdentifiedParameter:
    """Hold one base parameter by design (`cad`, NaN if unknown) and as built, with its errors.

    `std_error` follows the result's `errors`, `textbook_std_error` takes residuals as white.
    `determined` is False if this recording does not determine the parameter, so that `estimate` is
    regularised toward CAD; both errors then cover only the part that is determined.
    `poorly_determined` is True if the error is large relative to the value and matters to torque.
    `dropped` is True if the estimator set the parameter to zero (method `essential`); both errors
    are then NaN.
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
        """As built minus CAD, in standard errors; NaN if CAD has no value."""
        return (self.estimate - self.cad) / self.std_error if self.std_error > 0 else np.nan


class Identified(Protocol):
    """Have a result, as a study does."""

    @property
    def result(self) -> IdentificationResult:
        """The result."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class IdentificationResult:
    """Hold the result of an identification of a robot with n joints and p base parameters.

    Base parameters include drive parameters. A result is made once and never changed.

    Attributes
    ----------
    model, base
        The robot as designed and its base parameters.
    method
        `"ols"`, `"wls"`, ...
    sources
        The recordings identified from.
    n_samples, rate, duration
        Samples used (each gives n torques), Hz and s, after filtering and decimation.
    parameters
        P of `IdentifiedParameter`.
    errors
        How standard errors were estimated.
    covariance
        (p, p) accordingly; rows and columns of dropped parameters are zero.
    textbook_covariance
        (p, p), residuals taken as white.
    sigma
        (n,) standard deviation of the torque residual of each joint, infinite where its torque was
        not logged.
    effective_samples
        Number of independent samples with the same information.
    rank, singular_values
        Rank of this recording and the (p,) singular values of the weighted, column-scaled stack,
        largest first.
    condition_number, scaled_condition_number
        Of the weighted stack, and with columns scaled to unit length.
    undetermined
        Combinations of parameters that this recording does not excite.
    train, validation, cad
        Torque metrics: on the training data, on validation data, and of the CAD values on the
        latter (else on the former).
    physically_consistent, consistency_margin
        Whether physically consistent links and passive drives have these parameters, and by what
        margin; None if unknown.
    findings
        What the estimation concludes; a `Study` has more.
    provenance
        How the samples were made.
    notes
        What the estimator decided.
    chain, holdout
        The signal chain, and the rule by which part of the recordings was held out.
    digests
        Fingerprints of the recordings identified from.
    cause_data
        What `attribute` works from; None if it was not gathered.
    delay
        Time by which the torque of each recording was late, and what was applied.
    free
        The parameters by weighted least squares alone, for comparing results; None if `method` is
        that.
    servo, servo_errors
        The position servo whose command was the torque, and its standard errors; None for torques
        that were logged.
    scatter
        Errors of the time blocks, by which parameters are tested; None without blocks.
    trained
        Base parameters (p,) of the fit that `validation` is of, if `parameters` are of a further
        fit to everything; where whole recordings are left out in turn (m, p), row by row without
        recording m; else None.
    bias
        Part (p, p) of the covariance by effects that the model lacks; None without one.
    effects
        What the recordings show and the description lacks, in the model or not.
    encoders
        What lies between the two encoders of joints that have them.
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
    sigma: Array = field(metadata=store_as(missing=np.inf))
    effective_samples: float
    rank: int
    singular_values: Array
    condition_number: float = field(metadata=store_as(missing=np.inf))
    scaled_condition_number: float = field(metadata=store_as(missing=np.inf))
    undetermined: tuple[str, ...]
    train: TorqueMetrics
    validation: tuple[TorqueMetrics, ...]
    cad: TorqueMetrics
    physically_consistent: bool | None
    consistency_margin: float | None
    findings: tuple[Finding, ...]
    provenance: tuple[str, ...]
    notes: tuple[str, ...] = ()
    chain: SignalChain | None = None
    holdout: str | None = None
    digests: tuple[str, ...] = ()
    cause_data: CauseData | None = None
    errors: ErrorBasis = field(default_factory=ErrorBasis)
    free: FreeValues | None = None
    delay: tuple[RecordingDelay, ...] = ()
    servo: PositionServo | None = None
    servo_errors: ServoErrors | None = None
    scatter: BlockScatter | None = None
    trained: Array | None = None
    bias: Array | None = None
    effects: tuple[FoundEffect, ...] = ()
    encoders: tuple[EncoderPair, ...] = ()

    def __post_init__(self) -> None:
        p = self.base.n_base
        n = self.model.n_joints
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
        for name, count in (
            ("parameters", len(self.parameters)),
            ("free values", p if self.free is None else len(self.free.estimates)),
            ("trained values", p if self.trained is None else np.shape([self.trained])[-1]),
            ("rows of bias", p if self.bias is None or self.bias.shape == (p, p) else 0),
            ("block errors", p if self.scatter is None else np.shape([self.scatter.moves])[-1]),
        ):
            if count != p:
                raise ResultError(
                    f"a result for {p} base parameters needs as many {name}, got {count}"
                )

    def __repr__(self) -> str:
        held_out = [f"{100 * metrics.relative_error:.2g} %" for metrics in self.validation]
        return (
            f"<IdentificationResult of {self.robot}: {self.method}, {self.n_base} base parameters"
            f" (rank {self.rank}) from {self.n_samples} samples; relative torque error"
            f" {100 * self.train.relative_error:.2g} %"
            + (f", held out {', '.join(held_out)}>" if held_out else ">")
        )

    def _repr_html_(self) -> str:
        return str(self.summary()._repr_html_())

    @property
    def torque_condition(self) -> str:
        """What the torques take as given, in a sentence; empty for torques that were logged."""
        return "" if self.servo_errors is None else self.servo_errors.condition

    @property
    def decided_by_motion(self) -> bool:
        """Whether simulated motion decides its use, since no torque was measured."""
        return self.servo is not None

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
        """Number of base parameters, drive terms included: the rank of the robot's structure."""
        return self.base.n_base

    @property
    def estimates(self) -> Array:
        """Base parameters as built, shape (p,)."""
        return np.array([parameter.estimate for parameter in self.parameters])

    @property
    def weights(self) -> Array:
        """One over the standard deviation of each joint's torque residual, (n,); always finite."""
        return 1.0 / np.maximum(self.sigma, np.finfo(np.float64).tiny)

    @property
    def result(self) -> IdentificationResult:
        """The result itself, as a study has one: functions of a result take either."""
        return self

    @cached_property
    def of_training(self) -> IdentificationResult:
        """The result with the values of the fit that `validation` is of; itself if that is it."""
        if self.trained is None or self.trained.ndim > 1:
            return self
        return self._with_estimates(self.trained)

    def without_recording(self, number: int) -> IdentificationResult:
        """Return the result with the values that have not seen a recording, counted from 0.

        Where a part of every recording is held out it is `of_training`.
        """
        if self.trained is None or self.trained.ndim == 1:
            return self.of_training
        return self._with_estimates(self.trained[number])

    def _with_estimates(self, values: Array) -> IdentificationResult:
        parameters = zip(self.parameters, values.tolist(), strict=True)
        return replace(
            self, parameters=tuple(replace(each, estimate=value) for each, value in parameters)
        )

    @property
    def cad_values(self) -> Array:
        """Base parameters by design, shape (p,); NaN if the description has no value."""
        return np.array([parameter.cad for parameter in self.parameters])

    @property
    def std_errors(self) -> Array:
        """Standard errors, estimated as `errors` says, shape (p,); NaN for dropped parameters."""
        return np.array([parameter.std_error for parameter in self.parameters])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters, in the order of every array of them."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def params(self) -> Array:
        """The `estimates`, by the name that statsmodels gives them."""
        return self.estimates

    @property
    def bse(self) -> Array:
        """The `std_errors`, by the name that statsmodels gives them."""
        return self.std_errors

    @property
    def tvalues(self) -> Array:
        """Estimates in standard errors, shape (p,); NaN for dropped parameters."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.estimates / self.std_errors

    def conf_int(self, alpha: float = USUAL_ALPHA) -> Array:
        """Return confidence intervals, shape (p, 2), by Student's distribution.

        An interval misses the truth with probability `alpha`, as in statsmodels: 0.05 for 95 %,
        which are 1.96 standard errors. The `degrees_of_freedom` belong to the standard errors. NaN
        for dropped parameters. Raises `UsageError` unless `alpha` lies between 0 and 0.5.
        """
        freedom = np.maximum(self.degrees_of_freedom, FEWEST_DEGREES)
        # Standard errors are widened for few degrees of freedom already, and count once.
        errors = self.std_errors / widening(freedom)
        return confidence_intervals(self.estimates, errors, freedom, alpha)

    def to_frame(self, alpha: float = USUAL_ALPHA) -> pl.DataFrame:
        """Return a polars frame with a row per base parameter.

        Its columns are the fields of `IdentifiedParameter`, `t_value`, and the ends `lower` and
        `upper` of the confidence interval, which misses the truth with probability `alpha`.
        """
        import polars as pl  # noqa: PLC0415 - slow

        lower, upper = self.conf_int(alpha).T
        return pl.DataFrame([asdict(parameter) for parameter in self.parameters]).with_columns(
            t_value=self.tvalues, lower=lower, upper=upper
        )

    def with_effects(self, effects: tuple[FoundEffect, ...]) -> IdentificationResult:
        """Return the result with these effects; what was derived from all else stays known."""
        return replace(self, effects=effects).remembering(self._derived)

    def remembering(self, derived: dict[Any, Any]) -> IdentificationResult:
        """Return the result, which from now on remembers what was derived from the same values."""
        vars(self)["_derived"] = derived
        return self

    @cached_property
    def _derived(self) -> dict[Any, Any]:
        return {}

    def __getstate__(self) -> dict[str, Any]:
        # What was derived holds the solver's own objects, which no other process takes.
        return {name: value for name, value in vars(self).items() if name != "_derived"}

    def once(self, key: Any, derive: Callable[[], T]) -> T:
        """Return what is derived from the result, its effects apart, and remember it by a key."""
        if key not in self._derived:
            self._derived[key] = derive()
        derived: T = self._derived[key]
        return derived

    def summary(self) -> Any:
        """Summarise the result as text, HTML or CSV: the `Summary` of `summarise`."""
        return import_module(SUMMARY).summarise(self)

    def feasible(self, quantity: str, of: str | None = None, **stated: Any) -> Any:
        """Return the least and greatest value of a quantity: a `FeasibleInterval`.

        Over all physically consistent bodies that the recordings allow, such as
        `feasible("mass")`, `feasible("mass:link_3")` or `feasible("armature", "joint_2")`. `stated`
        are keywords of `feasible_intervals`, such as `prior="cad"`.
        """
        return import_module(FEASIBLE).feasible_interval(self, quantity, of, **stated)

    def plot(self, kind: str = "parameters", of: Any = None, axes: Any = None) -> Array:
        """Draw a figure with matplotlib.

        Parameters
        ----------
        kind
            `"parameters"`: as built less CAD, with confidence intervals; of a recording `"torque"`,
            measured and predicted, or `"residuals"`.
        of
            A recording, samples, or a prediction of one.
        axes
            Axes to draw on, one per joint, for parameters one; None: a new figure.

        Returns
        -------
        array of matplotlib axes
            Their figure is `axes[0].figure`.

        Raises
        ------
        UsageError
            If there is no such figure, no recording, or another number of axes.
        """
        prediction = self.predict(of) if isinstance(of, Recording | Samples) else of
        return np.asarray(FIGURES.find(kind)(self, prediction, axes))

    @property
    def dropped(self) -> NDArray[np.bool_]:
        """Which parameters the estimator set to zero, shape (p,)."""
        return np.array([parameter.dropped for parameter in self.parameters])

    @property
    def degrees_of_freedom(self) -> Array:
        """Degrees of freedom of each standard error, shape (p,); infinite without time blocks."""
        return (
            np.full(self.n_base, np.inf)
            if self.scatter is None
            else self.scatter.degrees_of_freedom
        )

    @property
    def errors_sentence(self) -> str:
        """How the standard errors were estimated, in a sentence."""
        return self.errors.sentence(self.effective_samples, self.n_samples)

    @cached_property
    def torque_model(self) -> TorqueModel:
        """The robot as built as a function of the state, drives included."""
        chi = expand_parameters(self.base, self.estimates)
        links = 10 * self.model.n_links
        return TorqueModel(self.model, self.base.drive, chi[links:], parameters=chi[:links])

    def torque(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Return the joint torque as built, rigid bodies and drives.

        Parameters
        ----------
        q, qd, qdd
            Joint positions, velocities and accelerations [rad or m, s], shape (n,) or (N, n).

        Returns
        -------
        Array
            Torques [N m or N], shape of `q`.
        """
        return self.torque_model(q, qd, qdd)

    def gravity(self, q: ArrayLike) -> Array:
        """Return the torque that holds the robot as built at rest, friction aside, shape of `q`."""
        return self.torque_model.gravity(q)

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return the mass matrix of the links as built, shape (n, n) or (N, n, n).

        Armatures of drives are not part of it.
        """
        return self.torque_model.mass_matrix(q)

    def friction(self, qd: ArrayLike, q: ArrayLike | None = None) -> Array:
        """Return the torque of the drives as built at constant velocity, shape of `qd`.

        Parameters
        ----------
        qd
            Joint velocities [rad/s or m/s], shape (n,) or (N, n).
        q
            Joint positions [rad or m]; needed if drive terms depend on load or position.

        Raises
        ------
        UsageError
            If positions are needed and not given.
        """
        drive = self.base.drive
        rest = np.zeros(np.shape(qd))
        if q is None and (drive.needs_load or any(term.by_position for term in drive.terms)):
            raise UsageError(f"the drive terms {drive} depend on load or position; give q too")
        return self.torque_model.friction(rest if q is None else q, qd, rest)

    @overload
    def predict(self, recording: Samples | Recording) -> Prediction: ...

    @overload
    def predict(self, recording: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array: ...

    def predict(
        self,
        recording: Samples | Recording | ArrayLike,
        qd: ArrayLike | None = None,
        qdd: ArrayLike | None = None,
    ) -> Prediction | Array:
        """Predict torque as built: of a recording, with the torque measured, or of states.

        Parameters
        ----------
        recording
            Samples, or a recording, which goes through the signal chain of the result; or joint
            positions [rad or m], shape (n,) or (N, n), with `qd` and `qdd`.
        qd, qdd
            Joint velocities and accelerations, as of `torque`.

        Returns
        -------
        Prediction or Array
            Measured and predicted torque of a recording; torques of states [N m or N].
            `asbuilt.validate` also checks a recording and estimates its delay.

        Raises
        ------
        UsageError
            If positions come without velocities and accelerations.
        """
        if isinstance(recording, Recording):
            recording = prepare_samples(recording, self.chain)
        if isinstance(recording, Samples):
            return predict_torque(self.model, self.base, self.estimates, recording)
        if qd is None or qdd is None:
            raise UsageError(
                "predict takes a recording or samples, or positions, velocities and accelerations;"
                f" got a {type(recording).__name__} alone",
                cure=Cure("read a file with read_recording first, or give qd and qdd"),
            )
        return self.torque(recording, qd, qdd)

    def predict_cad(self, samples: Samples) -> Prediction:
        """Predict the torque of a recording by design; unknown CAD values count as zero."""
        return predict_torque(
            self.model, self.base, np.nan_to_num(self.cad_values, nan=0.0), samples
        )

    def as_dict(self) -> dict[str, Any]:
        """Return what programs rely on, without the robot and the matrices.

        Plain numbers, texts and lists, None for what is undefined.
        """
        document = self._document(but=MATRICES)
        return document | {"encoders": [encoder.as_dict() for encoder in self.encoders]}

    def _document(self, but: Container[str] = ()) -> dict[str, Any]:
        """Return everything but the robot, its base parameters and the fields in `but`."""
        own = {
            item.name: make_plain(getattr(self, item.name))
            for item in fields(self)
            if item.name not in REBUILT and item.name not in but
        }
        return {
            "robot": self.robot,
            "drive": list(self.base.drive.specifications),
            "n_standard": self.n_standard,
            "n_base": self.n_base,
            "joints": list(self.joint_names),
            "warnings": list_warnings(self.findings),
            **own,
        }

    def to_json(self, **further: Any) -> str:
        """Return the whole result as JSON that `from_json` reads back to the last bit.

        Parameters
        ----------
        further
            Plain data to store in the same document.
        """
        whole = {"format": FORMAT, "version": FORMAT_VERSION} | self._document() | further
        whole["model"] = model_document(self.model)
        return json.dumps(whole, allow_nan=False, indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> IdentificationResult:
        """Read a result.

        Raises
        ------
        ResultError
            If the text is not a stored result, is damaged, or belongs to other base parameters.
        """
        whole = parse_stored_document(text)
        try:
            model = model_from_document(whole["model"])
            base = find_base_parameters(model, DriveSet.parse(whole["drive"]))
            result = cls(model=model, base=base, **decode_fields(cls, whole, but=REBUILT))
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as problem:
            reason = (
                str(problem)
                if isinstance(problem, AsbuiltError | FieldError)
                else f"{type(problem).__name__} {problem}"
            )
            raise ResultError(f"the stored result is damaged: {reason}", cure=AGAIN) from problem
        result._check_values()
        ids = [parameter.id for parameter in result.parameters]
        if ids != base.ids.tolist():
            odd = sorted(set(ids) ^ set(base.ids.tolist())) or ids
            raise ResultError(
                f"the result of {model.name} has other base parameters than the robot has today;"
                f" they differ in {odd[:10]}",
                cure=AGAIN,
            )
        return result

    def _check_values(self) -> None:
        """Raise `ResultError` that names a value that no identification gives."""
        errors = self.std_errors[~self.dropped]
        for name, sound, expected in (
            ("n_samples", self.n_samples > 0, "positive"),
            ("rate", self.rate > 0, "positive"),
            ("duration", self.duration > 0, "positive"),
            ("effective_samples", self.effective_samples >= 0, "at least 0"),
            ("rank", 0 <= self.rank <= self.base.n_base, f"from 0 to {self.base.n_base}"),
            ("sigma", bool(np.all(self.sigma > 0)), "positive"),
            ("estimate", _is_finite(self.estimates), "finite"),
            ("std_error", bool(np.all(errors >= 0)), "at least 0"),
            ("covariance", _is_finite(self.covariance), "finite"),
            ("covariance", not np.any(np.diag(self.covariance) < 0), "positive semidefinite"),
            ("covariance", _has_correlations(self.covariance), "positive semidefinite"),
        ):
            if not sound:
                raise ResultError(
                    f"the stored result is damaged: {name} must be {expected}", cure=AGAIN
                )


def _has_correlations(covariance: Array) -> bool:
    """Return whether no covariance (p, p) is beyond the product of its standard errors."""
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    # Rounding of a matrix in base parameters that another one was turned into.
    slack = 1e-6 * error.max(initial=0.0) ** 2
    return bool(np.all(np.abs(covariance) <= (1.0 + 1e-6) * np.outer(error, error) + slack))


def _is_finite(values: ArrayLike) -> bool:
    return bool(np.all(np.isfinite(np.asarray(values, dtype=np.float64))))
