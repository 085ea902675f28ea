# SPDX-License-Identifier: Apache-2.0
"""What real machines do: one effect at a time and several, larger than the model takes them.

Each case is simulated by the places of things (`simulation.physics`), not by the estimator's model.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from selfcal_ros.applications.papers.readings import hu_plan
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import WALK_STEPS, Spread, Truth

ARTIFACT = Artifact(11, 0.01, 24)
SIGMA_M, SIGMA_RAD = 20e-9, np.deg2rad(0.001)
MODEL = Spread(encoder="independent", rotation="finite")
SETTINGS = CellSettings(
    sigma_xy_m=SIGMA_M,
    sigma_theta_rad=SIGMA_RAD,
    servo_sigma_m=20e-9,
    servo_sigma_theta_rad=0.0,
)


Change = Callable[[Truth, np.random.Generator], Truth]
"""Truth and random numbers -> the truth as it is in a case."""
Spoil = Callable[[Measurements, np.random.Generator], Measurements]
"""Readings and random numbers -> the readings as they are in a case."""


def hu(repeats: int = 5) -> Plan:
    """Return Hu's four views, read `repeats` times."""
    return hu_plan(ARTIFACT, repeats)


def checked(plan: Plan) -> Plan:
    """Return a plan with check stops: five marks of each grid view, from 20 um beside."""
    return replace(
        plan,
        views=tuple(
            replace(view, check_marks=5, check_offset_m=20e-6) if view.grid else view
            for view in plan.views
        ),
    )


def resistant(repeats: int = 4) -> Plan:
    """Return five grid views with shifts of both signs, marks visited along x and y and back."""
    p = ARTIFACT.grid_pitch_m
    poses = (
        ("identity", 0.0, (0, 0)),
        ("rot90", np.pi / 2, (0, 0)),
        ("shift_x", 0.0, (p, 0)),
        ("shift_-x", 0.0, (-p, 0)),
        ("shift_y", 0.0, (0, p)),
    )
    views = tuple(
        View(name, turn, shift, True, True, repeats, "x_back_y_back")
        for name, turn, shift in poses
    )
    line = View(
        "line", 2 * np.pi / ARTIFACT.angular_count, (0.0, 0.0), False, True, repeats
    )
    return Plan("resistant", ARTIFACT, (*views, line))


@dataclass(frozen=True)
class Case:
    """One thing that a machine does.

    Attributes
    ----------
    name : str
        What.
    spread : Spread
        Of the truth.
    change : callable
        Truth and random numbers -> the truth as it is in this case.
    settings : CellSettings
        How the cell measures.
    plan : Plan
        What is measured.
    options : Options
        How it is calibrated.
    missing : float
        Part of the marks and lines that are not read in a view.
    spoil : callable
        Readings and random numbers -> the readings as they are in this case.
    messages : bool
        Whether the readings are collected from the messages of the cell; otherwise they are
        those of detections without ids of which none is rejected, which takes a tenth of the time.
    draw : callable, optional
        Random numbers and the case -> the case as it is in one run, where runs differ.
    """

    name: str
    spread: Spread = MODEL
    change: Change = lambda truth, rng: truth
    settings: CellSettings = SETTINGS
    plan: Plan = field(default_factory=hu)
    options: Options = Options()
    missing: float = 0.0
    spoil: Spoil = lambda readings, rng: readings
    messages: bool = False
    draw: Callable[[np.random.Generator, "Case"], "Case"] | None = None

    @property
    def times(self) -> int:
        """How many times as many runs as of other cases tell what is asked."""
        return 1 if self.draw is None else 25 if self.name == "population clean" else 5


def term_cases() -> list[Case]:
    """Return the cases of the terms of the model, those with the defaults first."""
    return [
        *_turned(),
        *_microscopes(),
        *_drifts(),
        *_plates(),
        *_noises(),
        *_with_terms(),
        *_together(),
    ]


def _turned() -> list[Case]:
    turned = [
        Case(
            f"plate turned by {angle:g} deg (sigma)",
            replace(MODEL, phi_rad=float(np.deg2rad(angle))),
        )
        for angle in (0.3, 0.1, 0.03)
    ]
    gaps = replace(
        turned[0], name=f"{turned[0].name}, 20 % of the marks missing", missing=0.2
    )
    return [turned[0], gaps, *turned[1:]]


_MICROSCOPE = replace(MODEL, microscope_rotation_rad=2e-3)
_SCALE = replace(MODEL, microscope_scale=5e-3)


def _microscopes() -> list[Case]:
    return [
        Case("microscope turned by 2 mrad", _MICROSCOPE),
        Case(
            "microscope turned by 2 mrad, stop errors 20 um",
            _MICROSCOPE,
            settings=replace(SETTINGS, stop_sigma_m=20e-6),
        ),
        Case(
            "microscope scale 0.5 %, stop errors 50 um",
            _SCALE,
            settings=replace(SETTINGS, stop_sigma_m=50e-6),
        ),
    ]


def drifting(size_m: float, view: int = 1) -> Change:
    """Return a change: one view drifts along x by `size_m`, steadily."""

    def change(truth: Truth, rng: np.random.Generator) -> Truth:
        drift = np.zeros((len(truth.phi_rad), 2, 3))
        drift[view, 0, 0] = size_m
        return replace(truth, drift_m=drift)

    return change


def _drifts() -> list[Case]:
    together = replace(SETTINGS, consecutive=True)
    return [
        Case(
            "drift 500 nm in a view, repeats consecutive",
            change=drifting(500e-9),
            settings=together,
        ),
        Case(
            "drift 50 nm in a view, repeats consecutive",
            change=drifting(50e-9),
            settings=together,
        ),
        Case("drift 50 nm in a view, repeats as passes", change=drifting(50e-9)),
    ]


def grown(truth: Truth, rng: np.random.Generator) -> Truth:
    """Let the plate grow by 1 um/m in one view."""
    scale = np.zeros(len(truth.phi_rad))
    scale[1] = 1e-6
    return replace(truth, plate_scale=scale)


def scaled(size: float) -> Change:
    """Return a change: the plate is larger by its own amount in each view."""

    def change(truth: Truth, rng: np.random.Generator) -> Truth:
        return replace(truth, plate_scale=rng.normal(0, size, len(truth.phi_rad)))

    return change


def bent(size_m: float) -> Change:
    """Return a change: the plate is bent as (x^2 - y^2, -2xy) by its own amount in each view."""

    def change(truth: Truth, rng: np.random.Generator) -> Truth:
        amounts = rng.normal(0, size_m, len(truth.phi_rad))
        shape = np.array([[[a, 0, -a], [0, -2 * a, 0]] for a in amounts])
        return replace(truth, plate_shape_m=shape)

    return change


def _plates() -> list[Case]:
    back = replace(MODEL, backlash_x_m=20e-9, backlash_y_m=20e-9)
    plate = replace(SETTINGS, visit_order="serpentine@plate")
    raster = replace(SETTINGS, visit_order="raster")
    return [
        Case("plate grown by 1 um/m in one view", change=grown),
        Case("plate bent in each view, 30 nm", change=bent(30e-9)),
        Case("plate bent in each view, 10 nm", change=bent(10e-9)),
        Case("backlash 20 nm, every site reached from one side", back, settings=raster),
        Case("backlash 20 nm, the stage's order, back and forth", back),
        Case("backlash 20 nm, the plate's order", back, settings=plate),
    ]


def _noises() -> list[Case]:
    flicker = replace(SETTINGS, sigma_xy_m=5e-9, flicker_xy_m=SIGMA_M)
    return [
        Case(
            "1/f noise, repeats consecutive",
            settings=replace(flicker, consecutive=True),
        ),
        Case("1/f noise, repeats as passes", settings=flicker),
    ]


def _with_terms() -> list[Case]:
    def case(name: str, terms: str, **more: Any) -> Case:
        return Case(
            f"{name}; model {terms}",
            plan=resistant(),
            options=Options(terms=parse_terms([terms], "reality")),
            **more,
        )

    back = replace(MODEL, backlash_x_m=20e-9, backlash_y_m=20e-9)
    stops = replace(SETTINGS, stop_sigma_m=20e-6)
    everything = replace(
        _MICROSCOPE,
        backlash_x_m=20e-9,
        backlash_y_m=20e-9,
        plate_scale=1e-6,
        drift_linear_m=100e-9,
        drift_quadratic_m=50e-9,
    )
    too_small = [
        case(
            f"size {factor} times too small: {name}",
            f"{term}:{size / factor:.3g}",
            change=change,
        )
        for name, term, size, change in (
            ("plate scale 1 um/m in each view", "plate_scale", 1e-6, scaled(1e-6)),
            ("plate bent by 30 nm in each view", "plate_shape", 30e-9, bent(30e-9)),
        )
        for factor in (3, 10)
    ]
    return [
        case(
            "microscope turned by 2 mrad, stop errors 20 um",
            "microscope",
            spread=_MICROSCOPE,
            settings=stops,
        ),
        case(
            "microscope scale 0.5 %, stop errors 20 um",
            "microscope",
            spread=_SCALE,
            settings=stops,
        ),
        case("drift 500 nm in a view", "drift", change=drifting(500e-9)),
        case("plate grown by 1 um/m in one view", "plate_scale", change=grown),
        case("plate bent in each view, 30 nm", "plate_shape:30e-9", change=bent(30e-9)),
        case("plate bent in each view, 10 nm", "plate_shape:10e-9", change=bent(10e-9)),
        case("backlash 20 nm", "approach", spread=back),
        case(
            "all of them",
            "microscope,drift,plate_scale,approach",
            spread=everything,
            settings=stops,
        ),
        *too_small,
    ]


def creeping(size_m: float) -> Change:
    """Return a change: the plate creeps along x and y after it was laid down, alike each time."""

    def change(truth: Truth, rng: np.random.Generator) -> Truth:
        course = size_m * np.exp(-np.linspace(0, 1, WALK_STEPS + 1) / 0.2)
        walk = np.stack([course, -course / 2])
        return replace(truth, walk_m=np.tile(walk, (len(truth.phi_rad), 1, 1)))

    return change


def misread(size_m: float) -> Spoil:
    """Return what spoils readings: one mark is off in all repeats of the second view."""

    def spoil(readings: Measurements, rng: np.random.Generator) -> Measurements:
        view, angle = readings.views[1], rng.uniform(0, 2 * np.pi)
        at = np.arange(len(view.m)) == rng.integers(len(view.m))
        off = replace(
            view,
            dx=view.dx + at * size_m * np.cos(angle),
            dy=view.dy + at * size_m * np.sin(angle),
        )
        return replace(readings, views=(readings.views[0], off, *readings.views[2:]))

    return spoil


def lines_turned(angle_rad: float) -> Spoil:
    """Return what spoils readings: the plate turns between marks and lines of the second view."""

    def spoil(readings: Measurements, rng: np.random.Generator) -> Measurements:
        view = readings.views[1]
        turned = replace(view, dtheta=view.dtheta + angle_rad)
        return replace(readings, views=(readings.views[0], turned, *readings.views[2:]))

    return spoil


def both(*changes: Change) -> Change:
    """Return the changes one after the other."""

    def change(truth: Truth, rng: np.random.Generator) -> Truth:
        for one in changes:
            truth = one(truth, rng)
        return truth

    return change


def _together() -> list[Case]:
    askew = replace(MODEL, microscope_rotation_rad=0.5e-3)
    back = replace(askew, backlash_x_m=10e-9, backlash_y_m=10e-9)
    stops = replace(SETTINGS, stop_sigma_m=20e-6)
    fine = replace(SETTINGS, sigma_theta_rad=np.deg2rad(1e-5))
    small = both(drifting(30e-9, view=3), scaled(0.2e-6))
    held = Options(terms=parse_terms(["microscope"], "reality"))
    return [
        *(
            Case(
                f"creep of {size} nm after each laying down, one pass",
                plan=hu(1),
                change=creeping(size * 1e-9),
            )
            for size in (100, 200)
        ),
        Case(
            "creep of 200 nm after each laying down, x, back, y, back",
            change=creeping(200e-9),
            plan=resistant(),
        ),
        Case("drift 30 nm in a view, plate scale 0.2 um/m in each view", change=small),
        Case(
            "drift 30 nm in a view, plate scale 0.2 um/m in each view, one pass",
            change=small,
            plan=hu(1),
        ),
        Case(
            "microscope turned by 0.5 mrad, backlash 10 nm, stop errors 20 um",
            back,
            settings=stops,
        ),
        Case(
            "microscope turned by 0.5 mrad, backlash 10 nm, stop errors 20 um; model microscope",
            back,
            settings=stops,
            options=held,
            plan=resistant(),
        ),
        Case(
            "a mark off by 300 nm in a view, one pass",
            plan=hu(1),
            spoil=misread(300e-9),
        ),
        Case(
            "a mark off by 300 nm in a view, plate scale 0.2 um/m in each view",
            change=scaled(0.2e-6),
            spoil=misread(300e-9),
        ),
        Case(
            "lines of a view turned by 1 arcsec, 20 % missing, lines read to 0.04 arcsec",
            settings=fine,
            missing=0.2,
            spoil=lines_turned(np.pi / 648_000),
        ),
    ]
