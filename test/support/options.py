# SPDX-License-Identifier: Apache-2.0
"""Options of the estimator without anything assumed: for tests of its mathematics."""

from typing import Any

from selfcal_ros.estimation.options import Options


def bare(**how: Any) -> Options:
    """Return options that assume no term: the model is that of the readings and of `terms`."""
    return Options(assumed=(), **how)


BARE = bare()
