"""Weighted least squares on the regressor of any library, as textbooks have it.

`W = [C^T Y(C q + b) | drive columns]` with the coupling C of a mechanism (closed chains: `loops`);
one variance per joint,
from a fit to its rows alone (Gautier, IEEE CDC, 1997); base parameters are the first independent
columns of a column-scaled W; errors are those of independent residuals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from adapter import Estimate, Facts, Fit
from plain import Motion, low_pass

Array = Any
INERTIAL = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
FITTED_RATE_PER_CUTOFF = 10.0
"""Rows fitted per period of the cutoff: ten; more rows hold no further information."""
RANK = 1e-6
"""Pivot of the scaled W, relative to the largest, below which a column is dependent."""

CHUNK = 2000
"""Samples predicted at once."""

TreeRegressor = Callable[[Array, Array, Array], Array]
"""States (N, n_tree) each to (N, n_tree, 10 n_links)."""


@dataclass
class Regression:
    """Regressor of a robot with its drives."""

    facts: Facts
    tree: TreeRegressor

    @property
    def names(self) -> list[str]:
        """Names of the standard parameters, links then drives."""
        links = [f"{each}{k + 1}" for k in range(len(self.facts.tree_joints)) for each in INERTIAL]
        drives = [f"{each}{k + 1}" for k in range(self.n_joints) for each in self.drives]
        shared = [f"{each}_{k + 1}" for k in range(len(self.shared)) for each in ("Fv", "Fc")]
        return links + drives + shared + [f"spring{k}" for k in self.springs]

    @property
    def drives(self) -> tuple[str, ...]:
        """Terms of a joint: viscous, Coulomb, offset, and armature where motor torque is read."""
        return ("Ia", "Fv", "Fc", "Fo") if self.facts.armature else ("Fv", "Fc", "Fo")

    @property
    def shared(self) -> Array:
        """Rows r (m, n): bearings that turn by `r q`, whose friction acts on several motors."""
        return np.reshape(self.facts.settings.get("friction_rows", []), (-1, self.n_joints))

    @property
    def springs(self) -> list[int]:
        """Joints with a spring, counted from 1."""
        return list(self.facts.settings.get("springs", []))

    def bodies(self, motion: Motion) -> Array:
        """Return the columns of the links (N, n, 10 n_links)."""
        q, qd, qdd, coupling = motion.q, motion.qd, motion.qdd, self.facts.coupling
        if coupling is None:
            return self.tree(q, qd, qdd)
        C, b = np.array(coupling["matrix"]), np.array(coupling["offset"])
        return np.einsum("ij,tip->tjp", C, self.tree(q @ C.T + b, qd @ C.T, qdd @ C.T))

    def drive_columns(self, motion: Motion) -> Array:
        """Return the columns of drives, shared bearings and springs (N, n, p_drive)."""
        q, qd, n = motion.q, motion.qd, self.n_joints
        columns = {"Ia": motion.qdd, "Fv": qd, "Fc": np.sign(qd), "Fo": np.ones_like(qd)}
        drives = np.zeros((len(q), n, n * len(self.drives)))
        for place, name in enumerate(self.drives):
            for k in range(n):
                drives[:, k, k * len(self.drives) + place] = columns[name][:, k]
        rates = qd @ self.shared.T
        rubbing = np.stack([rates, np.sign(rates)], axis=2).reshape(len(q), -1)
        shared = rubbing[:, None, :] * np.repeat(self.shared, 2, axis=0).T
        springs = np.zeros((len(q), n, len(self.springs)))
        for place, k in enumerate(self.springs):
            springs[:, k - 1, place] = q[:, k - 1]
        return np.concatenate([drives, shared, springs], axis=2)

    def stacked(self, motions: list[Motion]) -> tuple[Array, Array]:
        """Return W (N n, p), joint by joint, and tau (N n,), at ten rows a period of the cutoff.

        The columns of the drives, which jump, go through the low-pass of the torque.
        """
        W, tau, facts = [], [], self.facts
        step = max(1, round(facts.rate / (FITTED_RATE_PER_CUTOFF * facts.cutoff)))
        for motion in motions:
            inner = motion.inner(facts.edge)
            rows = slice(inner.start, inner.stop, step)
            drives = self.drive_columns(motion)
            smooth = low_pass(drives.reshape(len(drives), -1), facts.rate, facts.cutoff)
            part = Motion(*(x[rows] for x in motion))
            smooth = smooth.reshape(drives.shape)[rows]
            W.append(np.concatenate([self.bodies(part), smooth], axis=2))
            tau.append(part.tau)
        p = W[0].shape[2]
        return np.concatenate(W).transpose(1, 0, 2).reshape(-1, p), np.concatenate(tau).T.ravel()

    def weights(self, W: Array, tau: Array) -> Array:
        """Return one over the deviation of each row, by a fit to the rows of its joint alone."""
        n, found = self.n_joints, []
        for own, torque in zip(np.split(W, n), np.split(tau, n), strict=True):
            residual = torque - own @ np.linalg.lstsq(own, torque, rcond=1e-8)[0]
            found.append(np.full(len(torque), 1.0 / np.std(residual)))
        return np.concatenate(found)

    @property
    def n_joints(self) -> int:
        """Number of logged joints."""
        return len(self.facts.joints)

    def torque(self, motion: Motion, standard: Array) -> Array:
        """Return the torque (N, n) of standard parameters."""
        links = 10 * len(self.facts.tree_joints)
        rigid = []
        for rows in np.array_split(np.arange(len(motion.t)), 1 + len(motion.t) // CHUNK):
            part = Motion(*(x[rows] for x in motion[:4]))
            rigid.append(self.bodies(part) @ standard[:links])
        return np.concatenate(rigid) + self.drive_columns(motion) @ standard[links:]

    def payload(self) -> Estimate:
        """Return the mass that the last link carries, by the torque that the bare arm leaves.

        The bare arm is that of `weighted_fit`; the ten parameters of the payload are the columns of
        the last link (Khalil et al., IROS 2007).
        """
        W, tau = self.stacked(self.facts.plain())
        x = np.linalg.lstsq(W, tau, rcond=1e-8)[0]
        loaded, torque = self.stacked(self.facts.plain(self.facts.loaded))
        w = self.weights(loaded, torque)
        last = 10 * len(self.facts.tree_joints)
        Y, left = loaded[:, last - 10 : last] * w[:, None], (torque - loaded @ x) * w
        found, *_ = np.linalg.lstsq(Y, left, rcond=None)
        variance = np.sum((left - Y @ found) ** 2) / (len(left) - 10)
        error = float(np.sqrt(variance * np.linalg.inv(Y.T @ Y)[9, 9]))
        return Estimate("payload mass", float(found[9]), error)

    def moments(self) -> list[Estimate]:
        """Return the first moments (mx, my, mz) that each weight adds to the body that carries it.

        Of the torque that the bare arm leaves, by the columns of that body and the offsets, which
        drift from log to log.
        """
        W, tau = self.stacked(self.facts.plain())
        x = np.linalg.lstsq(W, tau, rcond=1e-8)[0]
        own = self.facts.settings["carrier"]
        names = [f"{key}{own}" for key in ("mx", "my", "mz")]
        offsets = [name for name in self.names if name.startswith("Fo")]
        columns = [self.names.index(name) for name in (*names, *offsets)]
        found = []
        for log in self.facts.loaded:
            loaded, torque = self.stacked(self.facts.plain([log]))
            w = self.weights(loaded, torque)
            Y, left = loaded[:, columns] * w[:, None], (torque - loaded @ x) * w
            values, *_ = np.linalg.lstsq(Y, left, rcond=1e-8)
            variance = np.sum((left - Y @ values) ** 2) / (len(left) - len(columns))
            errors = np.sqrt(variance * np.diag(np.linalg.pinv(Y.T @ Y, rcond=1e-12)))
            found += [Estimate(*each) for each in zip(names, values, errors, strict=False)]
        return found

    def weighted_fit(self) -> Fit:
        """Identify base parameters by weighted least squares."""
        W, tau = self.stacked(self.facts.plain())
        w = self.weights(W, tau)
        W, tau = W * w[:, None], tau * w
        columns, regrouping = base_columns(W)
        beta = np.linalg.lstsq(W[:, columns], tau, rcond=None)[0]
        variance = np.sum((tau - W[:, columns] @ beta) ** 2) / (len(tau) - len(beta))
        errors = np.sqrt(variance * np.diag(np.linalg.inv(W[:, columns].T @ W[:, columns])))
        standard = np.zeros(W.shape[1])
        standard[columns] = beta
        names = self.names
        parameters = [
            Estimate(
                names[column],
                float(value),
                float(error),
                {names[j]: float(row[j]) for j in np.flatnonzero(np.abs(row) > 1e-9)},
            )
            for column, value, error, row in zip(columns, beta, errors, regrouping, strict=True)
        ]
        return Fit(
            lambda motion: self.torque(motion, standard),
            parameters,
            note=f"{len(columns)} base parameters; no masses{impossible(parameters)}",
        )


def impossible(parameters: list[Estimate]) -> str:
    """Say how many rotors and frictions are negative beyond two standard errors, if any."""
    drives = [each for each in parameters if each.name[:2] in ("Ia", "Fv", "Fc")]
    below = [each for each in drives if each.value < -2.0 * each.error]
    if not below:
        return ""
    return f"; {len(below)} of {len(drives)} rotors and frictions negative beyond two errors"


def base_columns(W: Array) -> tuple[Array, Array]:
    """Return independent columns in order, and (p, all) how the others add to them."""
    scale = np.linalg.norm(W, axis=0)
    kept = scale > 1e-9 * scale.max()
    order = np.flatnonzero(kept)
    R = np.linalg.qr(W[:, order] / scale[order], mode="r")
    chosen: list[int] = []
    basis = np.zeros((R.shape[0], 0))
    for k in range(len(order)):  # the first independent columns in order, by Gram-Schmidt twice
        column = R[:, k]
        for _ in range(2):
            column = column - basis @ (basis.T @ column)
        length = np.linalg.norm(column)
        if length > RANK:
            basis = np.column_stack([basis, column / length])
            chosen.append(k)
    columns = order[chosen]
    full = np.zeros((len(columns), W.shape[1]))
    full[:, order] = np.linalg.lstsq(R[:, chosen], R, rcond=None)[0]
    full = full * np.where(kept, scale, 0.0) / scale[columns][:, None]
    full[np.abs(full) < 1e-7] = 0.0
    return columns, full
