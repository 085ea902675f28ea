# SPDX-License-Identifier: Apache-2.0
"""SIM.yaml: what it may say, what it must say, and that a seed gives the same messages."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import MapGrid
from selfcal_ros.model.readings import Sense
from selfcal_ros.settings.nodes import NODE_PARAMETERS
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread
from selfcal_ros.simulation.spec import (
    CELL,
    FAULTS,
    NOISE,
    PHYSICS,
    TRUTH,
    Faults,
    field_of,
    read_simulation,
    settings_of,
    spread_of,
)

PLAN = {
    "plan_id": "p",
    "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 4},
    "views": [{"name": "a"}, {"name": "b", "rotation_deg": 90}],
}


def simulation(folder, data):
    path = folder / "sim.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return read_simulation(path)


def test_a_plan_alone_is_a_simulation(tmp_path):
    made = simulation(tmp_path, {"plan": PLAN})
    assert (made.seed, made.compression, made.start_ns) == (
        0,
        "zstd",
        1_700_000_000_000_000_000,
    )
    assert made.settings.sense is Sense.MICROSCOPE_MOVES
    assert [view.name for view in made.plan.views] == ["a", "b"]
    truth, arrivals, ledger = made.run()
    assert ledger == {}
    assert len(truth.phi_rad) == 2
    assert len(arrivals) > 100


def test_every_key_reaches_its_place(tmp_path):
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    made = simulation(
        tmp_path,
        {
            "plan": "plan.yaml",
            "seed": 5,
            "truth": {
                "g": 1e-6,
                "phi": 0.0,
                "encoder": "xy_axes",
                "rotation": "linear",
            },
            "physics": {
                "microscope_scale": -0.01,
                "microscope_stretch": 0.02,
                "microscope_rotation": -0.03,
                "microscope_shear": 0.04,
                "backlash_x": 1e-8,
                "backlash_y": -2e-8,
                "plate_scale": 1e-6,
                "plate_shape": 3e-8,
                "drift_linear": 1e-7,
                "drift_quadratic": 2e-7,
                "drift_cubic": 3e-7,
                "drift_walk": 4e-7,
            },
            "noise": {
                "sigma_xy": 1e-8,
                "sigma_theta": 2e-6,
                "visit_xy": 1e-9,
                "flicker_xy": 2e-9,
                "flicker_theta": 3e-9,
                "resolution_xy": 4e-9,
                "resolution_theta": 5e-9,
            },
            "start_time": 12.5,
            "compression": "lz4",
            "cell": {
                "sense": "plate_moves",
                "encoder_rate": 1000,
                "with_ids": False,
                "exposure_period": 0.02,
                "declare_sigma": True,
                "servo_sigma": 0.0,
                "stop_sigma": 5e-5,
                "stop_sigma_theta": 1e-5,
                "follow_mark": True,
                "visit_order": "random@plate",
                "consecutive": True,
            },
            "faults": {"lost": 0.1, "delay": 0.2, "clock_step_s": 0.3},
        },
    )
    assert (made.seed, made.start_ns, made.compression) == (5, 12_500_000_000, "lz4")
    assert (made.spread.g_m, made.spread.phi_rad, made.spread.a_m) == (
        1e-6,
        0.0,
        0.3e-6,
    )
    cell = made.settings
    assert (
        cell.sense,
        cell.encoder_rate_hz,
        cell.with_ids,
        cell.exposure_period_s,
    ) == (Sense.PLATE_MOVES, 1000, False, 0.02)
    assert (cell.sigma_xy_m, cell.sigma_theta_rad, cell.declare_sigma) == (
        1e-8,
        2e-6,
        True,
    )
    assert (
        cell.servo_sigma_m,
        cell.stop_sigma_m,
        cell.stop_sigma_theta_rad,
        cell.follow_mark,
    ) == (0.0, 5e-5, 1e-5, True)
    assert (cell.visit_order, cell.consecutive) == ("random@plate", True)
    assert (cell.visit_xy_m, cell.flicker_xy_m, cell.flicker_theta_rad) == (
        1e-9,
        2e-9,
        3e-9,
    )
    assert (cell.resolution_xy_m, cell.resolution_theta_rad) == (4e-9, 5e-9)
    spread = made.spread
    assert (spread.encoder, spread.rotation) == ("xy_axes", "linear")
    assert (
        spread.microscope_scale,
        spread.microscope_stretch,
        spread.microscope_rotation_rad,
        spread.microscope_shear,
    ) == (-0.01, 0.02, -0.03, 0.04)
    assert (spread.backlash_x_m, spread.backlash_y_m) == (1e-8, -2e-8)
    assert (spread.plate_scale, spread.plate_shape_m) == (1e-6, 3e-8)
    assert (
        spread.drift_linear_m,
        spread.drift_quadratic_m,
        spread.drift_cubic_m,
        spread.drift_walk_m,
    ) == (1e-7, 2e-7, 3e-7, 4e-7)
    assert (made.faults.lost, made.faults.delay_s, made.faults.clock_step_s) == (
        0.1,
        0.2,
        0.3,
    )


def test_a_seed_gives_the_same_messages(tmp_path):
    data = {
        "plan": PLAN,
        "noise": {"sigma_xy": 1e-8},
        "faults": {"lost": 0.1, "delay": 0.1},
    }
    first, again, other = (
        simulation(tmp_path, {**data, "seed": seed}).run() for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first[0].g, again[0].g)
    assert first[1:] == again[1:]
    assert first[1] != other[1]


def test_the_machine_stays_when_it_is_measured_again(tmp_path):
    data = {
        "plan": PLAN,
        "seed": 4,
        "noise": {"sigma_xy": 1e-8},
        "faults": {"lost": 0.1},
    }
    alone, first, same, other = (
        simulation(tmp_path, {**data, **more}).run()
        for more in ({}, {"noise_seed": 1}, {"noise_seed": 1}, {"noise_seed": 2})
    )
    for name in ("g", "a", "g_theta", "a_theta"):
        np.testing.assert_array_equal(getattr(first[0], name), getattr(other[0], name))
        np.testing.assert_array_equal(getattr(first[0], name), getattr(alone[0], name))
    assert not np.array_equal(first[0].phi_rad, other[0].phi_rad)
    assert first[1:] == same[1:] and first[1] != other[1]


def test_every_effect_beside_the_model_reaches_its_field(tmp_path):
    """Each key alone changes its field, and no other."""
    values = {
        key: -1e-6 if parameter.low < 0 else 1e-3
        for key, parameter in PHYSICS.items()
        if not parameter.choices
    }
    assert len(values) > 20
    for key, value in (values | {"microscope_axes": "y-x"}).items():
        made = simulation(tmp_path, {"plan": PLAN, "physics": {key: value}})
        changed = {
            name: at
            for name, at in vars(made.spread).items()
            if at != getattr(Spread(), name)
        }
        assert changed == {field_of(key, Spread): value}
    made = simulation(
        tmp_path,
        {
            "plan": PLAN,
            "truth": {"phi_common": 1e-3, "t_common": 1e-5, "correlation": 4},
            "noise": {"noise_ratio": 0.5},
            "cell": {"encoder_sigma": 1e-8, "encoder_sigma_theta": 1e-7},
        },
    )
    assert (made.spread.phi_common_rad, made.spread.t_common_m) == (1e-3, 1e-5)
    assert made.spread.correlation_pitches == 4.0
    cell = made.settings
    assert (cell.noise_ratio, cell.encoder_sigma_m) == (0.5, 1e-8)
    assert cell.encoder_sigma_theta_rad == 1e-7


def test_a_plate_lies_otherwise_than_its_view_says(tmp_path):
    truth, _, _ = simulation(
        tmp_path,
        {
            "plan": PLAN,
            "placed": [{"name": "b", "rotation_deg": -90, "translation_pitch": [0, 1]}],
        },
    ).run()
    assert truth.placed[0] is None
    pose = truth.placed[1].lattice_pose(truth.artifact)
    assert (pose.q, pose.shift) == (3, (0, 1))
    assert simulation(tmp_path, {"plan": PLAN}).run()[0].placed == ()


def test_a_plate_lies_off_the_lattice_only_where_its_map_has_nodes_of_its_own(tmp_path):
    askew = {
        "plan": PLAN,
        "placed": [{"name": "b", "rotation_deg": 91, "angular": False}],
    }
    with pytest.raises(
        InputError, match="view 'b': grid marks cannot be measured at a turn of 91"
    ):
        simulation(tmp_path, askew)
    askew["plan"] = PLAN | {"map": {"grid_size": 3}}
    with pytest.raises(
        InputError, match=r"rotation: 1[.]01111 is not a whole number of ang"
    ):
        simulation(tmp_path, askew)
    askew["plan"]["views"] = [{"name": "b", "angular": False}]
    truth = simulation(tmp_path, askew).run()[0]
    assert truth.placed[0].rotation_rad == np.deg2rad(91)
    assert truth.artifact.map_grid == MapGrid(3, 0.02)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("[1]", ": not a mapping; see docs/guides/simulate.md"),
        ({}, ": the key 'plan' is missing; name a PLAN.yaml"),
        (
            {"plan": PLAN, "sed": 1},
            ": sed: unknown key; did you mean 'seed'? known are plan, truth, physics, "
            "placed, noise, cell, faults, camera, correction, seed, noise_seed, "
            "start_time, compression",
        ),
        (
            {"plan": {**PLAN, "views": []}},
            ": plan: the plan has no views; add at least one view",
        ),
        (
            {"plan": True},
            ": plan: not a mapping of keys to values; see the examples in config",
        ),
        (
            {"plan": PLAN, "truth": 5},
            ": truth: not a mapping; see docs/guides/simulate.md",
        ),
        (
            {"plan": PLAN, "faults": None},
            ": faults: not a mapping; see docs/guides/simulate.md",
        ),
        (
            {"plan": PLAN, "noise": {"encoder_rate": 500}},
            ": noise: encoder_rate: unknown key; known are sigma_xy, sigma_theta, "
            "noise_ratio, visit_xy, image_xy, flicker_xy, flicker_theta, "
            "resolution_xy, resolution_theta",
        ),
        (
            {"plan": PLAN, "placed": [{"name": "c"}]},
            ": placed: the plan has no view 'c'; known are a, b",
        ),
        (
            {"plan": PLAN, "placed": {"b": {}}},
            ": placed: views: {'b': {}} is not of type list; correct the value",
        ),
        (
            {"plan": PLAN, "placed": [{"name": "b", "turn": 90}]},
            ": placed: views[0]: turn: unknown key; known are name, rotation_deg, "
            "translation_pitch, translation_mm, grid, angular, repeats, visit_order",
        ),
        (
            {"plan": PLAN, "cell": {"visit_order": "spiral"}},
            ": simulated cell: visit_order: 'spiral' is not a visiting order; use one "
            "of raster, serpentine, there_and_back, x_then_y, x_back_y_back, random, "
            "if need be with @plate",
        ),
        (
            {"plan": PLAN, "cell": {"encoder_rate": 100}},
            ": simulated cell: 100 Hz gives fewer than 2.5 encoder samples in a dwell "
            "of 0.006 s; raise encoder_rate or exposure_period",
        ),
        (
            {"plan": PLAN, "faults": {"lost": 0.6, "duplicated": 0.6}},
            ": faults: the parts of the detections add up to 1.2; keep the sum at 1 "
            "or below: a detection has one fault at most",
        ),
        (
            {"plan": PLAN, "faults": {"delay": 0.6, "delay_s": 0.6}},
            ": faults: delay_s: given twice; remove one",
        ),
    ],
)
def test_what_is_refused_and_how(tmp_path, data, message):
    with pytest.raises(InputError) as caught:
        simulation(tmp_path, data)
    assert str(caught.value) == f"{tmp_path / 'sim.yaml'}{message}"


def test_a_plan_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"no\.yaml: no such file; check the path"):
        simulation(tmp_path, {"plan": "no.yaml"})


KEYS = {
    None: {
        "seed": (int, 0, 2**61),
        "noise_seed": (int, 0, 2**61),
        "start_time": (float, 0.0, 2.1e9),
        "compression": str,
    },
    "truth": dict.fromkeys(("g", "a", "t", "t_common"), (float, 0.0, 1e-3))
    | dict.fromkeys(("g_theta", "a_theta", "phi", "phi_common"), (float, 0.0, 0.1))
    | {"correlation": (float, 0.0, 1000.0), "encoder": str, "rotation": str},
    "physics": dict.fromkeys(
        (
            "microscope_scale",
            "microscope_stretch",
            "microscope_rotation",
            "microscope_shear",
            "microscope_distortion",
            "optical_tilt_x",
            "optical_tilt_y",
            "pitch_error",
        ),
        (float, -0.1, 0.1),
    )
    | dict.fromkeys(
        ("backlash_x", "backlash_y", "backlash_growth", "settling", "plate_bow"),
        (float, -1e-3, 1e-3),
    )
    | dict.fromkeys(
        ("plate_scale", "plate_strain", "plate_tilt", "line_eccentricity"),
        (float, 0.0, 0.1),
    )
    | dict.fromkeys(("microscope_pixels", "line_factor"), (float, -100.0, 100.0))
    | {
        "microscope_axes": str,
        "microscope_field": (float, 1e-6, 1e-3),
        "settling_time": (float, 1e-6, 3600.0),
    }
    | dict.fromkeys(
        (
            "stage_bend",
            "plate_shape",
            "drift_linear",
            "drift_quadratic",
            "drift_cubic",
            "drift_walk",
        ),
        (float, 0.0, 1e-3),
    ),
    "noise": dict.fromkeys(
        ("sigma_xy", "visit_xy", "flicker_xy", "resolution_xy"), (float, 0.0, 1e-3)
    )
    | dict.fromkeys(
        ("sigma_theta", "flicker_theta", "resolution_theta"), (float, 0.0, 0.1)
    )
    | {"noise_ratio": (float, 0.0, 100.0)},
    "cell": {
        "sense": str,
        "with_ids": bool,
        "declare_sigma": bool,
        "encoder_rate": (float, 1.0, 10000.0),
        "exposure_period": (float, 0.001, 10.0),
        "encoder_sigma": (float, 0.0, 1e-3),
        "encoder_sigma_theta": (float, 0.0, 0.1),
        "servo_sigma": (float, 0.0, 1e-3),
        "servo_sigma_theta": (float, 0.0, 0.1),
        "stop_sigma": (float, 0.0, 1e-3),
        "stop_sigma_theta": (float, 0.0, 0.1),
        "follow_mark": bool,
        "consecutive": bool,
    },
    "faults": dict.fromkeys(
        ("lost", "duplicated", "outliers", "low_score", "not_finite", "unknown_mark"),
        (float, 0.0, 1.0),
    )
    | dict.fromkeys(("delay", "clock_step", "encoder_gap"), (float, 0.0, 3600.0)),
}
FIELDS = [
    (section, key, rule) for section, keys in KEYS.items() for key, rule in keys.items()
]


def one(section, key, value):
    return {"plan": PLAN, **({section: {key: value}} if section else {key: value})}


@pytest.mark.parametrize(("section", "key", "rule"), FIELDS)
def test_every_field_has_a_type_and_bounds(tmp_path, section, key, rule):
    kind, *bounds = rule if isinstance(rule, tuple) else (rule,)
    wrong = [
        (
            "many",
            f"'many' is not {'known' if kind is str else f'of type {kind.__name__}'}; ",
        ),
        ([1], f"[1] is not of type {kind.__name__}; "),
        (None, f"None is not of type {kind.__name__}; "),
    ]
    if kind is not bool:
        wrong += [(True, f"True is not of type {kind.__name__}; ")]
    if kind is not float:
        wrong += [(1.5, f"1.5 is not of type {kind.__name__}; ")]
    if bounds:
        low, high = bounds
        wrong += [
            (value, f"{value} is outside {low} to {high}")
            for value in (kind(low) - 1, kind(high) * 2)
        ]
    if kind is float:
        wrong += [(value, f"{value} is outside") for value in (np.nan, np.inf, -np.inf)]
    for value, message in wrong:
        with pytest.raises(InputError) as caught:
            simulation(tmp_path, one(section, key, value))
        place = f"{section}: {key}" if section else key
        assert str(caught.value).startswith(
            f"{tmp_path / 'sim.yaml'}: {place}: {message}"
        )


@pytest.mark.parametrize(
    ("section", "key", "rule"),
    [
        field
        for field in FIELDS
        if isinstance(field[2], tuple)
        and field[1] not in ("encoder_rate", "exposure_period")
    ],
)
def test_the_bounds_themselves_are_accepted(tmp_path, section, key, rule):
    for value in rule[1:]:
        simulation(tmp_path, one(section, key, value))


def test_a_number_in_a_form_of_yaml_1_2_is_a_number(tmp_path):
    made = simulation(
        tmp_path,
        "plan: {plan_id: p, artifact: {grid_size: 5, grid_pitch: 1e-2, "
        "angular_count: 0}, views: [{name: a}]}\nstart_time: 1.7e9\n"
        "noise: {sigma_xy: 2e-8}\n",
    )
    assert made.plan.artifact.grid_pitch_m == 0.01
    assert (made.start_ns, made.settings.sigma_xy_m) == (
        1_700_000_000_000_000_000,
        2e-8,
    )


def test_flat_keys_reach_their_fields():
    settings = settings_of({"sense": "plate_moves", "stop_sigma": 1e-5, "other": 1})
    assert settings == CellSettings(Sense.PLATE_MOVES, stop_sigma_m=1e-5)
    spread = spread_of(
        {"encoder": "xy_axes", "drift_cubic": 1e-7, "phi": 0.0, "stop_sigma": 1}
    )
    assert spread == Spread(encoder="xy_axes", drift_cubic_m=1e-7, phi_rad=0.0)


def test_a_simulated_cell_is_by_default_what_a_simulation_is_but_for_hus_noise():
    cell, spread = CellSettings(), Spread()
    fields = {key: getattr(cell, field_of(key, CellSettings)) for key in NOISE | CELL}
    fields |= {
        key: getattr(spread, field_of(key, Spread))
        for key in (*PHYSICS, "encoder", "rotation")
    }
    fields |= {"sigma_xy": 20e-9, "sigma_theta": np.radians(0.001)}
    shared = {
        parameter.name: parameter.default
        for parameter in NODE_PARAMETERS["stage_simulator"]
        if parameter.name in fields
    }
    assert len(shared) > 25
    assert shared == {key: fields[key] for key in shared}


@pytest.mark.parametrize(
    ("name", "keys", "defaults"),
    [
        ("truth", TRUTH, Spread()),
        ("physics", PHYSICS, Spread()),
        ("noise", NOISE, CellSettings()),
        ("cell", CELL, CellSettings()),
        ("faults", FAULTS, Faults()),
    ],
)
def test_numbers_are_those_of_the_documents(name, keys, defaults):
    page = (Path(__file__).parents[2] / "docs/guides/simulate.md").read_text()
    section = (
        page.partition(f"\n`{name}`")[2].partition("\n\n`")[0].partition("\n## ")[0]
    )
    said = {}
    for line in section.splitlines():
        if not line.startswith("| `"):
            continue
        names, default, _ = line.strip("| ").split(" | ")
        numbers = [number.split()[0] for number in default.split(", ")]
        for i, key in enumerate(re.findall(r"`(\w+)`", names)):
            said[key] = numbers[min(i, len(numbers) - 1)]
    taken = {key for key in keys if not key.endswith("_s")}  # delay_s: as delay
    assert said.keys() == taken, (
        f"in docs/guides/simulate.md, table of `{name}`, add or remove the rows of "
        f"{sorted(said.keys() ^ taken)}"
    )
    for key in said:
        value = getattr(defaults, field_of(key, type(defaults)))
        if type(value) in (int, float):
            assert float(said[key]) == pytest.approx(value, rel=1e-3)


def test_a_camera_allows_no_faults_of_detections(tmp_path):
    with pytest.raises(InputError, match="faults: outliers: a fault of detections"):
        simulation(tmp_path, {"plan": PLAN, "camera": {}, "faults": {"outliers": 0.1}})


def test_a_mark_larger_than_any_image_is_refused(tmp_path):
    with pytest.raises(
        InputError, match=r"camera: mark_size: 8e\+06 pixels; a mark has up to 2000 pix"
    ):
        simulation(tmp_path, {"plan": PLAN, "camera": {"mark_size": 16.0}})


def test_a_negative_zero_is_zero(tmp_path):
    data = {"plan": PLAN, "truth": {"a": -0.0, "t": -0.0, "phi": -0.0}}
    simulation(tmp_path, data).run()


def test_lost_images_are_counted(tmp_path):
    _, arrivals, ledger = simulation(
        tmp_path, {"plan": PLAN, "camera": {}, "faults": {"lost": 0.5}}
    ).run()
    images = sum(hasattr(event, "offsets") for _, event in arrivals)
    lines = 2 * 4  # lines stay detections, lost as well
    detections = sum(hasattr(event, "offset_theta") for _, event in arrivals)
    assert 0 < images < 50 and images + detections + ledger["lost"] == 50 + lines
