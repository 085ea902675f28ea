# SPDX-License-Identifier: Apache-2.0
"""The summary of a result: its sections as text or for a report, and one sentence on its state."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from selfcal_ros.blocks import blocks
from selfcal_ros.errors import InputError, printable
from selfcal_ros.estimation.comparison.covariance import first_order_u
from selfcal_ros.estimation.verdict.uncertainty import budgets
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.error_map import (
    ErrorMap,
    ThetaDatum,
    along_axes,
    error_at_edges,
)
from selfcal_ros.model.findings import ViewLeftOut
from selfcal_ros.model.pose import without_cell
from selfcal_ros.model.result import CalibrationResult, ViewResult
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.outputs import to_ascii
from selfcal_ros.reporting.summary.numbers import (
    UNKNOWN,
    MapFigures,
    aligned,
    aligned_numbers,
    anywhere_m,
    arcsec,
    camera_facts,
    counted,
    decimals_for,
    fixed,
    fixed_column,
    map_figures,
    numeric_columns,
    p_text,
    significant,
    truth_figures,
    um,
    with_u,
)
from selfcal_ros.reporting.words.findings import assumption_text
from selfcal_ros.reporting.words.phrases import counted_views, dof_text, of_few_read
from selfcal_ros.reporting.words.quantities import size_of, unit_of
from selfcal_ros.units import ARCSEC_PER_RAD, MM_PER_M, RAD_PER_MRAD, UM_PER_M


@dataclass(frozen=True)
class Section:
    """A titled part of a summary: labelled facts, one table with a header, and notes."""

    title: str
    facts: tuple[tuple[str, str], ...] = ()
    table: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()


def all_sections(
    result: CalibrationResult, truth: Mapping[str, np.ndarray] | None = None
) -> list[Section]:
    """Return the sections of a summary in reading order."""
    sections = [
        verdict_section(result),
        measurement_section(result),
        views_section(result),
        error_section(result),
        terms_section(result),
        noise_section(result),
        Section("Camera", camera_facts(result)),
    ]
    if truth is not None:
        sections.append(truth_section(result.error_map, truth))
    sections += [rejected_section(result), attention_section(result)]
    return [s for s in sections if s.facts or s.table or s.notes]


def verdict_section(result: CalibrationResult) -> Section:
    """Return the verdict with failed tests and their likely causes; empty if none failed."""
    verdict = result.verdict
    notes = list(verdict.reasons)
    notes += [
        f"likely cause: {cause.text} ({p_text(cause.p, 1)})" for cause in verdict.causes
    ]
    return Section(_TITLES[verdict.grade], notes=(*notes, *enlargement_texts(verdict)))


def enlargement_texts(verdict: Verdict) -> list[str]:
    """Return a line for each cause of an enlarged uncertainty."""
    return [
        f"U enlarged by {printable(item.name)}: u {unit(item.u_rms)} rms, "
        f"{unit(item.u_max)} largest"
        for item, unit in (
            (item, arcsec if item.unit == "rad" else um) for item in verdict.enlarged_by
        )
    ]


THETA_DATUM = {
    ThetaDatum.XY_AXES: "xy_axes: the angular errors at 0°, 90°, 180° and 270° are tied to the "
    "slopes of the XY error along the four half axes (Hu eqs. 9, 27)",
    ThetaDatum.ZERO_MEAN: "zero_mean: the angular errors add up to zero",
}
"""Which constant of the angular errors is convention, in words."""

_TITLES = {
    Grade.GOOD: "Verdict",
    Grade.ENLARGED: "Verdict: GOOD WITHIN AN ENLARGED U",
    Grade.NOT_QUALIFIED: "Verdict: NOT QUALIFIED",
}


def terms_section(result: CalibrationResult) -> Section:
    """Return the estimates of the terms of the model."""
    rows = []
    for term in result.model.terms:
        block = blocks().get(term.name)
        of_images = block is not None and block.of_images
        if of_images or (term.source == "default" and term.size_used is None):
            continue  # part of the camera, or a line of the budget
        for item in term.estimates:
            how = (
                "free"
                if term.size is None
                else size_of(term.name, item.unit, term.size)
            )
            if term.size_used is not None:
                used = size_of(term.name, item.unit, term.size_used)
                how += f", too small: {used} used"
            scale, unit = unit_of(term.name, item.unit)
            value, u = item.value * scale, item.u * scale
            # two figures of u, and the value to the same place
            decimals = decimals_for([u], 2)
            rows.append(
                (
                    term.name,
                    item.view or "all",
                    item.component,
                    fixed(value, decimals),
                    fixed(u, decimals),
                    unit,
                    how,
                )
            )
    if not rows:
        return Section("Terms of the model")
    header = ("term", "view", "component", "value", "u (k=1)", "unit", "size")
    return Section("Terms of the model", table=(header, *rows))


def _nodes(grid: MapGrid, shape: tuple[int, int]) -> str:
    return (
        f"{shape[0]} × {shape[1]} nodes, pitch {grid.pitch_m * MM_PER_M:.6g} mm, "
        f"{grid.interpolation}"
    )


def measurement_section(result: CalibrationResult) -> Section:
    """Return plan, plate, method and input."""
    artifact = result.plate
    nx, ny = artifact.shape
    pitch = artifact.grid_pitch_m * MM_PER_M
    marks = (
        f"list of {nx} marks, neighbours {pitch:.6g} mm apart (median)"
        if artifact.marks
        else f"{nx} × {ny} marks, pitch {pitch:.6g} mm"
    )
    x, y = (2 * half * pitch for half in artifact.reach)
    observability = result.observability
    measured_names = {
        without_cell(view.name) for view in filter(_in_the_map(result), result.views)
    }
    views = (
        _mean_text(result)
        or f"{counted_views(result.views)}, {len(measured_names)} measured"
    )
    facts = [
        ("plan", f"{result.plan_id or UNKNOWN}: {views}"),
        (
            "plate",
            f"{marks}, field {x:.6g} × {y:.6g} mm, {artifact.angular_count or 'no'} angular lines",
        ),
        *(
            [("map", _nodes(artifact.map_grid, artifact.field.shape))]
            if artifact.map_grid
            else []
        ),
        *(
            [
                (
                    "angular map",
                    f"Fourier series, {counted(artifact.harmonics, 'harmonic')}",
                )
            ]
            if artifact.harmonics
            else []
        ),
        (
            "method",
            f"{result.method}, {result.sense.replace('_', ' ')}, "
            f"{result.model.misalignment} misalignments",
        ),
        *(
            []
            if result.parts.combined
            else [
                (
                    "identifiable",
                    f"{'yes' if observability.identifiable else 'NO'} (rank "
                    f"{observability.rank} of {observability.unknowns} unknowns, "
                    f"{counted(observability.deficiency, 'undetermined mode')})",
                )
            ]
        ),
    ]
    plate_map = result.artifact_map
    if math.isfinite(plate_map.magnification):
        value, u = (
            x * UM_PER_M for x in (plate_map.magnification, plate_map.u_magnification)
        )
        k = " (k=1)" if math.isfinite(u) else ""
        facts.append(
            (
                "magnification",
                f"encoders indicate the plate {'larger' if value >= 0 else 'smaller'} than "
                f"nominal by {with_u(abs(value), u)}{k} µm/m",
            )
        )
    if result.input.get("file"):
        digest = str(result.input.get("sha256") or "")
        facts.append(
            (
                "input",
                str(result.input["file"])
                + (f" (sha256 {digest[:16]})" if digest else ""),
            )
        )
    return Section("Measurement", tuple(facts))


def measured(view: ViewResult) -> bool:
    """Return whether anything was measured in a view."""
    return view.used > 0 or math.isfinite(view.phi)


def _in_the_map(result: CalibrationResult) -> Callable[[ViewResult], bool]:
    """Return whether a view was measured, and no finding says that most of it is missing."""
    missing = {
        finding.view for finding in result.findings if isinstance(finding, ViewLeftOut)
    }
    return lambda view: measured(view) and without_cell(view.name) not in missing


def views_section(result: CalibrationResult) -> Section:
    """Return the table of views: nominal pose, misalignment, detections."""
    artifact, views = result.plate, result.views
    columns = [
        [v.name for v in views],
        [
            pose_text(v.rotation, (v.translation_x, v.translation_y), artifact)
            for v in views
        ],
        fixed_column([v.phi / RAD_PER_MRAD for v in views]),
        fixed_column([v.tx * UM_PER_M for v in views]),
        fixed_column([v.ty * UM_PER_M for v in views]),
        [str(v.used) for v in views],
        [str(v.rejected) for v in views],
    ]
    pose = f"pose ({'mm' if artifact.marks else 'pitches'})"
    header = ("view", pose, "φ mrad", "tx µm", "ty µm", "used", "rejected")
    return Section(
        "Views and their misalignment",
        table=(header, *zip(*columns, strict=True)) if views else (),
    )


def pose_text(
    rotation_rad: float, translation_m: tuple[float, float], artifact: Artifact
) -> str:
    """Return a nominal pose as ``90° (+1, 0)``: turn, and pitches (mm for a list of marks)."""
    unit = 1 / MM_PER_M if artifact.marks else artifact.grid_pitch_m
    x, y = (
        f"{value / unit:+.6g}" if round(value / unit, 9) else "0"
        for value in translation_m
    )
    return f"{math.degrees(rotation_rad):.6g}° ({x}, {y})"


def position_text(emap: ErrorMap, site: tuple[int, int] | None) -> str:
    """Return the position of a site as ``at x 40 mm, y -20 mm``; empty for None."""
    if site is None:
        return ""
    pitch = emap.artifact.grid_pitch_m
    at = emap.artifact.places(*map(np.array, site))
    x, y = (f"{float(coordinate) * pitch * MM_PER_M:.6g}" for coordinate in at)
    return f"at x {x} mm, y {y} mm"


def place_text(emap: ErrorMap, site: tuple[int, int] | None) -> str:
    """Return a site and its position as ``at x 40 mm, y -20 mm (site 4, -2)``."""
    return (
        ""
        if site is None
        else f"{position_text(emap, site)} (site {site[0]}, {site[1]})"
    )


def error_section(result: CalibrationResult) -> Section:
    """Return errors and uncertainties of the XY map and of the angular map."""
    emap = result.error_map
    figures = map_figures(emap)
    facts = [
        (
            "largest error",
            f"{um(figures.max_error_m)} {place_text(emap, figures.max_site)}",
        ),
        ("rms error", f"{um(figures.rms_error_m)} per axis"),
    ]
    if figures.n_known < figures.n_sites:
        facts.append(("sites known", f"{figures.n_known} of {figures.n_sites}"))
    u_o, u_r = _first_order_u(result)
    facts += [
        *_spread_facts(
            "uncertainty",
            um,
            (figures.rms_u_m, figures.max_u_m),
            (result.noise.k_xy, result.noise.dof_of("xy")),
        ),
        *_between_nodes(result),
        *_edges(result),
        (
            "non-orthogonality",
            _slope_text(
                emap, (emap.nonorthogonality, u_o), "O", "µrad", "out of square by 2|O|"
            ),
        ),
        (
            "scale difference",
            _slope_text(
                emap,
                (emap.scale_difference, u_r),
                "R",
                "µm/m",
                "X and Y differ by 2|R|",
            ),
        ),
    ]
    if emap.artifact.angular_count:
        facts += _theta_facts(result)
    return Section("Stage error (indicated − true)", tuple(facts))


def _between_nodes(result: CalibrationResult) -> list[tuple[str, str]]:
    """Return U of one coordinate anywhere in the field, where the map is interpolated."""
    try:
        result_budgets = budgets(result)
    except InputError:  # damaged factors: the map can be shown all the same
        return []
    return [
        (
            "anywhere",
            f"U {um(budget.U_rms)} rms, at most {um(budget.U_max)} "
            f"(k={budget.k:.3g}), the map interpolated between its nodes",
        )
        for budget in result_budgets
        if budget.quantity == "xy" and budget.anywhere
    ]


def _edges(result: CalibrationResult) -> list[tuple[str, str]]:
    """Return the outermost rows of nodes that depart from the course of those inside."""
    emap = result.error_map
    if result.is_fitted_between_nodes:
        return []
    artifact, facts = emap.artifact, []
    edges = along_axes(error_at_edges, emap)
    for of, axis, side in zip(*edges.nonzero(), strict=True):
        last = (2 * side - 1) * artifact.half[axis]
        next_to_last, at = (
            f"{place * artifact.grid_pitch_m * MM_PER_M:.6g}"
            for place in (last - np.sign(last), last)
        )
        facts.append(
            (
                f"edge {'xy'[axis]} {at} mm",
                f"G{'xy'[of]} departs by {um(2 * edges[of, axis, side])} from its course inside: "
                f"U is up to about as large between {'xy'[axis]} {next_to_last} and {at} mm; let "
                "the field end where the stage runs freely",
            )
        )
    return facts


def _first_order_u(result: CalibrationResult) -> tuple[float, float]:
    """Return the standard uncertainties of O and R; NaN if unknown."""
    try:
        return first_order_u(result) if result.has_uncertainty else (math.nan, math.nan)
    except InputError:  # damaged factors: the map can be shown all the same
        return math.nan, math.nan


def _slope_text(
    emap: ErrorMap,
    slope_and_u: tuple[float, float],
    symbol: str,
    unit: str,
    meaning: str,
) -> str:
    """Return a slope, with its standard uncertainty, and what it means."""
    length = (max(emap.artifact.shape) - 1) * emap.artifact.grid_pitch_m
    value, u = slope_and_u
    k = " (k=1)" if math.isfinite(u) else ""
    return (
        f"{symbol} {with_u(value * UM_PER_M, u * UM_PER_M)}{k} {unit} = {um(value * length)} over "
        f"{length * MM_PER_M:.6g} mm; {meaning} = {significant(2 * abs(value) * UM_PER_M)} "
        f"{unit}"
    )


def _theta_facts(result: CalibrationResult) -> list[tuple[str, str]]:
    emap = result.error_map
    figures = map_figures(emap)
    at = ""
    if figures.max_line is not None:
        degrees = figures.max_line * 360 / emap.artifact.angular_count
        at = f" at line {figures.max_line}, {degrees:.6g}°"
    facts = [
        ("largest θ error", arcsec(figures.max_theta_rad) + at),
        ("rms θ error", arcsec(figures.rms_theta_rad)),
    ]
    if figures.n_lines_known < figures.n_lines:
        facts.append(("lines known", f"{figures.n_lines_known} of {figures.n_lines}"))
    return [
        *facts,
        *_spread_facts(
            "θ uncertainty",
            arcsec,
            (figures.rms_u_theta_rad, figures.max_u_theta_rad),
            (result.noise.k_theta, result.noise.dof_of("theta")),
        ),
        ("θ datum", THETA_DATUM[emap.datum_theta]),
    ]


def _spread_facts(
    label: str,
    unit: Callable[[float], str],
    u: tuple[float, float],
    student: tuple[float, float],
) -> list[tuple[str, str]]:
    """Return u and U (rms, largest), with coverage factor and degrees of freedom."""
    (rms_u, max_u), (k, dof) = u, student
    if not math.isfinite(rms_u):
        return [(label, "not known")]
    facts = [(label, f"u {unit(rms_u)} rms, {unit(max_u)} largest (k=1)")]
    if math.isfinite(k):
        facts.append(
            (
                "",
                f"U {unit(k * rms_u)} rms, {unit(k * max_u)} largest (k={k:.3g}, "
                f"95.45 %, {dof_text(dof)} degrees of freedom)",
            )
        )
    return facts


def noise_section(result: CalibrationResult) -> Section:
    """Return the noise of one reading: used, from repeats, from residuals, and their ratio.

    A mean of maps has no readings of its own.
    """
    if result.parts.combined:
        return Section("Noise")
    noise = result.noise
    rows = []
    for label, name, scale, unit in (
        ("x, y", "xy", UM_PER_M, "µm"),
        ("θ", "theta", ARCSEC_PER_RAD, "arcsec"),
    ):
        sigma, repeats, residuals = (
            getattr(noise, f"sigma_{name}{suffix}")
            for suffix in ("", "_repeats", "_residuals")
        )
        if not any(map(math.isfinite, (sigma, repeats, residuals))):
            continue
        dofs = [
            getattr(noise, f"dof_{name}_{kind}") for kind in ("repeats", "residuals")
        ]
        ratio = residuals / repeats if repeats > 0 else float("nan")
        texts = aligned_numbers(
            [value * scale for value in (sigma, repeats, residuals)]
        )
        rows.append(
            (
                f"{label} ({unit})",
                *texts[:2],
                _dof(dofs[0]),
                texts[2],
                _dof(dofs[1]),
                significant(ratio),
            )
        )
    header = (
        "one reading",
        "σ used",
        "repeats",
        "dof",
        "residuals",
        "dof",
        "residuals/repeats",
    )
    if not rows:
        return Section(
            "Noise",
            notes=(
                "not known: no mark was read twice and no detection declared its uncertainty",
            ),
        )
    return Section("Noise", table=(header, *rows), notes=_turned_notes(result))


def _turned_notes(result: CalibrationResult) -> tuple[str, ...]:
    """Return what was taken out of the repeats of lines."""
    names = ", ".join(f"'{name}'" for name in result.parts.turned or ())
    text = (
        f"all lines turned slowly while they were read, in {names}: this was taken out"
    )
    return (text,) if names else ()


def _dof(dof: float) -> str:
    """Return degrees of freedom as an integer; a dash where there are none."""
    return dof_text(dof) if dof else UNKNOWN


def truth_section(emap: ErrorMap, truth: Mapping[str, np.ndarray]) -> Section:
    """Return the comparison with a known truth, after removing the datum difference."""
    f = truth_figures(emap, truth)
    facts = [
        ("largest |G − truth|", f"{um(f.largest_m)} {place_text(emap, f.site)}"),
        ("rms", f"{um(f.rms_m)} per axis"),
        *_in_u(f.rms_in_u, f.largest_in_u, f.within_2u),
    ]
    if emap.artifact.angular_count and truth.get("g_theta") is not None:
        at = "" if f.line is None else f" at line {f.line}"
        facts += [
            ("largest θ difference", arcsec(f.largest_theta_rad) + at),
            ("rms θ difference", arcsec(f.rms_theta_rad)),
            *_in_u(f.rms_theta_in_u, f.largest_theta_in_u, f.theta_within_2u),
        ]
    return Section("Against the known truth (datum difference removed)", tuple(facts))


def _in_u(in_u: float, largest_in_u: float, within: float) -> list[tuple[str, str]]:
    if not math.isfinite(in_u):
        return []
    return [
        (
            "",
            f"{significant(in_u)} u rms, {significant(largest_in_u)} u largest, "
            f"{100 * within:.1f} % within 2 u",
        )
    ]


def rejected_section(result: CalibrationResult) -> Section:
    """Return rejected detections by reason, most frequent first; nothing of a mean of maps."""
    if result.parts.combined:
        return Section("Rejected detections")
    counts = sorted(result.rejected.items(), key=lambda item: (-item[1], item[0]))
    total = sum(result.rejected.values())
    used = sum(v.used for v in result.views)
    facts = [
        ("detections", f"{used} used, {total} rejected"),
        *((reason.replace("_", " "), str(count)) for reason, count in counts),
    ]
    return Section("Rejected detections", tuple(facts))


def attention_section(result: CalibrationResult) -> Section:
    """Return unseen modes, advice and warnings, which require action."""
    observability = result.observability
    lines = [f"undetermined mode: {mode.text}" for mode in observability.modes]
    lines += [f"advice: {advice.text}" for advice in observability.advice]
    lines += [f"warning: {warning}" for warning in result.warnings]
    return Section("Attention", notes=tuple(lines))


def state_sentence(result: CalibrationResult) -> str:
    """Return the state of a calibration in one sentence."""
    observability = result.observability
    figures = map_figures(result.error_map)
    if not observability.identifiable:
        advice = (
            f"; {printable(observability.advice[0].text)}"
            if observability.advice
            else ""
        )
        return (
            f"Not a calibration: {counted(observability.deficiency, 'mode')} of the stage error "
            f"cannot be determined from the marks that were read{advice}."
        )
    if not figures.n_known and not figures.n_lines_known:
        return "No calibration: no site of the error map is known."
    k = result.noise.k_theta
    text = (
        f"{_map_clause(result, figures)}{_theta_clause(figures, k)}{_warnings(result)}."
    )
    if result.verdict.grade is Grade.GOOD and result.recheck is None:
        assumed = assumption_text(result)
        return text + f" {assumed}." * bool(assumed)
    sentence = printable(result.verdict.sentence).rstrip(".")
    return (
        f"{sentence}. {text}"
        if result.verdict.qualified
        else f"{sentence}. Map as it is: {text}"
    )


def state_line(result: CalibrationResult) -> str:
    """Return grade, error and U in one line; its figures fit what `ros2 topic echo` shows.

    It shows 128 characters. What U owes to assumptions and the reason of a grade below good follow.
    """
    figures = map_figures(result.error_map)
    verdict = result.verdict
    if result.verification is not None:
        return result.verification.sentence
    if not result.observability.identifiable or not (
        figures.n_known or figures.n_lines_known
    ):
        return state_sentence(result)

    clauses = []
    if figures.n_known:
        clauses.append(f"error up to {um(figures.max_error_m)}")
        clauses.append(f"U {um(result.noise.k_xy * figures.max_u_m)} at the nodes")
        clauses.append(f"{um(anywhere_m(result)[2])} anywhere")
    line = ", ".join(clauses)
    if figures.n_lines_known:
        u_theta = arcsec(result.noise.k_theta * figures.max_u_theta_rad)
        line += f"{'; ' * bool(clauses)}θ up to {arcsec(figures.max_theta_rad)}, U {u_theta}"

    if result.recheck is not None and verdict.qualified:
        return f"{verdict.sentence}: {line}."
    if assumed := assumption_text(result) if verdict.qualified else "":
        line = f"{line}; {assumed}"
    if verdict.grade is Grade.GOOD:
        return f"Good: {line}."
    lead = "Good within an enlarged U" if verdict.qualified else "Not qualified"
    reasons = [
        f"most likely {cause.text}" for cause in verdict.causes
    ] or verdict.reasons
    return f"{lead}: {'; '.join((line, *map(printable, reasons[:1])))}."


def _mean_text(result: CalibrationResult) -> str:
    """Return ``mean of 2 maps``; nothing for a map of readings."""
    mean = result.parts.combined
    return "" if mean is None else f"mean of {counted(len(mean.runs), 'map')}"


def _map_clause(result: CalibrationResult, figures: MapFigures) -> str:
    share = (
        f" at {figures.n_known} of {figures.n_sites} sites"
        if figures.n_known < figures.n_sites
        else ""
    )
    views = counted_views(result.views, _in_the_map(result)) + of_few_read(
        result.findings
    )
    mean = _mean_text(result)
    text = f"{mean.capitalize()}{share}" if mean else f"Calibrated{share} from {views}"
    if not figures.n_known:
        return text
    k = result.noise.k_xy
    sites = "each" if share else "every site"
    uncertainty = "uncertainty not known"
    between = anywhere_m(result)[2]
    if math.isfinite(figures.max_u_m):
        also = f", any place to ±{um(between)}" if math.isfinite(between) else ""
        uncertainty = (
            f"{sites} known to ±{um(k * figures.max_u_m)}{also} or better (k={k:.3g})"
        )
    where = position_text(result.error_map, figures.max_site)
    return f"{text}: largest error {um(figures.max_error_m)} {where}, {uncertainty}"


def _theta_clause(figures: MapFigures, k: float) -> str:
    if not figures.n_lines_known:
        return ""
    u = figures.max_u_theta_rad
    spread = f", known to ±{arcsec(k * u)}" if math.isfinite(k * u) else ""
    return f"; largest θ error {arcsec(figures.max_theta_rad)}{spread}"


def _warnings(result: CalibrationResult) -> str:
    return f"; {counted(len(result.warnings), 'warning')}" if result.warnings else ""


def summary_text(
    result: CalibrationResult,
    *,
    truth: Mapping[str, np.ndarray] | None = None,
    ascii_only: bool = False,
) -> str:
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
        return printable(to_ascii(text) if ascii_only else text)

    lines = [spell(state_sentence(result))]
    for section in all_sections(result, truth):
        lines += ["", spell(section.title), *_section_lines(section, spell)]
    return "\n".join(lines)


def _section_lines(section: Section, spell: Callable[[str], str]) -> list[str]:
    """Return facts, table and notes of a section as aligned lines; spelled before aligning."""
    facts = [(spell(label), spell(value)) for label, value in section.facts]
    table = [[spell(cell) for cell in row] for row in section.table]
    numeric = numeric_columns(section.table) if section.table else []
    text_columns = next((i for i, number in enumerate(numeric) if number), len(numeric))
    return (
        aligned(facts, left=2)
        + aligned(table, left=max(text_columns, 1))
        + [f"  {spell(note)}" for note in section.notes]
    )
