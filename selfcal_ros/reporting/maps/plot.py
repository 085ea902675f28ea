# SPDX-License-Identifier: Apache-2.0
"""Picture of a calibration: error vectors and angular error, as PNG, SVG or PDF."""

import os
from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.projections.polar import PolarAxes

from selfcal_ros import __version__
from selfcal_ros.errors import InputError
from selfcal_ros.files import write_bytes
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.maps.style import RC, drawable
from selfcal_ros.reporting.maps.theta import draw_theta
from selfcal_ros.reporting.maps.xy import draw_error_map
from selfcal_ros.reporting.picture import picture
from selfcal_ros.reporting.summary.numbers import truth_arrays
from selfcal_ros.reporting.summary.sections import state_sentence

DPI = 150
KINDS: dict[str, dict[str, str | None]] = {
    ".png": {"Software": f"selfcal {__version__}"},
    ".svg": {"Creator": f"selfcal {__version__}", "Date": None},
    ".pdf": {"Creator": f"selfcal {__version__}", "CreationDate": None}}
"""Endings of pictures, and what is written into them: no date, so that they are repeatable."""


def save_map_plot(result: CalibrationResult, path: str | os.PathLike, *,
                  truth: Mapping[str, np.ndarray] | None = None) -> None:
    """Write a picture with the XY error vectors and the polar angular error to `path`, atomically.

    Parameters
    ----------
    result : CalibrationResult
        What was found; unknown sites and lines are left out.
    path : path-like
        File to write; .png, .svg or .pdf.
    truth : mapping, optional
        ``gx``, ``gy`` (nx, ny) in m and ``g_theta`` (K,) in rad, drawn beneath.

    Raises
    ------
    InputError
        If `truth` does not fit the map, the name does not end in one of `KINDS`, or the file
        cannot be written.
    """
    kind = Path(path).suffix.lower()
    if kind not in KINDS:
        raise InputError(str(path), "no kind of picture by its ending",
                         "name a file that ends in .png, .svg or .pdf")
    truth = truth_arrays(result.error_map, truth)
    with rc_context(RC):
        figure = _whole_figure(result, truth)
        data = picture(figure, kind.lstrip("."), dpi=DPI, metadata=KINDS[kind])
    write_bytes(path, data)


def _whole_figure(result: CalibrationResult, truth: Mapping[str, np.ndarray] | None) -> Figure:
    wide = result.artifact.angular_count > 0
    figure = Figure(figsize=(14.4 if wide else 8, 7.8),
                    layout=ConstrainedLayoutEngine(rect=(0, 0.04, 1, 0.86)))
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(1, 2 if wide else 1, 1)
    draw_error_map(axes, result.error_map, truth=truth)
    if wide:
        polar: Any = figure.add_subplot(1, 2, 2, projection="polar")
        draw_theta(polar, result.error_map, truth=truth)
        _legend(polar)
    figure.text(0.5, 0.985, fill(drawable(state_sentence(result)), 140 if wide else 78),
                ha="center", va="top", fontsize=11.5, fontweight="bold", linespacing=1.35)
    figure.text(0.01, 0.01, _footer(result), ha="left", va="bottom", fontsize=8,
                color="#55606a")
    return figure


def _footer(result: CalibrationResult) -> str:
    source = result.input.get("file", "")
    parts = [f"plan {drawable(result.plan_id, 60)}", f"method {drawable(result.method, 20)}",
             f"θ datum {result.error_map.datum_theta}" if result.artifact.angular_count else "",
             f"input {drawable(os.path.basename(str(source)), 60)}" if source else "",
             f"selfcal {__version__}"]
    return "  ·  ".join(part for part in parts if part)


def _legend(axes: PolarAxes) -> None:
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=4, frameon=False,
                fontsize=9)
