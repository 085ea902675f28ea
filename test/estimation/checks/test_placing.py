# SPDX-License-Identifier: Apache-2.0
"""Plates that lie otherwise than planned: told by the errors that marks carry along, and by ids."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Detection, EncoderSample
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.checks.placing import (
    PlacingError,
    _placed_alike,
    misplaced,
    moved_findings,
    other_poses,
)
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import PlacedPose
from selfcal_ros.model.readings import Sense, subset
from selfcal_ros.simulation.machine import Spread
from test.support import placed
from test.support.collecting import collect, gathered, scene
from test.support.mark_lists import lattice, rings, scatter
from test.support.misplaced import NOISE, laid, laid_at
from test.support.placed import PITCH_M, SIX, plate
from test.support.plans import image_plan, plan_of
from test.support.truth import random_truth, simulate_measurements

UNSEARCHED = Options(causes=False)
WRONG = {  # what the plan says, where the plate lies, in which view, and what is said
    "clockwise": (
        "0, 90, tx",
        "0, 270, tx",
        1,
        "turned by 270°, not by 90°; turn it counter-clockwise",
    ),
    "half a turn": (
        "0, 90, tx",
        "0, 180, tx",
        1,
        "turned by 180°, not by 90°; turn it as planned",
    ),
    "not turned": (
        "0, 90, tx, ty",
        "0, 0, tx, ty",
        1,
        "turned by 0°, not by 90°; turn it as ",
    ),
    "other side": (
        "0, 90, tx",
        "0, 90, -tx",
        2,
        "shifted by (-1, +0) pitches, not by (+1, +0) ",
    ),
    "other axis": (
        "0, 90, tx",
        "0, 90, ty",
        2,
        "shifted by (+0, +1) pitches, not by (+1, +0) ",
    ),
    "not shifted": (
        "0, 90, 180, tx",
        "0, 90, 180, 0",
        3,
        "shifted by (+0, +0) pitches, not by ",
    ),
}


EITHER_WAY = [
    (name, sense)
    for name in WRONG
    for sense in Sense
    if sense is Sense.MICROSCOPE_MOVES or name in ("clockwise", "other side")
]
"""A turn and a shift in both senses: what moves changes the sign of either alike."""


@cache
def read(planned, lies, sense=Sense.MICROSCOPE_MOVES):
    """Return the readings of a plate without ids that lies otherwise, and the views' names."""
    cell, names = laid(planned, lies, with_ids=False, sense=sense)
    return collect(cell.events, measurement_sense=str(sense))[0], names


@pytest.mark.parametrize(("name", "sense"), EITHER_WAY)
def test_without_ids_the_other_views_tell_how_a_plate_lies(name, sense):
    planned, lies, index, said = WRONG[name]
    readings, names = read(planned, lies, sense)
    with pytest.raises(PlacingError) as error:
        calibrate(readings)
    assert str(error.value).startswith(
        f"plan '{lies}', view '{names[index]}': the plate lies {said}"
    )
    assert str(error.value).endswith(
        "and measure this view again, or correct its pose in the plan"
    )


@pytest.mark.parametrize("name", WRONG)
def test_readings_without_repeats_tell_how_a_plate_lies(name):
    planned, lies, index, said = WRONG[name]
    readings, names = read(planned, lies)
    told = re.escape(f"view '{names[index]}': the plate lies {said}")
    with pytest.raises(PlacingError, match=told):
        calibrate(unrepeated(readings), UNSEARCHED)


def test_a_contradiction_that_hides_in_scattered_repeats_tells_how_a_plate_lies():
    readings, names = read("0, 90, tx, ty", "0, 270, tx, ty")
    drifting = replace(
        readings,
        views=tuple(
            replace(view, sigma_xy=8 * view.sigma_xy) for view in readings.views
        ),
    )
    found = misplaced(drifting)
    assert found is not None and (found.view, found.found_deg) == (names[1], 270)


def test_single_readings_that_are_off_are_not_a_plate_that_lies_otherwise():
    """At another pose, with marks missing, they share neither site nor mark with any."""
    readings, _ = read("0, 90, tx", "0, 90, tx")
    rng = np.random.default_rng(4)
    for _ in range(10):
        views = []
        for view in readings.views:
            seen = subset(view, rng.random(len(view.m)) < 0.75, np.zeros(0, dtype=int))
            off = np.zeros(len(seen.m))
            off[rng.integers(len(off))] = 5e-6
            views.append(replace(seen, dx=seen.dx + off, dy=seen.dy - off / 2))
        assert misplaced(replace(readings, views=tuple(views))) is None


def laid_once(readings, rng, *, again_m=0.0, noise_m=1.4e-8):
    """Return readings of a plate that stays where it is, but for a motion, m, in the last view."""
    plate, (first, *_) = readings.artifact, readings.views

    def sites(view):
        i, j = view.view.on_stage(plate).site_of(*plate.places(view.m, view.n))
        return list(zip(np.round(i).tolist(), np.round(j).tolist(), strict=True))

    seen = dict(zip(sites(first), np.stack([first.dx, first.dy], 1), strict=True))
    views = []
    for number, view in enumerate(readings.views):
        at = np.array([seen[site] for site in sites(view)])
        at = at + again_m * (number == len(readings.views) - 1)
        at = at + rng.normal(0, noise_m, at.shape)
        views.append(replace(view, dx=at[:, 0], dy=at[:, 1]))
    return replace(readings, views=tuple(views))


@pytest.mark.parametrize("planned", ["0, 90, tx", "0, 90, tx, ty", "0, tx, 90"])
@pytest.mark.parametrize("repeated", [True, False])
def test_a_plate_that_was_not_moved_is_not_one_without_errors(planned, repeated):
    """The map would be that of stage and plate together, within its noise."""
    readings, names = read(planned, planned)
    still = laid_once(readings, np.random.default_rng(5))
    still = still if repeated else unrepeated(still)
    with pytest.raises(PlacingError) as error:
        calibrate(still)
    assert str(error.value).startswith(
        f"plan '{readings.plan_id}', view '{names[1]}': the plate lies "
    )
    found = misplaced(still)
    assert found.found_deg == 0 and np.abs(found.found_shift).max() == 0


@pytest.mark.parametrize(("again_m", "noise_m"), [(3e-7, 1.4e-8), (0.0, 8e-8)])
def test_a_plate_that_may_not_have_been_moved_is_named_beside_a_good_map(
    again_m, noise_m
):
    """By a drift, or within so much noise, that it may also be a plate without errors."""
    readings, names = read("0, 90", "0, 90")
    rng = np.random.default_rng(5)
    still = laid_once(readings, rng, again_m=again_m, noise_m=noise_m)
    views = [replace(view, sigma_xy=2**0.5 * noise_m) for view in still.views]
    still = replace(still, views=tuple(views))
    assert misplaced(still) is None
    (finding,) = moved_findings(still)
    assert (finding.view, finding.against) == (names[1], names[0])
    assert finding.size == pytest.approx(again_m * 2**0.5, abs=noise_m)
    assert not list(moved_findings(readings))


def test_a_view_that_was_not_placed_anew_is_named_among_others():
    readings, names = read("0, 90, tx", "0, 90, tx")
    still = laid_once(readings, np.random.default_rng(6), again_m=5e-8)  # warmer
    views = (*readings.views[:2], still.views[2])
    found = misplaced(replace(readings, views=views))
    assert found is not None and found.view == names[2]


def test_a_plate_without_errors_is_not_one_that_was_not_moved():
    """Placed again it lies elsewhere by more than noise."""
    readings, _ = read("0, 90, tx", "0, 90, tx")
    rng = np.random.default_rng(7)
    truth = random_truth(readings.artifact, 3, rng)
    truth = replace(truth, a=0.0 * truth.a)
    plan = plan_of("0, 90, tx", 7, count=0, repeats=2)
    placed_again = simulate_measurements(truth, plan, rng, sigma_m=2e-8)
    assert misplaced(placed_again) is None
    assert not list(moved_findings(placed_again))


@pytest.mark.parametrize(
    ("plate_m", "noise_m", "placing_m"), [(5e-8, 1e-7, 3e-8), (2e-8, 2e-8, 2e-8)]
)
def test_a_good_plate_that_is_placed_again_exactly_is_not_one_that_was_not_moved(
    plate_m, noise_m, placing_m
):
    """Against pins, or aligned by its marks: where the readings show the errors of its marks."""
    spread = Spread(g_m=1e-6, a_m=plate_m, phi_rad=5e-7, t_m=placing_m)
    plan = plan_of("0, 90, tx, ty", 11, count=0, repeats=5)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth = random_truth(plan.artifact, 4, rng, spread)
        readings = simulate_measurements(truth, plan, rng, sigma_m=noise_m)
        assert misplaced(readings) is None


def test_a_pose_that_comes_twice_is_none_that_was_not_moved():
    """Off the lattice, with lines in one of its views."""
    pose = PlacedPose(np.exp(0.3j), (0.5, 0.25), 3.0)
    assert _placed_alike(pose, replace(pose, turn_lines=None))
    assert _placed_alike(pose, replace(pose, phase=np.exp((0.3 + 2e-6) * 1j)))
    assert not _placed_alike(pose, replace(pose, phase=np.exp(0.301j)))
    assert not _placed_alike(pose, replace(pose, shift=(0.5, 0.26)))


def unrepeated(readings):
    """Return readings of which nothing tells the noise of repeats."""
    return replace(
        readings,
        views=tuple(
            replace(view, sigma_xy=float("nan"), dof_xy=0) for view in readings.views
        ),
    )


@pytest.mark.parametrize("others", [(180,), ()])
@pytest.mark.parametrize("repeats", [1, 2])
@pytest.mark.parametrize("sense", list(Sense))
def test_images_tell_in_which_view_a_plate_lies_otherwise(sense, repeats, others):
    """Of two views the second relative to the first."""
    truth = random_truth(Artifact(7, 1e-3, 0), 3, np.random.default_rng(3))
    planned, lies = (
        simulate_measurements(
            truth,
            image_plan(7, turns=(0, turn, *others), repeats=repeats),
            np.random.default_rng(4),
            sigma_m=2e-8,
            sense=sense,
        )
        for turn in (90, 270)
    )
    assert len(lies.views) == 9 * (2 + len(others))
    assert misplaced(planned) is None and misplaced(lies) is None
    views = tuple(
        replace(there, view=here.view, m=-there.m, n=-there.n)
        if there.view.plan_view == "270"
        else there
        for here, there in zip(planned.views, lies.views, strict=True)
    )
    found = misplaced(replace(lies, views=views))
    assert found is not None and (found.view, found.found_deg) == ("90", 270)


def test_the_cells_of_one_view_alone_name_no_pose():
    """The first view of a run, which is checked as soon as it has been measured."""
    truth = random_truth(Artifact(7, 1e-3, 0), 1, np.random.default_rng(3))
    readings = simulate_measurements(
        truth, image_plan(7, turns=(0,)), np.random.default_rng(4), sigma_m=2e-8
    )
    rng = np.random.default_rng(5)
    dirty = tuple(
        replace(cell, dx=cell.dx + rng.normal(0, 1e-6, len(cell.dx)))
        for cell in readings.views
    )
    assert len({cell.view.plan_view for cell in dirty}) == 1 < len(dirty)
    assert misplaced(unrepeated(replace(readings, views=dirty))) is None


@pytest.mark.parametrize(("name", "sense"), EITHER_WAY)
def test_ids_tell_how_a_plate_lies_by_themselves(name, sense):
    planned, lies, index, said = WRONG[name]
    cell, _ = laid(planned, lies, with_ids=True, sense=sense)
    collector = gathered(cell.events, measurement_sense=str(sense))
    (finding,) = collector.findings(*collector.collect()).items()
    assert finding[0] == index
    assert said in finding[1].text.replace(" (or its ids are those of other marks)", "")


def test_two_views_do_not_tell_which_of_them_lies_otherwise():
    assert misplaced(read("0, 90", "0, 270")[0]) is None


def test_a_plate_without_errors_of_its_own_tells_nothing():
    readings, _ = read("0, 90, tx", "0, 270, tx")
    noise = np.random.default_rng(1)
    blank = replace(
        readings,
        views=tuple(
            replace(
                v,
                dx=noise.normal(0, 1.4e-8, len(v.m)),
                dy=noise.normal(0, 1.4e-8, len(v.m)),
            )
            for v in readings.views
        ),
    )
    assert misplaced(blank) is None


def test_it_is_told_before_a_view_is_complete():
    cell, names = laid("0, 90, tx", "0, 270, tx", with_ids=False)
    begin = [c.stamp_ns for c in cell.commands if c.view_index == 2][-1]
    third = [d for d in cell.detections if d.stamp_ns > begin]
    assert len(third) > 80
    cell.detections = [d for d in cell.detections if d.stamp_ns <= begin] + third[:28]
    found = misplaced(collect(cell.events)[0])
    assert found is not None and (found.view, found.found_deg) == (names[1], 270)


@pytest.mark.parametrize("text", ["0, 90, tx", "0, 90, 180, tx, ty"])
def test_plates_that_lie_as_planned_are_no_finding(text):
    for seed in range(3):
        readings = collect(scene(text, with_ids=False, seed=seed, **NOISE).events)[0]
        for size in (1.0, 0.1, 0.01):
            views = tuple(
                replace(v, dx=size * v.dx, dy=size * v.dy) for v in readings.views
            )
            assert misplaced(replace(readings, views=views)) is None
            assert misplaced(unrepeated(replace(readings, views=views))) is None


def test_other_poses_are_turns_and_shifts_each_once():
    pose = (
        plan_of("tx", 5, count=0)
        .views[0]
        .lattice_pose(plan_of("tx", 5, count=0).artifact)
    )
    poses = [(other.q, other.shift) for other in other_poses(pose)]
    assert len(poses) == len(set(poses)) and (0, (1, 0)) not in poses
    assert {
        (1, (1, 0)),
        (2, (1, 0)),
        (3, (1, 0)),
        (0, (0, 0)),
        (0, (-1, 0)),
        (0, (0, 1)),
        (0, (0, -1)),
        (0, (2, 0)),
        (0, (3, 0)),
        *((0, (1, step)) for step in (-2, -1, 1, 2)),
    } == set(poses)


PLATES = {
    "lattice": plate(9, 5),
    "list": lattice(7),
    "rings": rings(),
    "scatter": scatter(),
}


@pytest.mark.parametrize(
    ("name", "index", "pose", "said"),
    [
        ("lattice", 1, (270, (0, 0)), "turned by 270°, not by 90°"),
        ("lattice", 2, (127, (0.6, -0.7)), "turned by 127°, not by 37°"),
        ("lattice", 4, (0, (0, 0)), "shifted by (+0, +0) pitches, not by (+1, +0)"),
        ("list", 1, (0, (0, 0)), "turned by 0°, not by 90°"),
        ("list", 4, (0, (-1, 0)), "shifted by (-1, +0) pitches, not by (+1, +0)"),
        ("rings", 2, (217, (0.6, -0.7)), "turned by 217°, not by 37°"),
    ],
)
def test_plates_off_the_lattice_and_lists_of_marks_are_found_to_lie_otherwise(
    name, index, pose, said
):
    with pytest.raises(
        PlacingError, match=re.escape(f"'view {index}': the plate lies {said}")
    ):
        calibrate(laid_at(PLATES[name], index, pose, 0), UNSEARCHED)


@pytest.mark.parametrize("name", PLATES)
@pytest.mark.parametrize("sigma", [20e-9, 1e-9])
def test_plates_off_the_lattice_that_lie_as_planned_are_no_finding(name, sigma):
    for seed in range(2):
        assert misplaced(laid_at(PLATES[name], 1, SIX[1], seed, sigma)) is None


SIX_TURNS = (
    (0, (0, 0)),
    (30, (0, 0)),
    (45, (0.3, -0.2)),
    (137, (0, 0)),
    (90, (-0.7, 0.4)),
    (0, (0.5, 0.37)),
)


@pytest.mark.parametrize("pitches", [3, 4])
def test_a_stage_too_rough_for_its_nodes_is_no_mirrored_frame(pitches):
    """Waves of about the nodes' distance: plates that lie as planned contradict each other."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        along = (
            np.exp(1j * rng.uniform(0, 2 * np.pi, 6)) * 2 * np.pi / pitches / PITCH_M
        )
        phases = rng.uniform(0, 2 * np.pi, (2, 6, 1))

        def rough(z, along=along, phases=phases):
            wave = np.real(np.ravel(z) * along.conj()[:, None])
            x, y = 1.2e-7 * np.cos(wave + phases).sum(axis=1)
            return (x + 1j * y).reshape(np.shape(z))

        found, _ = placed.readings(plate(7, 3), SIX_TURNS, rng, size=3e-7, stage=rough)
        views = [replace(view, sigma_xy=20e-9, dof_xy=50) for view in found.views]
        assert misplaced(replace(found, views=tuple(views))) is None


def test_readings_noisier_than_their_repeats_are_no_mirrored_frame():
    """As of encoders within their signal period: repeats do not show it, no two views share it."""
    poses = (
        (0, (0, 0)),
        (90, (0.2, 0.4)),
        (35, (-0.8, 0.6)),
        (180, (1.0, -0.4)),
        (-70, (0.6, 1.0)),
    )
    for seed in range(3):
        found, _ = placed.readings(
            lattice(8, holes=(9, 30, 40), nodes=3),
            poses,
            np.random.default_rng(seed),
            sigma=45e-9,
            size=3e-7,
            stage=np.zeros_like,
        )
        views = [replace(view, sigma_xy=12e-9, dof_xy=50) for view in found.views]
        assert misplaced(replace(found, views=tuple(views))) is None


def reflected(events, of):
    """Return the messages of a cell whose joints and offsets are of(x, y)."""
    out = []
    for event in events:
        if isinstance(event, EncoderSample):
            x, y, *theta = event.positions
            event = replace(event, positions=(*of(x, y), *theta), velocities=())
        elif isinstance(event, Detection):
            x, y = of(event.offset_x, event.offset_y)
            event = replace(event, offset_x=x, offset_y=y)
        out.append(event)
    return out


@pytest.mark.parametrize(
    ("of", "said", "sense"),
    [
        (lambda x, y: (-x, y), "have x reversed; correct", Sense.MICROSCOPE_MOVES),
        (lambda x, y: (x, -y), "have y reversed; correct", Sense.PLATE_MOVES),
        (lambda x, y: (y, x), "have x and y exchanged; correct", Sense.PLATE_MOVES),
        (
            lambda x, y: (-y, -x),
            "have x and y exchanged and reversed; correct",
            Sense.MICROSCOPE_MOVES,
        ),
    ],
)
def test_a_mirrored_frame_without_ids_is_named(sense, of, said):
    cell = scene("0, 90, 180, tx, ty", with_ids=False, sense=sense, **NOISE)
    readings = collect(reflected(cell.events, of), measurement_sense=str(sense))[0]
    with pytest.raises(PlacingError, match=f"all views: the plate turns .* {said}"):
        calibrate(readings, UNSEARCHED)
    assert misplaced(collect(cell.events, measurement_sense=str(sense))[0]) is None


def test_one_view_turned_the_other_way_is_not_taken_for_a_mirrored_frame():
    """Two views tell the sense of a turn: the rest of the plan agrees with the frame."""
    cell, names = laid("0, 90, 180, tx, ty", "0, 270, 180, tx, ty", with_ids=False)
    found = misplaced(collect(cell.events)[0])
    assert (found.view, found.found_deg) == (names[1], 270)
