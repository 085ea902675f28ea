# SPDX-License-Identifier: Apache-2.0
"""How much of the field must be determined, and predictions with unequal repeats."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.estimation.observability.plan_check import predict
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import subset
from test.support.lattice_plans import plan_of
from test.support.truth import hu_plan, random_truth, simulate_measurements

FIELD = Artifact(11, 0.01, 0)


def with_marks(keep):
    plan, rng = plan_of("0,90,tx", FIELD), np.random.default_rng(0)
    data = simulate_measurements(random_truth(FIELD, 3, rng), plan, rng)
    views = tuple(
        subset(view, keep(view.m, view.n), np.zeros(0, dtype=bool))
        for view in data.views
    )
    return replace(data, views=views)


@pytest.mark.parametrize(("half", "determined"), [(3, False), (4, True)])
def test_half_of_the_field_must_be_determined(half, determined):
    """Marks within a square of 7 x 7 (about 0.4 of 121 sites), and of 9 x 9 (about 0.7)."""
    data = with_marks(lambda m, n: np.maximum(abs(m), abs(n)) <= half)
    if determined:
        found = calibrate(data, Options(uncertainty=False)).error_map
        assert 0.6 < np.isfinite(found.gx).mean() < 0.8
        return
    with pytest.raises(NotIdentifiableError) as refused:
        calibrate(data)
    advice = refused.value.observability.advice[0]
    assert advice.name == "marks_missing" and 0.4 * 121 < advice.sites < 0.5 * 121


def dense_theta(turns, repeats, free, k):
    """Return var(Gtheta) with a zero mean; the rotations of the views in `free` are unknown."""
    rows, weights = [], []
    for v, (turn, count) in enumerate(zip(turns, repeats, strict=True)):
        for line in range(k):
            row = np.zeros(2 * k + len(free))
            row[(line + turn) % k] = row[k + line] = 1
            if v in free:
                row[2 * k + free.index(v)] = 1
            rows.append(row)
            weights.append(count)
    cov = np.linalg.pinv(np.array(rows).T @ (np.array(weights)[:, None] * rows))[:k, :k]
    centre = np.eye(k) - 1 / k
    return np.diag(centre @ cov @ centre)


@pytest.mark.parametrize("repeats", [(1, 1, 1, 1), (1, 2, 5, 3), (4, 3, 2, 3)])
def test_the_prediction_for_lines_counts_the_repeats_of_each_view(repeats):
    plan = hu_plan(Artifact(5, 0.01, 12))
    views = tuple(
        replace(v, repeats=n) for v, n in zip(plan.views, repeats, strict=True)
    )
    system = planned_system(plan.artifact, views)
    found = predict(system, plan.artifact, ThetaDatum.ZERO_MEAN).u_theta ** 2
    wanted = dense_theta([0, 3, 1, 0], repeats, [2], 12)
    assert found == pytest.approx(wanted, rel=1e-9)
    as_unit = predict(system, plan.artifact, ThetaDatum.ZERO_MEAN, repeats=min(repeats))
    assert as_unit.u_theta**2 == pytest.approx(min(repeats) * wanted, rel=1e-9)


def test_the_prediction_for_marks_counts_the_repeats_of_each_view():
    """Twice the repeats in every view halve the variance; in one view less than that."""
    plan = plan_of("0,90,tx", Artifact(5, 0.01, 0, 7))

    def of(*repeats):
        views = tuple(
            replace(v, repeats=n) for v, n in zip(plan.views, repeats, strict=True)
        )
        found = predict(
            planned_system(plan.artifact, views), plan.artifact, ThetaDatum.ZERO_MEAN
        )
        assert found.u_theta.shape == (0,)  # a plate without lines
        return found.u_xy[0][np.isfinite(found.u_xy[0])] ** 2

    once, twice, one_more = of(1, 1, 1), of(2, 2, 2), of(1, 1, 2)
    assert len(once) > 20 and twice == pytest.approx(once / 2, rel=1e-9)
    assert (one_more < once * (1 + 1e-9)).all() and (one_more > twice).all()
