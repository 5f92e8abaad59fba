"""Elastic drives by two encoders: what lies between motor and link, from their difference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.experiment.quality.torque_fit import BREAKAWAY
from asbuilt.experiment.signal.samples import Samples
from asbuilt.scaled import Scaled
from asbuilt.statistics import jackknife_covariance
from asbuilt.tables import format_plus_minus

# Hold when what lies between two encoders is determined: own choices.

# Difference of the encoders, relative to the range of the motor, beyond which they belong to
# different coordinates, as in a coupled wrist
ENCODER_APART = 0.05
ENCODER_BLOCKS = 20  # Time blocks from whose jackknife errors follow
ENCODER_SURE = 4.0  # Standard errors from which a compliance counts as determined
# Share of what is left of the difference from which another form of friction is better
ENCODER_BETTER = 0.8
ENCODER_SHOWN = 3.0  # Standard errors from which damping, rotor and hysteresis count as present


PASSES = 3
"""Times that the lag is found and taken out."""


@dataclass(frozen=True, slots=True)
class EncoderPair:
    """Hold what lies between the motor's encoder of a joint and the link's, with standard errors.

    Parameters
    ----------
    joint
        Name of the joint.
    lag, lag_error
        Time by which the link's encoder is late [s].
    compliance, compliance_error
        Twist per torque [rad/(N m) or m/N].
    relaxation, relaxation_error
        Damping over stiffness [s].
    rotor, rotor_error
        Inertia of the motor at the joint [kg m^2 or kg]; None where the torque is the link's, or
        where the stiffness is not determined.
    hysteresis, hysteresis_error
        Difference of the encoders that reverses with the motion, from one direction to the other
        [rad or m].
    zero
        Difference of the zero positions of both encoders [rad or m].
    rest
        RMS of the difference beyond all these [rad or m].
    revolute
        Whether the joint turns.
    """

    joint: str
    lag: float
    lag_error: float
    compliance: float
    compliance_error: float
    relaxation: float
    relaxation_error: float
    rotor: float | None
    rotor_error: float | None
    hysteresis: float
    hysteresis_error: float
    zero: float
    rest: float
    revolute: bool = True

    @property
    def determined(self) -> bool:
        """Whether the stiffness is."""
        return self.compliance > ENCODER_SURE * self.compliance_error

    @property
    def stiffness(self) -> tuple[float, float] | None:
        """Stiffness and its standard error [N m/rad or N/m]; None if it is not determined."""
        c = self.compliance
        error = self.compliance_error
        return (1.0 / c, error / c**2) if self.determined else None

    @property
    def damping(self) -> tuple[float, float] | None:
        """Damping and its standard error [N m s/rad or N s/m]; None if it does not show."""
        if self.stiffness is None or self.relaxation < ENCODER_SHOWN * self.relaxation_error:
            return None
        return self.relaxation * self.stiffness[0], self.relaxation_error * self.stiffness[0]

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers by name; None for what is not determined."""
        stiffness, damping = (each or (None, None) for each in (self.stiffness, self.damping))
        return {
            "joint": self.joint,
            "lag": self.lag,
            "lag_error": self.lag_error,
            "stiffness": stiffness[0],
            "stiffness_error": stiffness[1],
            "damping": damping[0],
            "damping_error": damping[1],
            "rotor": self.rotor,
            "rotor_error": self.rotor_error,
            "hysteresis": self.hysteresis,
            "hysteresis_error": self.hysteresis_error,
            "rest": self.rest,
        }

    @property
    def text(self) -> str:
        """Lag and stiffness as text."""
        unit = "N m/rad" if self.revolute else "N/m"
        lag = f"lag {format_plus_minus(1e3 * self.lag, 1e3 * self.lag_error)} ms"
        if self.stiffness is None:
            return f"{self.joint} {lag}, stiffness not determined"
        return f"{self.joint} {lag}, stiffness {format_plus_minus(*self.stiffness)} {unit}"


def identify_encoders(
    samples: Sequence[Samples],
    revolute: Sequence[bool],
    friction: Sequence[Array] | None = None,
) -> tuple[EncoderPair, ...]:
    """Identify lag, compliance, damping, rotor and hysteresis between two encoders of each joint.

    The spring carries the torque of the motor less what it takes itself, `s = tau - I theta'' -
    friction`, and the encoders differ by

        theta - q = c s - (D / K) (theta - q)' + lag q' + h/2 sign(theta') + a theta + b,

    c = 1 / K, linear in all that is unknown, c I included. Errors come from the jackknife over
    time blocks (Miller, Biometrika 61, 1974), which allows for correlated residuals.

    Parameters
    ----------
    samples
        Samples with a second encoder; others are left out.
    revolute
        Which of the n joints turn.
    friction
        Friction of the drives of each of the samples (N, n) [N m or N], taken from their torque; by
        default none. Without it viscous and dry friction over the stiffness are part of lag and
        hysteresis.

    Returns
    -------
    tuple of EncoderPair
        One for each joint whose two encoders measure the same coordinate.
    """
    taken = [np.zeros_like(sample.q) for sample in samples] if friction is None else friction
    given = [both for both in zip(samples, taken, strict=True) if both[0].encoder is not None]
    return tuple(
        _identify_joint(given, k, turns)
        for k, turns in enumerate(revolute)
        if given and all(_is_pair(each, k) for each, _ in given)
    )


def _identify_joint(given: Sequence[tuple[Samples, Array]], k: int, turns: bool) -> EncoderPair:
    """Identify a joint from samples and friction of the drives (N, n)."""
    first = given[0][0]
    late = 0.0
    # The first time finds the lag, in which the columns are linear only where it is short.
    for _ in range(PASSES):
        rows = np.concatenate([_stack_joint_rows(each, k, f[:, k], late) for each, f in given])
        forms = (rows[:, 0] - f for f in (rows[:, 1], _sum_plain_friction(rows)))
        of_forms = (
            _identify_pair(
                first.joint_names[k],
                np.c_[s, rows[:, 2:]],
                first.torque_source == "sensor",
                turns,
            )
            for s in forms
        )
        pair = _choose_friction_form(*of_forms)
        late += pair.lag
    return replace(pair, lag=late)


def describe_encoders(pairs: Sequence[EncoderPair]) -> str:
    """Return lags and stiffness of all joints in a sentence; empty without two encoders."""
    return f"Two encoders: {'; '.join(pair.text for pair in pairs)}." if pairs else ""


def refer_to_links(
    samples: Samples, pairs: Sequence[EncoderPair], friction: Callable[[Samples], Array]
) -> Samples:
    """Return samples of the robot as it were with stiff drives, at the position of the links.

    At joints whose stiffness is determined the links move by their own encoder, its lag taken out,
    and the torque is that which moves the rotor with the link: `tau - I (theta - q)'' - (f(theta')
    - f(q'))`, f the friction (N, n) of the drives.
    """
    samples = samples.compact()
    if samples.encoder is None:
        return samples
    q, qd, qdd, tau = (x.copy() for x in (samples.q, samples.qd, samples.qdd, samples.tau))
    for pair in pairs:
        k = samples.joint_names.index(pair.joint)
        if not pair.determined:
            continue
        motor, link = _orient_sides(samples, k, pair.lag)
        q[:, k] = link[0] + pair.zero
        qd[:, k] = link[1]
        qdd[:, k] = link[2]
        if pair.rotor is not None:
            tau[:, k] -= pair.rotor * (motor[2] - link[2])
    moved = replace(samples, q=q, qd=qd, qdd=qdd, tau=tau)
    if samples.torque_source == "sensor":
        return moved
    return replace(moved, tau=tau - friction(samples) + friction(moved))


def with_friction_errors(
    pairs: Sequence[EncoderPair], viscous: Sequence[float], dry: Sequence[float]
) -> tuple[EncoderPair, ...]:
    """Return lag and hysteresis with what errors of friction (n,) over the stiffness add."""
    return tuple(
        replace(
            pair,
            lag_error=float(np.hypot(pair.lag_error, pair.compliance * Fv)),
            hysteresis_error=float(np.hypot(pair.hysteresis_error, 2.0 * pair.compliance * Fc)),
        )
        for pair, Fv, Fc in zip(pairs, viscous, dry, strict=True)
    )


def _is_pair(samples: Samples, k: int) -> bool:
    """Return whether both encoders of a joint move together."""
    assert samples.encoder is not None
    motor, link = _orient_sides(samples, k)
    wide = float(np.ptp(motor[0]))
    apart = float(np.std(motor[0] - link[0]))
    return wide > 0.0 and apart < ENCODER_APART * wide


def _orient_sides(samples: Samples, k: int, lag: float = 0.0) -> tuple[Array, Array]:
    """Return the motion of motor and link (3, N), in one direction.

    The link's is put forward by a lag [s].
    """
    assert samples.encoder is not None
    first = np.stack([x[:, k] for x in (samples.q, samples.qd, samples.qdd)])
    second = samples.encoder[:, :, k]
    sign = -1.0 if float(first[1] @ second[1]) < 0.0 else 1.0
    sides = first, sign * second
    motor, link = sides if samples.encoder_at == "link" else sides[::-1]
    if lag:
        jerk = np.concatenate(
            [np.gradient(link[2, a:b], 1.0 / samples.rate) for a, b in samples.segments]
        )
        ahead = np.stack([link[1] + 0.5 * lag * link[2], link[2], jerk])
        link = link + lag * ahead
    return motor, link


def _stack_joint_rows(samples: Samples, k: int, friction: Array, lag: float) -> Array:
    """Return torque, friction, columns and, last, the difference of the encoders, filtered, (M, 9).

    The link's is put forward by a lag [s].
    """
    motor, link = _orient_sides(samples, k, lag)
    apart = motor - link
    columns = (
        samples.tau[:, k],
        friction,
        motor[2],
        apart[1],
        link[1],
        np.tanh(motor[1] / BREAKAWAY),
        motor[0],
        np.ones(samples.n_samples),
        apart[0],
    )
    return samples.filtered(np.stack(columns, axis=1))


def _choose_friction_form(identified: EncoderPair, plain: EncoderPair) -> EncoderPair:
    """Return the pair by plain friction where that identified is of a form that the drive lacks.

    Such does harm where the motion reverses. Lag and hysteresis, which friction is part of, remain
    those by the friction identified, with their larger errors.
    """
    if plain.rest > ENCODER_BETTER * identified.rest:
        return identified
    return replace(
        plain,
        lag=identified.lag,
        lag_error=identified.lag_error,
        hysteresis=identified.hysteresis,
        hysteresis_error=identified.hysteresis_error,
    )


def _sum_plain_friction(rows: Array) -> Array:
    """Return the part of friction that is viscous, dry and constant, (M,)."""
    plain = rows[:, [4, 5, 7]]
    return plain @ np.linalg.lstsq(plain, rows[:, 1], rcond=None)[0]


def _identify_pair(name: str, rows: Array, sensor: bool, revolute: bool) -> EncoderPair:
    """Return what the rows of a joint determine."""
    used = np.array([True, not sensor, True, True, True, True, True])
    scale = np.maximum(np.sqrt(np.mean(rows**2, axis=0)), np.finfo(float).tiny)
    squares = [part.T @ part for part in np.array_split(rows / scale, ENCODER_BLOCKS) if len(part)]
    whole = np.sum(squares, axis=0)

    def coefficients(normal: Array) -> Array:
        values = np.zeros(len(used))
        inner = normal[:-1, :-1][np.ix_(used, used)]
        right = normal[:-1, -1][used]
        values[used] = Scaled(inner).solve(right)
        return np.asarray(values * scale[-1] / scale[:-1])

    raw = coefficients(whole)
    parts = np.array([_derive_physical_values(coefficients(whole - square)) for square in squares])
    error = np.sqrt(np.diag(jackknife_covariance(parts)))
    left = rows[:, -1] - rows[:, :-1] @ raw
    lag, c, relaxation, rotor, play = _derive_physical_values(raw).tolist()
    errors = error.tolist()
    known = not sensor and c > ENCODER_SURE * errors[1]
    return EncoderPair(
        joint=name,
        lag=lag,
        lag_error=errors[0],
        compliance=c,
        compliance_error=errors[1],
        relaxation=relaxation,
        relaxation_error=errors[2],
        rotor=rotor if known else None,
        rotor_error=errors[3] if known else None,
        hysteresis=play,
        hysteresis_error=errors[4],
        zero=float(np.mean(rows[:, 5:7], axis=0) @ raw[-2:]),
        rest=float(np.sqrt(np.mean(left**2))),
        revolute=revolute,
    )


def _derive_physical_values(values: Array) -> Array:
    """Return lag, compliance, damping over stiffness, rotor and hysteresis of coefficients (7,)."""
    c = values[0]
    rotor = -values[1] / c if c else 0.0
    return np.array([values[3], c, -values[2], rotor, 2.0 * values[4]])
