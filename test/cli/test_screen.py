# SPDX-License-Identifier: Apache-2.0
"""The screen of `selfcal up` and `monitor`: what it says for what the cell says."""

import io
import math
import re

import pytest
from rich.cells import cell_len
from rich.console import Console

from selfcal_ros.cli.screen import screen, what_now

EMPTY = {
    "health": {"pose_sequencer": None, "solver": None},
    "command": None,
    "view": None,
    "summary": None,
    "map": None,
}
COMMAND = {
    "phase": "PLACE",
    "plan_id": "hu",
    "run_id": "17",
    "view_index": 1,
    "view_name": "rot90",
    "views_planned": 4,
    "rotation_deg": 90.0,
    "translation_mm": [10.0, -20.0],
}


def told(state: str, message: str = "", level: int = 0, **values: str) -> dict:
    return {
        "level": level,
        "message": message or state,
        "values": {"state": state} | values,
    }


TURN = "90° ↺ counter-clockwise (the corner at the top right goes to the top left)"


def shown(picture: dict, log: tuple = (), size: tuple[int, int] = (140, 40)) -> str:
    console = Console(
        file=io.StringIO(), width=size[0], height=size[1], legacy_windows=False
    )
    console.print(screen(picture, list(log), size), end="")
    return console.file.getvalue()


@pytest.mark.parametrize(
    "sequencer, sentence",
    [
        (None, "pose_sequencer is not running: start it, or wait for it."),
        (told("IDLE"), "Press s to start the plan."),
        (
            told("IDLE", "waiting for solver (no sign of life)", 1),
            "Nothing to do: waiting for solver (no sign of life).",
        ),
        (
            told("PLACING", view_name="rot90"),
            f"Place the plate for view 'rot90' turned by {TURN}, at x 10 mm, y -20 "
            "mm; then press c.",
        ),
        (told("MEASURING"), "Nothing to do: the view is being measured."),
        (told("MEASURING", "view 'rot90' stalls", 1), "Look: view 'rot90' stalls."),
        (
            told("PLACING", "no sign of life from solver", 1),
            f"Place the plate for view 'rot90' turned by {TURN}, at x 10 mm, y -20 "
            "mm; then press c. Look: no sign of life from solver.",
        ),
        (told("DONE"), "Done. s starts another run."),
        (told("ABORTED"), "Aborted. s starts a new run."),
        (
            told("FOLLOWING"),
            "Nothing to do: another sequencer is in command; a ends that.",
        ),
    ],
)
def test_what_a_person_has_to_do(sequencer, sentence):
    assert (
        what_now(EMPTY | {"health": {"pose_sequencer": sequencer}, "command": COMMAND})
        == sentence
    )


@pytest.mark.parametrize(
    "phase, sentence",
    [
        (
            "PLACE",
            f"Place the plate for view 'rot90' turned by {TURN}, at x 10 mm, y -20 mm; then "
            "press c.",
        ),
        ("MEASURE", "Nothing to do: the view is being measured."),
        ("DONE", "Done. s starts another run."),
        ("ABORT", "Aborted. s starts a new run."),
    ],
)
@pytest.mark.parametrize("state", ["PLACING", "MEASURING"])
def test_the_newest_command_is_earlier_than_the_health(state, phase, sentence):
    health = {"pose_sequencer": told(state, plan_id="hu", view_name="identity")}
    assert (
        what_now(EMPTY | {"health": health, "command": COMMAND | {"phase": phase}})
        == sentence
    )


def test_an_empty_cell_is_shown_as_such():
    text = shown(EMPTY)
    for words in (
        "no view yet",
        "nothing measured yet",
        "no view has been solved yet",
        "no map yet",
        "solver: no sign of life",
        "[c] confirm",
    ):
        assert words in text


def test_coverage_rejections_map_verdict_and_health_are_shown():
    text = shown(
        {
            "health": {
                "pose_sequencer": told(
                    "MEASURING", views="4", plan_id="hu", run_id="17"
                ),
                "solver": told("", "readings cannot be used", 1),
            },
            "command": COMMAND,
            "view": {
                "view_name": "rot90",
                "complete": False,
                "grid": [7, 9],
                "angular": [3, 8],
                "checks": [2, 5],
                "used": 20,
                "rejected": {"stage_moving": 3, "duplicate": 12},
                "repeatability_um": 0.0213,
                "repeatability_arcsec": None,
                "plate": ["oo.", "o.o", "ooo"],
                "missing_lines": [0, 2, 4, 5, 7],
            },
            "summary": {
                "state": "Calibrated.",
                "views": [2, 4],
                "identifiable": True,
                "qualified": False,
                "enlarged": False,
                "max_error_um": 0.84,
                "rms_uncertainty_um": None,
                "advice": ["add a view"],
                "causes": ["the plate slipped"],
                "run_id": "17",
            },
            "map": {
                "run_id": "17",
                "qualified": False,
                "um": [[0.0, 1.0], [None, 0.5]],
            },
        },
        ["first", "escape \x1b[2J"],
    )
    for words in (
        "view 2 of 4: rot90",
        "plan hu, run 17",
        "marks 7 of 9, lines 3 of 8",
        "marks with check stops 2 of 5",
        "repeatability 0.0213 µm, -",
        "o o .",
        "missing lines 0, 2, 4, 5, 7",
        "12  duplicate",
        "not qualified",
        "the plate slipped",
        "add a view",
        "'@' = 1 µm",
        "solver: warn readings cannot be used",
        "first",
    ):
        assert words in text
    rows = [row for row in text.splitlines() if "? +" in row or "  @" in row]
    assert len(rows) == 2  # the known sites by size, the unknown one as a question mark
    assert text.index("12  duplicate") < text.index("3  stage_moving")
    assert "\x1b[2J" not in text
    assert "escape \\x1b[2J" in text


MEASURED = {
    "health": {
        "pose_sequencer": told("MEASURING", views="4", plan_id="hu", run_id="17"),
        "solver": told("", saved="/results/hu_17.json"),
        "measurement_collector": told("", "view 'rot90': 35 % of the readings taken"),
    },
    "command": COMMAND | {"phase": "MEASURE"},
    "view": {
        "view_name": "rot90",
        "complete": False,
        "grid": [430, 441],
        "angular": [3, 8],
        "checks": [0, 0],
        "used": 20,
        "rejected": {"stage_moving": 3},
        "repeatability_um": 0.0213,
        "repeatability_arcsec": 0.5,
        "plate": ["o" * 20 + "."] + ["o" * 21] * 20,
        "plate_step": 1,
        "missing_lines": [0, 2, 4, 5, 7],
    },
    "summary": {
        "state": "Calibrated from 4 views: largest error 0.713 µm at x 30 mm, y 50 mm, "
        "every site known to ±0.0483 µm, any place to ±0.0502 µm or better (k=2.01).",
        "views": [4, 4],
        "identifiable": True,
        "qualified": True,
        "enlarged": False,
        "max_error_um": 0.713,
        "rms_uncertainty_um": 0.0176,
        "advice": [],
        "causes": [],
        "run_id": "17",
    },
    "map": {
        "run_id": "17",
        "qualified": True,
        "step": 1,
        "um": [[0.713] + [0.1] * 20] + [[0.1] * 21] * 20,
    },
}
BAD = {
    "health": {
        f"node_{n}": told("", f"something is wrong with it, {n}, and at length " * 3, 1)
        for n in range(6)
    }
    | {"pose_sequencer": None},
    "view": MEASURED["view"]
    | {
        "rejected": {f"reason_{n}": n + 1 for n in range(12)},
        "missing_lines": list(range(100)),
        "view_name": "v" * 300,
    },
    "summary": MEASURED["summary"]
    | {
        "qualified": False,
        "causes": [
            f"cause {n}: the plate slipped within the view, measure it again"
            for n in range(9)
        ],
    },
}
LOG = [
    "[WARN] [1795306660.671861903] [solver]: a long line of a node "
    + "that goes on " * 9,
    "[INFO] [1795306661.000000001] [pose_sequencer]: PLACE rot90",
    "confirm: measuring",
]


@pytest.mark.parametrize(
    "size",
    [(80, 24), (120, 40), (60, 18), (200, 70), (81, 25), (20, 5), (80, 10), (1, 1)],
)
@pytest.mark.parametrize(
    "picture", [EMPTY, MEASURED, MEASURED | BAD], ids=["empty", "good", "bad"]
)
def test_the_screen_fits_whatever_the_size(picture, size):
    rows = shown(picture, LOG, size).splitlines()
    assert len(rows) <= size[1]
    assert max(map(cell_len, rows)) <= size[0]
    assert rows[-1].startswith("[s] start  [c] confirm"[: size[0] - 1])


@pytest.mark.parametrize("size", [(80, 24), (120, 40)])
def test_all_of_a_good_view_is_on_the_screen(size):
    rows = shown(MEASURED, LOG, size).splitlines()
    text = " ".join(" ".join(rows).split())
    assert len(rows) == size[1]
    for words in (
        "view 2 of 4: rot90 plan hu, run 17",
        "Nothing to do: the view is being measured.",
        "The map is saved as /results/hu_17.json",
        "marks 430 of 441, lines 3 of 8",
        "repeatability 0.0213 µm, 0.5 arcsec",
        "missing lines 0, 2, 4, 5, 7",
        "rejected by reason; 20 used",
        "3 stage_moving",
        "good; views 4 of 4",
        "every",
        "ok: pose_sequencer, solver, measurement_collector",
        "pose_sequencer: PLACE rot90",
        "confirm: measuring",
        "[s] start [c] confirm [r] redo [k] skip [a] abort [q] quit",
    ):
        assert words in text
    assert "more row" not in text
    assert "…" not in text
    signs = re.search(r"each cell: (\d+) x \d+ marks", text)
    side = math.ceil(21 / int(signs[1]))
    plate = [row for row in rows if re.match(r"o( o)+( \.)?( |$)", row)]
    assert len(plate) == side
    assert plate[0][: 2 * side].rstrip().endswith("o .")  # the missing mark, top right
    assert not any("." in row[: 2 * side] for row in plate[1:])
    assert sum("@" in row for row in rows) == 2  # the title, and the largest error


@pytest.mark.parametrize("size", [(80, 24), (120, 40)])
def test_what_there_is_no_room_for_is_counted(size):
    picture = MEASURED | BAD
    rows = shown(picture, LOG, size).splitlines()
    text = "\n".join(rows)
    for title in (
        "coverage of vvv",
        "rejected by reason; 20 used",
        "map and verdict",
        "nodes",
    ):
        assert title in text
    counted = [int(n) for n in re.findall(r"\.\.\. (\d+) more row", text)]
    assert len(counted) >= 3
    reasons = [row for row in rows if "reason_" in row]
    assert f"{12 - len(reasons)} more row" in text
    assert "reason_11" in reasons[0]  # the most frequent first
    assert "missing lines 0, 1, 2" in text and "and 90 more" in text
    assert "pose_sequencer is not running" in text


def test_a_small_terminal_says_what_is_to_be_done_and_asks_for_more_room():
    text = " ".join(shown(MEASURED, LOG, (59, 18)).split())
    assert "Nothing to do: the view is being measured." in text
    assert "Make this terminal larger: 60 x 18." in text


@pytest.mark.parametrize(
    "phase, run, sentence",
    [
        ("PLACE", "17", "view 2 of 4: rot90"),
        ("DONE", "17", "1 of 4 views done"),
        ("ABORT", "17", "aborted in view 2 of 4: rot90"),
        ("PLACE", "18", "views 4 of 4; an earlier run"),
    ],
)
def test_what_is_over_and_what_is_of_an_earlier_run_is_said(phase, run, sentence):
    text = shown(MEASURED | {"command": COMMAND | {"phase": phase, "run_id": run}})
    assert sentence in text
    assert ("an earlier run" in text) is (run == "18")


def test_lines_of_nodes_are_shown_without_the_time():
    text = shown(EMPTY, LOG)
    assert "WARN solver: a long line of a node that goes on" in text
    assert "\npose_sequencer: PLACE rot90\n" in text
    assert "1795306" not in text


@pytest.mark.parametrize(
    "views, sentence",
    [
        ("4", "view 2 of 4: rot90"),
        ("-1", "view 2 of 3: rot90"),
        ("9" * 5000, "view 2 of 3: rot90"),
        ("\u00b2", "view 2 of 3: rot90"),
    ],
)
def test_a_number_of_views_that_is_none_is_not_shown(views, sentence):
    picture = EMPTY | {
        "health": {"pose_sequencer": told("MEASURING", views=views)},
        "command": COMMAND | {"views_planned": 3},
    }
    assert sentence in shown(picture)


@pytest.mark.parametrize(
    ("turn", "said"),
    [
        (0.0, "turned by 0°, at"),
        (
            180.0,
            "↺ counter-clockwise (the corner at the top right goes to the bottom left), at",
        ),
        (
            270.0,
            "↺ counter-clockwise (the corner at the top right goes to the bottom right), at",
        ),
        (
            -90.0,
            "↻ clockwise (the corner at the top right goes to the bottom right), at",
        ),
        (15.0, "turned by 15° counter-clockwise, at"),
    ],
)
def test_the_sense_of_a_turn_and_its_corner_are_said(turn, said):
    assert said in what_now(
        EMPTY
        | {
            "health": {"pose_sequencer": told("PLACING")},
            "command": COMMAND | {"rotation_deg": turn},
        }
    )
