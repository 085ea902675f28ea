# SPDX-License-Identifier: Apache-2.0
"""The demo's bag, solved, exported, and driven by a simulated controller."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.applications.aerotech.read import load_cal
from selfcal_ros.applications.aerotech.verify import verify_tables
from selfcal_ros.bagio.offline import read_truth
from selfcal_ros.cli.main import main
from selfcal_ros.compensation.frame import frame_from_comments
from selfcal_ros.files import read_json
from selfcal_ros.model.result import result_from_dict

BAG = Path(__file__).parents[2] / "bags" / "hu_noise"


@pytest.fixture(scope="module")
def result_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("demo") / "result.json"
    assert main(["solve", str(BAG), "-o", str(path)]) == 0
    return path


@pytest.mark.parametrize(
    "wiring",
    [
        [],
        ["--home-x", "-50", "--home-y", "-50"],
        ["--reverse-x", "--reverse-theta"],
        ["--reverse-y", "--home-x", "50", "--unit", "um", "--home-y", "-50000"],
    ],
)
def test_the_demo_makes_its_machine_true(result_path, tmp_path, capsys, wiring):
    target = tmp_path / "stage.cal"
    assert (
        main(
            [
                "cal",
                "export",
                str(result_path),
                "-o",
                str(target),
                "--theta-axis",
                "3",
                "--counts-per-unit",
                "3=1000",
                *wiring,
            ]
        )
        == 0
    )
    capsys.readouterr()
    assert main(["cal", "verify", str(result_path), str(target), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (
        found["sites"]["before"]["max"] > 0.5e-6
        and found["sites"]["after"]["max"] < 1e-10
    )
    assert found["between"]["after"]["rms"] < found["between"]["before"]["rms"]


def test_the_true_stage_of_the_demo_keeps_the_calibration_error_alone(tmp_path):
    """Nothing but noise is in these readings: U is that of noise alone, no assumed term in it."""
    result_path, target = tmp_path / "result.json", tmp_path / "stage.cal"
    assert main(["solve", str(BAG), "--model", "none", "-o", str(result_path)]) == 0
    assert main(["cal", "export", str(result_path), "-o", str(target)]) == 0
    cal = load_cal(target)
    result = result_from_dict(read_json(result_path), str(result_path))
    truth = read_truth(BAG)
    stage = replace(
        result.error_map,
        gx=np.array(truth["gx"]),
        gy=np.array(truth["gy"]),
        g_theta=np.array(truth["g_theta"]),
    )
    found = verify_tables(stage, cal.tables, frame_from_comments(cal.comments)).sites
    u = np.sqrt(np.mean(result.error_map.u_gx**2 + result.error_map.u_gy**2))
    # 242 residuals: their rms is within 4 standard deviations, 0.18, of the stated uncertainty.
    assert found.rms("after") == pytest.approx(u, rel=0.25)
    assert found.rms("before") > 20 * found.rms("after")
