"""Array types; every array is `(n_samples, n_joints)` unless stated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]
