# SPDX-License-Identifier: Apache-2.0
"""Which terms are named when free terms hide modes of the stage."""

from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.estimation.terms.equations import unseen_by_term

INF = float("inf")


def equations(sizes, hidden):
    """Return terms of these sizes; `hidden`: set of free terms -> modes that they hide."""
    names = list(sizes)
    free = np.array([size == INF for size in sizes.values()])
    return SimpleNamespace(
        columns=SimpleNamespace(
            columns=[
                SimpleNamespace(term=name, size=size) for name, size in sizes.items()
            ]
        ),
        free=free,
        rows=lambda wanted: np.isin(names, [str(name) for name in wanted]),
        unseen=lambda rows: np.zeros(
            (len(names), hidden.get(frozenset(np.array(names)[rows].tolist()), 0))
        ),
    )


@pytest.mark.parametrize(
    ("hidden", "named"),
    [
        ({}, {}),
        ({("drift",): 2, ("drift", "plate_scale"): 2}, {"drift": 2}),
        (
            {("drift",): 2, ("plate_scale",): 1, ("drift", "plate_scale"): 4},
            {"drift": 2, "plate_scale": 1},
        ),
        ({("drift", "plate_scale"): 3}, {"drift": 3, "plate_scale": 3}),
    ],
)
def test_terms_are_named_that_hide_modes_alone_or_else_all_that_do_together(
    hidden, named
):
    """A microscope with a size is no free term: it is never named."""
    found = unseen_by_term(
        equations(
            {"microscope": 1e-3, "drift": INF, "plate_scale": INF},
            {frozenset(names): modes for names, modes in hidden.items()},
        )
    )
    assert found == named
