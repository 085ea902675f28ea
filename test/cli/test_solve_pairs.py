# SPDX-License-Identifier: Apache-2.0
"""Options of ``selfcal solve`` in pairs: every value of each with every value of every other.

What must hold comes from outside the estimator: the known truth, what was asked for, what files
there may be. Four pairs were wrong once, and each fails here where its mending is taken back: a map
without uncertainties that was qualified though its axes were wrong (never, xy_axes), uncertainties
that nobody wanted (law, never), noise that grew by six orders (xy_axes, terms of the model), and
the validation of another method (law, validate). All rows of a bag share one draw of its noise: the
limits are those of one map, not of forty.
"""

import json
from functools import partial
from itertools import combinations

import numpy as np
import pytest
import yaml

from selfcal_ros.cli import solve
from selfcal_ros.cli.main import main
from selfcal_ros.estimation.quality import validation
from selfcal_ros.files import read_json
from selfcal_ros.model.result import result_from_dict, result_to_dict

FACTORS = {
    "model": (
        [],
        ["--model", "microscope"],
        ["--model", "drift", "--model", "plate_scale:1e-6"],
        ["--model", "plate_shape:3e-8,approach"],
        ["--model", "none"],
    ),
    "reference": (
        [],
        ["--reference", "artifact:{plate}:3e-7"],
        ["--reference", "stage_x:{axis}:1e-7", "--certificate", "No. 7"],
    ),
    "uncertainty": ([], ["--uncertainty", "never"], ["--uncertainty", "always"]),
    "misalignment": ([], ["--misalignment", "linear"], ["--misalignment", "rigid"]),
    "method": ([], ["--method", "law"]),
    "datum": ([], ["--theta-datum", "xy_axes"]),
    "namespace": ([], ["--namespace", "/"]),
    "params": ([], ["--params", "nodes.yaml"]),
    "robust": ([], ["--robust"]),
    "validate": ([], ["--validate"]),
    "budget": ([], ["--budget"]),
    "report": ([], ["--report", "r.html"]),
    "quiet": ([], ["--quiet"]),
    "json": ([], ["--json"]),
}
ASSUMED = {
    "microscope",
    "plate_shape",
    "plate_strain",
    "line_eccentricity",
    "line_scale",
    "rotation",
}
"""What is in the model unless it is none, or linear."""
CLASHES = {
    ("reference", 1),
    ("reference", 2),
    ("model", 1),
    ("model", 2),
    ("model", 3),
    ("misalignment", 2),
    ("robust", 1),
    ("validate", 1),
}
"""What Hu's law does not go together with."""
VIEWS = [
    ("a", 0, (0, 0)),
    ("b", 90, (0, 0)),
    ("c", 0, (1, 0)),
    ("d", 0, (-1, 0)),
    ("e", 0, (0, 1)),
]
SIGMA_M, SIGMA_RAD = 2e-8, 1e-5
BAGS = {
    # axes that the rotary encoder continues, stops on the marks, visits from all sides
    "five": (
        VIEWS,
        4,
        "x_back_y_back@plate",
        {"encoder": "xy_axes", "phi": 5e-3},
        {},
        {"lost": 0.05},
    ),
    # Hu's views, marks without names, stops on them, each reached from one side, other axes
    "hu": (
        VIEWS[:3],
        2,
        "raster",
        {"encoder": "independent", "phi": 1e-5, "t": 3e-6},
        {"with_ids": False},
        {},
    ),
}
GAIN = {"gx": 6.0, "gy": 6.0, "g_theta": 1.0}
"""Largest standard uncertainty over the noise of one reading, whatever terms are in the model."""


Row = dict[str, int]


def clash(row: Row) -> bool:
    """Return whether options of a row contradict each other."""
    return bool(row.get("method")) and any(
        row.get(name) == level for name, level in CLASHES
    )


def pairs_of(factors) -> set[tuple[str, int, str, int]]:
    """Return each two levels of two factors, those that contradict each other left out."""
    return {
        (a, i, b, j)
        for a, b in combinations(factors, 2)
        for i in range(len(factors[a]))
        for j in range(len(factors[b]))
        if not clash({a: i, b: j})
    }


def covering(factors) -> list[Row]:
    """Return rows (factor: level) so that each two levels of two factors meet in a row; greedy.

    A row in which something is refused hides the other pairs in it: there is none.
    """
    left, rows = pairs_of(factors), []
    while left:
        first = min(left)
        row = {first[0]: first[1], first[2]: first[3]}
        for name in (name for name in factors if name not in row):
            row[name] = max(
                (
                    level
                    for level in range(len(factors[name]))
                    if not clash({**row, name: level})
                ),
                key=lambda level, name=name: (
                    len(left & pairs_in({**row, name: level}, factors)),
                    -level,
                ),
            )
        left -= pairs_in(row, factors)
        rows.append(row)
    return rows


def pairs_in(row: Row, factors) -> set[tuple[str, int, str, int]]:
    return {
        (a, row[a], b, row[b])
        for a, b in combinations(factors, 2)
        if a in row and b in row
    }


def factors_of(bag: str):
    """Return the options that a bag can be solved with: the law wants Hu's views."""
    return (
        FACTORS if bag == "hu" else {k: v for k, v in FACTORS.items() if k != "method"}
    )


ROWS = {bag: covering(factors_of(bag)) for bag in BAGS}


def words_of(row: Row, **known: float) -> list[str]:
    return [
        word.format(**known)
        for name, level in row.items()
        for word in FACTORS[name][level]
    ]


@pytest.mark.parametrize("bag", BAGS)
def test_each_two_values_of_options_meet(bag):
    factors = factors_of(bag)
    assert set().union(*(pairs_in(row, factors) for row in ROWS[bag])) >= pairs_of(
        factors
    )
    assert not any(clash(row) for row in ROWS[bag]) and len(ROWS[bag]) <= 30


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    for number, (name, (views, repeats, order, truth, cell, faults)) in enumerate(
        BAGS.items()
    ):
        plan = {
            "plan_id": name,
            "visit_order": order,
            "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 8},
            "views": [
                *(
                    {
                        "name": view,
                        "rotation_deg": turn,
                        "translation_pitch": list(shift),
                        "repeats": repeats,
                    }
                    for view, turn, shift in views
                ),
                {"name": "l", "rotation_deg": 45, "grid": False, "repeats": repeats},
            ],
        }
        (folder / f"{name}.yaml").write_text(
            yaml.safe_dump(
                {
                    "plan": plan,
                    "seed": 32 + number,
                    "cell": cell,
                    "faults": faults,
                    "truth": {
                        "rotation": "linear" if name == "hu" else "finite",
                        **truth,
                    },
                    "noise": {"sigma_xy": SIGMA_M, "sigma_theta": SIGMA_RAD},
                }
            )
        )
        assert (
            main(["simulate", str(folder / f"{name}.yaml"), "-o", str(folder / name)])
            == 0
        )
    return folder


@pytest.mark.parametrize(
    ("bag", "words"),
    [
        *(
            ("hu", words_of({"method": 1, name: level}, plate=0, axis=0))
            for name, level in sorted(CLASHES)
        ),
        ("hu", ["--certificate", "No. 7"]),
        ("five", ["--method", "law"]),
    ],
    ids=str,
)
def test_options_that_contradict_each_other(bags, bag, words, tmp_path, capsys):
    capsys.readouterr()
    assert (
        main(
            [
                "solve",
                str(bags / bag),
                "-o",
                str(tmp_path / "o.json"),
                "--report",
                str(tmp_path / "r.html"),
                *words,
            ]
        )
        == 2
    )
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("selfcal solve: ")
    assert printed.err.count("\n") == 1 and "; " in printed.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("bag", "number"),
    [(bag, number) for bag, rows in ROWS.items() for number in range(len(rows))],
)
def test_options_in_pairs(bags, bag, number, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(validation, "N_DRAWS", 16)
    monkeypatch.setattr(solve, "validate", partial(validation.validate, folds=1))
    capsys.readouterr()
    row = {"method": 0, **ROWS[bag][number]}
    (tmp_path / "nodes.yaml").write_text("solver: {ros__parameters: {drift_degree: 2}}")
    known = read_json(bags / bag / "truth.json")
    truth = {
        name: np.array(known[name]) for name in ("gx", "gy", "g_theta", "ax", "ay")
    }
    code = main(
        ["solve", str(bags / bag), "-o", "o.json", *words_of(row, **scales(truth))]
    )
    printed = capsys.readouterr()
    data, files = read_json("o.json"), {path.name for path in tmp_path.iterdir()}
    if row["json"]:
        assert json.loads(printed.out) == data
    # a plate that was laid down so well does not tell a microscope or a drift
    if code == 3:
        assert bag == "hu" and row["model"] in (1, 2, 3)
        assert not data["observability"]["identifiable"] and files == {
            "nodes.yaml",
            "o.json",
        }
        assert (
            printed.err.startswith("selfcal solve: ") and printed.err.count("\n") == 1
        )
        return
    # wrong by what is known: rotations that are no small ones, axes that the encoder owes nothing
    wrong = row["misalignment"] == 1 if bag == "five" else row["datum"] == 1
    grade = data["verdict"]["grade"]
    assert code == (5 if grade == "not_qualified" else 0)
    assert grade != "good" if wrong else grade == "good"
    assert files == {"nodes.yaml", "o.json"} | ({"r.html"} if row["report"] else set())
    again = result_to_dict(result_from_dict(data, "o.json"))
    # 1 and 1.0 are the same number
    assert again | {"digest": None} == data | {"digest": None}
    told = printed.err if row["json"] else printed.out
    assert ("Stage error" in told) == (not row["quiet"])
    assert_as_asked(data, row)
    assert_true(
        data, truth, row, wrong_xy=wrong and (bag == "five" or row["method"] == 1)
    )


def scales(truth):
    """Return the least-squares scale of the plate and the slope of Gx along x: known lengths."""
    x = np.arange(-2, 3)[:, None] * 0.01 * np.ones((1, 5))
    return {
        "plate": (truth["ax"] * x + truth["ay"] * x.T).sum() / (x**2 + x.T**2).sum(),
        "axis": (truth["gx"] * x).sum() / (x**2).sum(),
    }


def assert_as_asked(data, row):
    """The result says what was asked for, and has what was asked for and nothing else."""
    assert data["method"] == ("law" if row["method"] else "joint")
    assert data["error_map"]["datum_theta"] == (
        "xy_axes" if row["datum"] else "zero_mean"
    )
    linear = row["misalignment"] == 1 or row["method"]
    assert data["model"]["misalignment"] == ("linear" if linear else "rigid")
    given = ",".join(FACTORS["model"][row["model"]][1::2]).replace("none", "")
    names = {text.split(":")[0] for text in given.split(",") if text}
    bare = linear or row["model"] == 4
    assert {
        term["name"] for term in data["model"]["terms"] if term["source"] != "readings"
    } == names | (set() if bare else ASSUMED)
    degrees = {2 if row["params"] else 3} if "drift" in given else set()
    assert {
        sum(
            item["view"] == "a" and item["component"].startswith("x")
            for item in term["estimates"]
        )
        for term in data["model"]["terms"]
        if term["name"] == "drift"
    } == degrees
    kind = (None, "artifact", "stage_x")[row["reference"]]
    assert (data["reference"] or {}).get("kind") == kind
    assert (data["reference"] or {}).get("certificate", "") == "No. 7" * (
        row["reference"] == 2
    )
    never = row["uncertainty"] == 1
    assert ("outliers" in data, "validation" in data, bool(data["budget"])) == (
        bool(row["robust"]),
        bool(row["validate"]),
        not never,
    )


def assert_true(data, truth, row, *, wrong_xy):
    """All is known; and where the result is right, to within what it says."""
    emap, never = data["error_map"], row["uncertainty"] == 1
    error = {
        name: np.array(emap[name], dtype=float) - truth[name] for name in ("gx", "gy")
    }
    theta = truth["g_theta"] - (0.0 if row["datum"] else truth["g_theta"].mean())
    error["g_theta"] = np.array(emap["g_theta"], dtype=float) - theta
    for name, values in error.items():
        largest = GAIN[name] * (SIGMA_RAD if name == "g_theta" else SIGMA_M)
        u = np.array(emap[f"u_{name}"], dtype=float)
        assert np.isfinite(values).all()
        assert np.isnan(u).all() if never else (u > 0).all() and np.isfinite(u).all()
        # axes that the encoder does not follow spoil theta alone, but for Hu's law
        if data["verdict"]["qualified"] or (not wrong_xy and name != "g_theta"):
            # what is wrong and bounded enlarges u
            assert (
                never or data["verdict"]["grade"] == "enlarged" or u.max() < largest
            ), name
            of_u = values / (largest if never else u)
            assert np.sqrt((of_u**2).mean()) < 1.8 and abs(of_u).max() < 4.5, name
