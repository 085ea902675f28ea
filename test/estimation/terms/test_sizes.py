# SPDX-License-Identifier: Apache-2.0
"""A size that the readings contradict is told, and does not bend the map in silence."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom

from selfcal_ros.blocks import blocks
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.model_fit import fit_model
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.terms.equations import FREE, roots_by_term
from selfcal_ros.estimation.verdict.uncertainty import budgets
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.terms import ModelTerm, parse_terms
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.reporting.words.phrases import line_text
from selfcal_ros.simulation.machine import Spread, random_truth
from test.estimation.terms.test_terms import plan_of, settings
from test.support.dense_fit import DenseFit
from test.support.options import bare
from test.support.results import trusted
from test.support.truth import simulate_measurements

CLEAN = Spread(encoder="independent", rotation="finite", phi_rad=1e-4)
SIZES = {
    "microscope": 1e-3,
    "drift": 50e-9,
    "plate_scale": 1e-6,
    "plate_shape": 30e-9,
    "approach": 20e-9,
}


def of_sizes(truth, rng, sizes):
    """Return a truth whose terms are drawn from their sizes, every view's own."""
    views = len(truth.phi_rad)
    of = {name: sizes.get(name, 0.0) for name in SIZES}
    p1, p2, p3 = np.moveaxis(rng.normal(0, of["drift"], (views, 2, 3)), 2, 0)
    # Legendre polynomials of 2 tau - 1, less what is constant
    drift = np.stack([2 * p1 - 6 * p2 + 12 * p3, 6 * p2 - 30 * p3, 20 * p3], axis=2)
    return replace(
        truth,
        drift_m=drift,
        plate_scale=rng.normal(0, of["plate_scale"], views),
        plate_shape_m=bending(rng.normal(0, of["plate_shape"], (views, 2, 3))),
        backlash_m=rng.normal(0, of["approach"], 2),
        microscope=matrix_of(*rng.normal(0, of["microscope"], 4)),
    )


def bending(parts):
    """Return coefficients (views, 2, 3) of x^2, xy, y^2 of a z^2 + b |z|^2 + c z*^2.

    `parts`: those of a, b, c, real and imaginary, (views, 2, 3).
    """
    a, b, c = np.moveaxis(parts[:, 0] + 1j * parts[:, 1], 1, 0)
    forms = np.stack([a + b + c, 2j * (a - c), b - a - c], axis=1)
    return np.stack([forms.real, forms.imag], axis=1)


def matrix_of(scale, turn, stretch, shear):
    """Return the matrix of a microscope, E o = (scale + i turn) o + (stretch + i shear) conj(o)."""
    return np.array([[scale + stretch, shear - turn], [shear + turn, scale - stretch]])


def measured(seed, sizes, *, sigma_m=20e-9, phi_rad=1e-4):
    rng, plan = np.random.default_rng(seed), plan_of(5, 2)
    truth = random_truth(
        plan.artifact, len(plan.views), rng, replace(CLEAN, phi_rad=phi_rad)
    )
    truth = of_sizes(truth, rng, sizes)
    return truth, simulate_measurements(
        truth, plan, rng, settings=settings(sigma_m), visits=True
    )


def options(*terms, **more):
    return bare(terms=parse_terms(terms, ""), **more)


def fitted(readings, wanted):
    return fit_model(prepare(readings, wanted)[0])


def test_sizes_that_are_right_are_contradicted_at_the_rate_of_the_level():
    p = []
    for seed in range(7):
        _, readings = measured(seed, SIZES)
        sizes = fitted(readings, options(*(f"{n}:{s}" for n, s in SIZES.items()))).sizes
        assert {test.name for test in sizes} == set(SIZES)
        assert [test.rank for test in sorted(sizes, key=lambda t: t.name)] == [
            2,
            30,
            4,
            4,
            23,
        ]
        p += [test.p for test in sizes]
    p = np.array(p)
    assert p.min() > 5e-4
    for level in (0.1, 0.5):
        least, most = binom.ppf([1e-4, 1 - 1e-4], len(p), level)
        assert max(least, 1) <= (p < level).sum() <= most


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("factor", [10, 100])
def test_a_size_that_is_too_small_is_told_and_the_one_shown_is_right(name, factor):
    sizes = {name: 4 * SIZES[name]}
    _, readings = measured(3, sizes)
    (test,) = fitted(readings, options(f"{name}:{sizes[name] / factor}")).sizes
    assert test.contradicted
    # of two to thirty coefficients
    assert sizes[name] / 3 < test.shown < 3 * sizes[name]
    assert test.given == pytest.approx(sizes[name] / factor)
    assert test.shown < test.allowed


def test_the_statistic_is_what_the_size_adds_to_the_sum_of_squares():
    _, readings = measured(5, SIZES, phi_rad=1e-6)
    wanted = options(
        "plate_scale:4e-7",
        "plate_shape:3e-8",
        "approach:2e-8",
        "drift",
        misalignment_model="linear",
        at_places=False,
    )
    model = fitted(readings, wanted)
    assert not any(test.contradicted for test in model.sizes)

    def squares(without=None):
        terms = tuple(
            ModelTerm(term.name) if term.name == without else term
            for term in wanted.terms
        )
        return DenseFit(
            readings, terms, (model.fitted.xy.sigma, 1.0), places=False
        ).squares

    tests = {test.name: test for test in model.sizes}
    for name in ("plate_scale", "plate_shape", "approach"):
        assert tests[name].statistic == pytest.approx(
            squares() - squares(name), rel=1e-5
        ), name


@pytest.mark.parametrize(
    ("term", "said"),
    [
        ("plate_scale:1e-8", "a term 'plate_scale' as large as "),
        ("drift:1e-9", "a term 'drift' as large as "),
        (
            "microscope:1e-6",
            "a microscope that shows lengths along x longer than along y by ",
        ),
        ("approach:1e-10", "an indicated x that changes by ±(0.0"),
    ],
)
def test_a_calibration_with_a_contradicted_size_says_so_and_its_u_is_honest(term, said):
    name, _, given = term.partition(":")
    truth, readings = measured(4, {name: 5 * SIZES[name]})
    result = worded(calibrate(readings, options(term)))
    verdict, cause = result.verdict, result.verdict.causes[0]
    assert verdict.grade is Grade.ENLARGED
    assert cause.name == name and cause.p < 5e-4
    assert cause.text.startswith(said)
    assert verdict.reasons[0].startswith(f"the readings show {said}")
    unit = "µm" if name == "drift" else "µm/m"
    # of views nothing tells which it is: the largest is named, not sized
    assert cause.view == "" or f" {unit} in view '{cause.view}', " in cause.text
    assert cause.view == "" or "times the size assumed: " in cause.text
    assert verdict.sentence == f"Good within an enlarged U: {cause.text}"
    assert [item.name for item in verdict.enlarged_by] == [name]
    estimates = result.model.terms[0].estimates
    assert abs(cause.size) == max(abs(e.value) for e in estimates) > 100 * float(given)
    assert cause.view == max(estimates, key=lambda e: abs(e.value)).view
    error = np.stack([result.error_map.gx, result.error_map.gy]) - truth.g
    u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
    assert np.sqrt(np.mean((error / u) ** 2)) < 1.5


@pytest.mark.parametrize(
    ("size", "grade"), [("1e-9", "not_qualified"), ("1.5e-7", "good")]
)
def test_what_is_there_and_not_determined_passes_only_if_its_size_is_declared(
    size, grade
):
    _, readings = measured(4, {"plate_shape": 5 * SIZES["plate_shape"]})
    verdict = calibrate(readings, options(f"plate_shape:{size}")).verdict
    assert verdict.grade == grade
    assert [cause.name for cause in verdict.causes] == ["plate_shape"] * (
        grade != "good"
    )


def test_doubtful_sizes_are_raised_to_the_limit_of_their_chi_square():
    """A quarter of the sizes that readings contradict: p between 5e-4 and 0.1 in most draws."""
    raised = []
    for seed in range(8):
        _, readings = measured(seed, {"plate_scale": 3 * SIZES["plate_scale"]})
        result = trusted(readings, options(f"plate_scale:{SIZES['plate_scale']}"))
        (test,) = fitted(readings, options(f"plate_scale:{SIZES['plate_scale']}")).sizes
        (term,) = result.model.terms
        assert (term.size_used is not None) == (test.p < 0.1)
        if 5e-4 < test.p < 0.1:
            raised.append(test.allowed / test.given)
            assert term.size_used == test.allowed and result.verdict.grade is Grade.GOOD
    assert raised and min(raised) > 1


def test_two_coefficients_make_a_size_doubtful_at_a_looser_level():
    """Both may be small by chance while those that no reading determines are not."""
    wanted = options(f"approach:{SIZES['approach']}")
    tests = []
    for seed in range(16):
        _, readings = measured(seed, {"approach": 1.5 * SIZES["approach"]})
        tests += fitted(readings, wanted).sizes
    assert {test.rank for test in tests} == {2}
    assert all(test.raised == (test.p < 0.2) for test in tests)
    assert all((test.allowed > test.given) == test.raised for test in tests)
    assert any(0.1 < test.p < 0.2 for test in tests)


@pytest.mark.parametrize(
    ("plausible", "grade"), [(4.0, Grade.GOOD), (0.5, Grade.NOT_QUALIFIED)]
)
def test_doubt_raises_no_size_beyond_what_is_plausible_or_shown(
    monkeypatch, plausible, grade
):
    """What the readings show beyond what is plausible is a fault, though it be only doubtful."""
    size, seen = SIZES["plate_scale"], 0
    monkeypatch.setitem(
        blocks(),
        "plate_scale",
        replace(blocks()["plate_scale"], plausible=plausible * size),
    )
    for seed in range(8):
        _, readings = measured(seed, {"plate_scale": 3 * size})
        (test,) = fitted(readings, options(f"plate_scale:{size}")).sizes
        if 5e-4 < test.p < 0.1:
            seen += 1
            assert size < test.shown < 4 * size
            assert test.allowed < 1.000001 * max(test.shown, plausible * size)
            verdict = trusted(readings, options(f"plate_scale:{size}")).verdict
            assert verdict.grade is grade
            assert bool(verdict.causes) is (grade is Grade.NOT_QUALIFIED)
    assert seen


def test_a_size_that_is_too_small_is_kept_beside_the_one_that_was_used():
    _, readings = measured(4, {"plate_scale": 5e-6})
    result = calibrate(readings, options("plate_scale:1e-8"))
    (term,) = result.model.terms
    assert term.size == 1e-8 and 1e-6 < term.size_used < 1e-4
    back = result_from_dict(result_to_dict(worded(result)), "r.json")
    assert back.model == result.model
    line = next(
        c for c in budgets(result)[0].lines if c.component == "term plate_scale"
    )
    assert line_text(line).startswith("size 0.01 µm/m, too small for the readings; of ")
    assert (line.source, line.details.allowed) == ("readings", term.size_used)
    right = calibrate(readings, options("plate_scale:5e-6"))
    assert right.model.terms[0].size_used is None
    assert right.verdict.grade is Grade.GOOD


def test_one_wrong_size_does_not_make_another_appear_wrong():
    _, readings = measured(6, {**SIZES, "plate_scale": 1e-4, "plate_shape": 10e-9})
    wanted = options("plate_scale:1e-8", "plate_shape:1e-8", "approach:2e-8")
    sizes = fitted(readings, wanted).sizes
    assert [(t.name, t.contradicted) for t in sizes] == [
        ("plate_scale", True),
        ("plate_shape", False),
        ("approach", False),
    ]


def test_readings_without_noise_contradict_a_size_as_well():
    _, readings = measured(7, {"plate_scale": 1e-6}, sigma_m=0.0)
    (test,) = fitted(readings, options("plate_scale:1e-8")).sizes
    assert test.contradicted and 3e-7 < test.shown < 3e-6


def test_one_pattern_of_bending_alone_contradicts_the_size_of_all():
    """Saddles of three times the size; with all six coefficients alike it is 1.7 times."""
    found, size = [], SIZES["plate_shape"]
    for seed in range(8):
        rng, plan = np.random.default_rng(seed), plan_of(5, 2)
        parts = np.zeros((len(plan.views), 2, 3))
        parts[:, :, 2] = rng.normal(0, 3 * size, parts.shape[:2])
        truth = random_truth(plan.artifact, len(plan.views), rng, CLEAN)
        truth = replace(truth, plate_shape_m=bending(parts))
        readings = simulate_measurements(
            truth, plan, rng, settings=settings(), visits=True
        )
        (test,) = fitted(readings, options(f"plate_shape:{size}")).sizes
        found.append((test.p, test.p_together))
    p, together = np.array(found).T
    assert (p < 5e-4).all()
    assert (together > 1e-3).sum() >= 2


def test_a_coefficient_that_is_known_exactly_leaves_no_part_to_free_ones():
    """Rounding, over a variance of zero, overflowed."""
    sizes = ModelTerm("line_eccentricity", 1.0), ModelTerm("rotation", 1.0)
    columns = SimpleNamespace(
        columns=tuple(
            SimpleNamespace(term=term.name, size=term.size) for term in sizes
        ),
        size=np.ones(2),
        rows=lambda names: np.array([term.name in names for term in sizes]),
    )
    covariance = np.array([[1e24, 1e7], [1e7, 0.0]])
    parts = dict(roots_by_term(covariance, columns))
    assert parts.pop(FREE).shape == (2, 0)
    total = sum(root @ root.T for root in parts.values())
    np.testing.assert_allclose(total, covariance, atol=1e8)
