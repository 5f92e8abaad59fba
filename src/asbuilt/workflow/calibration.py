"""Payload, torque gains and channels of a robot from recordings without swapped joints.

Study-level: recordings, options and findings. The numerics are in `identification/calibration`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, load_robot
from asbuilt.description.inertia import shift_matrix
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Recording, Samples, SignalChain, head_of
from asbuilt.experiment.command.torque import drop_unknown_directions
from asbuilt.experiment.logs.recordings import (
    Recorded,
    RecordingLike,
    as_recordings,
    read_fitted_recordings,
)
from asbuilt.experiment.quality.checks import TOO_LITTLE
from asbuilt.experiment.quality.torque_fit import UNKNOWN_TORQUE
from asbuilt.findings import Cure
from asbuilt.identification import predict_torque
from asbuilt.identification.calibration.added_moments import AddedMoments, identify_added_moments
from asbuilt.identification.calibration.payload import (
    Payload,
    choose_payload_frame,
    identify_payload_samples,
)
from asbuilt.identification.calibration.torque_gains import (
    TorqueGains,
    find_gains_in_use,
    identify_gains,
)
from asbuilt.identification.calibration.two_channels import (
    LINK_SIDE,
    TwoChannelEstimate,
    identify_two_channels,
)
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.torque_prediction import Prediction
from asbuilt.scaled import find_column_space
from asbuilt.tables import round_significant
from asbuilt.workflow.prepare import Prepared, Progress, prepare
from asbuilt.workflow.study_options import ChannelOptions, GainOptions, PayloadOptions
from asbuilt.workflow.study_result import Study

COMMON = 0.9
"""Least share of the samples of two channels that has equal time stamps."""
SAME_MOTION = 0.02
"""Largest difference of positions of two channels, as a share of the motion."""


def identify_payload(
    result: IdentificationResult | Study,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    unloaded: RecordingLike | Sequence[RecordingLike] = (),
    validation: RecordingLike | Sequence[RecordingLike] = (),
    options: PayloadOptions | None = None,
    progress: Progress | None = None,
) -> Payload:
    """Identify what the flange carries, and validate it.

    Validation is on what was held out, then on other recordings, or else on the training data. All
    recordings go through one signal chain, chosen from the loaded ones.

    Parameters
    ----------
    result
        The identified arm, or its study.
    recordings
        Recordings under load, one or several, as for `identify`.
    unloaded
        Recordings of the bare arm, which hold its parameters.
    validation
        Recordings under load to validate on.
    options
        How to identify; None: the defaults.
    progress
        Called with the name of a step and the fraction done.

    Returns
    -------
    Payload
        Mass, centre of mass and inertia with standard errors, and predictions.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording, or torques that belong to other joints.
    IdentifiabilityError
        If the recordings do not determine a mass.
    """
    options = options or PayloadOptions()
    result = result.result
    prepared = _prepare_loaded(
        result, recordings, (unloaded, validation), options, options.holdout, progress
    )
    if options.checked:
        _, link, placement = choose_payload_frame(result.model, options.frame)
        refuse_swapped(result, prepared.training, link, placement)
    bare, others = prepared.others
    return identify_payload_samples(
        result,
        prepared.training,
        unloaded=bare,
        frame=options.frame,
        arm=options.arm,
        validation=(*prepared.held_out, *others)
        # Without other data the fit is validated on what it has seen, and says so.
        or [
            replace(samples, source=f"{samples.source}, the data used")
            for samples in prepared.training
        ],
        gain_uncertainty=options.gain_uncertainty,
    )


def identify_moments(
    result: IdentificationResult | Study,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    unloaded: RecordingLike | Sequence[RecordingLike] = (),
    options: PayloadOptions | None = None,
    progress: Progress | None = None,
) -> AddedMoments:
    """Identify the first moments that a weight on any link adds, with its mass if determined.

    Arguments as for `identify_payload`; with `unloaded` recordings of the same motion the errors
    cover the difference alone.
    """
    options = options or PayloadOptions()
    result = result.result
    prepared = _prepare_loaded(result, recordings, (unloaded,), options, None, progress)
    (bare,) = prepared.others
    return identify_added_moments(result, prepared.training, unloaded=bare, frame=options.frame)


def _prepare_loaded(
    result: IdentificationResult,
    recordings: RecordingLike | Sequence[RecordingLike],
    others: Sequence[RecordingLike | Sequence[RecordingLike]],
    options: PayloadOptions,
    holdout: str | None,
    progress: Progress | None,
) -> Prepared:
    """Prepare recordings with the delay that the arm was identified with, if none is stated."""
    chain = options.chain or SignalChain()
    model = result.model
    # A delay found with the arm is a property of the log's channels, and no load changes it.
    known = None if result.chain is None else result.chain.delay
    return prepare(
        model,
        as_recordings(model, recordings),
        others=[as_recordings(model, group) for group in others],
        chain=replace(chain, delay=known) if chain.delay == "auto" else chain,
        holdout=holdout,
        checked=options.checked,
        progress=progress,
    )


def find_gains(
    robot: RobotModel | str,
    recordings: RecordingLike | Sequence[RecordingLike],
    loaded: RecordingLike | Sequence[RecordingLike],
    # Gains are what is looked for: torques in a wrong unit are no error here.
    *,
    mass: float,
    options: GainOptions | None = None,
    progress: Progress | None = None,
) -> TorqueGains:
    """Identify the torque per logged unit of every drive from a payload of known mass.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    recordings, loaded
        Recordings of the bare arm and with the payload, one or several each, as for `identify`.
    mass
        Mass of the payload [kg].
    options
        How to identify; None: the defaults.
    progress
        Called with the name of a step and the fraction done.

    Returns
    -------
    TorqueGains
        The gains with standard errors, in place of those that the recordings were read with.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording other than wrong gains.
    IdentifiabilityError
        If the recordings do not determine the gains.
    """
    options = options or GainOptions()
    model, (bare, under) = read_fitted_recordings(load_robot(robot), (recordings, loaded))
    prepared = prepare(
        model,
        [*bare, *under],
        chain=options.chain,
        checked=options.checked,
        tolerated=(*TOO_LITTLE, *UNKNOWN_TORQUE),
        progress=progress,
    )
    # Gains in use are stated by the recordings, which samples have forgotten.
    heads = [head_of(item) for item in (*bare, *under) if not isinstance(item, Samples)]
    samples = [
        _select_known_direction(samples_of, item, prepared)
        for samples_of, item in zip(prepared.training, (*bare, *under), strict=True)
    ]
    return identify_gains(
        model,
        samples[: len(bare)],
        samples[len(bare) :],
        mass=mass,
        com=options.com,
        drive=options.drive,
        frame=options.frame,
        in_use=find_gains_in_use(heads),
        of_command=any(head.has_computed_torque for head in heads),
    )


def _select_known_direction(samples: Samples, item: Recorded, prepared: Prepared) -> Samples:
    """Return the samples of which it is known how friction acts."""
    if isinstance(item, Samples) or prepared.chain is None:
        return samples
    return drop_unknown_directions(samples, head_of(item), prepared.chain.cutoff or np.inf)


def identify_channels(
    robot: RobotModel | str,
    sensor: RecordingLike | Sequence[RecordingLike],
    motor: RecordingLike | Sequence[RecordingLike],
    *,
    options: ChannelOptions | None = None,
    progress: Progress | None = None,
) -> TwoChannelEstimate:
    """Identify links, link-side friction and motor side from torques on both sides of the gears.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    sensor, motor
        Recordings of the joint torque sensors and of the motor torques, one or several, in the
        same order, as for `identify`.
    options
        How to identify; None: the defaults.
    progress
        Called with the name of a step and the fraction done.

    Returns
    -------
    TwoChannelEstimate
        The parameters of both sides with standard errors.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording.
    UsageError
        If the two channels were not logged at the same instants.
    """
    options = options or ChannelOptions()
    model, (sensors, motors) = read_fitted_recordings(load_robot(robot), (sensor, motor))
    if len(sensors) != len(motors):
        raise UsageError(
            f"each recording needs both channels, got {len(sensors)} of sensors and {len(motors)}"
            " of motors"
        )
    # Resting joints differ by noise, which the motion of others must not excuse.
    pairs = [_match_instants(*pair) for pair in zip(sensors, motors, strict=True)]
    prepared = prepare(
        model,
        [sensor for sensor, _ in pairs],
        others=([motor for _, motor in pairs],),
        chain=options.chain,
        checked=options.checked,
        progress=progress,
    )
    for pair in pairs:
        _check_same_motion(*pair)
    return identify_two_channels(
        model,
        prepared.training,
        prepared.others[0],
        link_side=options.link_side or LINK_SIDE,
        motor_side=options.motor_side,
    )


def _match_instants(sensor: Recorded, motor: Recorded) -> tuple[Recorded, Recorded]:
    """Return what two channels logged at the same instants, each with the torque of the other.

    The signal chain drops rows that repeat the row before. Both torques decide about that, so that
    it drops the same rows of both channels.
    """
    if not (isinstance(sensor, Recording) and isinstance(motor, Recording)):
        return sensor, motor
    common = np.intersect1d(sensor.t, motor.t)
    least = COMMON * min(sensor.n_samples, motor.n_samples)
    if common.size < least:
        raise UsageError(
            f"{sensor.source} and {motor.source} are not of the same instants: {common.size} of"
            f" {sensor.n_samples} and {motor.n_samples} time stamps are equal",
            cure=Cure("log sensors and motors together, with the same time stamps"),
            value=common.size,
            lower=least,
        )
    if common.size < max(sensor.n_samples, motor.n_samples):
        shared = (np.isin(sensor.t, motor.t), np.isin(motor.t, sensor.t))
        sensor = sensor.taken(shared[0])
        motor = motor.taken(shared[1])
    return (
        replace(sensor, extra={**sensor.extra, "tau_motor": motor.tau}),
        replace(motor, extra={**motor.extra, "tau_sensor": sensor.tau}),
    )


def _check_same_motion(sensor: Recorded, motor: Recorded) -> None:
    if not (isinstance(sensor, Recording) and isinstance(motor, Recording)):
        return
    apart = np.nanmax(np.abs(sensor.q - motor.q), axis=0)
    moved = np.maximum(np.ptp(sensor.q, axis=0), np.ptp(motor.q, axis=0))
    worst = int(np.argmax(apart - SAME_MOTION * moved))
    if apart[worst] > SAME_MOTION * moved[worst]:
        raise UsageError(
            f"{sensor.source} and {motor.source} are not of the same motion: the positions of"
            f" {sensor.joint_names[worst]} differ by up to {apart[worst]:.3g}",
            cure=Cure("give the two channels of one recording"),
            joint=sensor.joint_names[worst],
            value=float(apart[worst]),
        )


# Say when torques count as swapped or negated; own choices, tested on real robots.
#
# `SWAP_LEFT` is the part of the squared error that a swap of two torques or one opposite sign may
# leave at most; `SWAP_NOISE` the squared error per torque, in noise variances of the result, below
# which nothing is tried.

SWAP_LEFT = 0.25
SWAP_NOISE = 4.0
ANY_MASSES = 0.1
"""Share by which any masses may explain changed torques worse, in squares, as 5 % of their error: a
wrist's friction may say less of its sign than noise does."""


def refuse_swapped(
    result: IdentificationResult, loaded: Sequence[Samples], link: int, placement: Array
) -> None:
    """Refuse torques under load that fit far better with two swapped or one negated.

    With the arm known, any body at `placement` (4, 4) on `link` explains the right order best.
    This also covers wrists, whose friction the result has. Recordings are looked at one by one.

    Raises
    ------
    RecordingError
        If torques seem swapped or negated.
    """
    weights = result.weights
    for samples in loaded:
        arm = predict_torque(result.model, result.base, result.estimates, samples)
        basis = _build_body_torques(result, samples, link, placement)
        as_logged = _measure_remaining_error((arm.measured - arm.predicted) * weights, basis)
        # A body explains the torques as logged: nothing is asked.
        if as_logged < SWAP_NOISE:
            continue
        tried = [
            (_measure_remaining_error((changed[0] - arm.predicted) * weights, basis), changed)
            for changed in _list_changes(arm.measured, result.joint_names)
        ]
        best, (changed, what, cure) = min(tried, key=lambda trial: trial[0])
        # A load elsewhere than at the flange can look like a wrong sign, too.
        if best < SWAP_LEFT * as_logged and _fit_any_masses(result, samples, arm, changed):
            raise RecordingError(
                f"{samples.source}: the torques do not fit the arm of the result with any body at"
                f" its flange; {what} (error {round_significant(np.sqrt(as_logged), 2)} times the"
                " noise"
                f" of the result as logged, {round_significant(np.sqrt(best), 2)} times then)",
                cure=cure,
            )


def _fit_any_masses(
    result: IdentificationResult, samples: Samples, arm: Prediction, changed: Array
) -> bool:
    """Return whether any masses and friction explain changed torques (N, n) as well as the logged.

    The known arm does not count: what a change makes of it would be no robot at all.
    """
    n = result.model.n_joints
    columns = observation_matrix(
        result.model,
        samples.q,
        samples.qd,
        samples.qdd,
        drive=result.base.drive,
        columns=result.base.columns,
    ).reshape(len(samples.q), n, -1)
    weighted = samples.filtered(columns) * result.weights[:, None]
    basis = find_column_space(weighted.reshape(-1, weighted.shape[2]))
    logged, other = (
        _measure_remaining_error(torque * result.weights, basis)
        for torque in (arm.measured, changed)
    )
    return other <= (1.0 + ANY_MASSES) * logged


def _build_body_torques(
    result: IdentificationResult, samples: Samples, link: int, placement: Array
) -> Array:
    """Return an orthonormal basis (N n, r) of the weighted torques that a body there can make."""
    shift = shift_matrix(placement)
    model = result.model
    columns = np.empty((samples.n_filtered, model.n_joints, 10))
    for i in range(10):
        # The body in the link's axes, parameter by parameter.
        links = np.zeros(10 * model.n_links)
        links[10 * link : 10 * link + 10] = shift[:, i]
        columns[:, :, i] = samples.filtered(
            inverse_dynamics(model, samples.q, samples.qd, samples.qdd, parameters=links)
        )
    return find_column_space((columns * result.weights[:, None]).reshape(-1, 10))


def _list_changes(measured: Array, names: Sequence[str]) -> Iterator[tuple[Array, str, Cure]]:
    """Yield the torques with two joints swapped, or one negated."""
    n = len(names)
    for j, k in combinations(range(n), 2):
        order = np.arange(n)
        order[[j, k]] = k, j
        yield (
            measured[:, order],
            f"the torques of {names[j]} and {names[k]} look swapped",
            Cure(
                "check the order of the torque columns; a recording sheet names them:"
                " [columns] torque = [...]",
                {"checked": False},
            ),
        )
    for k in range(n):
        signs = np.where(np.arange(n) == k, -1.0, 1.0)
        listed = ", ".join(f"{sign:g}" for sign in signs)
        yield (
            measured * signs,
            f"the torque of {names[k]} alone has the opposite sign",
            Cure(f"turn it in a recording sheet: sign = [{listed}]", {"checked": False}),
        )


def _measure_remaining_error(error: Array, basis: Array) -> float:
    # What an orthonormal basis leaves: |y|^2 - |Q^T y|^2.
    """Return the mean square of a weighted error (N, n) that a basis (N n, r) leaves."""
    y = error.ravel()
    return float(y @ y - np.sum((basis.T @ y) ** 2)) / y.size
