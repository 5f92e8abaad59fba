"""Torque gains of the drives, such as torque per current, by a known payload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia, shift_matrix
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import DriveSet, find_base_parameters
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment import Recording, Samples
from asbuilt.findings import Cure
from asbuilt.identification.calibration.payload import choose_payload_frame
from asbuilt.identification.calibration.payload_rows import map_to_payload
from asbuilt.identification.estimators.held_out_choice import group_motions
from asbuilt.identification.information.rows import TimeBlock, divide_into_blocks
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.identification.information.triangular import (
    solve_factor,
    triangular_factor,
    widen_factor,
)
from asbuilt.identification.uncertainty.block_scatter import BlockScores
from asbuilt.identification.uncertainty.uncertainty import estimate_scatter
from asbuilt.scaled import Scaled

# Hold how gains are iterated, and when they are determined.

GAIN_ITERATIONS = 60  # Most iterations of gains and noise
GAIN_CONVERGENCE = 1e-9  # Relative change of the gains at which they end
# Share of the payload in a joint's torque below which its gain depends on other joints
GAIN_SMALL_SHARE = 0.15
# Standard error of a gain, as a fraction of it, above which it is undetermined
GAIN_LARGEST_ERROR = 0.25
# Gain, in units of the median joint's, beyond which nothing bounds it: no two drives of a robot
# differ as much
GAIN_RUNAWAY = 1e4


@dataclass(frozen=True, slots=True, eq=False)
class TorqueGains:
    """Hold the torque gain of each joint, the torque of one logged unit [N m per unit].

    Parameters
    ----------
    joint_names
        Names of the n joints.
    gains, std_errors
        Gains (n,), NaN without any information, and their standard errors from time blocks.
    in_use
        Gains (n,) that the torques had been multiplied by before; ones for torques as logged.
    determined
        Whether these recordings determine each gain, shape (n,).
    payload_share
        RMS share of the payload in the torque under load (n,). If it is small, the gain depends on
        parameters shared with other joints and on the friction model.
    known
        Properties of the payload that were given.
    frame, payload
        Parameters (10,) of the payload in the axes of this frame, in the order of `LinkInertia`.
    sources
        The recordings.
    of_command
        Whether position servos gave the torques, so that the gains are their stiffnesses
        [N m/rad or N/m].
    """

    joint_names: tuple[str, ...]
    gains: Array
    std_errors: Array
    in_use: Array
    determined: NDArray[np.bool_]
    payload_share: Array
    known: tuple[str, ...]
    frame: str
    payload: Array
    sources: tuple[str, ...]
    of_command: bool = False

    @property
    def factors(self) -> Array:
        """Factors (n,) of the torques in use, 1 for correct gains."""
        return self.gains / self.in_use

    @property
    def factor_std_errors(self) -> Array:
        """Standard errors of the factors, (n,)."""
        return self.std_errors / np.abs(self.in_use)

    @property
    def to_use(self) -> Array:
        """Gains (n,) to use: the estimated ones, or those in use if undetermined."""
        return np.where(self.determined, self.gains, self.in_use)

    def sentences(self) -> tuple[str, ...]:
        """Return notes on the gains."""
        undetermined = self._name_joints(~self.determined)
        instead = "identify finds it" if self.of_command else "the gain in use stays"
        turned = self.determined & (self.factors < 0)
        small = self._name_joints(self.payload_share < GAIN_SMALL_SHARE)
        notes = (
            (
                True,
                f"given for the payload: {', '.join(self.known)}; estimated payload:"
                f" {self._describe_payload()}",
            ),
            (
                undetermined,
                f"undetermined, so {instead}: {undetermined}; the payload has little"
                " effect on these joints, or its centre or inertia is unknown",
            ),
            (
                turned.any(),
                "the torque in use has the opposite sign at"
                f" {'every joint' if turned.all() else self._name_joints(turned)}; these gains"
                " reverse it, so keep all other sign settings",
            ),
            (
                self.of_command,
                "the gains are the stiffnesses of the position servos; identify takes them as"
                " exact, so add their relative errors to the torques' errors",
            ),
            (
                small,
                f"the payload is below {100 * GAIN_SMALL_SHARE:.0f} % of the torque of {small};"
                " these gains depend on other joints and on the friction model beyond their"
                " standard errors",
            ),
        )
        return tuple(note for holds, note in notes if holds)

    def _name_joints(self, chosen: NDArray[np.bool_]) -> str:
        return ", ".join(
            name for name, named in zip(self.joint_names, chosen, strict=True) if named
        )

    def _describe_payload(self) -> str:
        body = LinkInertia(self.payload)
        centre = ", ".join(f"{value:.3g}" for value in self.payload[6:9] / self.payload[9])
        return f"mass {body.mass:.4g} kg, centre ({centre}) m in {self.frame}"


def find_gains_in_use(recordings: Sequence[Recording]) -> Array:
    """Return the gains (n,) in use in all recordings; raises `UsageError` if they differ."""
    each = [_read_gains(recording) for recording in recordings]
    for recording, gains in zip(recordings, each, strict=True):
        if not np.array_equal(gains, each[0]):
            listed = ", ".join(f"{gain:g}" for gain in each[0])
            raise UsageError(
                f"{recording.source} has gains {', '.join(f'{gain:g}' for gain in gains)},"
                f" {recordings[0].source} has {listed}; expected the same gains",
                cure=Cure("give the same gains for all recordings, or in their sheets"),
            )
    return each[0]


def _read_gains(recording: Recording) -> Array:
    """Return the gains (n,) of a recording, or the stiffness of its law, 1 where unknown."""
    if recording.drive_law is not None:
        return np.asarray(np.nan_to_num(recording.drive_law.kp, nan=1.0), dtype=np.float64)
    return np.ones(recording.n_joints) if recording.gains is None else np.array(recording.gains)


def identify_gains(
    model: RobotModel,
    unloaded: Samples | Sequence[Samples],
    loaded: Samples | Sequence[Samples],
    *,
    mass: float,
    com: ArrayLike | None = None,
    inertia_about_com: ArrayLike | None = None,
    drive: DriveSet | None = None,
    frame: str | None = None,
    in_use: ArrayLike | None = None,
    of_command: bool = False,
) -> TorqueGains:
    """Estimate torque gains from recordings without and with a known payload.

    `g_k i_k = Y_k beta` without and `g_k i_k = Y_k beta + P_k phi` with the payload, i being the
    logged torque. beta, g and the unknown part of phi minimise the error of `i_k = (Y_k beta + P_k
    phi) / g_k` in the logged unit; with columns `-i_k` instead, noise of i would bias the gains
    toward zero. The known part of phi sets the scale. A gain is determined if its joint carries the
    payload or shares parameters with joints that do: an axis through the payload's centre needs
    `com`, an axis that gravity never loads needs `inertia_about_com`.

    Source: Gautier and Briot, J. Dynamic Systems, Measurement and Control 136, 2014.

    Parameters
    ----------
    model
        The robot as designed.
    unloaded, loaded
        Samples without and with the payload.
    mass, com, inertia_about_com
        Known mass [kg], centre (3,) [m] and inertia (3, 3) [kg m^2] of the payload in `frame`.
    drive
        Drive terms, by default those usual for motor currents.
    frame
        Frame that carries the payload, by default the flange.
    in_use
        Gains that the samples were multiplied by (`find_gains_in_use`), which the new ones replace.
    of_command
        Whether position servos gave the torques.

    Raises
    ------
    UsageError
        If the mass is not positive, the inertia is given without the centre of mass, recordings of
        either kind are missing, or gains in use are invalid.
    IdentifiabilityError
        If the recordings do not determine the scale.
    """
    if not mass > 0:
        raise UsageError(f"the payload mass is {mass:g} kg; expected the known, positive mass")
    if inertia_about_com is not None and com is None:
        raise UsageError("inertia_about_com of the payload needs com, which is missing")
    without, under = (
        list(each) if isinstance(each, Sequence) else [each] for each in (unloaded, loaded)
    )
    terms = drive if drive is not None else choose_usual_drive(model, "current")
    if not without or not under:
        raise UsageError(
            f"gains of {model.name} need recordings without and with the payload, got"
            f" {len(without)} and {len(under)}; pass at least one of each"
        )
    if terms.needs_load:
        raise UsageError(f"drive terms {terms} depend on load; expected terms that do not")
    used = np.atleast_1d(np.asarray(1.0 if in_use is None else in_use, dtype=np.float64))
    if used.shape not in ((1,), (model.n_joints,)) or not np.all(np.isfinite(used) & (used != 0.0)):
        raise UsageError(
            f"gains in use are {used.tolist()}; expected one number or {model.n_joints}, one per"
            " joint, none of them 0"
        )
    used = np.broadcast_to(used, (model.n_joints,)).copy()
    name, link, placement = choose_payload_frame(model, frame)
    problem = _Problem(model, terms, without, under, link, shift_matrix(placement))
    centre, tensor = (
        np.asarray(np.zeros(shape) if each is None else each, dtype=np.float64)
        for each, shape in ((com, 3), (inertia_about_com, (3, 3)))
    )
    given = LinkInertia.from_com(mass, centre, tensor).parameters
    known = np.array([inertia_about_com is not None] * 6 + [com is not None] * 3 + [True])
    with use_one_blas_thread():
        theta, inverse, sigma = problem.solve(np.where(known, given, 0.0), known)
        scatter = problem.std_errors(theta, inverse, sigma, known)
    gains = 1.0 / inverse
    payload = theta[-10:]
    open_ended = ~(scatter < np.abs(gains)) | (
        np.abs(gains) > GAIN_RUNAWAY * np.nanmedian(np.abs(gains))
    )
    determined = ~open_ended & (scatter < GAIN_LARGEST_ERROR * np.abs(gains))
    if of_command:
        determined &= gains > 0.0
    share = problem.payload_share(gains, payload)
    gains, scatter, share = (np.where(open_ended, np.nan, each) for each in (gains, scatter, share))
    labels = (("mass", mass), ("centre of mass", com), ("inertia", inertia_about_com))
    return TorqueGains(
        joint_names=model.joint_names,
        gains=used * gains,
        std_errors=np.abs(used) * scatter,
        in_use=used,
        determined=determined,
        payload_share=share,
        known=tuple(label for label, each in labels if each is not None),
        frame=name,
        payload=payload,
        sources=tuple(each.source for each in (*without, *under)),
        of_command=of_command,
    )


class _Problem:
    """Hold the triangular factors of `[W_k | P_k | i_k]` of every joint by time block."""

    def __init__(
        self,
        model: RobotModel,
        drive: DriveSet,
        unloaded: Sequence[Samples],
        loaded: Sequence[Samples],
        link: int,
        to_link: Array,
    ) -> None:
        base = find_base_parameters(model, drive)
        self._n = model.n_joints
        self._p = base.n_base
        columns, bare, carried = map_to_payload(base, link, to_link)
        groups = (
            ("without", unloaded, base, bare),
            ("with", loaded, replace(base, columns=columns), carried),
        )
        self.blocks: list[list[Array]] = []
        self.times: list[TimeBlock] = []
        for how, recordings, parameters, of_columns in groups:
            if not any(True for _ in divide_into_blocks(model, recordings)):
                raise IdentifiabilityError(
                    f"no samples of {model.name} {how} the payload are left: every contiguous"
                    " segment is shorter than the filter needs",
                    cure=Cure("record longer, or raise the cutoff"),
                )
            information = accumulate_stream(model, parameters, recordings)
            self.times += information.blocks
            for block in zip(*information.factors, strict=True):
                joints = zip(information.support, block, strict=True)
                self.blocks.append(
                    [
                        widen_factor(rows, support, len(of_columns) - 1) @ of_columns
                        for support, rows in joints
                    ]
                )

    def solve(self, given: Array, known: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Return arm and payload, 1 / gain and noise (n,) by reweighted Gauss-Newton on 1 / gain.

        The first are `[beta, phi]`; the noise is in each joint's logged torque.
        """
        rows = [
            triangular_factor(np.vstack([block[k] for block in self.blocks]))
            for k in range(self._n)
        ]
        n_samples = sum(block.n_samples for block in self.times)
        p = self._p
        free = self._select_free(known)
        theta = np.concatenate([np.zeros(p), given])
        inverse = self._find_signs(rows, theta, free)
        sigma = np.ones(self._n)
        signed = np.vstack([r[:, :-1] * g for r, g in zip(rows, inverse, strict=True)])
        torque = np.concatenate([r[:, -1] for r in rows])
        theta[free] = self._solve_least_squares(
            signed[:, free], torque - signed[:, ~free] @ theta[~free]
        )
        for _ in range(GAIN_ITERATIONS):
            matrix, errors = self._linearise(rows, theta, inverse, sigma, free)
            step = self._solve_least_squares(matrix, errors)
            change = np.clip(step[-self._n :], -0.5 * np.abs(inverse), 0.5 * np.abs(inverse))
            theta[free] += step[: -self._n]
            inverse = inverse + change
            left = [r @ np.append(-g * theta, 1.0) for r, g in zip(rows, inverse, strict=True)]
            noise = np.array([float(np.linalg.norm(error)) for error in left])
            sigma = np.maximum(noise / np.sqrt(n_samples), 1e-12)
            if np.all(np.abs(change) <= GAIN_CONVERGENCE * np.abs(inverse)):
                break
        if not np.all(np.isfinite(inverse)):
            raise IdentifiabilityError(
                "the recordings do not determine the gains",
                cure=Cure("carry a heavier payload, and move the joints that carry it"),
            )
        return theta, inverse, sigma

    def _select_free(self, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.concatenate([np.ones(self._p, dtype=bool), ~known])

    def _linearise(
        self,
        rows: Sequence[Array],
        theta: Array,
        inverse: Array,
        sigma: Array,
        free: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        """Return the matrix of `[beta, free phi, 1 / gain]` about a solution, and the errors."""
        matrix = []
        errors = []
        for k, (r, g, s) in enumerate(zip(rows, inverse, sigma, strict=True)):
            own = np.zeros((len(r), self._n))
            own[:, k] = r[:, :-1] @ theta
            matrix.append(np.hstack([g * r[:, :-1][:, free], own]) / s)
            errors.append((r[:, -1] - g * own[:, k]) / s)
        return np.vstack(matrix), np.concatenate(errors)

    def _solve_least_squares(self, matrix: Array, target: Array) -> Array:
        """Return the shortest least-squares solution in columns scaled to unit length."""
        # Rows are of factors: rounding errors are those of the samples behind them.
        n_rows = self._n * sum(block.n_samples for block in self.times)
        return solve_factor(triangular_factor(np.column_stack([matrix, target])), n_rows).x

    def _find_signs(self, rows: Sequence[Array], theta: Array, free: NDArray[np.bool_]) -> Array:
        """Return the sign (n,) of each gain by a fit of `-i_k g_k + Y_k beta + P_k phi = 0`."""
        matrix = []
        target = []
        for k, r in enumerate(rows):
            own = np.zeros((len(r), self._n))
            own[:, k] = -r[:, -1]
            size = float(np.linalg.norm(r[:, -1])) or 1.0
            matrix.append(np.hstack([r[:, :-1][:, free], own]) / size)
            target.append(-r[:, :-1] @ theta / size)
        gains = self._solve_least_squares(np.vstack(matrix), np.concatenate(target))[-self._n :]
        return np.where(gains < 0, -1.0, 1.0)

    def payload_share(self, gains: Array, payload: Array) -> Array:
        """Return the payload's RMS torque over the RMS torque of the loaded recordings, (n,)."""
        shares = np.zeros(self._n)
        for k, gain in enumerate(gains):
            under = [block[k] for block in self.blocks if np.any(block[k][:, self._p : -1])]
            rows = np.vstack([np.zeros((1, self._p + 11)), *under])
            total = float(np.linalg.norm(rows[:, -1] * gain))
            if total > 0.0:
                shares[k] = np.linalg.norm(rows[:, self._p : -1] @ payload) / total
        return shares

    def std_errors(
        self, theta: Array, inverse: Array, sigma: Array, known: NDArray[np.bool_]
    ) -> Array:
        """Return standard errors of the gains (n,) from time blocks, infinite if undetermined.

        They belong to the fit about the solution, as in `estimate_block_uncertainty`: the arm and
        the unknown part of the payload absorb residuals too.
        """
        free = self._select_free(known)
        p = self._p
        parts = [self._linearise(block, theta, inverse, sigma, free) for block in self.blocks]
        grams = np.array([matrix.T @ matrix for matrix, _ in parts])
        columns = Scaled(grams.sum(axis=0))
        root = columns.inverse_root
        energy = sum(float(errors @ errors) for _, errors in parts)
        n_rows = self._n * sum(block.n_samples for block in self.times)
        variance = energy / max(n_rows - root.shape[1], 1)
        data = BlockScores(
            root.T @ grams @ root,
            np.array([error @ matrix for matrix, error in parts]) @ root,
            self.times,
            group_motions(grams[:, :p, :p], np.array([block.n_samples for block in self.times])),
            n_rows,
            variance,
        )
        own = root[-self._n :]
        found = np.maximum(estimate_scatter(data, own).variance, variance * np.sum(own**2, axis=1))
        return np.where(columns.determined[-self._n :], np.sqrt(found), np.inf) / inverse**2
