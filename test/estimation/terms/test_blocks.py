# SPDX-License-Identifier: Apache-2.0
"""Blocks of other packages: examples/stage_sag.py, registered as a user's package registers it."""

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros import blocks as registry
from selfcal_ros.blocks import block_of, blocks
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.terms.columns import Column
from selfcal_ros.files import read_yaml, write_yaml
from selfcal_ros.model.findings import Cause
from selfcal_ros.model.terms import default_terms, parse_terms
from selfcal_ros.reporting.words.findings import sentence_of
from selfcal_ros.simulation import physics

ROOT = Path(__file__).parents[3]
SAG = 8e-6
"""m/m: 80 nm times x^3 - x with the plate 10 mm off the centre."""


def register(tmp_path, monkeypatch, entry):
    """Install a package with entry points, as pip does."""
    folder = tmp_path / "sag-1.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: sag\nVersion: 1\n")
    (folder / "entry_points.txt").write_text(f"[selfcal.blocks]\n{entry}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "examples")
    clear()


def clear():
    blocks.cache_clear()
    default_terms.cache_clear()


@pytest.fixture
def stage_sag(tmp_path, monkeypatch):
    register(tmp_path, monkeypatch, "stage_sag = stage_sag:BLOCK")
    yield
    clear()


@pytest.fixture
def sagging(tmp_path, monkeypatch):
    """A bag of a stage that sags, simulated by its own formula."""
    plan = read_yaml(ROOT / "config/plans/resistant.yaml")
    plan["artifact"]["grid_size"] = 7
    write_yaml(tmp_path / "plan.yaml", plan)
    loads = [np.array(view["translation_pitch"]) * 0.01 for view in plan["views"]]

    def bending(truth, position, index):
        x = position / 0.03
        return SAG * loads[index][:, None] * (x**3 - x)

    monkeypatch.setattr(physics, "stage_bending", bending)
    write_yaml(
        tmp_path / "sim.yaml",
        {
            "plan": str(tmp_path / "plan.yaml"),
            "seed": 3,
            "noise": {"sigma_xy": 5e-9, "sigma_theta": 1e-6},
        },
    )
    assert (
        main(["simulate", str(tmp_path / "sim.yaml"), "-o", str(tmp_path / "bag")]) == 0
    )
    return str(tmp_path / "bag")


def solved(bag, capsys, *options):
    target = Path(bag).parent / "result.json"
    capsys.readouterr()
    code = main(["solve", bag, "-o", str(target), *options])
    return code, json.loads(target.read_text()), capsys.readouterr().out


@pytest.mark.usefixtures("stage_sag")
def test_it_is_found_sized_and_said(sagging, capsys):
    _, result, shown = solved(sagging, capsys)
    cause = result["verdict"]["causes"][0]
    assert cause["name"] == "stage_sag" and cause["unit"] == "m/m"
    assert abs(cause["size"] - SAG) < 4 * cause["u"] < 0.2 * SAG  # bending of 5 nm
    text = " ".join(shown.split())
    assert re.search(
        r"a stage that sags under a plate off its centre, by [78]\.\d\d ± \d\.\d\d "
        "µm a metre",
        text,
    )
    assert "stiffen the guides, or keep the plate at the centre" in text


@pytest.mark.usefixtures("stage_sag")
@pytest.mark.parametrize("size", ["", ":1e-5"])
def test_it_is_a_term_of_the_model(sagging, capsys, size):
    code, result, shown = solved(
        sagging, capsys, "--model", f"stage_sag{size}", "--budget"
    )
    term = next(
        term for term in result["model"]["terms"] if term["name"] == "stage_sag"
    )
    [estimate] = term["estimates"]
    # bending of 5 nm
    assert abs(estimate["value"] - SAG) < 4 * estimate["u"] < 0.2 * SAG
    assert code == 0 and "stage_sag" not in [
        c["name"] for c in result["verdict"]["causes"]
    ]
    assert ("term stage_sag" in shown) == bool(size)


@pytest.mark.usefixtures("stage_sag")
def test_a_plan_that_does_not_tell_it_is_refused_with_its_cure(capsys):
    assert (
        main(
            [
                "plan",
                "check",
                str(ROOT / "config/plans/hu.yaml"),
                "--model",
                "stage_sag",
            ]
        )
        == 0
    )
    assert "stage_sag" in capsys.readouterr().out
    assert [term.name for term in parse_terms(["stage_sag:1e-6,drift"], "x")] == [
        "drift",
        "stage_sag",
    ]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            "stage_sag = nowhere:BLOCK",
            r"^block 'stage_sag' \(nowhere:BLOCK\): it cannot be loaded: "
            "No module named 'nowhere'; repair or remove the package that registers it$",
        ),
        (
            "sag = stage_sag:BLOCK",
            "^block 'sag' .*: it is not a selfcal_ros.blocks.Block of this name",
        ),
        (
            "drift = stage_sag:BLOCK",
            "^block 'drift' .*, or another block has the name; correct",
        ),
    ],
)
def test_a_block_that_cannot_be_used_is_named(tmp_path, monkeypatch, entry, message):
    register(tmp_path, monkeypatch, entry)
    with pytest.raises(InputError, match=message):
        blocks()
    clear()


def test_a_result_of_an_absent_block_can_be_read():
    said = sentence_of(Cause(name="stage_sag", size=8e-6, u=1e-7, unit="m/m", p=0.0))
    assert said.startswith("an effect 'stage_sag' of 8.00 ± 0.10 µm/m")


@pytest.mark.parametrize("name", registry.BUILT_IN)
def test_every_block_has_its_sizes(name):
    block = block_of(name)
    assert block.name == name and block.cure and block.unit in ("m", "m/m", "rad")
    assert 0 < block.undetected < 2e-3 * min((*block.sizes, block.nominal or math.inf))
    assert len(block.parts) in (0, len(block.sizes))


@pytest.mark.parametrize(
    ("turns", "u"),
    [([1e-5], 1e-7), ([1e-5, 1e-6], 2**0.5 * 1e-7)],
)
def test_the_turn_of_lines_has_the_u_of_its_difference_from_the_nearest(turns, u):
    """A single one is that of the second view against the first: it has its own u."""
    n = len(turns)
    estimates = SimpleNamespace(
        columns=[Column("rotation", view, "turn", np.inf) for view in range(n)],
        values=np.array(turns),
        covariance=1e-14 * np.eye(n),
    )
    ((where, weights),) = block_of("rotation").located(estimates, tuple("ab"))
    own = np.sqrt(weights @ estimates.covariance @ weights)
    assert max(own, where.least_u) == pytest.approx(u, rel=1e-9)
