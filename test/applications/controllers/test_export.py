# SPDX-License-Identifier: Apache-2.0
"""Exported tables on simulated controllers, for every wiring; and on the wrong machine."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.controllers.export import FORMATS, export, loaded
from selfcal_ros.applications.controllers.grid import Grid, Source, Wiring, fixed
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import plane_residuals
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.support.maps import random_map, result_of

PLATE = Artifact(7, 0.01, 0, 5)
COUNTS = 2e6  # in a mm: a sixteenth is 0.03 nm
FRAMES = [
    MachineFrame(),
    MachineFrame(2, 1),
    MachineFrame(4, 7, unit="m", home_x_m=-0.03, home_y_m=0.01),
    MachineFrame(3, 1, unit="um", home_x_m=0.0123, reverse_x=True),
    MachineFrame(1, 2, unit="in", home_y_m=-0.0271, reverse_y=True),
    MachineFrame(5, 6, home_x_m=0.003, home_y_m=0.05, reverse_x=True, reverse_y=True),
]


def wiring_of(frame, name, **kwargs) -> Wiring:
    per = COUNTS * frame.unit_m / 1e-3
    return Wiring(frame, (per, 1.5 * per) if name == "pmac" else None, **kwargs)


def sayable(name, seed=1, gain=1.0):
    """Return a random map that the format can hold."""
    emap = random_map(PLATE, seed, gain=gain)
    gx, gy = emap.gx, emap.gy
    if name == "siemens":
        gx, gy = (g[:, :1] + g[:1, :] for g in (gx, gy))
    if name == "linuxcnc":
        gx, gy = gx[:, :1] + 0 * gx, gy[:1, :] + 0 * gy
    return replace(emap, gx=gx, gy=gy)


def sources_of(made):
    return [Source(text, name) for name, text in made.files.items()]


def rounding(name, frame):
    """Return the distance that the digits, and the motion of the zero, may leave."""
    if name == "pmac" and frame in FRAMES[3:5]:
        return 1e-7  # no fraction of its cells meets the nodes of the map
    return 3e-11 if name != "pmac" else 6e-11


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("name", FORMATS)
def test_a_map_that_can_be_said_leaves_the_rounding_of_the_digits(name, frame):
    emap = sayable(name)
    made = export(name, result_of(emap), wiring_of(frame, name), "out.txt")
    sites, between = made.residuals
    assert sites.rms("before") > 1e-7
    assert sorted({*between.position[0].round(6)}) == pytest.approx(
        np.arange(-2.5, 3) * 0.01
    )
    assert sites.largest("after") < rounding(name, frame)
    linear = Compensator(emap).error(*between.position)
    cubic = Compensator(emap, method="bicubic").error(*between.position)
    rest = np.subtract(cubic, linear)
    rest = rest - rest.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(
        between.after, -rest, rtol=0, atol=rounding(name, frame) + 1e-10
    )


WRONG = {
    "home_x": lambda w: replace(
        w, frame=replace(w.frame, home_x_m=w.frame.home_x_m + 0.01)
    ),
    "home_y": lambda w: replace(
        w, frame=replace(w.frame, home_y_m=w.frame.home_y_m - 0.01)
    ),
    "reverse_x": lambda w: replace(
        w, frame=replace(w.frame, reverse_x=not w.frame.reverse_x)
    ),
    "reverse_y": lambda w: replace(
        w, frame=replace(w.frame, reverse_y=not w.frame.reverse_y)
    ),
    "axes": lambda w: replace(
        w, frame=replace(w.frame, x_axis=w.frame.y_axis, y_axis=w.frame.x_axis)
    ),
    "unit": lambda w: replace(w, frame=replace(w.frame, unit="um")),
    "counts": lambda w: replace(w, counts=w.counts and w.counts[::-1]),
    "negate": lambda w: replace(w, negate=not w.negate),
}
HAS = {
    "axes": ("pmac", "beckhoff", "siemens"),
    "unit": ("kmotion", "linuxcnc", "siemens"),
    "counts": ("pmac",),
    "negate": ("beckhoff", "siemens"),
}


@pytest.mark.parametrize(
    ("name", "what"),
    [(name, what) for what in WRONG for name in HAS.get(what, FORMATS)],
)
@pytest.mark.parametrize("frame", [FRAMES[0], FRAMES[5]])
def test_a_file_does_not_correct_a_machine_that_is_wired_otherwise(name, what, frame):
    """With another sign, sense, order, direction, home, unit the error is not taken away."""
    emap, wiring = sayable(name, gain=3.0), wiring_of(frame, name)
    made = export(name, result_of(emap), wiring, "out.txt")
    other = WRONG[what](wiring)
    try:
        correct = loaded(name, sources_of(made), other)
    except InputError as error:  # axes that are written in the file
        assert what == "axes" and "masters" in str(error)
        return
    after = plane_residuals(emap, other.frame, correct)[0]
    assert after.rms("after") > 0.3 * after.rms("before")


def test_the_files_of_x_and_y_are_not_exchanged():
    emap = sayable("linuxcnc")
    made = export("linuxcnc", result_of(emap), Wiring(FRAMES[0]), "a/b.comp")
    assert list(made.files) == ["a/b_x.comp", "a/b_y.comp"]
    correct = loaded("linuxcnc", sources_of(made)[::-1], Wiring(FRAMES[0]))
    assert plane_residuals(emap, FRAMES[0], correct)[0].rms("after") > 1e-7


def test_a_long_axis_of_linuxcnc_has_as_many_lines_as_it_may():
    plate = Artifact(301, 1e-4, 0, 3)
    emap = random_map(plate, 2)
    gx = np.outer(np.sin(plate.x_m[:, 0] * 300) * 1e-6, np.ones(3))
    made = export(
        "linuxcnc", result_of(replace(emap, gx=gx, gy=0 * gx)), Wiring(FRAMES[0]), "o"
    )
    lines = [line.split() for line in made.files["o_x"].splitlines()[:256]]
    assert (float(lines[0][0]), float(lines[255][0])) == (-15, 15)
    assert made.files["o_x"].splitlines()[256] == "" and all(
        len(line) == 3 for line in lines
    )
    assert made.residuals[0].largest("after") < 1e-9


@pytest.mark.parametrize(("size", "said"), [(101, []), (103, ["10609", "10609"])])
def test_beckhoff_is_told_of_more_points_than_it_expects(size, said):
    emap = random_map(Artifact(size, 1e-3), 1, gain=0.01)
    texts = FORMATS["beckhoff"].write(emap, Wiring(FRAMES[0]))
    assert [
        line.split()[1]
        for lines in texts.values()
        for line in lines
        if "max_points" in line
    ] == said


def test_digits_are_those_of_the_rounding_and_zero_has_no_sign():
    assert [fixed(v, 1e-3) for v in (-1e-12, 1.0, -1.25)] == [
        "0.00000000",
        "1.00000000",
        "-1.25000000",
    ]
    assert [fixed(1.0, unit) for unit in (1.0, 1e-6, 0.0254)] == [
        "1." + 11 * "0",
        "1.00000",
        "1.0000000000",
    ]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("linuxcnc", "0 0 0\n1 1\n", "file:2: '1 1' is not of the form"),
        ("linuxcnc", "0 0 0\n1 1 1e20\n", "file:2: a number is too large"),
        (
            "linuxcnc",
            "0 0 0\n0 1 1\n",
            "file: 2 lines, or positions that do not increase",
        ),
        ("linuxcnc", "0 0 0\n1 1 2\n", "file: forward and reverse differ"),
        (
            "kmotion",
            "2,2\n1,1\n0,0\n0,0,1,1,0\n0,1,1,1,0\n1,0,1,1,0\n1,2,1,1,0",
            "file:7: row 1, column 2 is not in the table",
        ),
        ("kmotion", "1,2\n1,1\n0,0", "file: 1 rows and 2 columns"),
        ("kmotion", "2,2\n1,0\n0,0", "file: 2 rows and 2 columns, spacing [1.0, 0.0]"),
        ("pmac", "#1\n5 5 5", "file:2: '5 5 5' is not part of a table"),
        (
            "pmac",
            "DEFINE COMP 1.1,#1D,#3D,#1,9,9\n1 2 3",
            "file:1: motors (1, 3, 1) are not those",
        ),
        (
            "pmac",
            "DEFINE COMP 1.1,#1D,#2D,#1,9,9\n1 2",
            "file:1: 2 entries for 1.1; 3 belong",
        ),
    ],
)
def test_a_reader_names_the_line_and_what_is_wrong(name, text, message):
    with pytest.raises(InputError) as raised:
        loaded(
            name,
            [Source(text, "file")] * len(FORMATS[name].parts),
            wiring_of(FRAMES[0], name),
        )
    assert str(raised.value).startswith(message)


@pytest.mark.parametrize("name", ["beckhoff", "siemens"])
def test_negated_values_are_for_a_machine_that_subtracts(name):
    emap = sayable(name)
    plain = export(name, result_of(emap), wiring_of(FRAMES[0], name), "out.txt")
    made = export(
        name, result_of(emap), wiring_of(FRAMES[0], name, negate=True), "out.txt"
    )
    assert made.residuals[0].largest("after") < 3e-11
    added, subtracted = (
        loaded(name, sources_of(files), wiring_of(FRAMES[0], name))(
            np.array(3.0), np.array(-7.0)
        )
        for files in (plain, made)
    )
    np.testing.assert_allclose(added, np.negative(subtracted), rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ["linuxcnc", "siemens"])
def test_what_cannot_be_said_remains_and_the_file_says_how_much(name):
    emap = random_map(PLATE, 1)
    made = export(name, result_of(emap), Wiring(FRAMES[0]), "out.txt")
    rest = [
        g - g.mean(axis=axis, keepdims=True) for g, axis in ((emap.gx, 1), (emap.gy, 0))
    ]
    if name == "siemens":
        rest = [
            g - g.mean(axis=1 - axis, keepdims=True)
            for g, axis in zip(rest, (1, 0), strict=True)
        ]
    left = np.sqrt(sum((g - g.mean()).var() for g in rest))
    sites = made.residuals[0]
    assert sites.rms("after") == pytest.approx(left, rel=1e-3) and left > 5e-8
    for text in made.files.values():
        assert f"{1e6 * sites.rms('after'):.3g} um rms" in text


@pytest.mark.parametrize("name", FORMATS)
def test_the_comment_tells_where_a_file_comes_from(name):
    made = export(
        name, result_of(sayable(name)), wiring_of(FRAMES[0], name), "out.txt", filled=2
    )
    for text in made.files.values():
        mark = FORMATS[name].comment
        said = "\n".join(line for line in text.splitlines() if line.startswith(mark))
        for part in (
            "demo.mcap",
            "abab",
            "plan: demo",
            "datum: no translation",
            "reference length",
            "standard uncertainty of the corrections at the nodes",
            "written by selfcal",
            "verdict: good",
            "2 sites were",
            "added to the command",
            FORMATS[name].what,
            "left at the nodes",
            "machine: ",
        ):
            assert part in said, part
        assert ("sense is not documented" in said) == (name in ("beckhoff", "siemens"))
        first = text.splitlines()[0]
        assert first.startswith(mark) != FORMATS[name].comments_last


@pytest.mark.parametrize(
    "plan_id", ["a\nb", "/* a", "*/ a /* b", "/*/", "a; # b", "\x0b\u2028"]
)
@pytest.mark.parametrize("name", FORMATS)
def test_no_name_in_a_comment_changes_what_is_read(name, plan_id):
    wiring, at = wiring_of(FRAMES[0], name), np.linspace(-30.0, 30.0, 5)
    read = []
    for plan in ("demo", plan_id):
        result = replace(result_of(sayable(name)), plan_id=plan, input={"file": plan})
        made = export(name, result, wiring, "out.txt", command=plan)
        read.append(loaded(name, sources_of(made), wiring)(at, at[::-1]))
    np.testing.assert_array_equal(*read)


@pytest.mark.parametrize("name", FORMATS)
def test_a_map_with_holes_is_refused(name):
    with pytest.raises(
        InputError, match="1 sites are unknown, and a table has no holes"
    ):
        export(
            name,
            result_of(random_map(PLATE, 1, unknown=((0, 0),))),
            wiring_of(FRAMES[0], name),
            "out.txt",
        )


@pytest.mark.parametrize("frame", [FRAMES[0], FRAMES[2], FRAMES[5]])
@pytest.mark.parametrize("name", FORMATS)
def test_a_table_replaces_the_one_that_was_active(name, frame):
    """The stage has the error G0; calibrated with a table loaded it shows another, small map."""
    raw, wiring = sayable(name, 1, gain=20.0), wiring_of(frame, name)
    rough = replace(raw, gx=0.7 * raw.gx[::-1], gy=0.7 * raw.gy)
    old = export_of(name, rough, wiring)
    x, y = np.stack([PLATE.x_m, PLATE.y_m])
    # the encoder where the marks are met
    ex, ey = frame.to_machine(x + raw.gx, y + raw.gy)
    px, py = ex, ey
    for _ in range(100):
        cx, cy = old(px, py)
        px, py = ex - cx, ey - cy
    shown = frame.from_machine(px, py)
    seen = replace(raw, gx=shown[0] - x, gy=shown[1] - y)
    made = export(name, result_of(seen), wiring, "out.txt", active=old)
    cx, cy = loaded(name, sources_of(made), wiring)(*frame.to_machine(x, y))
    px, py = frame.to_machine(x, y)
    reached = Compensator(raw).correct(*frame.from_machine(px + cx, py + cy))
    off = np.subtract(reached, (x, y))
    off -= off.mean(axis=(1, 2), keepdims=True)
    # PMAC's zero moves everything by microns, and with it the error by its slope
    assert np.abs(off).max() < {"pmac": 3e-8, "linuxcnc": 1e-8, "siemens": 2e-9}.get(
        name, 1e-10
    )
    assert (
        np.abs(made.residuals[0].after).max()
        < 3e-8
        < 1e-7
        < made.residuals[0].rms("before")
    )
    assert "replaces the table" in next(iter(made.files.values()))
    # what the machine has now, not without the old table
    g = np.stack([seen.gx, seen.gy])
    g = g - g.mean(axis=(1, 2), keepdims=True)
    assert made.residuals[0].rms("before") == pytest.approx(
        np.sqrt((g**2).sum(0).mean()), rel=0.01
    )


@pytest.mark.parametrize("frame", [FRAMES[0], FRAMES[5]])
def test_what_an_active_table_bends_between_the_nodes_is_said(frame):
    """Cells half as long in y, and 2 um in every second row: only nodes of the map can be true."""
    emap, wiring = sayable("kmotion"), wiring_of(frame, "kmotion")
    x, y = frame.to_machine(PLATE.x_m[:, 0], PLATE.y_m[0])
    y = np.linspace(y[0], y[-1], 2 * len(y) - 1)
    bump = np.where(np.arange(len(y)) % 2, 2e-6 / frame.unit_m, 0.0)
    active = Grid(
        (x[0], y[0]), (x[1] - x[0], y[1] - y[0]), np.tile(bump, (len(x), 1)), "hold"
    )
    for also, bent in ((0.0, 2e-6), (5e-6, 2e-6)):  # a slope is no bend
        made = export(
            "kmotion",
            result_of(emap),
            wiring,
            "out.txt",
            active=lambda px, py, s=also: (active.at(px, py) + s * px, 0 * px),
        )
        assert made.bent_m == pytest.approx(bent, rel=1e-6)
        assert made.residuals[0].largest("after") < rounding("kmotion", frame) * 2
        assert (
            "bends between the nodes of the map, up to 2 um, is lost"
            in made.files["out.txt"]
        )
    assert (
        export(
            "kmotion",
            result_of(emap),
            wiring,
            "o",
            active=export_of("kmotion", emap, wiring),
        ).bent_m
        < 1e-10
    )


def export_of(name, emap, wiring):
    form = FORMATS[name]
    return form.read(
        [
            Source("\n".join(lines), part)
            for part, lines in form.write(emap, wiring).items()
        ],
        wiring,
    )
