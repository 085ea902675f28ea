# SPDX-License-Identifier: Apache-2.0
"""Figures of residuals as random numbers: histogram, normal plot and course by view, and drift."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import ndtri

from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.statistics import rms
from selfcal_ros.reporting.figures.fields import legend
from selfcal_ros.reporting.figures.maps import WIDTH
from selfcal_ros.reporting.figures.residuals import ViewResiduals, shortened
from selfcal_ros.reporting.sheet.drawing import Drawing
from selfcal_ros.reporting.sheet.frame import Frame, span_of
from selfcal_ros.reporting.summary.format import significant
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

BINS = 15
"""Bars of a histogram."""

MOST_DOTS = 400
"""Dots of a normal plot; of more, evenly spaced ones are shown."""


def distributions(found: Sequence[ViewResiduals], kind: str) -> Drawing | None:
    """Return a histogram and a normal plot of every view.

    Parameters
    ----------
    found : sequence of ViewResiduals
        The residuals.
    kind : str
        ``xy`` (both coordinates, µm) or ``theta`` (arcsec).
    """
    xy = kind == "xy"
    unit = "µm" if xy else "arcsec"
    rows = [(v.view.name, (v.xy_m * UM_PER_M if xy else v.theta_rad * ARCSEC_PER_RAD).ravel())
            for v in found]
    rows = [(name, np.sort(values[np.isfinite(values)])) for name, values in rows]
    rows = [(name, values) for name, values in rows if len(values)]
    if not rows:
        return None
    what = "grid" if xy else "angular"
    drawing = Drawing(f"distributions-{kind}", f"Histogram and normal plot of the {what} "
                      "residuals of every view.", WIDTH, 26 + 148.0 * len(rows))
    drawing.label(0, 16, f"Distribution of the {what} residuals by view, {unit}", size=13,
                  bold=True)
    end = 1.05 * span_of(np.concatenate([values for _, values in rows]).tolist())
    for number, (name, values) in enumerate(rows):
        top = 50.0 + 148 * number
        size = rms(values)
        drawing.label(46, top - 7, shortened(name, 24), size=12, bold=True)
        drawing.label(472, top - 7, f"{len(values)} residuals, rms {significant(size)} {unit}",
                      size=11, anchor="end", colour="soft")
        _histogram(drawing, values, size, (46, top, 190, 96), end)
        _normal_plot(drawing, values, size, (290, top, 182, 96), end)
    return drawing


def _histogram(drawing: Drawing, values: np.ndarray, size: float,
               box: tuple[float, float, float, float], end: float) -> None:
    counts, edges = np.histogram(values, BINS, (-end, end))
    width = 2 * end / BINS
    peak = len(values) * width * _normal_density(0.0) / size if size > 0 else 0.0
    top = 1.1 * max(float(counts.max()), min(peak, 3 * float(counts.max())), 1.0)
    frame = Frame(drawing, box, (-end, end), (0.0, top))
    drawing.shapes([(frame.at(low, 0), frame.at(low, count), frame.at(high, count),
                     frame.at(high, 0)) for low, high, count in
                    zip(edges[:-1], edges[1:], counts, strict=True) if count],
                   fill="band", stroke="paper")
    if size > 0:
        along = np.linspace(-end, end, 101)
        curve = len(values) * width * (_normal_density(along / size) / size)
        drawing.line([frame.at(x, min(y, top)) for x, y in zip(along, curve, strict=True)],
                     width=1.3)
    frame.axes(ticks=(5, 3))


def _normal_density(x: Any) -> Any:
    """Return the density of the standard normal distribution, of a number or an array."""
    return np.exp(-x ** 2 / 2) / math.sqrt(2 * math.pi)


def _normal_plot(drawing: Drawing, values: np.ndarray, size: float,
                 box: tuple[float, float, float, float], end: float) -> None:
    quantiles = ndtri((np.arange(len(values)) + 0.5) / len(values))
    reach = max(3.2, float(np.abs(quantiles).max()) * 1.05)
    frame = Frame(drawing, box, (-reach, reach), (-end, end))
    drawing.line([frame.at(q, min(max(q * size, -end), end)) for q in
                  np.linspace(-reach, reach, 41)], stroke="truth", width=1.2)
    chosen = _some(len(values))
    drawing.discs([frame.at(quantiles[i], values[i]) for i in chosen], 1.5, fill="ink")
    frame.axes(ticks=(6, 5))


def _some(count: int) -> list[int]:
    """Return at most MOST_DOTS evenly spaced indices, the first and the last among them."""
    if count <= MOST_DOTS:
        return list(range(count))
    return np.unique(np.linspace(0, count - 1, MOST_DOTS).round().astype(int)).tolist()


def courses(found: Sequence[ViewResiduals], sigma_m: float) -> Drawing | None:
    """Return the mean grid residuals over the time of each view; None where it is not known.

    The band holds 95 % of means of random noise of `sigma_m` (m, one reading).
    """
    views = [v for v in found if v.course.shape[1] > 1]
    if not views:
        return None
    drawing = Drawing("courses", "Mean grid residuals over the time of each view, with the band "
                      "that random noise would keep to.", WIDTH, 0)
    drawing.label(0, 16, "Mean residuals over the time of each view, µm", size=13, bold=True)
    bands = [2 * sigma_m * UM_PER_M / np.sqrt(np.maximum(v.course[3], 1)) for v in views]
    end = 1.1 * max(span_of((v.course[1:3] * UM_PER_M).ravel().tolist() + band.tolist())
                    for v, band in zip(views, bands, strict=True))
    top = 50.0
    for view, band in zip(views, bands, strict=True):
        since = view.course[0] - view.course[0, 0]
        minutes = since[-1] > 180
        t = since / (60 if minutes else 1)
        frame = Frame(drawing, (52, top, 420, 84), (0.0, float(t[-1]) or 1.0), (-end, end))
        drawing.label(52, top - 7, shortened(view.view.name, 40), size=12, bold=True)
        if np.isfinite(band).all():
            edge = list(zip(t, band, strict=True))
            drawing.shapes([[*(frame.at(x, y) for x, y in edge),
                             *(frame.at(x, -y) for x, y in reversed(edge))]],
                           fill="band", opacity=0.25)
        for axis, colour in ((1, "c0"), (2, "c1")):
            drawing.line([frame.at(x, y) for x, y in
                          zip(t, view.course[axis] * UM_PER_M, strict=True)], stroke=colour,
                         width=1.5)
        frame.axes(ticks=(6, 4))
        drawing.label(472, top - 7, "time in min" if minutes else "time in s", size=11,
                      colour="soft", anchor="end")
        top += 84 + 46
    legend(drawing, [("c0", "x"), ("c1", "y"), ("band", "95 % of random noise")], (52, top - 14))
    drawing.height = top - 4
    return drawing


def drift_found(result: CalibrationResult) -> Drawing | None:
    """Return the drift of the plate that the model's term found in each view; None without one."""
    term = next((t for t in result.model.terms if t.name == "drift"), None)
    if term is None or not term.estimates:
        return None
    tau = np.linspace(-1, 1, 61)
    paths: dict[tuple[str, str], np.ndarray] = {}
    for item in term.estimates:
        axis, _, degree = item.component.partition(" P")
        if degree.isdigit() and int(degree) < 20 and math.isfinite(item.value):
            shape = np.polynomial.legendre.Legendre.basis(int(degree))(tau)
            key = (item.view, axis)
            paths[key] = paths.get(key, np.zeros(len(tau))) + item.value * shape * UM_PER_M
    if not paths:
        return None
    names = list(dict.fromkeys(view for view, _ in paths))
    drawing = Drawing("drift", "Drift of the plate against the microscope within each view, as "
                      "the model found it.", WIDTH, 0)
    drawing.label(0, 16, "Drift found in each view, µm, over the part of its time", size=13,
                  bold=True)
    end = 1.1 * span_of(np.concatenate(list(paths.values())).tolist())
    frame = Frame(drawing, (58, 34, 414, 190), (0.0, 1.0), (-end, end))
    drawing.line([frame.at(0, 0), frame.at(1, 0)], stroke="line")
    for number, name in enumerate(names):
        for axis, dash in (("x", ()), ("y", (5, 3))):
            if (name, axis) in paths:
                drawing.line([frame.at((t + 1) / 2, v) for t, v in
                              zip(tau, paths[name, axis], strict=True)],
                             stroke=f"c{number % 6}", width=1.8, dash=dash)
    frame.axes(ticks=(5, 5), x_label="part of the view's time", y_label="")
    y = 34 + 190 + 62.0
    for first in range(0, len(names), 3):
        legend(drawing, [(f"c{(first + i) % 6}", shortened(name, 16)) for i, name in
                         enumerate(names[first:first + 3])], (46, y))
        y += 18
    drawing.label(46, y, "solid: along x, dashed: along y", size=12, colour="soft")
    drawing.height = y + 10
    return drawing
