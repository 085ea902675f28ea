# SPDX-License-Identifier: Apache-2.0
"""SIM.yaml: machine, cell and faults of a simulated calibration."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from selfcal_ros.collection.inputs import Detection, EncoderSample, Kind
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import InputError, known_are
from selfcal_ros.files import read_yaml, refuse_unknown
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.plan_form import plan_from_dict, plan_to_dict
from selfcal_ros.model.view import Plan, View
from selfcal_ros.results import read_result
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.estimator import plan_of, read_plan
from selfcal_ros.settings.nodes import SimulatorSettings
from selfcal_ros.settings.parameter import Parameter
from selfcal_ros.simulation.cell import CellSettings, Event, plan_events
from selfcal_ros.simulation.machine import Spread, Truth, random_truth
from selfcal_ros.simulation.rendering import Camera, Exposure, exposures
from selfcal_ros.units import M_PER_UM, NS_PER_S, RAD_PER_MRAD

PARTS = ("lost", "outliers", "low_score", "not_finite", "unknown_mark", "duplicated")
"""Faults of single detections, at most one per detection; in the order of the draw."""


@dataclass(frozen=True)
class Faults:
    """Faults: fractions of the detections (0..1), times in s.

    Attributes
    ----------
    lost, duplicated, outliers : float
        Fractions of the detections that never arrive, arrive twice, or are off by 1 to 20 um
        (angular: by 1 to 20 mrad).
    low_score, not_finite, unknown_mark : float
        Fractions with a score of 0.1, a NaN offset, or an id off the plate.
    delay_s : float
        Delay of arrival, drawn from an exponential distribution with a fifth of this as its mean;
        messages overtake each other.
    clock_step_s : float
        Step back of the cell's clock in the middle of the recording; 0 = none.
    encoder_gap_s : float
        Length of a gap in the encoder stream, at a third of the recording; 0 = none.

    Raises
    ------
    InputError
        If the fractions add up to more than 1.
    """

    lost: float = 0.0
    duplicated: float = 0.0
    outliers: float = 0.0
    low_score: float = 0.0
    not_finite: float = 0.0
    unknown_mark: float = 0.0
    delay_s: float = 0.0
    clock_step_s: float = 0.0
    encoder_gap_s: float = 0.0

    def __post_init__(self) -> None:
        """Refuse impossible fractions: a detection has one fault at most."""
        total = sum(getattr(self, name) for name in PARTS)
        if total > 1 + 1e-9:
            raise InputError(
                "faults",
                f"the parts of the detections add up to {total:g}",
                "keep the sum at 1 or below: a detection has one fault at most",
            )


def apply_faults(
    events: Sequence[Event | Exposure], faults: Faults, rng: np.random.Generator
) -> tuple[list[tuple[int, Event | Exposure]], dict[str, int]]:
    """Return (time of arrival in ns, message) in the order of arrival, and the ledger.

    Parameters
    ----------
    events : sequence
        Messages in the order of their stamps.
    faults : Faults
        The faults.
    rng : numpy.random.Generator
        Source of the draw.
    """
    ledger: Counter = Counter()
    first = events[0].stamp_ns
    last = events[-1].stamp_ns
    gap = first + (last - first) // 3
    step_at = first + (last - first) // 2
    step = round(faults.clock_step_s * NS_PER_S)
    out: list[tuple[int, Event | Exposure]] = []
    for event in events:
        arrival = event.stamp_ns
        if faults.delay_s:
            arrival += round(rng.exponential(faults.delay_s / 5) * NS_PER_S)
        if isinstance(event, EncoderSample) and gap <= event.stamp_ns < gap + round(
            faults.encoder_gap_s * NS_PER_S
        ):
            ledger["encoder_samples_lost"] += 1
            continue
        if step and event.stamp_ns >= step_at:
            event = replace(event, stamp_ns=event.stamp_ns - step)
            ledger["stamped_by_the_stepped_clock"] += 1
        for item in _spoil(event, faults, rng, ledger):
            out.append((arrival, item))
    out.sort(key=lambda item: item[0])
    return out, dict(ledger)


def _spoil(
    event: Event | Exposure, faults: Faults, rng: np.random.Generator, ledger: Counter
) -> Sequence[Event | Exposure]:
    if not isinstance(event, Detection | Exposure):
        return [event]
    chance = rng.random()
    for name in PARTS:
        part = getattr(faults, name)
        if chance < part:
            ledger[name] += 1
            if isinstance(event, Exposure):  # no others are allowed
                return [] if name == "lost" else [event, event]
            return _one_fault(event, name, rng)
        chance -= part
    return [event]


def _one_fault(event: Detection, name: str, rng: np.random.Generator) -> list[Event]:
    if name == "lost":
        return []
    if name == "duplicated":
        return [event, event]
    if name == "low_score":
        return [replace(event, score=0.1)]
    if name == "not_finite":
        return [replace(event, offset_x=float("nan"), offset_theta=float("nan"))]
    if name == "unknown_mark":
        return [replace(event, has_id=True, m=9999, n=0, k=2**31)]
    size = rng.uniform(1, 20)
    angle = rng.uniform(0, 2 * np.pi)
    if event.kind == Kind.ANGULAR:
        return [
            replace(
                event,
                offset_theta=event.offset_theta
                + np.sign(np.cos(angle)) * size * RAD_PER_MRAD,
            )
        ]
    return [
        replace(
            event,
            offset_x=event.offset_x + size * M_PER_UM * np.cos(angle),
            offset_y=event.offset_y + size * M_PER_UM * np.sin(angle),
        )
    ]


UNITS = ("", "_m", "_rad", "_s", "_hz", "_pitches", "_px", "_deg")
"""Endings of the fields of a dataclass, which the keys of a file do not have."""
LAST_START_S = 2.1e9
"""Largest start time: stamps are 32 bit seconds, with room for the longest recording."""

Section = dict[str, Parameter]
"""Key -> its unit, limits and choices; the default is that of the field."""

_NODE: Section = {
    parameter.name: parameter for parameter in SimulatorSettings.parameters()
}
"""The keys that are parameters of stage_simulator as well."""


def _keys(*names: str, unit: str = "", high: float = 1.0) -> Section:
    return {
        name: Parameter(
            name=name, default=0.0, description="", unit=unit, low=0.0, high=high
        )
        for name in names
    }


def field_of(key: str, kind: type) -> str:
    """Return the field of a dataclass that a key sets: the key with a unit; "" if none."""
    names = {item.name for item in fields(kind)}
    return next(
        (
            key.removesuffix("_s") + unit
            for unit in UNITS
            if key.removesuffix("_s") + unit in names
        ),
        "",
    )


TRUTH: Section = (
    _keys("g", "a", "t", "t_common", unit="m", high=1e-3)
    | _keys("g_theta", "a_theta", "phi", "phi_common", unit="rad", high=0.1)
    | _keys("correlation", unit="pitches", high=1000.0)
    | {name: _NODE[name] for name in ("encoder", "rotation")}
)
NOISE: Section = {
    name: _NODE[name]
    for name in (
        "sigma_xy",
        "sigma_theta",
        "noise_ratio",
        "visit_xy",
        "image_xy",
        "flicker_xy",
        "flicker_theta",
        "resolution_xy",
        "resolution_theta",
    )
}
CELL: Section = {"sense": replace(_NODE["measurement_sense"], name="sense")} | {
    name: _NODE[name]
    for name in (
        "encoder_rate",
        "exposure_period",
        "with_ids",
        "declare_sigma",
        "servo_sigma",
        "servo_sigma_theta",
        "encoder_sigma",
        "encoder_sigma_theta",
        "stop_sigma",
        "stop_sigma_theta",
        "follow_mark",
        "visit_order",
        "consecutive",
    )
}
PHYSICS: Section = {
    name: parameter
    for name, parameter in _NODE.items()
    if name not in TRUTH and field_of(name, Spread)
}
FAULTS: Section = _keys(*PARTS) | {
    f"{name}{unit}": Parameter(
        name=f"{name}{unit}",
        default=0.0,
        description="",
        unit="s",
        low=0.0,
        high=3600.0,
    )
    for unit in ("", "_s")
    for name in ("delay", "clock_step", "encoder_gap")
}
_DETECTOR: Section = {
    parameter.name: parameter for parameter in DetectorSettings.parameters()
}
CAMERA: Section = (
    {
        name: _DETECTOR[name]
        for name in (
            "pixel_size",
            "mark",
            "mark_size",
            "mark_width",
            "polarity",
            "turn",
            "mirror",
        )
    }
    | {
        name: Parameter(
            name=name, default=0, description="", unit="px", low=8, high=10_000
        )
        for name in ("width", "height")
    }
    | _keys("blur", unit="px", high=100.0)
    | _keys("dirt", high=1000.0)
    | _keys("ground", "contrast", "read_noise", "shot_noise", "vignetting")
    | {
        "distortion": Parameter(
            name="distortion", default=0.0, description="", unit="", low=-0.5, high=0.5
        ),
        "encoding": Parameter("encoding", "mono8", "", choices=("mono8", "mono16")),
    }
)
CORRECTION_TIMES = Parameter(
    "times", 1.0, "of the table that act", low=-1000.0, high=1000.0
)
OF_IMAGES = ("lost", "duplicated")
"""Faults that images can have."""
TOP = (
    Parameter("seed", 0, "of truth, noise and faults", low=0, high=2**61),
    Parameter(
        "noise_seed",
        0,
        "of all that a new measurement of the machine changes",
        low=0,
        high=2**61,
    ),
    Parameter(
        name="start_time",
        default=1.7e9,
        description="first stamp",
        unit="s",
        low=0.0,
        high=LAST_START_S,
    ),
    Parameter("compression", "zstd", "of the bag", choices=("zstd", "lz4", "none")),
)


@dataclass(frozen=True)
class Simulation:
    """A parsed SIM.yaml: plan, seeds, spread of the truth, cell, faults, start time.

    `noise_seed` is None if `seed` determines everything; `placed` has the actual poses in
    views that are not placed as the plan commands. With a `camera` there are images instead of grid
    detections. With a `correction` the controller subtracts its map, `correction_times` it.
    """

    plan: Plan
    seed: int
    spread: Spread
    settings: CellSettings
    faults: Faults = Faults()
    start_ns: int = 0
    compression: str = "zstd"
    noise_seed: int | None = None
    placed: tuple[View | None, ...] = ()
    camera: Camera | None = None
    correction: ErrorMap | None = None
    correction_times: float = 1.0

    def draw(self, n_views: int) -> tuple[Truth, np.random.Generator]:
        """Return the truth for a number of placings, and the source of noise and faults."""
        machine = rng = np.random.default_rng(self.seed)
        if self.noise_seed is not None:
            rng = np.random.default_rng(self.noise_seed)
        truth = random_truth(
            self.plan.artifact, n_views, machine, self.spread, placing=rng
        )
        truth = replace(truth, placed=self.placed)
        if self.correction is not None:
            truth = corrected(truth, self.correction, self.correction_times)
        return truth, rng

    def run(self) -> tuple[Truth, list[tuple[int, Event | Exposure]], dict[str, int]]:
        """Return the truth, the messages with their times of arrival, and the counts of faults."""
        truth, rng = self.draw(len(self.plan.views))
        settings = (
            replace(self.settings, with_ids=True) if self.camera else self.settings
        )
        cell_events = plan_events(
            truth, self.plan, settings=settings, rng=rng, start_ns=self.start_ns
        )
        events = list(
            exposures(truth, self.plan, self.camera, cell_events, sense=settings.sense)
            if self.camera
            else cell_events
        )
        arrivals, ledger = apply_faults(events, self.faults, rng)
        return truth, arrivals, ledger


def read_simulation(path: str | Path) -> Simulation:
    """Return the simulation in a SIM.yaml.

    Keys: ``plan`` (a path relative to the file, or an inline plan), ``seed``, ``noise_seed``,
    ``truth``, ``physics`` (fields of `Spread`), ``placed``, ``noise``, ``cell`` (fields of
    `CellSettings`), ``faults`` (fields of `Faults`), ``camera`` (fields of `Camera`),
    ``correction``, ``start_time`` (s), ``compression``; see docs/guides/simulate.md. SI units.

    Raises
    ------
    InputError
        For an unknown key, a value of the wrong type or out of bounds, or faults of more than
        all detections together.
    """
    where = str(path)
    data = _mapping(
        read_yaml(path),
        where,
        (
            "plan",
            "truth",
            "physics",
            "placed",
            "noise",
            "cell",
            "faults",
            "camera",
            "correction",
            *(parameter.name for parameter in TOP),
        ),
    )
    if "plan" not in data:
        raise InputError(where, "the key 'plan' is missing", "name a PLAN.yaml")
    top = {
        parameter.name: parameter.check(
            data.get(parameter.name, parameter.default), where
        )
        for parameter in TOP
    }
    read = {
        name: _section(data.get(name, {}), f"{where}: {name}", keys, defaults)
        for name, keys, defaults in (
            ("truth", TRUTH, Spread()),
            ("physics", PHYSICS, Spread()),
            ("noise", NOISE, CellSettings()),
            ("cell", CELL, CellSettings()),
            ("faults", FAULTS, Faults()),
            ("camera", CAMERA, Camera()),
        )
    }
    try:
        settings = CellSettings(**read["noise"], **read["cell"])
        faults = Faults(**read["faults"])
        camera = Camera(**read["camera"]) if "camera" in data else None
    except InputError as error:
        raise InputError(f"{where}: {error.where}", error.what, error.remedy) from error
    if camera is not None:
        _check_of_images(data.get("faults", {}), f"{where}: faults")
    plan = _plan(data["plan"], Path(path))
    if camera is not None and plan.artifact.marks:
        raise InputError(
            f"{where}: camera",
            "images are rendered of lattices, the plate is a list of marks",
            "leave camera out: simulate detections",
        )
    correction, times = _correction(data.get("correction", {}), Path(path))
    return Simulation(
        plan,
        seed=top["seed"],
        spread=Spread(**read["truth"], **read["physics"]),
        settings=settings,
        faults=faults,
        start_ns=round(top["start_time"] * NS_PER_S),
        compression=top["compression"],
        noise_seed=top["noise_seed"] if "noise_seed" in data else None,
        placed=_actual_poses(data.get("placed", []), plan, f"{where}: placed"),
        camera=camera,
        correction=correction,
        correction_times=times,
    )


def camera_of(path: str | Path) -> tuple[Camera, Spread]:
    """Return the camera of a SIM.yaml and the sizes of its truth.

    Raises
    ------
    InputError
        If it has no camera, or cannot be read.
    """
    simulation = read_simulation(path)
    if simulation.camera is None:
        raise InputError(str(path), "the cell has no camera", "add the key 'camera'")
    return simulation.camera, simulation.spread


def _check_of_images(faults: Mapping[str, Any], where: str) -> None:
    """Refuse faults that images cannot have."""
    for name in PARTS:
        if faults.get(name) and name not in OF_IMAGES:
            raise InputError(
                f"{where}: {name}",
                "a fault of detections, but the cell has a camera",
                f"use {' and '.join(OF_IMAGES)}, or dirt of the camera",
            )


def settings_of(values: Mapping[str, Any]) -> CellSettings:
    """Return the settings of a cell from the keys of ``noise`` and ``cell`` in one mapping."""
    return CellSettings(**_fields_of(values, NOISE | CELL, CellSettings()))


def spread_of(values: Mapping[str, Any], default: Spread | None = None) -> Spread:
    """Return the parameters of a truth from the keys of ``truth`` and ``physics``."""
    default = default or Spread()
    return replace(default, **_fields_of(values, TRUTH | PHYSICS, default))


def _fields_of(
    values: Mapping[str, Any], keys: Section, defaults: Any
) -> dict[str, Any]:
    fields_by_key = {
        key: field_of(key, type(defaults)) for key in keys if key in values
    }
    return {
        name: type(getattr(defaults, name))(values[key])
        for key, name in fields_by_key.items()
    }


def _plan(plan: Any, path: Path) -> Plan:
    if isinstance(plan, str):
        source = path.parent / plan
        return read_plan(source)
    return plan_of(plan, f"{path}: plan", path.parent)


def _actual_poses(views: Any, plan: Plan, where: str) -> tuple[View | None, ...]:
    """Return the actual poses of the named views; empty if none."""
    if not views:
        return ()
    written = plan_to_dict(plan)
    lies = {
        view.name: view
        for view in plan_from_dict(
            {
                key: written[key]
                for key in ("plan_id", "artifact", "map")
                if key in written
            }
            | {"views": views},
            where,
        ).views
    }
    names = [view.name for view in plan.views]
    for name in lies:
        if name not in names:
            raise InputError(
                where, f"the plan has no view '{name}'", known_are(name, names)
            )
    placed = [
        replace(lies[view.name], grid=view.grid, angular=view.angular)
        if view.name in lies
        else None
        for view in plan.views
    ]
    for lie in filter(None, placed):
        lie.on_stage(plan.artifact)
    return tuple(placed)


def _correction(data: Any, path: Path) -> tuple[ErrorMap | None, float]:
    """Return the map that the controller subtracts, None without, and how many times."""
    where = f"{path}: correction"
    data = _mapping(data, where, ("result", "times"))
    if not data:
        return None, 1.0
    if not isinstance(data.get("result"), str):
        raise InputError(where, "the key 'result' is missing", "name a RESULT.json")
    times = CORRECTION_TIMES.check(data.get("times", 1.0), where)
    return read_result(path.parent / data["result"]).error_map, times


def corrected(truth: Truth, table: ErrorMap, times: float) -> Truth:
    """Return a machine whose controller subtracts a table, bilinear between its nodes."""
    controller = Compensator(table)
    plate = truth.artifact
    g = truth.g - times * np.stack(controller.error(plate.x_m, plate.y_m))
    if not controller.has_theta or not plate.angular_count:
        return replace(truth, g=g)
    return replace(
        truth,
        g=g,
        g_theta=truth.g_theta - times * controller.error_theta(plate.theta_rad),
    )


def _mapping(data: Any, where: str, known_keys: tuple[str, ...]) -> dict:
    if not isinstance(data, dict):
        raise InputError(where, "not a mapping", "see docs/guides/simulate.md")
    refuse_unknown(data, known_keys, where)
    return data


def _section(data: Any, where: str, keys: Section, defaults: Any) -> dict:
    """Return field -> value of a section, each of the type of its default and within bounds."""
    out: dict[str, Any] = {}
    for key, value in _mapping(data, where, tuple(keys)).items():
        name = field_of(key, type(defaults))
        if name in out:
            raise InputError(f"{where}: {key}", "given twice", "remove one")
        out[name] = type(getattr(defaults, name))(keys[key].check(value, where))
    return out
