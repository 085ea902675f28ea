# SPDX-License-Identifier: Apache-2.0
"""From the settings of the solver to the options of the estimator."""

from selfcal_ros.collection.settings.nodes import NO_TERMS, UNCERTAINTY, SolverSettings
from selfcal_ros.collection.settings.plans import calibration_of
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.options import Options, ReferenceKind, ReferenceLength
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import DEFAULT_TERMS, ModelTerm, microscope_term, parse_terms


def solver_options(settings: SolverSettings, measurements: Measurements | None = None, *,
                   plate_from: str = "") -> Options:
    """Return the estimator's options in a solver's settings.

    If `model_terms` is empty, the terms in the plan of the `measurements` are used; if `plate_from`
    is, the calibration of the plate that the plan names.

    Raises
    ------
    InputError
        For invalid terms, or if there is no result of the plate's calibration.
    """
    plate_from = plate_from or (measurements.artifact_from if measurements is not None else "")
    kind = settings.reference_kind
    reference = None if kind == "none" else ReferenceLength(
        ReferenceKind(kind), settings.reference_error, settings.reference_u,
        settings.reference_certificate)
    if reference and settings.reference_at:
        reference = reference.at_temperature(settings.reference_at)
    terms, origin = _terms(settings.model_terms, measurements)
    assumed = _assumed(settings)
    return Options(method=settings.method, datum_theta=ThetaDatum(settings.theta_datum),
                   misalignment_model="" if settings.method == "law" else
                   settings.misalignment_model, reference=reference,
                   uncertainty=UNCERTAINTY[settings.uncertainty],
                   terms=terms, terms_from=origin if terms else "", assumed=assumed,
                   drift_degree=settings.drift_degree, plate_from=plate_from,
                   plate=calibration_of(plate_from) if plate_from else None,
                   magnification_limit=settings.magnification_limit)


def _terms(given: list[str],
           measurements: Measurements | None) -> tuple[tuple[ModelTerm, ...], str]:
    """Return the terms of the model, and where they come from: ``options`` or ``plan``."""
    words = [word for text in given for part in text.split(",") if (word := part.strip())]
    if words == [NO_TERMS]:
        return (), ""
    if NO_TERMS in words:
        raise InputError("model_terms", f"'{NO_TERMS}' and other terms exclude each other",
                         f"leave out '{NO_TERMS}', or all the others")
    planned: tuple[ModelTerm, ...] = ()
    if measurements is not None:
        planned = parse_terms(measurements.model_terms,
                              f"plan '{measurements.plan_id}': model_terms")
    if not words and measurements is not None:
        return planned, "plan"
    terms = parse_terms(given, "model_terms")
    # the microscope's uncertainty in the plan is no choice of a model
    known = [term for term in planned if term.parts and term.name not in {t.name for t in terms}]
    return (*terms, *known), "options"


def _assumed(settings: SolverSettings) -> tuple[ModelTerm, ...]:
    """Return the terms assumed if neither options nor plan name them."""
    if [word.strip() for word in settings.model_terms] == [NO_TERMS]:
        return ()
    microscope = microscope_term(settings.scale_u, settings.rotation_u, settings.shear_u)
    return tuple(microscope if term.name == microscope.name else term for term in DEFAULT_TERMS)
