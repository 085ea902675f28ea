# SPDX-License-Identifier: Apache-2.0
"""Options of the estimator without anything assumed: for tests of its mathematics."""

from typing import Any

from selfcal_ros.estimation.options import Options
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.terms import ModelTerm


def bare(**how: Any) -> Options:
    """Return options that assume no term: the model is that of the readings and of `terms`."""
    return Options(assumed=(), **how)


BARE = bare()

STILL = (ModelTerm("drift", 0.0), ModelTerm("approach", 0.0))
"""Declarations that a stage neither drifts nor errs by the direction of approach."""


MARKS = ((-1, 0), (1, 1))
"""Marks of a reference length between two of them."""


def reference_length(kind, error=0.0, u=0.0):
    """Return a reference length of any kind; that of marks between `MARKS`."""
    return ReferenceLength(kind, error, u, marks=MARKS if kind == "marks" else None)
