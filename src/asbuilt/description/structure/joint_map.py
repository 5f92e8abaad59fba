"""How the joints of the tree of bodies move with the coordinates, which a log has columns of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, Indices, Mask, read_only


@dataclass(frozen=True, eq=False)
class ShareDerivatives:
    """Hold derivatives of the motion of the joints of the tree by the motion of the coordinates.

    `second` (N, n_links, n, n) is f's Hessian, `d^2 f_i / dq_j dq_k`; `turning` (N, n_links, n) is
    dG/dt, so that d qd_tree/dq is `turning` and d qdd_tree/dqd twice that; `position` (N, n_links,
    n) is d qdd_tree/dq.
    """

    second: Array
    turning: Array
    position: Array


@dataclass(frozen=True, eq=False)
class TreeMotion:
    """Hold the motion of the joints of the tree and how the coordinates move them.

    `q`, `qd`, `qdd` are (N, n_links). `shares` G = dq_tree/dq is (n_links, n_joints) where it is
    constant, else (N, n_links, n_joints).
    """

    q: Array
    qd: Array
    qdd: Array
    shares: Array

    @property
    def by_sample(self) -> Array:
        """The shares with an axis of samples, of length 1 where they are constant."""
        return self.shares if self.shares.ndim == 3 else self.shares[None]

    def torques(self, tau: Array) -> Array:
        """Return `G^T tau` (N, n_joints) for torques (N, n_links) at the joints of the tree."""
        # Virtual work: tau_q = G^T tau_tree.
        if self.shares.ndim == 2:
            return np.ascontiguousarray(tau @ self.shares)
        return np.ascontiguousarray(np.einsum("si,sik->sk", tau, self.shares))

    def matrices(self, of_tree: Array) -> Array:
        """Return `G^T M G` (N, n_joints, n_joints) for M (N, n_links, n_links) of the tree."""
        return np.ascontiguousarray(np.swapaxes(self.shares, -1, -2) @ of_tree @ self.shares)

    def columns(self, of_tree: Array) -> Array:
        """Return `J G` (N, k, 6, n_joints) for Jacobians J (N, k, 6, n_links) of the tree."""
        return of_tree @ (self.shares if self.shares.ndim == 2 else self.shares[:, None])


class OwnMotion(TreeMotion):
    """Hold the motion of joints that are the coordinates themselves: nothing is to be summed."""

    def torques(self, tau: Array) -> Array:
        """Return the torques as they are."""
        return tau

    def matrices(self, of_tree: Array) -> Array:
        """Return the matrices as they are."""
        return of_tree

    def columns(self, of_tree: Array) -> Array:
        """Return the Jacobians as they are."""
        return of_tree


class JointMap:
    """Say how the joints of all links move with the coordinates q, (N, n_joints).

    The tree is the robot with a drive at every joint, its links in an order in which parents come
    first: link i of the tree is link `order[i]` of the robot (n_links,). What evaluates bodies does
    so for the tree, moved by `motion`, and need not know how the coordinates move it.
    """

    order: Indices
    of_links: Array
    """Typical shares in the order of the robot's links, (n_links, n_joints)."""
    first_posture: Array | None = None
    """Positions (n_joints,) about which the map holds; None: everywhere."""
    work: ClassVar[int] = 0
    """Work of the motion of a state, in joints times parameters: next to none for shares that are
    constant. What searches many states counts it."""

    def motion(self, q: Array, qd: Array | None = None, qdd: Array | None = None) -> TreeMotion:
        """Return the motion of the joints of the tree; rates not given are zero.

        Raises `MotionError` where no such motion exists.
        """
        raise NotImplementedError

    def derivatives(self, q: Array, qd: Array, qdd: Array) -> ShareDerivatives | None:
        """Return how the shares change with the motion, at states (N, n_joints); None: not."""
        return None

    def parameters(self, chi: NDArray[Any]) -> NDArray[Any]:
        """Return what belongs to parameters (..., n_links, 10) in the order of the tree."""
        return np.ascontiguousarray(chi[..., self.order, :])

    def by_link(self, of_tree: Array) -> Array:
        """Return what has an axis 1 of the tree's links in the order of the robot's."""
        return np.asarray(of_tree[:, np.argsort(self.order)])

    def exists(self, q: Array) -> Mask:
        """Return at which positions (N, n_joints) the joints of the tree have one."""
        return np.ones(len(q), dtype=bool)

    def draw(self, lower: Array, upper: Array, rng: np.random.Generator, count: int) -> Array:
        """Return positions (count, n_joints) that exist, uniform within bounds (n_joints,) each."""
        return rng.uniform(lower, upper, (count, len(lower)))


@dataclass(frozen=True)
class OneToOne(JointMap):
    """Say that every joint has a drive and a column of its own: coordinates are the joints."""

    n_joints: int

    @property
    def order(self) -> Indices:  # type: ignore[override]
        """The links as they are."""
        return np.arange(self.n_joints)

    @property
    def matrix(self) -> Array:
        """As of a `Coupling`."""
        return np.eye(self.n_joints)

    @property
    def offset(self) -> Array:
        """As of a `Coupling`."""
        return np.zeros(self.n_joints)

    @cached_property
    def of_links(self) -> Array:  # type: ignore[override]
        """Every joint moves one to one with its own coordinate."""
        return read_only(np.eye(self.n_joints))

    def motion(self, q: Array, qd: Array | None = None, qdd: Array | None = None) -> TreeMotion:
        """Return the motion itself."""
        still = np.zeros_like(q) if qd is None or qdd is None else q
        return OwnMotion(
            q, still if qd is None else qd, still if qdd is None else qdd, self.of_links
        )

    def parameters(self, chi: NDArray[Any]) -> NDArray[Any]:
        """Return the parameters as they are."""
        return chi

    def by_link(self, of_tree: Array) -> Array:
        """Return the array as it is."""
        return of_tree
