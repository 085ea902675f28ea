# SPDX-License-Identifier: Apache-2.0
import io
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from rich.file_proxy import FileProxy

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import first_order_u
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.uncertainty import budgets
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum
from selfcal_ros.model.findings import Cause, InWords
from selfcal_ros.model.result import (
    Noise,
    Observability,
    result_from_dict,
    result_to_dict,
)
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.verdict import (
    Grade,
    ModelResult,
    TermEstimate,
    TermResult,
    Verdict,
)
from selfcal_ros.outputs import can_print_symbols, to_ascii
from selfcal_ros.reporting.summary.numbers import (
    aligned,
    anywhere_m,
    arcsec,
    fixed_column,
    map_figures,
    significant,
    summary_numbers,
    truth_figures,
    um,
)
from selfcal_ros.reporting.summary.sections import (
    place_text,
    pose_text,
    state_line,
    state_sentence,
    summary_text,
)
from selfcal_ros.reporting.words.findings import assumption_text, worded
from test.support.maps import random_map
from test.support.results import known_result
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

UNSEEN = Observability(
    5,
    7,
    2,
    False,
    (InWords(text="non-orthogonality"), InWords(text="scale difference")),
    (InWords(text="add a view turned by 90°"),),
)


def line_with(text, label):
    return next(line for line in text.splitlines() if line.strip().startswith(label))


def test_every_first_sentence_says_what_u_owes_to_a_size_that_is_assumed():
    plan, rng = hu_plan(Artifact(7, 0.01, 8), repeats=3), np.random.default_rng(4)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    readings = simulate_measurements(
        truth, plan, rng, sigma_m=5e-9, sigma_theta_rad=1e-6
    )
    found = worded(calibrate(readings))
    assumed = assumption_text(found)
    assert assumed.startswith(
        "U assumes a plate that bends by 0.005 µm (k=1) from view to view"
    )
    for text in (
        state_sentence(found),
        state_line(found),
        found.verdict.sentence,
        worded(result_from_dict(result_to_dict(found), "file")).verdict.sentence,
    ):
        assert text.count("assumes a plate that bends") == 1, text
    # a solution with the larger size has no larger U, and hardly a smaller one
    larger = calibrate(
        readings, Options(terms=parse_terms(["plate_shape:15e-9"], "test"))
    )
    told = float(
        re.search(r"times as much would make it up to ([\d.]+) µm", assumed)[1]
    )
    assert (
        1 <= told / (larger.noise.k_xy * np.nanmax(larger.error_map.u_xy) * 1e6) < 1.15
    )
    # what a user declares is no assumption of ours
    assert "bends" not in assumption_text(worded(larger))


def small_map(gx, gy, u=1e-8, g_theta=(), u_theta=1e-7):
    gx = np.asarray(gx, dtype=float)
    g_theta = np.asarray(g_theta, dtype=float)
    artifact = Artifact(gx.shape[0], 0.01, len(g_theta))
    return ErrorMap(
        artifact,
        gx,
        np.asarray(gy, dtype=float),
        np.full(gx.shape, u),
        np.full(gx.shape, u),
        g_theta,
        np.full(len(g_theta), u_theta),
    )


def test_numbers_of_a_map_by_hand():
    gx, gy = np.zeros((2, 3, 3))
    gx[2, 0], gy[2, 0] = 3e-6, -4e-6
    emap = small_map(
        gx,
        gy,
        u=2e-8,
        g_theta=[0, -np.deg2rad(2 / 3600), 0, 0],
        u_theta=np.deg2rad(0.5 / 3600),
    )
    result = replace(known_result(3, 4)[0], error_map=emap)
    numbers = summary_numbers(result)
    assert numbers["max_error_um"] == pytest.approx(5.0, rel=1e-14)
    assert numbers["rms_error_um"] == pytest.approx(np.sqrt(25 / 18), rel=1e-14)
    assert numbers["rms_uncertainty_um"] == pytest.approx(0.02, rel=1e-14)
    assert numbers["max_theta_error_arcsec"] == pytest.approx(2.0, rel=1e-14)
    assert numbers["rms_theta_uncertainty_arcsec"] == pytest.approx(0.5, rel=1e-14)
    node, between = (
        next(
            budget
            for budget in budgets(result)
            if budget.quantity == "xy" and budget.anywhere is wanted
        )
        for wanted in (False, True)
    )
    assert numbers["rms_uncertainty_anywhere_um"] == pytest.approx(
        between.u_rms * 1e6, rel=1e-14
    )
    assert numbers["max_uncertainty_anywhere_um"] == pytest.approx(
        between.u_max * 1e6, rel=1e-14
    )
    # a map of one peak is rough between its sites
    assert between.u_max > 10 * node.u_max
    assert map_figures(emap).max_site == (1, -1)
    assert place_text(emap, (1, -1)) == "at x 10 mm, y -10 mm (site 1, -1)"
    assert "at x 10 mm, y -10 mm (site 1, -1)" in line_with(
        summary_text(result), "largest error"
    )


def test_a_row_at_an_edge_that_departs_from_those_inside_is_named():
    emap = random_map(Artifact(9, 0.01), 1)
    flat = np.zeros(emap.artifact.shape)
    rising = flat.copy()
    rising[:, 0] = 3e-6
    emap = replace(emap, gx=flat, gy=rising, u_gx=flat + 1e-9, u_gy=flat + 1e-9)
    result = replace(known_result(9, 0)[0], error_map=emap)
    text = summary_text(result)
    assert "Gy departs by 3.00 µm" in line_with(text, "edge y -40 mm")
    assert "between y -30 and -40 mm" in text and text.count("departs") == 1
    quiet = replace(result, error_map=replace(emap, gy=flat))
    assert "departs" not in summary_text(quiet)


def test_unknown_sites_do_not_count():
    gx = np.array([[np.nan, 1e-6, 0], [0, 9e-6, 0], [0, 0, 0]])
    gy = np.array([[1e-3, 0, 0], [0, np.nan, 0], [0, 0, 0]])
    figures = map_figures(small_map(gx, gy))
    assert (figures.n_sites, figures.n_known) == (9, 7)
    assert figures.max_error_m == pytest.approx(1e-6)
    assert figures.rms_error_m == pytest.approx(1e-6 / np.sqrt(14))


def test_uncertainties_of_unknown_lines_do_not_count():
    emap = replace(
        random_map(Artifact(3, 0.01, 4), 1),
        g_theta=np.array([np.nan, 1.0, 0, 0]),
        u_g_theta=np.array([9.0, 1.0, 1.0, 1.0]),
    )
    figures = map_figures(emap)
    assert (figures.rms_u_theta_rad, figures.max_u_theta_rad) == (1.0, 1.0)


def test_state_sentence_says_what_was_found():
    result, _ = known_result()
    sentence = state_sentence(result)
    assert sentence.startswith("Calibrated from 4 views: largest error 0.")
    assert "every site known to ±0.0" in sentence and sentence.endswith("arcsec.")
    assert f"any place to ±{um(anywhere_m(result)[2])}" in sentence
    assert state_sentence(replace(result, warnings=("a", "b"))).endswith(
        "; 2 warnings."
    )


def test_the_line_of_the_topic_has_grade_error_and_each_u_and_is_shown_whole():
    result, _ = known_result()
    emap, noise = result.error_map, result.noise
    line, u = state_line(result), np.stack([emap.u_gx, emap.u_gy])
    anywhere = next(b for b in budgets(result) if b.quantity == "xy" and b.anywhere)
    assert line == (
        f"Good: error up to {um(np.hypot(emap.gx, emap.gy).max())}, U {um(noise.k_xy * u.max())} "
        f"at the nodes, {um(anywhere.U_max)} anywhere; θ up to {arcsec(abs(emap.g_theta).max())}, "
        f"U {arcsec(noise.k_theta * emap.u_g_theta.max())}."
    )
    assert len(line) <= 128
    cause = Cause(name="slip", text="view 'a' slipped: measure it again")
    for verdict, lead, reason in (
        (
            Verdict(Grade.NOT_QUALIFIED, causes=(cause,)),
            "Not qualified: ",
            "; most likely view 'a' slipped: measure it again.",
        ),
        (
            Verdict(Grade.ENLARGED, reasons=("too rough",)),
            "Good within an enlarged U: ",
            "; too rough.",
        ),
    ):
        graded = state_line(replace(result, verdict=verdict))
        assert graded == lead + line.removeprefix("Good: ").removesuffix(".") + reason
        assert len(graded) - len(reason) <= 128
    without = replace(result, error_map=replace(emap, gx=emap.gx * np.nan))
    assert state_line(without).startswith("Good: θ up to ")
    unseen = replace(result, observability=UNSEEN)
    assert state_line(unseen) == state_sentence(unseen)


def test_state_sentence_of_a_deficient_plan_names_the_missing_view():
    result = replace(known_result()[0], observability=UNSEEN)
    assert state_sentence(result) == (
        "Not a calibration: 2 modes of the stage error cannot be determined from the marks that "
        "were read; add a view turned by 90°."
    )
    text = summary_text(result)
    assert "identifiable  NO (rank 5 of 7 unknowns, 2 undetermined modes)" in text
    assert "undetermined mode: scale difference" in text
    assert "advice: add a view turned by 90°" in text


def test_state_sentence_without_one_known_site():
    result, _ = known_result(3, 0)
    nothing = small_map(np.full((3, 3), np.nan), np.full((3, 3), np.nan), u=np.nan)
    empty = replace(result, error_map=nothing)
    assert state_sentence(empty) == "No calibration: no site of the error map is known."
    assert "largest error      not known" in summary_text(empty)
    assert np.isnan(summary_numbers(empty)["max_error_um"])


def test_summary_shows_every_part():
    result, truth = known_result()
    text = summary_text(result, truth=truth)
    assert (
        "plate         11 × 11 marks, pitch 10 mm, field 100 × 100 mm, 24 angular lines"
        in text
    )
    assert "input         bags/hu.mcap (sha256 abababababababab)" in text
    row = line_with(text, "shift_x").split()
    assert row[:4] == ["shift_x", "0°", "(+1,", "0)"] and row[-2:] == ["603", "3"]
    assert float(row[4]) == pytest.approx(1e3 * result.views[3].phi, abs=0.005)
    assert float(row[5]) == pytest.approx(1e6 * result.views[3].tx, abs=0.05)
    assert float(row[6]) == pytest.approx(1e6 * result.views[3].ty, abs=0.05)
    u_um = 1e6 * np.sqrt(np.mean(result.error_map.u_gx**2))
    assert f"u {u_um:.4f} µm rms, 0.0238 µm largest (k=1)" in text
    assert (
        f"U {2 * u_um:.4f} µm rms, 0.0476 µm largest (k=2, 95.45 %, 2904 degrees of freedom)"
    ) in text
    assert line_with(text, "x, y").split() == [
        "x,",
        "y",
        "(µm)",
        "0.0200",
        "0.0200",
        "2904",
        "0.0204",
        "220",
        "1.02",
    ]
    assert line_with(text, "outlier").split() == ["outlier", "12"]
    assert text.index("outlier") < text.index("no encoder sample")
    assert max(map(len, text.splitlines()[1:])) <= 110
    assert len(text.splitlines()) <= 52


def test_orthogonality_and_scale_keep_their_signs_and_lengths():
    result, _ = known_result(11, 0)
    emap = replace(result.error_map, nonorthogonality=2e-6, scale_difference=-3e-6)
    text = summary_text(replace(result, error_map=emap))
    u_o, u_r = (f"{1e6 * u:.3f}" for u in first_order_u(result))
    assert all(0.01 <= float(u) < 0.1 for u in (u_o, u_r))  # two digits, three decimals
    assert (
        f"O 2.000 ± {u_o} (k=1) µrad = 0.200 µm over 100 mm; out of square by 2|O| = 4.00 µrad"
    ) in text
    assert (
        f"R -3.000 ± {u_r} (k=1) µm/m = -0.300 µm over 100 mm; X and Y differ by 2|R| = 6.00"
    ) in text
    damaged = replace(
        result, views=(replace(result.views[0], read_grid="x"), *result.views[1:])
    )
    assert "µrad" in summary_text(damaged)


def test_ascii_summary_is_ascii_and_still_aligned():
    result, truth = known_result()
    views = (replace(result.views[0], name="Ansicht-ä-°"), *result.views[1:])
    text = summary_text(replace(result, views=views), truth=truth, ascii_only=True)
    assert text.isascii()
    header = line_with(text, "view ")
    assert header.split()[3:6] == ["phi", "mrad", "tx"]
    rows = [line_with(text, name) for name in ("Ansicht-?", "rot90", "line", "shift_x")]
    assert {len(row) for row in rows} == {len(header)}


def test_names_cannot_steer_the_terminal():
    result, _ = known_result()
    views = (replace(result.views[0], name="a\x1b[2J\nb"), *result.views[1:])
    hostile = replace(
        result, views=views, plan_id="p\rq", warnings=("w\x07",), rejected={"r\x1b": 1}
    )
    text = summary_text(hostile)
    assert all(char.isprintable() or char == "\n" for char in text)
    assert r"a\x1b[2J\nb" in text and r"p\rq" in text


def test_a_verdict_comes_before_everything_else():
    result, _ = known_result()
    cause = Cause(
        name="drift",
        size=5.1e-8,
        u=2e-9,
        unit="m",
        p=1e-12,
        text="drift of 51 ± 2 nm along x: solve with --model drift",
    )
    bad = Verdict(
        Grade.NOT_QUALIFIED,
        causes=(cause,),
        reasons=("residuals exceed repeats",),
        sentence="Not qualified: most likely drift of 51 nm",
    )
    text = summary_text(replace(result, verdict=bad))
    assert text.startswith(
        "Not qualified: most likely drift of 51 nm. Map as it is: Calibrated"
    )
    assert "Verdict: NOT QUALIFIED\n  residuals exceed repeats\n" in text
    assert (
        "likely cause: drift of 51 ± 2 nm along x: solve with --model drift (p = 1e-12)"
        in text
    )
    assert summary_text(result).startswith("Calibrated")


def test_terms_of_the_model_are_shown_with_their_uncertainties():
    result, _ = known_result()
    terms = (
        TermResult("microscope", None, (TermEstimate("", "xy", -2e-3, 3e-5, "m/m"),)),
        TermResult("drift", 5e-8, (TermEstimate("rot90", "x P1", 4e-8, 1e-9, "m"),)),
    )
    text = summary_text(replace(result, model=ModelResult("rigid", terms)))
    assert line_with(text, "microscope").split() == [
        "microscope",
        "all",
        "xy",
        "-2000",
        "30",
        "µm/m",
        "free",
    ]
    assert line_with(text, "drift").split() == [
        "drift",
        "rot90",
        "x",
        "P1",
        "0.0400",
        "0.0010",
        "µm",
        "0.05",
        "µm",
    ]


def test_few_degrees_of_freedom_widen_what_is_claimed():
    result, _ = known_result()
    few = replace(result, noise=replace(result.noise, dof_xy=5.0, k_xy=2.649))
    text = summary_text(few)
    assert "(k=2.65)" in text.splitlines()[0]
    assert "(k=2.65, 95.45 %, 5 degrees of freedom)" in text


def test_no_repeats_and_no_noise_at_all():
    result, _ = known_result()
    once = replace(
        result,
        noise=Noise(1e-8, float("nan"), sigma_xy_residuals=1e-8, dof_xy_residuals=10),
    )
    assert line_with(summary_text(once), "x, y").split() == [
        "x,",
        "y",
        "(µm)",
        "0.0100",
        "–",
        "–",
        "0.0100",
        "10",
        "–",
    ]
    silent = replace(result, noise=Noise(float("nan"), float("nan")))
    assert "not known: no mark was read twice" in summary_text(silent)


def test_a_view_that_was_not_measured_shows_dashes():
    result, _ = known_result()
    nan = float("nan")
    views = (
        *result.views[:3],
        replace(result.views[3], phi=nan, tx=nan, ty=nan, used=0),
    )
    text = summary_text(replace(result, views=views))
    assert line_with(text, "shift_x").split()[4:] == ["–", "–", "–", "0", "3"]
    assert "4 views, 3 measured" in text


def test_pose_is_in_degrees_and_pitches():
    assert pose_text(-np.pi / 2, (-0.02, 0.01), Artifact(5, 0.01)) == "-90° (-2, +1)"


def test_plate_without_angular_lines_has_no_theta():
    result, truth = known_result(5, 0)
    text = summary_text(result, truth=truth)
    assert "no angular lines" in text and "θ" not in text
    assert "θ" not in state_sentence(result)


def test_truth_recovery_in_units_of_the_uncertainty():
    result, truth = known_result(21, 72, seed=3)
    figures = truth_figures(result.error_map, truth)
    assert figures.rms_in_u == pytest.approx(1, abs=4 / np.sqrt(2 * 882))
    assert 0.92 < figures.within_2u < 0.985
    assert figures.rms_theta_in_u == pytest.approx(1, abs=4 / np.sqrt(2 * 72))
    exact, truth = known_result(noisy=False)
    assert truth_figures(exact.error_map, truth).largest_m < 1e-20


@given(st.tuples(*[st.floats(-1e-5, 1e-5)] * 5))
@settings(max_examples=20, deadline=None)
def test_datum_difference_does_not_change_the_comparison(shift):
    result, truth = known_result(7, 8)
    artifact = result.artifact
    tx, ty, turn, scale, theta = shift
    moved = {
        "gx": truth["gx"] + tx - turn * artifact.y_m + scale * artifact.x_m,
        "gy": truth["gy"] + ty + turn * artifact.x_m + scale * artifact.y_m,
        "g_theta": truth["g_theta"] + theta,
    }
    before = truth_figures(result.error_map, truth)
    after = truth_figures(result.error_map, moved)
    for name in (
        "largest_m",
        "rms_m",
        "rms_in_u",
        "largest_theta_rad",
        "rms_theta_rad",
    ):
        assert getattr(after, name) == pytest.approx(getattr(before, name), rel=1e-6)


@pytest.mark.parametrize("datum", list(ThetaDatum))
def test_theta_of_a_real_calibration_lies_within_its_uncertainty_in_either_datum(datum):
    """The lines that the datum fixes have a tiny u: a plain mean would put them many u off."""
    artifact, rng = Artifact(5, 0.01, 72), np.random.default_rng(8)
    plan = hu_plan(artifact, 4)
    truth = random_truth(
        artifact,
        len(plan.views),
        rng,
        Spread(encoder="xy_axes" if datum is ThetaDatum.XY_AXES else "independent"),
    )
    found = calibrate(
        simulate_measurements(truth, plan, rng, sigma_m=2e-9, sigma_theta_rad=2e-5),
        Options(datum_theta=datum, assumed=()),
    )
    figures = truth_figures(
        found.error_map, {"gx": truth.g[0], "gy": truth.g[1], "g_theta": truth.g_theta}
    )
    assert 0.7 < figures.rms_theta_in_u < 1.5 and figures.largest_theta_in_u < 5
    assert 0.7 < figures.rms_in_u < 1.3


def test_shear_is_not_taken_for_a_datum_difference():
    result, truth = known_result(7, 0, noisy=False)
    sheared = {
        "gx": truth["gx"] + 1e-6 * result.artifact.y_m,
        "gy": truth["gy"] + 1e-6 * result.artifact.x_m,
    }
    corner = 1e-6 * np.hypot(0.03, 0.03)
    assert truth_figures(result.error_map, sheared).largest_m == pytest.approx(corner)


def test_truth_with_unknown_sites():
    result, truth = known_result(5, 8)
    emap = result.error_map
    gx = emap.gx.copy()
    gx[0, 0] = np.nan
    figures = truth_figures(replace(emap, gx=gx), truth)
    assert np.isfinite(figures.largest_m)
    nothing = replace(emap, gx=np.full((5, 5), np.nan), g_theta=np.full(8, np.nan))
    assert np.isnan(truth_figures(nothing, truth).largest_m)
    assert "not known" in summary_text(replace(result, error_map=nothing), truth=truth)


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        ({}, "truth gx: missing; give gx, gy (m) and g_theta (rad)"),
        (
            {"gx": np.zeros((3, 3)), "gy": np.zeros((5, 5))},
            "truth gx: has the shape (3, 3), the map has (5, 5); give the truth on "
            "the lattice of the map",
        ),
        (
            {"gx": [[1], [2, 3]], "gy": 0},
            "truth gx: not an array of numbers; give lists of numbers and null",
        ),
    ],
)
def test_unusable_truth_is_refused(truth, message):
    with pytest.raises(InputError) as caught:
        summary_text(known_result(5, 0)[0], truth=truth)
    assert str(caught.value) == message


def test_summary_is_the_same_after_a_round_trip_through_json():
    result, truth = known_result()
    again = result_from_dict(result_to_dict(result), "r.json")
    assert summary_text(again, truth=truth) == summary_text(result, truth=truth)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.5806, "0.581"),
        (12.345, "12.3"),
        (1234.5, "1234"),
        (0, "0"),
        (-0.0099996, "-0.0100"),
        (1e-12, "1.00e-12"),
        (2.5e7, "2.50e+07"),
        (float("nan"), "–"),
        (float("inf"), "–"),
        (9.996, "10.0"),
        (999.6, "1000"),
        (1.234e-4, "0.000123"),
        (1.234e-5, "1.23e-05"),
        (1234567.0, "1234567"),
        (12345678.0, "1.23e+07"),
    ],
)
def test_significant_digits(value, text):
    assert significant(value) == text


def test_columns_share_their_decimals():
    assert fixed_column([30.12, -0.004, float("nan")]) == ["30.1", "0.0", "–"]
    assert aligned([("a", "1"), ("長", "10")], indent="") == ["a    1", "長  10"]


def test_symbols_only_where_the_stream_has_them():
    assert can_print_symbols(io.TextIOWrapper(io.BytesIO(), encoding="utf-8"))
    assert not can_print_symbols(io.TextIOWrapper(io.BytesIO(), encoding="latin-1"))
    assert not can_print_symbols(io.StringIO())
    utf8 = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    # while a bar is drawn, rich puts this in place of stderr
    assert can_print_symbols(FileProxy(Console(file=utf8), utf8))
    assert to_ascii("φ ° 90° 2×3 ±1 µm ☃") == "phi deg 90 deg 2x3 +/-1 um ?"


def test_summary_does_not_load_matplotlib():
    code = (
        "import sys, selfcal_ros.reporting.summary.sections; sys.exit('matplotlib' in "
        "sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
