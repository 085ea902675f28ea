# SPDX-License-Identifier: Apache-2.0
"""One screen for the person at the machine: verdict, views, errors, uncertainty, noise."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.summary.format import (
    aligned,
    can_print_symbols,
    counted,
    numeric_columns,
    printable,
    to_ascii,
)
from selfcal_ros.reporting.summary.numbers import (
    MapFigures,
    SummaryNumbers,
    map_figures,
    summary_numbers,
)
from selfcal_ros.reporting.summary.sections import (
    Section,
    all_sections,
    arcsec,
    place_text,
    um,
    views_done,
)

__all__ = ["SummaryNumbers", "can_print_symbols", "state_sentence", "summary_numbers",
           "summary_text"]


def state_sentence(result: CalibrationResult) -> str:
    """Return where the calibration stands, in one sentence that a person understands."""
    seen, figures = result.observability, map_figures(result.error_map)
    if not seen.identifiable:
        advice = f"; {printable(seen.advice[0])}" if seen.advice else ""
        return (f"Not a calibration: {counted(seen.deficiency, 'mode')} of the stage error cannot "
                f"be seen from the marks that were read{advice}.")
    if not figures.n_known and not figures.n_lines_known:
        return "No calibration: not one site of the error map is known."
    k = result.noise.k_theta
    text = f"{_map_clause(result, figures)}{_theta_clause(figures, k)}{_warnings(result)}."
    if result.verdict.grade is Grade.GOOD:
        return text
    said = printable(result.verdict.sentence).rstrip(".")
    return f"{said}. {text}" if result.verdict.qualified else f"{said}. Map as it is: {text}"


def _map_clause(result: CalibrationResult, figures: MapFigures) -> str:
    share = "" if figures.n_known == figures.n_sites else (
        f" at {figures.n_known} of {figures.n_sites} sites")
    text = f"Calibrated{share} from {counted(views_done(result), 'view')}"
    if not figures.n_known:
        return text
    k = result.noise.k_xy
    known = (f"every site known to ±{um(k * figures.max_u_m)} or better (k={k:.3g})"
             if math.isfinite(figures.max_u_m) else "uncertainty not known")
    where = place_text(result.error_map, figures.max_site).partition(" (")[0]
    return f"{text}: largest error {um(figures.max_error_m)} {where}, {known}"


def _theta_clause(figures: MapFigures, k: float) -> str:
    if not figures.n_lines_known:
        return ""
    u = figures.max_u_theta_rad
    spread = f", known to ±{arcsec(k * u)}" if math.isfinite(k * u) else ""
    return f"; largest θ error {arcsec(figures.max_theta_rad)}{spread}"


def _warnings(result: CalibrationResult) -> str:
    return f"; {counted(len(result.warnings), 'warning')}" if result.warnings else ""


def summary_text(result: CalibrationResult, *, truth: Mapping[str, np.ndarray] | None = None,
                 ascii_only: bool = False) -> str:
    """Return the summary of a calibration as aligned plain text, without a final newline.

    Parameters
    ----------
    result : CalibrationResult
        What was found; unknown values are shown as a dash.
    truth : mapping, optional
        ``gx``, ``gy`` (nx, ny) in m and ``g_theta`` (K,) in rad on the lattice of the map:
        adds the comparison, after removing the datum difference.
    ascii_only : bool
        Spell out µ, θ, φ, ° and the like; see `can_print_symbols`.

    Raises
    ------
    InputError
        If `truth` lacks an array or has another shape.
    """
    def spell(text: str) -> str:
        return to_ascii(text) if ascii_only else text

    lines = [spell(state_sentence(result))]
    for section in all_sections(result, truth):
        lines += ["", spell(section.title), *_section_lines(section, spell)]
    return "\n".join(lines)


def _section_lines(section: Section, spell: Callable[[str], str]) -> list[str]:
    """Return facts, table and notes of a section as aligned lines; spelled before aligning."""
    facts = [(spell(label), spell(value)) for label, value in section.facts]
    table = [[spell(cell) for cell in row] for row in section.table]
    numeric = numeric_columns(section.table) if section.table else []
    left = next((i for i, number in enumerate(numeric) if number), len(numeric))
    return (aligned(facts, left=2) + aligned(table, left=max(left, 1))
            + [f"  {spell(note)}" for note in section.notes])
