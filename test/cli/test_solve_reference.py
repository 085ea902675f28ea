# SPDX-License-Identifier: Apache-2.0
"""`selfcal solve --reference`: a known length sets the scale of the map."""

import json
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main

BAG = str(Path(__file__).parents[2] / "bags" / "hu_exact")


def solved(tmp_path, *options, code=0):
    out = tmp_path / "r.json"
    assert main(["solve", BAG, "--quiet", "--force", "-o", str(out), *options]) == code
    result = json.loads(out.read_text())
    maps = result["error_map"] | result["artifact_map"] | result["artifact"]
    keys = ("gx", "gy", "u_gx", "ax", "ay", "magnification")
    return {key: np.array(maps[key]) for key in keys}


@pytest.mark.parametrize("kind", ["artifact", "stage_x", "stage_y"])
def test_a_reference_length_adds_its_scale_and_its_uncertainty(tmp_path, kind):
    free = solved(tmp_path)
    # the length is not that of the stage: what misalignments make of the scale is 1 nm
    fixed = solved(tmp_path, "--reference", f"{kind}:2e-6:1e-7")
    # what the encoders indicate does not depend on what is known of the plate
    assert fixed["magnification"] == pytest.approx(free["magnification"], abs=1e-9)
    x = (np.arange(11) - 5)[:, None] * 0.01 * np.ones(11)
    grown_x, grown_y = fixed["gx"] - free["gx"], fixed["gy"] - free["gy"]
    scale = (grown_x * x).sum() / (x * x).sum()
    # one scale for x and y: only the magnification moves, and what misalignments, below 0.5 mm,
    # make of it: offsets do not grow with the stage
    np.testing.assert_allclose(grown_x, scale * x, rtol=0, atol=abs(scale) * 5e-4)
    np.testing.assert_allclose(grown_y, scale * x.T, rtol=0, atol=abs(scale) * 5e-4)
    if kind == "artifact":
        # a longer plate (A grows) is a stage that indicates too little (G falls)
        plate = ((free["ax"] * x + free["ay"] * x.T).sum()) / (2 * (x * x).sum())
        assert scale == pytest.approx(plate - 2e-6, rel=0.01)
    else:
        along = fixed["gx"] if kind == "stage_x" else fixed["gy"]
        axis = x if kind == "stage_x" else x.T
        assert (along * axis).sum() / (axis * axis).sum() == pytest.approx(
            2e-6, abs=1e-9
        )
    assert fixed["u_gx"][0, 5] == pytest.approx(0.05 * 1e-7, rel=0.05)


def test_a_reference_far_from_the_encoders_is_a_warning(tmp_path):
    # so far off, the stage stood 0.05 mm beside the sites at which it is indicated
    solved(tmp_path, "--reference", "artifact:1.2e-3:1e-7", code=5)
    (warning,) = json.loads((tmp_path / "r.json").read_text())["warnings"][:1]
    assert warning.startswith("by the reference length the encoders indicate lengths ")
    assert "shorter than they are by 1200" in warning


def test_the_distance_of_two_marks_is_met(tmp_path):
    plate = solved(
        tmp_path,
        "--reference",
        "marks:-5,0:5,0:0.1000002:1e-8",
        "--robust",
        "--validate",
        "--certificate",
        "PTB 1",
        "--reference-at",
        "20:0:0:0",
    )
    assert plate["ax"][10, 5] - plate["ax"][0, 5] == pytest.approx(2e-7, abs=1e-12)
    assert plate["u_gx"][0, 5] == pytest.approx(0.05 * 1e-7, rel=0.05)
    reference = json.loads((tmp_path / "r.json").read_text())["reference"]
    assert reference["marks"] == [[-5, 0], [5, 0]]
    assert (
        main(["export", "kmotion", str(tmp_path / "r.json"), "-o", str(tmp_path / "t")])
        == 0
    )
    assert (
        "reference length: distance of the marks (-5, 0) and (5, 0), relative error 2e-06, "
        "u 1e-07 (PTB 1)"
    ) in (tmp_path / "t").read_text()


def test_a_certificate_of_nothing_is_refused(capsys):
    assert main(["solve", BAG, "--certificate", "PTB 123"]) == 2
    assert capsys.readouterr().err == (
        "selfcal solve: --certificate: it belongs to a reference length, and none is given; "
        "name the length with --reference KIND:ERROR:U\n"
    )


@pytest.mark.parametrize(
    "text",
    [
        "artifact",
        "artifact:x:1",
        "moon:1e-6:1e-7",
        "artifact:1:0",
        "artifact:2_0e-7:1e-7",
        "marks:-0_5,0:5,0:0.1:0",
        "marks:-5,0:5,0:0.1_0:0",
        "marks",
        "marks:0,0:0,0:1e-3:0",
        "marks:-6,0:5,0:0.11:0",
    ],
)
def test_a_bad_reference_is_one_line(capsys, text):
    assert main(["solve", BAG, "--reference", text]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "reference" in err
