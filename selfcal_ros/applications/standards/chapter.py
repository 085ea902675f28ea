# SPDX-License-Identifier: Apache-2.0
"""The chapter of a report that has what a certificate states, for people."""

from typing import Any

from selfcal_ros.applications.standards.statements import (
    distance_text,
    require_certifiable,
    statement_texts,
)
from selfcal_ros.apply import StageMap
from selfcal_ros.errors import InputError
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.chapters import Chapter
from selfcal_ros.reporting.summary.sections import Section


def certificate_chapter(result: CalibrationResult, details: dict[str, Any]) -> Chapter:
    """Return the details of a certificate, its traceability, and U of distances.

    Parameters
    ----------
    result : CalibrationResult
        A calibration that identifies the stage.
    details : dict
        As `selfcal_ros.applications.standards.details.details_from_dict` gives it.

    Raises
    ------
    InputError
        As `require_certifiable`.
    """
    require_certifiable(result, details)
    sections = [
        _facts(title, details[name])
        for title, name in (
            ("Certificate", "certificate"),
            ("Laboratory", "laboratory"),
            ("Customer", "customer"),
            ("Item", "item"),
        )
    ]
    sections += [
        _table(title, details[name])
        for title, name in (
            ("Persons", "persons"),
            ("Conditions, u with k=1", "conditions"),
            ("Equipment", "equipment"),
        )
    ]
    try:
        stage = StageMap(result)
        distance = distance_text(stage, *stage.length_uncertainty())
    except InputError as error:
        distance = f"the correlations between nodes are not known ({error.what})"
    sections += [
        *(Section(name, notes=tuple(texts)) for name, texts in statement_texts(result)),
        Section("Uncertainty of distances", notes=(distance,)),
        Section("Remarks", notes=tuple(item["text"] for item in details["remarks"])),
    ]
    return Chapter("Certificate", sections=tuple(sections))


def certified(details: dict[str, Any]) -> dict[str, str]:
    """Return what the head of a certificate states, on its first page."""
    laboratory, customer, item = (
        details[name] for name in ("laboratory", "customer", "item")
    )
    persons = (
        person["name"] + (f" ({person['role']})" if "role" in person else "")
        for person in details["persons"]
    )
    return {
        "certificate": details["certificate"]["id"],
        "issued": details["certificate"]["issued"],
        "laboratory": _addressed(laboratory),
        "customer": _addressed(customer),
        "stage": " ".join(
            item[key] for key in ("manufacturer", "name", "model") if key in item
        ),
        "serial_number": item["serial_number"],
        "operator": ", ".join(persons),
    }


def _addressed(party: dict[str, Any]) -> str:
    return ", ".join(party[key] for key in ("name", "city", "country") if key in party)


def _facts(title: str, facts: dict[str, Any]) -> Section:
    return Section(
        title,
        tuple((key.replace("_", " "), str(value)) for key, value in facts.items()),
    )


def _table(title: str, rows: list[dict[str, Any]]) -> Section:
    keys = tuple(dict.fromkeys(key for row in rows for key in row))
    return Section(
        title,
        table=(
            tuple(key.replace("_", " ") for key in keys),
            *(tuple(str(row.get(key, "")) for key in keys) for row in rows),
        )
        if rows
        else (),
    )
