"""Least squares where the regressor is in error too, not only the torque."""

from __future__ import annotations

import numpy as np

from asbuilt.dynamics import use_one_blas_thread
from asbuilt.errors import IdentifiabilityError
from asbuilt.findings import Cure
from asbuilt.identification import (
    JOINT_WEIGHTS,
    Estimate,
    EstimationData,
    estimate_wls,
    estimator,
    rank_tolerance,
    triangular_factor,
)

EXACT_TERMS = ("Fo",)
"""Symbols of drive terms whose columns are constant, hence without error."""


@estimator(
    "total",
    "total least squares",
    "errors in positions and their derivatives too",
    held_fixed=(JOINT_WEIGHTS, "the share of errors in the motion"),
)
@use_one_blas_thread()
def estimate_total(data: EstimationData) -> Estimate:
    """Minimise `|[E D^-1 | e / |tau|]|_F` subject to `(W + E) beta = tau - e`.

    Rows are weighted joint by joint, and D holds the column lengths: errors of a column are as
    large relative to it as errors of the torque are. Columns of offsets are exact and solved first;
    the smallest singular value s gives the rest, `(W^T W - s^2 D^2) beta = W^T tau`. Undetermined
    directions keep the prior. Standard errors are first order.

    Source: Golub & Van Loan, SIAM J. Numer. Anal. 17, 1980; exact columns: Van Huffel &
    Vandewalle, The Total Least Squares Problem, 1991, section 3.5.

    Raises
    ------
    IdentifiabilityError
        If torque errors are as large as the contribution of the weakest combination of columns.
    """
    information = data.information
    base = data.base
    start = estimate_wls(data)
    factor = information.stacked(start.weights)
    scale = np.linalg.norm(factor[:, :-1], axis=0)
    scale[scale == 0.0] = 1.0
    exact = np.array([name.rstrip("0123456789") in EXACT_TERMS for name in base.names])
    order = np.concatenate([np.flatnonzero(exact), np.flatnonzero(~exact)])
    first = int(exact.sum())
    size = float(np.linalg.norm(factor[:, -1])) or 1.0
    toward = data.prior_values[order] * scale[order] / size
    r = triangular_factor(np.column_stack([factor[:, order] / scale[order], factor[:, -1] / size]))
    u, s, vt = np.linalg.svd(r[first:-1, first:-1])
    kept = s > rank_tolerance(information.n_rows, base.n_base) * max(s.max(initial=0.0), 1.0)
    left_open = vt[~kept].T
    u = u[:, kept]
    s = s[kept]
    v = vt[kept].T
    z = u.T @ r[first:-1, -1]
    left = np.hypot(np.linalg.norm(r[first:-1, -1] - u @ z), r[-1, -1])
    both = np.vstack([np.column_stack([np.diag(s), z]), np.append(np.zeros(len(s)), left)])
    smallest = float(np.linalg.svd(both, compute_uv=False)[-1])
    # Ratio of the smallest singular values with and without torque above which no solution is
    # given. At 1 the problem has no solution (Golub & Van Loan, 1980).
    if len(s) and smallest > 0.9 * s[-1]:
        raise IdentifiabilityError(
            f"total least squares has no reliable solution: errors of {smallest:.3g} of the"
            " torque are as large as the contribution of the weakest combination of parameters"
            f" of {base.robot} ({s[-1]:.3g})",
            cure=Cure("use wls, or a motion with more excitation", settings={"method": "wls"}),
        )
    y = toward.copy()
    y[first:] = v @ (s * z / (s**2 - smallest**2)) + left_open @ (left_open.T @ toward[first:])
    known = r[:first, -1] - r[:first, first:-1] @ y[first:] - r[:first, :first] @ toward[:first]
    y[:first] += np.linalg.lstsq(r[:first, :first], known, rcond=None)[0]
    beta = np.zeros(base.n_base)
    beta[order] = size * y / scale[order]
    root = start.solution.inverse_root
    noisy = root[~exact] * (smallest * scale[~exact])[:, None]
    values, axes = np.linalg.eigh(np.eye(root.shape[1]) - noisy.T @ noisy)
    root = root @ (axes / np.sqrt(np.maximum(values, 1e-6)))
    note = (
        f"Relative errors of regressor columns and torque are assumed equal: {smallest:.2g}."
        " Standard errors are first order."
    )
    return start.renewed(
        "total", information, start.solution, beta=beta, inverse_root=root, notes=(note,)
    )
