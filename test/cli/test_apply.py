# SPDX-License-Identifier: Apache-2.0
"""``selfcal apply``: a table of positions through the map."""

import json
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.apply import StageMap
from selfcal_ros.cli.main import main
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.words.findings import worded
from test.support.maps import random_map, result_of
from test.support.sessions import collected, events_of, small_plan

MAP = random_map(Artifact(5, 0.01, 8), 3, unknown=((0, 0),))
POINTS = "x,y,theta\n0.01,-0.02,0.5\n0.0033,0.0071,-2\n0.05,0.0,0\n-0.02,-0.02,1\n"


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(MAP)))
    (tmp_path / "p.csv").write_text(POINTS)
    return tmp_path


def table(path) -> tuple[list[str], np.ndarray]:
    head, *rows = path.read_text().splitlines()
    return head.split(","), np.array(
        [[float(cell or "nan") for cell in row.split(",")] for row in rows]
    )


@pytest.mark.parametrize("inverse", [False, True])
def test_each_point_is_followed_by_its_correction_and_u(desk, capsys, inverse):
    assert (
        main(
            [
                "apply",
                "R.json",
                "p.csv",
                "-o",
                "o.csv",
                "--outside",
                "edge",
                *["--inverse"] * inverse,
            ]
        )
        == 0
    )
    head, rows = table(desk / "o.csv")
    end = "true" if inverse else "command"
    assert head == [
        "x",
        "y",
        "theta",
        f"x_{end}",
        f"y_{end}",
        f"theta_{end}",
        "u_x",
        "u_y",
        "u_theta",
    ]
    x, y, theta = rows[:, :3].T
    use = Compensator(MAP)
    wanted = use.correct(x, y) if inverse else use.command(x, y)
    np.testing.assert_array_equal(rows[:, 3:5].T, wanted)
    turned = use.correct_theta(theta) if inverse else use.command_theta(theta)
    np.testing.assert_array_equal(rows[:, 5], turned)
    at = np.clip(wanted, -0.02, 0.02) if inverse else np.array([x, y])
    at[:, 2] = 0.05  # the point outside
    np.testing.assert_array_equal(rows[:, 6:8].T, use.uncertainty(*at))
    np.testing.assert_array_equal(
        rows[:, 8], use.uncertainty_theta(turned if inverse else theta)
    )
    out, err = capsys.readouterr()
    assert out == "written: o.csv, 4 points\n"
    assert err.splitlines() == [
        "selfcal apply: points outside the field, corrected as the nearest point of its edge, "
        "where u is not known: 1",
        "selfcal apply: points next to unknown sites or lines, left empty: 1",
    ]


def test_there_and_back_is_where_it_was(desk):
    (desk / "p.csv").write_text("# one\nX, Y\n # point\n0.011,-0.017\n")
    assert main(["apply", "R.json", "p.csv", "-o", "there.csv"]) == 0
    ((x, y),) = table(desk / "there.csv")[1][:, 2:4]
    (desk / "q.csv").write_text(f"x,y\n{float(x)!r},{float(y)!r}\n")
    assert main(["apply", "R.json", "q.csv", "-o", "back.csv", "--inverse"]) == 0
    np.testing.assert_allclose(
        table(desk / "back.csv")[1][0, 2:4], (0.011, -0.017), rtol=0, atol=1e-16
    )


def test_stdout_json_and_bicubic(desk, capsys):
    write_json("R.json", result_to_dict(result_of(random_map(Artifact(5, 0.01, 8), 3))))
    assert (
        main(
            [
                "apply",
                "R.json",
                "p.csv",
                "-o",
                "-",
                "--json",
                "--method",
                "bicubic",
                "--outside",
                "edge",
            ]
        )
        == 0
    )
    text = json.loads(capsys.readouterr().out)["csv"]
    (desk / "o.csv").write_text(text)
    use = Compensator(random_map(Artifact(5, 0.01, 8), 3), method="bicubic")
    rows = table(desk / "o.csv")[1]
    np.testing.assert_array_equal(rows[:, 3:5].T, use.command(*rows[:, :2].T))


def test_distances_get_their_error_and_a_line_over_the_length(desk, capsys):
    result = worded(calibrate(collected(events_of(small_plan("0, 90, 180, tx")))[1]))
    write_json("R.json", result_to_dict(result))
    (desk / "d.csv").write_text("x1,y1,x2,y2\n-0.02,0,0.02,0.01\n0,0,0,0.05\n")
    assert main(["apply", "R.json", "d.csv", "-o", "o.csv"]) == 5
    head, rows = table(desk / "o.csv")
    assert head == ["x1", "y1", "x2", "y2", "length", "error", "u"]
    error, u = StageMap(result).length_error(*rows[:, :4].T.reshape(2, 2, 2))
    np.testing.assert_array_equal(
        rows[:, 4:].T,
        [[np.hypot(0.04, 0.01), 0.05], [error[0], np.nan], [u[0], np.nan]],
    )
    *lines, outside = capsys.readouterr().err.splitlines()
    for line, anywhere in zip(lines, (True, False), strict=True):
        a, b = StageMap(result).length_uncertainty(anywhere=anywhere)
        where = "anywhere in the field" if anywhere else "of two nodes"
        assert (
            f"U of a distance L {where} is at most {1e6 * a:.3g} µm + {1e6 * b:.3g} µm/m L"
            in line
        )
    assert outside.startswith("selfcal apply: points outside the field, left empty (")
    assert main(["apply", "R.json", "d.csv", "-o", "x.csv", "--inverse"]) == 2
    assert "the ends of distances are true positions" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "p.csv:1: the header is not x,y or x,y,theta"),
        (
            "# made by hand\nname,y,x\nP,1,2\n",
            "p.csv:2: the header is not x,y or x,y,theta or x1,y1,x2,y2; begin with one of",
        ),
        ("x,y\n", "p.csv: it has no points"),
        ("x,y\n1,2,3\n", "p.csv:2: not 2 positions: '1,2,3'; give x,y in m and rad"),
        (
            "x,y\n0,01,0,02\n",
            "p.csv:2: not 2 positions: '0,01,0,02'; give x,y with decimal points, in",
        ),
        ("x,y\n\n1,nan\n", "p.csv:3: not 2 positions"),
        ("x,y\n1,inf\n", "p.csv:2: not 2 positions"),
        ("x,y\n1,z\n", "p.csv:2: not 2 positions"),
        (
            "x1,y1,x2,y2\n0,0,0.01,0\n0.01,0,0.01,0\n",
            "p.csv:3: the ends of the distance coincide; give two points",
        ),
        ("x,y\n1,1_0e-3\n", "p.csv:2: not 2 positions"),
        ("x,y\n1,٠.٠١\n", "p.csv:2: not 2 positions"),
    ],
)
def test_a_bad_table_is_one_line(desk, capsys, text, message):
    (desk / "p.csv").write_text(text)
    assert main(["apply", "R.json", "p.csv", "-o", "o.csv"]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"selfcal apply: {message}") and err.count("\n") == 1
    assert not (desk / "o.csv").exists()


@pytest.mark.parametrize("inverse", [False, True])
def test_beyond_the_edge_nothing_is_known(desk, capsys, inverse):
    """Neither value nor u, and code 5; theta has no edge, and the edge itself is inside."""
    (desk / "p.csv").write_text("x,y,theta\n0.02,0.02,0.5\n0.0225,0.0,1\n0.0,-0.03,1\n")
    words = ["apply", "R.json", "p.csv", "-o", "o.csv", *["--inverse"] * inverse]
    write_json(
        "R.json",
        result_to_dict(result_of(random_map(Artifact(5, 0.01, 8), 3, gain=1e-6))),
    )
    assert main(words) == 5
    rows = table(desk / "o.csv")[1]
    known = np.isfinite(rows[:, 3:])
    np.testing.assert_array_equal(known, [[True] * 6, *[[False, False, True] * 2] * 2])
    assert "left empty (--outside edge" in capsys.readouterr().err
    assert main([*words, "--outside", "edge", "--force"]) == 0
    edge = table(desk / "o.csv")[1]
    np.testing.assert_array_equal(np.isfinite(edge[:, 3:6]), True)
    np.testing.assert_array_equal(np.isfinite(edge[:, 6:]), known[:, 3:])


@pytest.mark.parametrize(
    ("text", "words", "code"),
    [
        ("x,y\n10,-5\n0,0\n", (), 2),
        ("x,y\n10,-5\n0,0\n", ("--outside", "edge"), 2),
        ("x1,y1,x2,y2\n10,-5,0,0\n", (), 2),
        ("x,y\n0.021,0\n0,0\n", (), 5),
        ("x,y\n0.021,0\n0,0\n", ("--outside", "edge"), 0),
        ("x,y\n10,-5\n0.01,0\n", (), 5),
        ("x,y\n0,0\n", (), 0),
    ],
)
def test_points_in_mm_are_asked_about(desk, capsys, text, words, code):
    (desk / "p.csv").write_text(text)
    assert main(["apply", "R.json", "p.csv", "-o", "o.csv", *words]) == code
    asked = (
        "p.csv: all points but the origin lie outside the field (x from -20 to 20 mm, y "
        "from -20 to 20 mm), up to ("
    )
    assert (asked in (err := capsys.readouterr().err)) is (code == 2)
    assert ("m: is it in mm?; give positions in m" in err) is (code == 2)


def test_a_table_of_excel_is_read_and_its_national_forms_are_named(desk, capsys):
    words = ["apply", "R.json", "p.csv", "-o", "o.csv", "--force"]
    (desk / "p.csv").write_bytes(b"\xef\xbb\xbfx,y\r\n0.01,-0.005\r\n0,0\r\n,\r\n")
    assert main(words) == 0
    np.testing.assert_array_equal(
        table(desk / "o.csv")[1][:, :2], [[0.01, -0.005], [0, 0]]
    )
    for text, message in (
        (
            "x;y\n0,01;-0,005\n",
            "p.csv:1: columns are separated by semicolons (and the numbers "
            "have decimal commas?); save the table with commas between columns and points in",
        ),
        ("x\ty\n0.01\t0\n", "p.csv:1: columns are separated by tabs"),
        (
            'x,y\n"0,01","-0,005"\n',
            "p.csv:2: '0,01' has a decimal comma; save the table",
        ),
    ):
        (desk / "p.csv").write_text(text)
        assert main(words) == 2
        assert message in capsys.readouterr().err


def test_outside_refused_and_not_qualified(desk, capsys):
    assert main(["apply", "R.json", "p.csv", "-o", "o.csv", "--outside", "refuse"]) == 2
    refusal = capsys.readouterr().err
    assert "outside the calibrated field" in refusal
    assert "nearest point of the edge" in refusal and "clamp" not in refusal
    doubt = replace(
        result_of(MAP),
        verdict=Verdict(Grade.NOT_QUALIFIED, sentence="Not qualified: too noisy."),
    )
    write_json("R.json", result_to_dict(doubt))
    assert main(["apply", "R.json", "p.csv", "-o", "o.csv", "--outside", "edge"]) == 5
    assert "too noisy" in capsys.readouterr().err and (desk / "o.csv").exists()


def test_bicubic_is_advised_where_it_halves_u_between_the_nodes(desk, capsys):
    """A stage of long waves, one whose nodes are independent, and points on nodes alone."""
    emap = random_map(Artifact(9, 0.01), 1)
    wave = 1e-6 * np.sin(emap.artifact.x_m / 0.015 + emap.artifact.y_m / 0.02)
    noise = np.random.default_rng(2).normal(0, 1e-6, wave.shape)
    for g, at, advised in (
        (wave, 0.005, True),
        (noise, 0.005, False),
        (wave, 0.01, False),
    ):
        (desk / "d.csv").write_text(f"x,y\n{at},{at}\n0.02,{-at}\n")
        u = np.full(wave.shape, 1e-9)
        write_json(
            "R.json",
            result_to_dict(result_of(replace(emap, gx=g, gy=g[::-1], u_gx=u, u_gy=u))),
        )
        assert main(["apply", "R.json", "d.csv", "-o", "o.csv", "--force"]) == 0
        assert ("with --method bicubic" in capsys.readouterr().err) is advised
