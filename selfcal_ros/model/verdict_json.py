# SPDX-License-Identifier: Apache-2.0
"""Verdict, model and provenance in a RESULT.json; older results have none of them."""

from typing import Any

from selfcal_ros.model.verdict import (
    Cause,
    ModelResult,
    Provenance,
    TermEstimate,
    TermResult,
    Verdict,
)

NAN = float("nan")


def verdict_to_dict(verdict: Verdict) -> dict[str, Any]:
    """Return the JSON form of a verdict, which is worded.

    Raises
    ------
    ValueError
        If it is not: give the result to `selfcal_ros.reporting.words.result.worded` first.
    """
    if verdict.findings:
        raise ValueError(f"{len(verdict.findings)} findings of the verdict are not worded")
    return {"qualified": verdict.qualified, "sentence": verdict.sentence,
            "reasons": list(verdict.reasons), "causes": [
                {"name": c.name, "text": c.text, "size": c.size, "u": c.u, "unit": c.unit,
                 "p": c.p} for c in verdict.causes]}


def verdict_from_dict(data: dict | None, *, identifiable: bool) -> Verdict:
    """Return the verdict of a result; one without a verdict counts as identified or not."""
    if data is None:
        return Verdict(identifiable, "Not judged: written before verdicts were")
    causes = tuple(Cause(_text(c["name"]), _text(c["text"]), _number(c["size"]), _number(c["u"]),
                         _text(c["unit"]), _number(c["p"])) for c in data["causes"])
    if not isinstance(data["qualified"], bool):
        raise ValueError(f"qualified is {data['qualified']!r}, not true or false")
    return Verdict(data["qualified"], _text(data["sentence"]),
                   tuple(_text(reason) for reason in data["reasons"]), causes)


def model_to_dict(model: ModelResult) -> dict[str, Any]:
    """Return the JSON form of the model behind a map."""
    return {"misalignment": model.misalignment, "terms": [
        {"name": term.name, "size": term.size,
         "estimates": [vars(estimate) for estimate in term.estimates],
         "size_used": term.size_used} for term in model.terms]}


def model_from_dict(data: dict | None) -> ModelResult:
    """Return the model behind a map; older results were linear, without terms."""
    if data is None:
        return ModelResult()
    return ModelResult(_text(data["misalignment"]), tuple(
        TermResult(_text(term["name"]), None if term["size"] is None else _number(term["size"]),
                   tuple(TermEstimate(_text(e["view"]), _text(e["component"]), _number(e["value"]),
                                      _number(e["u"]), _text(e["unit"]))
                         for e in term["estimates"]),
                   None if term.get("size_used") is None else _number(term["size_used"]))
        for term in data["terms"]))


def provenance_to_dict(provenance: Provenance) -> dict[str, Any]:
    """Return the JSON form of where a result comes from."""
    return {"created": provenance.created, "duration_s": provenance.duration_s,
            "version": provenance.version, **provenance.extra}


def provenance_from_dict(data: dict | None) -> Provenance:
    """Return where a result comes from, as far as it says."""
    if data is None:
        return Provenance()
    known = ("created", "duration_s", "version")
    return Provenance(_text(data["created"]), _number(data["duration_s"]), _text(data["version"]),
                      {key: value for key, value in data.items() if key not in known})


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} is not text")
    return value


def _number(value: Any) -> float:
    if value is None:
        return NAN
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} is not a number")
    return float(value)
