# SPDX-License-Identifier: Apache-2.0
"""A recheck with a reference length: the plate expands, and its temperature is known or not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from selfcal_ros.applications.standards.statements import is_traceable, scale_texts
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.recheck.plate import known_plate
from selfcal_ros.estimation.recheck.solve import recheck
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.reference import ReferenceKind, ReferenceLength
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.reporting.words.findings import worded
from test.support.lattice_plans import plan_of
from test.support.truth import random_truth, simulate_measurements

PLAN = plan_of("0,90,tx", Artifact(5, 0.01))
EXPANSION, U_EXPANSION, U_KELVIN = 8e-6, 4e-7, 0.05
LENGTH, U_LENGTH = 2e-6, 2e-7
STAGES = 8


def of_length(truth, scale):
    """Return the truth with a plate of this relative length."""
    m = PLAN.artifact.x_m + 1j * PLAN.artifact.y_m
    plate = truth.a[0] + 1j * truth.a[1]
    own = np.real(np.vdot(m, plate)) / np.vdot(m, m).real
    plate = plate + (scale - own) * m
    return replace(truth, a=np.stack([plate.real, plate.imag]))


def session(seed, warmer, *, told=True, sense=Sense.MICROSCOPE_MOVES):
    """Return a recheck of a plate that is now warmer, K, and the true error of the stage."""
    rng = np.random.default_rng(seed)
    expansion = EXPANSION + U_EXPANSION * rng.normal()
    length, truth = (
        LENGTH + U_LENGTH * rng.normal(),
        random_truth(PLAN.artifact, 3, rng),
    )

    def shown(celsius):
        read = celsius + U_KELVIN * rng.normal()
        return f"{read}:{U_KELVIN}:{EXPANSION}:{U_EXPANSION}"

    reference = ReferenceLength(
        ReferenceKind.ARTIFACT, LENGTH, U_LENGTH, "C 1"
    ).at_temperature(shown(20.4))
    cold, warm = (
        of_length(truth, length + expansion * (kelvin + 0.4)) for kelvin in (0, warmer)
    )
    of_plate = simulate_measurements(cold, PLAN, rng, sigma_m=2e-8, sense=sense)
    before = worded(calibrate(of_plate, Options(reference=reference, causes=False)))
    view = replace(PLAN, plan_id="again", views=PLAN.views[:1])
    plate = known_plate(before, "before.json", shown(20.4 + warmer) if told else "")
    again = simulate_measurements(warm, view, rng, sigma_m=2e-8, sense=sense)
    return recheck(
        again, Options(terms=parse_terms(["plate_shape:0"], "")), plate
    ), truth


@pytest.mark.parametrize(
    ("warmer", "told", "sense"),
    [
        (1.0, True, Sense.MICROSCOPE_MOVES),
        (-1.0, True, Sense.PLATE_MOVES),
        (1.0, False, Sense.MICROSCOPE_MOVES),
    ],
)
def test_a_recheck_of_a_warmer_plate_is_within_its_u(warmer, told, sense):
    """The scale is part of the map only if the temperature is known."""
    ratios, scales = [], []
    for seed in range(STAGES):
        result, truth = session(seed, warmer, told=told, sense=sense)
        emap = result.error_map
        modes = datum_modes(PLAN.artifact, scale=True)
        error = remove_modes(
            np.stack([emap.gx, emap.gy]) - truth.g, modes[: 3 if told else 4]
        )
        ratios.append(error / np.stack([emap.u_gx, emap.u_gy]))
        scales.append(result.recheck.scale.p)
        assert (result.reference is not None) is told is is_traceable(result)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.12)
    changed = sum(p < 0.05 for p in scales)
    assert changed <= binom.ppf(0.999, STAGES, 0.05) if told else changed == STAGES


def test_a_stage_that_has_grown_as_its_plate_is_not_called_still_good():
    """3 K, both 8 µm/m/K: its map, which has a scale, is 24 µm/m off, and nothing differs."""
    readings, again = (
        simulate_measurements(
            random_truth(PLAN.artifact, 3, np.random.default_rng(1)),
            plan,
            np.random.default_rng(seed),
            sigma_m=2e-8,
        )
        for seed, plan in enumerate((PLAN, replace(PLAN, views=PLAN.views[:1])))
    )
    length = ReferenceLength(ReferenceKind.ARTIFACT, LENGTH, U_LENGTH, "C 1")
    for reference, remedy in (
        (length.at_temperature("20.4:0.05:8e-6:4e-7"), "(--reference-at)"),
        (length, "calibrate with --reference"),
        (None, None),
    ):
        before = calibrate(readings, Options(reference=reference, causes=False))
        now = worded(recheck(again, Options(), known_plate(worded(before), "r.json")))
        (warning,) = now.warnings or (None,)
        still = "Still good, but for its scale, not compared: no change since r.json"
        assert now.verdict.sentence.startswith(still) is (remedy is not None)
        assert warning is remedy or remedy in warning
        why = scale_texts(now)[0]
        assert ("known plate in this measurement was not stated" in why) is bool(remedy)


def test_what_was_converted_is_stated():
    told, _ = session(1, 0.5)
    assert told.reference.certified.temperature_c == pytest.approx(20.9, abs=0.2)
    assert "converted to the temperature of this measurement" in scale_texts(told)[0]
    by_kind = {line.component: line for line in told.budget}
    assert (
        by_kind["plate temperature"].kind == "B" and by_kind["plate temperature"].u > 0
    )
    [convention] = scale_texts(session(1, 0.5, told=False)[0])
    assert (
        "the temperature of the known plate in this measurement was not stated"
        in convention
    )


def test_a_temperature_that_has_nothing_to_convert_is_refused():
    readings = simulate_measurements(
        random_truth(PLAN.artifact, 3, np.random.default_rng(1)),
        PLAN,
        np.random.default_rng(2),
        sigma_m=2e-8,
    )
    certified = ReferenceLength(ReferenceKind.ARTIFACT, LENGTH, U_LENGTH, "C 1")
    axis = ReferenceLength(ReferenceKind.STAGE_X, LENGTH, U_LENGTH, "C 1")
    text = "20.4:0.05:8e-6:4e-7"
    for reference in (None, certified, axis.at_temperature(text)):
        result = worded(calibrate(readings, Options(reference=reference, causes=False)))
        with pytest.raises(
            InputError, match="r has no reference length of its plate with the"
        ):
            known_plate(result, "r", text)
    result = worded(
        calibrate(
            readings, Options(reference=certified.at_temperature(text), causes=False)
        )
    )
    with pytest.raises(
        InputError, match="expansion_per_k is 5e-07, and 8e-06 in r; change the"
    ):
        known_plate(result, "r", "20.4:0.05:5e-7:4e-7")
