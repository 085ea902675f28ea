# SPDX-License-Identifier: Apache-2.0
"""A plan measured without ROS: the map, the bag, faults, and what is left after them."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.machine import MachineError
from selfcal_ros.machine.cell import open_machine
from selfcal_ros.machine.measuring import Run, collector_settings
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.settings.nodes import CollectorSettings
from test.support.cells import CELL, PLAN, SIMULATION, Agreeing, Jumping, write_cell
from test.support.faults import Spoilt


def run_of(folder, machine, cell, clock=None, desk=None) -> Run:
    return Run(
        read_plan(folder / "plan.yaml"),
        cell,
        machine,
        folder / "bag",
        desk or Agreeing(),
        clock or Jumping(),
    )


def away_from(truth, bag, settings=None) -> tuple[np.ndarray, object]:
    """Return found minus true map after removal of the datum, (2 n,), and the result."""
    measurements = collect_bag(bag, settings or CollectorSettings()).measurements
    result = calibrate(measurements)
    sites = result.error_map.artifact.field
    x, y = sites.x_m.ravel(), sites.y_m.ravel()
    one, zero = np.ones_like(x), np.zeros_like(x)
    columns = np.array([[*one, *zero], [*zero, *one], [*-y, *x], [*x, *y]]).T
    away = np.concatenate(
        [
            result.error_map.gx.ravel() - truth.g[0].ravel(),
            result.error_map.gy.ravel() - truth.g[1].ravel(),
        ]
    )
    return away - columns @ np.linalg.lstsq(columns, away, rcond=None)[0], result


@pytest.mark.parametrize("camera", [False, True])
@pytest.mark.parametrize("sense", ["microscope_moves", "plate_moves"])
def test_the_map_is_right_within_its_uncertainty(tmp_path, camera, sense):
    cell, machine = write_cell(
        tmp_path,
        camera=camera,
        cell=f"{CELL}sense: {sense}\norigin: {{x: 0.0005}}\n",
        simulation=f"{SIMULATION}cell: {{sense: {sense}}}\n",
    )
    machine._position[0] = 0.0005

    class Shifted(Spoilt):
        """The origin of its axes is not the centre of the field."""

        def position(self):
            x, *others = super().position()
            return (x + 0.0005, *others)

        def move_to(self, position):
            super().move_to((position[0] - 0.0005, *position[1:]))

    run_of(tmp_path, Shifted(machine), cell).measure()
    away, result = away_from(machine.truth, tmp_path / "bag", collector_settings(cell))
    u = np.concatenate([result.error_map.u_gx.ravel(), result.error_map.u_gy.ravel()])
    assert result.verdict.qualified
    assert np.abs(away).max() < 4 * u.max() < 1e-7
    assert np.abs(machine.truth.g).max() > 2e-7


def test_the_direction_of_fast_moves_is_known_with_an_encoder_that_is_noisy(tmp_path):
    cell, machine = write_cell(tmp_path)
    rng, clock = np.random.default_rng(1), Jumping()

    class Noisy(Spoilt):
        """A stage whose moves take no time, and its answers 20 ms."""

        def position(self):
            clock.sleep(0.02)
            return tuple(np.add(super().position(), rng.normal(0, 3e-9, 3)))

    run_of(tmp_path, Noisy(machine), cell, clock).measure()
    measured = collect_bag(tmp_path / "bag", CollectorSettings()).measurements
    unknown = [view.visits.approach_x == 0 for view in measured.views]
    assert not np.concatenate(unknown).any()


def test_nothing_moves_beyond_the_limits(tmp_path):
    cell, machine = write_cell(tmp_path, plan=PLAN.replace("0.001", "0.0101"))
    spoilt = Spoilt(machine)
    run = run_of(tmp_path, spoilt, cell)
    with pytest.raises(
        MachineError, match=r"view 'identity'.*beyond the limits -0.01 to 0.01"
    ):
        run.require()
    assert not spoilt.moves


def test_a_stage_that_stands_beyond_the_limits_moves_back_towards_them(tmp_path):
    cell, machine = write_cell(tmp_path)
    machine._position[:2] = -0.015, 0.012
    spoilt = Spoilt(machine)
    run_of(tmp_path, spoilt, cell).measure()
    x, y = np.array(spoilt.moves)[:2, :2].T
    assert (x[0], y[1]) == pytest.approx((-0.0149, 0.0119), abs=1e-6)
    beyond = np.abs(np.array(spoilt.moves)[2:, :2]).max()
    assert beyond < 0.01
    cell.require_limits("x", -0.012, "a move", start=-0.015)
    for value, start in ((-0.016, -0.015), (0.011, -0.015), (-0.011, 0.0)):
        with pytest.raises(MachineError, match="beyond the limits"):
            cell.require_limits("x", value, "a move", start=start)


@pytest.mark.parametrize(
    ("axis", "place_m"), [("x", (5e-3, 2e-6)), ("y", (2e-6, 5e-3))]
)
def test_a_stage_whose_position_is_in_mm_is_not_sent_thousands_of_them_back(
    tmp_path, axis, place_m
):
    """At 5 mm it says 5; to stay there, or to move to 4.9999, would end at its stop."""
    cell, machine = write_cell(tmp_path)
    machine._position[:2] = place_m
    spoilt = Spoilt(machine, "position in mm")
    with pytest.raises(
        MachineError, match=rf"at {axis} = 5\S* m, far beyond .*: is it in mm\?"
    ):
        run_of(tmp_path, spoilt, cell).measure()
    assert not spoilt.moves


def test_a_view_of_lines_needs_a_rotary_axis(tmp_path):
    cell, machine = write_cell(
        tmp_path, plan=PLAN.replace("angular_count: 0", "angular_count: 8")
    )
    spoilt = Spoilt(machine)
    spoilt.axes = ("x", "y")
    with pytest.raises(
        MachineError, match="the view moves theta, the machine has x and y"
    ):
        run_of(tmp_path, spoilt, cell).require()


def test_markers_of_another_plate_are_refused_before_anything_moves(tmp_path):
    cell, machine = write_cell(tmp_path, camera=True)
    cell = replace(cell, detector=replace(cell.detector, aruco="3x4"))
    with pytest.raises(
        InputError, match=r"cell.yaml: detector: aruco: '3x4', but .* has 3 x 3 marks"
    ):
        run_of(tmp_path, machine, cell).require()


def test_nothing_moves_while_the_plate_is_placed(tmp_path):
    cell, machine = write_cell(tmp_path, cell=CELL.replace("robot", "person"))
    spoilt = Spoilt(machine)
    moves_at = []

    class Placing(Agreeing):
        def place(self, command):
            moves_at.append(len(spoilt.moves))

        def may_move(self, text):
            moves_at.append(len(spoilt.moves))
            return False

    with pytest.raises(InputError, match="may not move"):
        run_of(tmp_path, spoilt, cell, desk=Placing()).measure()
    assert moves_at == [0, 0]
    assert not spoilt.moves


def test_a_plate_that_is_not_there_is_noticed_at_the_first_stops(tmp_path):
    cell, machine = write_cell(
        tmp_path, simulation=SIMULATION.replace("t: 5.0e-6", "t: 9.0e-4"), camera=True
    )
    spoilt = Spoilt(machine)
    with pytest.raises(NoDataError, match="nothing is seen at the first 5 stops"):
        run_of(tmp_path, spoilt, cell).measure()
    assert len(spoilt.moves) < 16


def test_a_mark_that_is_never_seen_is_named(tmp_path):
    cell, machine = write_cell(tmp_path)

    class Dirty(Spoilt):
        def offsets(self):
            return [seen for seen in super().offsets() if seen.mark != (1, -1)]

    with pytest.raises(
        NoDataError, match=r"mark \(1, -1\) are not read after 3 more visits"
    ) as error:
        run_of(tmp_path, Dirty(machine), cell).measure()
    assert "artifact: {marks: marks.csv}" in error.value.remedy


def test_marks_that_were_missed_are_visited_again(tmp_path):
    cell, machine = write_cell(tmp_path)

    class Forgetful(Spoilt):
        n_seen = 0

        def offsets(self):
            self.n_seen += 1
            return [] if self.n_seen % 5 == 0 else super().offsets()

    run_of(tmp_path, Forgetful(machine), cell).measure()
    counts = [
        view.count.min()
        for view in collect_bag(
            tmp_path / "bag", CollectorSettings()
        ).measurements.views
    ]
    assert min(counts) >= 2


def test_a_view_interrupted_before_its_first_reading_is_placed_again(tmp_path):
    """The robot of a new process has no plate yet, and no reading would show it."""
    cell, machine = write_cell(tmp_path)

    class Lost(Spoilt):
        placed = ()

        def place(self, placing):
            self.placed += (placing.view,)
            super().place(placing)

        def move_to(self, position):
            if self.placed == ("identity", "rot90"):
                raise MachineError("the power failed")
            super().move_to(position)

    with pytest.raises(MachineError, match="the power failed"):
        run_of(tmp_path, Lost(machine), cell).measure()
    again = Lost(open_machine(cell))
    run_of(tmp_path, again, cell, Jumping(Jumping().ns + 10**12)).measure(resume=True)
    assert again.placed == ("rot90", "shift")
    away, _ = away_from(machine.truth, tmp_path / "bag")
    assert np.abs(away).max() < 5e-8


@pytest.mark.parametrize("after", [18, 70])
def test_a_stage_that_lost_its_zero_has_the_view_measured_anew(tmp_path, after):
    """In the second view the first one has the former zero, which no reading shows."""
    cell, machine = write_cell(tmp_path)
    with pytest.raises(MachineError):
        run_of(
            tmp_path, Spoilt(machine, "connection lost in a move", after=after), cell
        ).measure()

    class Rehomed(Spoilt):
        """After the power cut its zero is 3 um beside the old one."""

        def position(self):
            x, *others = super().position()
            return (x + 3e-6, *others)

        def move_to(self, position):
            super().move_to((position[0] - 3e-6, *position[1:]))

    desk = Agreeing()
    run_of(
        tmp_path, Rehomed(machine), cell, Jumping(Jumping().ns + 10**12), desk
    ).measure(resume=True)
    [line] = [line for line in desk.lines if "its marks lie" in line]
    assert "measured anew" in line
    assert ("the views before have the former one" in line) == ("rot90" in line)
    assert ("rot90" in line) == (after == 70)
    readings = collect_bag(tmp_path / "bag", CollectorSettings()).measurements
    assert readings.views[0].rejected.get("superseded_by_redo", 0) > 0 or (
        readings.rejected.get("superseded_by_redo", 0) > 0
    )
    assert calibrate(readings).verdict.qualified


def test_a_plate_that_was_taken_away_has_the_view_measured_anew(tmp_path):
    """Another machine, as after its simulation was killed: its plate lies as for the first view."""
    cell, machine = write_cell(tmp_path)
    with pytest.raises(MachineError):
        run_of(
            tmp_path, Spoilt(machine, "connection lost in a move", after=100), cell
        ).measure()
    cell, machine = write_cell(tmp_path)
    desk = Agreeing()
    run_of(tmp_path, machine, cell, Jumping(Jumping().ns + 10**12), desk).measure(
        resume=True
    )
    assert [
        line for line in desk.lines if "none of its marks is seen where it was" in line
    ]
    assert calibrate(
        collect_bag(tmp_path / "bag", CollectorSettings()).measurements
    ).verdict.qualified


def test_a_bag_is_not_overwritten_and_not_continued_by_another_plan(tmp_path):
    cell, machine = write_cell(tmp_path)
    with pytest.raises(MachineError):
        run_of(
            tmp_path, Spoilt(machine, "connection lost in a move", after=12), cell
        ).measure()
    with pytest.raises(InputError, match="exists already; continue it with --resume"):
        run_of(tmp_path, machine, cell).measure()
    (tmp_path / "plan.yaml").write_text(PLAN.replace("repeats: 2", "repeats: 3"))
    with pytest.raises(InputError, match="of another plan"):
        run_of(tmp_path, machine, cell, Jumping(Jumping().ns + 10**12)).measure(
            resume=True
        )


def test_a_bag_that_is_complete_is_not_that_of_another_plan(tmp_path):
    cell, machine = write_cell(tmp_path)
    run_of(tmp_path, machine, cell).measure()
    desk = Agreeing()
    run_of(tmp_path, machine, cell, desk=desk).measure(resume=True)
    assert desk.lines[-1].endswith("measured already")
    for old, new in (
        ("rotation_deg: 90", "rotation_deg: 180"),
        ("grid_size: 3", "grid_size: 5"),
    ):
        assert old in PLAN
        (tmp_path / "plan.yaml").write_text(PLAN.replace(old, new))
        with pytest.raises(InputError, match="its run is of another plan"):
            run_of(tmp_path, machine, cell).measure(resume=True)


def test_what_is_not_there_is_not_continued(tmp_path):
    """A slip in the name of the bag would measure all views again."""
    cell, machine = write_cell(tmp_path)
    with pytest.raises(InputError, match="nothing to continue; name the bag"):
        run_of(tmp_path, machine, cell).measure(resume=True)
    assert not (tmp_path / "bag").exists()
    (tmp_path / "bag").mkdir()  # killed before its first file was whole
    desk = Agreeing()
    run_of(tmp_path, machine, cell, desk=desk).measure(resume=True)
    assert "nothing was saved yet, the measurement begins" in desk.lines[0]


def test_a_renamed_bag_is_not_begun_anew(tmp_path):
    """The readings of its files of the former name would be left out."""
    cell, machine = write_cell(tmp_path)
    (tmp_path / "plan.yaml").write_text(PLAN)
    run_of(tmp_path, machine, cell).measure()
    (tmp_path / "bag" / "bag_0.mcap").rename(tmp_path / "bag" / "monday_0.mcap")
    with pytest.raises(InputError, match="or it was renamed; name another folder"):
        run_of(tmp_path, machine, cell).measure(resume=True)


def test_a_clock_that_was_set_back_does_not_continue(tmp_path):
    cell, machine = write_cell(tmp_path)
    with pytest.raises(MachineError):
        run_of(
            tmp_path, Spoilt(machine, "connection lost in a move", after=12), cell
        ).measure()
    with pytest.raises(InputError, match="clock is behind the last message"):
        run_of(tmp_path, machine, cell, Jumping()).measure(resume=True)


def test_a_plate_that_is_laid_otherwise_than_asked_is_noticed_and_laid_anew(tmp_path):
    *head, turned, shifted = PLAN.replace("grid_size: 3", "grid_size: 5").splitlines()
    plan = "\n".join([*head, shifted, turned])
    cell, machine = write_cell(
        tmp_path,
        plan=plan,
        cell=CELL.replace("robot", "person"),
        simulation=f"{SIMULATION}cell: {{with_ids: false}}\n",
    )

    class Careless(Agreeing):
        """Turns the plate of the last view the other way the first time."""

        def place(self, command):
            super().place(command)
            view = command.placed()
            if self.placed.count("rot90") == 1:
                view = replace(view, rotation_rad=-view.rotation_rad)
            machine._lay(replace(command, view=view))

    desk = Careless()
    run_of(tmp_path, machine, cell, desk=desk).measure()
    assert desk.placed == ["identity", "shift", "rot90", "rot90"]
    assert any("measured anew" in line for line in desk.lines)
    away, _ = away_from(machine.truth, tmp_path / "bag")
    assert np.abs(away).max() < 5e-8
