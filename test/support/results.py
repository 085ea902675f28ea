# SPDX-License-Identifier: Apache-2.0
"""Calibration results with known content for the tests of reports."""

from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.judge import judged
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.parts import (
    Outliers,
    Parts,
    RejectedAt,
    Removed,
    ResidualsOfViews,
    ViewCourse,
    ViewResiduals,
)
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import (
    ArtifactMap,
    CalibrationResult,
    Noise,
    Observability,
    ViewResult,
)
from selfcal_ros.reporting.chapters import Chapter, chapters, heading
from selfcal_ros.reporting.report import report_html
from selfcal_ros.reporting.summary.numbers import truth_arrays
from test.support.lattice_plans import in_datum
from test.support.maps import first_order
from test.support.truth import hu_plan, random_truth

SIGMA_M, SIGMA_RAD = 0.02e-6, np.deg2rad(0.001)


def noise_of(lines: int) -> Noise:
    """Return the noise of five repeats; nothing is known of theta on a plate without lines."""
    theta = (SIGMA_RAD, 384, 44) if lines else (float("nan"), 0, 0)
    return Noise(
        SIGMA_M,
        theta[0],
        SIGMA_M,
        theta[0],
        1.02 * SIGMA_M,
        0.98 * theta[0],
        2904,
        theta[1],
        220,
        theta[2],
        dof_xy=2904,
        dof_theta=theta[1],
    )


def known_result(
    size: int = 11,
    lines: int = 24,
    *,
    seed: int = 1,
    size_y: int = 0,
    noisy: bool = True,
) -> tuple[CalibrationResult, dict[str, np.ndarray]]:
    """Return a result whose map is a random truth plus noise of its stated uncertainty."""
    artifact = Artifact(size, 0.01, lines, size_y)
    rng = np.random.default_rng(seed)
    plan = hu_plan(artifact, 5)
    truth = random_truth(artifact, len(plan.views), rng)
    u = 0.9 * SIGMA_M * (1 + 0.5 * np.hypot(artifact.m, artifact.n) / size)
    u_theta = np.full(lines, 0.75 * SIGMA_RAD)
    noise = rng.normal(0, 1, (2, *artifact.shape)) * (u if noisy else 0)
    gx, gy = truth.g + noise
    g_theta = truth.g_theta + rng.normal(0, 1, lines) * (u_theta if noisy else 0)
    nonorthogonality, scale = first_order(artifact, gx, gy)
    emap = ErrorMap(
        artifact, gx, gy, u, u.copy(), g_theta, u_theta, nonorthogonality, scale
    )
    views = tuple(
        ViewResult(
            v.name,
            v.rotation_rad,
            *v.translation_m,
            truth.phi_rad[i],
            *truth.t_m[i],
            used=600 + i,
            rejected=i,
            read_grid=int(v.grid),
            read_angular=int(v.angular),
        )
        for i, v in enumerate(plan.views)
    )
    result = CalibrationResult(
        plan.plan_id,
        emap,
        ArtifactMap(*truth.a, truth.a_theta),
        views,
        Observability(9, 9, 0, True),
        noise_of(lines),
        {"no_encoder_sample": 3, "outlier": 12},
        {"file": "bags/hu.mcap", "sha256": "ab" * 32},
    )
    return result, {"gx": truth.g[0], "gy": truth.g[1], "g_theta": truth.g_theta}


def with_residuals(
    size: int = 5, lines: int = 24, *, size_y: int = 0
) -> CalibrationResult:
    """Return a result that keeps residuals, their course, and places of rejection."""
    result, _ = known_result(size, lines, size_y=size_y)
    rng, shape = np.random.default_rng(2), result.artifact.shape
    rows = tuple(
        ViewResiduals(
            v.name,
            dx=rng.normal(0, 1e-8, shape),
            dy=rng.normal(0, 1e-8, shape),
            dtheta=rng.normal(0, 1e-6, lines),
            course=ViewCourse(
                np.arange(20.0),
                dx=rng.normal(0, 1e-8, 20),
                dy=rng.normal(0, 1e-8, 20),
                count=(9,) * 20,
            ),
        )
        for v in result.views
    )
    rejected = RejectedAt(
        result.views[0].name,
        ("low_score", "too_far_from_nominal"),
        np.array([0.01, -0.02]),
        np.array([0.02, 0.0]),
    )
    removed = Removed(result.views[1].name, "grid", (1, 0), 9.0, 0.5, 1e-6)
    return replace(
        result,
        parts=Parts(
            residuals=ResidualsOfViews(rows),
            rejected_at=(rejected,),
            outliers=Outliers("above a limit", 0, (removed,)),
        ),
    )


def trusted(measurements: Measurements, options: Options) -> CalibrationResult:
    """Return what `calibrate` finds where nobody asks whether plates and offsets are as planned."""
    return judged(solve_joint(measurements, options), measurements, options).result


def covered(result: CalibrationResult, g: np.ndarray) -> float:
    """Return the part of the map's coordinates at which U = k u covers the true map `g`."""
    emap = result.error_map
    off = in_datum(
        np.stack([emap.gx, emap.gy]) - g, emap.valid, result.artifact, scale=True
    )
    inside = abs(off) <= result.noise.k_xy * np.stack([emap.u_gx, emap.u_gy])
    return float(inside[:, emap.valid].mean())


def chapters_of(
    result: CalibrationResult, truth: dict[str, np.ndarray] | None = None
) -> list[Chapter]:
    """Return the chapters of the report that `selfcal report` writes."""
    return chapters(result, truth_arrays(result.error_map, truth))


def html_of(
    result: CalibrationResult, truth: dict[str, np.ndarray] | None = None
) -> str:
    """Return the report that `selfcal report` writes as HTML."""
    return report_html(result, chapters_of(result, truth), heading(result, {}))
