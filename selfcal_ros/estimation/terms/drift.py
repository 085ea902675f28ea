# SPDX-License-Identifier: Apache-2.0
"""Drift: the plate moves relative to the stage during a view, a polynomial of time.

V has sum_l d_l P_l(tau), tau the view's time in [-1, 1]: 2 coefficients a degree and view.
"""

from collections.abc import Iterator

import numpy as np
from numpy.polynomial.legendre import legval

from selfcal_ros.blocks import AXES, Block, Estimates, Located, Pattern, Where
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm

TIMES = np.linspace(-1, 1, 101)
"""Instants of a view at which the range of a drift is evaluated."""


def polynomial(order: int, time: np.ndarray) -> np.ndarray:
    """Return the Legendre polynomial of an order."""
    return legval(time, np.eye(order + 1)[order])


def patterns(inputs: TermInputs, _: ModelTerm) -> Iterator[Pattern]:
    """Yield the polynomials of each placing, along x and along y."""
    orders = range(1, inputs.drift_degree + 1)
    for first, members in inputs.members.items():
        polynomials = inputs.at_visits(
            lambda visits: np.stack(
                [polynomial(order, visits.time) for order in orders]
            ),
            members,
        )
        for order, (marks, visits) in zip(orders, polynomials, strict=False):
            yield Pattern(
                tuple((f"{axis} P{order}", unit) for axis, unit in AXES),
                marks,
                visits,
                view=first,
            )


def located(estimates: Estimates, names: tuple[str, ...]) -> Located:
    """Yield the range of the path of each view along each axis."""
    for view in sorted({column.view for column in estimates.columns}):
        for axis in "xy":
            shape = np.array(
                [
                    polynomial(int(c.component[3:]), TIMES)
                    if c.view == view and c.component[0] == axis
                    else 0 * TIMES
                    for c in estimates.columns
                ]
            )
            path = estimates.values @ shape
            spread = shape[:, int(path.argmax())] - shape[:, int(path.argmin())]
            yield Where(view=names[view], axis=axis), spread


BLOCK = Block(
    "drift",
    "m",
    patterns,
    undetected=1e-12,
    nominal=25e-9,
    needs_visits=True,
    of_time=True,
    alone=lambda component: component.endswith("P1"),
    located=located,
    change="order",
    cure="visit the marks in more than one order, e.g. visit_order: x_back_y_back",
)
