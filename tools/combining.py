# SPDX-License-Identifier: Apache-2.0
"""Coverage of combined maps and false alarms of E_n: sets of simulated runs with known truth.

.venv/bin/python -m tools.combining [--sets N] [--workers N]
"""

import argparse
import sys
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.applications.papers.readings import hu_plan, simulate_measurements
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.combine import Combination, Member, combine
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.parallel import check_workers, outcomes
from selfcal_ros.simulation.machine import random_truth

ARTIFACT = Artifact(7, 0.01, 12)
SIGMA_M, SIGMA_RAD = 20e-9, 20e-6
OPTIONS = Options(assumed=(), causes=False)


@dataclass(frozen=True)
class Case:
    """Runs of a set, and the part between them: its kind and standard deviation, m."""

    runs: int
    kind: str = "none"
    size_m: float = 0.0

    def __str__(self) -> str:
        """Return a name for the table."""
        return f"{self.runs} runs, {self.kind}" + (
            f" {self.size_m * 1e9:.0f} nm" if self.size_m else ""
        )


CASES = [
    Case(runs, kind, size)
    for kind, size in (
        ("none", 0.0),
        ("white", 20e-9),
        ("smooth", 20e-9),
        ("smooth", 100e-9),
        ("square", 100e-9),
    )
    for runs in (2, 3, 6)
]


@dataclass(frozen=True)
class Found:
    """Result of a set: coverage, alarms of single values and of runs, runs that stand out."""

    covered_xy: float
    covered_theta: float
    beyond: float
    disagree: float
    stands_out: bool
    between: bool


def part_between(case: Case, rng: np.random.Generator) -> np.ndarray:
    """Return what a stage differs by in one run, (2, nx, ny), m, without its datum."""
    x, y = (p / np.abs(ARTIFACT.x_m).max() for p in (ARTIFACT.x_m, ARTIFACT.y_m))
    if case.kind == "white":
        field = rng.normal(0, case.size_m, (2, *ARTIFACT.shape))
    elif case.kind == "smooth":
        field = sum(
            (
                rng.normal(0, case.size_m / 2, 2)[:, None, None] * x ** (d - p) * y**p
                for d in (1, 2, 3)
                for p in range(d + 1)
            ),
            np.zeros((2, *ARTIFACT.shape)),
        )
    else:
        field = (
            rng.normal(0, case.size_m) * np.stack([y, x]) * float(case.kind == "square")
        )
    return remove_modes(field, datum_modes(ARTIFACT, scale=True))


def combined(case: Case, seed: int) -> tuple[Combination, np.ndarray, np.ndarray]:
    """Return the mean of a set of runs, and the deviations of its maps from the truth."""
    rng = np.random.default_rng(seed)
    truth = random_truth(ARTIFACT, 4, rng)
    parts = []
    for run in range(case.runs):
        moved = replace(truth, g=truth.g + part_between(case, rng))
        result = calibrate(
            simulate_measurements(
                moved,
                hu_plan(ARTIFACT, 2),
                rng,
                sigma_m=SIGMA_M,
                sigma_theta_rad=SIGMA_RAD,
            ),
            OPTIONS,
        )
        parts.append(Member(f"{run}.json", result.error_map, result))
    found = combine(parts)
    emap = found.result.error_map
    off = remove_modes(
        np.stack([emap.gx, emap.gy]) - truth.g, datum_modes(ARTIFACT, scale=True)
    )
    theta = emap.g_theta - truth.g_theta
    return found, off, theta - theta.mean()


def judged(item: tuple[Case, int]) -> Found:
    """Return coverage and alarms of a case with a seed."""
    case, seed = item
    found, off, theta = combined(case, seed)
    emap, noise = found.result.error_map, found.result.noise
    runs = found.xy.deviations
    return Found(
        float((abs(off) <= noise.k_xy * np.stack([emap.u_gx, emap.u_gy])).mean()),
        float((abs(theta) <= noise.k_theta * emap.u_g_theta).mean()),
        float(np.mean([abs(run.e_n) > 1 for run in runs])),
        float(np.mean([run.test is not None and run.test.significant for run in runs])),
        any(run.p_scatter < 0.05 / case.runs for run in runs),
        found.xy.p_between < 0.05,
    )


def main() -> int:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--sets", type=int, default=300, help="sets of each case (default: 300)"
    )
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    args = parser.parse_args()
    print(
        "| runs, part between them | in U: XY | θ | nodes with \\|E_n\\| > 1 | runs that "
        "disagree | sets with a run that stands out | sets with a part between runs |"
    )
    print("|---|---|---|---|---|---|---|")
    for case in CASES:
        sets = []
        for outcome in outcomes(
            judged,
            [(case, seed) for seed in range(args.sets)],
            workers=check_workers(args.workers),
        ):
            if outcome.error is not None:
                raise outcome.error
            sets.append(outcome.value)
        shares = [
            100 * float(np.mean([getattr(one, name) for one in sets]))
            for name in (
                "covered_xy",
                "covered_theta",
                "beyond",
                "disagree",
                "stands_out",
                "between",
            )
        ]
        print(
            f"| {case} | " + " | ".join(f"{share:.1f} %" for share in shares) + " |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
