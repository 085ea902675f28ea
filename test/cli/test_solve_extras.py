# SPDX-License-Identifier: Apache-2.0
"""``selfcal solve`` with --robust, --validate and --budget on the shipped bags."""

import json
from pathlib import Path

import pytest

from selfcal_ros.cli.main import main

BAGS = Path(__file__).parents[2] / "bags"


@pytest.fixture
def solved(tmp_path, capsys):
    def solve(bag, *options):
        out = tmp_path / "result.json"
        code = main(["solve", str(BAGS / bag), "-o", str(out), *options])
        return code, json.loads(out.read_text()), capsys.readouterr()

    return solve


def test_validation_and_budget_are_printed_and_written(solved):
    code, result, printed = solved("hu_noise", "--validate", "--budget")
    assert code == 0
    assert "held-out readings:" in printed.out and "reading noise" in printed.out
    assert result["validation"][0]["n_grid"] > 20
    assert 1 < result["validation"][0]["ratio"] < 4
    assert {row["type"] for row in result["budget"]} == {"A", "B"}
    assert {row["source"] for row in result["budget"]} <= {
        "readings",
        "declared",
        "default",
    }


def test_the_law_cannot_hold_readings_out(capsys, tmp_path):
    """What was validated in its place was the joint solution, under the law's name."""
    args = ["solve", str(BAGS / "hu_noise"), "--method", "law", "--validate"]
    assert main([*args, "-o", str(tmp_path / "r.json")]) == 2
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == (
        "",
        "selfcal solve: --validate: Hu's law needs every reading and cannot hold any out; "
        "solve with --method joint\n",
    )
    assert not list(tmp_path.iterdir())


def test_without_an_uncertainty_map_the_budget_is_one_line(solved):
    code, result, printed = solved("hu_noise", "--uncertainty", "never", "--budget")
    assert code == 0 and result["budget"] == []
    assert printed.out.splitlines()[-1] == (
        "no budget: the uncertainty map was not computed (--uncertainty always)"
    )
    assert "reading noise" not in printed.out and printed.err == ""


def test_robust_lists_what_it_removed(solved):
    code, result, _ = solved("hu_noise", "--robust", "--quiet")
    assert code == 0
    assert set(result["outliers"]) == {"rule", "unchecked", "removed"}
    assert result["slips"] == [] and result["noisy_views"] == []


def test_extras_only_on_demand(solved):
    _, result, printed = solved("hu_noise")
    assert not {"validation", "outliers"} & set(result) and result["budget"]
    assert "held-out" not in printed.out and "reading noise" not in printed.out


def test_deficient_bag_names_the_unseen_modes(solved):
    code, result, printed = solved("deficient")
    assert code == 3
    assert (
        "do not identify the stage" in printed.err
        and len(printed.err.splitlines()) == 1
    )
    assert result["observability"]["modes"] and result["observability"]["advice"]
