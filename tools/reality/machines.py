# SPDX-License-Identifier: Apache-2.0
"""What machines do that no residual shows, or that is none of the model's terms."""

from dataclasses import replace
from typing import Any

import numpy as np

from selfcal_ros.applications.papers.readings import hu_plan
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.readings import Measurements, Sense, subset
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import WALK_STEPS, Spread, Truth, Waves
from tools.reality.cases import (
    ARTIFACT,
    MODEL,
    SETTINGS,
    SIGMA_M,
    Case,
    Change,
    Spoil,
    bent,
    checked,
    hu,
    resistant,
)

SERVO = replace(SETTINGS, servo_sigma_m=20e-9, servo_sigma_theta_rad=1e-7)
"""A stage that scatters about its stops as far as its encoders tell."""
WITHOUT_LINES = Artifact(ARTIFACT.grid_size, ARTIFACT.grid_pitch_m, 0)


def machine_cases() -> list[Case]:
    """Return the cases, those of the microscope first."""
    return [
        *_wired(),
        *_scaled(),
        *_plates(),
        *_stages(),
        *_noises(),
        *_laid(),
        *_exact(),
        *_checked(),
        *_hardly_told(),
    ]


def _checked() -> list[Case]:
    """Return cases with check stops, which tell the microscope."""
    stops = {"plan": checked(hu())}
    still = replace(SERVO, servo_sigma_m=0.0, servo_sigma_theta_rad=0.0)
    bare = {"plan": checked(hu_plan(WITHOUT_LINES, 5))}
    return [
        _case("check stops: nothing", more=stops),
        _case(
            "check stops: offsets of the other sign, no lines, stage that never scatters",
            0.01,
            more=bare,
            settings=still,
            microscope_axes="-x-y",
        ),
        _case(
            "check stops: pixels twice as large as declared",
            0.003,
            more=stops,
            microscope_pixels=0.5,
        ),
        _case(
            "check stops: scale of the microscope +5 %",
            0.05,
            more=stops,
            microscope_scale=0.05,
        ),
        _case(
            "check stops: scale of the microscope +5 %, no lines",
            more=bare,
            microscope_scale=0.05,
        ),
        _case(
            "check stops: microscope turned by 5 mrad",
            0.005,
            more=stops,
            microscope_rotation_rad=5e-3,
        ),
        _case(
            "check stops: shear of the microscope 2 mrad",
            0.1,
            more=stops,
            microscope_shear=2e-3,
        ),
        _case(
            "check stops: camera distortion 0.1 % at 250 um, plate against pins",
            0.001,
            more=stops,
            microscope_distortion=1e-3,
            **_pins(0.2),
        ),
        _case(
            "check stops: plate strained by 1 um/m in each view",
            more=stops,
            plate_strain=1e-6,
        ),
        _case(
            "check stops: plate bowed by 5 um, optical axis tilted by 5 mrad",
            more=stops,
            plate_bow_m=5e-6,
            optical_tilt_x_rad=5e-3,
        ),
        _case(
            "check stops: stage bends by 10 nm in each view",
            more=stops,
            stage_bend_m=10e-9,
        ),
        _case(
            "check stops: offsets of the lines of 0.9 times their size",
            more=stops,
            line_factor=0.9,
        ),
        _case(
            "check stops: drift of 0.36 um a view, one raster, repeats consecutive",
            more=stops,
            settings=replace(SERVO, consecutive=True, visit_order="raster"),
            drift_linear_m=0.36e-6,
        ),
    ]


def _case(
    name: str,
    phi_deg: float = 0.03,
    *,
    settings: CellSettings = SERVO,
    more: dict[str, Any] | None = None,
    **spread: Any,
) -> Case:
    """Return a case whose plates lie turned by `phi_deg` (sigma)."""
    return Case(
        f"{name}, plates turned by {phi_deg:g} deg",
        Spread(phi_rad=float(np.deg2rad(phi_deg)), **spread),
        settings=settings,
        **(more or {}),
    )


def _wired() -> list[Case]:
    still = replace(SERVO, servo_sigma_m=0.0, servo_sigma_theta_rad=0.0)
    moved = replace(SERVO, sense=Sense.PLATE_MOVES)
    bare = {"plan": hu_plan(WITHOUT_LINES, 5)}
    other = {"microscope_axes": "-x-y", "line_factor": -1.0}
    return [
        *(_case("offsets of the other sign", phi, **other) for phi in (0.003, 0.01)),
        _case("offsets of the other sign, plate moves", 0.01, settings=moved, **other),
        _case(
            "offsets of the other sign, no lines",
            0.01,
            more=bare,
            microscope_axes="-x-y",
        ),
        _case(
            "offsets of the other sign, no lines, stage that never scatters",
            0.01,
            more=bare,
            settings=still,
            microscope_axes="-x-y",
        ),
        _case("offsets of the other sign, marks alone", 0.01, microscope_axes="-x-y"),
        _case("offsets of the other sign, lines alone", 0.01, line_factor=-1.0),
        _case("offsets of the other sign along x alone", 0.01, microscope_axes="-xy"),
        _case("axes of the microscope exchanged", 0.01, microscope_axes="yx"),
        _case("microscope turned by 90 deg", 0.01, microscope_axes="-yx"),
        _case("pixels twice as large as declared", 0.003, microscope_pixels=0.5),
        _case("pixels half as large as declared", 0.003, microscope_pixels=2.0),
        _case(
            "pixels twice as large as declared, encoders with 20 nm of noise",
            0.003,
            settings=replace(SERVO, encoder_sigma_m=20e-9),
            microscope_pixels=0.5,
        ),
    ]


def _scaled() -> list[Case]:
    return [
        *(
            _case(
                f"scale of the microscope {100 * scale:+g} %",
                phi,
                microscope_scale=scale,
            )
            for scale, phi in (
                (0.1, 0.03),
                (0.05, 0.05),
                (0.05, 0.1),
                (0.02, 0.03),
                (0.02, 0.3),
                (-0.01, 0.03),
            )
        ),
        _case(
            "scale of the microscope +5 %, no lines",
            more={"plan": hu_plan(WITHOUT_LINES, 5)},
            microscope_scale=0.05,
        ),
        *(
            _case(
                f"offsets of the lines of {factor:g} times their size",
                phi,
                line_factor=factor,
            )
            for factor, phi in ((0.9, 0.03), (0.97, 0.03), (1.02, 0.001))
        ),
        _case("microscope turned by 5 mrad", 0.005, microscope_rotation_rad=5e-3),
        _case("microscope turned by 20 mrad", 0.03, microscope_rotation_rad=20e-3),
        _case("shear of the microscope 2 mrad", 0.1, microscope_shear=2e-3),
        _case(
            "camera distortion 0.1 % at 250 um, plate against pins",
            0.001,
            microscope_distortion=1e-3,
            **_pins(0.2),
        ),
        _case(
            "camera distortion 0.1 % at 250 um, plate laid by hand",
            0.1,
            microscope_distortion=1e-3,
        ),
        _case(
            "scale of the microscope +2 %, plate against pins",
            0.001,
            microscope_scale=0.02,
            **_pins(0.1),
        ),
        _case(
            "microscope turned by 5 mrad, plate against pins",
            0.001,
            microscope_rotation_rad=5e-3,
            **_pins(0.1),
        ),
    ]


def _pins(phi_deg: float) -> dict[str, float]:
    """Return how a plate lies against pins: 50 um and `phi_deg` (sigma) off, alike in all views."""
    return {
        "t_m": 1e-6,
        "t_common_m": 50e-6,
        "phi_common_rad": float(np.deg2rad(phi_deg)),
    }


def _plates() -> list[Case]:
    five = {"plan": resistant()}
    return [
        _case("plate strained by 1 um/m in each view", plate_strain=1e-6),
        _case(
            "plate strained by 1 um/m in each view, five views",
            more=five,
            plate_strain=1e-6,
        ),
        _case("plate 0.1 K warmer or colder in each view", plate_scale=0.9e-6),
        _case("plate tilted by 1 mrad in each view", plate_tilt_rad=1e-3),
        _case(
            "plate tilted by 1 mrad in each view, optical axis by 5 mrad",
            plate_tilt_rad=1e-3,
            optical_tilt_x_rad=5e-3,
        ),
        _case(
            "plate bowed by 5 um, optical axis tilted by 5 mrad",
            plate_bow_m=5e-6,
            optical_tilt_x_rad=5e-3,
        ),
        _case(
            "circle of lines off the axis by 15 urad in each view",
            line_eccentricity_rad=15e-6,
        ),
        _case("pitch declared 800 um/m wrong", pitch_error=800e-6),
    ]


def _stages() -> list[Case]:
    five = {"plan": resistant()}
    once = replace(SERVO, consecutive=True)
    return [
        _case("stage bends by 10 nm in each view", stage_bend_m=10e-9),
        _case(
            "stage bends by 10 nm in each view, five views",
            more=five,
            stage_bend_m=10e-9,
        ),
        _case("backlash that grows to 35 nm in a view", backlash_growth_m=35e-9),
        _case(
            "backlash that grows to 35 nm in a view, repeats consecutive",
            settings=once,
            backlash_growth_m=35e-9,
        ),
        _case("settling of 12 nm", settling_m=12e-9),
        _case(
            "settling of 12 nm, repeats consecutive",
            settings=once,
            settling_m=12e-9,
            settling_time_s=0.02,
        ),
        _case(
            "drift of 0.36 um a view, one raster, repeats consecutive",
            settings=replace(once, visit_order="raster"),
            drift_linear_m=0.36e-6,
        ),
        _case("drift as a random walk of 100 nm a view", drift_walk_m=100e-9),
        _case(
            "plate slips by 100 nm half-way through a view",
            more={"change": slipping(100e-9)},
        ),
        _case(
            "stage follows marks that lie 2 mm beside their sites",
            settings=replace(SERVO, follow_mark=True),
            t_m=2e-3,
        ),
        _case(
            "stage follows marks that lie 2 mm beside their sites, alike in all views",
            settings=replace(SERVO, follow_mark=True),
            t_common_m=2e-3,
        ),
        *(
            _case(
                f"stage correlated over {length:g} pitches follows marks that lie {1e3 * away_m:g} "
                "mm beside their sites",
                settings=replace(SERVO, follow_mark=True),
                t_m=away_m,
                correlation_pitches=length,
            )
            for length, away_m in ((4, 1e-3), (4, 2e-3), (2, 2e-3))
        ),
        _case(
            "encoders err by 30 nm in each 20 um",
            more={"change": subdivided(20e-6, 30e-9)},
        ),
        *(
            _case(
                "encoders err by 30 nm in each 20 um, stage follows marks",
                phi,
                settings=replace(SERVO, follow_mark=True),
                more={"change": subdivided(20e-6, 30e-9)},
            )
            for phi in (0.003, 0.01, 0.03)
        ),
    ]


def subdivided(period_m: float, size_m: float) -> Change:
    """Return a change: each linear encoder errs by a sine within its signal period."""

    def change(truth: Truth, rng: np.random.Generator) -> Truth:
        number = 2 * np.pi * truth.artifact.grid_pitch_m / period_m * np.eye(2)
        size = np.diag(size_m * np.exp(2j * np.pi * rng.uniform(size=2)))
        at_sites = np.real(size.sum(axis=0))  # a pitch is a number of whole periods
        waves = Waves(
            np.concatenate([truth.waves.number, number]),
            np.concatenate([truth.waves.size, size]),
        )
        return replace(truth, waves=waves, g=truth.g + at_sites[:, None, None])

    return change


def _noises() -> list[Case]:
    return [
        _case(
            "noise of 40 nm along x and 10 nm along y",
            settings=replace(SERVO, sigma_xy_m=40e-9, noise_ratio=0.25),
        ),
        _case(
            "encoders with 20 nm of noise",
            settings=replace(SERVO, encoder_sigma_m=20e-9),
        ),
        _case("servo scatter of 1 um", settings=replace(SERVO, servo_sigma_m=1e-6)),
        _case(
            "offsets in steps of 50 nm", settings=replace(SERVO, resolution_xy_m=50e-9)
        ),
        _case(
            "1/f noise of 20 nm beside white noise of 5 nm",
            settings=replace(SERVO, sigma_xy_m=5e-9, flicker_xy_m=SIGMA_M),
        ),
    ]


def laid(index: int, rotation_deg: float, shift: tuple[int, int]) -> Change:
    """Return a change: in view `index` the plate lies so instead, shifts in pitches."""

    def change(truth: Truth, rng: np.random.Generator) -> Truth:
        pitch = truth.artifact.grid_pitch_m
        view = replace(
            hu(1).views[index],
            rotation_rad=float(np.deg2rad(rotation_deg)),
            translation_m=(shift[0] * pitch, shift[1] * pitch),
        )
        placed = [view if i == index else None for i in range(len(truth.phi_rad))]
        return replace(truth, placed=tuple(placed))

    return change


def _laid() -> list[Case]:
    poses = (
        ("not turned", 1, 0.0, (0, 0)),
        ("turned by -90 deg", 1, -90.0, (0, 0)),
        ("turned by 180 deg", 1, 180.0, (0, 0)),
        ("not shifted", 3, 0.0, (0, 0)),
        ("shifted along y", 3, 0.0, (0, 1)),
        ("shifted to the other side", 3, 0.0, (-1, 0)),
        ("shifted by two pitches", 3, 0.0, (2, 0)),
    )
    bag = {"messages": True, "plan": hu(2)}
    bare = replace(SERVO, with_ids=False)
    return [
        *(_case(f"view {name}", more={"change": laid(*how)}) for name, *how in poses),
        *(
            _case(
                f"bag, {ids}: view {name}",
                settings=settings,
                more={"change": laid(*how), **bag},
            )
            for ids, settings in (("with ids", SERVO), ("without ids", bare))
            for name, *how in poses
        ),
        _case("bag, with ids: nothing", more=bag),
    ]


def slipping(size_m: float) -> Change:
    """Return a change: the plate slips along x and y half-way through the second view."""

    def change(truth: Truth, rng: np.random.Generator) -> Truth:
        walk = np.zeros((len(truth.phi_rad), 2, WALK_STEPS + 1))
        walk[1, :, WALK_STEPS // 2 :] = np.array([[size_m], [-size_m / 2]])
        return replace(truth, walk_m=walk)

    return change


def _exact() -> list[Case]:
    exact = CellSettings(servo_sigma_m=0.0, servo_sigma_theta_rad=0.0)
    five = {"plan": resistant()}
    return [
        _case("nothing, and no noise", settings=exact),
        _case("nothing, and no noise, five views", settings=exact, more=five),
    ]


def _hardly_told() -> list[Case]:
    """Return cases of which the readings determine a part, or few readings the size."""
    few, small = _seven_lines(), Artifact(5, 0.01, 24)
    any_pose = {
        "spread": replace(MODEL, correlation_pitches=3.0),
        "plan": _any_pose(),
        "settings": SERVO,
    }
    eccentric = {"settings": SETTINGS, "line_eccentricity_rad": 15e-6}
    return [
        *(
            Case(
                f"plate bent in each view, {1e9 * size_m:g} nm, six views",
                plan=_six(3),
                change=bent(size_m),
            )
            for size_m in (10e-9, 40e-9)
        ),
        *(
            Case(
                f"views at any pose, encoders err by {1e9 * size_m:g} nm in each 20 um",
                change=subdivided(20e-6, size_m),
                **any_pose,
            )
            for size_m in (20e-9, 30e-9)
        ),
        Case("views at any pose", **any_pose),
        Case(
            "views at any pose, one mark read in one of them",
            spoil=with_one_mark,
            **any_pose,
        ),
        _case(
            "circle of 7 lines off the axis by 15 urad in each view",
            more={"plan": few},
            **eccentric,
        ),
        *(
            Case(
                f"5 x 5 marks, one pass, noise of 20 nm declared as {1e9 * u_m:g} nm",
                plan=hu_plan(small, 1),
                spoil=declaring(u_m),
            )
            for u_m in (20e-9, 17e-9, 14e-9)
        ),
        _case("lines without noise", settings=replace(SERVO, sigma_theta_rad=0.0)),
        _case(
            "lines without noise, five views",
            more={"plan": resistant()},
            settings=replace(SERVO, sigma_theta_rad=0.0),
        ),
    ]


def _six(repeats: int) -> Plan:
    """Return Hu's views, one shifted along y and one turned by 180 deg."""
    plan, pitch = hu(repeats), ARTIFACT.grid_pitch_m
    return replace(
        plan,
        views=(
            *plan.views,
            View("shift_y", 0.0, (0.0, pitch), True, True, repeats),
            View("rot180", np.pi, (0.0, 0.0), True, True, repeats),
        ),
    )


def _seven_lines() -> Plan:
    """Return Hu's views of a plate with seven lines, which a turn by 90 deg does not show."""
    plan = hu_plan(Artifact(11, 0.01, 7), 5)
    return replace(
        plan,
        views=tuple(
            replace(view, angular=False) if view.name == "rot90" else view
            for view in plan.views
        ),
    )


def _any_pose() -> Plan:
    """Return six views turned and shifted by no multiples, on 9 x 9 marks."""
    plate = Artifact(9, 0.01, 0, map_grid=MapGrid(9, 0.01))
    poses = (
        (0, 0, 0),
        (33, 2, -3),
        (71, -4, 1),
        (118, 3, 4),
        (203, -2, -4),
        (290, 5, 2),
    )
    return Plan(
        "any_pose",
        plate,
        tuple(
            View(
                f"at_{turn}",
                float(np.deg2rad(turn)),
                (x * 1e-3, y * 1e-3),
                True,
                False,
                5,
            )
            for turn, x, y in poses
        ),
    )


def with_one_mark(readings: Measurements, rng: np.random.Generator) -> Measurements:
    """Leave one mark of the last view."""
    view = readings.views[-1]
    left = np.arange(len(view.m)) == len(view.m) // 2
    return replace(
        readings,
        views=(
            *readings.views[:-1],
            subset(view, left, np.zeros(len(view.k), dtype=bool)),
        ),
    )


def declaring(u_m: float) -> Spoil:
    """Return what spoils readings: they declare a noise of `u_m`."""

    def spoil(readings: Measurements, rng: np.random.Generator) -> Measurements:
        return replace(
            readings,
            views=tuple(
                replace(view, u=np.full(len(view.m), u_m)) for view in readings.views
            ),
        )

    return spoil
