# SPDX-License-Identifier: Apache-2.0
"""Qiao's published tables and simulations, rerun with seeds."""

from dataclasses import dataclass
from functools import partial
from math import pi

import numpy as np

from selfcal_ros.applications.papers.readings import (
    grid_deviation,
    simulate_measurements,
)
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.estimation.observability.plan_check import predict
from selfcal_ros.estimation.observability.rank import plan_observability
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum, datum_modes, rms
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.view import Plan, View
from selfcal_ros.parallel import Progress, mapped_in_parts, silent
from selfcal_ros.reporting.summary.numbers import counted
from selfcal_ros.simulation.machine import Spread, Truth, random_truth
from selfcal_ros.units import UM_PER_M

SIZES = (3, 5, 7, 9, 11)
ARTIFACT = Artifact(11, 0.01)
SPREAD = Spread(
    g_m=1e-6,
    a_m=1e-6,
    phi_rad=np.deg2rad(30 / 3600),
    t_m=30e-6,
    encoder="xy_axes",
    rotation="linear",
)
SIGMA_M = 0.1e-6
PUBLISHED_RMS_UM = (0.0563, 0.0572)
PUBLISHED_MEAN_UM = 0.05

POSES = {
    "initial": (0, 0, 0),
    "90°": (1, 0, 0),
    "180°": (2, 0, 0),
    "shift +x": (0, 1, 0),
    "shift -x": (0, -1, 0),
    "shift +y": (0, 0, 1),
}


@dataclass(frozen=True)
class RankRow:
    """A row of Qiao's tables 1 to 4, of so many positions: printed rank a n^2 + b n + c, unknowns.

    The number of unknowns is 4 n^2 + `extra`.
    """

    positions: str
    printed: tuple[float, float, float]
    extra: int

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the positions."""
        return tuple(self.positions.split(", "))

    @property
    def formula(self) -> str:
        """The printed rank as text."""
        a, b, c = self.printed
        middle = "" if b == 0 else "-n" if b == -1 else f"{b:g}n"
        return f"{a:g}n^2{middle}+{c:g}"

    def rank(self, n: int) -> float:
        """Return the printed rank for n x n marks."""
        a, b, c = self.printed
        return a * n**2 + b * n + c


ROWS = (
    RankRow("initial", (2, 0, 7), 3),
    RankRow("90°", (2, 0, 7), 3),
    RankRow("180°", (2, 0, 7), 3),
    RankRow("shift +x", (2, -2, 7), 3),
    RankRow("initial, 90°", (3.5, 0, 8.5), 6),
    RankRow("initial, 180°", (3, 0, 9), 6),
    RankRow("initial, shift +x", (4, -2, 7), 6),
    RankRow("initial, 90°, 180°", (3.5, 0, 11.5), 9),
    RankRow("initial, 90°, shift +x", (4, 0, 9), 9),
    RankRow("initial, 180°, shift +x", (4, -1, 10), 9),
    RankRow("initial, shift +x, shift -x", (4, -2, 10), 9),
    RankRow("initial, shift +x, shift +y", (4, 0, 7), 9),
    RankRow("initial, 90°, 180°, shift +x", (4, 0, 12), 12),
    RankRow("initial, 90°, shift +x, shift -x", (4, 0, 12), 12),
    RankRow("initial, 90°, shift +x, shift +y", (4, 0, 12), 12),
    RankRow("initial, 180°, shift +x, shift -x", (4, -1, 13), 12),
    RankRow("initial, 180°, shift +x, shift +y", (4, 0, 10), 12),
    RankRow("initial, shift +x, shift -x, shift +y", (4, 0, 10), 12),
)
PROGRAMS = (("initial", "90°", "shift +x"), ("initial", "180°", "shift +x"))


@dataclass(frozen=True, eq=False)
class Program:
    """One program of Figure 3: truth, noise-free estimate (2, N, N) in um, unseen modes."""

    views: tuple[str, ...]
    truth_um: np.ndarray
    found_um: np.ndarray
    deficiency: int

    @property
    def rms_um(self) -> float:
        """Root mean square of the estimate's error, um."""
        return rms(self.found_um - self.truth_um)


@dataclass(frozen=True, eq=False)
class QiaoReproduction:
    """Ranks (rows, sizes), the two programs, and the noise runs (draws, 2) in um."""

    ranks: np.ndarray
    unknowns: np.ndarray
    programs: tuple[Program, Program]
    rms_um: np.ndarray
    rms_uniform_um: np.ndarray
    error_um: np.ndarray
    bound_um: float


def plan_of(views: tuple[str, ...], artifact: Artifact = ARTIFACT) -> Plan:
    """Return the plan of Qiao's positions on a plate."""
    pitch = artifact.grid_pitch_m
    return Plan(
        " + ".join(views),
        artifact,
        tuple(
            View(name, q * pi / 2, (a * pitch, b * pitch), True, False)
            for name, (q, a, b) in ((name, POSES[name]) for name in views)
        ),
    )


@one_thread()
def reproduce_qiao(
    n_draws: int, seed: int, *, workers: int = 1, progress: Progress = silent
) -> QiaoReproduction:
    """Compute all ranks, run both programs without noise and the noise run `n_draws` times.

    The noise runs are solved by `workers` processes, with the same results for any number.
    """
    observability = [
        [plan_observability(plan_of(row.views, Artifact(n, 0.01))) for n in SIZES]
        for row in ROWS
    ]
    rng = np.random.default_rng(seed)
    truth = random_truth(ARTIFACT, 3, rng, SPREAD)
    first, second = (_program(truth, views) for views in PROGRAMS)
    plan = plan_of(PROGRAMS[0])
    draws = [
        simulate_measurements(truth, plan, rng, sigma_m=SIGMA_M) for _ in range(n_draws)
    ]
    exact = simulate_measurements(truth, plan, rng)
    draws += [_with_uniform_noise(exact, rng) for _ in range(n_draws)]
    errors = mapped_in_parts(
        partial(_all_errors_um, truth), draws, workers=workers, progress=progress
    )
    normal = errors[:n_draws]
    uniform = errors[n_draws:]
    gain = predict(
        planned_system(ARTIFACT, plan.views), ARTIFACT, ThetaDatum.XY_AXES
    ).rms_xy
    return QiaoReproduction(
        ranks=np.array([[s.rank for s in row] for row in observability]),
        unknowns=np.array([[s.unknowns for s in row] for row in observability]),
        programs=(first, second),
        rms_um=_rms(normal),
        rms_uniform_um=_rms(uniform),
        error_um=normal[0],
        bound_um=gain * SIGMA_M * UM_PER_M,
    )


def _rms(errors: list[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.mean(np.array(errors) ** 2, axis=(2, 3)))


def _all_errors_um(truth: Truth, draws: list[Measurements]) -> list[np.ndarray]:
    return [_errors_um(truth, readings) for readings in draws]


def _errors_um(truth: Truth, readings: Measurements) -> np.ndarray:
    options = Options(misalignment_model="linear", uncertainty=False, causes=False)
    error_map = calibrate(readings, options).error_map
    return (np.stack([error_map.gx, error_map.gy]) - truth.g) * UM_PER_M


def _with_uniform_noise(
    readings: Measurements, rng: np.random.Generator
) -> Measurements:
    """Add uniform noise within +-SIGMA_M."""

    def shaken(view: ViewReadings) -> ViewReadings:
        dx, dy = rng.uniform(-SIGMA_M, SIGMA_M, (2, len(view.dx)))
        return ViewReadings(
            view=view.view,
            m=view.m,
            n=view.n,
            dx=view.dx + dx,
            dy=view.dy + dy,
            count=view.count,
        )

    return Measurements(
        readings.plan_id,
        readings.artifact,
        tuple(shaken(view) for view in readings.views),
        readings.sense,
    )


def _program(truth: Truth, views: tuple[str, ...]) -> Program:
    """Solve without noise: by the estimator, or by the generalised inverse if it refuses."""
    plan = plan_of(views)
    observability = plan_observability(plan)
    if observability.identifiable:
        readings = simulate_measurements(truth, plan, np.random.default_rng(0))
        map_um = truth.g * UM_PER_M + _errors_um(truth, readings)
    else:
        map_um = _minimum_norm(truth, plan) * UM_PER_M
    return Program(views, truth.g * UM_PER_M, map_um, observability.deficiency)


def _minimum_norm(truth: Truth, plan: Plan) -> np.ndarray:
    """Return G (2, N, N) of the generalised inverse of Qiao's eqs. 1 and 5, m.

    Columns are the readings of unit truths, lengths counted in pitches so that rotations weigh
    like lengths.
    """
    artifact = plan.artifact
    n_views = len(plan.views)
    sites = artifact.m.size
    columns = []
    for column in range(4 * sites + 3 * n_views):
        vector = np.zeros(4 * sites + 3 * n_views)
        vector[column] = 1.0
        columns.append(_observe(_truth_of(vector, artifact, n_views), plan))
    stage, plate = datum_modes(artifact, scale=True), datum_modes(artifact, scale=False)
    datum = np.zeros((7, 4 * sites + 3 * n_views))
    datum[:4, : 2 * sites] = stage.reshape(4, -1)
    datum[4:, 2 * sites : 4 * sites] = plate.reshape(3, -1)
    matrix = np.vstack([np.array(columns).T, datum])
    right = np.concatenate([_observe(truth, plan), np.zeros(7)])
    solution = np.linalg.lstsq(matrix, right, rcond=1e-10)[0]
    return solution[: 2 * sites].reshape(2, *artifact.shape)


def _truth_of(vector: np.ndarray, artifact: Artifact, n_views: int) -> Truth:
    sites = artifact.m.size
    pitch = artifact.grid_pitch_m
    shape = (2, *artifact.shape)
    tail = vector[4 * sites :].reshape(n_views, 3)
    return Truth(
        artifact=artifact,
        g=vector[: 2 * sites].reshape(shape),
        a=vector[2 * sites : 4 * sites].reshape(shape),
        g_theta=np.zeros(0),
        a_theta=np.zeros(0),
        phi_rad=tail[:, 0] / pitch,
        t_m=tail[:, 1:],
        linear=True,
    )


def _observe(truth: Truth, plan: Plan) -> np.ndarray:
    parts = [
        grid_deviation(truth, i, view).ravel() for i, view in enumerate(plan.views)
    ]
    values = np.concatenate(parts)
    return values[np.isfinite(values)]


def qiao_text(reproduction: QiaoReproduction) -> str:
    """Return the rank tables, both programs and the noise run, next to the paper's."""
    lines = [
        "Qiao et al.: position self-calibration by least squares, tables 1-4",
        f"{'positions':44}{'printed rank':>14}  "
        + "".join(f"{f'n = {n}':>10}" for n in SIZES)
        + "   unknowns",
    ]
    for row, ranks in zip(ROWS, reproduction.ranks, strict=True):
        marks = [
            f"{rank:>9}" + ("=" if rank == row.rank(n) else "!")
            for rank, n in zip(ranks, SIZES, strict=True)
        ]
        lines.append(
            f"{' + '.join(row.views):44}{row.formula:>14}  {''.join(marks)}   4n^2+{row.extra}"
        )
    equal = sum(
        int(rank == row.rank(n))
        for row, ranks in zip(ROWS, reproduction.ranks, strict=True)
        for rank, n in zip(ranks, SIZES, strict=True)
    )
    lines += [
        f"{equal} of {reproduction.ranks.size} ranks as printed (marked =)",
        "",
        "Figure 3: without noise, n = 11, stage and plate errors of 1 µm",
    ]
    for number, (program, published) in enumerate(
        zip(
            reproduction.programs,
            ("the answer covers the truth", "the answer differs from the truth"),
            strict=True,
        ),
        1,
    ):
        how = (
            ""
            if not program.deficiency
            else (
                f" by the generalised inverse; `solve` refuses ({program.deficiency} "
                "modes undetermined)"
            )
        )
        lines.append(
            f"  program {number}, {' + '.join(program.views)}: rms error "
            f"{program.rms_um:.3g} µm{how}; published: {published}"
        )
    return "\n".join([*lines, "", *_noise_text(reproduction)])


def _noise_text(reproduction: QiaoReproduction) -> list[str]:
    n = len(reproduction.rms_um)
    x, y = reproduction.rms_um[0]
    over_draws, uniform = (
        rms(r) for r in (reproduction.rms_um, reproduction.rms_uniform_um)
    )
    return [
        f"Figure 4: noise of standard deviation 0.1 µm, program 1, {counted(n, 'draw')}",
        f"  rms error of one draw: x {x:.4f} µm, y {y:.4f} µm; published "
        f"{PUBLISHED_RMS_UM[0]} and {PUBLISHED_RMS_UM[1]} µm",
        f"  rms over all draws: {over_draws:.4f} µm; published {PUBLISHED_MEAN_UM} µm",
        f"  bound of any unbiased estimator: {reproduction.bound_um:.4f} µm",
        "  The published figure lies below that bound, so that it is not reproducible as printed.",
        f"  Noise uniform within ±0.1 µm gives {uniform:.4f} µm: probably this was used.",
    ]
