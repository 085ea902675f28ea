# SPDX-License-Identifier: Apache-2.0
"""Covariance of the coefficients, against one that is solved where nothing is undetermined."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import null_space

from selfcal_ros.estimation.terms.equations import TermEquations

SIGMA = 2e-8


class Made(TermEquations):
    """Equations whose information, norm and columns are given."""

    def limit(self, rows):
        return 1e-9


def equations(columns, size, whole, *, taken=()):
    """Return equations of real columns (readings, p), free where `size` (p,) is infinite.

    `whole` (p,) is how much larger columns were before misalignments took up part of them. Of
    those `taken` nothing but rounding is left.
    """
    left = columns.copy()
    left[:, taken] *= 1e-16
    own = Made(None, SimpleNamespace(columns=size, size=size), None, 0.0, 0.0)
    own.__dict__.update(
        information=left.T @ left,
        unbiased=left.T @ left,
        norm=whole * np.sqrt((columns**2).sum(axis=0)),
    )
    return own


def columns_of(rng, free, sized, hidden):
    """Return random columns in units far apart, the first `free` less what hides combinations."""
    columns = rng.normal(size=(free + sized + 6, free + sized))
    columns *= rng.uniform(0.05, 1.0, free + sized)
    if hidden:
        out = np.linalg.qr(rng.normal(size=(free, hidden)))[0]
        columns[:, :free] -= columns[:, :free] @ out @ out.T
    return columns * 10.0 ** rng.uniform(-3, 3, free + sized)


@pytest.mark.parametrize("taken", [0, 1])
@pytest.mark.parametrize(
    ("free", "sized", "hidden"),
    [(4, 0, 0), (4, 0, 1), (5, 0, 2), (3, 2, 0), (3, 2, 1), (2, 3, 0)],
)
def test_untold_combinations_have_no_covariance_and_the_others_their_own(
    free, sized, hidden, taken
):
    rng = np.random.default_rng([free, sized, hidden])
    for _ in range(20):
        columns = columns_of(rng, free, sized, hidden)
        size = np.r_[np.full(free, np.inf), 10.0 ** rng.uniform(-9, -6, sized)]
        own = equations(
            columns, size, rng.uniform(1, 9, free + sized), taken=[0] if taken else []
        )
        undetermined = own.undetermined(np.isinf(size))
        assert undetermined.shape[1] == max(hidden, taken)
        # coefficients x of which no undetermined combination has a part, sizes as readings of them
        basis = null_space(undetermined.T) if hidden + taken else np.eye(len(size))
        basis /= own.norm[:, None]
        prior = np.diag(np.where(np.isinf(size), 0.0, (SIGMA / size) ** 2))
        inner = basis.T @ (own.information + prior) @ basis
        unit = np.sqrt(np.diag(inner))
        wanted = (
            basis
            @ (np.linalg.inv(inner / np.outer(unit, unit)) / np.outer(unit, unit))
            @ basis.T
        )
        found = own.inverse(SIGMA)
        # in units of each one's uncertainty; where that is nothing but rounding, of its column
        spread = np.sqrt(np.diag(wanted))
        spread = np.where(spread * own.norm < 1e-9, 1 / own.norm, spread)
        assert np.allclose(
            found / np.outer(spread, spread),
            wanted / np.outer(spread, spread),
            rtol=0,
            atol=1e-6,
        )
