# SPDX-License-Identifier: Apache-2.0
"""Commands that no cell can follow are refused before anything is made of their numbers."""

from dataclasses import replace

import pytest

from selfcal_ros.collection.inputs import Command, Phase, Reason, check_command
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.support.collecting import collect, gathered, scene, table

ODD = [
    (
        {"translation_m": (1e17, 0.0)},
        {},
        "view '0' translation: 1e+19 pitches are beyond every field; is it in mm? "
        "give the translation in metres",
    ),
    ({"translation_m": (0.0, -1e300)}, {}, "view '0' translation: -"),
    (
        {"grid": False, "angular": False},
        {},
        "view command 0: neither grid nor angular marks are requested; set one to true",
    ),
    (
        {"repeats": 2**32 - 1},
        {},
        "view command 0: 4294967295 repeats; ask for 1 to 1000000",
    ),
    ({"repeats": 0}, {}, "view command 0: 0 repeats; ask for 1 to 1000000"),
    (
        {},
        {"view_index": 2**31},
        "view command 2147483648: a plan has at most 1000 views; ",
    ),
    (
        {},
        {"views_planned": 2**32 - 1},
        "view command 0: a plan has at most 1000 views; correct",
    ),
    (
        {},
        {"view": None},
        "view command 0: it describes no view; fill in its pose and its plate",
    ),
]


@pytest.mark.parametrize(("of_view", "of_command", "message"), ODD)
def test_a_command_with_impossible_numbers_is_refused(of_view, of_command, message):
    cell = scene()
    collector = gathered(cell.events)
    measure = cell.commands[1]
    bad = replace(
        measure, stamp_ns=measure.stamp_ns + 1, view=replace(measure.view, **of_view)
    )
    with pytest.raises(InputError) as caught:
        collector.add_command(replace(bad, **of_command))
    assert str(caught.value).startswith(message)
    collector.refuse("command", Reason.COMMAND_BAD)
    found, _ = collector.collect()
    assert found.all_rejected() == {"command_unusable": 1}
    assert table(found.views[0]) == table(collect(cell.events)[0].views[0])


def test_limits_themselves_are_kept():
    cell = scene(count=0)
    measure = cell.commands[1]
    collector = gathered([])
    collector.add_command(
        replace(
            measure,
            view_index=1000,
            views_planned=1000,
            view=replace(measure.view, repeats=1_000_000),
        )
    )
    collector.add_command(Command(0, Phase.ABORT, "p", 1000))
    collector.add_command(
        replace(measure, view=replace(measure.view, translation_m=(1000.0, 0.0)))
    )
    assert collector.received["command"] == 3


def test_a_plate_of_401_marks_a_side_of_which_25_were_read():
    cell = scene(count=0)
    wide = [
        replace(c, artifact=Artifact(401, 0.01)) if c.artifact else c
        for c in cell.commands
    ]
    _, progress = collect([*wide, *cell.samples, *cell.detections])
    assert (progress[0].grid_expected, progress[0].grid_done) == (401**2, 25)
    assert (progress[0].missing.m[0], progress[0].missing.n[199]) == (-200, -1)


@pytest.mark.parametrize("field", ["sigma", "score"])
def test_minus_zero_is_zero(field):
    cell = scene(repeats=2)
    for index in range(len(cell.detections)):
        cell.spoil(index, **{field: 0.0})
    want, _ = collect(cell.events)
    for index in range(0, len(cell.detections), 3):
        cell.spoil(index, **{field: -0.0})
    cell.detections.append(replace(cell.detections[0], **{field: 0.0}))
    found, _ = collect(cell.events)
    assert found.all_rejected() == {"duplicate": 1}
    assert found.views[0].u.tobytes() == want.views[0].u.tobytes()
    assert table(found.views[0]) == table(want.views[0])


@pytest.mark.parametrize(
    ("run_id", "good"),
    [
        ("", True),
        ("x", True),
        ("50", True),
        ("49", True),
        ("51", False),
        ("9" * 20, False),
        ("9" * 21, True),
    ],
)
def test_a_run_does_not_begin_after_its_own_command(run_id, good):
    ends = Command(50, Phase.DONE, "p", run_id=run_id)
    if good:
        check_command(ends)
    else:
        with pytest.raises(
            InputError, match="begins after its own stamp; let run_id be the stamp"
        ):
            check_command(ends)
