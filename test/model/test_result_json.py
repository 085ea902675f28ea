# SPDX-License-Identifier: Apache-2.0
"""RESULT.json: what is written is what is read, to the last bit, NaN included."""

import copy
import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.files import read
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.budget import (
    BudgetLine,
    OfAssumption,
    OfCause,
    OfNoise,
    OfPlate,
    OfReference,
    OfRuns,
    OfTerm,
)
from selfcal_ros.model.findings import (
    Cause,
    CauseDetails,
    FewRead,
    FewReadCell,
    InWords,
    NoiseContradicted,
    Remedy,
    TakenForSlip,
    ViewLeftOut,
    VisitedOnce,
)
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import (
    Observability,
    result_from_dict,
    result_to_dict,
    unidentified_result,
    with_input,
)
from selfcal_ros.model.verdict import (
    Enlargement,
    Grade,
    ModelResult,
    TermResult,
    Verdict,
)
from selfcal_ros.model.verified import AxisError, Verified
from selfcal_ros.model.view import View
from selfcal_ros.outputs import plain, write_json
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.results import read_result
from test.support.results import known_result

ARRAYS = ("gx", "gy", "u_gx", "u_gy", "g_theta", "u_g_theta")


def through_json(result):
    return result_from_dict(
        json.loads(json.dumps(result_to_dict(result), allow_nan=False)), "f"
    )


def assert_same(a, b):
    for name in ARRAYS:
        np.testing.assert_array_equal(
            getattr(a.error_map, name), getattr(b.error_map, name)
        )
    for name in ("ax", "ay", "a_theta", "u_ax", "u_ay", "u_a_theta"):
        np.testing.assert_array_equal(
            getattr(a.artifact_map, name), getattr(b.artifact_map, name)
        )
    for name in (
        "plan_id",
        "observability",
        "rejected",
        "input",
        "warnings",
        "method",
        "sense",
        "extra",
        "artifact",
    ):
        assert getattr(a, name) == getattr(b, name)
    for name in ("nonorthogonality", "scale_difference", "datum_theta"):
        np.testing.assert_equal(getattr(a.error_map, name), getattr(b.error_map, name))
    np.testing.assert_equal(asdict(a.noise), asdict(b.noise))
    np.testing.assert_equal([asdict(v) for v in a.views], [asdict(v) for v in b.views])


@pytest.mark.parametrize(("lines", "size_y"), [(24, 0), (0, 0), (8, 7)])
def test_a_result_survives_its_json_to_the_last_bit(lines, size_y):
    result, _ = known_result(11, lines, size_y=size_y)
    result = replace(
        result,
        warnings=("a", "b"),
        sense="plate_moves",
        method="law",
        extra={"more": [{"quantity": "x", "u_k1_m": 2.5e-9, "dof": 7}]},
    )
    assert_same(through_json(result), result)


def test_a_result_of_before_does_not_tell_what_nothing_checks():
    data = result_to_dict(known_result()[0])
    assert data["observability"].pop("unchecked_sites") is None
    assert result_from_dict(data, "old").observability.unchecked_sites is None
    data["observability"]["unchecked_lines"] = 3
    assert result_from_dict(data, "new").observability.unchecked_lines == 3


def test_unknown_places_are_null_and_come_back_as_nan():
    result, _ = known_result()
    result.error_map.gx[2, 3] = result.error_map.u_gy[0, 0] = np.nan
    result.error_map.g_theta[5] = np.nan
    result = replace(
        result,
        views=(replace(result.views[0], phi=np.nan), *result.views[1:]),
        noise=replace(result.noise, sigma_theta=np.nan),
    )
    data = result_to_dict(result)
    assert data["error_map"]["gx"][2][3] is None
    assert data["views"][0]["misalignment"]["phi"] is None
    assert data["noise"]["sigma_theta"] is None
    assert_same(through_json(result), result)
    assert not through_json(result).error_map.valid[2, 3]


def test_an_unidentified_plan_has_maps_of_nulls():
    view = View("a")
    measured = Measurements(
        "p",
        Artifact(3, 0.01, 4),
        (ViewReadings(view, used=9, rejected={"duplicate": 2}),),
        rejected={"outside_every_view": 1},
    )
    result = worded(
        unidentified_result(
            measured,
            Observability(
                25, 39, 14, False, (InWords(text="m"),), (InWords(text="add tx"),)
            ),
        )
    )
    again = through_json(result)
    assert_same(again, result)
    assert np.isnan(again.error_map.gx).all()
    assert again.rejected == {"duplicate": 2, "outside_every_view": 1}
    assert (again.views[0].used, again.views[0].rejected) == (9, 2)


def test_the_input_and_its_losses_are_added():
    result, _ = known_result()
    told = with_input(
        replace(result, warnings=("w",)), {"file": "b", "sha256": "0"}, ["cut"]
    )
    assert (told.input, told.warnings) == ({"file": "b", "sha256": "0"}, ("w", "cut"))


def test_plain_makes_json_types():
    value = {
        "a": np.float64("nan"),
        "b": (np.int64(3), np.array([1.0, np.inf])),
        "c": np.True_,
    }
    assert plain(value) == {"a": None, "b": [3, [1.0, None]], "c": True}


AXIS = AxisError(8e-7, 3e-8, 2e-6, 9e-8, 3e-8, 3e-8, 0.98, 0.01)
VERIFIED = plain(
    Verified(
        "m.json",
        "better",
        True,
        True,
        "none",
        "off",
        False,
        0.9,
        {"x": AXIS, "y": AXIS},
    )
)


def test_what_a_correction_did_is_read_as_it_was_written():
    result = replace(known_result(5, 8)[0], verification=read(Verified, VERIFIED))
    again = through_json(result)
    assert again.verification == result.verification
    assert again.verification.axes["y"] == AXIS and not again.extra


COURSE = {"time_s": [0.0, 1.0], "dx": [0.0, 0.0], "dy": [0.0, 0.0], "count": [1, 1]}
REMOVED = {
    "view": "a",
    "kind": "grid",
    "mark": [0, 0],
    "standardised": 9,
    "leverage": 0,
}


def damaged(path, value):
    data = copy.deepcopy(result_to_dict(known_result(5, 8)[0]))
    at = data
    for key in path[:-1]:
        at = at[key]
    if value is KeyError:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return data


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("error_map",), KeyError, "the key 'error_map' is missing"),
        (("error_map", "gx"), [[1.0]], "gx has the shape (1, 1), not (5, 5)"),
        (("error_map", "g_theta"), [], "g_theta has the shape (0,), not (8,)"),
        (("error_map", "gy"), [[0.0] * 4 + [-1e308]] * 5, "gy has values beyond 1000"),
        (("error_map", "nonorthogonality"), "0", "'0' is not a number"),
        (("error_map", "datum_theta"), "free", "'free' is not a valid ThetaDatum"),
        (("plan_id",), 3, "3 is not of type str"),
        (("measurement_sense",), "plate_move", "'plate_move' is not a valid Sense"),
        (("views", 0, "rotation"), None, "the pose of view 'identity' is not finite"),
        (("views", 0, "used"), True, "True is not of type int"),
        (("noise", "sigma_xy"), "small", "'small' is not a number"),
        (("rejected",), {"a": "many"}, "'many' is not of type int"),
        (("warnings",), "one", "'one' is not of type list"),
        (("observability", "identifiable"), 1, "1 is not of type bool"),
        (("observability", "unchecked_sites"), 1.5, "1.5 is not of type int"),
        (("views",), 3, "'int' object is not iterable"),
        (("verification",), "passed", "'passed' is not of type dict"),
        (("verification",), VERIFIED | {"passed": "yes"}, "'yes' is not of type bool"),
        (("verification",), VERIFIED | {"axes": {"x": 0.0}}, "0.0 is not of type dict"),
        (("residuals",), {"views": "abc"}, "'abc' is not of type list"),
        (("residuals",), {"views": [{"dx": []}]}, "the key 'view' is missing"),
        (("rejected_at",), [7], "7 is not of type dict"),
        (("slips",), {}, "{} is not of type list"),
        (
            ("rejected_at",),
            [{"view": "a", "reason": ["late"], "x": [], "y": []}],
            "reasons and places of rejected detections differ in number",
        ),
        (
            ("residuals",),
            {"views": [{"view": "a", "course": COURSE | {"count": [1]}}]},
            "the columns of a course differ in length",
        ),
        (
            ("residuals",),
            {"views": [{"view": "a", "course": COURSE | {"dx": [None, 0.0]}}]},
            "a value of a course is not finite",
        ),
        (
            ("outliers",),
            {"rule": "", "unchecked": 0, "removed": [REMOVED | {"mark": [1]}]},
            "(1,) is not a mark of the kind 'grid'",
        ),
    ],
)
def test_damaged_results_are_refused(path, value, message):
    with pytest.raises(InputError) as caught:
        result_from_dict(damaged(path, value), "f.json")
    assert str(caught.value) == (
        f"f.json: damaged result ({message}); write it again with `selfcal solve`"
    )


@pytest.mark.parametrize("data", [None, [], {}, {"schema": "selfcal.result/2"}])
def test_other_json_is_no_result(data):
    with pytest.raises(
        InputError, match=r"^f: not a result of schema selfcal\.result/1; give a "
    ):
        result_from_dict(data, "f")


@pytest.mark.parametrize(
    ("error", "u", "is_one"),
    [
        (0.099, 0.0, True),
        (-0.099, 0.099, True),
        (0.1, 0.0, False),
        (-0.1, 0.0, False),
        (0.15, 0.0, False),
        (0.0, 0.1, False),
        (0.0, 0.15, False),
        (0.0, -1e-9, False),
    ],
)
def test_a_reference_is_off_by_less_than_a_tenth(error, u, is_one):
    data = result_to_dict(known_result()[0])
    data["reference"] = {"kind": "stage_x", "relative_error": error, "u_relative": u}
    if is_one:
        assert result_from_dict(data, "r").reference == ReferenceLength(
            "stage_x", error, u
        )
        return
    with pytest.raises(
        InputError, match=r"^r: .*reference length: .* is not a (relative|stand)"
    ):
        result_from_dict(data, "r")


CAUSE = Cause(
    name="drift",
    size=5e-8,
    u=1e-9,
    unit="m",
    p=1e-7,
    view="tx",
    axis="x",
    mark=(1, -2),
    details=CauseDetails(part="x x2"),
    text="drift along x",
    effect_rms=2e-9,
    effect_max=6e-9,
    told=False,
    remedies=(Remedy("model", "drift:8e-8"), Remedy("view", "tx")),
)


@pytest.mark.parametrize("grade", Grade)
def test_a_grade_with_its_causes_and_terms_comes_back(grade):
    failed = NoiseContradicted(
        size=3e-8, unit="m", stated=1e-8, declared=False, text="noisy"
    )
    verdict = Verdict(
        grade,
        (failed,),
        (CAUSE,),
        (Enlargement("drift", 3e-9, 9e-9), Enlargement("rotation", 1e-6, 2e-6, "rad")),
        "So it is",
        ("why",),
    )
    terms = (
        TermResult("plate_strain", 7e-8, (), 2e-7, "default"),
        TermResult("drift", 5e-8, (), None, "readings"),
    )
    result = replace(
        known_result()[0], verdict=verdict, model=ModelResult("rigid", terms)
    )
    data = result_to_dict(result)["verdict"]
    assert (data["grade"], data["qualified"]) == (str(grade), grade != "not_qualified")
    assert data["causes"][0]["remedies"] == [{"model": "drift:8e-8"}, {"view": "tx"}]
    assert through_json(result).verdict == verdict
    assert through_json(result).model == result.model


def test_findings_come_back_as_what_they_are():
    cell = FewReadCell(view="tx", cell=(0, 1), read=3, shown=9)
    findings = (
        FewRead(unknown=((0, 1),), cells=(cell,), text="few"),
        FewRead(unknown=None, cells=(), text="few, and no camera"),
        ViewLeftOut(
            view="a", read=(1, 0), asked=(9, 0), rejected={"late": 8}, text="out"
        ),
        TakenForSlip(
            cause="drift",
            slip_in="a",
            of_cause=CauseDetails(part="x P1"),
            text="no slip",
        ),
        VisitedOnce(text="once"),
    )
    result = replace(known_result()[0], findings=findings)
    assert through_json(result).findings == findings


@pytest.mark.parametrize(
    ("name", "details"),
    [
        ("of_a_later_version", {"x": [1, 2]}),
        ("noise_contradicted", {"stated": 1e-8}),  # and what is declared was lost
        ("few_read", {"unknown": None, "cells": [{"cell": "?"}]}),
        ("repeats_contradict", {"rejected": 3, "of": 9, "of_a_later_version": 1}),
        # of an earlier one, with the data of the cause among its own
        ("taken_for_slip", {"cause": "drift", "slip_in": "a", "part": "x P1"}),
    ],
)
def test_a_finding_that_is_not_understood_is_kept_in_its_words(name, details):
    data = result_to_dict(
        replace(known_result()[0], findings=(VisitedOnce(text="as it was said"),))
    )
    data["findings"][0] |= {"name": name, "details": details}
    result = result_from_dict(data, "r")
    assert result.findings == (InWords(kind=name, data=details, text="as it was said"),)
    assert result_to_dict(result)["findings"] == data["findings"]


def test_a_verdict_of_before_has_the_grade_of_its_qualification():
    data = result_to_dict(
        replace(known_result()[0], verdict=Verdict(Grade.GOOD, sentence="Good"))
    )
    for key in ("grade", "enlarged_by", "failed"):
        del data["verdict"][key]
    assert result_from_dict(data, "old").verdict == Verdict(Grade.GOOD, sentence="Good")
    data["verdict"]["qualified"] = False
    assert result_from_dict(data, "old").verdict == Verdict(
        Grade.NOT_QUALIFIED, sentence="Good"
    )
    data["verdict"]["grade"] = "enlarged"
    with pytest.raises(
        InputError, match="the grade 'enlarged' contradicts qualified False"
    ):
        result_from_dict(data, "old")


def written_file(folder):
    path = folder / "r.json"
    write_json(path, result_to_dict(known_result(5, 8)[0]))
    return path


def edited(path, change):
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("error_map", lambda data: data["error_map"]["gx"][2].__setitem__(2, 1e-3)),
        ("artifact", lambda data: data["artifact"].__setitem__("grid_pitch", 0.011)),
        ("verdict", lambda data: data["verdict"].__setitem__("sentence", "Good")),
        ("provenance", lambda data: data["provenance"].__setitem__("version", "0")),
        ("remark", lambda data: data.__setitem__("remark", "better now")),
        ("budget", lambda data: data["digest"].pop("budget")),
    ],
)
def test_a_file_that_was_edited_is_refused_with_the_key(key, change, tmp_path):
    path = written_file(tmp_path)
    edited(path, change)
    with pytest.raises(
        InputError, match=f"r.json: its '{key}' was changed after the file was"
    ):
        read_result(path)


def test_layout_and_time_of_creation_are_no_edits(tmp_path):
    path = written_file(tmp_path)
    before = read_result(path)
    edited(
        path,
        lambda data: data["provenance"].__setitem__("created", "2026-01-02T03:04:05Z"),
    )
    assert_same(read_result(path), before)


@pytest.mark.parametrize("version", ["0.4.0", "0.10.0", "1.0.0", "unknown"])
@pytest.mark.parametrize(
    "remove",
    [lambda data: data.pop("digest"), lambda data: data.__setitem__("digest", "none")],
)
def test_a_file_whose_digests_were_removed_is_refused(version, remove, tmp_path):
    path = written_file(tmp_path)
    edited(path, lambda data: data["provenance"].__setitem__("version", version))
    edited(path, remove)
    with pytest.raises(InputError, match=r"r\.json: its 'digest' was removed"):
        read_result(path)


@pytest.mark.parametrize(
    "older",
    [
        lambda data: data["provenance"].__setitem__("version", "0.1.0"),
        lambda data: data["provenance"].__setitem__("version", "0.3.11"),
        lambda data: data["provenance"].pop("version"),
        lambda data: data.pop("provenance"),
    ],
)
def test_a_file_of_a_version_without_digests_is_not_qualified(older, tmp_path):
    path = written_file(tmp_path)
    before = read_result(path)
    edited(path, lambda data: (data.pop("digest"), older(data)))
    found = read_result(path)
    assert before.verdict.qualified and not found.verdict.qualified
    assert found.verdict.reasons[0] == (
        "the file has no digests, so whether it was edited cannot be checked"
    )
    np.testing.assert_array_equal(found.error_map.gx, before.error_map.gx)


@pytest.mark.parametrize(
    ("kind", "marks", "name"),
    [
        ("stage_x", None, "stage_x"),
        ("artifact", (), "artifact"),
        ("marks", ((-5, 0), (5, 0)), "distance of the marks (-5, 0) and (5, 0)"),
    ],
)
def test_a_reference_is_named_by_its_kind_or_its_marks(kind, marks, name):
    assert ReferenceLength(kind, 1e-6, marks=marks).name == name


@pytest.mark.parametrize(
    "details",
    [
        OfNoise("repeats", contradicted=True),
        OfTerm(given=1e-8, allowed=None, remaining=0.4),
        OfTerm(given=1e-8, allowed=2e-8, remaining=0.4),
        OfAssumption(1e-8),
        OfCause("drift"),
        OfRuns(3),
        OfReference("stage_x"),
        OfPlate("old.json"),
        {},
        {"of_a_later_version": [1.0]},
        {"runs": "three"},
    ],
    ids=str,
)
def test_how_a_line_of_the_budget_was_found_comes_back(details):
    line = BudgetLine(
        quantity="xy",
        component="reading noise",
        kind="A",
        value=0.0,
        u=2e-8,
        unit="m",
        effect_rms=1e-8,
        effect_max=3e-8,
        dof=math.inf,
        source="readings",
        details=details,
    )
    result = replace(known_result()[0], budget=(line,))
    assert through_json(result).budget == (line,)
