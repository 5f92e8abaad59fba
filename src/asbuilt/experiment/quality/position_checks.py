"""Checks of positions: steps and noise, loops, joints that follow others, second encoders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Indices, find_finite_rows
from asbuilt.compilation import kernel
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.recording import Recording, find_changed_rows
from asbuilt.experiment.signal.band_choice import POSITION_BANDWIDTHS, Band, choose_band
from asbuilt.experiment.signal.resampling import plan_uniform_grid
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.statistics import jackknife_covariance

NEAR = 0.1
"""Distance from a multiple of the step, in steps, that counts as on it."""
LARGEST_MULTIPLE = 60.0
"""Typical difference in steps beyond which a step is too fine to be measured."""


def find_position_steps(segments: Sequence[Array]) -> Array:
    """Return the step of the values of each joint (n,), 0 where none is found.

    A joint that takes values on a grid changes between samples by multiples of its step, whatever
    the noise before the quantisation. The step is the largest number of which 0.6 of the
    changes are multiples: of a continuous signal it is about 0.2, and up to 0.4 of them may be off,
    samples that were interpolated or a digit that was lost. `segments` are positions (L, n).

    Examples
    --------
    >>> q = np.round(np.sin(np.arange(2000) / 300.0) / 1e-3) * 1e-3
    >>> find_position_steps([q[:, None]]).round(9).tolist()
    [0.001]
    """
    return np.array(
        [
            _find_step(np.concatenate([np.diff(q[:, k]) for q in segments]))
            for k in range(segments[0].shape[1])
        ]
    )


def _find_step(differences: Array) -> float:
    # Of longer recordings every second, third, ... difference is used.
    # As many differences as decide; more only cost time.
    size = np.abs(differences[:: max(1, differences.size // 20_000)])
    size = size[np.isfinite(size)]
    n_all = size.size
    # Exact zeros and rounding of a division are no steps.
    size = size[size > 1e-9 * max(size.max(initial=0.0), np.finfo(np.float64).tiny)]
    # A step is measured from thirty differences other than 0.
    if size.size < 30:
        return 0.0
    # The standard error of a share of 1000 differences is 0.015, so that a candidate which few of
    # them support is not looked at more closely.
    few = np.ascontiguousarray(size[:: max(1, size.size // 1_000)])
    for candidate in _list_candidates(size):
        # A thousand differences sort out most candidates.
        if _measure_share(few, _refine_step(few, candidate)) < 0.45:
            continue
        step = _refine_step(size, candidate)
        if step > 0.0 and _measure_share(size, step) >= 0.6:
            # A constant speed changes by one size too, but no multiple of it is exact.
            return 0.0 if _has_constant_speed(size / step, n_all) else step
    return 0.0


def _list_candidates(size: Array) -> Array:
    """Return possible steps, largest first: changes that are frequent, and their fractions."""
    typical = float(np.median(size))
    common = np.quantile(size, np.linspace(0.0, 0.9, 61))
    # Differences between frequent changes are multiples of the step as well.
    gaps = np.diff(np.unique(np.round(size / typical, 3))) * typical
    gaps = np.quantile(gaps, np.linspace(0.0, 0.9, 13)) if gaps.size else gaps
    # Every second or third value of a coarse log may be missing.
    found = np.concatenate([common, common / 2.0, common / 3.0, gaps])
    # Steps far below the typical change cannot be told from noise.
    found = found[(found > typical / LARGEST_MULTIPLE) & (found <= 1.5 * typical)]
    return np.unique(found)[::-1]


@kernel("f1 f", fastmath=True, usual=True)
def _refine_step(size: Array, step: float) -> float:
    """Return the least-squares step of the differences that are near multiples of `step`.

    Without branches the sums run in vector registers.
    """
    # Small multiples first: their error is the step's, large ones then refine it.
    for most in (2.5, 8.5, LARGEST_MULTIPLE):
        product = square = 0.0
        for k in range(size.size):
            ratio = size[k] / step
            multiple = np.rint(ratio)
            # Twice as far as counts: the first estimate is rough.
            near = (abs(ratio - multiple) < 2.0 * NEAR) & (multiple >= 1.0) & (multiple < most)
            weight = multiple if near else 0.0
            product += size[k] * weight
            square += weight * weight
        if square > 0.0:
            step = product / square
    return step


@kernel("f1 f", fastmath=True, usual=True)
def _measure_share(size: Array, step: float) -> float:
    """Return the share of differences that are near multiples of `step`."""
    count = 0.0
    for k in range(size.size):
        ratio = size[k] / step
        multiple = np.rint(ratio)
        near = (abs(ratio - multiple) < NEAR) & (multiple >= 1.0)
        count += 1.0 if near else 0.0
    return count / size.size


def _has_constant_speed(multiples: Array, n_all: int) -> bool:
    """Return whether the changes are of one size, as at a constant speed, and not exactly so."""
    alike = np.abs(multiples - 1.0) < NEAR
    # Rounded values repeat exactly, to a hundredth of the step.
    return bool(alike.sum() > 0.6 * n_all and np.std(multiples[alike]) > 0.01)


MEASURED = 20_000
"""Samples at the beginning by which step and noise are measured: 20 s at 1 kHz."""
COARSE = 2.0 * np.pi / 2**16
"""Step [rad or m] beyond which positions are called coarse: 16 bits per turn."""
LIMITED = 0.8
"""Share of the cutoff wanted below which noise of the positions limits the band."""


@dataclass(frozen=True, eq=False)
class PositionNoise:
    """Hold step and noise of the positions of each joint.

    Parameters
    ----------
    step
        Step of the values [rad or m], 0 where none was found, (n,).
    density
        Spectrum of the noise about the default cutoff [rad^2/Hz], at least the step^2 / (6 rate) of
        white quantisation noise (Bennett, Bell System Technical Journal, 1948), (n,).
    band
        The default cutoff.
    """

    step: Array
    density: Array
    band: Band

    @classmethod
    def of(cls, recording: Recording) -> PositionNoise | None:
        """Measure a recording; None if no segment can be used, or no position changes."""
        try:
            grid = plan_uniform_grid(recording)
        except RecordingError:
            return None
        finite = recording.q[find_finite_rows(recording.q)]
        # Repeated positions hide the step of the values.
        changed = find_changed_rows(finite)
        if grid.rate < 1.0 or not changed[1:].any():
            return None
        band = choose_band(grid.uniform(), grid.rate, computed=recording.has_computed_torque)
        step = find_position_steps([finite[changed]])
        density = np.zeros(len(step)) if band.noise is None else band.noise.density(band.cutoff)
        # Quantisation is noise even where the spectrum does not show it.
        return cls(step, np.maximum(density, step**2 / (6.0 * grid.rate)), band)


def check_positions(model: RobotModel, noise: PositionNoise | None) -> Iterator[Finding]:
    """Find positions of coarse steps, and noise that limits the band."""
    if noise is None:
        return
    steps = [_describe_step(model, k, step) for k, step in enumerate(noise.step.tolist())]
    band = noise.band
    if band.noise is not None and band.cutoff < LIMITED * band.wanted:
        worst = band.noise.limiting_joint(band.wanted)
        # Noise above the motion's band limits nothing that matters.
        cuts_motion = band.cutoff < LIMITED * POSITION_BANDWIDTHS * band.bandwidth
        by_steps = f", whose positions change in {steps[worst]}" if steps[worst] else ""
        yield Finding(
            "band_limited_by_noise",
            "warning" if steps[worst] and cuts_motion else "info",
            f"Noise of the positions, not the motion, limits the low-pass to {band.cutoff:.2g} Hz,"
            f" most of all the noise of {model.joint_names[worst]}{by_steps}; faster parts of the"
            " motion determine nothing",
            Cure("log positions with the encoder's full resolution, or velocities, or move faster"),
        )
    for k, text in enumerate(steps):
        # A step below 16 bits per turn is named only if it limits the band.
        if text and noise.step[k] > COARSE:
            yield Finding(
                "coarse_positions",
                "info",
                f"positions change in {text}",
                joint=model.joint_names[k],
            )


def _describe_step(model: RobotModel, joint: int, step: float) -> str:
    if step <= 0.0:
        return ""
    if not model.joints[joint].is_revolute:
        return f"steps of {1e3 * step:.3g} mm"
    return f"steps of {1e3 * step:.3g} mrad ({2.0 * np.pi / step:.0f} per turn)"


BLOCKS = 10
"""Time blocks from whose scatter the error of a lag follows."""


def check_structure(model: RobotModel, recording: Recording) -> Iterator[Finding]:
    """Name samples at which the loops do not close, and postures near a singular one."""
    closure = model.closure
    if closure is None:
        return
    known = np.flatnonzero(find_finite_rows(recording.q))
    # At most 2000 postures, evenly spread.
    # Loops are looked at in 2000 samples of a log.
    rows = known[:: max(1, known.size // 2000)]
    # Postures that do not close have no distance from a singular one.
    at = closure.postures(recording.q[rows])
    names = model.joint_names
    moving = [k for k in range(model.n_joints) if closure.moves_loops(k)]

    def describe(k: int) -> tuple[str, float]:
        """Return the posture of sample k as text, and its time."""
        where = [f"{names[j]} at {recording.q[rows[k], j]:.4g}" for j in moving]
        time = float(recording.t[rows[k]])
        return f"at {time:.3f} s, with {join_names(where, len(where))}", time

    failed = np.flatnonzero(~at.closed)
    if failed.size:
        where, time = describe(int(failed[0]))
        yield Finding(
            "loops_open",
            "error",
            f"the encoders contradict the loops of the description: they do not close {where}"
            f" ({100.0 * failed.size / rows.size:.3g} % of the samples)",
            Cure("correct zero positions, signs and units of the log, or the lengths of the links"),
            joint=names[moving[0]],
            time=time,
        )
    if not at.closed.any():
        return
    nearest = int(np.argmin(np.where(at.closed, at.distance, np.inf)))
    # The nearest one is said even where it is far: it is what a user can check.
    where, time = describe(nearest)
    text = (
        f"the loops are nearest to a singular posture {where}: smallest singular value"
        f" {at.distance[nearest]:.2g} of the largest"
    )
    # Ratio of singular values of loops from which a posture is far from a singular one.
    if at.distance[nearest] >= 0.02:
        yield Finding("distance_to_singularity", "info", text, joint=names[moving[0]], time=time)
        return
    yield Finding(
        "near_singular_posture",
        "warning",
        f"{text}; there small errors of positions make large ones of passive joints and torques",
        Cure("keep away from it, or cut these samples out"),
        joint=names[moving[0]],
        time=time,
    )


def check_followers(model: RobotModel, recording: Recording) -> Iterator[Finding]:
    """Compare logged positions of followers with those that follow; name torques not used."""
    # Positions of the joints of all links; NaN at samples that have NaN.
    known = find_finite_rows(recording.q)
    placed = np.full((known.size, model.n_links), np.nan)
    placed[known] = model.link_positions(recording.q[known])
    for k, joint in enumerate(model.followers, start=model.n_joints):
        # Shares name the joints that a follower follows.
        master = " and ".join(
            name
            for name, share in zip(model.joint_names, model.link_shares[k], strict=True)
            if share
        )
        logged = recording.extra.get(f"q_{joint.name}")
        if logged is not None:
            q = np.asarray(logged).reshape(-1)
            away = float(np.sqrt(np.nanmean((q - placed[:, k]) ** 2)))
            # Play of a gripper [rad or m], and the share of the follower's range that exceeds it.
            play, unit = (0.02, "rad") if joint.is_revolute else (0.001, "m")
            # Play is no error of the coupling, nor is a small share of a long way.
            if away > max(play, 0.05 * float(np.nanmax(q) - np.nanmin(q))):
                yield Finding(
                    "coupling_disagrees",
                    "warning",
                    f"{joint.name} is logged {away:.3g} {unit} (root mean square) away from where"
                    f" {master} puts it by the {'loops' if joint.is_passive else 'coupling'} in the"
                    " description, with which the torques are computed",
                    Cure(
                        "correct lengths and zero positions of the loops in the description"
                        if joint.is_passive
                        else "correct multiplier and offset of the mimic joint in the description"
                    ),
                    joint=joint.name,
                )
        torque = recording.extra.get(f"tau_{joint.name}")
        if torque is not None and float(np.nanmax(np.abs(torque), initial=0.0)) > 0.0:
            yield Finding(
                "follower_torque",
                "warning",
                f"the log has a torque of {joint.name}, which follows {master}; only the torque of"
                f" {master} is used",
                Cure("if it has a drive of its own, remove the mimic from the description"),
                joint=joint.name,
            )


@dataclass(frozen=True, slots=True)
class EncoderLag:
    """Hold the lag of the link's encoder behind the motor's, and what it leaves.

    Parameters
    ----------
    value, std_error
        The lag [s].
    explained
        Share of the square of motor minus link that it explains.
    rest
        RMS of motor minus link beyond it [rad or m].
    """

    value: float
    std_error: float
    explained: float
    rest: float


def estimate_encoder_lag(t: Array, own: Array, other: Array) -> EncoderLag | None:
    """Return the lag of `other` (N,) behind `own` (N,); None if one of them does not move.

    To first order `other(t) = s own(t - lag) + c = s own - s lag d(own)/dt + c`: zero positions and
    directions of the encoders may differ. The error comes from the jackknife over blocks of time
    (Miller, Biometrika 61, 1974).
    """
    if not (np.ptp(own) > 0.0 and np.ptp(other) > 0.0):
        return None
    # s own - s lag d(own)/dt + c, a fit of three columns.
    columns = np.column_stack([own, np.gradient(own, t), np.ones_like(own)])

    def lag(left_out: Indices) -> tuple[float, Array]:
        kept = np.delete(np.arange(t.size), left_out)
        fitted = np.linalg.lstsq(columns[kept], other[kept], rcond=None)[0]
        # The slope over the gain is minus the lag.
        return -float(fitted[1] / fitted[0]), fitted

    value, (s, b, c) = lag(np.arange(0))
    parts = [[lag(rows)[0]] for rows in np.array_split(np.arange(t.size), BLOCKS)]
    variance = jackknife_covariance(np.array(parts))[0, 0]
    difference = other - s * own - c
    error = other - columns @ np.array([s, b, c])
    return EncoderLag(
        value,
        float(np.sqrt(variance)),
        1.0 - float(np.mean(error**2) / np.mean(difference**2)),
        float(np.sqrt(np.mean(error**2))),
    )


def check_encoders(model: RobotModel, recording: Recording) -> Iterator[Finding]:
    """Report the lag between two encoders of each joint, and joints without the second."""
    second = recording.second_encoder
    if second is None or recording.n_samples < 2 * BLOCKS:
        return
    # The lag is of the link behind the motor, whichever is the second encoder.
    sign = 1.0 if second[0] == "link" else -1.0
    found = [
        (joint, estimate_encoder_lag(recording.t, own, other))
        for joint, own, other in zip(model.joints, recording.q.T, second[1].T, strict=True)
    ]
    # Standard errors beyond which a lag is one.
    lagging = [
        (joint, encoder_lag)
        for joint, encoder_lag in found
        if encoder_lag is not None and abs(encoder_lag.value) > 3.0 * encoder_lag.std_error
    ]
    if not lagging:
        return
    lags = [
        f"{joint.name} {1e3 * sign * encoder_lag.value:.2f} +- {1e3 * encoder_lag.std_error:.2f} ms"
        for joint, encoder_lag in lagging
    ]
    shares = sorted(100.0 * encoder_lag.explained for _, encoder_lag in lagging)
    rest = [
        f"{np.rad2deg(encoder_lag.rest) * 1e3:.1f} mdeg"
        if joint.is_revolute
        else f"{1e6 * encoder_lag.rest:.1f} um"
        for joint, encoder_lag in lagging
    ]
    without = [joint.name for joint, encoder_lag in found if encoder_lag is None]
    also = f"; {join_names(without)} have one encoder that moves" if without else ""
    yield Finding(
        "encoder_lag",
        "info",
        f"the link encoders lag behind the motor encoders by {join_names(lags, len(lags))}, which"
        f" explains {shares[0]:.0f} to {shares[-1]:.0f} % of their difference and leaves"
        f" {join_names(rest, len(rest))} for elasticity and hysteresis{also}",
        joint=lagging[0][0].name,
    )
