# SPDX-License-Identifier: Apache-2.0
"""Hypothesis strategies for calibration tables with random keywords."""

from functools import cache

import numpy as np
from hypothesis import strategies as st

from selfcal_ros.applications.aerotech.model import Table1D, Table2D, Unit, UnitWord

AXES = (1, 2, 3)


@cache
def maybe(strategy):
    return st.none() | strategy


def decimals(low, high, digits=3):
    scale = 10**digits
    return st.integers(int(low * scale), int(high * scale)).map(lambda n: n / scale)


units = st.builds(
    Unit, st.sampled_from(list(UnitWord)), st.sampled_from([1.0, 1000.0, 3600.0, 7.0])
)
distances = decimals(0.1, 40).flatmap(lambda d: st.sampled_from([d, -d]))
offsets = decimals(-300, 300)
rollovers = decimals(50, 4000)
serials = st.text("abcXYZ0123 ;'-", max_size=8)
# strategies are made once: one that is made for each draw is looked through each time
axis = st.sampled_from(AXES)
orders = st.permutations(AXES)
ways = st.sampled_from(["CW", "CCW"])
feedbacks = decimals(-2000, 2000)
expansions, references = decimals(-1e-4, 1e-4, 7), decimals(0, 40)
turns, lengths = decimals(-20, 20), decimals(1, 200)
counts, secondary = decimals(1, 50), decimals(0.5, 80)
up_to_12, up_to_6, two_or_three = (
    st.integers(1, 12),
    st.integers(1, 6),
    st.integers(2, 3),
)
odd = st.sampled_from([1, 3, 5])
booleans = st.booleans()


@cache
def values(*shape):
    return st.integers(0, 2**32 - 1).map(
        lambda seed: np.round(np.random.default_rng(seed).normal(0, 5, shape), 4)
    )


@st.composite
def tables_1d(draw):
    return Table1D(
        draw(axis),
        draw(distances),
        draw(values(draw(up_to_12))),
        draw(maybe(axis)),
        draw(maybe(units)),
        draw(maybe(units)),
        draw(maybe(offsets)),
        draw(maybe(expansions)),
        draw(maybe(references)),
        draw(booleans),
        draw(booleans),
        draw(maybe(rollovers)),
        draw(maybe(ways)),
        draw(maybe(turns)),
        draw(maybe(feedbacks)),
        draw(maybe(lengths)),
        draw(maybe(serials)),
    )


@st.composite
def tables_2d(draw):
    shape = draw(up_to_6), draw(up_to_6), draw(two_or_three)
    row, column = draw(orders)[:2]
    return Table2D(
        row,
        column,
        tuple(draw(orders)[: shape[2]]),
        draw(distances),
        draw(distances),
        draw(values(*shape)),
        draw(maybe(units)),
        draw(maybe(units)),
        draw(maybe(offsets)),
        draw(maybe(offsets)),
        draw(maybe(feedbacks)),
        draw(maybe(feedbacks)),
        draw(booleans),
        draw(maybe(rollovers)),
        draw(maybe(rollovers)),
        draw(maybe(serials)),
    )


@st.composite
def tables_galvo(draw):
    shape = draw(odd), draw(odd), draw(two_or_three)
    outputs = (1, 2, 3)[: shape[2]]
    return Table2D(
        2,
        1,
        outputs,
        abs(draw(distances)),
        abs(draw(distances)),
        draw(values(*shape)),
        draw(maybe(units)),
        draw(maybe(units)),
        negcor=draw(booleans),
        galvo=True,
    )


@st.composite
def setups(draw):
    """Axis -> dict of what its controller knows; all units can be converted."""
    out = {}
    for number in AXES:
        out[number] = {"counts": draw(counts), "secondary": draw(secondary)}
        for name, strategy in (
            ("direction", ways),
            ("offset", turns),
            ("feedback", feedbacks),
        ):
            chosen = draw(maybe(strategy))
            if chosen is not None:
                out[number][name] = chosen
    return out
