# SPDX-License-Identifier: Apache-2.0
"""``selfcal diff``: files in, figures out, exit codes."""

import io
import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.maps import compare
from selfcal_ros.estimation.options import Options
from selfcal_ros.files import read_json
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_from_dict, result_to_dict, with_digests
from selfcal_ros.model.verdict import Enlargement, Grade, Verdict
from selfcal_ros.outputs import plain, write_json
from selfcal_ros.reporting.figures import maps, paper
from selfcal_ros.reporting.figures.drawing import Drawing
from test.support.truth import hu_plan, random_truth, simulate_measurements


@pytest.fixture
def files(tmp_path):
    artifact = Artifact(5, 0.01, 8)
    truth = random_truth(artifact, 4, np.random.default_rng(1))
    out = []
    for seed in (1, 2):
        readings = simulate_measurements(
            truth,
            hu_plan(artifact),
            np.random.default_rng(seed),
            sigma_m=2e-8,
            sigma_theta_rad=2e-5,
        )
        result = calibrate(readings, Options())
        if seed == 2:
            emap = result.error_map
            result = replace(result, error_map=replace(emap, gx=emap.gx + 1e-6))
        out.append(str(tmp_path / f"{seed}.json"))
        write_json(out[-1], result_to_dict(result))
    return out


def test_both_maps_and_their_difference_are_drawn(files, tmp_path, capsys, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        paper, "save_picture", lambda picture, path: drawn.append(picture)
    )
    assert main(["diff", *files, "--plot", str(tmp_path / "d.svg")]) == 0
    [picture] = drawn
    text = [item.text for item in picture.items if hasattr(item, "text")]
    assert (
        picture.says
        == "verdict: not significant, the maps agree within their uncertainties"
    )
    assert [
        line for line in text if line in ("A", "B, in the datum of A", "B − A")
    ] == ["A", "B, in the datum of A", "B − A"]
    assert "B − A in θ in arcsec, outwards = counter-clockwise" in text
    a, b = (result_from_dict(read_json(file), file) for file in files)
    found = compare(a, b)
    difference = {"gx": found.dx, "gy": found.dy, "g_theta": found.d_theta}
    shown = []
    monkeypatch.setattr(
        maps,
        "error_map",
        lambda result, **_: shown.append(result) or Drawing("", "", 10, 10),
    )
    maps.difference_picture(a, b, difference, "")
    of_a, of_b, of_both = (result.error_map for result in shown)
    np.testing.assert_array_equal(of_a.gx, a.error_map.gx)
    # without the micrometre of the datum
    assert np.abs(of_b.gx - a.error_map.gx).max() < 1e-7
    np.testing.assert_array_equal(of_both.gy, found.dy)
    np.testing.assert_array_equal(
        of_both.u_gx, np.hypot(a.error_map.u_gx, b.error_map.u_gx)
    )
    assert main(["diff", *files, "--plot", files[0]]) == 2
    assert "would be overwritten" in capsys.readouterr().err


def test_two_results_as_text_and_as_json(files, capsys):
    assert main(["diff", *files]) == 0
    text = capsys.readouterr().out
    assert (
        "translation (+1, " in text
        and "not significant" in text
        and "theta  rms" in text
    )
    assert main(["diff", *files, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (
        f"XY     rms {found['rms_um']:.5f} µm per axis   largest {found['max_um']:.5f} µm on"
        in text
    )
    both = np.abs([found["dx"], found["dy"]]) * 1e6
    assert found["max_um"] == pytest.approx(both.max())
    assert found["rms_um"] == pytest.approx(np.sqrt(np.mean(both**2)))
    assert found["datum_difference"]["translation_x"] == pytest.approx(1e-6, rel=1e-6)
    assert 0.005 < found["rms_um"] < found["max_um"] < 0.1
    assert found["significance_xy"]["correlated"] is True
    test = found["significance_xy"]
    assert (
        1e-3 < test["p"] < 1 and len(found["dx"]) == 5 and found["significant"] is False
    )
    assert (
        f"largest |z| {test['largest_z']:.2f}, limit {test['z_limit']:.2f}, p = "
        in text
    )
    assert (
        f"Mahalanobis distance^2/dof {test['chi2_ratio']:.3f}, {test['dof']:.0f} dof"
        in text
    )
    assert text.splitlines()[-1] == (
        "verdict: not significant, the maps agree within their uncertainties"
    )


def test_plates_are_compared_as_the_stages_are(files, tmp_path, capsys):
    assert main(["diff", "--artifact", *files, "--plot", str(tmp_path / "d.svg")]) == 0
    text = capsys.readouterr().out
    assert text.startswith(
        "B minus A, plates, datum difference removed: translation (+0, +0) µm"
    )
    assert "the maps agree" in text and "theta  rms" in text
    assert "B − A" in (tmp_path / "d.svg").read_text()
    assert main(["diff", "--artifact", *files, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (
        found["significance_xy"]["correlated"]
        and found["significance_theta"]["correlated"]
    )
    a, b = (np.array(read_json(path)["artifact_map"]["ax"]) for path in files)
    # less a turn and a scale
    assert np.array(found["dx"]) == pytest.approx(b - a, abs=5e-8)
    assert main(["diff", files[0], files[1]]) == 0
    assert "translation (+1, " in capsys.readouterr().out


def test_the_grades_of_both_and_what_enlarged_them_are_shown(files, capsys):
    enlarged = result_from_dict(read_json(files[1]), "b")
    verdict = Verdict(
        Grade.ENLARGED,
        enlarged_by=(
            Enlargement("drift", 3e-9, 9e-9),
            Enlargement("reading", np.radians(1 / 3600), np.radians(2 / 3600), "rad"),
        ),
        sentence="Good within an enlarged U: a drift",
    )
    write_json(files[1], result_to_dict(replace(enlarged, verdict=verdict)))
    assert main(["diff", *files]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-3] == "A      grade: good"
    assert lines[-2] == (
        "B      grade: enlarged; U enlarged by drift: u 0.00300 µm rms, 0.00900 µm largest; "
        "U enlarged by reading: u 1.00 arcsec rms, 2.00 arcsec largest"
    )
    assert main(["diff", *files, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["grade"] == {"a": "good", "b": "enlarged"}
    assert found["enlarged_by"]["a"] == []
    assert found["enlarged_by"]["b"][0] == {
        "name": "drift",
        "u_rms": 3e-9,
        "u_max": 9e-9,
        "unit": "m",
    }


def test_maps_that_differ_and_maps_without_uncertainty_have_their_verdicts(
    files, tmp_path, capsys
):
    data = read_json(files[1])
    data["error_map"]["gy"][2][3] += 1e-6
    other = str(tmp_path / "other.json")
    write_json(other, with_digests(data))
    assert main(["diff", files[0], other]) == 0
    assert (
        capsys.readouterr().out.splitlines()[-1]
        == "verdict: significant, the maps differ in XY"
    )
    for key in ("u_gx", "u_gy", "u_g_theta"):
        data["error_map"][key] = plain(
            np.array(data["error_map"][key], dtype=float) * np.nan
        )
    write_json(other, with_digests(data))
    assert main(["diff", files[0], other]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == (
        "verdict: none, no uncertainties to test against"
    )


def test_a_result_that_is_not_qualified_is_named(files, tmp_path, capsys):
    """Its uncertainties are enlarged, so that it agrees with much: that is told beside it."""
    data = read_json(files[1])
    data["verdict"] |= {
        "qualified": False,
        "grade": "not_qualified",
        "sentence": "Not qualified: because",
    }
    bad, laser = str(tmp_path / "bad.json"), str(tmp_path / "laser.json")
    write_json(bad, with_digests(data))
    write_json(
        laser,
        {
            "ex_x": [],
            "error_map_equivalent": {
                "nonorthogonality": 1e-6,
                "u_nonorthogonality": 1e-7,
                "scale_difference": None,
                "u_scale_difference": None,
            },
        },
    )
    for arguments in (
        (files[0], bad),
        (bad, files[0]),
        (bad, laser),
        (files[0], bad, "--json"),
    ):
        assert main(["diff", *arguments]) == 0
        assert (
            capsys.readouterr().err == f"selfcal diff: {bad}: Not qualified: because\n"
        )
    assert main(["diff", *files]) == 0
    assert capsys.readouterr().err == ""


def test_different_theta_datums_are_said(files, tmp_path, capsys):
    data = read_json(files[1])
    data["error_map"]["datum_theta"] = "xy_axes"
    other = str(tmp_path / "other.json")
    write_json(other, with_digests(data))
    assert main(["diff", files[0], other]) == 0
    assert "theta datums differ: zero_mean and xy_axes" in capsys.readouterr().out
    assert main(["diff", *files]) == 0
    assert "datums differ" not in capsys.readouterr().out


def test_keep_scale_is_for_maps_that_have_one(files, tmp_path, capsys):
    """Scales of 50 µm/m apart: one is measured, the other a convention, which is no difference."""
    for number, error in enumerate((0.0, 5e-5)):
        data = read_json(files[number])
        data["error_map"]["gx"] = (
            np.array(data["error_map"]["gx"]) + error * 0.01 * np.arange(-2, 3)[:, None]
        ).tolist()
        data["error_map"]["gy"] = (
            np.array(data["error_map"]["gy"]) + error * 0.01 * np.arange(-2, 3)
        ).tolist()
        if error:
            data["reference"] = {
                "kind": "artifact",
                "relative_error": error,
                "u_relative": 1e-7,
            }
        write_json(files[number], with_digests(data))
    assert main(["diff", *files]) == 0
    assert "scale +50 µm/m" in capsys.readouterr().out
    for pair, bare in ((files, files[0]), (files[::-1], files[0])):
        assert main(["diff", *pair, "--keep-scale"]) == 2
        printed = capsys.readouterr()
        assert printed.out == "" and printed.err == (
            f"selfcal diff: --keep-scale: {bare} has no reference length, so its magnification is "
            "unknown; omit it, or solve with --reference\n"
        )
    assert main(["diff", files[1], files[1], "--keep-scale"]) == 0
    assert "scale +0 µm/m" in capsys.readouterr().out


def test_another_lattice_is_bad_input(files, tmp_path, capsys):
    data = read_json(files[1])
    data["artifact"]["grid_pitch"] = 0.02
    other = tmp_path / "other.json"
    write_json(other, with_digests(data))
    assert main(["diff", files[0], str(other)]) == 2
    error = capsys.readouterr().err
    assert "the lattices differ: pitches of 10 and 20 mm" in error
    assert str(other) in error and len(error.splitlines()) == 1


def test_result_against_the_laser(files, tmp_path, capsys):
    laser = tmp_path / "laser.json"
    write_json(
        laser,
        {
            "ex_x": [],
            "error_map_equivalent": {
                "nonorthogonality": 1e-6,
                "u_nonorthogonality": 1e-7,
                "scale_difference": -2e-6,
                "u_scale_difference": 1e-7,
            },
        },
    )
    assert main(["diff", files[0], str(laser)]) == 0
    out = capsys.readouterr().out
    assert re.search(r"nonorthogonality: \S+ and \+1 µrad, difference ", out)
    assert re.search(r"scale difference: \S+ and -2 µm/m, difference ", out)
    assert main(["diff", files[0], str(laser), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["nonorthogonality"]["laser"] == 1e-6 and found["grade"] == {
        "a": "good"
    }
    assert found["nonorthogonality"]["difference"] == pytest.approx(
        1e-6 - found["nonorthogonality"]["map"]
    )
    assert main(["diff", files[0], str(laser), "--keep-scale"]) == 2
    assert capsys.readouterr().err == (
        f"selfcal diff: --keep-scale: for {laser} squareness and scale difference are compared, "
        "not the magnification; omit it\n"
    )


def test_files_that_are_no_results(files, tmp_path, capsys):
    bad = tmp_path / "bad.json"
    bad.write_text("{}")
    assert main(["diff", files[0], str(bad)]) == 2
    assert "not a result of schema" in capsys.readouterr().err
    assert main(["diff", str(tmp_path / "none.json"), files[0]]) == 2
    assert "no such file" in capsys.readouterr().err


def test_symbols_are_spelled_out_where_stdout_cannot_take_them(files, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    assert main(["diff", *files]) == 0
    stream.flush()
    text = stream.buffer.getvalue().decode()
    assert " um per axis" in text and " urad, scale difference " in text


def test_rounding_errors_are_zero(files, capsys):
    assert main(["diff", files[0], files[0]]) == 0
    assert (
        capsys.readouterr()
        .out.splitlines()[0]
        .startswith(
            "B minus A, datum difference removed: translation (+0, +0) µm, rotation +0 arcsec, "
            "scale +0 µm/m"
        )
    )
