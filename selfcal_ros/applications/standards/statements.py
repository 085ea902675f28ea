# SPDX-License-Identifier: Apache-2.0
"""What a certificate states of a result, for programs and for people, and what it cannot."""

import math
from collections.abc import Iterator
from datetime import date, timedelta
from typing import Any

from selfcal_ros.apply import StageMap
from selfcal_ros.errors import InputError
from selfcal_ros.model.findings import ScaleNotCompared
from selfcal_ros.model.recheck import PlateCalibration
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.units import UM_PER_M

TRACEABILITY, AGREEMENT = "Metrological traceability", "Agreement of readings and model"
EXPANDED = (
    "Each U is the expanded measurement uncertainty after JCGM 100:2008 (GUM): the "
    "standard uncertainty times the coverage factor stated with it, for a coverage "
    "probability of 95.45 %."
)
SCOPE = (
    "The results relate only to the item calibrated, as it was and under the conditions "
    "stated here."
)
INVALID = "No statement of the uncertainty is valid: the result is not qualified."


def require_certifiable(result: CalibrationResult, details: dict[str, Any]) -> None:
    """Refuse what no certificate can state, with the verdict or without.

    Raises
    ------
    InputError
        If the result has no uncertainties, the temperature of the plate is
        not that with which its length was converted, or the readings are not of the days of the
        certificate. A day either way is a time zone.
    """
    if not result.has_uncertainty:
        raise InputError(
            "certificate",
            "the result has no uncertainties",
            "solve again with --uncertainty always",
        )
    _require_temperature(result, details["conditions"])
    core = details["certificate"]
    zone = timedelta(days=1)
    times = [result.provenance.first_exposure, result.provenance.last_exposure]
    if all(times) and "clock" not in core:
        try:
            first, last = (date.fromisoformat(text[:10]) for text in times)
        except ValueError as error:
            raise InputError(
                "certificate",
                f"the times of the readings are not dates: {' to '.join(times)}",
                "solve their bag again, or explain the clock of the readings in certificate.clock",
            ) from error
        begin, end = (date.fromisoformat(core[name]) for name in ("begin", "end"))
        if first < begin - zone or last > end + zone:
            raise InputError(
                "certificate",
                f"the readings are of {first} to {last}, the dates of performance {begin} to {end}",
                "correct begin and end, or explain the clock of the readings in certificate.clock",
            )


def _require_temperature(
    result: CalibrationResult, conditions: list[dict[str, Any]]
) -> None:
    """Refuse a temperature of the plate that contradicts the one of its reference length.

    Of a mean, it is one of the temperatures of its runs, or between them.
    """
    lengths = result.reference.each if result.reference else ()
    of_plate = [
        length.certified
        for length in lengths
        if length.certified and length.kind.of_plate
    ]
    if not of_plate or len(of_plate) < len(lengths):
        return
    coldest, warmest = (
        choice(of_plate, key=lambda certified: certified.temperature_c)
        for choice in (min, max)
    )
    for item in conditions:
        if item.get("unit") != "degC" or "plate" not in item["name"]:
            continue
        value, u = item["value"], item.get("u", 0.0)
        for used, beyond in (
            (coldest, coldest.temperature_c - value),
            (warmest, value - warmest.temperature_c),
        ):
            if beyond > 2 * math.hypot(used.u_temperature_k, u) + 1e-9:
                raise InputError(
                    "certificate",
                    f"{item['name']} is {value:g} °C, but the reference length was converted "
                    f"to {used.temperature_c:g} °C (u {used.u_temperature_k:g} K)",
                    "correct the condition, or solve again with the temperature of the "
                    "measurement in --reference-at",
                )


def is_traceable(result: CalibrationResult) -> bool:
    """Return whether certified lengths, at the temperature of the measurement, set the scale."""
    return result.reference is not None and all(
        length.certificate and length.certified and length.u_relative
        for length in result.reference.each
    )


def statement_texts(result: CalibrationResult) -> Iterator[tuple[str, list[str]]]:
    """Yield name and texts of what a certificate states of a result, for programs and people."""
    verdict = result.verdict
    yield TRACEABILITY, scale_texts(result)
    yield (
        AGREEMENT,
        [
            verdict.sentence or str(verdict.grade),
            *verdict.reasons,
            *([] if verdict.qualified else [INVALID]),
        ],
    )
    if verdict.qualified:
        yield "Uncertainty", [EXPANDED]
    yield "Scope", [SCOPE]


def method_name(result: CalibrationResult) -> str:
    """Return the name of the method."""
    of_plate, of_views = (
        "Comparison of a stage with a plate known from its calibration",
        "Self-calibration of a stage with a plate in several views",
    )
    mean = result.parts.combined
    if mean is None:
        return of_views if result.recheck is None else of_plate
    methods = {
        of_plate
        if run.calibration
        else of_views
        if run.sha256 or run.run_id
        else "Error map from another source"
        for run in mean.runs
    }
    return f"Weighted mean of {len(mean.runs)} maps: {'; '.join(sorted(methods))}"


def known_plate_texts(result: CalibrationResult) -> list[str]:
    """Return which calibrations made the plates of rechecks known; nothing of other results."""
    if result.recheck is not None:
        return [
            f"{_known_from(result.recheck.calibration)}; their uncertainty is the line 'known "
            "plate' of the budget"
        ]
    runs = result.parts.combined.runs if result.parts.combined else ()
    return [
        f"{run.file}: {_known_from(run.calibration)}" for run in runs if run.calibration
    ]


def _known_from(calibration: PlateCalibration) -> str:
    """Return which calibration the errors of the marks are from."""
    readings = calibration.readings
    dates = [
        instant[:10]
        for instant in (calibration.first_exposure, calibration.last_exposure)
        if instant
    ]
    facts = [
        f"plan {calibration.plan_id}",
        *([f"run {calibration.run_id}"] if calibration.run_id else []),
        *([f"readings of {' to '.join(dict.fromkeys(dates))}"] if dates else []),
        *(
            [f"{readings['file']}, sha256 {readings['sha256']}"]
            if {"file", "sha256"} <= readings.keys()
            else []
        ),
        *([f"evaluated {calibration.created}"] if calibration.created else []),
    ]
    return (
        f"the errors of the marks are those of a self-calibration ({'; '.join(facts)})"
    )


def scale_texts(result: CalibrationResult) -> list[str]:
    """Return what sets the scale of a map, and whether it is traceable."""
    if result.reference is None:
        why = "no reference length was used"
        if any(isinstance(finding, ScaleNotCompared) for finding in result.findings):
            why = (
                "the temperature of the known plate in this measurement was not stated"
            )
        elif result.parts.combined is not None:
            why = "the magnification of each run was removed from the mean"
        return [
            f"The scale of the map is a convention, relative to the encoders: {why}. Form, "
            "straightness and squareness do not depend on a reference."
        ]
    texts = []
    if result.recheck is not None:
        texts.append(
            "The scale is that of the known plate, set at its calibration and converted "
            "to the temperature of this measurement as follows."
        )
    mean = result.parts.combined
    if mean is not None:
        texts.append(
            "The scale is the mean of those of the runs, by their weights, each set as follows."
        )
    for length in result.reference.each:
        texts.append(
            f"The scale is set by a reference length ({length.name}): relative "
            f"error {length.relative_error:.4g}, standard uncertainty "
            f"{length.u_relative:.3g}; certificate: {length.certificate or 'none'}."
        )
        if certified := length.certified:
            texts.append(
                f"Certified at {certified.certified_at_c:g} °C: {certified.relative_error:.4g}, "
                f"standard uncertainty {certified.u_relative:.3g}; used at "
                f"{certified.temperature_c:g} °C (u {certified.u_temperature_k:g} K) with the "
                f"expansion coefficient {certified.expansion_per_k:.4g} 1/K "
                f"(u {certified.u_expansion_per_k:.2g} 1/K)."
            )
    if not is_traceable(result):
        texts.append(
            "Not traceable: this needs a certificate, its uncertainty, and the "
            "temperature of the reference (--certificate, --reference-at)"
            + (", of every run." if mean else ".")
        )
    return texts


def distance_text(stage: StageMap, a: float, b: float) -> str:
    """Return the statement U = a + b L on distances in the field, a in m and b in m/m."""
    nodes = ""
    if stage.halfway.any() or stage.edges.any():
        a_nodes, b_nodes = stage.length_uncertainty(anywhere=False)
        nodes = (
            f"; of any two nodes {a_nodes * UM_PER_M:.3g} µm + {b_nodes * UM_PER_M:.3g} µm/m "
            f"· L, without the {stage.method} interpolation between nodes"
        )
    return (
        f"U of the distance L of any two points of the field is at most {a * UM_PER_M:.3g} µm "
        f"+ {b * UM_PER_M:.3g} µm/m · L{nodes}; k = {stage.result.noise.k_xy:.3g}, 95.45 %. "
        "Errors of neighbouring nodes are correlated."
    )
