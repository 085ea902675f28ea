# SPDX-License-Identifier: Apache-2.0
"""Figures of the residuals: by mark, as distributions, over time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.result import CalibrationResult, ViewResult
from selfcal_ros.reporting.figures import parts
from selfcal_ros.reporting.figures.drawing import SERIES, Drawing, Frame, span_of
from selfcal_ros.reporting.summary.numbers import significant
from selfcal_ros.units import ARCSEC_PER_RAD, MM_PER_M, UM_PER_M


@dataclass(frozen=True, eq=False)
class DrawnResiduals:
    """Residuals of one view.

    Attributes
    ----------
    view : ViewResult
        The view.
    xy_m : float array (2, nx, ny)
        Grid residuals by mark, stage axes, m; NaN where not read.
    course : float array (4, parts)
        Time (s, from the first reading of the run), mean x and y (m) and number of the readings
        in each fraction of the view's duration; without parts where that is not known.
    theta_rad : float array (K,)
        Angular residuals by line, rad; NaN where not read.
    """

    view: ViewResult
    xy_m: np.ndarray
    course: np.ndarray
    theta_rad: np.ndarray

    def places_mm(self, artifact: Artifact) -> np.ndarray:
        """Return the nominal stage position of each mark, mm, (2, nx, ny)."""
        at = self.view.translation_x, self.view.translation_y
        return places_mm(self.view.rotation, at, artifact.x_m, artifact.y_m)


def places_mm(
    rotation_rad: float,
    translation_m: tuple[float, float],
    x_m: np.ndarray,
    y_m: np.ndarray,
) -> np.ndarray:
    """Return the nominal stage positions of points on a plate in this pose, mm, (2, ...)."""
    c, s = math.cos(rotation_rad), math.sin(rotation_rad)
    return (
        np.stack(
            [c * x_m - s * y_m + translation_m[0], s * x_m + c * y_m + translation_m[1]]
        )
        * MM_PER_M
    )


def residuals_in(result: CalibrationResult) -> list[DrawnResiduals]:
    """Return the residuals in a result by view; empty if there are none."""
    stored = result.parts.residuals
    shape = result.plate.shape
    lines = (result.plate.angular_count,)
    if stored is None or len(stored.views) != len(result.views):
        return []
    return [
        DrawnResiduals(
            view,
            np.stack([_of_shape(values, shape) for values in (row.dx, row.dy)]),
            np.zeros((4, 0))
            if row.course is None
            else np.array(
                [row.course.time_s, row.course.dx, row.course.dy, row.course.count]
            ),
            _of_shape(row.dtheta, lines),
        )
        for view, row in zip(result.views, stored.views, strict=True)
    ]


def _of_shape(values: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    return (
        values
        if values is not None and values.shape == shape
        else np.full(shape, np.nan)
    )


def residual_maps(
    result: CalibrationResult, residuals: Sequence[DrawnResiduals]
) -> Drawing | None:
    """Return the grid residuals of every view as vectors at the marks; None if there are none."""
    views = [v for v in residuals if np.isfinite(v.xy_m).any()]
    if not views:
        return None
    artifact = result.plate
    sites = parts.thinned(artifact, parts.MAX_ARROWS)
    factor = parts.enlargement(
        np.concatenate([np.hypot(*v.xy_m).ravel() for v in views]),
        (sites[0].step or 1) * artifact.grid_pitch_m,
    )
    drawing = parts.titled("residual-maps", "Residuals of the grid readings by view")
    reach = [
        max(float(np.abs(v.places_mm(artifact)[axis]).max()) for v in views)
        + 1.3 * artifact.grid_pitch_m * MM_PER_M
        for axis in (0, 1)
    ]
    frames = parts.panels(drawing, [v.view.name for v in views], reach)
    for view, frame in zip(views, frames, strict=True):
        frame.axes(ticks=(4, 4))
        at = view.places_mm(artifact)[:, *sites].reshape(2, -1)
        parts.arrows(frame, at, view.xy_m[:, *sites].reshape(2, -1), factor, width=0.9)
    y = drawing.height + 18
    parts.arrow_key(frames[0], factor, (46, y))
    drawing.label(150, y + 4, f"enlarged {factor:,.0f} ×; axes in mm")
    drawing.height = y + 16
    return drawing


BINS = 15
"""Bars of a histogram."""

MOST_DOTS = 400
"""Dots of a normal plot; of more, evenly spaced ones are shown."""


def distributions(residuals: Sequence[DrawnResiduals], kind: str) -> Drawing | None:
    """Return a histogram and a normal plot of every view.

    Parameters
    ----------
    residuals : sequence of DrawnResiduals
        The residuals.
    kind : str
        ``xy`` (both coordinates, µm) or ``theta`` (arcsec).
    """
    xy = kind == "xy"
    unit = "µm" if xy else "arcsec"
    rows = [
        (
            v.view.name,
            (v.xy_m * UM_PER_M if xy else v.theta_rad * ARCSEC_PER_RAD).ravel(),
        )
        for v in residuals
    ]
    rows = [(name, np.sort(values[np.isfinite(values)])) for name, values in rows]
    rows = [(name, values) for name, values in rows if len(values)]
    if not rows:
        return None
    mark_kind = "grid" if xy else "angular"
    drawing = parts.titled(
        f"distributions-{kind}",
        f"Distribution of the {mark_kind} residuals by view",
        44 + 148.0 * len(rows),
    )
    end = 1.05 * span_of(np.concatenate([values for _, values in rows]).tolist())
    for number, (name, values) in enumerate(rows):
        top = 50.0 + 148 * number
        last = number == len(rows) - 1
        size = rms(values)
        drawing.label(46, top - 7, parts.shortened(name, 24), bold=True)
        drawing.label(
            472,
            top - 7,
            f"{len(values)} residuals, rms {significant(size)} {unit}",
            size=11,
            anchor="end",
            colour="soft",
        )
        _histogram(drawing, values, size, (46, top, 190, 96), end).axes(
            ticks=(5, 3), x_label=f"residual in {unit}" if last else ""
        )
        _normal_plot(drawing, values, size, (290, top, 182, 96), end).axes(
            ticks=(6, 5), x_label="normal quantile" if last else ""
        )
    return drawing


def _histogram(
    drawing: Drawing,
    values: np.ndarray,
    size: float,
    box: tuple[float, float, float, float],
    end: float,
) -> Frame:
    counts, edges = np.histogram(values, BINS, (-end, end))
    width = 2 * end / BINS
    peak = len(values) * width * _normal_density(0.0) / size if size > 0 else 0.0
    top = 1.1 * max(float(counts.max()), min(peak, 3 * float(counts.max())), 1.0)
    frame = Frame(drawing, box, (-end, end), (0.0, top))
    drawing.shapes(
        [
            (
                frame.at(low, 0),
                frame.at(low, count),
                frame.at(high, count),
                frame.at(high, 0),
            )
            for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True)
            if count
        ],
        fill="band",
        stroke="paper",
    )
    if size > 0:
        along = np.linspace(-end, end, 101)
        curve = len(values) * width * (_normal_density(along / size) / size)
        drawing.line(
            [frame.at(x, min(y, top)) for x, y in zip(along, curve, strict=True)],
            width=1.3,
        )
    return frame


def _normal_density(x: Any) -> Any:
    """Return the density of the standard normal distribution, of a number or an array."""
    return np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)


def _normal_plot(
    drawing: Drawing,
    values: np.ndarray,
    size: float,
    box: tuple[float, float, float, float],
    end: float,
) -> Frame:
    quantiles = ndtri((np.arange(len(values)) + 0.5) / len(values))
    reach = max(3.2, float(np.abs(quantiles).max()) * 1.05)
    frame = Frame(drawing, box, (-reach, reach), (-end, end))
    drawing.line(
        [
            frame.at(q, min(max(q * size, -end), end))
            for q in np.linspace(-reach, reach, 41)
        ],
        stroke="truth",
        width=1.2,
    )
    chosen = _some(len(values))
    drawing.discs([frame.at(quantiles[i], values[i]) for i in chosen], 1.5, fill="ink")
    return frame


def _some(count: int) -> list[int]:
    """Return at most MOST_DOTS evenly spaced indices, including the first and the last."""
    if count <= MOST_DOTS:
        return list(range(count))
    return np.unique(np.linspace(0, count - 1, MOST_DOTS).round().astype(int)).tolist()


def courses(residuals: Sequence[DrawnResiduals], sigma_m: float) -> Drawing | None:
    """Return the mean grid residuals over the time of each view; None if times are unknown.

    The band contains 95 % of the means of random noise `sigma_m` (m, one reading).
    """
    views = [v for v in residuals if v.course.shape[1] > 1]
    if not views:
        return None
    drawing = parts.titled("courses", "Mean residuals over the time of each view, µm")
    bands = [
        2 * sigma_m * UM_PER_M / np.sqrt(np.maximum(v.course[3], 1)) for v in views
    ]
    end = 1.1 * max(
        span_of((v.course[1:3] * UM_PER_M).ravel().tolist() + band.tolist())
        for v, band in zip(views, bands, strict=True)
    )
    top = 50.0
    for view, band in zip(views, bands, strict=True):
        t = view.course[0] - view.course[0, 0]
        minutes = t[-1] > 180
        t = t / (60 if minutes else 1)
        expected = [parts.Curve(t, np.zeros(len(t)), "band", 0.0, U=band, band=True)]
        parts.chart(
            drawing,
            (52, top, 420, 84),
            [
                *(expected if np.isfinite(band).all() else []),
                *(
                    parts.Curve(t, view.course[axis] * UM_PER_M, f"c{axis - 1}")
                    for axis in (1, 2)
                ),
            ],
            title=parts.shortened(view.view.name, 40),
            x=(0.0, float(t[-1]) or 1.0),
            y=(-end, end),
        )
        drawing.label(
            472,
            top - 7,
            "time in min" if minutes else "time in s",
            size=11,
            colour="soft",
            anchor="end",
        )
        top += 84 + 46
    parts.legend(
        drawing,
        [("c0", "x"), ("c1", "y"), ("band", "95 % of random noise")],
        (52, top - 14),
    )
    drawing.height = top - 4
    return drawing


def drift_found(result: CalibrationResult) -> Drawing | None:
    """Return the drift of the plate estimated in each view; None without the term."""
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
            paths[key] = (
                paths.get(key, np.zeros(len(tau))) + item.value * shape * UM_PER_M
            )
    if not paths:
        return None
    names = list(dict.fromkeys(view for view, _ in paths))
    drawing = parts.titled("drift", "Drift found in each view, µm")
    end = 1.1 * span_of(np.concatenate(list(paths.values())).tolist())
    parts.chart(
        drawing,
        (58, 34, 414, 190),
        [
            parts.Curve(np.array([0.0, 1.0]), np.zeros(2), "line", 1.0),
            *(
                parts.Curve(
                    (tau + 1) / 2, paths[name, axis], f"c{number % SERIES}", 1.8, dash
                )
                for number, name in enumerate(names)
                for axis, dash in (("x", ()), ("y", (5, 3)))
                if (name, axis) in paths
            ),
        ],
        x=(0.0, 1.0),
        y=(-end, end),
        labels=("fraction of the view's duration", ""),
    )
    y = 34 + 190 + 62.0
    for first in range(0, len(names), 3):
        parts.legend(
            drawing,
            [
                (f"c{i % SERIES}", parts.shortened(name, 16))
                for i, name in list(enumerate(names))[first : first + 3]
            ],
            (46, y),
        )
        y += 18
    drawing.label(46, y, "solid: along x, dashed: along y", colour="soft")
    drawing.height = y + 10
    return drawing
