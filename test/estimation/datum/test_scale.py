# SPDX-License-Identifier: Apache-2.0
"""The scale's dependence on a solution is that of the scale itself, sign and all."""

import numpy as np
import pytest

from selfcal_ros.estimation.datum.covariance import scale_of, scale_rows
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.reference import ReferenceKind
from test.support.lattice_plans import plan_of
from test.support.options import reference_length

HALF_M = 0.03
PLAN = plan_of("0,90,tx,270-2tx+ty", Artifact(7, 0.01, 0, 5))


def in_datum(system, field, parameters):
    """Return map, misalignments and plate in their datum, as a solution gets there."""
    parts = system.gauge.coefficients(field)
    field = system.gauge.remove(field, parts)
    parameters = parameters - parts @ system.rigid[:4]
    plate, _ = system.grid.plate(np.zeros(system.grid.weight.shape), field, parameters)
    return field, system.plate_gauge.remove(
        plate, system.plate_gauge.coefficients(plate)
    )


@pytest.mark.parametrize("kind", ReferenceKind)
def test_the_rows_give_the_change_of_the_scale(kind):
    """Of the maps of a random solution whose readings are all zero, in their datum."""
    system, rng = planned_system(PLAN.artifact, PLAN.views), np.random.default_rng(4)
    reference = reference_length(kind, 3e-6, 5e-7)
    sites, marks = scale_rows(system, reference)
    none = np.zeros(system.grid.views.shape, dtype=complex)
    start = scale_of(system, reference, field=none, plate=none, half_width_m=HALF_M)
    assert start == pytest.approx((-1 if kind.of_plate else 1) * 3e-6 * HALF_M)
    for _ in range(3):
        raw = rng.normal(size=none.shape) + 1j * rng.normal(size=none.shape)
        raw, parameters = raw * 1e-7, rng.normal(size=system.size) * 1e-7
        field, plate = in_datum(system, raw, parameters)
        found = scale_of(
            system, reference, field=field, plate=plate, half_width_m=HALF_M
        )
        change = (np.vdot(sites, field.ravel()) + np.vdot(marks, plate.ravel())).real
        assert abs(change) > 1e-12
        assert found - start == pytest.approx(change, rel=1e-6)


def test_a_longer_plate_and_an_axis_that_indicates_too_much_turn_the_scale_the_right_way():
    """A plate that is e longer than nominal has A = +e z; an axis that indicates e too much, G."""
    system = planned_system(PLAN.artifact, PLAN.views)
    z, none = system.grid.views.z, np.zeros(system.grid.views.shape, dtype=complex)
    for kind in (ReferenceKind.ARTIFACT, ReferenceKind.MARKS):
        plate = reference_length(kind, 2e-6)
        assert scale_of(
            system, plate, field=none, plate=2e-6 * HALF_M * z, half_width_m=HALF_M
        ) == pytest.approx(0.0, abs=1e-18)
    axis = reference_length(ReferenceKind.STAGE_Y, 2e-6)
    only_y = 1j * 2e-6 * HALF_M * z.imag
    assert scale_of(
        system, axis, field=only_y, plate=none, half_width_m=HALF_M
    ) == pytest.approx(0.0, abs=1e-18)
    assert scale_of(
        system, axis, field=2e-6 * HALF_M * z.real, plate=none, half_width_m=HALF_M
    ) == pytest.approx(2e-6 * HALF_M)
