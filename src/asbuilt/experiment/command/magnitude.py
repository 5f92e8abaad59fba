"""Law by which the command of a servo explains a current that was logged without a sign."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.errors import RecordingError
from asbuilt.experiment.command.torque import (
    LOGGED,
    differentiate_logged_positions,
    hold_command,
)
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure, join_names
from asbuilt.scaled import Scaled

Kind = Literal["motor", "supply"]
KINDS: Mapping[Kind, str] = {
    "motor": "motor currents, in proportion to the torque",
    "supply": "supply currents, which grow with the square of the torque",
}


@dataclass(frozen=True, slots=True)
class MagnitudeLaw:
    """Hold how a magnitude m of one joint follows its control error e and velocity w.

    A "motor" current is `m = scale |e - lag w| + rest`, in proportion to the torque. A "supply"
    current is that times the duty cycle, itself in proportion to e:
    `m = scale max(e (e - lag w), 0) + rest`.

    Parameters
    ----------
    kind
        Motor or supply.
    scale
        Unit of the column per rad (motor) or rad^2 (supply); per m or m^2 for a sliding joint.
    lag, lag_error
        Damping of the servo by its stiffness, with the voltage that the motor induces, plus the
        delay of the command [s], and its standard error.
    rest
        Reading where the servo gives no torque, in the unit of the column.
    explained
        Share of the variance that is explained in blocks of time that were not fitted.
    """

    kind: Kind
    scale: float
    lag: float
    lag_error: float
    rest: float
    explained: float

    @property
    def holds(self) -> bool:
        """Whether the law explains the column well enough to be used."""
        # Own choice of the share of the variance of blocks not fitted.
        return self.explained >= 0.7 and self.scale > 0.0


def is_magnitude(values: Array) -> bool:
    """Return whether a column (N,) is never negative, and not zero throughout."""
    finite = values[np.isfinite(values)]
    return bool(finite.size and finite.min() >= 0.0 and finite.max() > 0.0)


def fit_magnitude_laws(
    recordings: Recording | Sequence[Recording], magnitudes: Sequence[Array] | None = None
) -> tuple[MagnitudeLaw | None, ...]:
    """Return the law of each joint's magnitude; None where the command explains nothing.

    Both kinds are fitted to half of the time blocks and validated on the other half, both ways; the
    kind that explains more of all joints holds for all.

    Parameters
    ----------
    recordings
        Recordings of the same joints.
    magnitudes
        A magnitude (N, n) for each recording; by default its torque.

    Examples
    --------
    >>> t = np.arange(0.0, 40.0, 0.02)
    >>> q = np.sin(t)[:, None]
    >>> u = q + 0.2 * np.cos(2.3 * t)[:, None]
    >>> recording = Recording(t=t, q=q, tau=q, command=u)
    >>> e, w = hold_command(recording) - q, differentiate_logged_positions(recording)
    >>> law = fit_magnitude_laws(recording, [3.0 * np.abs(e - 0.05 * w)])[0]
    >>> law.kind, round(law.scale, 3), round(law.lag, 4)
    ('motor', 3.0, 0.05)
    """
    several = [recordings] if isinstance(recordings, Recording) else [*recordings]
    given = [each.tau for each in several] if magnitudes is None else magnitudes
    parts = [
        (each, magnitude)
        for each, magnitude in zip(several, given, strict=True)
        if each.command is not None
    ]
    if not parts:
        return (None,) * several[0].n_joints
    m = np.concatenate([magnitude for _, magnitude in parts])
    e = np.concatenate([hold_command(each) - each.q for each, _ in parts])
    w = np.concatenate([_choose_velocity(each) for each, _ in parts])
    blocks = list[Array]()
    first = 0
    for each, _ in parts:
        # Blocks of 2 s, half of which validate the other half.
        own = np.floor((each.t - np.nanmin(each.t)) / 2.0)
        blocks.append(own + first)
        first += int(np.nanmax(own)) + 1
    block = np.concatenate(blocks)
    laws = [
        [_fit_joint_law(kind, block, *columns) for columns in zip(m.T, e.T, w.T, strict=True)]
        for kind in KINDS
    ]
    return tuple(max(laws, key=_sum_explained))


def _sum_explained(laws: Iterable[MagnitudeLaw | None]) -> float:
    """Return the sum over joints of what laws explain."""
    return sum(max(law.explained, 0.0) for law in laws if law is not None)


def describe_laws(names: Sequence[str], laws: Sequence[MagnitudeLaw | None]) -> str:
    """Return what the command explains of magnitudes, to follow a sentence; empty if nothing."""
    parts = []
    for kind, what in KINDS.items():
        listed = [
            f"{name} ({100.0 * law.explained:.0f} % explained by the command)"
            for name, law in zip(names, laws, strict=True)
            if law is not None and law.holds and law.kind == kind
        ]
        if listed:
            parts.append(f"the magnitudes of {join_names(listed)} are {what}")
    return f"; {'; '.join(parts)}" if parts else ""


def choose_sign_cure(laws: Sequence[MagnitudeLaw | None]) -> Cure:
    """Return how to use torques of all joints without a sign."""
    # A sign by the command needs a law at every joint.
    if all(law is not None and law.holds and law.kind == "motor" for law in laws):
        return Cure(
            'write sign = "command" in a recording sheet: the torque then has the sign of the'
            " control error"
        )
    return Cure(
        "use the commanded positions if the log has them, with torque_source = command",
        settings={"torque_source": "command"},
    )


def fit_logged_magnitude_laws(recordings: Sequence[Recording]) -> tuple[MagnitudeLaw | None, ...]:
    """Return the laws of magnitudes that were logged with the commands; empty if none were."""
    logged = [
        (recording, recording.extra[LOGGED])
        for recording in recordings
        if LOGGED in recording.extra
        and any(is_magnitude(column) for column in recording.extra[LOGGED].T)
    ]
    if not logged:
        return ()
    return fit_magnitude_laws([each for each, _ in logged], [values for _, values in logged])


def sign_by_command(recording: Recording, unused: Collection[str] = ()) -> Recording:
    """Return a recording whose magnitudes have the sign of the servo's torque, `e - lag w`.

    Joints that are `unused` need no law and keep their torque.

    Raises
    ------
    RecordingError
        If there is no command, a torque is negative, or the command does not explain the magnitude
        of a joint as the current of a motor, so that its sign or its proportion to the torque is
        unknown.
    """
    lowest = float(np.nanmin(recording.tau))
    if recording.command is None:
        raise RecordingError(
            f"{recording.source}: the sign of the torques shall come from the command, but the log"
            " has no commanded positions",
            cure=Cure("name their columns in the recording sheet as columns.command"),
            file=recording.source,
        )
    if lowest < 0.0:
        raise RecordingError(
            f"{recording.source}: the sign of the torques shall come from the command, but the log"
            f" has torques down to {lowest:.4g}: they have a sign",
            cure=Cure('leave out sign = "command"'),
            file=recording.source,
            value=lowest,
        )
    laws = fit_magnitude_laws(recording)
    for kind, what in (
        (None, "do not follow the command"),
        ("supply", f"are {KINDS['supply']}"),
    ):
        bad = [
            name
            for name, law in zip(recording.joint_names, laws, strict=True)
            if name not in unused and (law.kind if law is not None and law.holds else None) == kind
        ]
        if bad:
            raise RecordingError(
                f"{recording.source}: the magnitudes of {join_names(bad)} {what}; the command gives"
                " them no sign that could be used",
                cure=Cure(
                    "use the commanded positions instead", settings={"torque_source": "command"}
                ),
                file=recording.source,
                joint=bad[0],
            )
    lag = np.array([0.0 if law is None else law.lag for law in laws])
    driving = hold_command(recording) - recording.q - lag * _choose_velocity(recording)
    driving[:, [name in unused for name in recording.joint_names]] = 1.0
    side = np.where(driving < 0.0, -1.0, 1.0)
    listed = ", ".join(f"{1e3 * each:.3g}" for each in lag)
    note = f"torques have the sign of command - position - lag velocity, lags of {listed} ms"
    return replace(recording, tau=side * recording.tau, notes=(*recording.notes, note))


def _choose_velocity(recording: Recording) -> Array:
    return differentiate_logged_positions(recording) if recording.qd is None else recording.qd


def _fit_joint_law(
    kind: Kind, blocks: Array, magnitude: Array, error: Array, velocity: Array
) -> MagnitudeLaw | None:
    """Return the law of one joint, each input (N,); None if it has too few rows.

    It is fitted to all blocks, and validated on the blocks of the other parity.
    """
    rows = np.all(np.isfinite([blocks, magnitude, error, velocity]), axis=0)
    m = magnitude[rows]
    e = error[rows]
    w = velocity[rows]
    block = blocks[rows].astype(np.intp)
    # Six blocks at least, and something to explain.
    if np.unique(block).size < 6 or not np.ptp(m) > 0.0 or not np.ptp(e) > 0.0:
        return None
    odd = block % 2 == 1
    left = 0.0
    for here in (odd, ~odd):
        lag = _fit_lag(kind, m[here], e[here], w[here])
        scale, rest = _fit_line(_evaluate_shape(kind, e[here], w[here], lag), m[here])
        left += float(
            np.sum((m[~here] - scale * _evaluate_shape(kind, e, w, lag)[~here] - rest) ** 2)
        )
    lag = _fit_lag(kind, m, e, w)
    scale, rest = _fit_line(_evaluate_shape(kind, e, w, lag), m)
    lag_error = _estimate_lag_error(kind, m, e, w, lag, block)
    return MagnitudeLaw(
        kind, scale, lag, lag_error, rest, 1.0 - left / float(np.sum((m - m.mean()) ** 2))
    )


def _evaluate_shape(kind: Kind, e: Array, w: Array, lag: float) -> Array:
    driving = e - lag * w
    return np.abs(driving) if kind == "motor" else np.maximum(e * driving, 0.0)


def _fit_line(x: Array, y: Array) -> tuple[float, float]:
    """Return slope and intercept of the line through points."""
    centred = x - x.mean()
    energy = float(centred @ centred)
    slope = float(centred @ y) / energy if energy > 0.0 else 0.0
    return slope, float(y.mean() - slope * x.mean())


def _fit_lag(kind: Kind, m: Array, e: Array, w: Array) -> float:
    """Return the lag with which the law fits best, by the profile over it."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - light start

    def cost(lag: float) -> float:
        x = _evaluate_shape(kind, e, w, lag)
        scale, rest = _fit_line(x, m)
        return float(np.sum((m - scale * x - rest) ** 2))

    tried = np.linspace(-0.1, 0.5, 31)
    best = float(tried[int(np.argmin([cost(float(each)) for each in tried]))])
    step = float(tried[1] - tried[0])
    return float(minimize_scalar(cost, bounds=(best - step, best + step), method="bounded").x)


def _estimate_lag_error(
    kind: Kind, m: Array, e: Array, w: Array, lag: float, block: Indices
) -> float:
    """Return the standard error of the lag from the scores of time blocks."""
    step = 1e-3
    scale, rest = _fit_line(_evaluate_shape(kind, e, w, lag), m)
    ahead = _evaluate_shape(kind, e, w, lag + step)
    behind = _evaluate_shape(kind, e, w, lag - step)
    x = _evaluate_shape(kind, e, w, lag)
    J = np.stack([scale * (ahead - behind) / (2.0 * step), x, np.ones_like(x)], axis=1)
    residual = m - scale * x - rest
    inverse = Scaled(J.T @ J).pseudo_inverse[0]
    scores = np.bincount(block, weights=residual * (J @ inverse))
    return float(np.sqrt(np.sum(scores**2)))
