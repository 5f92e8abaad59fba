"""Compiled time steps of a robot under its servo, and their derivatives by parameters.

One step solves `(M + E + h (D + Kd)) a + b(q, v) + D v + even(q, v) + f = servo(q, v)` for the
acceleration a, with `v' = v + h a`, `q' = q + h v'`. E and D are the armatures and dampings of the
drives, b the torques of the rigid bodies without acceleration, even and odd the parts of all other
drive terms that do not and do change sign with the velocity. The odd part is dry friction: f has
the sign of v' and the size of odd, or is what holds the joint at rest, if that is less (Moreau's
time stepping, solved by Gauss and Seidel). These are the steps of MuJoCo's `implicitfast` with
rigid dry friction.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from asbuilt.compilation import kernel, part
from asbuilt.dynamics.kernels.operations import STACK
from asbuilt.dynamics.kernels.recursion import PARENT
from asbuilt.dynamics.kernels.single_sample import CODES, PER_LINK, mass_matrix, torque
from asbuilt.dynamics.kernels.stack_machine import run

SLOWEST = 1e-9
"""Speed at which the friction of a joint at rest is evaluated [rad/s or m/s]."""


@part
def factor_cholesky(A, first, n):
    """Write the lower Cholesky factor over A; return False if A is not positive definite.

    Row i of A begins at `first[i]`: what is before it is zero, and so it is in the factor. The
    diagonal of the factor is kept inverted.
    """
    for i in range(n):
        for j in range(first[i], i):
            for k in range(max(first[i], first[j]), j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] *= A[j, j]
            A[i, i] -= A[i, j] * A[i, j]
        if not A[i, i] > 0.0:
            return False
        A[i, i] = 1.0 / np.sqrt(A[i, i])
    return True


@part
def solve_cholesky(L, first, x, n):
    """Overwrite x by the solution of `L L^T y = x` for a factor of `factor_cholesky`."""
    for i in range(n):
        for k in range(first[i], i):
            x[i] -= L[i, k] * x[k]
        x[i] *= L[i, i]
    for i in range(n - 1, -1, -1):
        x[i] *= L[i, i]
        for k in range(first[i], i):
            x[k] -= L[i, k] * x[i]


@part
def _write_row_starts(codes, moved_by, rotors, damping, first):
    """Write the column at which each row (n,) of the mass matrix begins, by the branches."""
    for k in range(first.size):
        first[k] = k
        for j in range(k):
            if first[k] == k and (rotors[k, j] != 0.0 or damping[k, j] != 0.0):
                first[k] = j
    for i in range(codes.size // CODES):
        j = i
        while j >= 0:
            k = i
            r = j
            if moved_by.size > 0:
                k = moved_by[i]
                r = moved_by[j]
            first[max(k, r)] = min(first[max(k, r)], k, r)
            j = codes[CODES * j + PARENT]


@part
def _write_rigid_bodies(
    codes, numbers, moved_by, shares, offset, q, v, zero, tree, masses, M, bias
):
    """Write mass matrix and torque without acceleration; return whether they are finite.

    Joint i of the tree is at `shares[i] q[moved_by[i]] + offset[i]`; no shares: each has a drive.
    `tree` (4, n_links) and `masses` (n_links, n_links) are work space.
    """
    M[:] = 0.0
    own = shares.size == 0
    if not own:
        masses[:], bias[:] = 0.0, 0.0
    for i in range(shares.size):
        k = moved_by[i]
        tree[0, i], tree[1, i], tree[2, i] = shares[i] * q[k] + offset[i], shares[i] * v[k], 0.0
    # one call each, which is inlined and compiled once
    x, dx, ddx = (q, v, zero) if own else (tree[0], tree[1], tree[2])
    good = mass_matrix(codes, numbers, x, M if own else masses) and torque(
        codes, numbers, x, dx, ddx, bias if own else tree[3]
    )
    for i in range(shares.size):
        bias[moved_by[i]] += shares[i] * tree[3, i]
        for j in range(shares.size):
            M[moved_by[i], moved_by[j]] += shares[i] * masses[i, j] * shares[j]
    return good


@part
def _split_drive(program, links, numbers, q, v, load, away, zero, stack, even, odd):
    """Write the parts of the drive torques that do not and do change sign with the velocity."""
    n = q.size
    even[:], odd[:] = 0.0, 0.0
    if program.size == CODES * links:
        return
    constants = PER_LINK * links + 3
    for k in range(n):
        away[k] = max(abs(v[k]), SLOWEST)
    run(program, CODES * links, numbers, constants, q, away, zero, load, stack, even)
    for k in range(n):
        away[k] = -away[k]
    run(program, CODES * links, numbers, constants, q, away, zero, load, stack, odd)
    for k in range(n):
        ahead = even[k]
        back = odd[k]
        even[k], odd[k] = 0.5 * (ahead + back), 0.5 * (ahead - back)


@part
def _apply_dry_friction(L, first, h, odd, friction, v, W, column, n):
    """Change free velocities v to those under dry friction, whose impulses are kept.

    The impulses before are tried first: they are right for a robot whose joints all slide on.
    """
    largest = 0.0
    for j in range(n):
        bound = h * max(odd[j], 0.0)
        friction[j] = min(max(friction[j], -bound), bound)
        largest = max(largest, bound)
        column[j] = friction[j]
    if largest == 0.0:
        return
    solve_cholesky(L, first, column, n)
    sliding = True
    for j in range(n):
        v[j] -= column[j]
        bound = h * max(odd[j], 0.0)
        sliding = sliding and abs(friction[j]) == bound and friction[j] * v[j] >= 0.0
    if sliding:
        return
    for j in range(n):
        W[j, j] = 0.0
    # Most rounds of the friction solver.
    for _ in range(60):
        change = 0.0
        for j in range(n):
            bound = h * max(odd[j], 0.0)
            if bound == 0.0 or (abs(friction[j]) == bound and friction[j] * v[j] >= 0.0):
                continue
            if W[j, j] == 0.0:
                W[j] = 0.0
                W[j, j] = 1.0
                solve_cholesky(L, first, W[j], n)
            new = min(max(friction[j] + v[j] / W[j, j], -bound), bound)
            moved = new - friction[j]
            if moved != 0.0:
                friction[j] = new
                change = max(change, abs(moved))
                for i in range(n):
                    v[i] -= W[j, i] * moved
        # Change of the friction impulses, relative to the largest, at which it stops.
        if change <= 1e-12 * largest:
            break


@kernel("i1 i1 F1 i1 f1 f1 f2 f2 f1 f1 f1 f1 f1 b f3 f F3 F3 F3 F3")
def simulate(
    codes,
    program,
    numbers,
    moved_by,
    shares,
    offset,
    rotors,
    damping,
    kp,
    kd,
    limit,
    dead,
    falling,
    by_command,
    inputs,
    h,
    q,
    v,
    a,
    state,
):
    """Simulate windows; `q[w, 0]` and `v[w, 0]` are their initial states.

    `inputs` (W, S, n), `q` and `v` (W, S + 1, n), `a` (W, S, n); `state` (W, S, n) becomes 1 and
    -1 for joints that dry friction brakes, 0 for those that it holds, .5 and -.5 for those without;
    4 is added for those at the torque limit of the servo. `moved_by`, `shares` and `offset`
    (n_links,) are as in `_write_rigid_bodies`. `rotors` and `damping` are (n, n). `dead` and
    `falling` (n,) are the deadband and how much the limit falls per speed.
    """
    n = kp.size
    windows = inputs.shape[0]
    steps = inputs.shape[1]
    links = codes.size // CODES
    tree = np.empty((4, links))
    masses = np.empty((links, links))
    bias = np.empty(n)
    even = np.empty(n)
    odd = np.empty(n)
    zero = np.zeros(n)
    away = np.empty(n)
    friction = np.empty(n)
    stack = np.empty(STACK)
    M = np.empty((n, n))
    W = np.empty((n, n))
    column = np.empty(n)
    tau = np.empty(n)
    position = np.empty(n)
    rate = np.empty(n)
    free = np.empty(n)
    full = np.empty(n, dtype=np.bool_)
    first = np.empty(n, dtype=np.int64)
    _write_row_starts(codes, moved_by, rotors, damping, first)
    for w in range(windows):
        friction[:] = 0.0
        alive = True
        for s in range(steps):
            if not alive:
                q[w, s + 1], v[w, s + 1], a[w, s], state[w, s] = np.nan, np.nan, 0.0, 1.0
                continue
            for k in range(n):
                position[k], rate[k] = q[w, s, k], v[w, s, k]
            alive = _write_rigid_bodies(
                codes,
                numbers,
                moved_by,
                shares,
                offset,
                position,
                rate,
                zero,
                tree,
                masses,
                M,
                bias,
            )
            _split_drive(
                program, links, numbers, position, rate, bias, away, zero, stack, even, odd
            )
            for k in range(n):
                full[k] = False
                tau[k] = inputs[w, s, k]
                if by_command:
                    error = inputs[w, s, k] - position[k]
                    error -= min(max(error, -dead[k]), dead[k])
                    fall = falling[k] * rate[k]
                    tau[k] = kp[k] * error - kd[k] * rate[k]
                    if tau[k] > limit[k] - fall:
                        full[k] = True
                        tau[k] = limit[k] - fall
                    elif tau[k] < -limit[k] - fall:
                        full[k] = True
                        tau[k] = -limit[k] - fall
                free[k] = tau[k] - bias[k] - even[k]
            for k in range(n):
                for j in range(n):
                    free[k] -= damping[k, j] * rate[j]
                    M[k, j] += rotors[k, j] + h * damping[k, j]
                if by_command and not full[k]:
                    M[k, k] += h * kd[k]
            alive = alive and factor_cholesky(M, first, n)
            if alive:
                solve_cholesky(M, first, free, n)
                for k in range(n):
                    free[k] = rate[k] + h * free[k]
                _apply_dry_friction(M, first, h, odd, friction, free, W, column, n)
            for k in range(n):
                # Velocity from which a simulation counts as diverged.
                alive = alive and abs(free[k]) < 1e4
            for k in range(n):
                held = odd[k] > 0.0 and abs(friction[k]) < h * odd[k]
                if held:
                    free[k] = 0.0
                v[w, s + 1, k] = free[k] if alive else np.nan
                q[w, s + 1, k] = position[k] + h * free[k] if alive else np.nan
                a[w, s, k] = (free[k] - rate[k]) / h if alive else 0.0
                sign = 0.0 if held else 1.0 if friction[k] > 0.0 else -1.0
                if odd[k] <= 0.0:
                    sign = 0.5 if free[k] > 0.0 else -0.5
                state[w, s, k] = sign + (4.0 if full[k] else 0.0)


@part
def _sign(state):
    """Return the direction in which a joint moves, zero at rest."""
    return state - 4.0 if state > 2.0 else state


@part
def _evaluate_kept_share(state, accelerations, s, k):
    """Return the share of a change of velocity that joint k keeps in step s; -1 where it moves on.

    None is left at rest. A joint that reverses under dry friction, accelerated by a before and a'
    after, does so `-dv / a` later if it is faster by dv, which thereby becomes `a' / a dv` (the
    saltation of Aizerman and Gantmakher, 1958). In steps of time it is dv or nothing, as the
    reversal happens to fall: derivatives of the steps themselves hold for tiny changes alone.
    """
    here = _sign(state[s, k])
    if s == 0 or (here == 0.0 and s + 1 == state.shape[0]):
        return 0.0 if here == 0.0 else -1.0
    before = s - 1
    after = s if here != 0.0 else s + 1
    if _sign(state[before, k]) * _sign(state[after, k]) != -1.0:
        return 0.0 if here == 0.0 else -1.0
    return min(max(accelerations[after, k] / accelerations[before, k], 0.0), 1.0)


@kernel("i1 f4 f4 f4 f2 f2 f3 f3 f3 f3 f4 f i F4")
def sensitivities(
    joints,
    by_position,
    by_velocity,
    masses,
    rotors,
    damping,
    stiffness,
    slope,
    state,
    accelerations,
    columns,
    h,
    every,
    out,
):
    """Write how the positions of a branch at the samples depend on its parameters and its start.

    Parameters
    ----------
    joints
        Joints of the branch (m,), which no other joints move.
    by_position, by_velocity, masses
        Derivatives of the torques by state and acceleration, drives and servo left out, shapes
        (W, S, n, n).
    stiffness, slope
        Derivatives of the servo's torque by position and velocity, with opposite signs, shapes
        (W, S, n).
    state
        Of `simulate`.
    columns
        Torques of unit parameters (W, S, m, p), servo parameters with the opposite sign.
    h, every
        Step, and steps per sample.
    out
        Shape (W, S // every, m, p + 2 m): by the parameters, then by position and velocity of
        each joint at the start.
    """
    m = joints.size
    known = columns.shape[3]
    p = known + 2 * m
    windows = columns.shape[0]
    steps = columns.shape[1]
    A = np.empty((m, m))
    place = np.empty(m, dtype=np.int64)
    dense = np.zeros(m, dtype=np.int64)
    kept = np.empty(m)
    dq = np.empty((m, p))
    dv = np.empty((m, p))
    right = np.empty((m, p))
    for w in range(windows):
        dq[:], dv[:] = 0.0, 0.0
        for i in range(m):
            dq[i, known + i], dv[i, known + m + i] = 1.0, 1.0
        for s in range(steps):
            moving = np.int64(0)
            for i in range(m):
                kept[i] = _evaluate_kept_share(state[w], accelerations[w], s, joints[i])
                if kept[i] < 0.0:
                    place[moving] = i
                    moving += 1
            for x in range(moving):
                i = place[x]
                k = joints[i]
                bounded = state[w, s, k] > 2.0
                for c in range(known):
                    right[x, c] = -columns[w, s, i, c]
                right[x, known:] = 0.0
                for j in range(m):
                    r = joints[j]
                    G = by_position[w, s, k, r]
                    C = by_velocity[w, s, k, r] + damping[k, r]
                    if i == j:
                        G = G + stiffness[w, s, k]
                        C = C + slope[w, s, k]
                    for c in range(p):
                        right[x, c] -= G * dq[j, c] + C * dv[j, c]
                for y in range(moving):
                    r = joints[place[y]]
                    A[x, y] = masses[w, s, k, r] + rotors[k, r] + h * damping[k, r]
                if not bounded:
                    A[x, x] += h * slope[w, s, k]
            # a joint that comes to rest loses its change of velocity to friction
            for i in range(m):
                k = joints[i]
                if kept[i] >= 0.0:
                    for x in range(moving):
                        r = joints[place[x]]
                        pull = (masses[w, s, r, k] + rotors[r, k] + h * damping[r, k]) / h
                        pull *= 1.0 - kept[i]
                        for c in range(p):
                            right[x, c] += pull * dv[i, c]
                    for c in range(p):
                        dv[i, c] *= kept[i]
            if factor_cholesky(A, dense, moving):
                for x in range(moving):
                    for k in range(x):
                        for c in range(p):
                            right[x, c] -= A[x, k] * right[k, c]
                    for c in range(p):
                        right[x, c] *= A[x, x]
                for x in range(moving - 1, -1, -1):
                    for k in range(x + 1, moving):
                        for c in range(p):
                            right[x, c] -= A[k, x] * right[k, c]
                    for c in range(p):
                        right[x, c] *= A[x, x]
                for x in range(moving):
                    for c in range(p):
                        dv[place[x], c] += h * right[x, c]
            for i in range(m):
                for c in range(p):
                    dq[i, c] += h * dv[i, c]
            if (s + 1) % every == 0:
                for i in range(m):
                    for c in range(p):
                        out[w, (s + 1) // every - 1, i, c] = dq[i, c]
