# SPDX-License-Identifier: Apache-2.0
"""Explanations as causes: their largest component with its uncertainty, and what to do about it."""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from scipy.special import eval_legendre

from selfcal_ros.estimation.terms.sizes import SizeTest
from selfcal_ros.estimation.verdict.causes import Explanation
from selfcal_ros.estimation.verdict.slip_columns import SLIP
from selfcal_ros.model.terms import TermName
from selfcal_ros.model.verdict import Cause, TermEstimate
from selfcal_ros.units import MRAD_PER_RAD, PPM_PER_ONE, UM_PER_M, URAD_PER_RAD

TIMES = np.linspace(-1, 1, 101)
"""Instants of a view between which the range of a drift is sought."""


class Unit(NamedTuple):
    """How a person reads a quantity: how many of the unit are one in SI, and its name."""

    per_si: float
    name: str


UM, RATIO = Unit(UM_PER_M, "µm"), Unit(PPM_PER_ONE, "µm/m")
MRAD, PERCENT = Unit(MRAD_PER_RAD, "mrad"), Unit(100.0, "%")


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
    text, size, u, unit = _TEXTS[found.name](found, names, half_width_m)
    return Cause(found.name, text, size, u, unit, found.p)


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
    unit = _OF_SIZES.get(test.name, UM)
    ratio = abs(largest.value) / test.given
    times = f"{ratio:.3g}" if ratio < 1e3 else f"{ratio:.0f}"
    text = (f"{test.name} up to {abs(largest.value) * unit.per_si:.3g} {unit.name}, "
            f"{times} times the size given: give a larger size, as "
            f"in --model {test.name}:{test.shown:.1e}, or leave it free")
    return Cause(str(test.name), text, abs(largest.value), largest.u, largest.unit, test.p)


_OF_SIZES = {TermName.MICROSCOPE: MRAD, TermName.PLATE_SCALE: RATIO}
"""Unit in which a person reads the coefficients of a term; µm for the others."""


def noise_cause(view: str, ratio: float, u: float, p: float) -> Cause:
    """Return a view that is noisier than the others as a cause."""
    return Cause("noise", f"view '{view}' is {ratio:.2f} times as noisy as the others: measure it "
                 "again, or look for what shook it", ratio, u, "m/m", p)


def plus_minus(value: float, u: float, unit: Unit) -> str:
    """Return ``value ± u unit`` with two figures of the uncertainty."""
    value, u = value * unit.per_si, u * unit.per_si
    digits = 3
    if math.isfinite(u) and u > 0:
        digits = min(max(1 - math.floor(math.log10(u)), 0), 9)
    return f"{value:.{digits}f} ± {u:.{digits}f} {unit.name}"


def _linear(found: Explanation, weights: np.ndarray) -> tuple[float, float]:
    """Return weights @ values and its standard uncertainty."""
    variance = float(weights @ found.covariance @ weights)
    return float(weights @ found.values), math.sqrt(max(variance, 0.0))


def _likeliest(found: Explanation, options: list[tuple[str, np.ndarray]]) -> tuple[str, float,
                                                                                  float]:
    """Return name, value and u of the combination that stands out most."""
    sized = [(name, *_linear(found, weights)) for name, weights in options]
    return max(sized, key=lambda item: abs(item[1]) / max(item[2], 1e-300))


def _microscope(found: Explanation, *_: object) -> tuple[str, float, float, str]:
    # components xx, xy, yx, yy of E
    half = np.array([[1, 0, 0, 1], [0, -1, 1, 0], [1, 0, 0, -1], [0, 1, 1, 0]]) / 2
    name, value, u = _likeliest(found, list(zip(("scale", "turn", "scales", "shear"), half,
                                                strict=True)))
    said = {"turn": f"microscope turned by {plus_minus(value, u, MRAD)}",
            "scale": f"scale of the microscope off by {plus_minus(value, u, PERCENT)}",
            "scales": f"scales of the microscope along x and y differ by "
                      f"{plus_minus(2 * value, 2 * u, PERCENT)}",
            "shear": f"axes of the microscope out of square by "
                     f"{plus_minus(2 * value, 2 * u, MRAD)}"}[name]
    return (f"{said}: solve with --model microscope, or align it", value, u,
            "rad" if name in ("turn", "shear") else "m/m")


def _drift(found: Explanation, names: tuple[str, ...], _: float) -> tuple[str, float, float, str]:
    options: dict[str, np.ndarray] = {}
    for view in sorted({column.view for column in found.columns}):
        for axis in "xy":
            shape = np.array([
                eval_legendre(int(c.component[3:]), TIMES)
                if c.view == view and c.component[0] == axis else 0 * TIMES
                for c in found.columns])
            path = found.values @ shape
            ends = shape[:, int(path.argmax())] - shape[:, int(path.argmin())]
            options[f"along {axis} while view '{names[view]}' was measured"] = ends
    where, value, u = _likeliest(found, list(options.items()))
    return (f"drift of {plus_minus(value, u, UM)} {where}: solve with --model drift, or "
            "visit the marks there and back", value, u, "m")


def _units(found: Explanation) -> list[tuple[str, np.ndarray]]:
    return [(str(i), row) for i, row in enumerate(np.eye(len(found.columns)))]


def _plate_scale(found: Explanation, names: tuple[str, ...],
                 _: float) -> tuple[str, float, float, str]:
    at, value, u = _likeliest(found, _units(found))
    view = names[found.columns[int(at)].view]
    return (f"plate larger by {plus_minus(value, u, RATIO)} in view '{view}' than in view "
            f"'{names[0]}': solve with --model plate_scale, or let it take the temperature",
            value, u, "m/m")


def _plate_shape(found: Explanation, names: tuple[str, ...],
                 _: float) -> tuple[str, float, float, str]:
    at, value, u = _likeliest(found, _units(found))
    column = found.columns[int(at)]
    more = "" if found.whole else "; part of it cannot be separated from the stage: give its size"
    return (f"plate bent by {plus_minus(value, u, UM)} at the middle of an edge in view "
            f"'{names[column.view]}' against view '{names[0]}': solve with --model "
            f"plate_shape:SIZE, or lay it down without strain{more}", value, u, "m")


def _approach(found: Explanation, *_: object) -> tuple[str, float, float, str]:
    at, value, u = _likeliest(found, _units(found))
    axis = found.columns[int(at)].component
    return (f"indicated {axis} differs by ±({plus_minus(value, u, UM)}) with the direction "
            "of approach: solve with --model approach, or arrive from one side", value, u, "m")


def _slip(found: Explanation, names: tuple[str, ...],
          half_width_m: float) -> tuple[str, float, float, str]:
    order = {column.component: i for i, column in enumerate(found.columns)}
    x, y, phi = (found.values[order[part]] for part in ("x", "y", "phi"))
    size = math.hypot(x, y)
    toward = np.zeros(3)
    toward[order["x"]], toward[order["y"]] = (x / size, y / size) if size else (1.0, 0.0)
    value, u = _linear(found, toward)
    view = names[found.columns[0].view]
    return (f"the plate slipped by ({x * UM_PER_M:.3g}, {y * UM_PER_M:.3g}) µm and "
            f"{phi / half_width_m * URAD_PER_RAD:.3g} µrad after about {found.part:.0%} of view "
            f"'{view}': measure the view again, or solve with --robust", value, u, "m")


_TEXTS: dict[str, Callable[..., tuple[str, float, float, str]]] = {
    TermName.MICROSCOPE: _microscope, TermName.DRIFT: _drift, TermName.PLATE_SCALE: _plate_scale,
    TermName.PLATE_SHAPE: _plate_shape, TermName.APPROACH: _approach, SLIP: _slip}
