# SPDX-License-Identifier: Apache-2.0
"""What a saved result knows of stage and plate together is what one dense least squares knows."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.covariance import together
from selfcal_ros.estimation.joint import solve
from selfcal_ros.estimation.terms import equations
from selfcal_ros.estimation.verdict import judge
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.reporting.words.findings import worded
from test.estimation.terms.test_dense_fit import both, measured


@pytest.fixture(autouse=True)
def _equal_white_noise(monkeypatch):
    """What else noise may be, and doubt, have their own tests."""
    monkeypatch.setattr(solve, "MAX_NODES", 0)
    monkeypatch.setattr(equations, "DOUBT_LEVEL", equations.CAUSE_LEVEL)
    monkeypatch.setattr(judge, "LACK_LEVEL", 0.0)


@cache
def solved(plan, model, sense=Sense.MICROSCOPE_MOVES):
    """Return the result and the dense least squares of readings; of lines some are missing."""
    return both(
        measured(plan, model, sense, missing=0.1 * (plan == "lines")),
        model,
        misalignment_model="linear",
        at_places=False,
    )


def saved(result):
    return result_from_dict(json.loads(json.dumps(result_to_dict(worded(result)))), "r")


def require_same(found, wanted, rel):
    """Require covariances within a part of the product of their standard uncertainties."""
    u = np.sqrt(np.diag(wanted))
    assert np.abs(found - wanted).max() > 0
    assert (np.abs(found - wanted) <= rel * np.outer(u, u)).all()


@pytest.mark.parametrize("model", ["none", "assumed", "sized", "free"])
@pytest.mark.parametrize(
    ("plan", "sense"),
    [("lines", Sense.MICROSCOPE_MOVES), ("oblong", Sense.PLATE_MOVES)],
)
def test_covariance_of_both_maps_and_the_microscope(plan, model, sense):
    result, dense = solved(plan, model, sense)
    known = together(saved(result))
    dense.grid(known.sites)
    dense.plate(known.marks, known.sites)
    of = {
        part: at
        for (term, _, part), at in zip(
            dense.keys, range(len(dense.p))[dense.b], strict=True
        )
        if term == "microscope"
    }
    rows = np.zeros((4, len(dense.p)))
    for row, part in zip(rows, ("scale", "turn", "stretch", "shear"), strict=True):
        row[of.get(part, 0)] = part in of
    rows = np.concatenate(
        [
            dense.to_map[np.tile(known.sites.ravel(), 2)],
            dense.to_plate[np.tile(known.marks.ravel(), 2)],
            rows,
        ]
    )
    require_same(
        known.cover(known.sites, known.marks), rows @ dense.covariance @ rows.T, 2e-3
    )


@pytest.mark.parametrize(
    ("model", "sense"),
    [
        ("none", Sense.MICROSCOPE_MOVES),
        ("assumed", Sense.PLATE_MOVES),
        ("sized", Sense.MICROSCOPE_MOVES),
    ],
)
def test_covariance_of_both_angular_maps(model, sense):
    result, dense = solved("lines", model, sense)
    known, cover = together(saved(result)).lines()
    rows = np.zeros((2, dense.K, len(dense.p)))
    for part, at, here in zip(rows, (dense.gt, dense.at), known, strict=True):
        part[:, at] = np.eye(dense.K)
        part -= part[here].mean(axis=0)
        part[~here] = 0
    rows = rows.reshape(-1, len(dense.p))
    wanted, told = rows @ dense.covariance @ rows.T, known.ravel()
    require_same(cover[np.ix_(told, told)], wanted[np.ix_(told, told)], 5e-3)
    assert not cover[~told].any()


def test_what_is_not_kept_is_not_known():
    result, _ = solved("oblong", "sized")
    assert together(saved(result)) is not None
    kept = replace(result.kept, factors=replace(result.kept.factors, beside={}))
    assert together(replace(result, kept=kept)) is None
    assert (
        together(
            replace(
                result,
                views=tuple(replace(view, read_grid=None) for view in result.views),
            )
        )
        is None
    )


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            lambda kept: {
                "beside": {k: v for k, v in kept.beside.items() if k != "plate"}
            },
            "no plate of this plate",
        ),
        (
            lambda kept: {
                "terms": (*kept.terms, "slip"),
                "of_map": np.concatenate([kept.of_map, kept.of_map[:1]]),
            },
            "no effects on the plate",
        ),
    ],
)
def test_factors_without_what_belongs_to_them_are_refused(changed, message):
    result, _ = solved("oblong", "sized")
    factors = replace(result.kept.factors, **changed(result.kept.factors))
    known = together(replace(result, kept=replace(result.kept, factors=factors)))
    with pytest.raises(
        InputError, match=f"covariance_terms: {message}; write the result again"
    ):
        known.cover(known.sites, known.marks)
