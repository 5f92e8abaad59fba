"""Log-Cholesky parameters of a link: any ten numbers give a consistent one."""

import numpy as np
import pinocchio as pin

from asbuilt.description import LinkInertia


def from_log_cholesky(theta) -> LinkInertia:
    """The link of `alpha d1 d2 d3 s12 s23 s13 t1 t2 t3`, by Pinocchio."""
    parameters = pin.LogCholeskyParameters(np.array(theta, dtype=float)).toDynamicParameters()
    return LinkInertia.from_pinocchio_order(parameters)


def log_cholesky(link: LinkInertia) -> np.ndarray:
    """The inverse (Rucker and Wensing, 2022, eq. 10)."""
    U = np.linalg.cholesky(link.pseudo_inertia[::-1, ::-1])[::-1, ::-1]
    S = U / U[3, 3]
    places = ([0, 1, 0, 0, 1, 2], [1, 2, 2, 3, 3, 3])
    return np.concatenate([[np.log(U[3, 3])], np.log(np.diag(S)[:3]), S[places]])
