# SPDX-License-Identifier: Apache-2.0
"""Verdict, model and provenance in a RESULT.json; older results have none of them."""

from typing import Any

from selfcal_ros.model.verdict import (
    Cause,
    Enlargement,
    Grade,
    ModelResult,
    Provenance,
    Remedy,
    TermEstimate,
    TermResult,
    Verdict,
)

NAN = float("nan")
REFERENCES = ("artifact", "stage_x", "stage_y")
"""Kinds of a reference length."""


def verdict_to_dict(verdict: Verdict) -> dict[str, Any]:
    """Return the JSON form of a verdict, which is worded.

    Raises
    ------
    ValueError
        If it is not: give the result to `selfcal_ros.reporting.words.result.worded` first.
    """
    if verdict.findings:
        raise ValueError(f"{len(verdict.findings)} findings of the verdict are not worded")
    return {"qualified": verdict.qualified, "grade": str(verdict.grade),
            "sentence": verdict.sentence, "reasons": list(verdict.reasons),
            "enlarged_by": [vars(item) for item in verdict.enlarged_by],
            "causes": [{"name": c.name, "text": c.text, "view": c.view, "axis": c.axis,
                        "mark": list(c.mark), "size": c.size, "u": c.u, "unit": c.unit, "p": c.p,
                        "effect_rms": c.effect_rms, "effect_max": c.effect_max, "told": c.told,
                        "remedies": [{r.kind: r.value} for r in c.remedies]}
                       for c in verdict.causes]}


def verdict_from_dict(data: dict | None, *, identifiable: bool) -> Verdict:
    """Return the verdict of a result; one without a verdict counts as identified or not."""
    if data is None:
        return Verdict(Grade.GOOD if identifiable else Grade.NOT_QUALIFIED,
                       "Not judged: written before verdicts were")
    if not isinstance(data["qualified"], bool):
        raise ValueError(f"qualified is {data['qualified']!r}, not true or false")
    grade = Grade(data.get("grade", "good" if data["qualified"] else "not_qualified"))
    if data["qualified"] is (grade is Grade.NOT_QUALIFIED):
        raise ValueError(f"the grade '{grade}' contradicts qualified {data['qualified']}")
    return Verdict(grade, _text(data["sentence"]),
                   tuple(_text(reason) for reason in data["reasons"]),
                   tuple(_cause(cause) for cause in data["causes"]),
                   enlarged_by=tuple(
                       Enlargement(_text(e["name"]), _number(e["u_rms"]), _number(e["u_max"]),
                                   _text(e["unit"]))
                       for e in data.get("enlarged_by", [])))


def _cause(c: dict) -> Cause:
    return Cause(_text(c["name"]), _text(c["text"]), _number(c["size"]), _number(c["u"]),
                 _text(c["unit"]), _number(c["p"]), view=_text(c.get("view", "")),
                 axis=_text(c.get("axis", "")), mark=tuple(map(int, c.get("mark", ()))),
                 effect_rms=_number(c.get("effect_rms")), effect_max=_number(c.get("effect_max")),
                 told=bool(c.get("told", True)),
                 remedies=tuple(Remedy(kind, _text(value)) for remedy in c.get("remedies", [])
                                for kind, value in remedy.items()))


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


def reference_from_dict(raw: Any) -> dict[str, Any] | None:
    """Return the reference length of a result as it is; ValueError if it is none."""
    if raw is None:
        return None
    if not isinstance(raw, dict):
        raise ValueError(f"{raw!r} is not a reference")
    told = raw
    if told["kind"] not in REFERENCES:
        raise ValueError(f"the reference {told['kind']!r} is unknown")
    error, u = _number(told["relative_error"]), _number(told["u_relative"])
    if not (abs(error) < 0.1 and 0 <= u < 0.1):
        raise ValueError(f"reference: {error!r} with u {u!r} is not a relative error")
    _text(told.get("certificate") or "")
    return told


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
