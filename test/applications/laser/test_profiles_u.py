# SPDX-License-Identifier: Apache-2.0
"""Uncertainties of profiles, straightness and squareness against numeric derivatives."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.laser.data import Closure, StepDiagonalResult
from selfcal_ros.applications.laser.profiles import (
    ReferenceLine,
    profile_m,
    squareness,
    straightness,
    u_profile_m,
    u_slope,
)
from selfcal_ros.applications.laser.report import geometry

N, STEPS = 5, (0.01, 0.015)


@pytest.fixture
def found():
    """Return a result whose errors are correlated throughout, and unequal axes."""
    rng = np.random.default_rng(6)
    errors = rng.normal(0, 1e-6, (2, N, 2))
    root = rng.normal(0, 1e-9, (4 * N, 4 * N))
    return StepDiagonalResult(
        STEPS, errors, root @ root.T, "new", "exact", {}, Closure()
    )


def u_of(function, found):
    """Return the standard uncertainty of function(found) by central differences."""
    gradient = []
    for index in range(found.errors_m.size):
        shift = np.zeros(found.errors_m.size)
        shift[index] = 1e-9
        up, down = (
            function(
                replace(
                    found,
                    errors_m=found.errors_m
                    + sign * shift.reshape(found.errors_m.shape),
                )
            )
            for sign in (1, -1)
        )
        gradient.append((up - down) / 2e-9)
    return np.sqrt(np.array(gradient) @ found.covariance @ gradient)


@pytest.mark.parametrize("line", ReferenceLine)
@pytest.mark.parametrize(("axis", "direction"), [(0, 1), (1, 0)])
def test_straightness(found, axis, direction, line):
    wanted = u_of(lambda f: straightness(f, axis, direction, line).value, found)
    assert straightness(found, axis, direction, line).u == pytest.approx(
        wanted, rel=1e-6
    )


@pytest.mark.parametrize("line", ReferenceLine)
def test_squareness(found, line):
    wanted = u_of(lambda f: squareness(f, line=line).value, found)
    assert squareness(found, line=line).u == pytest.approx(wanted, rel=1e-6)


def test_squareness_and_straightness_are_reported_in_mm_with_their_u(found):
    out, line = geometry(found, ReferenceLine.END_POINTS), ReferenceLine.END_POINTS
    for name, value in (
        ("squareness", squareness(found, line=line)),
        ("straightness_x", straightness(found, 0, 1, line)),
        ("straightness_y", straightness(found, 1, 0, line)),
    ):
        assert (out[name], out[f"u_{name}"]) == pytest.approx(
            (1e3 * value.value, 1e3 * value.u)
        )


@pytest.mark.parametrize(("axis", "direction"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_profiles_and_slopes(found, axis, direction):
    wanted = [
        u_of(lambda f, i=i: profile_m(f, axis, direction)[i], found)
        for i in range(N + 1)
    ]
    assert u_profile_m(found, axis, direction) == pytest.approx(
        wanted, rel=1e-6, abs=1e-20
    )
    lone = u_slope(found, axis, direction)
    x = np.arange(N + 1) * STEPS[axis]
    slope = u_of(lambda f: np.polyfit(x, profile_m(f, axis, direction), 1)[0], found)
    assert lone == pytest.approx(slope, rel=1e-6)
