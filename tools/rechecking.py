# SPDX-License-Identifier: Apache-2.0
"""A population of machines rechecked: type I error, detection, coverage.

.venv/bin/python -m tools.rechecking [--machines N] [--size K] [--nodes N]

Each machine is calibrated, then seen in one more view of the same plate. Half of the machines have
changed meanwhile: N nodes of the map (default: 3) by K times its standard uncertainty (default: 3),
or with 0 nodes all of them smoothly, by K times in the mean (rms).
"""

import argparse
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.lattice.maps import MapSpline
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid
from selfcal_ros.model.error_map import datum_modes, remove_modes, rms
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.view import View
from selfcal_ros.parallel import check_workers, outcomes

PITCH_M, SIGMA_M, SIGMA_RAD, SIZE_M, TURN_RAD = 0.01, 20e-9, 2e-6, 0.3e-6, 1e-4
BEND_M = 5e-9
"""Bending of the plate in each view, at the middle of an edge: what is assumed of it."""

LENGTH = 0.3
"""Correlation length of a smooth change, as a part of the width of the field."""

MAPS = {
    "lattice": Artifact(11, PITCH_M, 12),
    "lattice six": Artifact(11, PITCH_M, 12),
    "general six": Artifact(11, PITCH_M, 0, map_grid=MapGrid(7, PITCH_M * 10 / 6)),
}
PLANS = {
    "lattice": ((0, (0, 0)), (90, (0, 0)), (0, (1, 0))),
    "lattice six": (
        (0, (0, 0)),
        (90, (0, 0)),
        (180, (0, 0)),
        (270, (0, 0)),
        (0, (1, 0)),
        (0, (0, 1)),
    ),
    "general six": (
        (0, (0, 0)),
        (90, (0, 0)),
        (37, (0.6, -0.7)),
        (211, (-1.2, 0.6)),
        (0, (1, 0)),
        (135, (0.4, 1.1)),
    ),
}


@dataclass(frozen=True)
class Case:
    """A machine: how its plate is calibrated, its seed, the change over u, and its nodes."""

    plan: str
    seed: int
    size: float
    nodes: int = 3


def complex_normal(
    rng: np.random.Generator, shape: tuple[int, ...], size: float
) -> np.ndarray:
    return size * (rng.normal(size=shape) + 1j * rng.normal(size=shape))


@dataclass(frozen=True, eq=False)
class Machine:
    """Errors of stage and plate: G at the nodes, A, and of both circles of lines."""

    artifact: Artifact
    field: np.ndarray
    plate: np.ndarray
    lines: np.ndarray

    def read(self, view: View, rng: np.random.Generator) -> ViewReadings:
        """Return the readings of a view, each mark and line once."""
        artifact, out, phi = self.artifact, ViewReadings(view), TURN_RAD * rng.normal()
        if view.grid:
            out = self._marks(out, phi, rng)
        if not view.angular:
            return out
        k, (stage, plate) = np.arange(artifact.angular_count), self.lines
        turn = round(view.rotation_rad / (2 * np.pi) * len(k))
        theta = (
            stage[(k + turn) % len(k)] + plate + phi + rng.normal(0, SIGMA_RAD, len(k))
        )
        return replace(out, k=k, dtheta=theta, count_theta=np.ones(len(k), dtype=int))

    def _marks(
        self, out: ViewReadings, phi: float, rng: np.random.Generator
    ) -> ViewReadings:
        artifact, view = self.artifact, out.view
        inside = view.pose.in_field(artifact)
        m, n = artifact.m[inside], artifact.n[inside]
        mark, phase = (m + 1j * n) * PITCH_M, view.pose.phase
        spline = MapSpline.of(
            artifact.field,
            Interpolation.BICUBIC if artifact.map_grid else Interpolation.BILINEAR,
        )
        z = mark / np.abs(mark.real).max()
        bent = np.stack([z**2, abs(z) ** 2, z.conj() ** 2], axis=-1) @ complex_normal(
            rng, (3,), BEND_M
        )
        seen = (
            phase * np.exp(1j * phi) * (mark + self.plate[inside] + bent) - phase * mark
        )
        seen += (
            spline.rows(view.pose.places(artifact, m, n))
            @ spline.coefficients(self.field).ravel()
        )
        seen += complex_normal(rng, (), 3e-6) + complex_normal(rng, m.shape, SIGMA_M)
        return replace(
            out, m=m, n=n, dx=seen.real, dy=seen.imag, count=np.ones(len(m), dtype=int)
        )


def smooth(field: Artifact, rng: np.random.Generator) -> np.ndarray:
    """Return a smooth random map without motion and scale, rms 1 of each coordinate."""
    z = (field.x_m + 1j * field.y_m).ravel()
    near = np.exp(
        -(np.abs(z[:, None] - z) ** 2) / (2 * (LENGTH * np.ptp(field.x_m)) ** 2)
    )
    values, vectors = np.linalg.eigh(near)
    drawn = (vectors * np.sqrt(np.maximum(values, 0))) @ complex_normal(
        rng, z.shape, 1.0
    )
    xy = np.stack([drawn.real, drawn.imag]).reshape(2, *field.shape)
    xy = remove_modes(xy, datum_modes(field, scale=True))
    return (xy[0] + 1j * xy[1]) / rms(xy)


def run(case: Case) -> tuple[bool, bool, float, float]:
    """Return whether a machine's results are qualified, and it is said to have changed.

    And of the new map the part in U, and error / u, rms.
    """
    artifact, rng = (
        MAPS[case.plan],
        np.random.default_rng([case.seed, int(case.size > 0)]),
    )
    lines = artifact.angular_count > 0
    machine = Machine(
        artifact,
        complex_normal(rng, artifact.field.shape, SIZE_M),
        complex_normal(rng, artifact.shape, SIZE_M),
        rng.normal(0, 1e-5, (2, artifact.angular_count)),
    )
    views = tuple(
        View(f"{i}", np.radians(turn), (a * PITCH_M, b * PITCH_M), True, lines)
        for i, (turn, (a, b)) in enumerate(PLANS[case.plan])
    )
    if lines:
        views = (
            *views,
            View("line", 2 * np.pi / artifact.angular_count, (0.0, 0.0), False, True),
        )
    before = calibrate(
        Measurements(
            case.plan, artifact, tuple(machine.read(view, rng) for view in views)
        ),
        Options(),
    )
    field = machine.field.copy()
    known = np.flatnonzero(before.error_map.valid)
    if case.size and not case.nodes:
        field += case.size * rms(before.error_map.u_gx) * smooth(artifact.field, rng)
    for node in rng.choice(known, case.nodes, replace=False) if case.size else ():
        u = float(before.error_map.u_gx.flat[node])
        field.flat[node] += case.size * u * np.exp(2j * np.pi * rng.random())
    today = replace(machine, field=field)
    result = calibrate(
        Measurements("today", artifact, (today.read(views[0], rng),)),
        Options(plate=before, plate_from="before"),
    )
    emap = result.error_map
    error = np.stack([emap.gx - field.real, emap.gy - field.imag])
    error = remove_modes(error, datum_modes(artifact.field, scale=True))
    u = np.stack([emap.u_gx, emap.u_gy])
    good = np.isfinite(u)
    inside = float(np.mean(np.abs(error[good]) < result.noise.k_xy * u[good]))
    failed = {found.name for found in result.verdict.failed}
    return (
        before.verdict.qualified
        and failed <= {"changed_or_drifted"},  # read in one pass
        bool(result.recheck.changed),
        inside,
        float(np.sqrt(np.mean((error[good] / u[good]) ** 2))),
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--machines", type=int, default=200, help="of each plan (default: 200)"
    )
    parser.add_argument(
        "--first", type=int, default=0, help="seed of the first (default: 0)"
    )
    parser.add_argument(
        "--size", type=float, default=3.0, help="of a change, over u (default: 3)"
    )
    parser.add_argument(
        "--nodes", type=int, default=3, help="changed; 0 = all (default: 3)"
    )
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    args = parser.parse_args()
    print(
        "| calibration | machines | qualified | said to have changed: not changed, changed | "
        "new map in U | error / u |\n|---|---|---|---|---|---|"
    )
    for plan in PLANS:
        cases = [
            Case(plan, args.first + i // 2, args.size * (i % 2), args.nodes)
            for i in range(args.machines)
        ]
        found: list = [None] * len(cases)
        for outcome in outcomes(run, cases, workers=check_workers(args.workers)):
            if outcome.error is not None:
                raise outcome.error
            found[outcome.index] = outcome.value
        same, other = (
            [
                one[1]
                for one, case in zip(found, cases, strict=True)
                if bool(case.size) is changes
            ]
            for changes in (False, True)
        )
        print(
            f"| {plan} | {len(found)} | {sum(one[0] for one in found)} | {sum(same)} "
            f"of {len(same)}, {sum(other)} of {len(other)} | "
            f"{100 * np.mean([one[2] for one in found]):.1f} % | "
            f"{np.sqrt(np.mean([one[3] ** 2 for one in found])):.3f} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
