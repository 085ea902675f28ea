# SPDX-License-Identifier: Apache-2.0
"""The calibration report: one HTML file that needs nothing else."""

import base64
import os
from collections.abc import Mapping
from html import escape

import numpy as np

from selfcal_ros.files import write_text
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.html_extras import (
    convention_section,
    extra_sections,
    provenance_section,
)
from selfcal_ros.reporting.html_style import CSS
from selfcal_ros.reporting.maps.plot import error_map_svg, theta_svg, uncertainty_map_svg
from selfcal_ros.reporting.summary.format import printable
from selfcal_ros.reporting.summary.numbers import truth_arrays
from selfcal_ros.reporting.summary.sections import Section, all_sections
from selfcal_ros.reporting.summary.text import state_sentence

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""Content security policy: a browser will not fetch anything, whatever a name contains."""
_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{css}</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""


def save_report(result: CalibrationResult, path: str | os.PathLike, *,
                truth: Mapping[str, np.ndarray] | None = None) -> None:
    """Write the report of a calibration to `path`, atomically.

    Raises
    ------
    InputError
        If `truth` does not fit the map, or the file cannot be written.
    """
    write_text(path, report_html(result, truth=truth))


def report_html(result: CalibrationResult, *,
                truth: Mapping[str, np.ndarray] | None = None) -> str:
    """Return the report as one HTML document with embedded pictures and no outside resource.

    Parameters
    ----------
    result : CalibrationResult
        What was found; all its text is escaped.
    truth : mapping, optional
        ``gx``, ``gy`` in m and ``g_theta`` in rad: adds the comparison and draws it.

    Raises
    ------
    InputError
        If `truth` does not fit the map.
    """
    truth = truth_arrays(result.error_map, truth)
    sections = all_sections(result, truth)
    attention = [s for s in sections if s.title == "Attention"]
    others = [s for s in sections if s.title != "Attention"]
    found = result.observability.identifiable and not result.warnings
    verdict = _text(state_sentence(result))
    parts = [f'<p class="verdict{"" if found else " bad"}">{verdict}</p>',
             *(_section(s, kind="attention") for s in attention), _pictures(result, truth),
             *map(_section, others), *map(_section, extra_sections(result.extra)),
             _section(convention_section(result)), _section(provenance_section(result))]
    title = _text(f"Stage calibration: plan {result.plan_id}")
    return _PAGE.format(policy=POLICY, title=title, css=CSS, body="\n".join(parts))


def _text(value: object) -> str:
    return escape(printable(value))


def _pictures(result: CalibrationResult, truth: Mapping[str, np.ndarray] | None) -> str:
    figures = [("Error of the stage in X and Y: enlarged vectors over their length.",
                error_map_svg(result, truth=truth))]
    if result.artifact.angular_count:
        figures.append(("Error of the stage in θ: distance from the dashed circle.",
                        theta_svg(result, truth=truth)))
    figures.append(("Standard uncertainty of the XY error at every site.",
                    uncertainty_map_svg(result)))
    images = "\n".join(
        f'<figure><img alt="{escape(caption)}" src="data:image/svg+xml;base64,'
        f'{base64.b64encode(svg).decode()}"><figcaption>{escape(caption)}</figcaption></figure>'
        for caption, svg in figures)
    return f'<section class="maps"><h2>Maps</h2><div class="figures">\n{images}\n</div></section>'


def _section(section: Section, kind: str = "") -> str:
    """Return a section with its facts, its table and its notes."""
    parts = [f"<h2>{escape(section.title)}</h2>"]
    if section.facts:
        rows = "".join(f"<tr><th>{escape(label)}</th><td>{escape(value)}</td></tr>"
                       for label, value in section.facts)
        parts.append('<div class="scroll"><table class="facts">'
                     f"<tbody>{rows}</tbody></table></div>")
    if section.table:
        head = "".join(f"<th>{escape(cell)}</th>" for cell in section.table[0])
        rows = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
                       for row in section.table[1:])
        parts.append(f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
                     f"<tbody>{rows}</tbody></table></div>")
    if section.notes:
        items = "".join(f"<li>{escape(note)}</li>" for note in section.notes)
        parts.append(f"<ul>{items}</ul>")
    tag = f'<section class="{kind}">' if kind else "<section>"
    return tag + "\n".join(parts) + "</section>"
