# SPDX-License-Identifier: Apache-2.0
"""Sites that are not known because they hang on no others: what they do to those that are."""

from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.error_map import datum_modes, remove_modes
from test.support.plans import plan_of
from test.support.truth import Spread, random_truth, simulate_measurements

# a turn joins these four sites to each other; without these marks no shift joins them to the others
APART = {(2, 1), (-1, 2), (-2, -1), (1, -2)}
LOST = {(1, 1), (-2, 2), (0, -2), (-1, 2), (-2, -1), (1, -2)}


def without_lost_marks():
    """Return readings of plates turned by a degree, whose sites `APART` hang on no others."""
    plan, rng = plan_of("0, 90, tx, ty", 5), np.random.default_rng(3)
    truth = random_truth(
        plan.artifact,
        len(plan.views),
        rng,
        Spread(phi_rad=np.deg2rad(1), rotation="finite"),
    )
    readings = simulate_measurements(truth, plan, rng)
    views = []
    for view in readings.views:
        at = [*zip(view.m.tolist(), view.n.tolist(), strict=True)]
        if view.view.name == "tx":
            keep = np.array([mark not in LOST for mark in at])
        elif view.view.name == "ty":
            keep = np.array(
                [
                    mark not in APART and (mark[0], mark[1] + 1) not in APART
                    for mark in at
                ]
            )
        else:
            keep = np.ones(len(at), dtype=bool)
        views.append(
            replace(
                view,
                m=view.m[keep],
                n=view.n[keep],
                dx=view.dx[keep],
                dy=view.dy[keep],
                count=view.count[keep],
            )
        )
    return replace(readings, views=tuple(views)), truth


def test_what_is_taken_off_sites_and_plate_there_changes_no_reading():
    grid, rng = (
        prepare(without_lost_marks()[0], Options())[0].system.grid,
        np.random.default_rng(1),
    )
    field, plate = rng.normal(size=(2, *grid.views.shape, 2)) @ [1, 1j]
    found, small = grid.free_parts_small(field, plate)
    change = grid.views.gather(found - field) + (small - plate)
    assert abs(change[grid.read]).max() < 1e-12
    apart = [(m + 2, n + 2) for m, n in APART]
    moved = {*map(tuple, np.argwhere(abs(found - field) > 1e-12).tolist())}
    assert moved == {*apart}


def test_sites_that_hang_on_no_others_leave_no_residuals_where_plates_turn():
    """Nothing tells by how much they are off together, and a turned plate turns that amount."""
    readings, truth = without_lost_marks()
    result = calibrate(readings)
    emap = result.error_map
    known = np.isfinite(emap.gx)
    assert {(int(i) - 2, int(j) - 2) for i, j in np.argwhere(~known)} == APART
    error = np.stack([emap.gx, emap.gy]) - np.where(known, truth.g, np.nan)
    error = remove_modes(error, datum_modes(readings.artifact, scale=True))
    # what rotations of 17 mrad make of plate errors of 0.3 um, not of offsets of 30 um
    assert np.nanmax(abs(error)) < 2e-9 and result.noise.sigma_xy_residuals < 5e-9
