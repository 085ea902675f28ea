# SPDX-License-Identifier: Apache-2.0
"""Hu's published simulation, rerun with seeds, by Hu's law and by joint least squares."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from selfcal_ros.applications.papers.law import (
    HuReadings,
    hu_readings,
    hu_views,
    law_for,
)
from selfcal_ros.applications.papers.readings import hu_plan, simulate_measurements
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.estimation.observability.plan_check import predict
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum
from selfcal_ros.model.readings import Measurements, Sense
from selfcal_ros.parallel import Progress, mapped_in_parts, silent
from selfcal_ros.reporting.summary.numbers import counted, with_u
from selfcal_ros.simulation.machine import Spread, Truth, random_truth
from selfcal_ros.units import M_PER_UM, UM_PER_M

ARTIFACT = Artifact(11, 0.01, 24)
"""Plate of Hu's section 4: 11 x 11 marks, 10 mm, lines every 15°.

Hu prints the pitch as L/N; N marks have N - 1 intervals.
"""
AS_PUBLISHED = Spread(encoder="xy_axes", rotation="linear")


@dataclass(frozen=True)
class Published:
    """One published table and its figures; um and deg.

    `table` rows are x, y, theta; columns max, min, std. The signs of the minima were lost in
    print, and the caption of Table 2 has the noise of Table 1.
    """

    name: str
    figures: tuple[str, str]
    n_draws: tuple[int, int]
    sigma_um: float
    sigma_deg: float
    table: tuple[tuple[float, float, float], ...]

    def least_std(self, row: int) -> float:
        """Return the smallest std of as many values with the extremes of a row."""
        high, low, _ = self.table[row]
        # rows: x, y, theta
        count = ARTIFACT.m.size if row < 2 else ARTIFACT.angular_count
        return (high - low) / math.sqrt(2 * (count - 1))


TABLES = (
    Published(
        name="Table 1",
        figures=("Figure 6", "Figure 7"),
        n_draws=(20, 20),
        sigma_um=0.02,
        sigma_deg=0.001,
        table=(
            (0.0541, -0.0490, 0.0195),
            (0.0511, -0.0506, 0.0196),
            (1.5877e-3, -1.2065e-3, 7.1184e-4),
        ),
    ),
    Published(
        name="Table 2",
        figures=("Figure 8", "Figure 9"),
        n_draws=(10, 20),
        sigma_um=0.002,
        sigma_deg=0.0001,
        table=(
            (0.0051, -0.0051, 0.0020),
            (0.0051, -0.0053, 0.0020),
            (2.9963e-4, -6.9733e-4, 7.6657e-5),
        ),
    ),
)


@dataclass(frozen=True, eq=False)
class Errors:
    """Calibration errors of all draws: xy (draws, 2, N, N) in um, theta (draws, K) in deg."""

    xy: np.ndarray
    theta: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of each draw's error map: x, y (um), theta (deg); (draws, 3)."""
        xy = self.xy.reshape(len(self.xy), 2, -1).std(axis=2, ddof=1)
        return np.column_stack([xy, self.theta.std(axis=1, ddof=1)])

    @property
    def first(self) -> np.ndarray:
        """Return max, min, std of the first draw: rows x, y, theta, (3, 3)."""
        parts = [*self.xy[0].reshape(2, -1), self.theta[0]]
        return np.array([[part.max(), part.min(), part.std(ddof=1)] for part in parts])


@dataclass(frozen=True, eq=False)
class HuRun:
    """All draws at one noise: by the law and by joint least squares, with the bound."""

    published: Published
    law: Errors
    joint: Errors
    bound: tuple[float, float]


@dataclass(frozen=True, eq=False)
class HuReproduction:
    """The whole simulation: the truth, the noise-free error, both tables."""

    truth: Truth
    noise_free_um: float
    noise_free_deg: float
    runs: tuple[HuRun, ...]


@one_thread()
def reproduce_hu(
    n_draws: int, seed: int, *, workers: int = 1, progress: Progress = silent
) -> HuReproduction:
    """Run Hu's simulation: one truth, `n_draws` draws of noise at each of the two levels.

    The draws are solved by `workers` processes, with the same results for any number of them.
    """
    rng = np.random.default_rng(seed)
    truth = random_truth(ARTIFACT, 4, rng, AS_PUBLISHED)
    exact = _law_errors(truth, [simulate_measurements(truth, hu_plan(ARTIFACT), rng)])
    runs = []
    for number, table in enumerate(TABLES):
        spread = partial(
            mapped_in_parts, workers=workers, progress=partial(_later, progress, number)
        )
        runs.append(_run(truth, table, rng, n_draws, spread))
    return HuReproduction(
        truth, float(abs(exact.xy).max()), float(abs(exact.theta).max()), tuple(runs)
    )


def _later(progress: Progress, number: int, done: int, total: int) -> None:
    progress(done + number * total, len(TABLES) * total)


def _run(
    truth: Truth,
    table: Published,
    rng: np.random.Generator,
    n_draws: int,
    spread: Callable,
) -> HuRun:
    plan = hu_plan(ARTIFACT)
    draws = [
        simulate_measurements(
            truth,
            plan,
            rng,
            sigma_m=table.sigma_um * M_PER_UM,
            sigma_theta_rad=np.deg2rad(table.sigma_deg),
        )
        for _ in range(n_draws)
    ]
    gain = predict(planned_system(ARTIFACT, plan.views), ARTIFACT, ThetaDatum.XY_AXES)
    bound = gain.rms_xy * table.sigma_um, gain.rms_theta * table.sigma_deg
    return HuRun(
        table, _law_errors(truth, draws), _joint_errors(truth, draws, spread), bound
    )


def _law_errors(truth: Truth, draws: list[Measurements]) -> Errors:
    law = law_for(ARTIFACT, ThetaDatum.XY_AXES, Sense.MICROSCOPE_MOVES)
    readings_of_draws = [
        hu_readings(ARTIFACT, hu_views(readings)) for readings in draws
    ]
    solution = law.solve(
        HuReadings(
            *(
                np.concatenate(
                    [getattr(of_draw, name) for of_draw in readings_of_draws], axis=-1
                )
                for name in ("v0", "v1", "v3", "vt")
            )
        )
    )
    xy = np.moveaxis(solution.g, -1, 0) - truth.g
    return Errors(xy * UM_PER_M, np.rad2deg(solution.g_theta.T - truth.g_theta))


def _joint_errors(truth: Truth, draws: list[Measurements], spread: Callable) -> Errors:
    maps = spread(_joint_maps, draws)
    xy = np.array([[m.gx - truth.g[0], m.gy - truth.g[1]] for m in maps])
    theta = np.array([m.g_theta - truth.g_theta for m in maps])
    return Errors(xy * UM_PER_M, np.rad2deg(theta))


def _joint_maps(draws: list[Measurements]) -> list[ErrorMap]:
    options = Options(
        datum_theta=ThetaDatum.XY_AXES,
        misalignment_model="linear",
        uncertainty=False,
        causes=False,
    )
    return [calibrate(readings, options).error_map for readings in draws]


def hu_text(reproduction: HuReproduction) -> str:
    """Return Tables 1 and 2 and the series of Figures 6 to 9, next to the paper's."""
    n = len(reproduction.runs[0].law.xy)
    lines = [
        "Hu, Zhu, Liu: self-calibration of XY-theta stages, section 4",
        "N = 11, 10 mm, K = 24; law = the published steps, joint = least squares of all "
        "readings at once",
        f"without noise the law errs by {reproduction.noise_free_um:.1e} µm, "
        f"{reproduction.noise_free_deg:.1e}°",
        "bound = smallest rms error of any unbiased method; std leaves out the mean of a "
        "map's error, so that it may lie below",
    ]
    for run in reproduction.runs:
        lines += ["", *_table_text(run, n), "", *_series_text(run)]
    return "\n".join(lines)


def _table_text(run: HuRun, n_draws: int) -> list[str]:
    table = run.published
    draws = "1 draw" if n_draws == 1 else f"{n_draws} draws, mean ± spread"
    lines = [
        f"{table.name}: noise {table.sigma_um:g} µm, {table.sigma_deg:g}°",
        f"{'':10}{'published':^33} {'law, first draw':^33} {f'std of {draws}':^46}",
        f"{'':10}{'max':>11}{'min':>11}{'std':>11} {'max':>11}{'min':>11}{'std':>11} "
        f"{'law':>22}{'joint':>22}{'bound':>11}",
    ]
    names = ("EGx, µm", "EGy, µm", "EGth, °")
    bounds = (run.bound[0], run.bound[0], run.bound[1])
    first = run.law.first
    for row, name in enumerate(names):
        cells = [f"{value:11.4g}" for value in (*table.table[row], *first[row])]
        spreads = [
            with_u(float(errors.std[:, row].mean()), _spread(errors.std[:, row]))
            for errors in (run.law, run.joint)
        ]
        lines.append(
            f"{name:10}{''.join(cells[:3])} {''.join(cells[3:])} "
            f"{spreads[0]:>22}{spreads[1]:>22}{bounds[row]:11.4g}"
        )
    for row, name in enumerate(names):
        if table.table[row][2] < table.least_std(row):
            lines.append(
                f"the published row of {name.split(',')[0]} contradicts itself: with its "
                f"max and min, its std is at least {table.least_std(row):.3g}"
            )
    return lines


def _spread(values: np.ndarray) -> float:
    """Return the standard deviation of single draws; NaN of one draw, which has none."""
    return float(values.std(ddof=1)) if len(values) > 1 else float("nan")


def _series_text(run: HuRun) -> list[str]:
    lines = []
    for figure, n, columns in zip(
        run.published.figures, run.published.n_draws, ((0, 1), (2,)), strict=True
    ):
        lines.append(
            f"{figure}: std of the law's error in {counted(min(n, len(run.law.xy)), 'draw')}"
        )
        for column in columns:
            name = ("x, µm", "y, µm", "theta, °")[column]
            values = " ".join(
                f"{value:.2e}" if column == 2 else f"{value:.4f}"
                for value in run.law.std[:n, column]
            )
            lines.append(f"  {name}: {values}")
    return lines
