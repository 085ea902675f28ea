# SPDX-License-Identifier: Apache-2.0
"""Rotation: the plate turns between the marks and the lines of a view; Vtheta has r."""

from collections.abc import Iterator

import numpy as np

from selfcal_ros.blocks import Block, Estimates, Located, Pattern, Where, differences
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm


def patterns(inputs: TermInputs, term: ModelTerm) -> Iterator[Pattern]:
    """Yield the turn of each view of marks and lines; free ones are relative to the first."""
    for view in inputs.with_lines[int(term.free) :]:
        values = np.zeros((len(inputs.line_names), inputs.n_lines))
        values[view] = 1.0
        yield Pattern((("turn", 1),), view=view, lines=values)


def located(estimates: Estimates, names: tuple[str, ...]) -> Located:
    """Yield the view that differs most from all others: a common rotation belongs to the datum."""
    _, of_u = differences(estimates.values, estimates.covariance)
    n = len(of_u)
    # a single one is that of the second view against the first
    distinctness = np.where(np.eye(n) > 0, np.inf, of_u).min(axis=1)
    at = int(distinctness.argmax())
    unit = np.eye(n)[at]
    weights = unit - (1 - unit) / max(n - 1, 1)
    # u is that of the difference from the nearest
    nearest = abs(float(estimates.values @ weights)) / max(distinctness[at], 1e-300)
    yield Where(view=names[estimates.columns[at].view], least_u=nearest), weights


BLOCK = Block(
    "rotation",
    "rad",
    patterns,
    undetected=1e-10,
    sizes=(1e-7,),  # 5 nm at a radius of 50 mm
    of_lines=True,
    between=True,
    located=located,
    cure="read lines in more views with marks",
)
