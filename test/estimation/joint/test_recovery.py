# SPDX-License-Identifier: Apache-2.0
"""The joint solution returns a known truth to rounding, whatever the plan."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.errors import InputError, NoDataError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.normal import equations
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, Sense, ViewReadings
from selfcal_ros.model.view import View
from test.support.lattice_plans import in_datum, measured_in_datum, plan_of
from test.support.options import BARE, bare
from test.support.refusals import refused
from test.support.truth import (
    grid_deviation,
    hu_plan,
    random_truth,
    simulate_measurements,
)

EXACT = 1e-12


def measured(plan, seed=1, **how):
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    return truth, simulate_measurements(truth, plan, rng, **how)


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize(("size", "pitch", "lines"), [(11, 0.01, 24), (21, 0.005, 72)])
def test_hu_simulation_comes_back_exactly(size, pitch, lines, sense):
    plan = hu_plan(Artifact(size, pitch, lines))
    truth, readings = measured(plan, sense=sense)
    found = calibrate(readings, BARE)
    assert np.abs(found.error_map.gx - truth.g[0]).max() < EXACT
    assert np.abs(found.error_map.gy - truth.g[1]).max() < EXACT
    assert np.abs(found.error_map.g_theta - truth.g_theta).max() < EXACT
    assert np.abs(found.artifact_map.ax - truth.a[0]).max() < EXACT
    assert np.abs(found.artifact_map.ay - truth.a[1]).max() < EXACT
    assert np.abs(found.artifact_map.a_theta - truth.a_theta).max() < EXACT
    for index, view in enumerate(found.views):
        assert view.phi == pytest.approx(truth.phi_rad[index], abs=EXACT)
        if view.name != "line":
            assert (view.tx, view.ty) == pytest.approx(
                tuple(truth.t_m[index]), abs=EXACT
            )
    assert np.isnan(found.views[2].tx)
    assert found.observability.identifiable and found.findings == ()
    assert np.nanmax(found.error_map.u_gx) < EXACT


@pytest.mark.parametrize("shape", [(7, 7), (9, 5)])
@pytest.mark.parametrize("sense", Sense)
def test_squareness_and_scale_difference_are_those_of_a_straight_fit_to_the_map(
    shape, sense
):
    """O and R of Gx = O y + R x + Fx, Gy = O x - R y + Fy (Hu eq. 6), also where marks miss."""
    artifact = Artifact(shape[0], 0.01, 0, shape[1])
    _, readings = measured(plan_of("0,90,tx,ty", artifact), sense=sense, missing=0.2)
    emap = calibrate(readings, BARE).error_map
    x, y, known = artifact.x_m, artifact.y_m, emap.valid
    one, zero = np.ones_like(x), np.zeros_like(x)
    columns = [(y, x), (x, -y), (one, zero), (zero, one), (-y, x), (x, y)]
    design = np.array([np.concatenate([cx[known], cy[known]]) for cx, cy in columns]).T
    right = np.concatenate([emap.gx[known], emap.gy[known]])
    wanted = np.linalg.lstsq(design, right, rcond=None)[0][:2]
    assert np.abs(wanted).min() > 1e-8
    assert (emap.nonorthogonality, emap.scale_difference) == pytest.approx(
        tuple(wanted), rel=1e-6
    )


@pytest.mark.parametrize(
    "names",
    [
        "0,90,tx",
        "0,90,180,tx",
        "90,180,tx",
        "0,270-2tx+ty,tx,ty",
        "0,90,180,270,tx,ty",
        "90+tx,-tx,ty",
    ],
)
@pytest.mark.parametrize("shape", [(7, 7), (9, 5), (5, 9)])
def test_any_plan_and_shape(names, shape):
    artifact = Artifact(shape[0], 0.01, 0, shape[1])
    truth, readings = measured(plan_of(names, artifact))
    try:
        found = calibrate(readings, BARE)
    except NotIdentifiableError as error:
        assert shape[0] != shape[1] and error.observability.deficiency > 0
        return
    known = found.error_map.valid
    expected = in_datum(truth.g, known, artifact, scale=True)
    assert np.nanmax(np.abs(found.error_map.gx - expected[0])) < EXACT
    assert np.nanmax(np.abs(found.error_map.gy - expected[1])) < EXACT


def test_a_long_field_needs_and_takes_shifts_both_ways():
    artifact = Artifact(7, 0.01, 24, 11)
    with refused(r"shifted by \+1 pitch along Y"):
        calibrate(measured(hu_plan(artifact))[1], BARE)
    truth, readings = measured(plan_of("0,90,tx,ty", artifact, lines=1))
    found = calibrate(readings, BARE)
    assert found.error_map.valid.all()
    assert np.abs(found.error_map.gy - truth.g[1]).max() < EXACT


@pytest.mark.parametrize("missing", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("sense", Sense)
def test_missing_marks(missing, sense):
    artifact = Artifact(11, 0.01, 24)
    truth, readings = measured_in_datum(
        hu_plan(artifact),
        5,
        lambda some: calibrate(some, BARE).error_map.valid,
        missing=missing,
        sense=sense,
    )
    found = calibrate(readings, BARE)
    known = found.error_map.valid
    assert known.mean() > 0.95
    assert np.nanmax(np.abs(found.error_map.gx - truth.g[0])) < EXACT
    assert np.nanmax(np.abs(found.error_map.gy - truth.g[1])) < EXACT
    lines = np.isfinite(found.error_map.g_theta)
    offset = found.error_map.g_theta[lines] - truth.g_theta[lines]
    assert np.ptp(offset) < EXACT
    assert np.isfinite(found.error_map.u_gx[known]).all()
    assert np.isnan(found.error_map.u_gx[~known]).all()


@pytest.mark.parametrize("seed", range(8))
def test_order_of_readings_changes_no_bit(seed):
    random, (_, readings) = (
        np.random.default_rng(seed),
        measured(
            hu_plan(Artifact(5, 0.01, 8)),
            sigma_m=1e-8,
            sigma_theta_rad=1e-7,
            missing=0.05,
        ),
    )
    shuffled = []
    for view in readings.views:
        marks, lines = (random.permutation(len(of)) for of in (view.m, view.k))
        fields = {
            name: getattr(view, name)[marks] for name in ("m", "n", "dx", "dy", "count")
        }
        fields |= {
            name: getattr(view, name)[lines] for name in ("k", "dtheta", "count_theta")
        }
        shuffled.append(replace(view, **fields))
    other = replace(readings, views=tuple(shuffled))
    one, other = calibrate(readings, BARE), calibrate(other, BARE)
    equations.system_of.cache_clear()
    again = calibrate(readings, BARE)
    for name in ("gx", "gy", "u_gx", "u_gy", "g_theta", "u_g_theta"):
        expected = getattr(one.error_map, name).tobytes()
        assert getattr(other.error_map, name).tobytes() == expected
        assert getattr(again.error_map, name).tobytes() == expected
    assert repr(one.views) == repr(other.views) == repr(again.views)


@given(
    st.tuples(*[st.floats(-1e-4, 1e-4)] * 7),
    st.sampled_from(["0,90,tx", "0,90,180,ty"]),
)
@settings(max_examples=12, deadline=None)
def test_datum_shifts_change_nothing(shift, names):
    """A stage or a plate moved, turned or grown as a whole gives the same map.

    The linear model knows no more than that. Of plates that turn by a rotation it holds but for
    the product of the stage's turn or growth and the misalignments, some 0.3 mm.
    """
    artifact = Artifact(5, 0.01)
    truth = measured(plan_of(names, artifact))[0]
    cx, cy, turn, grow, ax, ay, plate = shift
    x, y = artifact.x_m, artifact.y_m
    moved = replace(
        truth,
        g=truth.g + np.stack([cx - turn * y + grow * x, cy + turn * x + grow * y]),
        a=truth.a + np.stack([ax - plate * y, ay + plate * x]),
    )
    plan = plan_of(names, artifact)
    largest = max(
        np.nanmax(abs(grid_deviation(truth, i, v))) for i, v in enumerate(plan.views)
    )
    for model, limit in (("linear", EXACT), ("rigid", EXACT + 4e-4 * largest)):
        one, two = (
            calibrate(
                simulate_measurements(
                    known, plan, np.random.default_rng(0), linear=model == "linear"
                ),
                bare(misalignment_model=model, causes=False),
            ).error_map
            for known in (truth, moved)
        )
        assert np.abs(one.gx - two.gx).max() < limit
        assert np.abs(one.gy - two.gy).max() < limit


@pytest.mark.parametrize("names", ["0,90,tx", "0,90,180,tx,ty"])
def test_a_plan_turned_as_a_whole_gives_the_map_turned(names):
    """Measuring the stage G'(X) = R G(R^-1 X) gives R applied to the map of G."""
    artifact = Artifact(7, 0.01)
    truth, readings = measured(plan_of(names, artifact))
    turned = replace(truth, g=np.stack([-truth.g[1][:, ::-1].T, truth.g[0][:, ::-1].T]))
    found = calibrate(readings, BARE).error_map
    other = calibrate(
        simulate_measurements(
            turned, plan_of(names, artifact), np.random.default_rng(0)
        ),
        BARE,
    ).error_map
    assert np.abs(other.gx + found.gy[:, ::-1].T).max() < EXACT
    assert np.abs(other.gy - found.gx[:, ::-1].T).max() < EXACT


def test_weights_of_repeats_are_those_of_repeated_readings():
    """One mean of 4 readings counts like 4 views with that reading each."""
    plan = plan_of("0,90,tx", Artifact(5, 0.01))
    _, readings = measured(plan, sigma_m=1e-7)
    heavy = replace(readings.views[0], count=readings.views[0].count * 2)
    weighted = calibrate(
        replace(readings, views=(heavy, *readings.views[1:])), BARE
    ).error_map
    declared = [
        replace(view, u=np.full(len(view.m), 1e-7 / np.sqrt(2 if i == 0 else 1)))
        for i, view in enumerate(readings.views)
    ]
    by_sigma = calibrate(replace(readings, views=tuple(declared)), BARE).error_map
    assert np.abs(weighted.gx - by_sigma.gx).max() < 1e-18
    assert np.abs(weighted.gx - calibrate(readings, BARE).error_map.gx).max() > 1e-10


def test_a_view_broken_off_after_one_mark_harms_nothing():
    plan = hu_plan(Artifact(7, 0.01, 24))
    truth, readings = measured(plan)
    first = readings.views[0]
    broken = ViewReadings(
        View("broken", 0.0, (0.0, 0.01)),
        first.m[:1],
        first.n[:1] + 2,
        first.dx[:1],
        first.dy[:1],
        first.count[:1],
    )
    found = calibrate(replace(readings, views=(*readings.views, broken)), BARE)
    assert np.abs(found.error_map.gx - truth.g[0]).max() < EXACT
    assert [view.phi for view in found.views[:4]] == pytest.approx(
        list(truth.phi_rad), abs=EXACT
    )
    assert np.isnan(found.views[4].phi)
    assert found.observability.identifiable and found.observability.deficiency == 0


def test_angular_marks_planned_but_never_read_leave_the_xy_map():
    truth, readings = measured(hu_plan(Artifact(7, 0.01, 24)))
    bare = replace(
        readings,
        views=tuple(
            replace(
                view,
                k=view.k[:0],
                dtheta=view.dtheta[:0],
                count_theta=view.count_theta[:0],
            )
            for view in readings.views
        ),
    )
    found = calibrate(bare, BARE)
    assert np.abs(found.error_map.gx - truth.g[0]).max() < EXACT
    assert np.isnan(found.error_map.g_theta).all() and np.isnan(found.views[2].phi)


class TestHostile:
    plan = hu_plan(Artifact(5, 0.01, 8))

    def readings(self, **change):
        _, readings = measured(self.plan)
        first = replace(readings.views[0], **change)
        return replace(readings, views=(first, *readings.views[1:]))

    def test_nothing_read(self):
        empty = Measurements(
            "p",
            self.plan.artifact,
            tuple(ViewReadings(view) for view in self.plan.views),
        )
        with pytest.raises(
            NoDataError, match="plan 'p': no grid mark was read; record"
        ):
            calibrate(empty, BARE)

    def test_mark_off_the_plate(self):
        with pytest.raises(
            InputError,
            match=r"view 'identity' grid readings: mark \(3, 0\) lies "
            "off the plate",
        ):
            calibrate(
                self.readings(
                    m=np.r_[3, self.readings().views[0].m[1:]],
                    n=np.r_[0, self.readings().views[0].n[1:]],
                ),
                BARE,
            )

    def test_mark_off_the_field(self):
        with pytest.raises(InputError, match="off the stage's field"):
            calibrate(self.readings(view=View("identity", 0.0, (0.02, 0.0))), BARE)

    def test_mark_twice(self):
        m = self.readings().views[0].m.copy()
        m[1], n = m[0], self.readings().views[0].n.copy()
        n[1] = n[0]
        with pytest.raises(InputError, match="a mark comes twice"):
            calibrate(self.readings(m=m, n=n), BARE)

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_not_finite(self, bad):
        dx = self.readings().views[0].dx.copy()
        dx[3] = bad
        with pytest.raises(InputError, match="not a finite number"):
            calibrate(self.readings(dx=dx), BARE)

    def test_count_below_one(self):
        with pytest.raises(InputError, match="a count below 1"):
            calibrate(self.readings(count=np.zeros(25, dtype=int)), BARE)

    def test_lengths_differ(self):
        with pytest.raises(InputError, match="differ in length"):
            calibrate(self.readings(dx=np.zeros(24), dy=np.zeros(24)), BARE)

    def test_grid_marks_at_an_odd_turn(self):
        with pytest.raises(InputError, match="not a multiple of 90°"):
            calibrate(self.readings(view=View("identity", np.pi / 4, grid=False)), BARE)

    def test_unknown_line(self):
        k = self.readings().views[0].k.copy()
        k[-1] = 8
        with pytest.raises(InputError, match="a line that the plate does not have"):
            calibrate(self.readings(k=k), BARE)

    def test_unknown_options(self):
        with pytest.raises(InputError, match="misalignment_model: 'magic' is unknown"):
            bare(misalignment_model="magic")
        with pytest.raises(InputError, match="datum_theta: 'free' is unknown"):
            bare(datum_theta="free")
