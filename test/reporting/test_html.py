# SPDX-License-Identifier: Apache-2.0
import base64
import hashlib
import json
import re
import sys
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest

from selfcal_ros import __version__
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.joint.problem import coverage_factor
from selfcal_ros.model.findings import Cause, InWords, Remedy
from selfcal_ros.model.result import Observability, result_from_dict, result_to_dict
from selfcal_ros.model.verdict import Grade, Provenance, Verdict
from selfcal_ros.reporting.chapters import (
    MAX_ROWS,
    convention_section,
    extra_sections,
    heading,
)
from selfcal_ros.reporting.report import (
    page,
    printed_page,
    report_html,
    write_report,
)
from selfcal_ros.reporting.turning import script
from test.support.results import chapters_of, html_of, known_result, with_residuals

VOID = {"meta", "img", "br"}


class Checker(HTMLParser):
    """Collects tags, addresses and text, and insists that elements nest."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses, self.text, self.tags = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [
            value for name, value in attrs if name in ("src", "href", "srcset")
        ]
        assert not any(name.startswith("on") for name, _ in attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def parsed(html):
    checker = Checker()
    checker.feed(html)
    checker.close()
    assert checker.open == []
    return checker


def test_report_is_whole_and_needs_nothing_from_outside():
    result, truth = known_result(5, 24)
    html = html_of(result, truth)
    page = parsed(html)
    assert page.addresses and all(a.startswith("#") for a in page.addresses)
    assert all(f'id="{a[1:]}"' in html for a in page.addresses)
    assert page.tags.count("svg") == 8
    assert not {"link", "iframe", "object", "img"} & set(page.tags)
    own = html.replace(script(), "")
    assert "url(" not in own and "@import" not in own
    assert "default-src 'none'" in html


def test_a_browser_runs_the_script_of_the_page_and_no_other():
    html = html_of(known_result(5, 24)[0])
    (text,) = re.findall(r"<script>(.*?)</script>", html, flags=re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', html)
    assert f"script-src 'sha256-{digest}'" in policy
    assert not re.search(r"\bfetch\(|XMLHttpRequest\(\)|\beval\(|new Function", text)


def test_the_map_that_turns_has_the_numbers_of_the_result():
    result, _ = known_result(5, 0)
    gx = result.error_map.gx.copy()
    gx[1, 2] = np.nan
    (text,) = re.findall(
        r'data-map="([^"]*)"',
        html_of(replace(result, error_map=replace(result.error_map, gx=gx))),
    )
    found = json.loads(unescape(text))
    assert found["gx"][1][2] is None and found["gy"][1][2] is None
    assert found["gx"][0][3] == pytest.approx(1e6 * gx[0, 3], abs=1e-4)
    assert found["x"][0] == pytest.approx(1e3 * result.artifact.x_m[0, 0])
    assert found["u"][4][0] == pytest.approx(
        1e6
        * result.noise.k_xy
        * max(result.error_map.u_gx[4, 0], result.error_map.u_gy[4, 0]),
        abs=1e-4,
    )


def test_large_and_unknown_maps_do_not_turn():
    assert "data-map" not in html_of(known_result(53, 0)[0])
    result, _ = known_result(3, 0)
    nothing = np.full((3, 3), np.nan)
    unknown = replace(result.error_map, gx=nothing, gy=nothing)
    assert "<script" not in html_of(replace(result, error_map=unknown))


@pytest.fixture(scope="module")
def printer():
    """Return WeasyPrint, an extra, which also needs a library of the system."""
    try:
        import weasyprint
    except (ImportError, OSError) as error:
        pytest.skip(f"WeasyPrint cannot be loaded: {error}")
    return weasyprint


def test_a_pdf_is_the_page_printed(tmp_path, printer, monkeypatch):
    result, pages = replace(with_residuals(), plan_id="長 $x$ \x1b"), []

    def counted(page):
        document = page.render()
        pages.extend(document.pages)
        return document.write_pdf()

    monkeypatch.setattr(printer.HTML, "write_pdf", counted)
    write_report(result, tmp_path / "a.pdf")
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF") and len(pages) > 3
    html = report_html(result, chapters_of(result), heading(result, {}), printed=True)
    assert "<script" not in html and "<nav" not in html and "Point at" not in html


@pytest.mark.parametrize("height", [1524, 2708])
def test_figures_taller_than_a_page_are_printed_smaller(printer, height):
    """As the residuals of ten views, or of all cells of images."""
    svg = f'<svg class="figure" viewBox="0 0 480 {height}" width="480"></svg>'
    figure = f"<figure>{svg}<figcaption>What it shows</figcaption></figure>"
    body = f'<div class="figures">{3 * figure}</div>'
    assert printed_page(page("tall", body), "a.pdf").startswith(b"%PDF")


def test_a_page_for_paper_has_its_colours_in_the_figures():
    result, _ = known_result(3, 8)
    html = report_html(result, chapters_of(result), heading(result, {}), printed=True)
    figures = re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL)
    assert len(figures) > 4
    for figure in figures:
        assert "var(" not in figure and 'class="f-' not in figure
        assert 'fill="#' in figure and 'fill="none"' in figure


def test_a_pdf_without_its_printer_is_refused_with_two_ways_out(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        InputError,
        match=r"a\.pdf: a PDF is printed by WeasyPrint, which is not "
        r"installed; pip install 'selfcal_ros\[pdf\]', or write a\.html and print "
        r"it in a browser$",
    ):
        write_report(known_result(3, 0)[0], tmp_path / "a.pdf")


def test_a_printer_that_lacks_a_library_is_said_so(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    with pytest.raises(InputError, match="which cannot be loaded"):
        write_report(known_result(3, 0)[0], tmp_path / "a.pdf")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("grade", list(Grade))
def test_the_banner_has_the_colour_of_the_verdict(grade):
    result = replace(
        known_result(3, 0)[0],
        verdict=Verdict(grade, sentence="Verdict"),
        warnings=("torn bag",),
    )
    html = html_of(result)
    assert re.findall(r'<p class="verdict (\w+)">', html) == [str(grade)]


def test_the_sentence_comes_first_and_the_maps_before_the_tables():
    html = html_of(with_residuals())
    places = [
        html.index(text)
        for text in (
            '<p class="verdict',
            "<th>stage</th>",
            "Error of the stage, G",
            "Uncertainty of the map, U",
            "<h2>Verdict, drift and causes</h2>",
        )
    ]
    assert places == sorted(places)


def test_a_row_names_its_cells_for_narrow_screens():
    html = html_of(known_result(3, 0)[0])
    assert re.search(r'<td class="\w" data-name="dof">\d+</td>', html)


def test_every_colour_of_a_figure_is_defined_for_light_and_dark():
    html = html_of(with_residuals(), known_result(5, 24)[1])
    used = set(re.findall(r'class="(?:[^"]* )?[fs]-(\w+)', html))
    light, dark = re.findall(r":root \{ [^}]*\}", html)[:2]
    assert len(used) > 20
    for name in used:
        assert f"--{name}: #" in light and f"--{name}: #" in dark
        assert f"svg.figure .f-{name}{{fill:var(--{name})}}" in html
    assert "@media screen and (prefers-color-scheme: dark)" in html


def test_figures_follow_what_the_result_keeps():
    bare, rich = (
        parsed(html_of(r)).text for r in (known_result(5, 24)[0], with_residuals())
    )
    titles = (
        "Residuals of the grid readings by view",
        "Distribution of the grid residuals",
        "Distribution of the angular residuals",
        "Mean residuals over the time",
        "Positions of rejected grid readings",
    )
    for title in titles:
        assert not any(title in text for text in bare)
        assert any(title in text for text in rich)


def test_both_kinds_of_uncertainty_are_told_with_what_each_is_for():
    result, _ = known_result(5, 24)
    page = parsed(html_of(result))
    text = "|".join(page.text)
    for where in (
        "x or y, at the nodes",
        "x or y, anywhere",
        "θ, at the lines",
        "θ, anywhere",
    ):
        assert text.count(where) == 1
    assert "At the nodes: how well the map itself is known." in text
    assert "Anywhere: with the error of interpolating" in text
    # U of the nodes is k u, written out: 2.0009 * 0.9 * 0.02 um * 1.28 at the corner
    u = result.error_map.u_gx.max() * 1e6
    assert f"|{coverage_factor(2904) * u:.3f}" in text.replace(" ", "")


def test_causes_come_as_a_table_with_one_unit_each():
    result, _ = known_result(3, 0)
    causes = (
        Cause(
            name="drift",
            size=8e-8,
            u=3e-9,
            unit="m",
            p=1e-9,
            view="run 2: shift x",
            axis="x",
            remedies=(
                Remedy("model", "drift:8e-8"),
                Remedy("action", "measure there and back"),
            ),
        ),
        Cause(name="noise", size=2.0, u=0.1, unit="m/m", p=2e-4, view="a"),
    )
    verdict = Verdict(
        Grade.NOT_QUALIFIED,
        causes=causes,
        reasons=("grid readings: too much",),
        sentence="Not qualified: most likely drift",
    )
    html = html_of(replace(result, verdict=verdict))
    banner = re.findall(r'<p class="verdict not_qualified">([^<]*)', html)[0]
    assert banner.startswith("Not qualified: most likely drift. Map as it is:")
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", html)
    at = cells.index("drift")
    what = (
        "a drift of 0.0800 ± 0.0030 µm along x during view &#x27;run 2: shift x&#x27;"
    )
    assert cells[at : at + 7] == [
        "drift",
        what,
        "0.0800",
        "0.0030",
        "µm",
        "1e-09",
        "solve with --model drift:8e-8, or measure there and back",
    ]
    assert cells[at + 7 : at + 14] == [
        "noise",
        "2.00 times as much noise in view &#x27;a&#x27; as in the others",
        "2.00",
        "0.10",
        "times",
        "0.0002",
        "measure the view again, and look for a source of vibration",
    ]
    assert "failed: grid readings: too much" in html


def test_the_report_of_a_large_field_stays_small():
    result, _ = known_result(101, 360)
    assert len(html_of(result).encode()) < 2_000_000


def test_report_says_everything():
    result, truth = known_result(5, 24)
    text = " ".join(parsed(html_of(result, truth)).text)
    for expected in (
        "Stage calibration: plan hu",
        "Calibrated from 4 views",
        "shift_x",
        "Non-orthogonality".lower(),
        "scale difference",
        "no encoder sample",
        "Against the known truth",
        "zero_mean: the angular errors add up to zero",
        "ab" * 32,
        f"selfcal_ros {__version__}",
        "joint least squares",
        "add +G to a command",
    ):
        assert expected in text, expected


def test_text_from_files_is_escaped():
    evil = '<script>alert("x")</script>'
    result, _ = known_result(3, 0)
    hostile = replace(
        result,
        plan_id=evil,
        warnings=(evil,),
        rejected={evil: 1},
        input={"file": evil, evil: evil},
        method=evil,
        sense=evil,
        extra={evil: evil, "table": [{evil: evil}]},
        views=(replace(result.views[0], name=evil),),
        observability=Observability(
            1, 2, 1, False, (InWords(text=evil),), (InWords(text=evil),)
        ),
    )
    page = parsed(html_of(hostile))
    assert page.tags.count("script") == 1  # that of the page
    assert evil in "".join(page.text)


def test_a_deficient_plan_is_marked_and_comes_first():
    result, _ = known_result(3, 0)
    seen = Observability(
        1,
        3,
        2,
        False,
        (InWords(text="scale difference"),),
        (InWords(text="add a view turned by 90°"),),
    )
    html = html_of(replace(result, observability=seen))
    assert '<p class="verdict not_qualified">Not a calibration: 2 modes' in html
    assert html.index("advice: add a view turned by 90°") < html.index("<h2>Map</h2>")
    assert '<p class="verdict good">Calibrated' in html_of(result)


def test_unknown_maps_and_plates_without_lines():
    result, _ = known_result(3, 0)
    nothing = np.full((3, 3), np.nan)
    emap = replace(
        result.error_map,
        gx=nothing,
        gy=nothing,
        u_gx=nothing,
        u_gy=nothing,
        nonorthogonality=np.nan,
        scale_difference=np.nan,
    )
    page = parsed(html_of(replace(result, error_map=emap, views=())))
    assert page.tags.count("svg") == 4
    assert "not known" in " ".join(page.text)
    assert "θ datum" not in page.text


def test_rows_and_numbers_are_tabulated_with_units():
    rows = [
        {"view": "a", "rms_m": 1.7e-8, "mark": [1, -2]},
        {"view": "b", "rms_m": 1.23e-6, "exceeds": True},
    ]
    sections = extra_sections(
        {
            "left_over": {"largest_rad": 1e-6, "n": 968, "map": [[1.0]]},
            "validation": rows,
        }
    )
    assert [s.title for s in sections] == ["Held-out validation", "Left over"]
    assert sections[0].table == (
        ("view", "rms in µm", "mark", "exceeds"),
        ("a", "0.017", "1, -2", "–"),
        ("b", "1.230", "–", "yes"),
    )
    assert sections[1].facts == (("largest in arcsec", "0.206"), ("n", "968"))


def test_extras_of_other_forms_are_left_to_the_file():
    assert (
        extra_sections({"covariance": [[1.0]], "empty": {}, "none": None, "rows": []})
        == []
    )
    assert extra_sections({"seed": 7})[0].facts == (("seed", "7"),)
    views = [{"view": "a", "rms_m": 2e-8}]
    nested = extra_sections({"validation": {"rms_m": 1e-8, "views": views}})
    assert nested[0].facts == (("rms in µm", "0.0100"),)
    assert nested[0].table == (("view", "rms in µm"), ("a", "0.0200"))
    long = extra_sections({"outliers": [{"m": i} for i in range(MAX_ROWS + 5)]})[0]
    assert len(long.table) == MAX_ROWS + 1 and long.notes == (
        "5 more rows are in the result file",
    )


def test_a_report_begins_with_stage_serial_number_operator_and_dates():
    result, _ = known_result(3, 8)
    made = Provenance(
        "2026-11-23T08:51:45+00:00",
        3.0,
        "0.1.0",
        {"stage": "bag's"},
        "2026-11-21T15:28:54.617+00:00",
        "2026-11-21T16:29:26.532+00:00",
    )
    result = replace(result, provenance=made)
    found = heading(
        result, {"stage": "XY <1>", "operator": "N. N.", "serial_number": ""}
    )
    assert found.facts == (
        ("stage", "XY <1>"),
        ("serial number", "– (not given: --serial-number TEXT)"),
        ("operator", "N. N."),
        ("measured", "2026-11-21 15:28 to 16:29 UTC"),
        ("evaluated", "2026-11-23 08:51 UTC"),
    )
    assert dict(heading(result, {}).facts)["stage"] == "bag's"
    html = report_html(result, [], found)
    assert (
        html.index('class="verdict') < html.index("XY &lt;1&gt;") < html.index("N. N.")
    )
    late = replace(made, last_exposure="2026-11-22T00:10:00.000+00:00")
    assert dict(heading(replace(result, provenance=late), {}).facts)["measured"] == (
        "2026-11-21 15:28 to 2026-11-22 00:10 UTC"
    )
    bare = heading(replace(result, provenance=Provenance()), {})
    assert all(value.startswith("–") for _, value in bare.facts)


def test_conventions_follow_the_result():
    result, _ = known_result(3, 8)
    facts = dict(convention_section(replace(result, sense="plate_moves")).facts)
    assert facts["sense"] == "the plate rides on the stage under a fixed microscope"
    assert facts["error"].startswith("G = indicated − true")


def test_report_is_repeatable_and_survives_the_json_form(tmp_path):
    result, _ = known_result(3, 8)
    again = result_from_dict(result_to_dict(result), "r.json")
    write_report(result, tmp_path / "a.html")
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == html_of(again)


def test_truth_of_another_lattice_is_refused():
    with pytest.raises(InputError, match=r"^truth gx: has the shape \(3, 3\), the map"):
        html_of(known_result(5, 0)[0], known_result(3, 0)[1])
