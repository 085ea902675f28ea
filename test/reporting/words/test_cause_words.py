# SPDX-License-Identifier: Apache-2.0
"""Sentence, size and uncertainty of each cause: lengths in µm, ratios in µm/m, turns in mrad."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.findings import ReadingCause, RotationCause
from selfcal_ros.estimation.terms.columns import Column
from selfcal_ros.estimation.verdict.cause_sizes import cause_of, noise_cause
from selfcal_ros.estimation.verdict.explanations import Explanation
from selfcal_ros.model.verdict import Cause, Remedy
from selfcal_ros.reporting.words.causes import advice, cause_text, remedies, what_it_is

NAMES = ("0", "90", "+x")
MICROSCOPE = ("scale", "turn", "stretch", "shear")


def explanation(name, components, values, u, **more):
    """Return an explanation with equal, independent uncertainties; (view, component) each."""
    columns = tuple(Column(name, view, component, np.inf) for view, component in components)
    return Explanation(name, columns, np.array(values, dtype=float),
                       u**2 * np.eye(len(values)), 1e-6, more.pop("whole", True), 0.0, **more)


def microscope(*values):
    return explanation("microscope", [(-1, part) for part in MICROSCOPE], values, 1e-5)


ALIGN = "align the microscope, or let the stage stop beside the marks on purpose (check_stops)"
CLAMP = "support the plate without strain"


@pytest.mark.parametrize(("found", "text", "size", "u", "unit"), [
    # E o = (scale + i turn) o + (stretch + i shear) conj(o)
    (microscope(0, 2e-3, 0, 0), f"microscope turned by 2.000 ± 0.010 mrad: {ALIGN}", 2e-3, 1e-5,
     "rad"),
    (microscope(5e-3, 0, 0, 0), f"scale of the microscope off by 0.5000 ± 0.0010 %: {ALIGN}", 5e-3,
     1e-5, "m/m"),
    (microscope(0, 0, 1e-3, 0), "scales of the microscope along x and y differ by 0.2000 ± "
     f"0.0020 %: {ALIGN}", 1e-3, 1e-5, "m/m"),
    (microscope(0, 0, 0, 1e-3), "axes of the microscope out of square by 2.000 ± 0.020 mrad: "
     f"{ALIGN}", 1e-3, 1e-5, "rad"),
    # P1 runs from -1 to 1: the range is twice the coefficient
    (explanation("drift", [(1, "x P1"), (1, "y P1"), (2, "x P1"), (2, "y P1")],
                 [1e-9, 0, 0, 25.6e-9], 1e-9), "drift of 0.0512 ± 0.0020 µm along y while view "
     "'+x' was measured: visit the marks there and back", 51.2e-9, 2e-9, "m"),
    (explanation("plate_scale", [(1, ""), (2, "")], [1e-7, -2e-6], 1e-7),
     "plate smaller by 2.00 ± 0.10 µm/m in view '+x' than in view '0': let the plate reach thermal "
     "equilibrium", -2e-6, 1e-7, "m/m"),
    (explanation("plate_scale", [(1, ""), (2, "")], [1e-7, 2e-6], 1e-7),
     "plate larger by 2.00 ± 0.10 µm/m in view '+x' than in view '0': let the plate reach thermal "
     "equilibrium", 2e-6, 1e-7, "m/m"),
    (explanation("plate_strain", [(1, "scale"), (1, "stretch"), (1, "shear")],
                 [1e-7, -3e-6, 0], 1e-7),
     "plate strained along x against y by -3.00 ± 0.10 µm/m in view '90' against view '0': "
     f"{CLAMP}",
     -3e-6, 1e-7, "m/m"),
    (explanation("plate_shape", [(1, "x x2"), (1, "y x2")], [3e-8, 0], 1.5e-9),
     "plate bent by 0.0300 ± 0.0015 µm at the middle of an edge in view '90' against view '0': "
     f"{CLAMP}", 3e-8, 1.5e-9, "m"),
    (explanation("plate_shape", [(1, "x x2")], [-3e-8], 1.5e-9, whole=False),
     "plate bent by 0.0300 ± 0.0015 µm at the middle of an edge in view '90' against view '0', "
     f"part of which cannot be separated from the stage: {CLAMP}", -3e-8, 1.5e-9, "m"),
    (explanation("approach", [(-1, "x"), (-1, "y")], [0, 2e-8], 1e-9),
     "indicated y differs by ±(0.0200 ± 0.0010 µm) with the direction of approach: arrive from "
     "one side", 2e-8, 1e-9, "m"),
    # 3 and 4 make 5
    (explanation("line_eccentricity", [(0, "cos"), (0, "sin"), (1, "cos"), (1, "sin")],
                 [1e-7, 0, 3e-6, -4e-6], 1e-7),
     "circle of lines off the axis by 5.00 ± 0.10 µrad of its radius in view '90': centre the "
     "circle of lines on the axis of rotation in each view", 5e-6, 1e-7, "rad"),
    # a rotation is in units of what it does at the half width, 0.05 m
    (explanation("slip", [(1, "x"), (1, "y"), (1, "phi")], [3e-7, -4e-7, 5e-8], 1e-8, part=0.4),
     "the plate slipped by (0.3, -0.4) µm and 1 µrad after about 40% of view '90': measure the "
     "view again, or solve with --robust", 5e-7, 1e-8, "m"),
    (explanation("reading", [(2, "x"), (2, "y")], [-3e-7, 4e-7], 1e-8, mark=(-2, 5)),
     "a reading of mark (-2, 5) in view '+x' that is off by 0.500 ± 0.010 µm: solve with --robust, "
     "or measure it again", 5e-7, 1e-8, "m")])
def test_a_cause_in_words(found, text, size, u, unit):
    cause = cause_of(found, NAMES, 0.05)
    assert (cause.name, cause_text(cause), cause.unit, cause.p) == (found.name, text, unit, 1e-6)
    assert (cause.size, cause.u) == pytest.approx((size, u), rel=1e-12)


@pytest.mark.parametrize(("what", "text"), [
    (ReadingCause("90", (7,)), "a reading of line 7 in view '90' that is off by -2.00 ± 0.10 "
     "arcsec: solve with --robust, or measure it again"),
    (RotationCause("90"), "lines of view '90' turned by -2.00 ± 0.10 arcsec against its marks: "
     "check whether the plate moved between marks and lines, and the sign of the lines' offsets")])
def test_angles_in_words(what, text):
    arcsec = np.pi / 648_000
    name = "reading" if isinstance(what, ReadingCause) else "rotation"
    assert cause_text(Cause(name, "", -2 * arcsec, 0.1 * arcsec, "rad", 1e-6, what)) == text


def test_a_noisy_view_in_words():
    cause = noise_cause("90", 3.1415, 0.2, 1e-4)
    assert cause_text(cause) == ("view '90' is 3.14 times as noisy as the others: measure the "
                                 "view again, and look for a source of vibration")
    assert (cause.name, cause.size, cause.u, cause.unit, cause.p) == (
        "noise", 3.1415, 0.2, "m/m", 1e-4)


def test_a_remedy_that_was_tried_comes_first_and_a_view_is_for_programs():
    found = explanation("drift", [(1, "x P1")], [1e-8], 1e-9)
    tried = (Remedy("model", "drift:2e-08"), Remedy("view", "90"))
    cause = replace(cause_of(found, NAMES, 0.05), remedies=tried)
    assert cause_text(cause) == (
        "drift of 0.0200 ± 0.0020 µm along x while view '90' was measured: solve with --model "
        "drift:2e-08, or visit the marks there and back")
    assert remedies(cause) == (*tried, Remedy("action", "visit the marks there and back"))


def test_what_a_cause_is_stays_whole_whatever_its_view_is_called():
    found = explanation("drift", [(1, "x P1")], [1e-8], 1e-9)
    cause = cause_of(found, ("0", "run 2: shift x"), 0.05)
    saved = replace(cause, text=cause_text(cause), remedies=remedies(cause), what=None)
    assert what_it_is(saved) == what_it_is(cause)
    assert what_it_is(saved).endswith("while view 'run 2: shift x' was measured")
    assert advice(saved) == "visit the marks there and back"
