# SPDX-License-Identifier: Apache-2.0
"""`selfcal certificate`: the schema's structure, the map's numbers, what is refused."""

import json
import os
import re
from dataclasses import replace
from datetime import date
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml

from selfcal_ros.applications.standards.chapter import certificate_chapter
from selfcal_ros.applications.standards.dcc import DCC, SI, certificate
from selfcal_ros.applications.standards.details import details_from_dict, read_details
from selfcal_ros.applications.standards.statements import is_traceable
from selfcal_ros.apply import StageMap
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.combine import Member, combine
from selfcal_ros.estimation.comparison.covariance import covariance_of, first_order_u
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.recheck.plate import known_plate
from selfcal_ros.estimation.recheck.solve import recheck
from selfcal_ros.estimation.verdict.uncertainty import budgets
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.findings import NotConverged
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.words.findings import worded
from test.support.lattice_plans import plan_of
from test.support.maps import random_map, result_of
from test.support.truth import hu_plan, random_truth, simulate_measurements

DETAILS = Path(__file__).parents[3] / "config/certificates/details.yaml"
GIVEN = yaml.safe_load(DETAILS.read_text())
IN = {"dcc": DCC, "si": SI}
SCHEMA = Path(
    os.environ.get("SELFCAL_DCC_SCHEMA")
    or Path(__file__).parents[3] / "build/oracles/dcc/dcc.xsd"
)
"""dcc.xsd of version 3.3.0, with the schemas beside it that it imports; `make test` fetches it."""
CERTIFIED = ReferenceLength("artifact", 1e-6, 2e-7, "PTB 1")
OF_MARKS = ReferenceLength.between(
    "-2,0:2,0:0.04000004:8e-9", Artifact(5, 0.01), "PTB 1"
)


def solved(reference=None, *, lines=8):
    rng = np.random.default_rng(1)
    plan = hu_plan(Artifact(5, 0.01, lines), 2)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    readings = simulate_measurements(
        truth, plan, rng, sigma_m=2e-8, sigma_theta_rad=2e-5
    )
    return worded(calibrate(readings, Options(reference=reference, causes=False)))


RESULT = solved()
BAD = worded(replace(RESULT, verdict=Verdict(Grade.NOT_QUALIFIED, (NotConverged(),))))


def details():
    return details_from_dict(GIVEN, "d.yaml")


def written(result=RESULT, **options):
    return ET.fromstring(certificate(result, details(), **options))


def named(root, name):
    """Return the elements whose name is a text."""
    return [
        item
        for item in root.iter()
        if item.findtext("dcc:name/dcc:content", "", IN) == name
    ]


def values(item, path="si:realListXMLList/si:valueXMLList"):
    return np.array(item.findtext(path, "", IN).split(), dtype=float)


U = (
    "si:realListXMLList/si:measurementUncertaintyUnivariateXMLList/si:expandedMUXMLList/"
    "si:valueExpandedMUXMLList"
)


def test_the_map_of_the_certificate_is_that_of_the_result():
    root, emap, at = written(), RESULT.error_map, RESULT.artifact
    [x], [y], [gx], [gy] = (named(root, name) for name in ("x", "y", "Gx", "Gy"))
    for item, expected in ((x, at.x_m), (y, at.y_m), (gx, emap.gx), (gy, emap.gy)):
        np.testing.assert_allclose(values(item), expected.ravel(), rtol=1e-8)
        assert item.findtext("si:realListXMLList/si:unitXMLList", "", IN) == r"\metre"
    k = RESULT.noise.k_xy
    np.testing.assert_allclose(values(gx, U), k * emap.u_gx.ravel(), rtol=1e-8)
    np.testing.assert_allclose(values(gy, U), k * emap.u_gy.ravel(), rtol=1e-8)
    assert float(gx.findtext(".//si:coverageFactorXMLList", "", IN)) == pytest.approx(
        k, abs=1e-4
    )
    [theta], [angle] = named(root, "Gtheta"), named(root, "angle")
    np.testing.assert_allclose(values(theta), emap.g_theta, rtol=1e-8)
    np.testing.assert_allclose(
        values(theta, U), RESULT.noise.k_theta * emap.u_g_theta, rtol=1e-8
    )
    np.testing.assert_allclose(values(angle), np.arange(8) * np.pi / 4, rtol=1e-8)
    unknown = emap.gx.copy()
    unknown[0, 1] = np.nan
    holed = written(replace(RESULT, error_map=replace(emap, gx=unknown)))
    assert all(len(values(named(holed, name)[0])) == 24 for name in ("x", "Gx", "Gy"))


def test_budget_and_distances_are_those_of_the_result():
    root = written()
    [at_nodes] = named(
        root, "Uncertainty budget: XY, one coordinate at the nodes of the map"
    )
    found = {
        item.findtext("dcc:name/dcc:content", "", IN): float(
            item.findtext("si:real/si:value", "", IN)
        )
        for item in at_nodes.iter(f"{{{DCC}}}quantity")
    }
    budget = budgets(RESULT)[0]
    assert found["reading noise (type A)"] == pytest.approx(budget.lines[0].effect_rms)
    assert found["combined standard uncertainty"] == pytest.approx(budget.u_rms)
    assert found["expanded uncertainty"] == pytest.approx(budget.U_rms)
    assert len(found) == len(budget.lines) + 2
    a, b = StageMap(RESULT).length_uncertainty()
    assert [
        float(named(root, name)[0].findtext("si:real/si:value", "", IN))
        for name in "ab"
    ] == pytest.approx([a, b])
    assert not named(root, "Gx, then Gy")


def test_the_covariance_is_written_on_request():
    [item] = named(written(covariance=True), "Gx, then Gy")
    found = [
        values(column, "si:covarianceXMLList/si:valueXMLList")
        for column in item.iter(f"{{{SI}}}columnXMLList")
    ]
    known = np.ones(RESULT.artifact.shape, dtype=bool)
    np.testing.assert_allclose(
        found, covariance_of(RESULT, "xy", known), rtol=1e-7, atol=1e-26
    )
    apart = replace(RESULT, views=())
    text = ET.tostring(written(apart), encoding="unicode")
    assert "correlations between nodes are not known" in text and not named(
        ET.fromstring(text), "a"
    )
    with pytest.raises(InputError, match="correlations"):
        written(apart, covariance=True)


ORDER = [
    "dccSoftware",
    "coreData",
    "items",
    "calibrationLaboratory",
    "respPersons",
    "customer",
    "statements",
]


def test_the_certificate_has_the_parts_of_the_schema_in_their_order():
    root = written()
    assert root.get("schemaVersion") == "3.3.0"
    assert [item.tag for item in root] == [
        f"{{{DCC}}}administrativeData",
        f"{{{DCC}}}measurementResults",
    ]
    assert [item.tag.partition("}")[2] for item in root[0]] == ORDER
    assert [item.tag.partition("}")[2] for item in root[1]] == [
        "usedMethods",
        "usedSoftware",
        "measuringEquipments",
        "influenceConditions",
        "measurementResult",
    ]
    assert [item.tag.partition("}")[2] for item in root[1][-1]] == [
        "name",
        "description",
        "results",
        "measurementMetaData",
    ]
    core = {item.tag.partition("}")[2]: item.text for item in root[0][1]}
    assert (
        core["uniqueIdentifier"] == "EX-2026-0042" and core["issueDate"] == "2026-11-23"
    )
    assert (core["countryCodeISO3166_1"], core["usedLangCodeISO639_1"]) == ("DE", "en")
    [stage] = named(root, "XY-theta stage")
    assert (
        stage.findtext("dcc:identifications/dcc:identification/dcc:value", "", IN)
        == "4711"
    )
    assert (
        stage.findtext("dcc:manufacturer/dcc:name/dcc:content", "", IN)
        == "Example Stages"
    )
    [warm] = named(root, "temperature of the plate")
    assert float(warm.findtext(".//si:valueExpandedMU", "", IN)) == pytest.approx(0.1)
    empty = [
        item for item in root.iter() if len(item) == 0 and not (item.text or "").strip()
    ]
    assert not empty


def test_details_are_taken_as_they_are_written(tmp_path):
    given = json.loads(json.dumps(GIVEN, default=str))
    given["laboratory"]["post_code"], given["item"]["serial_number"] = (
        "@post",
        "@serial",
    )
    given["certificate"]["id"], given["certificate"]["language"] = "@id", "@no"
    given["laboratory"]["country"] = "@NO"
    text = (
        yaml.safe_dump(given)
        .replace("'@post'", "01067")
        .replace("'@serial'", "00471")
        .replace("'@id'", "1e3")
        .replace("'@no'", "no")
        .replace("'@NO'", "NO")
    )
    (tmp_path / "d.yaml").write_text(text)
    found = read_details(str(tmp_path / "d.yaml"))
    assert found["laboratory"]["post_code"] == "01067"
    assert (
        found["item"]["serial_number"] == "00471"
        and found["certificate"]["id"] == "1e3"
    )
    assert (found["laboratory"]["country"], found["certificate"]["language"]) == (
        "NO",
        "no",
    )
    assert found["conditions"] == details()["conditions"]
    assert found["certificate"]["begin"] == details()["certificate"]["begin"]


@pytest.mark.skipif(not SCHEMA.exists(), reason="the schema could not be fetched")
@pytest.mark.parametrize("lines", [0, 8])
def test_the_certificate_is_valid(lines):
    etree = pytest.importorskip("lxml.etree")
    schema = etree.XMLSchema(etree.parse(str(SCHEMA)))
    for result, options in (
        (solved(lines=lines), {"covariance": True}),
        (replace(RESULT, views=()), {}),
        (BAD, {"not_qualified": True}),
        (solved(CERTIFIED.at_temperature("20.4:.1:5e-7:5e-8"), lines=lines), {}),
    ):
        schema.assertValid(etree.fromstring(certificate(result, details(), **options)))


def statement(root, name):
    [found] = named(root, name)
    return found


def test_only_a_certified_reference_at_its_temperature_is_traceable():
    full = CERTIFIED.at_temperature("20.4:.1:5e-7:5e-8")
    for reference, traceable in (
        (None, False),
        (CERTIFIED, False),
        (full, True),
        (replace(full, certificate=""), False),
        (replace(full, u_relative=0.0), False),
        (OF_MARKS, False),
        (OF_MARKS.at_temperature("20.4:.1:5e-7:5e-8"), True),
    ):
        result = solved(reference)
        assert is_traceable(result) is traceable
        said = statement(written(result), "Metrological traceability")
        assert said.findtext("dcc:traceable", "", IN) == str(traceable).lower()
        text = " ".join(said.itertext())
        assert ("PTB 1" in text) is bool(reference and reference.certificate)
        assert ("used at 20.4 °C" in text) is bool(reference and reference.certified)
        assert ("Not traceable" in text) is bool(reference and not traceable)
        assert ("(distance of the marks (-2, 0) and (2, 0))" in text) is bool(
            reference and reference.marks
        )


def test_a_result_that_is_not_qualified_needs_the_option():
    with pytest.raises(
        InputError, match="is not qualified: Not qualified: the estimate converged"
    ):
        written(BAD)
    said = statement(
        written(BAD, not_qualified=True), "Agreement of readings and model"
    )
    assert said.findtext("dcc:valid", "", IN) == "false"
    assert "No statement of the uncertainty is valid" in " ".join(said.itertext())
    good = statement(written(), "Agreement of readings and model")
    assert good.findtext("dcc:valid", "", IN) == "true"
    nothing = np.full(RESULT.artifact.shape, np.nan)
    with pytest.raises(InputError, match="no uncertainties"):
        written(
            replace(
                RESULT, error_map=replace(RESULT.error_map, u_gx=nothing, u_gy=nothing)
            )
        )


def scalar(root, name):
    """Return value, U and coverage factor of a number."""
    [item] = [
        found
        for found in root.iter(f"{{{DCC}}}quantity")
        if found.findtext("dcc:name/dcc:content", "", IN).startswith(name)
    ]
    return [
        float(item.findtext(f".//si:{key}", "nan", IN))
        for key in ("value", "valueExpandedMU", "coverageFactor")
    ]


def test_squareness_has_the_coverage_factor_of_the_map():
    few = replace(RESULT, noise=replace(RESULT.noise, k_xy=2.87))
    for name, value, u in zip(
        ("non-orthogonality O", "scale difference R"),
        (RESULT.error_map.nonorthogonality, RESULT.error_map.scale_difference),
        first_order_u(RESULT),
        strict=True,
    ):
        assert scalar(written(few), name) == pytest.approx(
            [value, 2.87 * u, 2.87], rel=1e-6
        )


@pytest.mark.parametrize("dof", [np.inf, 5.0])
def test_the_ellipsoid_of_all_nodes_has_the_factor_of_its_dimension(dof):
    """25 nodes, of two coordinates, without translation, rotation and magnification: 46."""
    noise = replace(RESULT.noise, dof_xy=dof, dof_map_xy=dof)
    root = written(replace(RESULT, noise=noise), covariance=True)
    found = float(
        root.findtext(
            ".//si:ellipsoidalRegionMUXMLList/si:coverageFactorXMLList", "", IN
        )
    )
    assert found == pytest.approx({np.inf: 7.960, 5.0: 14.636}[dof], abs=1e-3)


def test_all_nodes_of_a_large_field_are_written():
    large = replace(result_of(random_map(Artifact(41, 0.002), 3)), noise=RESULT.noise)
    xml = certificate(large, details())
    root = ET.fromstring(xml)
    assert [len(values(named(root, name)[0])) for name in ("x", "Gx", "Gy")] == [
        41 * 41
    ] * 3
    assert len(values(named(root, "Gy")[0], U)) == 41 * 41
    np.testing.assert_allclose(
        values(named(root, "Gx")[0]), large.error_map.gx.ravel(), rtol=1e-8
    )
    if SCHEMA.exists():
        etree = pytest.importorskip("lxml.etree")
        etree.XMLSchema(etree.parse(str(SCHEMA))).assertValid(etree.fromstring(xml))


def test_a_long_remark_is_not_shortened_and_a_hostile_one_is_text():
    data = details()
    long = "w" * 5000
    hostile = "]]> <dcc:x/> & \" ' \x1b[2J \u202e \ufffe \U0001f600 --> <!--"
    data["remarks"] = [{"text": long}, {"text": hostile}]
    root = ET.fromstring(certificate(RESULT, data))
    said = [" ".join(item.itertext()) for item in named(root, "Remark")]
    assert long in said[0]
    assert "]]> <dcc:x/> & \" ' \\x1b[2J \\u202e \\ufffe \U0001f600 --> <!--" in said[1]
    assert any(
        long in note
        for section in certificate_chapter(RESULT, data).sections
        for note in section.notes
    )


def test_the_datum_is_that_of_the_result():
    with_length = solved(CERTIFIED)
    for result, scale in (
        (RESULT, "no translation, rotation or magnification over the field"),
        (
            with_length,
            "no translation or rotation over the field; a reference length sets the scale",
        ),
    ):
        [about] = named(written(result), "Error map of the stage")
        text = " ".join(about.find("dcc:description", IN).itertext())
        assert f"XY datum: {scale}" in text and "unless" not in text


def exposed(first, last):
    made = replace(
        RESULT.provenance,
        extra={"visit_order": {"identity": "x_back_y_back"}},
        first_exposure=f"{first}T23:30:00.000+00:00",
        last_exposure=f"{last}T01:00:00+00:00",
    )
    return replace(RESULT, provenance=made)


def test_times_of_readings_that_are_not_dates_are_refused():
    with pytest.raises(
        InputError, match="the times of the readings are not dates: yesterdayT23"
    ):
        certificate(exposed("yesterday", "2026-11-21"), details())


@pytest.mark.parametrize(
    ("first", "last", "good"),
    [
        ("2026-11-21", "2026-11-21", True),
        ("2026-11-20", "2026-11-22", True),  # a time zone apart
        ("2026-11-19", "2026-11-21", False),
        ("2026-11-21", "2026-11-23", False),
        ("2023-11-14", "2023-11-14", False),
    ],
)
def test_readings_of_other_days_are_refused(first, last, good):
    result, clock = exposed(first, last), {**details()}
    clock["certificate"] = {
        **clock["certificate"],
        "clock": "was not set: 3 years behind",
    }
    if not good:
        for write in (certificate, certificate_chapter):
            with pytest.raises(
                InputError,
                match=f"the readings are of {first} to {last}, the "
                "dates of performance 2026-11-21 to 2026-11-21; correct begin",
            ):
                write(result, details())
    else:
        [order] = named(written(result), "visit order")
        assert (
            order.findtext("dcc:description/dcc:content", "", IN)
            == "identity: x_back_y_back"
        )
    [said] = named(ET.fromstring(certificate(result, clock)), "clock of the readings")
    assert "3 years behind" in " ".join(said.itertext())


@pytest.mark.parametrize(
    ("reference", "name", "u", "value", "good"),
    [
        (
            CERTIFIED,
            "temperature of the plate",
            0.05,
            20.55,
            True,
        ),  # 2 u of both: 0.22 K
        (CERTIFIED, "temperature of the plate", 0.05, 20.7, False),
        (CERTIFIED, "temperature of the plate", None, 20.7, False),
        (CERTIFIED, "temperature of the air", 0.05, 23.0, True),
        (
            replace(CERTIFIED, kind="stage_x"),
            "temperature of the plate",
            0.05,
            20.7,
            True,
        ),
    ],
)
def test_a_plate_at_another_temperature_than_its_length_is_refused(
    reference, name, u, value, good
):
    result = solved(reference.at_temperature("20.4:.1:5e-7:5e-8"))
    stated = {"name": name, "value": value, "unit": "degC"} | (
        {} if u is None else {"u": u}
    )
    given = {**details(), "conditions": [stated]}
    if good:
        assert certificate(result, given)
        return
    for write in (certificate, certificate_chapter):
        with pytest.raises(
            InputError,
            match=r"is 20\.7 °C, but the reference length was converted "
            r"to 20\.4 °C \(u 0\.1 K\); correct the condition, or solve again",
        ):
            write(result, given)


def test_a_date_of_issue_that_is_missing_is_today_and_not_before_the_end():
    given = without("certificate", "issued")
    assert (
        details_from_dict(given, "d")["certificate"]["issued"]
        == date.today().isoformat()
    )
    given["certificate"]["end"] = "2999-01-01"
    with pytest.raises(
        InputError, match="is before the end of the measurement, 2999-01-01"
    ):
        details_from_dict(given, "d")


def test_the_texts_are_english_whatever_the_language_of_names():
    given = details_from_dict(changed("de", "certificate", "language"), "d.yaml")
    core = ET.fromstring(certificate(RESULT, given))[0][1]
    assert [item.text for item in core.findall("dcc:usedLangCodeISO639_1", IN)] == [
        "de",
        "en",
    ]
    assert [
        item.text for item in core.findall("dcc:mandatoryLangCodeISO639_1", IN)
    ] == ["en"]


def test_scope_and_uncertainty_are_stated():
    assert "only to the item calibrated" in " ".join(
        statement(written(), "Scope").itertext()
    )
    assert "JCGM 100:2008" in " ".join(statement(written(), "Uncertainty").itertext())
    assert not named(written(BAD, not_qualified=True), "Uncertainty")
    titles = {
        section.title: " ".join(section.notes)
        for section in certificate_chapter(BAD, details()).sections
    }
    assert (
        "No statement of the uncertainty is valid"
        in titles["Agreement of readings and model"]
    )
    assert "Uncertainty" not in titles and "item calibrated" in titles["Scope"]


def test_the_largest_u_of_the_budget_is_that_of_the_worst_node():
    emap, root = RESULT.error_map, written()
    worst = max(emap.u_gx.max(), emap.u_gy.max())
    for name, u, word in (
        ("at the nodes of the map", worst, "largest "),
        ("anywhere", worst, "largest at most "),
    ):
        [budget] = [
            item
            for item in root.iter(f"{{{DCC}}}result")
            if name in item.findtext("dcc:name/dcc:content", "", IN)
            and "XY" in item.findtext("dcc:name/dcc:content", "", IN)
        ]
        text = next(
            " ".join(item.itertext())
            for item in budget.iter(f"{{{DCC}}}quantity")
            if "combined" in item.findtext("dcc:name/dcc:content", "", IN)
        )
        said = float(re.search(rf"{word}([-.e\d]+)", text)[1])
        assert said == pytest.approx(u, rel=5e-3) if name != "anywhere" else said > u


def run(seed, reference=None, *, lines=8):
    rng = np.random.default_rng(1)
    plan = hu_plan(Artifact(5, 0.01, lines), 2)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    readings = simulate_measurements(
        truth, plan, np.random.default_rng(seed), sigma_m=2e-8, sigma_theta_rad=2e-5
    )
    return Member(
        f"{seed}.json",
        (
            found := worded(
                calibrate(readings, Options(reference=reference, causes=False))
            )
        ).error_map,
        found,
    )


def test_a_mean_is_traceable_if_all_its_runs_are():
    cold, warm = (CERTIFIED.at_temperature(f"{t}:.1:5e-7:5e-8") for t in (20.4, 21))
    for references, traceable in (
        ((cold, warm), True),
        ((cold, cold), True),
        ((cold, CERTIFIED), False),
    ):
        parts = [
            run(seed, reference)
            for seed, reference in zip((5, 6), references, strict=True)
        ]
        mean = worded(combine(parts, keep_scale=True).result)
        assert is_traceable(mean) is traceable
        root = written(mean)
        text = " ".join(statement(root, "Metrological traceability").itertext())
        assert ("used at 21 °C" in text) is (
            warm in references
        ) and "used at 20.4 °C" in text
        assert [named(root, f"readings of {part.name}") != [] for part in parts] == [
            True,
            True,
        ]
        assert is_traceable(result_from_dict(result_to_dict(mean), "m")) is traceable
    table = Member("t.csv", run(7).error_map)
    assert not is_traceable(combine([run(5, cold), table], keep_scale=True).result)


@pytest.mark.parametrize(
    ("value", "beyond"), [(20.2, ""), (20.7, ""), (20.0, "20.4"), (21.4, "21")]
)
def test_a_temperature_beyond_those_of_the_runs_of_a_mean_is_refused(value, beyond):
    cold, warm = (CERTIFIED.at_temperature(f"{t}:.1:5e-7:5e-8") for t in (20.4, 21))
    mean = worded(combine([run(5, cold), run(6, warm)], keep_scale=True).result)
    stated = {"name": "plate", "value": value, "u": 0.05, "unit": "degC"}
    given = {**details(), "conditions": [stated]}
    if not beyond:
        assert certificate(mean, given)
        return
    with pytest.raises(InputError, match=f"length was converted to {beyond} °C"):
        certificate(mean, given)


def test_the_certificate_of_a_mean_states_what_its_runs_are():
    """One calibration, one recheck, and a table, of plates without lines."""
    _, again = rechecked()
    parts = [run(5, lines=0), Member("again.json", again.error_map, again)]
    parts[0] = replace(parts[0], result=replace(parts[0].result, run_id="17"))
    parts.append(Member("t.csv", run(7, lines=0).error_map))
    root = written(worded(combine(parts).result))
    [method] = root.iter(f"{{{DCC}}}usedMethod")
    text = " ".join(method.itertext())
    assert "Weighted mean of 3 maps: Comparison of a stage" in text
    assert "; Error map from another source; Self-calibration of a stage" in text
    assert "again.json: the errors of the marks are those of a self-calibration" in text
    assert named(root, "coverage of x and y") and not named(root, "coverage of theta")
    scale = " ".join(statement(root, "Metrological traceability").itertext())
    assert "the magnification of each run was removed from the mean" in scale
    [shared] = named(root, "shared by all runs (type B)")[:1]
    assert ", declared: declared or assumed" in " ".join(shared.itertext())


def test_a_mean_has_u_of_its_squareness():
    mean = worded(combine([run(5), run(6)]).result)
    value, U_O, k = scalar(written(mean), "non-orthogonality O")
    cover = covariance_of(mean, "xy", np.ones((5, 5), dtype=bool))
    at = mean.artifact
    columns = np.array(
        [
            np.concatenate([a.ravel(), b.ravel()])
            for a, b in (
                (at.y_m, at.x_m),
                (at.x_m, -at.y_m),
                (at.x_m, at.y_m),
                (-at.y_m, at.x_m),
                (1 + 0 * at.x_m, 0 * at.x_m),
                (0 * at.x_m, 1 + 0 * at.x_m),
            )
        ]
    ).T
    row = np.linalg.pinv(columns)[0]
    assert pytest.approx(k * np.sqrt(row @ cover @ row), rel=1e-4) == U_O
    assert k == pytest.approx(mean.noise.k_xy, rel=1e-4) and value == pytest.approx(
        mean.error_map.nonorthogonality
    )


def without(*path):
    data = yaml.safe_load(DETAILS.read_text())
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    return data


def changed(value, *path):
    data = yaml.safe_load(DETAILS.read_text())
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return data


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "d.yaml: not the details of a certificate"),
        (
            without("laboratory"),
            "d.yaml: laboratory: is missing; give name, city, country",
        ),
        (without("conditions"), "d.yaml: conditions: is missing; give name"),
        (
            without("certificate", "id"),
            "d.yaml: certificate.id: is missing; give a text",
        ),
        (without("customer", "city"), "d.yaml: customer.city: is missing"),
        (without("item", "serial_number"), "d.yaml: item.serial_number: is missing"),
        (without("persons", 0, "name"), r"d.yaml: persons\[0\].name: is missing"),
        (
            changed("Germany", "certificate", "country"),
            "certificate.country: 'Germany' is not a country code of two capitals, e.g. DE",
        ),
        (changed("EN", "certificate", "language"), "'EN' is not a language code"),
        (
            changed("20.11.2026", "certificate", "begin"),
            "'20.11.2026' is not a date YYYY-MM-DD",
        ),
        (
            changed("2026-11-19", "certificate", "end"),
            "2026-11-19 is before 2026-11-21",
        ),
        (
            changed("2026-11-20", "certificate", "issued"),
            "certificate.issued: 2026-11-20 is before the end of the measurement, "
            "2026-11-21; correct",
        ),
        (
            changed("2026-11-20", "equipment", 0, "valid_until"),
            r"equipment\[0\].valid_until: 2026-11-20 is before the end of "
            r"the measurement, 2026-11-21",
        ),
        (
            changed("soon", "equipment", 1, "valid_until"),
            r"equipment\[1\].valid_until: 'soon' is not",
        ),
        (
            changed("here", "certificate", "place"),
            "place: 'here' is not one of laboratory, customer",
        ),
        (
            changed("x", "certificate", "idd"),
            "certificate.idd: is unknown; did you mean 'id'",
        ),
        (changed({}, "instruments"), "instruments: is unknown"),
        (
            changed("warm", "conditions", 0, "value"),
            r"conditions\[0\].value: 'warm' is not a number",
        ),
        (
            changed("1_000", "conditions", 1, "value"),
            r"conditions\[1\].value: '1_000' is not a number",
        ),
        (changed("degF", "conditions", 0, "unit"), "'degF' is not one of degC"),
        (
            changed(293.55, "conditions", 0, "value"),
            r"conditions\[0\]: 293.55 is not a temperature from -50 to "
            r"100 degC: is it in K\?; give degC",
        ),
        (
            without("conditions", 0, "unit"),
            r"conditions\[0\]: neither a value with its unit nor",
        ),
        (changed(0, "conditions", 0, "u"), r"conditions\[0\]: neither a value"),
        (changed("  ", "item", "name"), "item.name: '  ' is not a text"),
        (
            changed("me", "laboratory"),
            "laboratory: 'me' has no keys; give name, city, country",
        ),
    ],
)
def test_details_that_lack_something_are_one_line(data, message):
    with pytest.raises(InputError, match=message) as raised:
        details_from_dict(data, "d.yaml")
    assert "\n" not in str(raised.value)


def test_the_verb_writes_refuses_and_ends_with_the_code_of_the_result(tmp_path, capsys):
    good, bad, out = (
        str(tmp_path / name) for name in ("good.json", "bad.json", "dcc.xml")
    )
    write_json(good, result_to_dict(RESULT))
    write_json(bad, result_to_dict(BAD))
    assert main(["certificate", good, str(DETAILS), "-o", out]) == 0
    assert capsys.readouterr().out == f"written: {out}, not traceable\n"
    assert main(["certificate", good, str(DETAILS), "-o", "-"]) == 0
    printed = ET.fromstring(capsys.readouterr().out)
    np.testing.assert_allclose(
        values(named(printed, "Gx")[0]), RESULT.error_map.gx.ravel(), rtol=1e-8
    )
    assert main(["certificate", bad, str(DETAILS), "-o", out, "--force"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "--not-qualified" in error
    assert (
        main(
            ["certificate", bad, str(DETAILS), "-o", out, "--not-qualified", "--force"]
        )
        == 5
    )
    assert main(["certificate", good, str(DETAILS), "-o", good]) == 2


def test_the_report_has_the_same_for_people(tmp_path, capsys):
    result, page = str(tmp_path / "r.json"), tmp_path / "r.html"
    write_json(
        result, result_to_dict(solved(CERTIFIED.at_temperature("20.4:.1:5e-7:5e-8")))
    )
    assert main(["report", result, "--details", str(DETAILS), "-o", str(page)]) == 0
    text = page.read_text()
    for part in (
        "EX-2026-0042",
        "Example Calibration Laboratory",
        "temperature of the plate",
        "20.4",
        "used at 20.4 °C",
        "U of the distance L",
        "chromium on fused silica",
    ):
        assert part in text, part
    first_page = text[: text.index("<h2>")]
    for part in (
        "EX-2026-0042",
        "Example Calibration Laboratory",
        "Example Machine Builder",
        "Example Stages XY-theta stage XYT-200",
        "4711",
        "A. Example",
    ):
        assert part in first_page, part
    assert main(["report", result, "-o", str(page), "--force"]) == 0
    assert "EX-2026-0042" not in page.read_text()
    bad = tmp_path / "d.yaml"
    bad.write_text("item: {}")
    assert (
        main(["report", result, "--details", str(bad), "-o", str(tmp_path / "d.html")])
        == 2
    )
    assert "certificate: is missing" in capsys.readouterr().err
    apart = solved()
    chapter = certificate_chapter(replace(apart, views=()), details())
    assert any(
        "correlations between nodes are not known" in note
        for section in chapter.sections
        for note in section.notes
    )


def rechecked():
    """Return a calibration with a certified length, and what one view of its plate gave."""
    plan, rng = plan_of("0,90,tx", Artifact(5, 0.01)), np.random.default_rng(3)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    before = worded(
        calibrate(
            simulate_measurements(truth, plan, rng, sigma_m=2e-8),
            Options(
                reference=CERTIFIED.at_temperature("20.4:.1:5e-7:5e-8"), causes=False
            ),
        )
    )
    before = replace(before, input={"file": "plate.mcap", "sha256": "0123abcd"})
    view = replace(plan, plan_id="again", views=plan.views[:1])
    readings = simulate_measurements(truth, view, rng, sigma_m=2e-8)
    plate = known_plate(
        result_from_dict(result_to_dict(before), "r"),
        "there/r.json",
        "20.4:.1:5e-7:5e-8",
    )
    return before, worded(recheck(readings, Options(), plate))


def test_the_certificate_of_a_recheck_states_its_method_and_the_calibration_behind_it():
    before, after = rechecked()
    first, root = written(before), written(after, covariance=True)
    [method] = root.iter(f"{{{DCC}}}usedMethod")
    text = " ".join(method.itertext())
    assert "Comparison of a stage with a plate known from its calibration" in text
    assert "plan 0,90,tx; plate.mcap, sha256 0123abcd" in text
    assert "Self-calibration of a stage" in " ".join(first.itertext())
    assert not named(
        first, "Comparison of a stage with a plate known from its calibration"
    )
    scale = " ".join(statement(root, "Metrological traceability").itertext())
    assert (
        "The scale is that of the known plate" in scale and "used at 20.4 °C" in scale
    )
    assert "known plate" not in " ".join(
        statement(first, "Metrological traceability").itertext()
    )
    for one in (first, root):
        assert "line_eccentricity" not in " ".join(one.itertext())  # there are no lines
    assert "line_eccentricity" in " ".join(written().itertext())


def test_the_certificate_of_a_recheck_has_u_of_squareness_and_correlations():
    _, after = rechecked()
    root, k = written(after, covariance=True), after.noise.k_xy
    u_o, u_r = first_order_u(after)
    for name, u in (
        ("non-orthogonality O, Gx = O y + R x, Gy = O x - R y", u_o),
        ("scale difference R", u_r),
    ):
        [item] = named(root, name)
        assert float(item.findtext(".//si:valueExpandedMU", "", IN)) == pytest.approx(
            k * u
        )
    cover = covariance_of(after, "xy", after.error_map.valid)
    u = np.concatenate([after.error_map.u_gx.ravel(), after.error_map.u_gy.ravel()])
    np.testing.assert_allclose(np.sqrt(np.diag(cover)), u, rtol=1e-6)
    assert u_o > 0 and [*named(root, "a"), *named(root, "Gx, then Gy")]
