# SPDX-License-Identifier: Apache-2.0
"""Statistics of arrays in which NaN means unknown."""

import numpy as np

MANY_DOF = 1e9
"""Finite substitute for infinite degrees of freedom in the tails of F and t."""


def rms(values: np.ndarray) -> float:
    """Return the root mean square of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")
