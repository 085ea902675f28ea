# SPDX-License-Identifier: Apache-2.0
"""Figures of the published simulations, by the names of their pictures."""

from collections.abc import Sequence

import numpy as np

from selfcal_ros.applications.papers.hu import HuReproduction, HuRun
from selfcal_ros.applications.papers.qiao import QiaoReproduction
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.reporting.figures import parts
from selfcal_ros.reporting.figures.drawing import Drawing, Frame
from selfcal_ros.units import M_PER_UM, MM_PER_M, UM_PER_M

QIAO_PITCH_M = 0.01
Field = tuple[np.ndarray, str, float]
"""Vectors (2, nx, ny) in m, their colour, and the width of their shafts."""


def hu_figures(reproduction: HuReproduction) -> list[Drawing]:
    """Return Figures 4 to 9 of Hu."""
    truth = reproduction.truth
    low, high = truth.g.min() * UM_PER_M, truth.g.max() * UM_PER_M
    field = parts.titled(
        "hu_figure_4", f"Hu, Figure 4: nominal stage error, {low:.3f} to {high:.3f} µm"
    )
    (frame,) = parts.panels(field, [""], _reach(truth.artifact))
    _vectors(frame, truth.artifact, [(truth.g, "truth", 1.2)])
    field.height += 20
    lines = parts.titled("hu_figure_5", "Hu, Figure 5: nominal angular error, °", 260)
    parts.chart(
        lines,
        (66, 40, 400, 170),
        [
            parts.Curve(
                np.rad2deg(truth.artifact.theta_rad),
                np.rad2deg(truth.g_theta),
                "c0",
                dots=2.5,
            )
        ],
        labels=("θ in °", ""),
    )
    return [
        field,
        lines,
        *(
            _draws(run, name, columns)
            for run in reproduction.runs
            for name, columns in zip(run.published.figures, ((0, 1), (2,)), strict=True)
        ),
    ]


def qiao_figures(reproduction: QiaoReproduction) -> list[Drawing]:
    """Return Figures 3 and 4 of Qiao."""
    artifact = Artifact(reproduction.error_um.shape[1], QIAO_PITCH_M, 0)
    programs = parts.titled(
        "qiao_figure_3", "Qiao, Figure 3: truth and least-squares answer"
    )
    for frame, program in zip(
        parts.panels(
            programs,
            [", ".join(p.views) for p in reproduction.programs],
            _reach(artifact),
        ),
        reproduction.programs,
        strict=True,
    ):
        _vectors(
            frame,
            artifact,
            [
                (program.found_um * M_PER_UM, "c0", 2.6),
                (program.truth_um * M_PER_UM, "truth", 1.0),
            ],
        )
        left, top, _, height = frame.box
        programs.label(
            left + 80, top + height + 36, f"rms error {program.rms_um:.2g} µm"
        )
    parts.legend(
        programs, [("truth", "truth"), ("c0", "answer")], (46, programs.height + 44)
    )
    programs.height += 54
    noise = parts.titled("qiao_figure_4", "Qiao, Figure 4: noise of 0.1 µm")
    frame = parts.panels(noise, ["error of one draw"], _reach(artifact))[0]
    _vectors(frame, artifact, [(reproduction.error_um * M_PER_UM, "ink", 1.0)])
    _, top, _, height = frame.box
    n = len(reproduction.rms_um)
    parts.chart(
        noise,
        (290, top, 182, height),
        [
            *(
                parts.Curve(
                    np.arange(1, n + 1),
                    np.sqrt((values**2).mean(axis=1)),
                    colour,
                    0.0,
                    dots=1.8,
                )
                for values, colour in (
                    (reproduction.rms_um, "c0"),
                    (reproduction.rms_uniform_um, "c1"),
                )
            ),
            _level(n, 0.05, "ink", (5, 3)),
            _level(n, reproduction.bound_um, "c2", (2, 2)),
        ],
        title="rms error, µm",
        labels=("draw", ""),
        y=(0.0, 1.1 * float(reproduction.rms_um.max())),
    )
    for number, entries in enumerate(
        (
            (("c0", "normal, σ = 0.1 µm"), ("c1", "uniform, ±0.1 µm")),
            (("ink", "published mean"), ("c2", "bound at σ = 0.1 µm")),
        )
    ):
        parts.legend(noise, entries, (150, noise.height + 48 + 18 * number))
    noise.height += 78
    return [programs, noise]


def _reach(artifact: Artifact) -> list[float]:
    return [(half + 1.2) * artifact.grid_pitch_m * MM_PER_M for half in artifact.half]


def _vectors(frame: Frame, artifact: Artifact, fields: Sequence[Field]) -> None:
    """Draw fields over each other at the same enlargement, with a key below."""
    places_mm = np.stack([artifact.x_m.ravel(), artifact.y_m.ravel()]) * MM_PER_M
    factor = parts.enlargement(
        np.concatenate([np.hypot(*field).ravel() for field, _, _ in fields]),
        artifact.grid_pitch_m,
    )
    for field, colour, width in fields:
        parts.arrows(
            frame, places_mm, field.reshape(2, -1), factor, colour=colour, width=width
        )
    frame.axes(ticks=(4, 4))
    left, top, _, height = frame.box
    parts.arrow_key(frame, factor, (left, top + height + 32))


def _level(n: int, value: float, colour: str, dash: tuple[float, ...]) -> parts.Curve:
    return parts.Curve(np.array([1.0, float(n)]), np.full(2, value), colour, dash=dash)


def _draws(run: HuRun, name: str, columns: tuple[int, ...]) -> Drawing:
    """Return the standard deviations of the errors draw by draw, with the published ones."""
    published = run.published
    n = min(published.n_draws[published.figures.index(name)], len(run.law.xy))
    drawing = parts.titled(
        f"hu_{name.lower().replace(' ', '_')}",
        f"Hu, {name}: std of the error, noise {published.sigma_um:g} µm, {published.sigma_deg:g}°",
        300,
    )
    end = 1.1 * max(
        float(errors.std[:n, list(columns)].max()) for errors in (run.law, run.joint)
    )
    width = 410 / len(columns)
    for number, column in enumerate(columns):
        parts.chart(
            drawing,
            (62 + number * width, 50, width - 50 * (len(columns) - 1), 170),
            [
                *(
                    parts.Curve(
                        np.arange(1, n + 1), errors.std[:n, column], colour, dots=2.2
                    )
                    for errors, colour in ((run.law, "c0"), (run.joint, "c1"))
                ),
                _level(n, published.table[column][2], "ink", (5, 3)),
                _level(n, run.bound[int(column == 2)], "c2", (2, 2)),
            ],
            title=("EGx, µm", "EGy, µm", "EGθ, °")[column],
            labels=("draw", ""),
            y=(0.0, end),
        )
    parts.legend(
        drawing,
        [
            ("c0", "law"),
            ("c1", "joint least squares"),
            ("ink", "published"),
            ("c2", "bound"),
        ],
        (46, 280),
    )
    return drawing
