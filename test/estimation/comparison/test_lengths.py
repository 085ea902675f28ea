# SPDX-License-Identifier: Apache-2.0
"""Reference lengths behind a mean that keeps its scale: what averages out, and what may differ."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.combine import Member, combine, variance_between
from selfcal_ros.estimation.comparison.lengths import length_in_both, lengths_of
from selfcal_ros.estimation.comparison.maps import compare
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.verdict import Grade
from test.support.maps import random_map, result_of

PLATE = Artifact(7, 0.01)
PLACE = np.stack([PLATE.x_m, PLATE.y_m])
NOISE_M = 3e-9
EXPANSION = 8e-6


def length(name, error, u, celsius=20.0):
    """Return a certified length of glass, with its temperature to 0.05 K."""
    reference = ReferenceLength("artifact", error, u, name)
    return reference.at_temperature(f"{celsius}:0.05:{EXPANSION}:0")


def run(name, scale, reference, seed):
    """Return a run whose map has a scale, and noise of its own."""
    noise = np.random.default_rng(seed).normal(0, NOISE_M, PLACE.shape)
    gx, gy = (
        np.stack([(base := random_map(PLATE, 1)).gx, base.gy]) + scale * PLACE + noise
    )
    u = np.hypot(NOISE_M, reference.u_relative * PLACE)
    emap = replace(base, gx=gx, gy=gy, u_gx=u[0], u_gy=u[1])
    return Member(name, emap, replace(result_of(emap), input={}, reference=reference))


def test_scales_covary_by_certificates_and_differ_by_temperatures():
    lengths = lengths_of(
        [
            length("A 1", 1e-6, 2e-7),
            None,
            length("a1", 1e-6, 2e-7),
            length("B", 0, 3e-7),
        ],
        np.ones(2),
    )
    u_t = (EXPANSION * 0.05) ** 2
    covariance = np.diag([4e-14 + u_t, 0, 4e-14 + u_t, 9e-14 + u_t])
    covariance[0, 2] = covariance[2, 0] = 4e-14
    np.testing.assert_allclose(lengths.differing, covariance)
    weights = np.array([0.3, 0.1, 0.2, 0.4])
    assert lengths.within(weights) == pytest.approx(0.25 * 4e-14 + 0.16 * 9e-14)
    assert lengths.common(weights) == pytest.approx(0.81 * u_t)


@pytest.mark.parametrize(("name", "error"), [("A", 1e-6), ("B", 1e-6), ("", 2e-6)])
def test_a_length_that_all_runs_may_have_does_not_average_out(name, error):
    """Of one certificate, of equal numbers, or without a name."""
    lengths = lengths_of(
        [length("A", 1e-6, 2e-7), length(name, error, 2e-7)], np.ones(2)
    )
    halves = np.full(2, 0.5)
    assert lengths.within(halves) == 0
    assert lengths.common(halves) == pytest.approx(4e-14 + (EXPANSION * 0.05) ** 2)


def test_what_lengths_may_differ_by_is_not_scatter_between_runs():
    """Two runs of a plate known to 2 µm/m, 3 µm/m from one of a better; and thermometers."""
    good, poor = length("A", 0, 1e-7), length("B", 1e-6, 2e-6)
    plates = [run("a", 0, good, 1), run("b", 3e-6, poor, 2), run("c", 3e-6, poor, 3)]
    warmer = [
        run(str(celsius), scale, length("A", 0, 1e-7, celsius), celsius + 20)
        for celsius, scale in ((20, -4e-7), (21, 4e-7), (22, 1e-7))
    ]
    for runs in (plates, warmer):
        found = combine(runs, keep_scale=True)
        assert found.result.verdict.grade is Grade.GOOD
        deviating = found.result.parts.combined.runs
        assert all(one.agrees and one.beyond < 0.1 for one in deviating)
    place = PLACE.ravel()
    of_temperature = (EXPANSION * 0.05) ** 2 + 1e-14
    np.testing.assert_allclose(found.xy.common, of_temperature * place**2, atol=1e-22)
    off = run("d", 4e-6, length("C", 2e-6, 1e-7), 4)
    assert combine([*plates, off], keep_scale=True).result.verdict.enlarged_by
    assert combine(
        [run("a", 4e-6, length("C", 2e-6, 1e-7), 4), run("b", 0, good, 5)],
        keep_scale=True,
    ).result.verdict.enlarged_by


def test_certificates_average_out_by_the_weights_of_their_runs():
    runs = [
        run("a", 0, length("A", 0, 1.0e-6), 1),
        run("b", 1e-6, length("B", 1e-6, 1.2e-6), 2),
        run("c", 1e-6, length("B", 1e-6, 1.2e-6), 3),
    ]
    mean = combine(runs, keep_scale=True).xy
    a, b, c = mean.weights
    of_certificates = (a * 1.0e-6) ** 2 + ((b + c) * 1.2e-6) ** 2
    of_noise = (mean.weights**2).sum() * NOISE_M**2
    expected = of_noise + of_certificates * PLACE.ravel() ** 2
    np.testing.assert_allclose(mean.within, expected, rtol=0.06)  # of the datum


def test_a_run_without_a_length_is_not_of_the_certificate_of_the_others():
    pair = [length("A", 1e-6, 2e-7), length("A", 1e-6, 2e-7)]
    lengths = lengths_of([None, *pair], np.ones(2))
    assert lengths.certificates.shape == (3, 0)
    np.testing.assert_allclose(lengths.one, [0, 2e-7, 2e-7])


def test_a_difference_does_not_contain_the_length_that_both_maps_have():
    """2 µm/m between two maps, by one certificate of 2 µm/m or by two; with correlations or not."""
    by_one, by_another = (length(name, 1e-6, 2e-6) for name in ("A 1", "B"))
    before, after = run("a", 0, by_one, 1), run("b", 2e-6, by_one, 2)
    for certificate, significant in (("a1", True), ("B", False), ("", False)):
        reference = replace(by_one, certificate=certificate)
        result = replace(after.result, reference=reference)
        test = compare(before.result, result, keep_scale=True).xy
        assert test.significant is significant
    assert length_in_both(by_one, replace(by_one, kind="stage_x")) == 0
    assert length_in_both(by_one, by_another) == 0
    with pytest.raises(
        InputError, match="u_relative of the certificate 'A 1' is 3e-06"
    ):
        length_in_both(by_one, length("A 1", 1e-6, 3e-6))


def test_the_variance_between_correlated_runs_is_that_of_what_they_do_not_share():
    """An error common to all runs changes nothing; one of two runs is that of their mean."""
    values = np.array([[-3.0], [1.0], [2.0]])
    alone = variance_between(values, np.full(3, 1.0))
    assert variance_between(values, np.eye(3) + 50.0) == pytest.approx(alone)
    pair = np.eye(3)
    pair[1:, 1:] += 1e9
    assert variance_between(values, pair) == pytest.approx(
        variance_between(values[1:], np.ones(2))
    )
