# SPDX-License-Identifier: Apache-2.0
"""Verdict, model and provenance in a RESULT.json; older results have none of them."""

import math
from typing import Any

from selfcal_ros.model.verdict import (
    BudgetLine,
    Cause,
    Enlargement,
    Finding,
    Grade,
    ModelResult,
    Provenance,
    Remedy,
    TermEstimate,
    TermResult,
    Verdict,
)

REFERENCES = ("artifact", "stage_x", "stage_y")
"""Kinds of a reference length."""


def finding_to_dict(found: Finding) -> dict[str, Any]:
    """Return the JSON form of a finding, or of a cause.

    Raises
    ------
    ValueError
        If it has no text: call `selfcal_ros.reporting.words.findings.worded` on the result first.
    """
    if not found.text:
        raise ValueError(f"the finding '{found.name}' is not worded")
    data = {**vars(found), "mark": list(found.mark)}
    if isinstance(found, Cause):
        data["remedies"] = [{remedy.kind: remedy.value} for remedy in found.remedies]
    return data


def finding_from_dict(data: dict) -> Finding:
    """Return a finding; files of older versions have no details."""
    return Finding(**_finding(data))


def _finding(data: dict) -> dict[str, Any]:
    details = data.get("details")
    if not isinstance(details, dict | None):
        raise ValueError(f"{details!r} are no details")
    return {**{key: _text(data[key]) for key in ("name", "text", "unit")},
            **{key: _text(data.get(key, "")) for key in ("view", "axis")},
            **{key: _number(data[key]) for key in ("size", "u", "p")},
            "mark": tuple(map(int, data.get("mark", ()))), "details": details}


def _cause(data: dict) -> Cause:
    return Cause(**_finding(data), effect_rms=_number(data.get("effect_rms")),
                 effect_max=_number(data.get("effect_max")), told=bool(data.get("told", True)),
                 remedies=tuple(Remedy(kind, _text(value)) for remedy in data.get("remedies", [])
                                for kind, value in remedy.items()))


def verdict_to_dict(verdict: Verdict) -> dict[str, Any]:
    """Return the JSON form of a verdict; ValueError if it has no sentences."""
    return {"qualified": verdict.qualified, "grade": str(verdict.grade),
            "sentence": verdict.sentence, "reasons": list(verdict.reasons),
            "failed": [finding_to_dict(found) for found in verdict.failed],
            "causes": [finding_to_dict(cause) for cause in verdict.causes],
            "enlarged_by": [vars(item) for item in verdict.enlarged_by]}


def verdict_from_dict(data: dict | None, *, identifiable: bool) -> Verdict:
    """Return the verdict of a result; without one, whether it is identified decides."""
    if data is None:
        return Verdict(Grade.GOOD if identifiable else Grade.NOT_QUALIFIED,
                       sentence="Not judged: written before there were verdicts")
    if not isinstance(data["qualified"], bool):
        raise ValueError(f"qualified is {data['qualified']!r}, not true or false")
    grade = Grade(data.get("grade", "good" if data["qualified"] else "not_qualified"))
    if data["qualified"] is (grade is Grade.NOT_QUALIFIED):
        raise ValueError(f"the grade '{grade}' contradicts qualified {data['qualified']}")
    return Verdict(
        grade, tuple(map(finding_from_dict, data.get("failed", []))),
        tuple(map(_cause, data["causes"])),
        tuple(Enlargement(_text(e["name"]), _number(e["u_rms"]), _number(e["u_max"]),
                          _text(e["unit"])) for e in data.get("enlarged_by", [])),
        _text(data["sentence"]), tuple(map(_text, data["reasons"])))


def line_to_dict(line: BudgetLine) -> dict[str, Any]:
    """Return the JSON form of a line of the budget."""
    data = dict(vars(line))
    return {"quantity": data.pop("quantity"), "component": data.pop("component"),
            "type": data.pop("kind"), **data}


def budget_from_dict(rows: Any) -> tuple[BudgetLine, ...]:
    """Return the lines of a budget; none of those of files that have other columns."""
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError(f"{rows!r} is not a list of lines of a budget")
    return tuple(_line(row) for row in rows if "effect_rms" in row)


def _line(row: dict) -> BudgetLine:
    dof = row["dof"]
    if not isinstance(row["details"], dict):
        raise ValueError(f"{row['details']!r} are no details")
    quantity, component, kind, unit, source, text = (
        _text(row[key]) for key in ("quantity", "component", "type", "unit", "source", "text"))
    value, u, effect_rms, effect_max = (
        _number(row[key]) for key in ("value", "u", "effect_rms", "effect_max"))
    return BudgetLine(quantity, component, kind, value, u, unit, effect_rms, effect_max,
                      math.inf if dof is None else _number(dof), source, row["details"], text)


def model_to_dict(model: ModelResult) -> dict[str, Any]:
    """Return the JSON form of the model behind a map."""
    return {"misalignment": model.misalignment, "terms": [
        {"name": term.name, "size": term.size,
         "estimates": [vars(estimate) for estimate in term.estimates],
         "size_used": term.size_used, "source": term.source} for term in model.terms]}


def model_from_dict(data: dict | None) -> ModelResult:
    """Return the model behind a map; older results were linear, without terms."""
    if data is None:
        return ModelResult()
    return ModelResult(_text(data["misalignment"]), tuple(
        TermResult(_text(term["name"]), None if term["size"] is None else _number(term["size"]),
                   tuple(TermEstimate(_text(e["view"]), _text(e["component"]), _number(e["value"]),
                                      _number(e["u"]), _text(e["unit"]))
                         for e in term["estimates"]),
                   None if term.get("size_used") is None else _number(term["size_used"]),
                   _text(term.get("source", "declared")))
        for term in data["terms"]))


def provenance_to_dict(provenance: Provenance) -> dict[str, Any]:
    """Return the JSON form of a provenance."""
    return {"created": provenance.created, "duration_s": provenance.duration_s,
            "version": provenance.version, **provenance.extra}


def provenance_from_dict(data: dict | None) -> Provenance:
    """Return the provenance of a result, as far as known."""
    if data is None:
        return Provenance()
    known = ("created", "duration_s", "version")
    return Provenance(_text(data["created"]), _number(data["duration_s"]), _text(data["version"]),
                      {key: value for key, value in data.items() if key not in known})


def reference_from_dict(raw: Any) -> dict[str, Any] | None:
    """Return the reference length of a result; ValueError if invalid."""
    if raw is None:
        return None
    if not isinstance(raw, dict):
        raise ValueError(f"{raw!r} is not a reference")
    if raw["kind"] not in REFERENCES:
        raise ValueError(f"the reference {raw['kind']!r} is unknown")
    error, u = _number(raw["relative_error"]), _number(raw["u_relative"])
    if not (abs(error) < 0.1 and 0 <= u < 0.1):
        raise ValueError(f"reference: {error!r} with u {u!r} is not a relative error")
    _text(raw.get("certificate") or "")
    return raw


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} is not text")
    return value


def _number(value: Any) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} is not a number")
    return float(value)
