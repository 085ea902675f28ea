# SPDX-License-Identifier: Apache-2.0
"""What a report holds, chapter by chapter, before it becomes a page or a PDF."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from selfcal_ros.estimation.verdict.uncertainty import Budget, budgets
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.extras import convention_section, extra_sections, provenance_section
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.reporting.figures.maps import (
    angular_map,
    component_maps,
    error_map,
)
from selfcal_ros.reporting.figures.places import plan_figure, rejected_map, views_in
from selfcal_ros.reporting.figures.residuals import (
    courses,
    distributions,
    drift_found,
    residual_maps,
    residuals_in,
)
from selfcal_ros.reporting.summary import sections
from selfcal_ros.reporting.summary.format import aligned_numbers, fixed_column, printable
from selfcal_ros.reporting.summary.sections import Section
from selfcal_ros.reporting.words.findings import advice, line_text, unit_of, what_it_is
from selfcal_ros.reporting.words.tables import dof_text
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

AT_NODES = ("At the nodes: how well the map itself is known. Take it to compare two calibrations, "
            "and for positions that are nodes.")
ANYWHERE = ("Anywhere: with the error of interpolating between the nodes, which the curvature of "
            "the map tells. Take it for what a corrected machine does at any position; a finer "
            "plate makes it smaller.")


@dataclass(frozen=True)
class Figure:
    """A drawing and what to read from it."""

    drawing: Drawing
    caption: str


@dataclass(frozen=True)
class Chapter:
    """A part of a report: figures, then tables; `alert` marks what a person has to act on."""

    title: str
    figures: tuple[Figure, ...] = ()
    sections: tuple[Section, ...] = ()
    alert: bool = False


def chapters(result: CalibrationResult, truth: Mapping[str, np.ndarray] | None,
             more: Sequence[Chapter] = ()) -> list[Chapter]:
    """Return the chapters of a report; those with nothing to say are left out.

    Parameters
    ----------
    result : CalibrationResult
        What was found.
    truth : mapping, optional
        ``gx``, ``gy`` (nx, ny) in m and ``g_theta`` (K,) in rad on the lattice of the map.
    more : sequence of Chapter
        Chapters of others; they follow the uncertainty.
    """
    found = [
        Chapter("Attention", sections=(sections.attention_section(result),), alert=True),
        _causes(result), _maps(result, truth), _uncertainty(result), *more,
        _residuals(result), _rejected(result),
        Chapter("Measurement", _figures(
            (plan_figure(result.artifact, views_in(result)) if result.views else None,
             "The plate as the plan lays it; the arrow leads the corner from where it is without a "
             "turn.")), (sections.measurement_section(result), sections.views_section(result))),
        Chapter("Details", sections=tuple(extra_sections(result.extra))),
        Chapter("How to read the numbers", sections=(convention_section(result),
                                                     provenance_section(result)))]
    kept = [Chapter(c.title, c.figures, tuple(s for s in c.sections
                                              if s.facts or s.table or s.notes), c.alert)
            for c in found]
    return [c for c in kept if c.figures or c.sections]


def _figures(*pairs: tuple[Drawing | None, str]) -> tuple[Figure, ...]:
    return tuple(Figure(drawing, caption) for drawing, caption in pairs if drawing is not None)


def _causes(result: CalibrationResult) -> Chapter:
    """Return why the verdict is what it is: failed tests, causes with sizes, terms."""
    verdict = result.verdict
    rows = []
    for cause in verdict.causes:
        scale, unit = (1.0, "times") if cause.name == "noise" else unit_of(cause.name, cause.unit)
        rows.append((cause.name.replace("_", " "), printable(what_it_is(cause)), *fixed_column(
            [cause.size * scale, cause.u * scale], 3), unit, f"{cause.p:.1g}",
            printable(advice(cause))))
    header = ("cause", "what the readings show", "size", "u", "unit", "p", "remedy")
    return Chapter("Verdict, drift and causes", _figures(
        (drift_found(result), "What the term drift took off the readings: the plate against the "
                              "microscope, within each view.")), (
        Section("Verdict", (("verdict", printable(verdict.sentence)),) if verdict.sentence else (),
                notes=tuple(f"failed: {printable(reason)}" for reason in verdict.reasons)),
        Section("Likely causes, the most likely first", table=(header, *rows) if rows else ()),
        sections.terms_section(result), sections.noise_section(result.noise)))


def _maps(result: CalibrationResult, truth: Mapping[str, np.ndarray] | None) -> Chapter:
    pairs: list[tuple[Drawing | None, str]] = [
        (error_map(result, truth), "Each vector leads from where the stage is to where its "
                                   "encoders say it is. A pointer shows the numbers of a site."),
        (component_maps(result), "Gx and Gy at one scale, and below how well each is known. Sites "
                                 "that are not known are grey. Edges and corners are seen by fewer "
                                 "views.")]
    if result.artifact.angular_count:
        pairs.append((angular_map(result, truth), "Error of the angle at every line; on the "
                                                  "dashed circle there is none."))
    tables = [sections.error_section(result)]
    if truth is not None:
        tables.append(sections.truth_section(result.error_map, truth))
    return Chapter("Map", _figures(*pairs), tuple(tables))


def _uncertainty(result: CalibrationResult) -> Chapter:
    """Return both kinds of U, each with what it is for."""
    rows, tables = [], []
    for budget in budgets(result):
        unit, scale = ("µm", UM_PER_M) if budget.unit == "m" else ("arcsec", ARCSEC_PER_RAD)
        numbers = [budget.u_rms, budget.u_max, budget.U_rms, budget.U_max]
        rows.append((_where(budget), *fixed_column([value * scale for value in numbers]), unit,
                     f"{budget.k:.2f}", dof_text(budget.dof)))
        if budget.anywhere:
            tables.append(_budget_table(budget, unit, scale))
    if not rows:
        return Chapter("Uncertainty")
    header = ("known", "u rms", "u largest", "U rms", "U largest", "unit", "k", "dof")
    return Chapter("Uncertainty", sections=(Section(
        "Two kinds of U, for 95.45 %", table=(header, *rows), notes=(AT_NODES, ANYWHERE)), *tables))


def _budget_table(budget: Budget, unit: str, scale: float) -> Section:
    """Return the lines of a budget."""
    effects = [aligned_numbers([getattr(line, name) * scale for line in budget.lines])
               for name in ("effect_rms", "effect_max")]
    rows = [(line.component, line.kind, *effect, unit, dof_text(line.dof), line.source,
             printable(line.text or line_text(line)))
            for line, *effect in zip(budget.lines, *effects, strict=True)]
    header = ("component", "type", "u rms", "u largest", "unit", "dof", "source", "from")
    name = "x or y" if budget.quantity == "xy" else "θ"
    return Section(f"Uncertainty budget (GUM): {name}", table=(header, *rows))


def _where(budget: Budget) -> str:
    if budget.quantity == "xy":
        return "x or y, anywhere" if budget.anywhere else "x or y, at the nodes"
    return "θ, anywhere" if budget.anywhere else "θ, at the lines"


def _residuals(result: CalibrationResult) -> Chapter:
    found = residuals_in(result)
    pairs = (
        (residual_maps(result, found), "What the fit leaves at each mark. Random directions are "
         "noise; neighbours that point the same way are an effect outside the model."),
        (distributions(found, "xy"), "Bars against the normal curve of the same rms, and the same "
         "residuals against normal quantiles: dots off the line at its ends are outliers."),
        (distributions(found, "theta"), "The same of the angular lines."),
        (courses(found, result.noise.sigma_xy), "Means over a sixtieth of the view's time each. A "
         "course that leaves the band is a drift."))
    return Chapter("Residuals", _figures(*pairs))


def _rejected(result: CalibrationResult) -> Chapter:
    return Chapter("Rejected readings", _figures(
        (rejected_map(result), "Many at one place: dirt or damage on the plate or the stage. Many "
         "in one row: a moment of the run. Detections without an encoder sample have no place.")),
        (sections.rejected_section(result),))
