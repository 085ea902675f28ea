# SPDX-License-Identifier: Apache-2.0
"""Dataclasses as JSON and back, by their fields; verdict, model and provenance in a RESULT.json."""

import math
from dataclasses import MISSING, fields, is_dataclass
from enum import StrEnum
from functools import cache
from numbers import Integral
from types import UnionType
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

import numpy as np

from selfcal_ros.model import verdict as verdicts

REFERENCES = ("artifact", "stage_x", "stage_y", "marks")
"""Kinds of a reference length."""

_hints = cache(get_type_hints)


def plain(value: Any) -> Any:
    """Return `value` as JSON types: arrays as lists, NaN and infinities as None."""
    if isinstance(value, np.generic):  # first, as a float64 is a float
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        whole = value.dtype.kind in "fiub" and bool(np.isfinite(value).all())
        return value.tolist() if whole else plain(value.tolist())
    return value


def read(kind: Any, value: Any) -> Any:
    """Return a value from JSON as `kind`: a dataclass, a tuple of one kind, or a plain type.

    Null is NaN for a float. Keys that a dataclass has no field for are ignored.

    Raises
    ------
    ValueError, KeyError
        For a value of another type, and for a missing key whose field has no default.
    """
    inner = get_args(kind)
    if is_dataclass(kind):
        data, make = read(dict, value), cast(Any, kind)
        needed = [item.name for item in fields(kind) if item.name in data or (
            item.default is MISSING and item.default_factory is MISSING)]
        return make(**{name: read(_hints(make)[name], data[name]) for name in needed})
    if get_origin(kind) is tuple:
        return tuple(read(inner[0], item) for item in read(list, value))
    if get_origin(kind) is UnionType:  # of a kind and None
        return None if value is None else read(inner[0], value)
    if kind is float:
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise ValueError(f"{value!r} is not a number")
        return math.nan if value is None else float(value)
    kind = str if get_origin(kind) is Literal else get_origin(kind) or kind
    if issubclass(kind, StrEnum):
        return kind(value)
    wanted = Integral if kind is int else kind
    if not isinstance(value, wanted) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{value!r} is not of type {kind.__name__}")
    return value


def finding_to_dict(found: verdicts.Finding) -> dict[str, Any]:
    """Return the JSON form of a finding, or of a cause.

    Raises
    ------
    ValueError
        If it has no sentence.
    """
    if not found.text:
        raise ValueError(f"the finding '{found.name}' is not worded")
    data = {**vars(found), "mark": list(found.mark)}
    if isinstance(found, verdicts.Cause):
        data["remedies"] = [{remedy.kind: remedy.value} for remedy in found.remedies]
    return data


def findings_from_list(kind: type, data: Any) -> tuple:
    """Return findings, or causes; those of older versions have no details."""
    return tuple(read(kind, {"details": None} | found | {"remedies": [
        {"kind": name, "value": value} for remedy in found.get("remedies", [])
        for name, value in remedy.items()]}) for found in read(list, data))


def verdict_to_dict(verdict: verdicts.Verdict) -> dict[str, Any]:
    """Return the JSON form of a verdict; ValueError if it has no sentences."""
    return {"qualified": verdict.qualified, "grade": str(verdict.grade),
            "sentence": verdict.sentence, "reasons": list(verdict.reasons),
            "failed": [finding_to_dict(found) for found in verdict.failed],
            "causes": [finding_to_dict(cause) for cause in verdict.causes],
            "enlarged_by": [vars(item) for item in verdict.enlarged_by]}


def verdict_from_dict(data: dict | None, *, identifiable: bool) -> verdicts.Verdict:
    """Return the verdict of a result; without one, whether it is identified decides."""
    if data is None:
        grade = verdicts.Grade.GOOD if identifiable else verdicts.Grade.NOT_QUALIFIED
        return verdicts.Verdict(grade, sentence="Not judged: written before there were verdicts")
    qualified = read(bool, data["qualified"])
    grade = verdicts.Grade(data.get("grade", "good" if qualified else "not_qualified"))
    if qualified is (grade is verdicts.Grade.NOT_QUALIFIED):
        raise ValueError(f"the grade '{grade}' contradicts qualified {qualified}")
    return verdicts.Verdict(
        grade, findings_from_list(verdicts.Finding, data.get("failed", [])),
        findings_from_list(verdicts.Cause, data["causes"]),
        read(tuple[verdicts.Enlargement, ...], data.get("enlarged_by", [])),
        read(str, data["sentence"]), read(tuple[str, ...], data["reasons"]))


def line_to_dict(line: verdicts.BudgetLine) -> dict[str, Any]:
    """Return the JSON form of a line of the budget."""
    return {"type" if name == "kind" else name: value for name, value in vars(line).items()}


def budget_from_list(rows: Any) -> tuple[verdicts.BudgetLine, ...]:
    """Return the lines of a budget; none of those of files that have other columns."""
    return tuple(
        read(verdicts.BudgetLine, row | {"dof": math.inf if row["dof"] is None else row["dof"],
                                  "kind": row["type"]})
        for row in read(list, rows) if "effect_rms" in read(dict, row))


def provenance_from_dict(data: dict | None) -> verdicts.Provenance:
    """Return the provenance of a result, as far as known."""
    known = ("created", "duration_s", "version")
    return verdicts.Provenance() if data is None else read(verdicts.Provenance, data | {
        "extra": {key: value for key, value in data.items() if key not in known}})


def reference_from_dict(raw: Any) -> dict[str, Any] | None:
    """Return the reference length of a result; ValueError if invalid."""
    if raw is None:
        return None
    if read(dict, raw)["kind"] not in REFERENCES:
        raise ValueError(f"the reference {raw['kind']!r} is unknown")
    error, u = read(float, raw["relative_error"]), read(float, raw["u_relative"])
    if not (abs(error) < 0.1 and 0 <= u < 0.1):
        raise ValueError(f"reference: {error!r} with u {u!r} is not a relative error")
    read(str, raw.get("certificate") or "")
    for value in read(dict, raw.get("certified") or {}).values():
        read(float, value)
    marks = [read(tuple[int, ...], mark) for mark in read(list, raw.get("marks") or [])]
    if (raw["kind"] == "marks") != (len(set(marks)) == 2 == len(marks[0]) == len(marks[1])):
        raise ValueError(f"reference: the marks {marks} do not fit the kind {raw['kind']!r}")
    return raw


def reference_name(reference: dict[str, Any]) -> str:
    """Return what was certified: the kind of a reference length, or its marks."""
    if reference["kind"] != "marks":
        return str(reference["kind"])
    return "distance of the marks {} and {}".format(*map(tuple, reference["marks"]))
