"""Least squares of trajectories, torques and CAD together, in coordinates of consistent robots."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.inertia import pseudo_inertias
from asbuilt.identification.bodies.cad_prior import (
    PSEUDO_INERTIA_SVEC,
    CadPrior,
    body_metric_root,
    smat,
    svec,
)
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.trajectories.sensitivity import Branch, Motion, Trajectories
from asbuilt.identification.trajectories.simulated_robot import FittedLaw, SimulatedRobot
from asbuilt.identification.trajectories.start_elimination import Eliminated, eliminate_starts
from asbuilt.identification.trajectories.windows import Windows

# Hold weights of the objective, and when a parameter is undetermined.

# Weight of drive parameters toward their start, which matters only if they are undetermined
OBJECTIVE_DRIVE_RIDGE = 1e-4
OBJECTIVE_SMALLEST = 1e-6  # Least error of a start [rad, m, rad/s or m/s]
OBJECTIVE_MOST_KEPT = 2e7  # Numbers of derivatives that are kept for other weights
# Share of its variance by prior and torque rows from which a parameter is left undetermined
OBJECTIVE_MOSTLY = 0.5


Slopes = Callable[[], Iterator[tuple[Branch, slice, Array]]]
"""What yields the derivatives of the windows of a recording, branch by branch."""
Starts = tuple[int, slice, Branch, Eliminated]
"""Number of a recording, some of its windows, and how their starts follow a branch's parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Hold standard parameters (n_standard,), links and drives, the law of drives, and starts.

    `starts` are position and velocity at the start of the windows of each recording, (W, 2, n);
    they follow the parameters, as far as the windows determine them.
    """

    chi: Array
    law: FittedLaw
    starts: tuple[Array, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Weights:
    """Hold what the squared error of each joint (n,) and window counts, per set of windows."""

    joints: Array
    windows: tuple[Array, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """Hold cost, gradient (m,), matrix (m, m) and gradients window by window (W, m).

    Starts are at their best, given the parameters; `gain` is by how much the cost falls when they
    move there alone.
    """

    cost: float
    gradient: Array
    matrix: Array
    scores: Array
    data: Array
    starts: tuple[Starts, ...]
    gain: float

    def fall(self, free: Mask) -> float:
        """Return by how much the cost falls if only the free coordinates (m,) move, to its best."""
        g = self.gradient[free]
        return 0.5 * float(g @ np.linalg.solve(self.matrix[np.ix_(free, free)], g))


@dataclass(frozen=True, eq=False)
class Objective:
    """Measure a point by trajectories, torque rows and distance from CAD.

    The coordinates around a point are S_i of every link, `P_i = L_i exp(S_i) L_i^T` with L_i the
    Cholesky factor of its pseudo-inertia, so that every link is physically consistent; drive
    parameters; and those of the law.

    Attributes
    ----------
    trajectories, windows
        What is simulated.
    information, torque_weights
        Torque rows, and the weight of the rows of each joint (n,), zero for none.
    prior, belief
        CAD, and the weight of the divergence from it; infinite holds the links of CAD.
    start
        Where parameters of drives and law stay if nothing determines them; what is fitted of the
        law is the same at every point.
    """

    trajectories: Trajectories
    windows: tuple[Windows, ...]
    information: SquareRootInformation
    torque_weights: Array
    prior: CadPrior
    belief: float
    start: Point

    @property
    def n_links(self) -> int:
        """Number of links."""
        return self.prior.n_links

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.start.chi) + len(self.start.law.free.names)

    def robot(self, point: Point) -> SimulatedRobot:
        """Return the robot of a point, the links of the description in place of its own."""
        model = self.trajectories.model
        drive = self.trajectories.base.drive
        values = point.chi[10 * self.n_links :].reshape(model.n_joints, -1)
        return SimulatedRobot(model, drive, values, point.law.servo)

    @cached_property
    def links_held(self) -> bool:
        """Whether no link moves."""
        return not np.isfinite(self.belief)

    @cached_property
    def free(self) -> Indices:
        """The coordinates that are fitted."""
        return np.arange(10 * self.n_links if self.links_held else 0, self.size)

    @cached_property
    def start_weights(self) -> tuple[Array, ...]:
        """What the squared distance of starts from the measured ones counts, (2, n) each.

        A position has the error by which it differs from the logged one, a velocity is as
        uncertain as the velocities of the joint are large, so that the window decides.
        """
        squares = (
            [np.mean((cut.q[:, 0] - cut.start_q) ** 2, axis=0), np.mean(cut.start_qd**2, axis=0)]
            for cut in self.windows
        )
        return tuple(1.0 / (np.stack(square) + OBJECTIVE_SMALLEST**2) for square in squares)

    def motions(self, point: Point, some: Sequence[Indices] | None = None) -> list[Motion]:
        """Simulate all windows, or `some` of each recording by number."""
        cuts = [
            replace(cut, start_q=start[:, 0], start_qd=start[:, 1])
            for cut, start in zip(self.windows, point.starts, strict=True)
        ]
        if some is not None:
            cuts = [cut.some(at) for cut, at in zip(cuts, some, strict=True)]
        robot = self.robot(point)
        links = point.chi[: 10 * self.n_links]
        parts = [
            (k, at)
            for k, cut in enumerate(cuts)
            for at in np.array_split(
                np.arange(cut.n_windows), min(os.cpu_count() or 1, max(cut.n_windows, 1))
            )
        ]

        def one(part: tuple[int, Indices]) -> Motion:
            cut = cuts[part[0]].some(part[1])
            return self.trajectories.simulate(robot.centred(cut.step), cut, links)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = list(pool.map(one, parts))
        of_recordings = [
            [each for (at, _), each in zip(parts, found, strict=True) if at == k]
            for k in range(len(self.windows))
        ]
        return [Motion(*map(np.concatenate, zip(*own, strict=True))) for own in of_recordings]

    def errors(self, motions: Sequence[Motion]) -> list[Array]:
        """Return measured minus simulated positions after the start, (W, L - 1, n) each."""
        return [
            cut.q[:, 1:] - motion.sampled(cut.divisions)[:, 1:]
            for cut, motion in zip(self.windows, motions, strict=True)
        ]

    def cost(self, point: Point, motions: Sequence[Motion], weights: Weights) -> float:
        """Return half the weighted squares of everything; infinite if a simulation diverges."""
        total = float(sum(np.sum(cost) for cost in self.window_costs(point, motions, weights)))
        return total + self.other_cost(point) if np.isfinite(total) else np.inf

    def window_costs(
        self, point: Point, motions: Sequence[Motion], weights: Weights
    ) -> list[Array]:
        """Return the part of the cost that belongs to each window (W,), its start included."""
        return [
            0.5 * of_window * (np.sum(error**2, axis=1) @ weights.joints)
            + 0.5 * np.sum(weight * off**2, axis=(1, 2))
            for error, of_window, weight, off in zip(
                self.errors(motions),
                weights.windows,
                self.start_weights,
                self._measure_start_moves(point),
                strict=True,
            )
        ]

    def other_cost(self, point: Point) -> float:
        """Return the part of the cost that belongs to no window."""
        _, rest = self._build_torque_rows(point)
        ridge, moved = self._build_pull(point)
        total = 0.5 * float(rest @ rest + ridge @ moved**2)
        if self.links_held:
            return total
        divergence = float(self.prior.strength @ self.prior.divergence(point.chi))
        return total + 0.5 * self.belief * divergence

    def _measure_start_moves(self, point: Point) -> list[Array]:
        """Return the starts less the measured ones, (W, 2, n) each."""
        return [
            start - np.stack([cut.start_q, cut.start_qd], axis=1)
            for start, cut in zip(point.starts, self.windows, strict=True)
        ]

    def slopes(self, point: Point, motions: Sequence[Motion]) -> tuple[Slopes, ...]:
        """Return the derivatives of the motions of every recording, computed once if they are few.

        They do not depend on weights. Others are computed each time that they are asked for.
        """
        needed = np.any(self._derive_parameters(point)[:, self.free] != 0.0, axis=1)
        robot = self.robot(point)
        links = point.chi[: 10 * self.n_links]
        found = [
            partial(
                self.trajectories.derivatives, robot.centred(cut.step), cut, links, motion, needed
            )
            for cut, motion in zip(self.windows, motions, strict=True)
        ]
        size = sum(cut.n_windows * cut.n_samples for cut in self.windows)
        if size * self.trajectories.model.n_joints * np.count_nonzero(needed) > OBJECTIVE_MOST_KEPT:
            return tuple(found)
        return tuple(partial(iter, list(each())) for each in found)

    def quadratic(
        self,
        point: Point,
        motions: Sequence[Motion],
        weights: Weights,
        slopes: Sequence[Slopes] | None = None,
    ) -> Quadratic:
        """Return the quadratic model of the cost around a point, starts eliminated.

        `slopes` belong to the point and its motions; None: they are computed.
        """
        to_z = self._derive_parameters(point)
        slopes = self.slopes(point, motions) if slopes is None else slopes
        H, scores, starts, gain = self._reduce_windows(point, motions, weights, slopes, len(to_z))
        data = to_z.T @ H @ to_z
        matrix = data.copy()
        gradient = -to_z.T @ scores.sum(axis=0)
        rows, rest = self._build_torque_rows(point)
        A = rows @ to_z
        matrix += A.T @ A
        gradient += A.T @ rest
        if not self.links_held:
            self._add_cad(point, gradient, matrix)
        ridge, moved = self._build_pull(point)
        gradient += ridge * moved
        matrix[np.diag_indices(len(ridge))] += ridge
        cost = self.cost(point, motions, weights)
        return Quadratic(cost, gradient, matrix, scores @ to_z, data, starts, gain)

    def _reduce_windows(
        self,
        point: Point,
        motions: Sequence[Motion],
        weights: Weights,
        slopes: Sequence[Slopes],
        size: int,
    ) -> tuple[Array, Array, tuple[Starts, ...], float]:
        """Return matrix (size, size) and scores (W, size) of windows, starts, and their gain."""
        H = np.zeros((size, size))
        scores = []
        starts = list[Starts]()
        gain = 0.0
        errors = self.errors(motions)
        away = self._measure_start_moves(point)
        for k, (cut, derivatives, error, of_window) in enumerate(
            zip(self.windows, slopes, errors, weights.windows, strict=True)
        ):
            score = np.zeros((cut.n_windows, size))
            for branch, part, J in derivatives():
                root = np.sqrt(of_window[part])[:, None, None] * np.sqrt(
                    weights.joints[branch.joints]
                )
                own = eliminate_starts(
                    (J * root[..., None]).reshape(len(J), -1, J.shape[-1]),
                    (error[part][..., branch.joints] * root).reshape(len(J), -1),
                    self.start_weights[k][:, branch.joints].ravel(),
                    away[k][part][:, :, branch.joints].reshape(len(J), -1),
                )
                at = branch.parameters
                H[np.ix_(at, at)] += own.matrix
                score[part, at] += own.scores
                starts.append((k, part, branch, own))
                gain += own.gain
            scores.append(score)
        return H, np.concatenate(scores), tuple(starts), gain

    def starts_after(self, point: Point, quadratic: Quadratic, step: Array) -> tuple[Array, ...]:
        """Return the best starts at coordinates `step` (m,) from a point, by its model."""
        z = self._derive_parameters(point) @ step
        found = [start.copy() for start in point.starts]
        for k, part, branch, own in quadratic.starts:
            moved = own.to_best - own.by_parameters @ z[branch.parameters]
            found[k][part][:, :, branch.joints] += moved.reshape(-1, 2, len(branch.joints))
        return tuple(found)

    def moved(self, point: Point, step: Array, starts: tuple[Array, ...]) -> Point:
        """Return the point at coordinates `step` (m,) from a point, with other starts."""
        n = self.n_links
        L = np.linalg.cholesky(pseudo_inertias(point.chi[: 10 * n].reshape(n, 10)))
        values, axes = np.linalg.eigh(smat(step[: 10 * n].reshape(n, 10)))
        grown = (axes * np.exp(np.clip(values, -20.0, 20.0))[:, None]) @ axes.transpose(0, 2, 1)
        P = L @ grown @ L.transpose(0, 2, 1)
        chi = point.chi.copy()
        chi[: 10 * n] = np.linalg.solve(PSEUDO_INERTIA_SVEC, svec(P).T).T.reshape(-1)
        chi[10 * n :] += step[10 * n : len(chi)]
        bounded = self.prior.non_negative
        chi[bounded] = np.maximum(chi[bounded], 0.0)
        return Point(chi, point.law.moved(step[len(chi) :]), starts)

    def at_bound(self, point: Point, gradient: Array) -> Mask:
        """Return which coordinates are held or lie at their bound with the descent beyond it."""
        held = np.ones(self.size, dtype=np.bool_)
        held[self.free] = False
        bounded = self.prior.non_negative
        held[bounded] |= (point.chi[bounded] <= 0.0) & (gradient[bounded] > 0.0)
        last = len(point.chi)
        held[last:] |= point.law.at_bound(gradient[last:])
        return held

    def covariance(self, point: Point, quadratic: Quadratic) -> Array:
        """Return the covariance (p_z, p_z) of parameters of base and law at the minimum."""
        to_z = self._derive_parameters(point)[:, self.free]
        root = np.linalg.cholesky(quadratic.matrix[np.ix_(self.free, self.free)])
        spread = np.linalg.solve(root, to_z.T)
        return spread.T @ spread

    def drive_errors(self, quadratic: Quadratic) -> Array:
        """Return the standard errors (n, columns_per_joint) of the drive parameters."""
        variance = np.zeros(self.size)
        variance[self.free] = np.diag(self._invert(quadratic.matrix))
        of_drives = variance[10 * self.n_links : len(self.start.chi)]
        return np.sqrt(of_drives).reshape(self.trajectories.model.n_joints, -1)

    def undetermined(self, quadratic: Quadratic) -> tuple[str, ...]:
        """Return the parameters of drives and law that the trajectories hardly determine."""
        names = [*self.prior.names, *self.start.law.free.names]
        inverse = self._invert(quadratic.matrix)
        held = np.zeros(self.size)
        rest = (quadratic.matrix - quadratic.data)[np.ix_(self.free, self.free)]
        held[self.free] = np.diag(inverse @ rest @ inverse) / np.diag(inverse)
        drives = range(10 * self.n_links, self.size)
        return tuple(names[k] for k in drives if held[k] > OBJECTIVE_MOSTLY)

    def _invert(self, matrix: Array) -> Array:
        """Return the inverse of the part of a matrix (m, m) that belongs to what is fitted."""
        return np.asarray(np.linalg.inv(matrix[np.ix_(self.free, self.free)]))

    def _derive_parameters(self, point: Point) -> Array:
        """Return how parameters of base and law follow from the coordinates, (p_z, m)."""
        n = self.n_links
        p = self.trajectories.base.n_base
        K = self.trajectories.base.regrouping
        roots = np.linalg.inv(body_metric_root(point.chi[: 10 * n], np.ones(n)))
        to_z = np.zeros((self.trajectories.n_parameters, self.size))
        for i in range(n):
            part = slice(10 * i, 10 * i + 10)
            to_z[:p, part] = K[:, part] @ roots[i]
        to_z[:p, 10 * n : len(point.chi)] = K[:, 10 * n :]
        to_z[p:, len(point.chi) :] = point.law.columns
        return to_z

    def _build_torque_rows(self, point: Point) -> tuple[Array, Array]:
        """Return rows (r, p_z) and residuals (r,) of the torques, which follow the stiffness."""
        base = self.trajectories.base
        beta = base.regrouping @ point.chi
        start = self.start.law
        scale = point.law.stiffness_factor(start)
        stiffness = np.zeros(self.information.n_joints)
        if start.servo is not None and start.free.stiffness:
            stiffness = np.array(start.servo.kp)
        rows = []
        rest = []
        for k, (support, factor) in enumerate(
            zip(self.information.support, self.information.joint_factors, strict=True)
        ):
            weighted = self.torque_weights[k] * factor
            row = np.zeros((len(factor), self.trajectories.n_parameters))
            row[:, support] = weighted[:, :-1]
            if stiffness[k]:
                row[:, base.n_base + k] = -weighted[:, -1] / stiffness[k]
            rows.append(row)
            rest.append(weighted[:, :-1] @ beta[support] - scale * weighted[:, -1])
        return np.concatenate(rows), np.concatenate(rest)

    def _add_cad(self, point: Point, gradient: Array, matrix: Array) -> None:
        """Add gradient and curvature of half the divergence of the links from CAD."""
        n = self.n_links
        L = np.linalg.cholesky(pseudo_inertias(point.chi[: 10 * n].reshape(n, 10)))
        C = L.transpose(0, 2, 1) @ np.linalg.inv(self.prior.pseudo_inertias) @ L
        basis = smat(np.eye(10))
        for i in range(n):
            part = slice(10 * i, 10 * i + 10)
            weight = 0.5 * self.belief * self.prior.strength[i]
            gradient[part] += weight * svec(C[i] - np.eye(4))
            turned = np.einsum("ab,xbc,ycd->xyad", C[i], basis, basis)
            curvature = np.einsum("xyaa->xy", turned)
            matrix[part, part] += weight * 0.5 * (curvature + curvature.T)

    def _build_pull(self, point: Point) -> tuple[Array, Array]:
        """Return weights (m,) of drives and law toward their start, and how far they are from it.

        Both are zero for links.
        """
        ridge = np.zeros(self.size)
        away = np.zeros(self.size)
        chi = point.chi
        drives = slice(10 * self.n_links, len(chi))
        law = slice(len(chi), None)
        ridge[drives] = OBJECTIVE_DRIVE_RIDGE / self.prior.drive_scale**2
        away[drives] = (chi - self.start.chi)[drives]
        ridge[law] = point.law.free.weights
        away[law] = point.law.away(self.start.law)
        return ridge, away
