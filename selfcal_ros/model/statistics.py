# SPDX-License-Identifier: Apache-2.0
"""Statistics of arrays in which NaN stands for what is not known."""

import numpy as np

MANY_DOF = 1e9
"""Degrees of freedom that stand for infinitely many, where the tail of F or t takes no infinity."""


def rms(values: np.ndarray) -> float:
    """Return the root mean square of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")
