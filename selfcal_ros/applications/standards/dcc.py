# SPDX-License-Identifier: Apache-2.0
"""A digital calibration certificate: DCC 3.3.0 of the PTB with quantities in D-SI 2.2.1."""

from collections.abc import Iterator, Sequence
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from selfcal_ros import __version__
from selfcal_ros.applications.standards.details import UNITS
from selfcal_ros.applications.standards.statements import (
    AGREEMENT,
    TRACEABILITY,
    distance_text,
    is_traceable,
    known_plate_texts,
    method_name,
    require_certifiable,
    statement_texts,
)
from selfcal_ros.apply import StageMap
from selfcal_ros.blocks import blocks
from selfcal_ros.errors import InputError, printable, visible
from selfcal_ros.estimation.comparison.covariance import first_order_u
from selfcal_ros.estimation.verdict.uncertainty import budgets
from selfcal_ros.model.pose import without_cell
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.chapters import convention_section, text_of
from selfcal_ros.reporting.words.phrases import dof_text, line_text
from selfcal_ros.reporting.words.tables import quantity_text

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
VERSION = "3.3.0"
PROBABILITY = "0.9545"
MAX_COVARIANCE = 21 * 21
"""Largest number of nodes whose covariance is written: 10 MB."""
TEXTS_ARE_IN = "en"
"""Language of what the program states; names and remarks are in that of the laboratory."""
METRE, RADIAN, ONE = r"\metre", r"\radian", r"\one"


def certificate(
    result: CalibrationResult,
    details: dict[str, Any],
    *,
    covariance: bool = False,
    not_qualified: bool = False,
) -> bytes:
    """Return the certificate of a calibration as XML.

    Parameters
    ----------
    result : CalibrationResult
        A calibration with uncertainties, worded.
    details : dict
        As `selfcal_ros.applications.standards.details.details_from_dict` gives it.
    covariance : bool
        Whether the covariance of all nodes is included, not only U of distances.
    not_qualified : bool
        Whether a result that is not qualified is certified as such.

    Raises
    ------
    NotIdentifiableError
        If the result has no map.
    InputError
        If the result is not qualified and `not_qualified` is False, or has no uncertainties.
    """
    stage = StageMap(result)
    require_certifiable(result, details)
    if not result.verdict.qualified and not not_qualified:
        raise InputError(
            "certificate",
            f"the result is not qualified: {printable(result.verdict.sentence)}",
            "calibrate again, or let the certificate state it with --not-qualified",
        )
    for prefix, uri in (("dcc", DCC), ("si", SI)):
        ET.register_namespace(prefix, uri)
    root = _dcc(
        "digitalCalibrationCertificate",
        _administration(result, details),
        _results(stage, details, covariance=covariance),
    )
    root.set("schemaVersion", VERSION)
    ET.indent(root, " ")
    return ET.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"


def _node(namespace: str, name: str, *content: ET.Element | str | None) -> ET.Element:
    """Return an element with children, or with a text; None among the children is left out."""
    element = ET.Element(f"{{{namespace}}}{name}")
    for part in content:
        if isinstance(part, str):
            element.text = visible(part)
        elif part is not None:
            element.append(part)
    return element


def _dcc(name: str, *content: ET.Element | str | None) -> ET.Element:
    return _node(DCC, name, *content)


def _si(name: str, *content: ET.Element | str | None) -> ET.Element:
    return _node(SI, name, *content)


def _dcc_if_given(name: str, value: str | None) -> ET.Element | None:
    return _dcc(name, value) if value else None


def _content(name: str, *texts: str) -> ET.Element:
    """Return an element of a text type, each text a paragraph."""
    return _dcc(name, *(_dcc("content", text) for text in texts))


def _administration(result: CalibrationResult, details: dict[str, Any]) -> ET.Element:
    core, item, lab = details["certificate"], details["item"], details["laboratory"]
    order = core.get("order")
    persons = [
        _dcc(
            "respPerson",
            _dcc("person", _content("name", person["name"])),
            _dcc_if_given("role", person.get("role")),
            _dcc("mainSigner", str(not i).lower()),
        )
        for i, person in enumerate(details["persons"])
    ]
    return _dcc(
        "administrativeData",
        _dcc("dccSoftware", _software()),
        _dcc(
            "coreData",
            _dcc("countryCodeISO3166_1", core["country"]),
            *(
                _dcc("usedLangCodeISO639_1", code)
                for code in dict.fromkeys((core["language"], TEXTS_ARE_IN))
            ),
            _dcc("mandatoryLangCodeISO639_1", TEXTS_ARE_IN),
            _dcc("uniqueIdentifier", core["id"]),
            _dcc(
                "identifications",
                _identification("calibrationLaboratory", order, "order"),
            )
            if order
            else None,
            _dcc("beginPerformanceDate", core["begin"]),
            _dcc("endPerformanceDate", core["end"]),
            _dcc("performanceLocation", core["place"]),
            _dcc("issueDate", core["issued"]),
        ),
        _dcc("items", _dcc("item", *_thing(item))),
        _dcc(
            "calibrationLaboratory",
            _dcc_if_given("calibrationLaboratoryCode", lab.get("code")),
            _dcc("contact", *_contact(lab)),
        ),
        _dcc("respPersons", *persons),
        _dcc("customer", *_contact(details["customer"])),
        _dcc("statements", *_statements(result, details)),
    )


def _software() -> ET.Element:
    return _dcc(
        "software",
        _content("name", "selfcal_ros"),
        _dcc("release", __version__),
        _dcc("type", "application"),
    )


def _identification(issuer: str, value: str, name: str) -> ET.Element:
    return _dcc(
        "identification",
        _dcc("issuer", issuer),
        _dcc("value", value),
        _content("name", name),
    )


def _thing(item: dict[str, str]) -> Iterator[ET.Element | None]:
    """Yield the parts of an item or an equipment."""
    yield _content("name", item["name"])
    descriptions = [
        f"{word}: {item[key]}"
        for word, key in (
            ("certificate", "certificate"),
            ("valid until", "valid_until"),
        )
        if key in item
    ]
    if descriptions:
        yield _content("description", ", ".join(descriptions))
    if "manufacturer" in item:
        yield _dcc("manufacturer", _content("name", item["manufacturer"]))
    yield _dcc_if_given("model", item.get("model"))
    if "serial_number" in item:
        yield _dcc(
            "identifications",
            _identification("manufacturer", item["serial_number"], "serial number"),
        )


def _contact(details: dict[str, str]) -> Iterator[ET.Element | None]:
    yield _content("name", details["name"])
    yield _dcc_if_given("eMail", details.get("email"))
    yield _dcc_if_given("phone", details.get("phone"))
    yield _dcc(
        "location",
        _dcc("city", details["city"]),
        _dcc("countryCode", details["country"]),
        _dcc_if_given("postCode", details.get("post_code")),
        _dcc_if_given("street", details.get("street")),
        _dcc_if_given("streetNo", details.get("number")),
    )


def _statements(
    result: CalibrationResult, details: dict[str, Any]
) -> Iterator[ET.Element]:
    """Yield the statements on traceability, verdict, uncertainty and scope, and the remarks."""
    flags = {
        TRACEABILITY: ("traceable", is_traceable(result)),
        AGREEMENT: ("valid", result.verdict.qualified),
    }
    for name, texts in statement_texts(result):
        key, value = flags.get(name, ("", False))
        flag = _dcc(key, str(value).lower()) if key else None
        yield _dcc(
            "statement",
            _content("name", name),
            flag if key == "traceable" else None,
            _content("declaration", *texts),
            flag if key == "valid" else None,
        )
    for remark in details["remarks"]:
        yield _dcc(
            "statement",
            _content("name", "Remark"),
            _content("declaration", remark["text"]),
        )


def _results(
    stage: StageMap, details: dict[str, Any], *, covariance: bool
) -> ET.Element:
    result = stage.result
    core = details["certificate"]
    conditions = [
        _dcc(
            "influenceCondition",
            _content("name", item["name"]),
            _dcc("data", _condition(item)),
        )
        for item in details["conditions"]
    ]
    equipment = [
        _dcc("measuringEquipment", *_thing(item)) for item in details["equipment"]
    ]
    return _dcc(
        "measurementResults",
        _dcc(
            "usedMethods",
            _dcc(
                "usedMethod",
                _content("name", method_name(result)),
                _content(
                    "description", *known_plate_texts(result), *_model_texts(result)
                ),
                _dcc("norm", "JCGM 100:2008"),
            ),
        ),
        _dcc("usedSoftware", _software()),
        _dcc("measuringEquipments", *equipment) if equipment else None,
        _dcc("influenceConditions", *conditions),
        _dcc(
            "measurementResult",
            _content("name", "Error map of the stage"),
            _content(
                "description",
                *(f"{name}: {text}" for name, text in convention_section(result).facts),
            ),
            _dcc(
                "results",
                *_maps(stage),
                *_budgets(result),
                *_correlations(stage, covariance=covariance),
            ),
            _dcc(
                "measurementMetaData",
                *(
                    _dcc(
                        "metaData",
                        _content("name", name),
                        _content("description", text),
                    )
                    for name, text in _meta(result, core)
                ),
            ),
        ),
    )


def _model_texts(result: CalibrationResult) -> list[str]:
    """Return the model: misalignments and terms with their sizes."""
    texts = [
        f"{result.model.misalignment} misalignments of the plate in each view; method: "
        f"{result.method}, {result.sense.replace('_', ' ')}"
    ]
    for term in result.model.terms:
        block = blocks().get(term.name)
        if block is not None and block.of_lines and not result.plate.angular_count:
            continue
        size = (
            "free"
            if term.size is None
            else f"standard deviation {term.solved_with:.3g}"
        )
        of_images = (
            block is not None and block.of_microscope and result.camera is not None
        )
        source = (
            "determined by the images"
            if of_images and term.source == "default"
            else (term.source)
        )
        texts.append(f"term {term.name}: {size}, {source}")
    return texts


def _meta(result: CalibrationResult, core: dict[str, str]) -> Iterator[tuple[str, str]]:
    """Yield what else is known of the measurement, by name."""
    noise, provenance = result.noise, result.provenance
    yield "plan", result.plan_id
    for name in ("file", "sha256"):
        if result.input.get(name):
            yield f"readings, {name}", result.input[name]
    for name, value in zip(("file", "sha256"), result.read_from or (), strict=False):
        yield f"result, {name}", value
    for name, value in (
        ("run", result.run_id),
        ("evaluated", provenance.created),
        *provenance.facts.items(),
        ("clock of the readings", core.get("clock")),
    ):
        if value:
            yield name.replace("_", " "), text_of(value)
    if np.isfinite(provenance.duration_s):
        yield "duration", f"{provenance.duration_s:.0f} s"
    for run in result.parts.combined.runs if result.parts.combined else ():
        yield (
            f"readings of {run.file}",
            (
                f"run {run.run_id or 'unknown'}, sha256 {run.sha256 or 'unknown'}, weight "
                f"{run.weight:.3g}"
            ),
        )
    yield from _views(result)
    for kind, name in (("xy", "x and y"), ("theta", "theta")):
        if np.isfinite(result.error_map.of(kind)[1]).any():
            k, dof = getattr(noise, f"k_{kind}"), dof_text(noise.dof_of(kind))
            yield (
                f"coverage of {name}",
                f"k = {k:.3g} for 95.45 %, {dof} degrees of freedom",
            )
    for warning in result.warnings:
        yield "warning", warning


def _views(result: CalibrationResult) -> Iterator[tuple[str, str]]:
    """Yield the name of each view, and its pose and readings."""
    for view in result.views:
        name = without_cell(view.name)
        cell = view.name.removeprefix(name)
        yield (
            f"view {name}, cell {cell}" if cell else f"view {name}",
            (
                f"turned {np.degrees(view.rotation):.6g}°, shifted ({view.translation_x:.6g}, "
                f"{view.translation_y:.6g}) m, {view.used} readings, {view.rejected} rejected"
            ),
        )


def _condition(item: dict[str, Any]) -> ET.Element:
    if "text" in item and "value" not in item:
        return _content("text", item["text"])
    return _dcc(
        "quantity",
        _content("description", item["text"]) if "text" in item else None,
        _real(item["value"], UNITS[item["unit"]], item.get("u")),
    )


def _real(
    value: float, unit: str, u: float | None = None, k: float = 2.0
) -> ET.Element:
    """Return a number with its unit, and U = k u if u is known."""
    return _si(
        "real",
        _si("value", _number(value)),
        _si("unit", unit),
        _si(
            "measurementUncertaintyUnivariate",
            _si(
                "expandedMU",
                _si("valueExpandedMU", _number(k * u)),
                _si("coverageFactor", f"{k:.5g}"),
                _si("coverageProbability", PROBABILITY),
            ),
        )
        if u is not None
        else None,
    )


def _number(value: float) -> str:
    return f"{value:.9g}"


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(map(_number, values))


def _list(
    name: str, values: np.ndarray, unit: str, u: tuple[np.ndarray, float] | None = None
) -> ET.Element:
    """Return a list of numbers; `u` are their standard uncertainties and the coverage factor."""
    spread = None
    if u is not None:
        spread = _si(
            "measurementUncertaintyUnivariateXMLList",
            _si(
                "expandedMUXMLList",
                _si("valueExpandedMUXMLList", _numbers(u[1] * u[0])),
                _si("coverageFactorXMLList", f"{u[1]:.4f}"),
                _si("coverageProbabilityXMLList", PROBABILITY),
            ),
        )
    return _dcc(
        "quantity",
        _content("name", name),
        _si(
            "realListXMLList",
            _si("valueXMLList", _numbers(values)),
            _si("unitXMLList", unit),
            spread,
        ),
    )


def _maps(stage: StageMap) -> Iterator[ET.Element]:
    """Yield the maps: positions, errors and U of all known nodes and lines."""
    result = stage.result
    emap = stage.error_map
    plate = stage.error_map.artifact
    has_u = emap.valid & np.isfinite(emap.u_gx + emap.u_gy)
    k = result.noise.k_xy
    yield _result(
        "Error G = indicated - true in x and y at the nodes",
        _dcc(
            "list",
            _list("x", plate.x_m[has_u], METRE),
            _list("y", plate.y_m[has_u], METRE),
            _list("Gx", emap.gx[has_u], METRE, (emap.u_gx[has_u], k)),
            _list("Gy", emap.gy[has_u], METRE, (emap.u_gy[has_u], k)),
        ),
    )
    u_o, u_r = (u if np.isfinite(u) else None for u in first_order_u(result))
    if np.isfinite(emap.nonorthogonality + emap.scale_difference):
        yield _result(
            "Squareness and difference of scales",
            _dcc(
                "list",
                _scalar(
                    "non-orthogonality O, Gx = O y + R x, Gy = O x - R y",
                    emap.nonorthogonality,
                    RADIAN,
                    u=u_o,
                    k=k,
                ),
                _scalar("scale difference R", emap.scale_difference, ONE, u=u_r, k=k),
            ),
        )
    lines = np.isfinite(emap.g_theta + emap.u_g_theta)
    if lines.any():
        angle = 2 * np.pi * np.flatnonzero(lines) / plate.angular_count
        yield _result(
            "Error of the angle at the lines, indicated - true",
            _dcc(
                "list",
                _list("angle", angle, RADIAN),
                _list(
                    "Gtheta",
                    emap.g_theta[lines],
                    RADIAN,
                    (emap.u_g_theta[lines], result.noise.k_theta),
                ),
            ),
        )


def _result(name: str, *data: ET.Element) -> ET.Element:
    return _dcc("result", _content("name", name), _dcc("data", *data))


def _scalar(
    name: str,
    value: float,
    unit: str,
    text: str = "",
    *,
    u: float | None = None,
    k: float = 2.0,
) -> ET.Element:
    return _dcc(
        "quantity",
        _content("name", name),
        _content("description", text) if text else None,
        _real(value, unit, u, k),
    )


def _budgets(result: CalibrationResult) -> Iterator[ET.Element]:
    """Yield the budgets: the standard uncertainty of each component, rms over the field."""
    for budget in budgets(result):
        unit = METRE if budget.unit == "m" else RADIAN
        rows = [
            _scalar(
                f"{line.component} (type {line.kind})",
                line.effect_rms,
                unit,
                f"largest {line.effect_max:.3g}, {dof_text(line.dof)} degrees of freedom, "
                f"{line.source}: {line.text or line_text(line)}",
            )
            for line in budget.lines
        ]
        most = "at most " if budget.anywhere else ""
        rows.append(
            _scalar(
                "combined standard uncertainty",
                budget.u_rms,
                unit,
                f"largest {most}{budget.u_max:.3g}, {dof_text(budget.dof)} degrees of freedom",
            )
        )
        rows.append(
            _scalar(
                "expanded uncertainty",
                budget.U_rms,
                unit,
                f"k = {budget.k:.3g} for 95.45 %, largest {most}{budget.U_max:.3g}",
            )
        )
        yield _result(
            f"Uncertainty budget: {quantity_text(budget)}", _dcc("list", *rows)
        )


def _correlations(stage: StageMap, *, covariance: bool) -> Iterator[ET.Element]:
    """Yield U of distances, a + b L, and the covariance of all nodes if requested."""
    emap = stage.error_map
    plate = stage.error_map.artifact
    has_u = emap.valid & np.isfinite(emap.u_gx + emap.u_gy)
    try:
        a, b = stage.length_uncertainty()
    except InputError as error:
        if covariance:
            raise
        yield _result(
            "Correlations",
            _content(
                "text", f"The correlations between nodes are not known ({error.what})."
            ),
        )
        return
    yield _result(
        "Expanded uncertainty of the distance L of two points, U = a + b L",
        _content("text", distance_text(stage, a, b)),
        _dcc("list", _scalar("a", a, METRE), _scalar("b", b, ONE)),
    )
    if not covariance:
        return
    if has_u.sum() > MAX_COVARIANCE:
        raise InputError(
            "--covariance",
            f"{int(has_u.sum())} nodes",
            "omit it: U of distances is given; the covariance is written for up to "
            f"{MAX_COVARIANCE} nodes",
        )
    full = stage.covariance(plate.x_m[has_u], plate.y_m[has_u])
    columns = (
        _si(
            "columnXMLList",
            _si(
                "covarianceXMLList",
                _si("valueXMLList", _numbers(column)),
                _si("unitXMLList", METRE + r"\tothe{2}"),
            ),
        )
        for column in full
    )
    yield _result(
        "Covariance of Gx, then Gy, at the nodes",
        _dcc(
            "quantity",
            _content("name", "Gx, then Gy"),
            _si(
                "realListXMLList",
                _si(
                    "valueXMLList",
                    _numbers(np.concatenate([emap.gx[has_u], emap.gy[has_u]])),
                ),
                _si("unitXMLList", METRE),
                _si(
                    "measurementUncertaintyMultivariateXMLList",
                    _si(
                        "ellipsoidalRegionMUXMLList",
                        _si("covarianceMatrixXMLList", *columns),
                        _si(
                            "coverageFactorXMLList", f"{_of_ellipsoid(stage, full):.4f}"
                        ),
                        _si("coverageProbabilityXMLList", PROBABILITY),
                    ),
                ),
            ),
        ),
    )


def _of_ellipsoid(stage: StageMap, covariance: np.ndarray) -> float:
    """Return the coverage factor of the ellipsoid of all nodes together (JCGM 102:2011, 6.5.2).

    The datum leaves the covariance less than its full rank.
    """
    from scipy.stats import chi2, f  # half a second, for this alone

    rank = int(
        np.linalg.matrix_rank(
            covariance, tol=1e-7 * np.abs(covariance).max(), hermitian=True
        )
    )
    dof = stage.result.noise.dof_of("xy")
    square = (
        rank * f.ppf(float(PROBABILITY), rank, dof)
        if np.isfinite(dof)
        else chi2.ppf(float(PROBABILITY), rank)
    )
    return float(np.sqrt(square))
