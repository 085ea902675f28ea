# SPDX-License-Identifier: Apache-2.0
"""Maps of a batch against a baseline: which ones are named, and what the table then holds."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.batch.course import compared, probability, sentence
from selfcal_ros.applications.batch.table import csv_text
from selfcal_ros.cli.main import main
from selfcal_ros.estimation.comparison.maps import compare
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.words.findings import worded
from test.support.options import BARE
from test.support.sessions import small_bag
from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

PLATE = Artifact(5, 0.01, 8)


def result_of(noise_seed, *, moved_m=0.0, artifact=PLATE):
    """Return one machine's map; `moved_m` moves one node since the baseline."""
    truth = random_truth(artifact, 4, np.random.default_rng(1), Spread(phi_rad=1e-3))
    g = truth.g.copy()
    g[0, 1, 2] += moved_m
    rng = np.random.default_rng([2, noise_seed])
    readings = simulate_measurements(
        replace(truth, g=g),
        hu_plan(artifact, 4),
        rng,
        sigma_m=20e-9,
        sigma_theta_rad=2e-5,
    )
    return solve_joint(readings, BARE).result


def shelf(folder, results):
    """Return records of results, as a batch keeps them."""
    out = []
    for number, result in enumerate(results):
        write_json(folder / f"{number}.json", result_to_dict(result))
        out.append(
            {
                "bag": f"bag {number:02}",
                "result": f"{number}.json",
                "exit_code": 0,
                "qualified": True,
                "message": "",
                "quantities": {"sigma_xy_um": 0.02},
            }
        )
    return out


def test_maps_that_changed_are_named_and_no_others(tmp_path):
    maps = [
        result_of(seed, moved_m=200e-9 if seed in (3, 8) else 0.0)
        for seed in range(1, 21)
    ]
    records = compared(shelf(tmp_path, maps), tmp_path, result_of(0), "old.json")
    assert [r["bag"] for r in records if r["baseline"]["changed"]] == [
        "bag 02",
        "bag 07",
    ]
    text = sentence(records, "old.json")
    assert (
        text.startswith("2 of 20 maps differ from old.json: bag 02 (p = ")
        and "bag 07" in text
    )
    found = compare(result_of(0), maps[2])
    assert records[2]["baseline"]["p"] == probability(found)
    assert records[2]["quantities"] == pytest.approx(
        {
            "sigma_xy_um": 0.02,
            "difference_from_baseline_rms_um": found.rms_m * 1e6,
            "difference_from_baseline_largest_um": found.max_m * 1e6,
            "theta_difference_from_baseline_rms_arcsec": np.degrees(found.rms_theta_rad)
            * 3600,
        }
    )
    rows = list(csv.DictReader(io.StringIO(csv_text(records))))
    assert rows[2]["changed"] == "true" and rows[3]["changed"] == "false"
    assert float(rows[2]["baseline_p"]) == records[2]["baseline"]["adjusted_p"]
    assert float(rows[2]["difference_from_baseline_largest_um"]) == pytest.approx(
        0.2, rel=0.4
    )


def test_a_stable_machine_is_rarely_named(tmp_path):
    """p of 40 maps against maps of their own: about 5 % below 0.05, and not more."""
    p = [
        probability(compare(result_of(seed), result_of(1000 + seed)))
        for seed in range(40)
    ]
    assert sum(value < 0.05 for value in p) <= 6


def test_bags_without_a_map_remain_as_they_are(tmp_path):
    known = shelf(tmp_path, [result_of(1), result_of(1, artifact=Artifact(7, 0.01, 8))])
    failed = {"bag": "bad", "exit_code": 2, "qualified": None, "message": "no"}
    records = compared([failed, *known], tmp_path, result_of(0), "old.json")
    assert records[0] is failed and set(records[2]) - set(known[1]) == {"not_compared"}
    reason = records[2]["not_compared"]
    assert "lattice" in reason or "plate" in reason
    assert sentence(records, "old.json") == (
        f"0 of 1 maps differ from old.json; not compared: 1 ({reason})"
    )
    rows = list(csv.DictReader(io.StringIO(csv_text(records))))
    assert [row["not_compared"] for row in rows] == ["", "", reason]


def test_without_uncertainties_nothing_is_tested(tmp_path):
    known = replace(result_of(0), noise=replace(result_of(0).noise, sigma_xy=np.nan))
    emap = known.error_map
    none = replace(
        known,
        error_map=replace(
            emap,
            u_gx=emap.u_gx * np.nan,
            u_gy=emap.u_gy * np.nan,
            u_g_theta=emap.u_g_theta * np.nan,
        ),
    )
    (record,) = compared(shelf(tmp_path, [none]), tmp_path, none, "old.json")
    assert record["baseline"] is None
    assert record["quantities"]["difference_from_baseline_largest_um"] == 0.0


def test_the_verb_compares_with_a_result(tmp_path, capsys):
    bag, out, old = "bags/hu_noise", tmp_path / "out", tmp_path / "old.json"
    assert main(["solve", bag, "--quiet", "-o", str(old)]) == 0
    assert (
        main(["batch", bag, "-o", str(out), "--workers", "1", "--baseline", str(old)])
        == 0
    )
    assert f"0 of 1 maps differ from {old}" in capsys.readouterr().out
    (record,) = json.loads((out / "batch.json").read_text())["records"]
    assert record["baseline"]["changed"] is False
    assert "differ from" in (out / "index.html").read_text()
    assert (
        main(["batch", bag, "-o", str(out), "--baseline", str(tmp_path / "none.json")])
        == 2
    )


def test_a_batch_without_any_map_of_the_baseline_is_written(tmp_path, capsys):
    """The bags are solved for hours: the table must not be lost for it."""
    write_json(tmp_path / "old.json", result_to_dict(worded(result_of(0))))
    out = tmp_path / "out"
    assert (
        main(
            [
                "batch",
                "bags/hu_noise",
                "-o",
                str(out),
                "--workers",
                "1",
                "--baseline",
                str(tmp_path / "old.json"),
            ]
        )
        == 0
    )
    assert "0 of 0 maps differ from" in capsys.readouterr().out
    (row,) = csv.DictReader((out / "table.csv").read_text().splitlines())
    assert row["not_compared"] and row["changed"] == row["baseline_p"] == ""


def test_maps_that_are_not_compared_are_counted(tmp_path, capsys):
    out = tmp_path / "out"
    (tmp_path / "other").mkdir()
    bag = small_bag(tmp_path / "other")
    assert main(["solve", str(bag), "--quiet", "-o", str(tmp_path / "old.json")]) == 0
    assert (
        main(
            [
                "batch",
                str(bag),
                "bags/hu_noise",
                "-o",
                str(out),
                "--workers",
                "1",
                "--baseline",
                str(tmp_path / "old.json"),
            ]
        )
        == 0
    )
    said = capsys.readouterr().out
    assert "0 of 1 maps differ from" in said
    assert "; not compared: 1 (" in said
