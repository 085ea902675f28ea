# SPDX-License-Identifier: Apache-2.0
"""``selfcal cell try``: what a few moves tell of camera and stage, and what is written of it."""

import io
import json
import math
import re

import numpy as np
import pytest
from PIL import Image as Pillow

from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.files import read_yaml
from selfcal_ros.machine import MachineError
from selfcal_ros.machine.cell import read_cell
from selfcal_ros.machine.trying import Trial
from selfcal_ros.vision.drawing import COLOUR, REJECTED
from test.support.cells import CELL, Jumping, write_cell
from test.support.faults import Spoilt

PLATE = (
    "plan: {plan_id: c, artifact: {grid_size: 3, grid_pitch: 0.001, angular_count: 0}, "
    "views: [{name: a}]}\nseed: 3\ntruth: {g: 2.0e-7, a: 2.0e-7, t: 5.0e-6, phi: 1.0e-3}\n"
)
CAMERA = (
    "camera: {width: 220, height: 200, pixel_size: 2.0e-6, mark_size: 50.0e-6, MORE}\n"
)
MARKS = "detector: {mark: disc, mark_size: 50.0e-6}\n"


def write(
    folder, more="turn: 3.0", *, physics="", cell=MARKS, sense="microscope_moves"
):
    return write_cell(
        folder,
        cell=f"{CELL}{cell}sense: {sense}\n",
        simulation=f"{PLATE}physics: {{{physics}}}\ncell: {{sense: {sense}}}\n"
        f"{CAMERA.replace('MORE', more)}",
    )


@pytest.mark.parametrize("sense", ["microscope_moves", "plate_moves"])
@pytest.mark.parametrize(
    ("turn", "mirror"), [(3.0, False), (-140.0, False), (75.0, True)]
)
def test_camera_and_backlash_are_found_within_their_uncertainty(
    tmp_path, turn, mirror, sense
):
    cell, machine = write(
        tmp_path,
        f"turn: {turn}, mirror: {str(mirror).lower()}",
        physics="backlash_x: 2.5e-6",
        sense=sense,
    )
    trial = Trial(cell, machine, Jumping())
    _, marks = trial.look()
    assert len(marks) == 1
    assert trial.mark_pixels == pytest.approx(25, rel=0.05)
    found = trial.move()
    camera = found.camera
    assert camera.mirror is mirror
    local_scale = 4e-4  # of the stage: errors of 0.2 um from mark to mark, 1 mm
    assert (
        abs(camera.pixel_size_m / 2e-6 - 1)
        < local_scale + 5 * camera.u_pixel_size_m / 2e-6
    )
    assert camera.u_pixel_size_m < 1e-9
    away = math.remainder(camera.turn_rad - math.radians(turn), math.tau)
    assert abs(away) < local_scale + 5 * camera.u_turn_rad < 0.05
    # indicated - true is 2.5 um after a motion in + direction, -2.5 um after one in -
    assert abs(found.reversal["x"].value - 5e-6) < max(5 * found.reversal["x"].u, 2e-8)
    assert abs(found.reversal["y"].value) < max(5 * found.reversal["y"].u, 2e-8)
    notes = " ".join(found.notes)
    assert ("the image is mirrored" in notes) is mirror
    assert "x has a backlash: approach" in notes
    assert "y has a backlash" not in notes
    # after it stands where it stood
    assert np.abs(machine.position()[:2]).max() < 1e-6


def test_a_stage_that_creeps_after_a_move(tmp_path):
    cell, machine = write(tmp_path, physics="settling: 3.0e-6, settling_time: 0.02")
    trial = Trial(cell, machine, Jumping())
    trial.look()
    assert trial.move().settling_s > 0


def test_what_is_found_is_written_and_the_plan_is_measured_with_it(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write(tmp_path)
    assert main(["cell", "try", "cell.yaml", "--yes", "--json"]) == 0
    out, err = capsys.readouterr()
    said = json.loads(out)
    assert "cell.seen.png: 1 mark of" in err
    with Pillow.open("cell.seen.png") as picture:
        assert picture.size == (220, 200)
        assert (np.asarray(picture) == COLOUR).all(axis=2).sum() > 50
    data = read_yaml("cell.yaml")
    assert (
        data["detector"]["pixel_size"]
        == said["pixel_size"]
        == pytest.approx(2e-6, rel=0.01)
    )
    assert data["found"]["backlash_x"].keys() == {"value", "u"}
    assert read_cell("cell.yaml").detector.turn == pytest.approx(3.0, abs=0.5)


def test_nothing_moves_or_is_written_without_a_yes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path)
    before = (tmp_path / "cell.yaml").read_text()
    answers = io.StringIO("n\n")
    answers.isatty = lambda: True
    monkeypatch.setattr("sys.stdin", answers)
    assert main(["cell", "try", "cell.yaml"]) == 0
    assert "nothing was moved or written" in capsys.readouterr().out
    assert (tmp_path / "cell.yaml").read_text() == before
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert main(["cell", "try", "cell.yaml"]) == 2
    assert "there is nobody to ask" in capsys.readouterr().err


def test_without_a_mark_the_picture_shows_what_is_seen(tmp_path, monkeypatch, capsys):
    """Not found is a mark of the other polarity: the line says what is there."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path, cell=MARKS.replace("}", ", polarity: bright}"))
    assert main(["cell", "try", "cell.yaml", "--yes"]) == 4
    out, err = capsys.readouterr()
    assert "cell.seen.png: what is seen" in out
    assert re.search(
        r"no mark is found in the image; what repeats is 2\d\S* px, dark", err
    )
    with Pillow.open("cell.seen.png") as picture:
        assert picture.size == (220, 200)


def test_the_picture_shows_what_was_rejected_and_the_line_why(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write(tmp_path)
    assert main(["cell", "try", "cell.yaml", "--yes", "--mark-pixels", "18"]) == 4
    assert "no mark is found in the image; rejected: 1 wrong_size; what repeats" in (
        capsys.readouterr().err
    )
    with Pillow.open("cell.seen.png") as picture:
        assert (np.asarray(picture) == REJECTED).all(axis=2).sum() > 50


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--mark-pixels", "3"], "--mark-pixels: 3 is not a size of a mark in pixels"),
        (["-o", "cell.yaml"], "cell.yaml: would be overwritten"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_moves(
    tmp_path, monkeypatch, capsys, options, said
):
    monkeypatch.chdir(tmp_path)
    write(tmp_path)
    before = (tmp_path / "cell.yaml").read_text()
    assert main(["cell", "try", "cell.yaml", "--yes", *options]) == 2
    assert said in capsys.readouterr().err
    assert (tmp_path / "cell.yaml").read_text() == before


def test_a_machine_without_a_camera_needs_no_size_in_pixels(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_cell(tmp_path)
    assert main(["cell", "try", "cell.yaml", "--yes", "--mark-pixels", "20"]) == 0


def test_marks_in_another_unit_move_nothing(tmp_path, monkeypatch, capsys):
    """The first moves are by the size of a mark, here 50 for 50e-6."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path, cell="detector: {mark: disc, mark_size: 50.0e-3}\n")
    before = (tmp_path / "cell.yaml").read_text()
    assert main(["cell", "try", "cell.yaml", "--yes"]) == 2
    assert "or mark_size: first moves are as long as a mark" in capsys.readouterr().err
    assert (tmp_path / "cell.yaml").read_text() == before


@pytest.mark.parametrize(
    ("fault", "error", "said"),
    [
        ("late by one frame", MachineError, "the image is late by one frame"),
        ("stands still", MachineError, "nothing moved"),
        ("position in mm", MachineError, "is it mm for m?"),
        ("x is reversed", MachineError, "x is reversed"),
        ("x and y are exchanged", MachineError, "the axes are exchanged"),
        ("last image again", MachineError, "returns the last image again"),
    ],
)
def test_what_is_wrong_is_named_and_the_stage_stopped(tmp_path, fault, error, said):
    cell, machine = write(tmp_path)
    spoilt = Spoilt(machine, fault, after=5 if "image" in fault else 0)
    trial = Trial(cell, spoilt, Jumping())
    trial.look()
    with pytest.raises(error, match=said):
        trial.move()
    assert spoilt.stops


def test_marks_of_another_size_than_stated_are_refused(tmp_path):
    cell, machine = write(tmp_path, cell="detector: {mark: disc, mark_size: 80.0e-6}\n")
    trial = Trial(cell, machine, Jumping())
    trial.look()
    with pytest.raises(InputError, match="by the moves of the stage a pixel has 2 µm"):
        trial.move()


def test_an_image_without_a_mark(tmp_path):
    cell, machine = write(tmp_path)
    machine.move_to((5e-4, 5e-4, 0.0))
    with pytest.raises((NoDataError, MachineError), match=r"no mark is found|blank"):
        Trial(cell, machine, Jumping()).look()
