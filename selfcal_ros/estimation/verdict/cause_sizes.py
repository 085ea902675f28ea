# SPDX-License-Identifier: Apache-2.0
"""Explanations as causes: their largest component with its uncertainty, and where it is."""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from scipy.special import eval_legendre

from selfcal_ros.estimation.findings import (
    ApproachCause,
    DriftCause,
    MicroscopeCause,
    NoiseCause,
    PlateScaleCause,
    PlateShapeCause,
    ReadingCause,
    SizeCause,
    SlipCause,
)
from selfcal_ros.estimation.terms.sizes import SizeTest
from selfcal_ros.estimation.verdict.causes import Explanation
from selfcal_ros.estimation.verdict.reading_columns import READING
from selfcal_ros.estimation.verdict.slip_columns import SLIP
from selfcal_ros.model.terms import TermName
from selfcal_ros.model.verdict import Cause, Finding, TermEstimate

TIMES = np.linspace(-1, 1, 101)
"""Instants of a view between which the range of a drift is sought."""


class Sized(NamedTuple):
    """The component that stands out: value and standard uncertainty in `unit`, and what it is."""

    value: float
    u: float
    unit: str
    what: Finding


def cause_of(found: Explanation, names: tuple[str, ...], half_width_m: float) -> Cause:
    """Return an explanation as a cause.

    Parameters
    ----------
    found : Explanation
        What explains the residuals.
    names : tuple of str
        Names of the grid views.
    half_width_m : float
        Longer half width of the plate, m: the unit of a slip's rotation.
    """
    sized = _SIZES[found.name](found, names, half_width_m)
    return Cause(found.name, "", sized.value, sized.u, sized.unit, found.p, sized.what)


def size_cause(test: SizeTest, estimates: Iterable[TermEstimate]) -> Cause:
    """Return the size of a term that the readings contradict as a cause.

    Parameters
    ----------
    test : SizeTest
        That failed.
    estimates : iterable of TermEstimate
        The term's coefficients without that size.
    """
    largest = max(estimates, key=lambda e: abs(e.value))
    return Cause(str(test.name), "", abs(largest.value), largest.u, largest.unit, test.p,
                 SizeCause(test.given, test.shown))


def noise_cause(view: str, ratio: float, u: float, p: float) -> Cause:
    """Return a view that is noisier than the others as a cause."""
    return Cause("noise", "", ratio, u, "m/m", p, NoiseCause(view))


def _linear(found: Explanation, weights: np.ndarray) -> tuple[float, float]:
    """Return weights @ values and its standard uncertainty."""
    variance = float(weights @ found.covariance @ weights)
    return float(weights @ found.values), math.sqrt(max(variance, 0.0))


def _likeliest[What](found: Explanation, options: list[tuple[What, np.ndarray]],
                     ) -> tuple[What, float, float]:
    """Return key, value and u of the combination that stands out most."""
    sized = [(what, *_linear(found, weights)) for what, weights in options]
    return max(sized, key=lambda item: abs(item[1]) / max(item[2], 1e-300))


def _microscope(found: Explanation, *_: object) -> Sized:
    # components xx, xy, yx, yy of E
    half = np.array([[1, 0, 0, 1], [0, -1, 1, 0], [1, 0, 0, -1], [0, 1, 1, 0]]) / 2
    part, value, u = _likeliest(found, list(zip(("scale", "turn", "scales", "shear"), half,
                                                strict=True)))
    return Sized(value, u, "rad" if part in ("turn", "shear") else "m/m", MicroscopeCause(part))


def _drift(found: Explanation, names: tuple[str, ...], _: float) -> Sized:
    options: list[tuple[DriftCause, np.ndarray]] = []
    for view in sorted({column.view for column in found.columns}):
        for axis in "xy":
            shape = np.array([
                eval_legendre(int(c.component[3:]), TIMES)
                if c.view == view and c.component[0] == axis else 0 * TIMES
                for c in found.columns])
            path = found.values @ shape
            ends = shape[:, int(path.argmax())] - shape[:, int(path.argmin())]
            options.append((DriftCause(axis, names[view]), ends))
    what, value, u = _likeliest(found, options)
    return Sized(value, u, "m", what)


def _one_column(found: Explanation) -> tuple[int, float, float]:
    """Return index, value and u of the coefficient that stands out most."""
    return _likeliest(found, list(enumerate(np.eye(len(found.columns)))))


def _plate_scale(found: Explanation, names: tuple[str, ...], _: float) -> Sized:
    at, value, u = _one_column(found)
    return Sized(value, u, "m/m", PlateScaleCause(names[found.columns[at].view], names[0]))


def _plate_shape(found: Explanation, names: tuple[str, ...], _: float) -> Sized:
    at, value, u = _one_column(found)
    return Sized(value, u, "m", PlateShapeCause(names[found.columns[at].view], names[0],
                                                found.whole))


def _approach(found: Explanation, *_: object) -> Sized:
    at, value, u = _one_column(found)
    return Sized(value, u, "m", ApproachCause(found.columns[at].component))


def _reading(found: Explanation, names: tuple[str, ...], _: float) -> Sized:
    toward = found.values / np.hypot(*found.values)
    value, u = _linear(found, toward)
    if found.mark is None:
        raise ValueError("a reading without its mark")
    return Sized(value, u, "m", ReadingCause(names[found.columns[0].view], found.mark))


def _slip(found: Explanation, names: tuple[str, ...], half_width_m: float) -> Sized:
    order = {column.component: i for i, column in enumerate(found.columns)}
    x, y, phi = (float(found.values[order[part]]) for part in ("x", "y", "phi"))
    size = math.hypot(x, y)
    toward = np.zeros(3)
    toward[order["x"]], toward[order["y"]] = (x / size, y / size) if size else (1.0, 0.0)
    value, u = _linear(found, toward)
    return Sized(value, u, "m", SlipCause(names[found.columns[0].view], found.part, x, y,
                                          phi / half_width_m))


_SIZES: dict[str, Callable[..., Sized]] = {
    TermName.MICROSCOPE: _microscope, TermName.DRIFT: _drift, TermName.PLATE_SCALE: _plate_scale,
    TermName.PLATE_SHAPE: _plate_shape, TermName.APPROACH: _approach, SLIP: _slip,
    READING: _reading}
