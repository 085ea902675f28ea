# SPDX-License-Identifier: Apache-2.0
"""Plots of the published simulations, as PNG."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from selfcal_ros.files import write_bytes
from selfcal_ros.papers.hu import HuReproduction, HuRun
from selfcal_ros.papers.qiao import Program, QiaoReproduction
from selfcal_ros.reporting.picture import picture
from selfcal_ros.units import MM_PER_M, UM_PER_M

DPI = 110


def save_hu_plots(found: HuReproduction, folder: Path) -> list[Path]:
    """Write Figures 4 to 9 of Hu into `folder` and return their paths."""
    paths = [_save(folder / "hu_figure_4.png", lambda fig: _truth_map(fig, found)),
             _save(folder / "hu_figure_5.png", lambda fig: _truth_theta(fig, found))]
    for run in found.runs:
        for name, columns in zip(run.published.figures, ((0, 1), (2,)), strict=True):
            path = folder / f"hu_{name.lower().replace(' ', '_')}.png"
            paths.append(_save(path, partial(_series, run=run, name=name, columns=columns)))
    return paths


def save_qiao_plots(found: QiaoReproduction, folder: Path) -> list[Path]:
    """Write Figures 3 and 4 of Qiao into `folder` and return their paths."""
    return [_save(folder / "qiao_figure_3.png", lambda fig: _programs(fig, found)),
            _save(folder / "qiao_figure_4.png", lambda fig: _noise_run(fig, found))]


def _save(path: Path, draw: Callable[[Figure], None]) -> Path:
    figure = Figure(figsize=(9, 4.5), dpi=DPI, layout="constrained")
    draw(figure)
    write_bytes(path, picture(figure, "png", dpi=DPI, metadata={"Software": None}))
    return path


def _truth_map(figure: Figure, found: HuReproduction) -> None:
    axes = figure.subplots()
    artifact = found.truth.artifact
    axes.quiver(artifact.x_m * MM_PER_M, artifact.y_m * MM_PER_M, *(found.truth.g * UM_PER_M),
                color="tab:red", angles="xy", scale_units="xy", scale=0.1)
    axes.set(title=f"Hu, Figure 4: nominal stage error times 10000, within "
             f"[{found.truth.g.min() * UM_PER_M:.3f}, {found.truth.g.max() * UM_PER_M:.3f}] µm",
             xlabel="x, mm", ylabel="y, mm", aspect="equal")


def _truth_theta(figure: Figure, found: HuReproduction) -> None:
    axes = figure.subplots()
    angle = np.rad2deg(found.truth.artifact.theta_rad)
    axes.bar(angle, np.rad2deg(found.truth.g_theta), width=6)
    axes.set(title="Hu, Figure 5: nominal angular error", xlabel="θ, deg", ylabel="Gθ, deg")


def _series(figure: Figure, run: HuRun, name: str, columns: tuple[int, ...]) -> None:
    n = min(run.published.n_draws[run.published.figures.index(name)], len(run.law.xy))
    draws = np.arange(1, n + 1)
    for axes, column in zip(np.atleast_1d(figure.subplots(1, len(columns), sharey=True)), columns,
                            strict=True):
        label, unit = (("EGx", "µm"), ("EGy", "µm"), ("EGθ", "deg"))[column]
        axes.plot(draws, run.law.std[:n, column], "o-", label="law")
        axes.plot(draws, run.joint.std[:n, column], "s-", label="joint least squares")
        axes.axhline(run.published.table[column][2], color="k", ls="--", label="published std")
        axes.axhline(run.bound[int(column == 2)], color="tab:green", ls=":", label="bound")
        axes.set(title=label, xlabel="draw", ylabel=f"std, {unit}")
        axes.legend(fontsize=8)
        axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylim(bottom=0)
    figure.suptitle(f"Hu, {name}: noise {run.published.sigma_um:g} µm, "
                    f"{run.published.sigma_deg:g} deg")


def _programs(figure: Figure, found: QiaoReproduction) -> None:
    for axes, program in zip(figure.subplots(1, 2), found.programs, strict=True):
        _arrows(axes, program)
    figure.suptitle("Qiao, Figure 3: truth (red) and least-squares answer (blue), times 5000")


def _arrows(axes: Axes, program: Program) -> None:
    size = program.truth_um.shape[1]
    at = (np.arange(size) - size // 2) * 10.0
    x, y = np.meshgrid(at, at, indexing="ij")
    for field, colour in ((program.found_um, "tab:blue"), (program.truth_um, "tab:red")):
        axes.quiver(x, y, *field, color=colour, angles="xy", scale_units="xy", scale=0.2)
    axes.set(title=f"{' + '.join(program.views)}: rms error {program.rms_um:.2g} µm",
             xlabel="x, mm", ylabel="y, mm", aspect="equal")


def _noise_run(figure: Figure, found: QiaoReproduction) -> None:
    left, right = figure.subplots(1, 2)
    size = found.error_um.shape[1]
    at = (np.arange(size) - size // 2) * 10.0
    x, y = np.meshgrid(at, at, indexing="ij")
    left.quiver(x, y, *found.error_um, angles="xy", scale_units="xy", scale=0.02)
    left.set(title="calibration error of one draw, times 50000", xlabel="x, mm", ylabel="y, mm",
             aspect="equal")
    for values, label in ((found.rms_um, "normal, σ = 0.1 µm"),
                          (found.rms_uniform_um, "uniform, ±0.1 µm")):
        right.plot(np.arange(1, len(values) + 1), np.sqrt((values**2).mean(axis=1)), ".",
                   label=label)
    right.axhline(0.05, color="k", ls="--", label="published mean")
    right.axhline(found.bound_um, color="tab:green", ls=":", label="bound at σ = 0.1 µm")
    right.set(title="rms error", xlabel="draw", ylabel="µm", ylim=(0, None))
    right.legend(fontsize=8)
    figure.suptitle("Qiao, Figure 4: noise of 0.1 µm")
