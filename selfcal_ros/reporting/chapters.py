# SPDX-License-Identifier: Apache-2.0
"""The contents of a report, chapter by chapter, for HTML and PDF alike."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal_ros import __version__
from selfcal_ros.errors import printable
from selfcal_ros.estimation.comparison.covariance import plate_as_map
from selfcal_ros.estimation.verdict.uncertainty import Budget, budgets
from selfcal_ros.model.reference import reference_to_dict
from selfcal_ros.model.result import COMBINED, SCHEMA, VERIFICATION, CalibrationResult
from selfcal_ros.outputs import plain
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.reporting.figures.maps import (
    angular_map,
    component_maps,
    error_map,
    uncertainty_map,
)
from selfcal_ros.reporting.figures.places import (
    camera_errors,
    plan_figure,
    rejected_map,
    stage_yaw,
    views_in,
)
from selfcal_ros.reporting.figures.residuals import (
    courses,
    distributions,
    drift_found,
    residual_maps,
    residuals_in,
)
from selfcal_ros.reporting.summary import sections
from selfcal_ros.reporting.summary.numbers import (
    UNKNOWN,
    aligned_numbers,
    camera_facts,
    fixed_column,
    significant,
)
from selfcal_ros.reporting.summary.sections import Section
from selfcal_ros.reporting.words.findings import advice, what_it_is
from selfcal_ros.reporting.words.phrases import dof_text, line_text, recheck_lines
from selfcal_ros.reporting.words.quantities import unit_of
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

MAX_MARKS = 51 * 51
"""Largest plate whose components are shown."""
MAX_ROWS = 200
"""Longest table of a report; the rest is in the result file."""
TITLES = {
    "outliers": "Marks removed or given less weight",
    "validation": "Held-out validation",
    "reference": "Reference length",
}
"""Known extras, in the order in which they are reported; others follow by name."""
DRAWN = {"residuals", "rejected_at"}
"""Extras that are drawn, not tabulated."""
_UNITS = (
    ("_m", "µm", UM_PER_M),
    ("_rad", "arcsec", ARCSEC_PER_RAD),
    ("_um", "µm", 1.0),
    ("_arcsec", "arcsec", 1.0),
    ("_mm", "mm", 1.0),
    ("_s", "s", 1.0),
)
_SENSE = {
    "microscope_moves": "the microscope moves over a resting plate",
    "plate_moves": "the plate rides on the stage under a fixed microscope",
}


def _tables(result: CalibrationResult) -> dict[str, Any]:
    """Return the tables of a result, with what a correction did that was on."""
    tables = {**result.parts.to_dict(), **result.extra}
    if result.verification is not None:
        tables[VERIFICATION] = plain(result.verification)
    return tables


def extra_sections(extra: Mapping[str, Any]) -> list[Section]:
    """Return a section for each extra that is a set of numbers or a table.

    Lengths named ``*_m`` are shown in µm and angles named ``*_rad`` in arcsec. Plain arrays
    and deeper structures are only in the result file.
    """
    names = [
        *(n for n in TITLES if n in extra),
        *sorted(n for n in extra if n not in TITLES),
    ]
    names = [name for name in names if name not in DRAWN]
    sections = [
        _extra_section(name, TITLES.get(name, _words(name).capitalize()), extra[name])
        for name in names
    ]
    return [section for section in sections if section is not None]


def _extra_section(name: str, title: str, value: Any) -> Section | None:
    if isinstance(value, Mapping):
        facts = tuple(
            (_heading(key), _cell(key, item))
            for key, item in value.items()
            if _is_plain(item)
        )
        tables = [item for item in value.values() if _is_table(item)]
        if not facts and not tables:
            return None
        return Section(title, facts, *(_table(tables[0]) if tables else ((), ())))
    if _is_table(value):
        return Section(title, (), *_table(value))
    if _is_plain(value) and value is not None:
        return Section(title, ((_heading(name), _cell(name, value)),))
    return None


def _is_plain(value: Any) -> bool:
    return (
        value is None
        or isinstance(value, str | int | float)
        or (  # or a mark (m, n)
            isinstance(value, list)
            and len(value) in (1, 2)
            and all(type(i) is int for i in value)
        )
    )


def _is_table(value: Any) -> bool:
    return (
        isinstance(value, Sequence)
        and not isinstance(value, str)
        and len(value) > 0
        and all(isinstance(row, Mapping) and row for row in value)
    )


def _table(rows: Sequence[Mapping[str, Any]]) -> tuple[tuple, tuple]:
    """Return the rows below a header of all their plain keys, and a note if some are omitted."""
    keys = [
        k
        for k in dict.fromkeys(key for row in rows for key in row)
        if all(_is_plain(row.get(k)) for row in rows)
        and any(row.get(k) not in (None, "") for row in rows)
    ]
    shown_rows = rows[:MAX_ROWS]
    columns = [_column(key, [row.get(key) for row in shown_rows]) for key in keys]
    table = (tuple(_heading(key) for key in keys), *zip(*columns, strict=True))
    more = len(rows) - len(shown_rows)
    return table, ((f"{more} more rows are in the result file",) if more else ())


def _column(key: str, values: list[Any]) -> list[str]:
    """Return the cells of a column: numbers with equal decimals."""
    if not any(isinstance(v, float) for v in values) or any(
        isinstance(v, str | list) for v in values
    ):
        return [_cell(key, v) for v in values]
    scale = _unit(key)[2]
    numbers = [
        float("nan") if v is None or isinstance(v, bool) else v * scale for v in values
    ]
    return aligned_numbers(numbers)


def _unit(key: str) -> tuple[str, str, float]:
    return next(
        (
            (suffix, unit, scale)
            for suffix, unit, scale in _UNITS
            if str(key).endswith(suffix)
        ),
        ("", "", 1.0),
    )


def _words(key: str) -> str:
    return str(key).replace("_", " ").strip()


def _heading(key: str) -> str:
    suffix, unit, _ = _unit(key)
    return _words(str(key).removesuffix(suffix)) + (f" in {unit}" if unit else "")


def _cell(key: str, value: Any) -> str:
    if value is None:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    scale = _unit(key)[2]
    if isinstance(value, float) or (isinstance(value, int) and scale != 1.0):
        return significant(value * scale)
    return str(value)


ABOUT = {
    "stage": "--stage TEXT",
    "serial_number": "--serial-number TEXT",
    "operator": "--operator TEXT",
}
"""Entries at the head of a report that the readings do not contain -> how to give them."""


def heading(result: CalibrationResult, about: Mapping[str, str]) -> Section:
    """Return what was calibrated, by whom and when.

    `about` overrides the result; what it has beyond `ABOUT`, as the number of a certificate, comes
    first.
    """
    provenance = result.provenance
    facts = {
        **provenance.facts,
        **{key: value for key, value in about.items() if value},
    }
    first, last = (
        str(facts.get(key, "")).replace("T", " ")[:16]
        for key in ("first_exposure", "last_exposure")
    )
    measured = f"{first} to {last.removeprefix(first[:11])} UTC"
    return Section(
        "Calibration",
        (
            *((_words(key), value) for key, value in about.items() if key not in ABOUT),
            *(
                (_words(key), facts.get(key) or f"{UNKNOWN} (not given: {hint})")
                for key, hint in ABOUT.items()
            ),
            ("measured", measured if first else UNKNOWN),
            (
                "evaluated",
                f"{provenance.created[:16].replace('T', ' ')} UTC"
                if provenance.created
                else UNKNOWN,
            ),
        ),
    )


def convention_section(result: CalibrationResult) -> Section:
    """Return the conventions behind the numbers: signs, datum, sense of measurement, coverage."""
    facts = [
        (
            "error",
            "G = indicated − true, stage frame; add +G to a command to reach its position",
        ),
        (
            "XY datum",
            "no translation or rotation over the field; a reference length sets the scale"
            if result.reference
            else "no translation, rotation or magnification over the field (Hu eq. 5)",
        ),
        ("O and R", "Gx = O·y + R·x + Fx, Gy = O·x − R·y + Fy (Hu eq. 6)"),
    ]
    if result.artifact.angular_count:
        facts.append(("θ datum", sections.THETA_DATUM[result.error_map.datum_theta]))
    facts += [
        ("sense", _SENSE.get(result.sense, result.sense)),
        (
            "uncertainty",
            "u is the standard uncertainty (k=1), U = k u the expanded one, k from "
            "Student's t for 95.45 % at the degrees of freedom of the uncertainty",
        ),
        (
            "misalignment",
            "φ is the turn of the plate about its centre, counter-clockwise, tx and "
            "ty its offset, beyond the nominal pose of the view",
        ),
    ]
    return Section("Conventions", tuple(facts))


def text_of(value: Any) -> str:
    """Return a value as text; the entries of a mapping are listed."""
    if isinstance(value, Mapping):
        return ", ".join(
            f"{_words(key)}: {text_of(item)}" for key, item in value.items()
        )
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def provenance_section(result: CalibrationResult) -> Section:
    """Return the provenance of the numbers: input and digest, method, software."""
    source = result.input
    facts = [(_words(key), str(value)) for key, value in source.items() if value]
    facts += [
        (
            "method",
            {
                "joint": "joint least squares of all readings",
                "law": "Hu's closed-form law",
                COMBINED: "weighted mean of several calibrations",
            }.get(result.method, result.method),
        ),
        ("result schema", SCHEMA),
        ("software", f"selfcal_ros {__version__}"),
    ]
    provenance = result.provenance
    facts += [
        (_words(key), text_of(value))
        for key, value in (
            ("created", provenance.created),
            ("solved_by", provenance.version and f"selfcal_ros {provenance.version}"),
            ("run", result.run_id),
            *provenance.facts.items(),
        )
        if value
    ]
    if math.isfinite(provenance.duration_s):
        facts.append(
            (
                "duration",
                f"{provenance.duration_s:.0f} s from the first exposure to the last",
            )
        )
    if length := reference_to_dict(result.reference):
        facts += [
            (f"reference {_words(key)}", text_of(value))
            for key, value in length.items()
            if value != ""
        ]
    return Section("Provenance", tuple(facts))


AT_NODES = (
    "At the nodes: how well the map itself is known. Use it to compare two calibrations, "
    "and for positions that are nodes."
)
ANYWHERE = (
    "Anywhere: with the error of interpolating between the nodes, estimated from the "
    "curvature of the map. Use it for the positions of a corrected machine anywhere; a "
    "finer plate reduces it."
)


@dataclass(frozen=True)
class CaptionedFigure:
    """A drawing with its caption, which `on_screen` completes where there is a pointer."""

    drawing: Drawing
    caption: str
    on_screen: str = ""
    """What a reader at a screen can do with it."""


@dataclass(frozen=True)
class Chapter:
    """A part of a report: figures, then tables; `alert` means that someone must act on it."""

    title: str
    figures: tuple[CaptionedFigure, ...] = ()
    sections: tuple[Section, ...] = ()
    alert: bool = False


def chapters(
    result: CalibrationResult,
    truth: Mapping[str, np.ndarray] | None,
    more: Sequence[Chapter] = (),
) -> list[Chapter]:
    """Return the chapters of a report without empty ones.

    Parameters
    ----------
    result : CalibrationResult
        What was found.
    truth : mapping, optional
        ``gx``, ``gy`` (nx, ny) in m and ``g_theta`` (K,) in rad on the lattice of the map.
    more : sequence of Chapter
        Chapters of others; they follow the uncertainty.
    """
    drafts = [
        Chapter(
            "Attention", sections=(sections.attention_section(result),), alert=True
        ),
        _maps(result, truth),
        _causes(result),
        _uncertainty(result),
        *more,
        _plate(result),
        Chapter(
            "Camera",
            _figures(
                (
                    camera_errors(result),
                    "Each vector points from the true position of a mark in the image "
                    "to the measured one.",
                ),
                (
                    stage_yaw(result),
                    "Rotation of the image, and of whatever the stage carries, at "
                    "each position of the stage.",
                ),
            ),
            (Section("Camera", camera_facts(result)),),
        ),
        _residuals(result),
        _rejected(result),
        Chapter(
            "Measurement",
            _figures(
                (
                    plan_figure(result.plate, views_in(result))
                    if result.views
                    else None,
                    "The plate as the plan places it; the arrow shows how far its "
                    "marked corner has turned.",
                )
            ),
            (sections.measurement_section(result), sections.views_section(result)),
        ),
        Chapter("Details", sections=tuple(extra_sections(_tables(result)))),
        Chapter(
            "How to read the numbers",
            sections=(convention_section(result), provenance_section(result)),
        ),
    ]
    trimmed = [
        Chapter(
            c.title,
            c.figures,
            tuple(s for s in c.sections if s.facts or s.table or s.notes),
            c.alert,
        )
        for c in drafts
    ]
    return [c for c in trimmed if c.figures or c.sections]


def _figures(*pairs: tuple[Drawing | None, str]) -> tuple[CaptionedFigure, ...]:
    return tuple(
        CaptionedFigure(drawing, caption)
        for drawing, caption in pairs
        if drawing is not None
    )


def _causes(result: CalibrationResult) -> Chapter:
    """Return the reasons for the verdict: failed tests, causes with sizes, terms."""
    verdict = result.verdict
    rows = []
    for cause in verdict.causes:
        scale, unit = (
            (1.0, "times") if cause.name == "noise" else unit_of(cause.name, cause.unit)
        )
        rows.append(
            (
                cause.name.replace("_", " "),
                what_it_is(cause),
                *fixed_column([cause.size * scale, cause.u * scale], 3),
                unit,
                f"{cause.p:.1g}",
                advice(cause),
            )
        )
    header = ("cause", "what the readings show", "size", "u", "unit", "p", "remedy")
    return Chapter(
        "Verdict, drift and causes",
        _figures(
            (
                drift_found(result),
                "The drift that the term removed from the readings: plate relative "
                "to microscope, within each view.",
            )
        ),
        (
            Section(
                "Verdict",
                (("verdict", verdict.sentence),) if verdict.sentence else (),
                notes=tuple(f"failed: {reason}" for reason in verdict.reasons),
            ),
            _change(result),
            Section(
                "Likely causes, the most likely first",
                table=(header, *rows) if rows else (),
            ),
            sections.terms_section(result),
            sections.noise_section(result),
        ),
    )


def _change(result: CalibrationResult) -> Section:
    """Return what a recheck found; nothing of another result."""
    recheck = result.recheck
    if recheck is None:
        return Section("Change")
    title = f"Change since {printable(recheck.of)}"
    return Section(title, notes=tuple(recheck_lines(recheck)))


MAP = "Map"
"""Title of the chapter of the map of the stage."""


def _maps(result: CalibrationResult, truth: Mapping[str, np.ndarray] | None) -> Chapter:
    """Return the error and its uncertainty, first together, then by component."""
    caption = (
        "Each vector points from the true position of the stage to the indicated one."
    )
    vectors = CaptionedFigure(
        error_map(result, truth),
        caption,
        on_screen="Point at a site to read its numbers.",
    )
    figures = [
        vectors,
        *_figures(
            (
                uncertainty_map(result),
                "How well each node is known: the larger U of x and y. Edges and "
                "corners are covered by fewer views. Unknown nodes are grey.",
            ),
            (
                component_maps(result),
                "Gx and Gy at one scale, and below them their uncertainties.",
            ),
        ),
    ]
    if result.artifact.angular_count:
        figures += _figures(
            (
                angular_map(result, truth),
                "Error of the angle at every line; it is zero on the dashed circle.",
            )
        )
    tables = [sections.error_section(result)]
    if truth is not None:
        tables.append(sections.truth_section(result.error_map, truth))
    return Chapter(MAP, tuple(figures), tuple(tables))


def _plate(result: CalibrationResult) -> Chapter:
    """Return the map of the plate, shown as that of the stage."""
    plate = plate_as_map(result)
    if not plate.error_map.valid.any():
        return Chapter("Plate")
    pairs: list[tuple[Drawing | None, str]] = [
        (
            error_map(plate, of="plate"),
            "Each vector points from the nominal to the true position of a mark on the plate.",
        )
    ]
    if plate.artifact.m.size <= MAX_MARKS:
        pairs.append(
            (
                component_maps(plate, of="plate"),
                "Ax and Ay at one scale, and below them their uncertainties.",
            )
        )
    if np.isfinite(plate.error_map.g_theta).any():
        pairs.append(
            (angular_map(plate, of="plate"), "Error of the angle of every line.")
        )
    return Chapter("Plate", _figures(*pairs))


def _uncertainty(result: CalibrationResult) -> Chapter:
    """Return both kinds of U and their uses."""
    rows, tables = [], []
    for budget in budgets(result):
        unit, scale = (
            ("µm", UM_PER_M) if budget.unit == "m" else ("arcsec", ARCSEC_PER_RAD)
        )
        numbers = [budget.u_rms, budget.u_max, budget.U_rms, budget.U_max]
        rows.append(
            (
                _where(budget),
                *fixed_column([value * scale for value in numbers]),
                unit,
                f"{budget.k:.2f}",
                dof_text(budget.dof),
            )
        )
        if budget.anywhere:
            tables.append(_budget_table(budget, unit, scale))
    if not rows:
        return Chapter("Uncertainty")
    header = (
        "known",
        "u rms",
        "u largest",
        "U rms",
        "U largest",
        "unit",
        "k",
        "degrees of freedom",
    )
    return Chapter(
        "Uncertainty",
        sections=(
            Section(
                "Two kinds of U, for 95.45 %",
                table=(header, *rows),
                notes=(AT_NODES, ANYWHERE),
            ),
            *tables,
        ),
    )


def _budget_table(budget: Budget, unit: str, scale: float) -> Section:
    """Return the lines of a budget."""
    effects = [
        aligned_numbers([getattr(line, name) * scale for line in budget.lines])
        for name in ("effect_rms", "effect_max")
    ]
    rows = [
        (
            line.component,
            line.kind,
            *effect,
            unit,
            dof_text(line.dof),
            line.source,
            line.text or line_text(line),
        )
        for line, *effect in zip(budget.lines, *effects, strict=True)
    ]
    header = (
        "component",
        "type",
        "u rms",
        "u largest",
        "unit",
        "degrees of freedom",
        "source",
        "from",
    )
    name = "x or y" if budget.quantity == "xy" else "θ"
    return Section(f"Uncertainty budget (GUM): {name}", table=(header, *rows))


def _where(budget: Budget) -> str:
    if budget.quantity == "xy":
        return "x or y, anywhere" if budget.anywhere else "x or y, at the nodes"
    return "θ, anywhere" if budget.anywhere else "θ, at the lines"


def _residuals(result: CalibrationResult) -> Chapter:
    view_residuals = residuals_in(result)
    pairs = (
        (
            residual_maps(result, view_residuals),
            "Residuals of the fit at each mark. Random directions are noise; "
            "neighbours that point the same way are an effect outside the model.",
        ),
        (
            distributions(view_residuals, "xy"),
            "Bars against the normal curve of the same rms, and the same residuals "
            "against normal quantiles: dots off the line at its ends are outliers.",
        ),
        (distributions(view_residuals, "theta"), "The same for the angular lines."),
        (
            courses(view_residuals, result.noise.sigma_xy),
            "Means over sixtieths of the view's duration. A curve that leaves the "
            "band shows a drift.",
        ),
    )
    return Chapter("Residuals", _figures(*pairs))


def _rejected(result: CalibrationResult) -> Chapter:
    return Chapter(
        "Rejected readings",
        _figures(
            (
                rejected_map(result),
                "Many at one place: dirt or damage on the plate or the stage. Many "
                "in one row: a disturbance at that time. Detections without an encoder sample "
                "have no position.",
            )
        ),
        (sections.rejected_section(result),),
    )
