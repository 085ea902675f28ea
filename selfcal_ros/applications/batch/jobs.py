# SPDX-License-Identifier: Apache-2.0
"""One bag of a batch: solved, and stored by its content and settings.

The key of a record is a digest of the bag's content and of everything that affects the result, so
that a batch that was interrupted, moved or enlarged does only new work.
"""

import hashlib
import math
import os
from pathlib import Path

from selfcal_ros.applications.batch import folder
from selfcal_ros.applications.papers.methods import calibrate_by
from selfcal_ros.bagio.offline import bag_input, collect_bag
from selfcal_ros.collection.reduce import with_collected
from selfcal_ros.errors import ExitCode, NotIdentifiableError, SelfcalError
from selfcal_ros.estimation.comparison.covariance import first_order_u
from selfcal_ros.model import result as results
from selfcal_ros.model.findings import finding_to_dict
from selfcal_ros.outputs import plain, write_json
from selfcal_ros.reporting.summary.numbers import summary_numbers
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.reporting.words.observability import with_advice
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.units import ARCSEC_PER_RAD, PPM_PER_ONE, UM_PER_M


def run_job(job: folder.BatchJob) -> folder.Record:
    """Return the record of a bag: the existing one if allowed, or that of a new solution.

    An unusable bag has a record, too, with the exit code and the line of `selfcal
    solve`. Nothing is stored if its content cannot be read at all.

    Raises
    ------
    InputError
        If the folder of the batch cannot be written.
    """
    record: folder.Record = {
        "schema": folder.SCHEMA,
        "bag": os.path.realpath(job.bag),
        "settings": job.settings.digest(),
    }
    try:
        source = bag_input(job.bag)
        record["files"] = folder.stat_of(job.bag)
    except SelfcalError as error:
        return record | _without_result(error)
    key = hashlib.sha256(
        f"{source['sha256']} {record['settings']}".encode()
    ).hexdigest()[:24]
    path = job.folder / folder.RECORDS / f"{key}.json"
    existing = None if job.redo else folder.read_record(path)
    if existing is not None and folder.is_whole(job.folder, existing):
        if not Path(existing["bag"]).exists():  # it was moved
            write_json(path, existing | record)
        return existing | record
    record |= {"key": key, "sha256": source["sha256"]}
    result: results.CalibrationResult | None = None
    try:
        result, problem = solved(job, source)
        record |= _with_result(result) if problem is None else _without_result(problem)
    except SelfcalError as error:
        record |= _without_result(error)
    if result is not None:
        record["result"] = f"{folder.RESULTS}/{key}.json"
        data = results.result_to_dict(results.created_now(result))
        write_json(job.folder / record["result"], data)
    write_json(path, record)
    return record


def solved(
    job: folder.BatchJob, source: dict[str, str]
) -> tuple[results.CalibrationResult, NotIdentifiableError | None]:
    """Return the result of a bag, as from `selfcal solve`, and the reason if it has no map."""
    settings = job.settings
    session = collect_bag(job.bag, settings.collector, namespace=settings.namespace)
    options = solver_options(settings.solver, session.measurements)
    problem = None
    try:
        calibrated = calibrate_by(settings.solver.method, session.measurements, options)
        result = worded(with_collected(calibrated, session.measurements.views))
    except NotIdentifiableError as error:
        if not isinstance(error.observability, results.Observability):
            raise
        result = worded(
            results.unidentified_result(session.measurements, error.observability)
        )
        problem = with_advice(error)
    return results.with_input(result, source, session.lost), problem


def _without_result(error: SelfcalError) -> folder.Record:
    return {"exit_code": int(error.exit_code), "message": str(error), "qualified": None}


def _with_result(result: results.CalibrationResult) -> folder.Record:
    good = result.verdict.qualified
    artifact = result.artifact
    return {
        "exit_code": int(ExitCode.DONE if good else ExitCode.NOT_QUALIFIED),
        "qualified": good,
        "grade": str(result.verdict.grade),
        "causes": plain([finding_to_dict(cause) for cause in result.verdict.causes]),
        "message": result.verdict.sentence,
        "plan_id": result.plan_id,
        "run_id": result.run_id,
        "plate": [*artifact.shape, artifact.grid_pitch_m, artifact.angular_count],
        "first_exposure": result.provenance.first_exposure or None,
        "quantities": quantities(result),
    }


def quantities(result: results.CalibrationResult) -> dict[str, float | None]:
    """Return name -> value; the unit is the end of the name, None = unknown.

    Terms of the model shared by all views are included by their components, in SI units.
    """
    emap, noise = result.error_map, result.noise
    u_o, u_r = first_order_u(result) if result.has_uncertainty else (math.nan, math.nan)
    used = sum(view.used for view in result.views)
    rejected = sum(result.rejected.values())
    values = {
        "nonorthogonality_arcsec": emap.nonorthogonality * ARCSEC_PER_RAD,
        "u_nonorthogonality_arcsec": u_o * ARCSEC_PER_RAD,
        "scale_difference_ppm": emap.scale_difference * PPM_PER_ONE,
        "u_scale_difference_ppm": u_r * PPM_PER_ONE,
        **summary_numbers(result),
        "sigma_xy_um": noise.sigma_xy * UM_PER_M,
        "sigma_theta_arcsec": noise.sigma_theta * ARCSEC_PER_RAD,
        "rejected_percent": 100 * rejected / (used + rejected)
        if used + rejected
        else math.nan,
    }
    for term in result.model.terms:
        for estimate in term.estimates:
            if not estimate.view:
                unit = estimate.unit.replace("/", folder.PER)
                values[f"{term.name}_{estimate.component}_{unit}".replace(" ", "_")] = (
                    estimate.value
                )
    return {
        name: value if math.isfinite(value) else None for name, value in values.items()
    }
