# SPDX-License-Identifier: Apache-2.0
"""DETAILS.yaml: what a certificate states that no reading tells."""

import math
import re
from collections.abc import Callable
from datetime import date
from typing import Any

from selfcal_ros.errors import InputError, known_are
from selfcal_ros.files import read_yaml
from selfcal_ros.model.reference import check_celsius
from selfcal_ros.plain_numbers import number_of

PLACES = ("laboratory", "customer", "laboratoryBranch", "customerBranch", "other")
"""Places of a calibration that the schema knows."""
UNITS = {
    "degC": r"\degreecelsius",
    "%": r"\percent",
    "hPa": r"\hecto\pascal",
    "K": r"\kelvin",
    "K/h": r"\kelvin\hour\tothe{-1}",
    "m/s": r"\metre\second\tothe{-1}",
}
"""Units of conditions -> D-SI."""


def _text(value: Any) -> str | None:
    """Return the text that a schema without empty strings accepts; None if there is none."""
    words = " ".join(str(value).split()) if isinstance(value, str | int | float) else ""
    return None if isinstance(value, bool) or not words else words


def _code(pattern: str) -> Callable[[Any], str | None]:
    return lambda value: (
        value if isinstance(value, str) and re.fullmatch(pattern, value) else None
    )


def _date(value: Any) -> str | None:
    try:
        return str(
            value if isinstance(value, date) else date.fromisoformat(str(value))
        )[:10]
    except ValueError:
        return None


def _number(value: Any) -> float | None:
    try:
        number = math.nan if isinstance(value, bool) else number_of(str(value))
    except (TypeError, ValueError):
        return None
    return number if abs(number) < 1e9 else None


def _choice(*names: str) -> Callable[[Any], str | None]:
    return lambda value: value if value in names else None


Kind = tuple[Callable[[Any], Any], str]
"""Reader of a value, None if it is invalid, and what it expects."""
TEXT: Kind = (_text, "a text")
DATE: Kind = (_date, "a date YYYY-MM-DD")
COUNTRY: Kind = (_code("[A-Z]{2}"), "a country code of two capitals, e.g. DE")
LANGUAGE: Kind = (_code("[a-z]{2}"), "a language code of two letters, e.g. en")
NUMBER: Kind = (_number, "a number")
_ADDRESS: dict[str, Kind] = {
    "name": TEXT,
    "city": TEXT,
    "country": COUNTRY,
    "street": TEXT,
    "number": TEXT,
    "post_code": TEXT,
    "email": TEXT,
    "phone": TEXT,
}
_THING: dict[str, Kind] = {
    "name": TEXT,
    "manufacturer": TEXT,
    "model": TEXT,
    "serial_number": TEXT,
    "certificate": TEXT,
}
SECTIONS: dict[str, tuple[dict[str, Kind], tuple[str, ...]]] = {
    "certificate": (
        {
            "id": TEXT,
            "country": COUNTRY,
            "language": LANGUAGE,
            "place": (_choice(*PLACES), "one of " + ", ".join(PLACES)),
            "begin": DATE,
            "end": DATE,
            "issued": DATE,
            "order": TEXT,
            "clock": TEXT,
        },
        ("id", "country", "language", "place", "begin", "end"),
    ),
    "laboratory": ({**_ADDRESS, "code": TEXT}, ("name", "city", "country")),
    "customer": (_ADDRESS, ("name", "city", "country")),
    "item": (_THING, ("name", "serial_number")),
    "persons": ({"name": TEXT, "role": TEXT}, ("name",)),
    "conditions": (
        {
            "name": TEXT,
            "value": NUMBER,
            "u": NUMBER,
            "unit": (_choice(*UNITS), "one of " + ", ".join(UNITS)),
            "text": TEXT,
        },
        ("name",),
    ),
    "equipment": ({**_THING, "valid_until": DATE}, ("name",)),
    "remarks": ({"text": TEXT}, ("text",)),
}
"""Section -> its keys, and those that must be there."""
LISTS = ("persons", "conditions", "equipment", "remarks")
"""Sections that are lists of such entries."""
NEEDED = ("certificate", "laboratory", "customer", "item", "persons", "conditions")
"""Sections that must be there; a list has one entry at least."""


def read_details(path: str) -> dict[str, Any]:
    """Return the details of a certificate in DETAILS.yaml, as `details_from_dict`."""
    return details_from_dict(read_yaml(path, as_written=True), path)


def details_from_dict(data: Any, where: str) -> dict[str, Any]:
    """Return the details of a certificate, checked: section -> {key: value}, or a list of these.

    Parameters
    ----------
    data : object
        Content of DETAILS.yaml.
    where : str
        File name, for messages.

    Raises
    ------
    InputError
        If a key is missing or unknown, or a value is invalid.
    """
    if not isinstance(data, dict):
        raise InputError(
            where,
            "not the details of a certificate",
            f"give the sections {', '.join(NEEDED)}",
        )
    for name in data:
        if name not in SECTIONS:
            raise InputError(
                f"{where}: {name}", "is unknown", known_are(str(name), SECTIONS)
            )
    details: dict[str, Any] = {}
    for name in SECTIONS:
        if not data.get(name):
            if name in NEEDED:
                raise InputError(
                    f"{where}: {name}",
                    "is missing",
                    "give " + ", ".join(SECTIONS[name][1]),
                )
            details[name] = []
        elif name in LISTS:
            items = data[name] if isinstance(data[name], list) else [data[name]]
            details[name] = [
                _section(item, name, f"{where}: {name}[{index}]")
                for index, item in enumerate(items)
            ]
        else:
            details[name] = _section(data[name], name, f"{where}: {name}")
    for index, item in enumerate(details["conditions"]):
        if (
            ("value" in item) is not ("unit" in item)
            or not ("value" in item or "text" in item)
            or (item.get("u", 1.0) <= 0)
        ):
            raise InputError(
                f"{where}: conditions[{index}]",
                "neither a value with its unit nor a text",
                "give value, u and unit, or text",
            )
        if item.get("unit") == "degC":
            check_celsius(item["value"], f"{where}: conditions[{index}]")
    _check_dates(details, where)
    return details


def _check_dates(details: dict[str, Any], where: str) -> None:
    """Refuse dates that are not in their order; the day of issue is today unless it is given."""
    core = details["certificate"]
    if core["begin"] > core["end"]:
        raise InputError(
            f"{where}: certificate.end",
            f"{core['end']} is before {core['begin']}",
            "exchange begin and end",
        )
    issued = core.setdefault("issued", date.today().isoformat())
    if issued < core["end"]:
        raise InputError(
            f"{where}: certificate.issued",
            f"{issued} is before the end of the measurement, {core['end']}",
            "correct the dates",
        )
    for index, item in enumerate(details["equipment"]):
        if item.get("valid_until", issued) < core["end"]:
            raise InputError(
                f"{where}: equipment[{index}].valid_until",
                f"{item['valid_until']} is before the end of the measurement, {core['end']}",
                "measure with equipment whose certificate is valid",
            )


def _section(data: Any, name: str, where: str) -> dict[str, Any]:
    keys, needed = SECTIONS[name]
    if not isinstance(data, dict):
        raise InputError(where, f"{data!r} has no keys", f"give {', '.join(needed)}")
    for key in data:
        if key not in keys:
            raise InputError(f"{where}.{key}", "is unknown", known_are(str(key), keys))
    section = {}
    for key, (reader, expected) in keys.items():
        if data.get(key) is None:
            if key in needed:
                raise InputError(f"{where}.{key}", "is missing", f"give {expected}")
            continue
        section[key] = reader(data[key])
        if section[key] is None:
            raise InputError(
                f"{where}.{key}", f"{data[key]!r} is not {expected}", "correct it"
            )
    return section
