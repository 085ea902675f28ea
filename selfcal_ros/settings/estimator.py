# SPDX-License-Identifier: Apache-2.0
"""Plans and results from files, and the estimator's options from the settings of the solver."""

from pathlib import Path
from typing import Any

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.options import Options
from selfcal_ros.files import csv_rows, read_text, read_yaml
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.marks import marks_of
from selfcal_ros.model.plan_form import plan_from_dict, plan_to_dict
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.reference import ReferenceKind, ReferenceLength
from selfcal_ros.model.terms import (
    ModelTerm,
    default_terms,
    in_order,
    merged,
    microscope_term,
    parse_terms,
)
from selfcal_ros.model.view import Plan
from selfcal_ros.plain_numbers import number_of
from selfcal_ros.results import read_result
from selfcal_ros.settings.nodes import NO_TERMS, UNCERTAINTY, SolverSettings

MOST_BYTES = 4_000_000
"""Largest file with a list of marks."""
_KIND = {"id": "whole number", "x": "number", "y": "number"}


def read_plan(path: str | Path) -> Plan:
    """Return the plan in a PLAN.yaml.

    Raises
    ------
    InputError
        If it is none, or the result in ``artifact_from`` cannot be read.
    """
    return plan_of(read_yaml(path), str(path), Path(path).parent)


def plan_of(data: object, where: str, folder: Path) -> Plan:
    """Return the plan in a mapping; a known plate need not be described again.

    Parameters
    ----------
    data : object
        As `plan_from_dict` has it; ``artifact`` and ``map`` are those of the result in
        ``artifact_from`` or ``verify`` unless they are given, and ``marks`` may be the name of a
        CSV.
    where : str
        File name, for messages.
    folder : Path
        Folder in which relative names of results begin.
    """
    data = _with_marks(data, where, folder)
    sources = {
        key: str((folder / data[key]).resolve())
        for key in ("artifact_from", "verify")
        if isinstance(data, dict) and isinstance(data.get(key), str)
    }
    if not sources or not isinstance(data, dict):
        return plan_from_dict(data, where)
    result_plan = (
        {}
        if "artifact" in data
        else plan_to_dict(Plan("", read_result(next(iter(sources.values()))).plate, ()))
    )
    plate = {key: result_plan[key] for key in ("artifact", "map") if key in result_plan}
    return plan_from_dict(plate | data | sources, where)


def _with_marks(data: object, where: str, folder: Path) -> object:
    """Return the mapping of a plan with its list of marks in place of the name of the file."""
    plate = data.get("artifact") if isinstance(data, dict) else None
    if (
        not isinstance(data, dict)
        or not isinstance(plate, dict)
        or not isinstance(plate.get("marks"), str)
    ):
        return data
    for key in ("grid_size", "grid_pitch"):
        if key in plate:
            raise InputError(
                f"{where}: artifact",
                f"marks and {key} are both given",
                "leave one of them out",
            )
    path = folder / plate["marks"]
    return data | {
        "artifact": plate | {"marks": _marks_in(read_text(path, MOST_BYTES), str(path))}
    }


def _marks_in(text: str, where: str) -> dict[str, list[Any]]:
    """Return the columns id, x and y of a list of marks, m."""
    rows = csv_rows(text, where)
    head = [cell.lower().removesuffix("_m") for cell in rows[0][1]] if rows else []
    missing = [name for name in ("id", "x", "y") if name not in head]
    if missing:
        raise InputError(
            f"{where}:1",
            f"no column {', '.join(missing)}",
            "begin with the line id,x,y (x and y in m)",
        )
    twice = [name for name in ("id", "x", "y") if head.count(name) > 1]
    if twice:
        raise InputError(
            f"{where}:1", f"two columns {twice[0]}", "leave the right one of them"
        )
    columns: dict[str, list[Any]] = {"id": [], "x": [], "y": []}
    for place, cells in rows[1:]:
        if len(cells) != len(head):
            raise InputError(
                place, f"{len(cells)} cells, not {len(head)}", "correct the line"
            )
        for name, values in columns.items():
            cell = cells[head.index(name)]
            try:
                value = number_of(cell)
                values.append(int(cell) if name == "id" else value)
            except ValueError:
                raise InputError(
                    place, f"{name} '{cell}' is not a {_KIND[name]}", "correct the line"
                ) from None
    marks_of(
        columns["id"],
        columns["x"],
        columns["y"],
        where=[place for place, _ in rows[1:]],
    )
    return columns


def solver_options(
    settings: SolverSettings,
    measurements: Measurements | None = None,
    *,
    plate_from: str = "",
) -> Options:
    """Return the estimator's options in a solver's settings.

    The terms of `model_terms` replace the same ones in the plan of the `measurements`; if
    `plate_from` is empty, the calibration that the plan names is used: the one it verifies, or that
    of the plate.

    Raises
    ------
    InputError
        For invalid terms, or if there is no result of the plate's calibration.
    """
    if measurements is not None:
        plate_from = plate_from or measurements.verify or measurements.artifact_from
    if plate_from and settings.method == "law":
        raise InputError(
            "method law",
            f"the plate is known from {plate_from}, and Hu's law cannot use that",
            "leave the method out",
        )
    reference = _reference(settings, measurements)
    terms, origin = _terms(settings.model_terms, measurements)
    assumed = _assumed(settings)
    return Options(
        datum_theta=ThetaDatum(settings.theta_datum),
        misalignment_model=settings.misalignment_model,
        reference=reference,
        uncertainty=UNCERTAINTY[settings.uncertainty],
        terms=terms,
        terms_from=origin if terms else "",
        assumed=assumed,
        drift_degree=settings.drift_degree,
        plate_from=plate_from,
        plate=read_result(plate_from) if plate_from else None,
        plate_at=settings.reference_at if plate_from else "",
        magnification_limit=settings.magnification_limit,
        robust=settings.robust,
    )


def _reference(
    settings: SolverSettings, measurements: Measurements | None
) -> ReferenceLength | None:
    """Return the reference length; None if there is none, or that of marks of no plate."""
    kind, marks = settings.reference_kind, settings.reference_marks
    if bool(marks) != (kind == ReferenceKind.MARKS):
        raise InputError(
            "reference_marks",
            f"'{marks}' does not fit reference_kind '{kind}'",
            "give M,N:M,N:LENGTH:U with the kind 'marks', and only then",
        )
    if kind == "none" or (marks and measurements is None):
        return None
    reference = (
        ReferenceLength.between(
            marks, measurements.artifact, settings.reference_certificate
        )
        if marks and measurements
        else ReferenceLength(
            ReferenceKind(kind),
            settings.reference_error,
            settings.reference_u,
            settings.reference_certificate,
        )
    )
    return (
        reference.at_temperature(settings.reference_at)
        if settings.reference_at
        else reference
    )


def _terms(
    entries: list[str], measurements: Measurements | None
) -> tuple[tuple[ModelTerm, ...], str]:
    """Return the terms of the model, and where they come from: ``options`` or ``plan``."""
    words = [
        word for text in entries for item in text.split(",") if (word := item.strip())
    ]
    if words == [NO_TERMS]:
        return (), ""
    if NO_TERMS in words:
        raise InputError(
            "model_terms",
            f"'{NO_TERMS}' and other terms exclude each other",
            f"leave out '{NO_TERMS}', or all the others",
        )
    planned: tuple[ModelTerm, ...] = ()
    if measurements is not None:
        planned = parse_terms(
            measurements.model_terms, f"plan '{measurements.plan_id}': model_terms"
        )
    if not words and measurements is not None:
        return planned, "plan"
    # what the plan declares of other terms holds all the same
    return in_order(merged(planned, parse_terms(entries, "model_terms"))), "options"


def _assumed(settings: SolverSettings) -> tuple[ModelTerm, ...]:
    """Return the terms assumed if neither options nor plan name them."""
    if [word.strip() for word in settings.model_terms] == [NO_TERMS]:
        return ()
    declared = microscope_term(settings.scale_u, settings.rotation_u, settings.shear_u)
    return tuple(
        declared if term.name == declared.name else term for term in default_terms()
    )
