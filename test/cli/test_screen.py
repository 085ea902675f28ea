# SPDX-License-Identifier: Apache-2.0
"""The screen of `selfcal up` and `monitor`: what it says for what the cell says."""

import io

import pytest
from rich.console import Console

from selfcal_ros.cli.screen import screen, what_now

EMPTY = {"health": {"pose_sequencer": None, "solver": None}, "command": None, "view": None,
         "summary": None, "map": None}
COMMAND = {"phase": "PLACE", "plan_id": "hu", "run_id": "17", "view_index": 1,
           "view_name": "rot90", "views_planned": 4, "rotation_deg": 90.0,
           "translation_mm": [10.0, -20.0]}


def told(state: str, message: str = "", level: int = 0, **values: str) -> dict:
    return {"level": level, "message": message or state, "values": {"state": state} | values}


def shown(picture: dict, log: tuple = ()) -> str:
    console = Console(file=io.StringIO(), width=140, legacy_windows=False)
    console.print(screen(picture, list(log)))
    return console.file.getvalue()


@pytest.mark.parametrize("sequencer, sentence", [
    (None, "pose_sequencer is not there: start it, or wait for it."),
    (told("IDLE"), "Press s to start the plan."),
    (told("IDLE", "waiting for solver (no sign of life)", 1),
     "Nothing: waiting for solver (no sign of life)."),
    (told("PLACING", view_name="rot90"), "Place the plate for view 'rot90' turned by 90 deg, at x "
                                         "10 mm, y -20 mm; then press c."),
    (told("MEASURING"), "Nothing: the view is being measured."),
    (told("MEASURING", "view 'rot90' stalls", 1), "Look: view 'rot90' stalls."),
    (told("PLACING", "no sign of life of solver", 1),
     "Place the plate for view 'rot90' turned by 90 deg, at x 10 mm, y -20 mm; then press c. "
     "Look: no sign of life of solver."),
    (told("DONE"), "Done. s starts another run."),
    (told("ABORTED"), "Aborted. s starts a new run."),
    (told("FOLLOWING"), "Nothing: somebody else commands; a ends that.")])
def test_what_a_person_has_to_do(sequencer, sentence):
    assert what_now(EMPTY | {"health": {"pose_sequencer": sequencer},
                             "command": COMMAND}) == sentence


@pytest.mark.parametrize("phase, sentence", [
    ("PLACE", "Place the plate for view 'rot90' turned by 90 deg, at x 10 mm, y -20 mm; then press "
              "c."),
    ("MEASURE", "Nothing: the view is being measured."), ("DONE", "Done. s starts another run."),
    ("ABORT", "Aborted. s starts a new run.")])
@pytest.mark.parametrize("state", ["PLACING", "MEASURING"])
def test_the_newest_command_is_earlier_than_the_health(state, phase, sentence):
    health = {"pose_sequencer": told(state, plan_id="hu", view_name="identity")}
    assert what_now(EMPTY | {"health": health, "command": COMMAND | {"phase": phase}}) == sentence


def test_an_empty_cell_is_shown_as_such():
    text = shown(EMPTY)
    for words in ("no view yet", "nothing measured yet", "no view has been solved yet",
                  "no map yet", "solver: gone", "[c] confirm"):
        assert words in text


def test_coverage_rejections_map_verdict_and_health_are_shown():
    text = shown({
        "health": {"pose_sequencer": told("MEASURING", views="4", plan_id="hu", run_id="17"),
                   "solver": told("", "readings cannot be used", 1)},
        "command": COMMAND,
        "view": {"view_name": "rot90", "complete": False, "grid": [7, 9], "angular": [3, 8],
                 "used": 20, "rejected": {"stage_moving": 3, "duplicate": 12},
                 "repeatability_um": 0.0213, "repeatability_arcsec": None,
                 "plate": ["oo.", "o.o", "ooo"], "missing_lines": [0, 2, 4, 5, 7]},
        "summary": {"state": "Calibrated.", "views": [2, 4], "identifiable": True,
                    "qualified": False, "max_error_um": 0.84, "rms_uncertainty_um": None,
                    "advice": ["add a view"], "causes": ["the plate slipped"], "run_id": "17"},
        "map": {"run_id": "17", "qualified": False, "um": [[0.0, 1.0], [None, 0.5]]}},
        ["first", "escape \x1b[2J"])
    for words in ("view 2 of 4: rot90", "plan hu, run 17", "marks 7 of 9, lines 3 of 8",
                  "repeatability 0.0213 um, -", "o o .", "missing lines 0, 2, 4, 5, 7",
                  "12  duplicate", "not qualified", "the plate slipped", "add a view",
                  "'@' = 1 um", "solver: warn readings cannot be used", "first"):
        assert words in text
    rows = [row for row in text.splitlines() if "? +" in row or "  @" in row]
    assert len(rows) == 2  # the known sites by size, the unknown one as a question mark
    assert text.index("12  duplicate") < text.index("3  stage_moving")
    assert "\x1b[2J" not in text
    assert "escape \\x1b[2J" in text


@pytest.mark.parametrize("views, sentence", [
    ("4", "view 2 of 4: rot90"), ("-1", "view 2 of 3: rot90"), ("9" * 5000, "view 2 of 3: rot90"),
    ("\u00b2", "view 2 of 3: rot90")])
def test_a_number_of_views_that_is_none_is_not_shown(views, sentence):
    picture = EMPTY | {"health": {"pose_sequencer": told("MEASURING", views=views)},
                       "command": COMMAND | {"views_planned": 3}}
    assert sentence in shown(picture)
