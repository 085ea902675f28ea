# SPDX-License-Identifier: Apache-2.0
"""What columns leave of means and of visits about them, against one dense least squares."""

from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.estimation.terms.equations import Score, Sums, residual_sums


@pytest.mark.parametrize("p", [1, 3])
def test_what_columns_leave_is_what_a_dense_least_squares_leaves(p):
    rng = np.random.default_rng(p)
    means, within = rng.normal(size=(7, p)), 2 * rng.normal(size=(11, p))
    e, f = rng.normal(size=7), rng.normal(size=11)
    gram, own = means.T @ means, within.T @ within
    equations = SimpleNamespace(
        free_inverse=np.linalg.inv(gram + own),
        projected=SimpleNamespace(gram=gram),
        columns=SimpleNamespace(within=SimpleNamespace(gram=own)),
    )
    score = Score(means.T @ e, within.T @ f, Sums(float(e @ e), 7, float(f @ f), 11))
    found = residual_sums(equations, score)
    both = np.vstack([means, within])
    values = np.linalg.lstsq(both, np.concatenate([e, f]), rcond=None)[0]
    hat = np.diag(both @ np.linalg.pinv(both))
    assert found.between == pytest.approx(((e - means @ values) ** 2).sum())
    assert found.within == pytest.approx(((f - within @ values) ** 2).sum())
    assert (found.dof_between, found.dof_within) == pytest.approx(
        (7 - hat[:7].sum(), 11 - hat[7:].sum())
    )
