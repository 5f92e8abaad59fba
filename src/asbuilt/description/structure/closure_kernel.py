"""Positions of passive joints along a motion, by Newton's method, and how motors move them.

With coordinates u = (q, p) of motors and passive joints, the equations `phi(u) = 0` of the loops
and their derivative `J = (J_q, J_p)`

    p' = p - J_p^+ phi                      a step of Newton, J_p^+ by Householder's QR
    dp/dq = -J_p^+ J_q                      how motors move passive joints
    pdd = -J_p^+ (J_q qdd + dJ/dt ud)
"""

# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from asbuilt.compilation import kernel, part
from asbuilt.description.structure.loop_equations import (
    allocate_workspace,
    assemble,
    count_equations,
    expand_into_tree,
)

NEWTON = 12
"""Most steps of Newton; from a sample to the next it takes two."""
SEARCH = 200
"""Most steps towards the first closed posture, each shortened to `FARTHEST`."""
CONVERGED = 1e-8
"""Correction after which the next is rounding, as Newton's are squared at each step [rad]."""
FARTHEST = 0.25
"""Largest correction [rad, or share of the loop's size] that keeps the assembly mode."""
STRIDE = 0.1
"""Longest step of a motor [rad, or share of the loop's size] from a closed posture."""
SHORTEST = 1e-6
"""Steps of this size that do not close end at the reach of the mechanism, or at a singularity."""
SINGULAR = 1e-9
"""Ratio of the pivots of J_p at which some passive joint is not determined by the loops."""


@part
def _reduce(work, rows, first, count, order):
    """Bring columns first ... first + count - 1 to triangular form, others turned along.

    Householder reflections with pivots; `order` takes the columns in the order of the pivots.
    Returns the ratio of the last pivot to the first, 0 where there are fewer rows than columns.
    """
    width = work.shape[1]
    largest = 0.0
    smallest = 0.0
    for k in range(count):
        order[k] = k
    if rows < count:
        return 0.0
    for k in range(count):
        # The column with the most left comes next: the last pivot then measures the rank.
        best = k
        most = -1.0
        for j in range(k, count):
            total = 0.0
            for i in range(k, rows):
                total += work[i, first + j] ** 2
            if total > most:
                best = j
                most = total
        if best != k:
            order[k], order[best] = order[best], order[k]
            for i in range(rows):
                work[i, first + k], work[i, first + best] = (
                    work[i, first + best],
                    work[i, first + k],
                )
        norm = math.sqrt(most)
        largest = max(largest, norm)
        # Below, some passive joint could move without opening a loop.
        smallest = norm
        if norm <= SINGULAR * largest or norm == 0.0:
            return 0.0
        # Away from the head, so that their difference loses no digits.
        head = work[k, first + k]
        pivot = -norm if head > 0.0 else norm
        work[k, first + k] = head - pivot
        scale = 1.0 / (pivot * (pivot - head))
        for j in range(width):
            # Columns that are finished, and the reflection itself, stay.
            if first <= j <= first + k:
                continue
            total = 0.0
            for i in range(k, rows):
                total += work[i, first + k] * work[i, j]
            total *= scale
            for i in range(k, rows):
                work[i, j] -= total * work[i, first + k]
        work[k, first + k] = pivot
        for i in range(k + 1, rows):
            work[i, first + k] = 0.0
    return smallest / largest


@part
def _solve(work, first, count, order, column, out):
    """Write the solution of the reduced equations for a right-hand side."""
    # Back substitution, in the order of the pivots.
    for k in range(count - 1, -1, -1):
        total = work[k, column]
        for j in range(k + 1, count):
            total -= work[k, first + j] * out[order[j]]
        out[order[k]] = total / work[k, first + k]


@part
def _measure_gap(work, rows, phi):
    """Return the norm of phi, in units of the loops' sizes and rad."""
    total = 0.0
    for i in range(rows):
        total += work[i, phi] ** 2
    return math.sqrt(total)


@part
def _factor_jacobian(mechanism, u, still, n, work, room, here, order):
    """Factor J at u; returns the gap and the ratio of pivots."""
    expand_into_tree(mechanism, u, 1.0, here)
    assemble(mechanism, here, still, work, room)
    gap = _measure_gap(work, work.shape[0], work.shape[1] - 2)
    return gap, _reduce(work, work.shape[0], n, order.size, order)


@part
def _close_loops(mechanism, u, still, n, scale, tolerance, search, work, room, here, order, step):
    """Move the passive joints of u until the loops close, and leave the factors of J there.

    Returns whether they do, the gap, and the ratio of pivots.
    """
    phi = work.shape[1] - 2
    passive = order.size
    for _ in range(SEARCH if search else NEWTON):
        gap, pivot = _factor_jacobian(mechanism, u, still, n, work, room, here, order)
        if pivot <= SINGULAR:
            return False, gap, pivot
        _solve(work, n, passive, order, phi, step)
        most = 0.0
        for k in range(passive):
            most = max(most, abs(step[k]) / scale[n + k])
        # Far jumps may land in another assembly mode; a search has none to keep.
        if not math.isfinite(most) or (most > FARTHEST and not search):
            return False, gap, pivot
        share = FARTHEST / most if most > FARTHEST else 1.0
        for k in range(passive):
            u[n + k] -= share * step[k]
        # Newton squares its error: this correction was the last, and the gap is measured once more.
        if most <= CONVERGED:
            gap, pivot = _factor_jacobian(mechanism, u, still, n, work, room, here, order)
            return pivot > SINGULAR and gap <= tolerance, gap, pivot
    return False, gap, pivot


@part
def _predict_posture(u, moves, target, share, tried):
    """Write the posture a share of the way from u to motors at `target`, by the tangent."""
    passive, n = moves.shape
    for k in range(n):
        # exactly the target in the end
        tried[k] = target[k] if share >= 1.0 else u[k] + share * (target[k] - u[k])
    for k in range(passive):
        tried[n + k] = u[n + k]
        for j in range(n):
            tried[n + k] += moves[k, j] * (tried[j] - u[j])


@part
def _measure_farthest_motor(u, target, scale):
    """Return the longest way of a motor from u to `target`, in units of `scale`."""
    most = 0.0
    for k in range(target.size):
        most = max(most, abs(target[k] - u[k]) / scale[k])
    return most


@part
def _solve_moves(work, n, order, moves, step):
    """Write how motors move passive joints, by the factors of J."""
    # dp/dq = -J_p^+ J_q, column by column.
    for j in range(n):
        _solve(work, n, order.size, order, j, step)
        for k in range(order.size):
            moves[k, j] = -step[k]


@part
def _carry_rates(u, moves, motor, bias):
    """Write into u all coordinates' rates for the motors' rates; passive ones less `bias`."""
    passive, n = moves.shape
    for k in range(n):
        u[k] = motor[k]
    for k in range(passive):
        # pdd = -J_p^+ (J_q qdd + dJ/dt ud)
        u[n + k] = -bias[k]
        for j in range(n):
            u[n + k] += moves[k, j] * motor[j]


@part
def _write_shares(mechanism, moves, shares):
    """Write how the joints of the tree move with the motors, `A (1, dp/dq)`."""
    n = moves.shape[1]
    sources = mechanism[5]
    first = mechanism[6]
    for joint in range(shares.shape[0]):
        for j in range(n):
            shares[joint, j] = 0.0
        for k in range(first[joint], first[joint + 1]):
            column = int(sources[k, 0])
            factor = sources[k, 1]
            if column < n:
                shares[joint, column] += factor
            else:
                for j in range(n):
                    shares[joint, j] += factor * moves[column - n, j]


@kernel("i1 i3 f2 f2 b1 f2 i1 f1 f1 f1 f b f2 F2 F2")
def close_loops(
    kinds,
    paths,
    numbers,
    placements,
    revolute,
    sources,
    first,
    offset,
    scale,
    home,
    tolerance,
    search,
    q,
    postures,
    quality,
):
    """Write the postures u (N, n + passive) of motors at q (N, n) in which the loops close.

    Each sample starts from the one before, the first from the closed posture `home`, in steps that
    keep the assembly mode. `quality[s]` are the gap, the ratio of the pivots of J_p, and 1 where
    the loops close within `tolerance`; postures are NaN where they do not. With `search`, the
    passive joints of `home` are a guess from which Newton may go far. `scale` (n + passive,) is 1
    for angles, the size of a loop for lengths.
    """
    mechanism = (kinds, paths, numbers, placements, revolute, sources, first, offset)
    n = q.shape[1]
    n_tree = offset.size
    passive = home.size - n
    work = np.zeros((count_equations(kinds), n + passive + 2))
    room = allocate_workspace(n_tree)
    order = np.zeros(passive, dtype=np.int64)
    step = np.zeros(passive)
    here = np.zeros(n_tree)
    still = np.zeros(n_tree)
    # u is the last posture that closed; `known` the last of a sample
    u = home.copy()
    known = home.copy()
    tried = home.copy()
    moves = np.zeros((passive, n))
    moved = np.zeros((passive, n))
    for sample in range(q.shape[0]):
        target = q[sample]
        # In a search the first posture is not closed, so that no step from it means anything.
        if search:
            u[:n] = target
        # Long ways in strides, so that the tangent stays near the branch.
        share = STRIDE / max(_measure_farthest_motor(u, target, scale), STRIDE)
        closed = False
        while not closed:
            # The tangent predicts, Newton corrects.
            _predict_posture(u, moves, target, share, tried)
            closed, gap, pivot = _close_loops(
                mechanism,
                tried,
                still,
                n,
                scale,
                tolerance,
                search,
                work,
                room,
                here,
                order,
                step,
            )
            if closed:
                _solve_moves(work, n, order, moves, step)
                u[:] = tried
                closed = share >= 1.0
                share = STRIDE / max(_measure_farthest_motor(u, target, scale), STRIDE)
            # The mechanism ends here, or is singular: shorter steps do not help.
            elif search or share * _measure_farthest_motor(u, target, scale) < SHORTEST:
                break
            else:
                # A quarter, as the error of the tangent falls with the square.
                share *= 0.25
        quality[sample, 0], quality[sample, 1] = gap, pivot
        quality[sample, 2] = 1.0 if closed else 0.0
        if closed:
            postures[sample] = u
            known[:], moved[:] = u, moves
        else:
            postures[sample] = tried if search else np.full(home.size, np.nan)
            # The next sample starts from the last one that closed.
            u[:], moves[:] = known, moved


@kernel("i1 i3 f2 f2 b1 f2 i1 f1 f2 f2 f2 F2 F2 F2 F3")
def move_tree(
    kinds,
    paths,
    numbers,
    placements,
    revolute,
    sources,
    first,
    offset,
    postures,
    qd,
    qdd,
    at,
    rates,
    accelerations,
    shares,
):
    """Write motion (N, n_links) and shares (N, n_links, n) of the joints of the tree.

    `postures` (N, n + passive) are those of `close_loops`; where these are NaN, so is the motion.
    """
    mechanism = (kinds, paths, numbers, placements, revolute, sources, first, offset)
    n = qd.shape[1]
    n_tree = offset.size
    passive = postures.shape[1] - n
    work = np.zeros((count_equations(kinds), n + passive + 2))
    room = allocate_workspace(n_tree)
    order = np.zeros(passive, dtype=np.int64)
    step = np.zeros(passive)
    none = np.zeros(passive)
    here = np.zeros(n_tree)
    still = np.zeros(n_tree)
    rate = np.zeros(n + passive)
    moves = np.zeros((passive, n))
    for sample in range(postures.shape[0]):
        u = postures[sample]
        if math.isnan(u[0]):
            at[sample] = np.nan
            rates[sample], accelerations[sample], shares[sample] = np.nan, np.nan, np.nan
            continue
        _factor_jacobian(mechanism, u, still, n, work, room, here, order)
        _solve_moves(work, n, order, moves, step)
        expand_into_tree(mechanism, u, 1.0, at[sample])
        _carry_rates(rate, moves, qd[sample], none)
        expand_into_tree(mechanism, rate, 0.0, rates[sample])
        # With rates: the factors at hand are of J alone, and the bias is needed now.
        assemble(mechanism, at[sample], rates[sample], work, room)
        _reduce(work, work.shape[0], n, passive, order)
        _solve(work, n, passive, order, work.shape[1] - 1, step)
        _carry_rates(rate, moves, qdd[sample], step)
        expand_into_tree(mechanism, rate, 0.0, accelerations[sample])
        _write_shares(mechanism, moves, shares[sample])
