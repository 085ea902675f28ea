# SPDX-License-Identifier: Apache-2.0
"""Hypothesis strategies for calibration tables with random keywords."""

import numpy as np
from hypothesis import strategies as st

from selfcal_ros.compensation.aerotech.model import Table1D, Table2D, Unit, UnitWord

AXES = (1, 2, 3)


def maybe(strategy):
    return st.none() | strategy


def decimals(low, high, digits=3):
    scale = 10 ** digits
    return st.integers(int(low * scale), int(high * scale)).map(lambda n: n / scale)


units = st.builds(Unit, st.sampled_from(list(UnitWord)),
                  st.sampled_from([1.0, 1000.0, 3600.0, 7.0]))
distances = decimals(0.1, 40).flatmap(lambda d: st.sampled_from([d, -d]))
offsets = decimals(-300, 300)
rollovers = decimals(50, 4000)
serials = st.text("abcXYZ0123 ;'-", max_size=8)


def values(*shape):
    return st.integers(0, 2 ** 32 - 1).map(
        lambda seed: np.round(np.random.default_rng(seed).normal(0, 5, shape), 4))


@st.composite
def tables_1d(draw):
    return Table1D(
        draw(st.sampled_from(AXES)), draw(distances), draw(values(draw(st.integers(1, 12)))),
        draw(maybe(st.sampled_from(AXES))), draw(maybe(units)), draw(maybe(units)),
        draw(maybe(offsets)), draw(maybe(decimals(-1e-4, 1e-4, 7))), draw(maybe(decimals(0, 40))),
        draw(st.booleans()), draw(st.booleans()), draw(maybe(rollovers)),
        draw(maybe(st.sampled_from(["CW", "CCW"]))), draw(maybe(decimals(-20, 20))),
        draw(maybe(decimals(-2000, 2000))), draw(maybe(decimals(1, 200))), draw(maybe(serials)))


@st.composite
def tables_2d(draw):
    shape = draw(st.integers(1, 6)), draw(st.integers(1, 6)), draw(st.integers(2, 3))
    row, column = draw(st.permutations(AXES))[:2]
    feedback = decimals(-2000, 2000)
    return Table2D(
        row, column, tuple(draw(st.permutations(AXES))[:shape[2]]), draw(distances),
        draw(distances), draw(values(*shape)), draw(maybe(units)), draw(maybe(units)),
        draw(maybe(offsets)), draw(maybe(offsets)), draw(maybe(feedback)), draw(maybe(feedback)),
        draw(st.booleans()), draw(maybe(rollovers)), draw(maybe(rollovers)), draw(maybe(serials)))


@st.composite
def tables_galvo(draw):
    shape = (draw(st.sampled_from([1, 3, 5])), draw(st.sampled_from([1, 3, 5])),
             draw(st.integers(2, 3)))
    outputs = (1, 2, 3)[:shape[2]]
    return Table2D(2, 1, outputs, abs(draw(distances)), abs(draw(distances)), draw(values(*shape)),
                   draw(maybe(units)), draw(maybe(units)), negcor=draw(st.booleans()), galvo=True)


@st.composite
def setups(draw):
    """Axis -> dict of what its controller knows; all units can be converted."""
    out = {}
    for axis in AXES:
        out[axis] = {"counts": draw(decimals(1, 50)), "secondary": draw(decimals(0.5, 80))}
        for name, strategy in (("direction", st.sampled_from(["CW", "CCW"])),
                               ("offset", decimals(-20, 20)), ("feedback", decimals(-2000, 2000))):
            chosen = draw(maybe(strategy))
            if chosen is not None:
                out[axis][name] = chosen
    return out
