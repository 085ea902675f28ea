# SPDX-License-Identifier: Apache-2.0
"""Terms of the model: recovered from a machine that has them, told or refused."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.lattice.readings import grid_data
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.estimation.terms.visits import term_inputs
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import ModelTerm, parse_terms
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.reporting.words.observability import with_advice
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.options import bare
from test.support.truth import simulate_measurements

PITCH = 0.01
ALL = "microscope,drift,plate_scale,approach"
MACHINE = Spread(
    encoder="independent",
    rotation="finite",
    microscope_rotation_rad=2e-3,
    microscope_scale=-1e-3,
    microscope_shear=5e-4,
    backlash_x_m=20e-9,
    backlash_y_m=-30e-9,
    plate_scale=1e-6,
    drift_linear_m=100e-9,
    drift_quadratic_m=50e-9,
    drift_cubic_m=30e-9,
)


def parts_of(matrix):
    """Return E by its parts, E o = (scale + i turn) o + (stretch + i shear) conj(o)."""
    (xx, xy), (yx, yy) = matrix
    return {
        "scale": (xx + yy) / 2,
        "turn": (yx - xy) / 2,
        "stretch": (xx - yy) / 2,
        "shear": (xy + yx) / 2,
    }


def plan_of(size=5, repeats=4, order="x_back_y_back", lines=0):
    poses = (
        ("0", 0, (0, 0)),
        ("90", 1, (0, 0)),
        ("+x", 0, (1, 0)),
        ("-x", 0, (-1, 0)),
        ("+y", 0, (0, 1)),
    )
    return Plan(
        "p",
        Artifact(size, PITCH, lines),
        tuple(
            View(
                name,
                q * np.pi / 2,
                (a * PITCH, b * PITCH),
                True,
                lines > 0,
                repeats,
                order,
            )
            for name, q, (a, b) in poses
        ),
    )


def settings(sigma_m=0.0, sense=Sense.MICROSCOPE_MOVES, **more):
    return CellSettings(
        sense,
        sigma_m,
        stop_sigma_m=20e-6,
        servo_sigma_m=0.0,
        servo_sigma_theta_rad=0.0,
        **more,
    )


def measured(plan, spread=MACHINE, *, seed=3, change=None, **how):
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng, spread)
    truth = change(truth) if change else truth
    return truth, simulate_measurements(
        truth, plan, rng, settings=settings(**how), visits=True
    )


def true_stage(truth):
    """Return a truth without a stage error: it would differ between where the stage stops."""
    return replace(truth, g=np.zeros_like(truth.g))


@pytest.mark.parametrize("sense", Sense)
def test_a_machine_that_does_it_all_is_recovered_to_rounding(sense):
    truth, readings = measured(plan_of(), change=true_stage, sense=sense)
    result = calibrate(
        readings,
        bare(
            terms=parse_terms([ALL], ""),
            causes=False,
            misalignment_model="rigid",
            datum_theta="zero_mean",
        ),
    )
    # the plate's own error grows with it, by less than a picometre
    assert np.abs([result.error_map.gx, result.error_map.gy]).max() < 3e-12
    found = {
        (t.name, e.view, e.component): e.value
        for t in result.model.terms
        for e in t.estimates
    }
    for key, value in parts_of(MACHINE.microscope).items():
        assert found["microscope", "", key] == pytest.approx(value, abs=1e-8)
    assert found["approach", "", "x"] == pytest.approx(20e-9, abs=1e-12)
    assert found["approach", "", "y"] == pytest.approx(-30e-9, abs=1e-12)
    for view, scale in list(zip(plan_of().views, truth.plate_scale, strict=True))[1:]:
        assert found["plate_scale", view.name, "scale"] == pytest.approx(
            scale - truth.plate_scale[0], abs=1e-8
        )


def test_the_matrix_of_a_microscope_is_found_within_its_uncertainty():
    squares = []
    for seed in range(12):
        spread = Spread(
            encoder="independent",
            rotation="finite",
            microscope_rotation_rad=2e-3,
            microscope_scale=5e-3,
        )
        _, readings = measured(plan_of(), spread, seed=seed, sigma_m=20e-9)
        result = calibrate(
            readings,
            bare(
                terms=parse_terms(["microscope"], ""),
                misalignment_model="rigid",
                causes=False,
            ),
        )
        (term,) = result.model.terms
        wanted = parts_of(spread.microscope)
        squares += [
            ((e.value - wanted[e.component]) / e.u) ** 2 for e in term.estimates
        ]
    assert 0.4 < np.mean(squares) < 1.8  # chi2 of 48: outside once in ten thousand


def test_a_drift_that_looks_like_the_stage_is_refused_and_a_size_widens_u():
    still = Spread(encoder="independent", rotation="finite")
    _, readings = measured(plan_of(order="raster", repeats=1), still, sigma_m=20e-9)
    with pytest.raises(NotIdentifiableError) as caught:
        calibrate(readings, bare(terms=parse_terms(["drift"], ""), drift_degree=1))
    assert str(with_advice(caught.value)).startswith(
        "the readings do not separate drift from the stage (2 modes undetermined): drift: visit "
        "the marks in more than one order"
    )
    assert caught.value.observability.deficiency == 2
    assert not caught.value.observability.identifiable
    u = {}
    for size in ("1e-9", "1e-6"):
        result = calibrate(
            readings, bare(terms=parse_terms([f"drift:{size}"], ""), drift_degree=1)
        )
        u[size] = float(np.sqrt(np.mean(result.error_map.u_gx**2)))
    assert u["1e-6"] > 4 * u["1e-9"]


@pytest.mark.parametrize("terms", ["microscope", "drift", "plate_scale:1e-6", ""])
def test_axes_that_the_stage_does_not_have_are_no_noise_of_the_readings(terms):
    """The datum of theta shifts the angular map; whether the stage keeps it is another test."""
    plan = plan_of(lines=8)
    plan = replace(
        plan, views=(*plan.views, View("line", np.pi / 4, (0.0, 0.0), False, True))
    )
    _, readings = measured(
        plan,
        Spread(encoder="independent", rotation="finite"),
        sigma_m=20e-9,
        sigma_theta_rad=2e-6,
    )
    found = [
        calibrate(
            readings,
            bare(terms=parse_terms([terms], ""), datum_theta=datum, causes=False),
        )
        for datum in ("xy_axes", "zero_mean")
    ]
    assert [item.verdict.qualified for item in found] == [False, True]
    assert all(
        "axis conditions" in reason for reason in worded(found[0]).verdict.reasons
    )
    for values in zip(
        *(
            (
                item.error_map.gx,
                item.error_map.u_gx,
                item.noise.sigma_xy_residuals,
                item.noise.sigma_theta_residuals,
            )
            for item in found
        ),
        strict=True,
    ):
        assert np.allclose(*values, rtol=1e-6, atol=1e-13)


@pytest.mark.parametrize("one_sided", [("y",), ("x", "y")])
def test_an_axis_that_arrives_from_one_side_alone_has_no_approach_and_keeps_its_map(
    one_sided,
):
    """What it adds is the same everywhere: the views' own positions take it up."""
    _, readings = measured(
        plan_of(), Spread(encoder="independent", rotation="finite"), sigma_m=20e-9
    )
    always = {f"approach_{axis}": 1 for axis in one_sided}
    readings = replace(
        readings,
        views=tuple(
            replace(
                view,
                visits=replace(
                    view.visits,
                    **{
                        name: np.full(len(view.visits.mark), sign, dtype=np.int8)
                        for name, sign in always.items()
                    },
                ),
            )
            for view in readings.views
        ),
    )
    plain, found = (
        calibrate(readings, bare(terms=parse_terms([terms], ""), causes=False))
        for terms in ("", "approach")
    )
    (term,) = found.model.terms
    told = {estimate.component: estimate for estimate in term.estimates}
    for axis in "xy":
        assert np.isfinite(told[axis].value) == (axis not in one_sided)
    for name in ("gx", "gy", "u_gx"):
        values = getattr(found.error_map, name), getattr(plain.error_map, name)
        assert np.allclose(*values, rtol=0, atol=1e-13 if len(one_sided) == 2 else 5e-9)


def test_terms_need_visits():
    _, readings = measured(plan_of())
    without = replace(
        readings, views=tuple(replace(v, visits=None) for v in readings.views)
    )
    with pytest.raises(
        InputError,
        match="view '0': the term 'drift' needs the time, the offset "
        "and the direction of approach of each reading",
    ):
        calibrate(without, bare(terms=parse_terms(["drift"], "")))
    assert calibrate(without, bare(terms=parse_terms(["plate_scale"], ""))).model.terms


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("warp", "--model: the term 'warp' is unknown; known are microscope, drift"),
        ("drift,drift:1e-9", "--model: the term 'drift' is given twice; remove one"),
        ("drift:x", "--model: drift: the size 'x' is not a positive number"),
        ("drift:-1e-9", "the size '-1e-9' is not a positive number"),
        ("drift:inf", "the size 'inf' is not a positive number"),
        (
            "drift:1e300",
            "--model: drift: the size 1e300 is outside 1e-18 to 1; give a standard",
        ),
        ("drift:9e-19", "the size 9e-19 is outside 1e-18 to 1"),
        ("drift:1.01", "the size 1.01 is outside 1e-18 to 1"),
        ("drift:", "the size '' is not a positive number"),
    ],
)
def test_terms_that_cannot_be_read(text, said):
    with pytest.raises(InputError) as caught:
        parse_terms([text], "--model")
    assert said in str(caught.value)


def test_terms_are_read_in_one_order():
    assert parse_terms(["approach:2e-8, drift", "", "microscope"], "") == (
        ModelTerm("microscope"),
        ModelTerm("drift"),
        ModelTerm("approach", 2e-8),
    )
    assert [str(t) for t in parse_terms(["drift:5e-8,approach"], "")] == [
        "drift:5e-08",
        "approach",
    ]


def test_no_columns_make_nothing_of_any_visit():
    rng = np.random.default_rng(1)
    plan = Plan("one", Artifact(5, 0.01), (View("a"),))
    readings = simulate_measurements(
        random_truth(plan.artifact, 1, rng), plan, rng, visits=True
    )
    inputs = term_inputs(readings, grid_data(readings))
    columns = term_columns(inputs, [ModelTerm("plate_scale")])
    assert columns.columns == () and columns.at_visits(np.zeros(0)) == [0.0]
    free = term_columns(replace(inputs, drift_degree=1), [ModelTerm("drift")])
    (drift,) = free.at_visits(np.array([2.0, 3.0]))
    np.testing.assert_allclose(drift, (2 + 3j) * inputs.visits[0].time)
