# SPDX-License-Identifier: Apache-2.0
"""`selfcal certificate`: the schema's structure, the map's numbers, what is refused."""

import os
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml

from selfcal_ros.apply import StageMap
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import xy_covariance
from selfcal_ros.estimation.options import Options, ReferenceLength
from selfcal_ros.estimation.verdict.uncertainty import budgets
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.model.verdict import Finding, Grade, Verdict
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.standards.chapter import certificate_chapter
from selfcal_ros.standards.dcc import DCC, SI, certificate, is_traceable
from selfcal_ros.standards.details import details_from_dict
from test.support.truth import hu_plan, random_truth, simulate_measurements

DETAILS = Path(__file__).parents[2] / "config/certificates/details.yaml"
GIVEN = yaml.safe_load(DETAILS.read_text())
IN = {"dcc": DCC, "si": SI}
SCHEMA = Path(os.environ.get("SELFCAL_DCC_SCHEMA")
              or Path(__file__).parents[2] / "build/oracles/dcc/dcc.xsd")
"""dcc.xsd of version 3.3.0, with the schemas beside it that it imports; `make test` fetches it."""
CERTIFIED = ReferenceLength("artifact", 1e-6, 2e-7, "PTB 1")
OF_MARKS = ReferenceLength.between("-2,0:2,0:0.04000004:8e-9", Artifact(5, 0.01), "PTB 1")


def solved(reference=None, *, lines=8):
    rng = np.random.default_rng(1)
    plan = hu_plan(Artifact(5, 0.01, lines), 2)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    readings = simulate_measurements(truth, plan, rng, sigma_m=2e-8, sigma_theta_rad=2e-5)
    return worded(calibrate(readings, Options(reference=reference, causes=False)))


RESULT = solved()
BAD = worded(replace(RESULT, verdict=Verdict(Grade.NOT_QUALIFIED, (Finding("not_converged"),))))


def details():
    return details_from_dict(GIVEN, "d.yaml")


def written(result=RESULT, **options):
    return ET.fromstring(certificate(result, details(), **options))


def named(root, name):
    """Return the elements whose name is a text."""
    return [item for item in root.iter()
            if item.findtext("dcc:name/dcc:content", "", IN) == name]


def values(item, path="si:realListXMLList/si:valueXMLList"):
    return np.array(item.findtext(path, "", IN).split(), dtype=float)


U = ("si:realListXMLList/si:measurementUncertaintyUnivariateXMLList/si:expandedMUXMLList/"
     "si:valueExpandedMUXMLList")


def test_the_map_of_the_certificate_is_that_of_the_result():
    root, emap, at = written(), RESULT.error_map, RESULT.artifact
    [x], [y], [gx], [gy] = (named(root, name) for name in ("x", "y", "Gx", "Gy"))
    for item, expected in ((x, at.x_m), (y, at.y_m), (gx, emap.gx), (gy, emap.gy)):
        np.testing.assert_allclose(values(item), expected.ravel(), rtol=1e-8)
        assert item.findtext("si:realListXMLList/si:unitXMLList", "", IN) == r"\metre"
    k = RESULT.noise.k_xy
    np.testing.assert_allclose(values(gx, U), k * emap.u_gx.ravel(), rtol=1e-8)
    np.testing.assert_allclose(values(gy, U), k * emap.u_gy.ravel(), rtol=1e-8)
    assert float(gx.findtext(".//si:coverageFactorXMLList", "", IN)) == pytest.approx(k, abs=1e-4)
    [theta], [angle] = named(root, "Gtheta"), named(root, "angle")
    np.testing.assert_allclose(values(theta), emap.g_theta, rtol=1e-8)
    np.testing.assert_allclose(values(theta, U), RESULT.noise.k_theta * emap.u_g_theta, rtol=1e-8)
    np.testing.assert_allclose(values(angle), np.arange(8) * np.pi / 4, rtol=1e-8)
    unknown = emap.gx.copy()
    unknown[0, 1] = np.nan
    holed = written(replace(RESULT, error_map=replace(emap, gx=unknown)))
    assert all(len(values(named(holed, name)[0])) == 24 for name in ("x", "Gx", "Gy"))


def test_budget_and_distances_are_those_of_the_result():
    root = written()
    [at_nodes] = named(root, "Uncertainty budget: XY, one coordinate at the nodes of the map")
    found = {item.findtext("dcc:name/dcc:content", "", IN): float(item.findtext(
        "si:real/si:value", "", IN)) for item in at_nodes.iter(f"{{{DCC}}}quantity")}
    budget = budgets(RESULT)[0]
    assert found["reading noise (type A)"] == pytest.approx(budget.lines[0].effect_rms)
    assert found["combined standard uncertainty"] == pytest.approx(budget.u_rms)
    assert found["expanded uncertainty"] == pytest.approx(budget.U_rms)
    assert len(found) == len(budget.lines) + 2
    a, b = StageMap(RESULT).length_uncertainty()
    assert [float(named(root, name)[0].findtext("si:real/si:value", "", IN))
            for name in "ab"] == pytest.approx([a, b])
    assert not named(root, "Gx, then Gy")


def test_the_covariance_is_written_on_request():
    [item] = named(written(covariance=True), "Gx, then Gy")
    found = [values(column, "si:covarianceXMLList/si:valueXMLList")
             for column in item.iter(f"{{{SI}}}columnXMLList")]
    known = np.ones(RESULT.artifact.shape, dtype=bool)
    np.testing.assert_allclose(found, xy_covariance(RESULT, known)[0], rtol=1e-7, atol=1e-26)
    apart = replace(RESULT, views=())
    text = ET.tostring(written(apart), encoding="unicode")
    assert "correlations between nodes are not known" in text and not named(ET.fromstring(text),
                                                                            "a")
    with pytest.raises(InputError, match="correlations"):
        written(apart, covariance=True)


ORDER = ["dccSoftware", "coreData", "items", "calibrationLaboratory", "respPersons", "customer",
         "statements"]


def test_the_certificate_has_the_parts_of_the_schema_in_their_order():
    root = written()
    assert root.get("schemaVersion") == "3.3.0"
    assert [item.tag for item in root] == [f"{{{DCC}}}administrativeData",
                                           f"{{{DCC}}}measurementResults"]
    assert [item.tag.partition("}")[2] for item in root[0]] == ORDER
    assert [item.tag.partition("}")[2] for item in root[1]] == [
        "usedMethods", "usedSoftware", "measuringEquipments", "influenceConditions",
        "measurementResult"]
    assert [item.tag.partition("}")[2] for item in root[1][-1]] == [
        "name", "description", "results", "measurementMetaData"]
    core = {item.tag.partition("}")[2]: item.text for item in root[0][1]}
    assert core["uniqueIdentifier"] == "EX-2026-0042" and core["issueDate"] == "2026-11-23"
    assert (core["countryCodeISO3166_1"], core["usedLangCodeISO639_1"]) == ("DE", "en")
    [stage] = named(root, "XY-theta stage")
    assert stage.findtext("dcc:identifications/dcc:identification/dcc:value", "", IN) == "4711"
    assert stage.findtext("dcc:manufacturer/dcc:name/dcc:content", "", IN) == "Example Stages"
    [warm] = named(root, "temperature of the plate")
    assert float(warm.findtext(".//si:valueExpandedMU", "", IN)) == pytest.approx(0.1)
    empty = [item for item in root.iter() if len(item) == 0 and not (item.text or "").strip()]
    assert not empty


@pytest.mark.skipif(not SCHEMA.exists(), reason="the schema could not be fetched")
@pytest.mark.parametrize("lines", [0, 8])
def test_the_certificate_is_valid(lines):
    etree = pytest.importorskip("lxml.etree")
    schema = etree.XMLSchema(etree.parse(str(SCHEMA)))
    for result, options in ((solved(lines=lines), {"covariance": True}),
                            (replace(RESULT, views=()), {}), (BAD, {"not_qualified": True}),
                            (solved(CERTIFIED.at_temperature("21:.1:5e-7:5e-8"), lines=lines), {})):
        schema.assertValid(etree.fromstring(certificate(result, details(), **options)))


def statement(root, name):
    [found] = named(root, name)
    return found


def test_only_a_certified_reference_at_its_temperature_is_traceable():
    full = CERTIFIED.at_temperature("21:.1:5e-7:5e-8")
    for reference, traceable in ((None, False), (CERTIFIED, False), (full, True),
                                 (replace(full, certificate=""), False),
                                 (replace(full, u_relative=0.0), False), (OF_MARKS, False),
                                 (OF_MARKS.at_temperature("21:.1:5e-7:5e-8"), True)):
        result = solved(reference)
        assert is_traceable(result) is traceable
        said = statement(written(result), "Metrological traceability")
        assert said.findtext("dcc:traceable", "", IN) == str(traceable).lower()
        text = " ".join(said.itertext())
        assert ("PTB 1" in text) is bool(reference and reference.certificate)
        assert ("used at 21 °C" in text) is bool(reference and reference.certified)
        assert ("Not traceable" in text) is bool(reference and not traceable)
        assert ("(distance of the marks (-2, 0) and (2, 0))" in text) is bool(
            reference and reference.marks)


def test_a_result_that_is_not_qualified_needs_the_option():
    with pytest.raises(InputError, match="is not qualified: Not qualified: the estimate converged"):
        written(BAD)
    said = statement(written(BAD, not_qualified=True), "Agreement of readings and model")
    assert said.findtext("dcc:valid", "", IN) == "false"
    assert "No statement of the uncertainty is valid" in " ".join(said.itertext())
    good = statement(written(), "Agreement of readings and model")
    assert good.findtext("dcc:valid", "", IN) == "true"
    nothing = np.full(RESULT.artifact.shape, np.nan)
    with pytest.raises(InputError, match="no uncertainties"):
        written(replace(RESULT, error_map=replace(RESULT.error_map, u_gx=nothing, u_gy=nothing)))


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


@pytest.mark.parametrize(("data", "message"), [
    ([], "d.yaml: not the details of a certificate"),
    (without("laboratory"), "d.yaml: laboratory: is missing; give name, city, country"),
    (without("conditions"), "d.yaml: conditions: is missing; give name"),
    (without("certificate", "id"), "d.yaml: certificate.id: is missing; give a text"),
    (without("customer", "city"), "d.yaml: customer.city: is missing"),
    (without("item", "serial_number"), "d.yaml: item.serial_number: is missing"),
    (without("persons", 0, "name"), r"d.yaml: persons\[0\].name: is missing"),
    (changed("Germany", "certificate", "country"),
     "certificate.country: 'Germany' is not a country code of two capitals, e.g. DE"),
    (changed("EN", "certificate", "language"), "'EN' is not a language code"),
    (changed("20.11.2026", "certificate", "begin"), "'20.11.2026' is not a date YYYY-MM-DD"),
    (changed("2026-11-19", "certificate", "end"), "2026-11-19 is before 2026-11-20"),
    (changed("here", "certificate", "place"), "place: 'here' is not one of laboratory, customer"),
    (changed("x", "certificate", "idd"), "certificate.idd: is unknown; did you mean 'id'"),
    (changed({}, "instruments"), "instruments: is unknown"),
    (changed("warm", "conditions", 0, "value"), r"conditions\[0\].value: 'warm' is not a number"),
    (changed("degF", "conditions", 0, "unit"), "'degF' is not one of degC"),
    (changed(293.55, "conditions", 0, "value"),
     r"conditions\[0\]: 293.55 is no temperature from -50 to 100 degC: is it in K\?; give degC"),
    (without("conditions", 0, "unit"), r"conditions\[0\]: neither a value with its unit nor"),
    (changed(0, "conditions", 0, "u"), r"conditions\[0\]: neither a value"),
    (changed("  ", "item", "name"), "item.name: '  ' is not a text"),
    (changed("me", "laboratory"), "laboratory: 'me' has no keys; give name, city, country"),
])
def test_details_that_lack_something_are_one_line(data, message):
    with pytest.raises(InputError, match=message) as raised:
        details_from_dict(data, "d.yaml")
    assert "\n" not in str(raised.value)


def test_the_verb_writes_refuses_and_ends_with_the_code_of_the_result(tmp_path, capsys):
    good, bad, out = (str(tmp_path / name) for name in ("good.json", "bad.json", "dcc.xml"))
    write_json(good, result_to_dict(RESULT))
    write_json(bad, result_to_dict(BAD))
    assert main(["certificate", good, str(DETAILS), "-o", out]) == 0
    assert capsys.readouterr().out == f"written: {out}, not traceable\n"
    assert main(["certificate", good, str(DETAILS), "-o", "-"]) == 0
    printed = ET.fromstring(capsys.readouterr().out)
    np.testing.assert_allclose(values(named(printed, "Gx")[0]), RESULT.error_map.gx.ravel(),
                               rtol=1e-8)
    assert main(["certificate", bad, str(DETAILS), "-o", out]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "--not-qualified" in error
    assert main(["certificate", bad, str(DETAILS), "-o", out, "--not-qualified"]) == 5
    assert main(["certificate", good, str(DETAILS), "-o", good]) == 2


def test_the_report_has_the_same_for_people(tmp_path, capsys):
    result, page = str(tmp_path / "r.json"), tmp_path / "r.html"
    write_json(result, result_to_dict(solved(CERTIFIED.at_temperature("21:.1:5e-7:5e-8"))))
    assert main(["report", result, "--details", str(DETAILS), "-o", str(page)]) == 0
    text = page.read_text()
    for part in ("EX-2026-0042", "Example Calibration Laboratory", "temperature of the plate",
                 "20.4", "used at 21 °C", "U of the distance L", "chromium on fused silica"):
        assert part in text, part
    assert main(["report", result, "-o", str(page)]) == 0
    assert "EX-2026-0042" not in page.read_text()
    bad = tmp_path / "d.yaml"
    bad.write_text("item: {}")
    assert main(["report", result, "--details", str(bad), "-o", str(page)]) == 2
    assert "certificate: is missing" in capsys.readouterr().err
    apart = solved()
    chapter = certificate_chapter(replace(apart, views=()), details())
    assert any("correlations between nodes are not known" in note
               for section in chapter.sections for note in section.notes)
