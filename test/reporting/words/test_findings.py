# SPDX-License-Identifier: Apache-2.0
"""Every finding has its sentence, with its numbers in the units in which people read them."""

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.blocks import BUILT_IN
from selfcal_ros.estimation.terms.columns import Column
from selfcal_ros.estimation.verdict.causes import Explanation, cause_of
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.findings import (
    AxesNotMet,
    Cause,
    CauseDetails,
    DrawnUncertainty,
    Finding,
    FiniteRotation,
    InWords,
    Magnification,
    NoiseContradicted,
    NoiseUnknown,
    NoisyView,
    NoOffsets,
    NotIdentified,
    NoUncertainty,
    OutlierRemoved,
    OutliersGivenUp,
    OutliersKept,
    OutliersRemoved,
    OwnTermsUnknown,
    PlateHardlyMoved,
    PredictionFailed,
    ReferenceOff,
    Remedy,
    RestNotIdentified,
    ScaleNotCompared,
    SlipBefore,
    SlipFound,
    SlipsGivenUp,
    TakenForSlip,
    TooManyOutliers,
    Unchecked,
)
from selfcal_ros.model.result import Noise, result_from_dict, result_to_dict
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.reporting.words.findings import (
    _ACTIONS,
    _CAUSES,
    FIXED,
    advice,
    remedies,
    sentence_of,
    what_it_is,
    worded,
    worded_verdict,
)
from selfcal_ros.reporting.words.observability import FIXED as FIXED_MODES
from selfcal_ros.reporting.words.observability import mode_text
from selfcal_ros.reporting.words.quantities import unit_of
from test.support.maps import random_map, result_of
from test.support.sources import PACKAGE

ARCSEC_RAD = math.pi / 648_000
NAMES = ("0", "90", "+x")
GROUND = SimpleNamespace(names_of=lambda term: NAMES, names=NAMES, half_width_m=0.05)
MICROSCOPE = ("scale", "turn", "stretch", "shear")
ALIGN = "align the microscope, or have the stage stop next to the marks deliberately (check_stops)"
CLAMP = "support the plate without strain"
UNTESTED = Noise(1e-8, 1e-6)
TESTED = Noise(1e-8, 1e-6, p_theta=0.4)


def explanation(name, components, values, u, **more):
    """Return an explanation with equal, independent uncertainties; (view, component) each."""
    columns = tuple(
        Column(name, view, component, np.inf) for view, component in components
    )
    return Explanation(
        name,
        columns,
        np.array(values, dtype=float),
        u**2 * np.eye(len(values)),
        1e-6,
        more.pop("determined", True),
        0.0,
        **more,
    )


def microscope(*values):
    return explanation("microscope", [(-1, part) for part in MICROSCOPE], values, 1e-5)


def strained(part, size):
    values = [size * (part == one) for one in ("scale", "stretch", "shear")]
    return explanation(
        "plate_strain", [(1, "scale"), (1, "stretch"), (1, "shear")], values, 1e-7
    )


@pytest.mark.parametrize(
    ("found", "text", "size", "u", "unit"),
    [
        # E o = (scale + i turn) o + (stretch + i shear) conj(o)
        *(
            (
                microscope(0, sign * 2e-3, 0, 0),
                f"a microscope turned {way} by 2.000 ± 0.010 mrad: {ALIGN}",
                sign * 2e-3,
                1e-5,
                "rad",
            )
            for sign, way in ((1, "counter-clockwise"), (-1, "clockwise"))
        ),
        # (1 + E) of what is seen is true
        *(
            (
                microscope(sign * 5e-3, 0, 0, 0),
                f"a microscope that shows lengths too {what} by 0.5000 ± 0.0010 %: {ALIGN}",
                sign * 5e-3,
                1e-5,
                "m/m",
            )
            for sign, what in ((1, "short"), (-1, "long"))
        ),
        *(
            (
                microscope(0, 0, sign * 1e-3, 0),
                f"a microscope that shows lengths along x {what} than along y by "
                f"0.2000 ± 0.0020 %: {ALIGN}",
                sign * 1e-3,
                1e-5,
                "m/m",
            )
            for sign, what in ((1, "shorter"), (-1, "longer"))
        ),
        (
            microscope(0, 0, 0, 1e-3),
            f"microscope axes out of square by 2.000 ± 0.020 mrad: {ALIGN}",
            1e-3,
            1e-5,
            "rad",
        ),
        # P1 runs from -1 to 1: the range is twice the coefficient
        (
            explanation(
                "drift",
                [(1, "x P1"), (1, "y P1"), (2, "x P1"), (2, "y P1")],
                [1e-9, 0, 0, 25.6e-9],
                1e-9,
            ),
            "a drift of 0.0512 ± 0.0020 µm along y during view '+x': visit the marks "
            "there and back",
            51.2e-9,
            2e-9,
            "m",
        ),
        (
            explanation("plate_scale", [(1, ""), (2, "")], [1e-7, -2e-6], 1e-7),
            "a plate smaller by 2.00 ± 0.10 µm/m in view '+x' than in view '0': let "
            "the plate reach thermal equilibrium",
            -2e-6,
            1e-7,
            "m/m",
        ),
        (
            explanation("plate_scale", [(1, ""), (2, "")], [1e-7, 2e-6], 1e-7),
            "a plate larger by 2.00 ± 0.10 µm/m in view '+x' than in view '0': let the plate reach "
            "thermal equilibrium",
            2e-6,
            1e-7,
            "m/m",
        ),
        *(
            (
                strained(part, size),
                f"a plate {how} by 3.00 ± 0.10 µm/m in view '90' relative to view '0': {CLAMP}",
                size,
                1e-7,
                "m/m",
            )
            for part, size, how in (
                ("scale", 3e-6, "enlarged"),
                ("scale", -3e-6, "shrunk"),
                # V = b z + (a + ih) z*
                ("stretch", 3e-6, "stretched along x and compressed along y"),
                ("stretch", -3e-6, "stretched along y and compressed along x"),
                (
                    "shear",
                    3e-6,
                    "stretched along its diagonal at 45° and compressed along the other",
                ),
                (
                    "shear",
                    -3e-6,
                    "stretched along its diagonal at 135° and compressed along the other",
                ),
            )
        ),
        (
            explanation("plate_shape", [(1, "x x2"), (1, "y x2")], [3e-8, 0], 1.5e-9),
            "a plate bent by 0.0300 ± 0.0015 µm at the middle of an edge in view '90' "
            f"relative to view '0': {CLAMP}",
            3e-8,
            1.5e-9,
            "m",
        ),
        (
            explanation(
                "plate_shape", [(1, "x x2")], [-3e-8], 1.5e-9, determined=False
            ),
            "a plate bent by 0.0300 ± 0.0015 µm at the middle of an edge in view '90' "
            "relative to view '0', part of which cannot be separated from the stage: "
            f"{CLAMP}",
            -3e-8,
            1.5e-9,
            "m",
        ),
        (
            explanation("approach", [(-1, "x"), (-1, "y")], [0, 2e-8], 1e-9),
            "an indicated y that changes by ±(0.0200 ± 0.0010 µm) with the direction of approach: "
            "approach each mark from the same side",
            2e-8,
            1e-9,
            "m",
        ),
        # 3 and 4 make 5
        (
            explanation(
                "line_eccentricity",
                [(0, "cos"), (0, "sin"), (1, "cos"), (1, "sin")],
                [1e-7, 0, 3e-6, -4e-6],
                1e-7,
            ),
            "a circle of lines off the axis of rotation by 5.00 ± 0.10 µrad of its "
            "radius in view '90': centre the circle of lines on the axis of rotation "
            "in each view",
            5e-6,
            1e-7,
            "rad",
        ),
        # a rotation is in units of what it does at the half width, 0.05 m
        (
            explanation(
                "slip",
                [(1, "x"), (1, "y"), (1, "phi")],
                [3e-7, -4e-7, 5e-8],
                1e-8,
                share_before=0.4,
            ),
            "a plate that slipped by (0.3, -0.4) µm and 1 µrad after "
            "about 40 % of view '90': measure the "
            "view again, or solve with --robust",
            5e-7,
            1e-8,
            "m",
        ),
        (
            explanation(
                "reading", [(2, "x"), (2, "y")], [-3e-7, 4e-7], 1e-8, mark=(-2, 5)
            ),
            "a reading of mark (-2, 5) in view '+x' that is off by 0.500 ± 0.010 µm: "
            "solve with --robust, or measure it again",
            5e-7,
            1e-8,
            "m",
        ),
    ],
)
def test_a_cause_in_words(found, text, size, u, unit):
    cause = cause_of(found, GROUND)
    assert (cause.name, sentence_of(cause), cause.unit, cause.p) == (
        found.name,
        text,
        unit,
        1e-6,
    )
    assert (cause.size, cause.u) == pytest.approx((size, u), rel=1e-12)


def test_after_a_robust_solution_none_is_advised_anew():
    for name, action in (
        ("slip", "measure the view again"),
        ("reading", "measure it again"),
    ):
        cause = Cause(
            name=name, size=1e-6, u=0.0, unit="m", details=CauseDetails(robust=True)
        )
        assert advice(cause) == action
        assert "--robust" in advice(replace(cause, details=CauseDetails()))


TURN = Cause(
    name="microscope",
    size=2e-3,
    u=1e-5,
    unit="rad",
    p=1e-6,
    details=CauseDetails(part="turn"),
)
SCALE = Cause(
    name="microscope",
    size=0.06,
    u=1e-3,
    unit="m/m",
    p=1e-6,
    details=CauseDetails(part="scale", either=True),
)
COMPARE = "compare the offset of a line at two angles of the rotary axis"
CAUSES = [
    *(
        (
            replace(
                SCALE, name="line_scale", size=size, details=CauseDetails(part="scale")
            ),
            f"offsets of the lines too {how} by 5.00 ± 0.10 %: {COMPARE}",
        )
        for size, how in ((0.05, "small"), (-0.05, "large"))
    ),
    *(
        (
            replace(SCALE, name="line_scale", size=size),
            f"offsets of the lines too {how} by 6.00 ± 0.10 %, or a microscope that "
            f"shows lengths too {other} by as much: {COMPARE}",
        )
        for size, how, other in ((0.06, "small", "long"), (-0.06, "large", "short"))
    ),
    *(
        (
            replace(SCALE, size=size),
            f"a microscope that shows lengths too {how} by 6.00 ± 0.10 %, or offsets "
            f"of the lines too {other} by as much: {ALIGN}",
        )
        for size, how, other in ((0.06, "short", "large"), (-0.06, "long", "small"))
    ),
    (
        Cause(
            name="reading",
            size=-2 * ARCSEC_RAD,
            u=0.1 * ARCSEC_RAD,
            unit="rad",
            p=1e-6,
            view="90",
            mark=(7,),
        ),
        "a reading of line 7 in view '90' that is off by 2.00 ± 0.10 arcsec: solve "
        "with --robust, or measure it again",
    ),
    *(
        (
            Cause(
                name="rotation",
                size=sign * 2 * ARCSEC_RAD,
                u=0.1 * ARCSEC_RAD,
                unit="rad",
                p=1e-6,
                view="90",
            ),
            f"lines turned {way} by 2.00 ± 0.10 arcsec relative to the marks in view '90': check "
            "whether the plate moved between marks and lines, and the sign of the lines' offsets",
        )
        for sign, way in ((1, "counter-clockwise"), (-1, "clockwise"))
    ),
    (
        Cause(name="noise", size=3.1415, u=0.2, unit="m/m", p=1e-4, view="90"),
        "3.14 times as much noise in view '90' as in the others: measure the view again, and look "
        "for a source of vibration",
    ),
    (
        Cause(
            name="off_sites",
            size=2e-8,
            u=1e-9,
            unit="m",
            p=1e-6,
            details=CauseDetails(away=4.1e-4),
        ),
        "a stage that stood 0.41 mm off the sites, where its error differs by 0.0200 ± 0.0010 µm: "
        "place the plate closer to its nominal pose, send the stage to the sites, or correct "
        "the stage by this map and measure again",
    ),
    *(
        (
            replace(TURN, details=CauseDetails(given=given)),
            f"a term 'microscope' as large as 2 mrad, {times} times the size assumed: {ALIGN}",
        )
        for given, times in ((1e-6, "2000"), (8e-4, "2.5"))
    ),
    (
        Cause(
            name="plate_strain",
            size=2e-6,
            u=1e-7,
            unit="m/m",
            p=1e-6,
            view="90",
            details=CauseDetails(given=1e-6),
        ),
        f"a term 'plate_strain' as large as 2 µm/m in view '90', 2 times the size assumed: {CLAMP}",
    ),
]


def noise(size, stated, unit, *, declared):
    return NoiseContradicted(size=size, unit=unit, stated=stated, declared=declared)


def slip(places, *, spoils, y=-4e-7, phi=5e-6):
    return SlipFound(
        size=5e-7,
        unit="m",
        view="90",
        places=tuple(SlipBefore(*place) for place in places),
        x=3e-7,
        y=y,
        phi=phi,
        spoils=spoils,
    )


def outliers(number, first):
    return OutliersRemoved(
        number=number, first=tuple(OutlierRemoved(*reading) for reading in first)
    )


def unchecked(sites, lines=()):
    return Unchecked(sites=sites, lines=lines)


FINDINGS = [
    (NotIdentified(), "the readings do not identify the stage"),
    (
        noise(4e-8, 2e-8, "m", declared=False),
        "grid readings: residuals show a noise of 0.04 µm, repeats 0.02 µm; the readings contain "
        "something other than random noise",
    ),
    (
        noise(ARCSEC_RAD, 2 * ARCSEC_RAD, "rad", declared=True),
        "angular readings: residuals show a noise of 1 arcsec, the detections' own sigma 2 arcsec; "
        "repeats share what single readings do not (drift between passes), or the stated noise is "
        "too large",
    ),
    (
        NoOffsets(),
        "all offsets of marks are 0: if the stage was driven until each mark was centred, say so "
        "(--microscope 0.01); if not, the detector measures nothing, and the map is that of the "
        "stage's targets",
    ),
    (
        NoiseUnknown(),
        "grid readings: neither repeats nor residuals determine the noise, so the "
        "uncertainty is not known; read every mark twice",
    ),
    (
        FiniteRotation(size=5.126e-3, unit="rad", residuals=2.04e-8),
        "the model is linear, but the plate was turned by up to 5.13 mrad: leave out "
        "--misalignment linear (or --method law); solved jointly with finite "
        "rotations, the default, the readings leave 0.0204 µm",
    ),
    (
        AxesNotMet(size=3 * ARCSEC_RAD, unit="rad", p=0.0012),
        "theta: the stage does not satisfy the axis conditions of the datum xy_axes (misclosure 3 "
        "arcsec, p = 0.0012); use zero_mean",
    ),
    (
        PredictionFailed(size=3.456, view="ty", tenth=0, limit=1.2),
        "view 'ty' is predicted with 3.46 times the noise, beyond the limit of 1.20",
    ),
    (
        PredictionFailed(size=3.456, tenth=2, limit=1.2),
        "a random tenth (2) is predicted with 3.46 times the noise, beyond the limit of 1.20",
    ),
    (
        ScaleNotCompared(of="stage/before.json", certified=True),
        "the scale of before.json was not compared: a stage that has grown as the plate has looks "
        "unchanged; name the temperature of the plate in this measurement (--reference-at)",
    ),
    (
        ScaleNotCompared(of="before.json", certified=False),
        "the scale of before.json was not compared: a stage that has grown as the plate has looks "
        "unchanged; calibrate with --reference and --reference-at of the plate",
    ),
    (
        NoUncertainty(),
        "no uncertainty map, because of the size of the field: ask for it (--uncertainty always)",
    ),
    (
        unchecked([(5, -3)]),
        "1 site (5, -3) of the map rests on a single reading that no other checks; an error in it "
        "goes into the map, and no residual shows it: measure the missing marks, or add a view",
    ),
    (
        unchecked([(m, 5) for m in range(7)], [4, 11]),
        "7 sites ((0, 5), (1, 5), (2, 5), (3, 5), (4, 5) and 2 more) and 2 lines (4, "
        "11) of the map rest on single readings that no other checks; an error in "
        "them goes into the map, and no residual shows it: measure the missing marks, "
        "or add a view",
    ),
    (
        PlateHardlyMoved(view="90", against="0", size=3e-7, unit="m"),
        "view '90': the plate lies within 0.3 µm of where it lay in view '0', and shows no errors "
        "of its own: if it was not placed anew, its errors are in the map; place it some µm "
        "elsewhere",
    ),
    (
        unchecked([], [4]),
        "1 line 4 of the map rests on a single reading that no other checks; an error in it goes "
        "into the map, and no residual shows it: measure the missing marks, or add a view",
    ),
    *(
        (
            Magnification(size=sign * 2e-3, u=1e-5, unit="m/m"),
            f"the encoders indicate the plate {word} than nominal by 2000 ± 10 µm/m, "
            "more than plate and encoders should differ: check the pitch in the plan "
            "(grid_pitch), and the scale of the encoders",
        )
        for sign, word in ((1, "larger"), (-1, "smaller"))
    ),
    *(
        (
            ReferenceOff(size=sign * 2e-3, u=1e-5, unit="m/m"),
            f"by the reference length the encoders indicate lengths {word} than they "
            "are by 2000 ± 10 µm/m, more than encoders should: check its error and "
            "the unit of that (relative, not µm/m), and the pitch in the plan "
            "(grid_pitch)",
        )
        for sign, word in ((1, "longer"), (-1, "shorter"))
    ),
    (
        DrawnUncertainty(draws=200),
        "uncertainties of Hu's law from 200 draws of unit noise: 5.0 % standard error",
    ),
    (
        outliers(2, [("90", "grid", (0, -2), 5.04), ("a", "angular", (7,), 9.0)]),
        "removed 2 outliers: '90' grid (0, -2) (5.0 sigma), 'a' angular 7 (9.0 sigma)",
    ),
    (
        outliers(3, [("90", "grid", (0, -2), 5.04), ("90", "grid", (1, -2), 6.04)]),
        "removed 3 outliers: '90' grid (0, -2) (5.0 sigma), '90' grid (1, -2) (6.0 "
        "sigma) and 1 more",
    ),
    (
        outliers(1, [("90", "grid", (0, -2), 5.04)]),
        "removed 1 outlier: '90' grid (0, -2) (5.0 sigma)",
    ),
    (
        NoisyView(size=2.26, view="90"),
        "view '90' is 2.3 times as noisy as the others: measure it again",
    ),
    (
        TooManyOutliers(limit=0.1),
        "more than 10 % of the readings contradict the others: none was removed; look for a wrong "
        "plan or a faulty view",
    ),
    (OutliersKept(), "removing more outliers would leave the stage undetermined"),
    (
        OutliersGivenUp(rounds=60),
        "gave up on outliers after 60 rounds: the readings seem to contain more; look for a wrong "
        "plan or a faulty view",
    ),
    (
        slip([("90", "m", 2)], spoils=False),
        "view '90': the plate slipped before m = 2 by (0.3, -0.4) µm and 5 µrad; treated as two "
        "placements",
    ),
    (
        slip([("90", "m", 2)], spoils=True),
        "view '90': the plate slipped before m = 2 by (0.3, -0.4) µm and 5 µrad; treated as two "
        "placements; this spoils the map: measure the view again",
    ),
    (
        slip([("90", "m", 2), ("+x", "n", 0)], spoils=False, y=0.0, phi=0.0),
        "view '90': the plate slipped by about (0.3, 0) µm and 0 µrad, before m = 2 "
        "or before n = 0 in view '+x'; the readings do not determine which; the view "
        "is left out",
    ),
    (
        slip([("90", "m", 2), ("90", "n", 0)], spoils=True),
        "view '90': the plate slipped by about (0.3, -0.4) µm and 5 µrad, before m = "
        "2 or before n = 0; the readings do not determine which; this spoils the map: "
        "measure the view again",
    ),
    (
        TakenForSlip(
            size=2e-3,
            u=1e-5,
            unit="rad",
            cause="microscope",
            of_cause=CauseDetails(part="turn"),
            slip_in="+x",
        ),
        "view '+x' looks as if the plate slipped, but the readings show a microscope turned "
        "counter-clockwise by 2.000 ± 0.010 mrad, which explains them better: no view was split",
    ),
    (
        SlipsGivenUp(slips=3),
        "gave up on slips after 3: the readings seem to contain more; measure again",
    ),
    (
        OwnTermsUnknown(terms=("drift", "plate_scale")),
        "its own drift and plate_scale cannot be known: not judged",
    ),
]


@pytest.mark.parametrize(
    ("found", "text"),
    [*CAUSES, *FINDINGS],
    ids=[found.name for found, _ in [*CAUSES, *FINDINGS]],
)
def test_a_finding_in_words(found, text):
    assert sentence_of(found) == text


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_effect_of_the_package_has_its_sentence_and_remedy(name):
    for table, words in (("_CAUSES", _CAUSES), ("_ACTIONS", _ACTIONS)):
        assert name in words, f"add '{name}' to {table} in reporting/words/findings.py"


def kinds_of(base):
    return [kind for sub in base.__subclasses__() for kind in (sub, *kinds_of(sub))]


ELSEWHERE = {InWords, RestNotIdentified}
"""Of a file, or said with the plate beside it (`why_text`)."""


@pytest.mark.parametrize("kind", kinds_of(Finding), ids=lambda kind: kind.__name__)
def test_every_finding_has_words_of_its_own(kind):
    has_words = [
        kind in of.registry or kind in fixed
        for of, fixed in ((sentence_of, FIXED), (mode_text, FIXED_MODES))
    ]
    assert sum(has_words) == (kind not in ELSEWHERE), (
        f"add the sentence of {kind.__name__} to reporting/words/findings.py"
    )


def test_no_finding_of_the_package_is_left_over():
    sources = "".join(
        path.read_text()
        for path in PACKAGE.rglob("*.py")
        if not path.is_relative_to(PACKAGE / "reporting")
        and path != PACKAGE / "model/findings.py"
    )
    unused = [
        kind.__name__
        for kind in kinds_of(Finding)
        if f"{kind.__name__}(" not in sources
    ]
    assert unused == ["OrAddViews"]  # by the class, in `plan_check`


def test_what_has_no_words_is_not_worded():
    with pytest.raises(KeyError, match="no words for in_words"):
        sentence_of(InWords())
    with pytest.raises(KeyError, match="unheard"):
        sentence_of(Cause(name="unheard"))


def test_a_remedy_that_was_tried_comes_first_and_a_view_is_for_programs():
    found = explanation("drift", [(1, "x P1")], [1e-8], 1e-9)
    tried = (Remedy("model", "drift:2e-08"), Remedy("view", "90"))
    cause = replace(cause_of(found, GROUND), remedies=tried)
    assert sentence_of(cause) == (
        "a drift of 0.0200 ± 0.0020 µm along x during view '90': solve with --model drift:2e-08, "
        "or visit the marks there and back"
    )
    assert remedies(cause) == (
        *tried,
        Remedy("action", "visit the marks there and back"),
    )


ODD = "run 2: shift x"


def saved_and_read(result):
    return result_from_dict(json.loads(json.dumps(result_to_dict(result))), "r")


def test_a_view_with_a_colon_in_its_name_cuts_no_sentence_of_a_saved_result():
    """Whatever a view is called: what a cause is, and what to do, come from the data."""
    found = explanation("plate_scale", [(1, ""), (2, "")], [1e-7, 2e-6], 1e-7)
    cause = replace(
        cause_of(
            found,
            SimpleNamespace(
                names_of=lambda term: ("0: first", "90", ODD), half_width_m=0.05
            ),
        ),
        remedies=(Remedy("model", "plate_scale:3e-06"), Remedy("view", ODD)),
    )
    what = f"a plate larger by 2.00 ± 0.10 µm/m in view '{ODD}' than in view '0: first'"
    noisy = NoisyView(size=2.26, unit="m/m", view=ODD)
    bare = replace(
        result_of(random_map(Artifact(3, 0.01, 8), 1)),
        findings=(noisy,),
        verdict=Verdict(Grade.NOT_QUALIFIED, (noisy,), (cause,)),
    )
    again = saved_and_read(worded(bare))
    verdict = again.verdict
    assert verdict.reasons == (
        f"view '{ODD}' is 2.3 times as noisy as the others: measure it again",
        f"the readings show {what}",
    )
    remedy = "solve with --model plate_scale:3e-06, or let the plate reach thermal equilibrium"
    assert verdict.sentence == f"Not qualified: most likely {what}: {remedy}"
    assert (what_it_is(verdict.causes[0]), advice(verdict.causes[0])) == (what, remedy)
    assert again.warnings == verdict.reasons[:1]
    assert (
        worded(again).warnings == again.warnings
        and saved_and_read(again).verdict == verdict
    )
    # what a program needs: which view to measure again
    views = [
        remedy.value for remedy in verdict.causes[0].remedies if remedy.kind == "view"
    ]
    assert views == [verdict.causes[0].view] == [ODD] == [verdict.failed[0].view]


@pytest.mark.parametrize(
    "name",
    [
        "microscope",
        "plate_scale",
        "plate_strain",
        "plate_shape",
        "slip",
        "off_sites",
        "roughness",
    ],
)
def test_a_cause_of_a_file_without_its_data_is_its_text(name):
    damaged = replace(
        TURN, name=name, unit="m", details=CauseDetails(), text="as it was said"
    )
    assert what_it_is(damaged) == "as it was said"


def test_a_verdict_names_the_likeliest_cause_or_else_the_first_reason():
    drift = Cause(
        name="drift", size=5e-7, u=1e-8, unit="m", p=1e-6, view="90", axis="x"
    )
    unknown = NoiseUnknown()
    found = worded_verdict(
        Verdict(Grade.NOT_QUALIFIED, (unknown,), (TURN, drift)), TESTED
    )
    assert found.sentence == (
        "Not qualified: most likely a microscope turned counter-clockwise by 2.000 ± "
        f"0.010 mrad: {ALIGN}"
    )
    assert found.reasons == (
        sentence_of(unknown),
        *(f"the readings show {what_it_is(cause)}" for cause in (TURN, drift)),
    )
    assert [cause.text for cause in found.causes] == [
        sentence_of(TURN),
        sentence_of(drift),
    ]
    assert not found.qualified and worded_verdict(found, TESTED) is found
    alone = worded_verdict(Verdict(Grade.NOT_QUALIFIED, (unknown,)), TESTED)
    assert alone.sentence == f"Not qualified: {sentence_of(unknown)}"


def test_a_qualified_verdict_says_what_was_compared():
    assert worded_verdict(Verdict(Grade.GOOD), TESTED).sentence == (
        "Good: residuals and the noise of readings agree"
    )
    assert worded_verdict(Verdict(Grade.GOOD), UNTESTED).sentence == (
        "Good: residuals show the noise; there are no repeats to compare it with"
    )


def test_a_verdict_within_an_enlarged_uncertainty_names_what_enlarged_it():
    found = worded_verdict(Verdict(Grade.ENLARGED, causes=(TURN,)), TESTED)
    assert found.sentence == f"Good within an enlarged U: {sentence_of(TURN)}"
    assert found.qualified


def test_a_result_is_worded_once_and_only_then_written():
    bare = replace(
        result_of(random_map(Artifact(3, 0.01, 8), 1)),
        warnings=("as read",),
        verdict=Verdict(Grade.NOT_QUALIFIED, (NoiseUnknown(),), (TURN,)),
        findings=(OutliersKept(), SlipsGivenUp(slips=3)),
    )
    for part in (bare, replace(bare, findings=())):
        with pytest.raises(ValueError, match=re.escape("is not worded")):
            result_to_dict(part)
    found = worded(bare)
    assert found.warnings == ("as read", *map(sentence_of, bare.findings))
    written = result_to_dict(found)
    assert result_to_dict(worded(found)) == written
    assert written["verdict"]["causes"] == [
        {
            "name": "microscope",
            "text": sentence_of(TURN),
            "view": "",
            "axis": "",
            "mark": [],
            "size": 2e-3,
            "u": 1e-5,
            "unit": "rad",
            "p": 1e-6,
            "details": {"part": "turn"},
            "effect_rms": None,
            "effect_max": None,
            "told": True,
            "remedies": [{"action": ALIGN}],
        }
    ]
    assert written["verdict"]["failed"] == [
        {
            "name": "noise_unknown",
            "text": sentence_of(NoiseUnknown()),
            "view": "",
            "axis": "",
            "mark": [],
            "size": None,
            "u": None,
            "unit": "",
            "p": None,
            "details": {},
        }
    ]
    assert written["findings"][1]["details"] == {"slips": 3}
    assert [item["text"] for item in written["findings"]] == list(found.warnings[1:])
    assert np.array_equal(found.error_map.gx, bare.error_map.gx)


@pytest.mark.parametrize(
    ("name", "si", "unit"),
    [
        ("drift", "m", "µm"),
        ("microscope", "m/m", "µm/m"),
        ("microscope", "rad", "mrad"),
        ("line_eccentricity", "rad", "µrad"),
        ("line_scale", "m/m", "µm/m"),
        ("plate_strain", "m/m", "µm/m"),
    ],
)
def test_estimates_and_causes_have_one_unit_each(name, si, unit):
    assert unit_of(name, si).name == unit
