# SPDX-License-Identifier: Apache-2.0
"""The numbers of a result that a batch keeps and follows over time."""

import math

from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.summary.numbers import summary_numbers
from selfcal_ros.units import ARCSEC_PER_RAD, PPM_PER_ONE, UM_PER_M

PER = "_per_"
"""Stands for the stroke of a unit in a name."""


def quantities(result: CalibrationResult) -> dict[str, float | None]:
    """Return name -> value; the unit is the end of the name, None = not known.

    Terms of the model that all views share are there by their components, in SI units.
    """
    emap, noise, numbers = result.error_map, result.noise, summary_numbers(result)
    used = sum(view.used for view in result.views)
    rejected = sum(result.rejected.values())
    found = {
        "nonorthogonality_arcsec": emap.nonorthogonality * ARCSEC_PER_RAD,
        "scale_difference_ppm": emap.scale_difference * PPM_PER_ONE,
        "max_error_um": numbers.max_error_um,
        "rms_error_um": numbers.rms_error_um,
        "rms_uncertainty_um": numbers.rms_uncertainty_um,
        "max_theta_error_arcsec": numbers.max_theta_error_arcsec,
        "rms_theta_uncertainty_arcsec": numbers.rms_theta_uncertainty_arcsec,
        "sigma_xy_um": noise.sigma_xy * UM_PER_M,
        "sigma_theta_arcsec": noise.sigma_theta * ARCSEC_PER_RAD,
        "rejected_percent": 100 * rejected / (used + rejected) if used + rejected else math.nan}
    for term in result.model.terms:
        for estimate in term.estimates:
            if not estimate.view:
                unit = estimate.unit.replace("/", PER)
                found[f"{term.name}_{estimate.component}_{unit}".replace(" ", "_")] = estimate.value
    return {name: value if math.isfinite(value) else None for name, value in found.items()}


def described(name: str) -> tuple[str, str]:
    """Return a quantity's name as words, and its unit."""
    text, _, unit = name.replace(f"m{PER}m", "m/m").rpartition("_")
    return text.replace("_", " "), {"percent": "%", "um": "µm"}.get(unit, unit)
