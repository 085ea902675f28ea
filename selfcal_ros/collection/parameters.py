# SPDX-License-Identifier: Apache-2.0
"""Every parameter of every node, declared once: default, bounds, unit and description.

The nodes declare them from here, ``selfcal solve --params`` reads a ROS parameter file against
the same table, and the documentation is printed from it. An unknown name is an error.
"""

from dataclasses import dataclass
from typing import Any

from selfcal_ros.errors import InputError, known_are
from selfcal_ros.estimation.options import Options, ReferenceKind, ReferenceLength
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Measurements, Sense
from selfcal_ros.model.terms import (
    DRIFT_DEGREE,
    MAX_DRIFT_DEGREE,
    ModelTerm,
    TermName,
    parse_terms,
)

BARE_Y = "y"
"""ROS reads a bare y in a parameter file as true, and `ros2 param dump` writes it bare."""


@dataclass(frozen=True)
class Parameter:
    """One parameter: its type is the type of its default."""

    name: str
    default: Any
    description: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()

    def check(self, value: Any, where: str) -> Any:
        """Return `value` as the parameter's type, or raise InputError."""
        kind = type(self.default)
        if value is True and self.default == BARE_Y:
            value = BARE_Y
        if kind is list and isinstance(value, str | tuple):
            value = [value] if isinstance(value, str) else list(value)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise InputError(f"{where}: {self.name}", f"{value!r} is not of type {kind.__name__}",
                             "put it in quotes" if kind is str else "correct the value")
        if kind is list and not all(isinstance(item, str) for item in value):
            raise InputError(f"{where}: {self.name}", f"{value!r} is not a list of texts",
                             "put each item in quotes")
        if self.choices and value not in self.choices:
            raise InputError(f"{where}: {self.name}", f"{value!r} is not known",
                             f"choose one of {', '.join(self.choices)}")
        if kind in (int, float) and not (
                (self.low is None or value >= self.low)
                and (self.high is None or value <= self.high)):
            raise InputError(f"{where}: {self.name}", f"{value} is outside {self.low} to "
                             f"{self.high} {self.unit}".rstrip(), "correct the value")
        return value


_SENSE = Parameter(
    "measurement_sense", str(Sense.MICROSCOPE_MOVES),
    "who moves: the microscope over a resting plate, or the plate under the microscope",
    choices=tuple(str(sense) for sense in Sense))
_FRAME = Parameter("frame_id", "stage", "frame of published messages (REP-103)")
_PLAN = Parameter("plan", "", "path of PLAN.yaml")
_HARDWARE = Parameter("hardware_id", "", "name or serial number of the stage, in the health; "
                      "empty = the namespace, or 'stage'")

_AUTOSTART = Parameter("autostart", True, "configure and activate by itself; false = wait for a "
                       "lifecycle manager")

COLLECTOR = (
    _SENSE, _FRAME, _AUTOSTART,
    Parameter("joint_x", "x", "joint that indicates x"),
    Parameter("joint_y", "y", "joint that indicates y"),
    Parameter("joint_theta", "theta", "joint that indicates theta"),
    Parameter("max_encoder_gap", 0.1, "largest gap between the encoder samples around an exposure",
              "s", 1e-6, 10.0),
    Parameter("max_speed", 5e-4, "largest speed at which the stage counts as at rest",
              "m/s", 0.0, 1.0),
    Parameter("max_angular_speed", 5e-3, "largest turn rate at which the stage counts as at rest",
              "rad/s", 0.0, 10.0),
    Parameter("encoder_agreement", 1e-9, "largest difference of two samples with one stamp",
              "m or rad", 0.0, 1e-3),
    Parameter("min_score", 0.4, "smallest score of a usable detection (ignored if all are 0)",
              "", 0.0, 1.0),
    Parameter("max_deviation", 5e-4, "largest distance of a mark from its nominal place once the "
              "view's own rotation and offset are removed; never more than a quarter pitch",
              "m", 1e-9, 1.0),
    Parameter("ambiguity_ratio", 0.5, "a mark without id is ambiguous if its distance to the "
              "nearest nominal mark exceeds this part of that to the second nearest",
              "", 0.01, 1.0),
    Parameter("max_rotation", 0.035, "largest rotational misalignment to expect when marks "
              "have no ids; where lines alone are read it must be below 0.45 of a line",
              "rad", 0.0, 0.2),
    Parameter("max_stage_distance", 0.0, "largest distance of the indicated stage position from "
              "the nominal site of the mark seen; 0 = half a pitch, and max_rotation times the "
              "radius of the plate", "m", 0.0, 10.0),
    Parameter("outlier_limit", 6.0, "distance from the median of a mark's repeats, in standard "
              "deviations of one reading, beyond which a repeat is an outlier; 0 = keep all",
              "", 0.0, 1000.0),
    Parameter("approach_threshold", 1e-6, "displacement of x or y before an exposure that counts "
              "as a motion and tells the direction of approach", "m", 0.0, 1e-2),
    Parameter("status_period", 0.5, "time between two ViewStatus messages", "s", 0.02, 60.0),
    Parameter("clock_limit", 0.1, "offset between the cell's clock and this machine's that is a "
              "warning; a view is not called complete on stamps that far in the future",
              "s", 0.001, 3600.0),
    Parameter("encoder_rate_min", 0.0, "encoder samples a second below which there is a warning "
              "while a view is measured; 0 = none", "Hz", 0.0, 1e5),
    Parameter("repeatability_xy_limit", 0.0, "repeatability of one grid reading above which there "
              "is a warning; 0 = none", "m", 0.0, 1e-3),
    Parameter("repeatability_theta_limit", 0.0, "repeatability of one angular reading above which "
              "there is a warning; 0 = none", "rad", 0.0, 0.1),
    Parameter("journal", "", "folder for journals: what is received, written before it is used, "
              "and taken up again after a crash; empty = none"),
    Parameter("journal_lag_limit", 5.0, "time by which the disk may lag behind the journal before "
              "there is a warning", "s", 0.1, 3600.0),
)
NO_TERMS = "none"
"""The word for no terms, where the plan asks for some."""

_UNCERTAINTY = {"auto": None, "always": True, "never": False}

SOLVER = (
    _FRAME, _AUTOSTART,
    Parameter("method", "joint", "estimator", choices=("joint", "law")),
    Parameter("theta_datum", str(ThetaDatum.ZERO_MEAN), "what fixes the constant of the "
              "angular map", choices=tuple(str(datum) for datum in ThetaDatum)),
    Parameter("misalignment_model", "rigid", "how the plate turns in the joint method: rigid, by a "
              "rotation, or linear, as published; the law is always linear",
              choices=("linear", "rigid")),
    Parameter("uncertainty", "auto", "uncertainty map of the joint solution: auto = up to "
              "201 x 201 sites; always = up to 1001 x 1001, in minutes",
              choices=tuple(_UNCERTAINTY)),
    Parameter("reference_kind", "none", "what a known length was measured on: it sets the scale",
              choices=("none", *map(str, ReferenceKind))),
    Parameter("reference_error", 0.0, "relative error of that length: artifact (true - nominal) / "
              "nominal, stage axis (indicated - true) / nominal", "m/m", -0.09, 0.09),
    Parameter("reference_u", 0.0, "standard uncertainty of reference_error (k=1)",
              "m/m", 0.0, 0.09),
    Parameter("reference_certificate", "", "what states that length: number and issuer of a "
              "certificate"),
    Parameter("model_terms", [""], "terms estimated with the map, each TERM or TERM:SIZE of "
              + ", ".join(TermName) + "; the size is a standard deviation, SI; empty = those of "
              f"the plan, {NO_TERMS} = none"),
    Parameter("drift_degree", DRIFT_DEGREE, "degree of the polynomial of time by which views "
              "drift, where drift is a term", "", 1, MAX_DRIFT_DEGREE),
    Parameter("save_path", "", "RESULT.json to write whenever the map changes; empty = none"),
    Parameter("result_folder", "", "folder in which save_map may write, and from which relative "
              "paths count; empty = the working directory"),
)
SEQUENCER = (
    _PLAN, _FRAME, _AUTOSTART,
    Parameter("auto_start", False, "start the plan without waiting for the start service"),
    Parameter("start_checks", True, "start only when collector, encoder, detections and solver "
              "are there; false = start without"),
    Parameter("resume", True, "the first start takes up the unfinished run of the plan that the "
              "collector knows"),
    Parameter("stall_time", 5.0, "time without a detection after which a view is said to stall",
              "s", 0.1, 3600.0),
    Parameter("auto_confirm", False, "measure without waiting for confirm_view (robot loaders)"),
    Parameter("settle_time", 0.5, "time between PLACE and MEASURE when auto_confirm is set",
              "s", 0.0, 3600.0),
    Parameter("view_timeout", 0.0, "give up waiting for a view's completion; 0 = wait forever",
              "s", 0.0, 1e6),
    Parameter("max_redos", 0, "times an incomplete view is redone after a time-out", "", 0, 100),
    Parameter("result_path", "", "where run_calibration has the solver save the map; empty = "
              "PLAN_ID.json in the solver's result_folder"),
    Parameter("save_timeout", 60.0, "longest wait of run_calibration for the solver to save",
              "s", 0.1, 3600.0),
)
COMPENSATOR = (
    _FRAME, _AUTOSTART,
    Parameter("joint_x", "x", "joint that indicates x"),
    Parameter("joint_y", "y", "joint that indicates y"),
    Parameter("joint_theta", "theta", "joint that indicates theta"),
    Parameter("interpolation", "bilinear", "between nodes", choices=("bilinear", "bicubic")),
    Parameter("outside", "clamp", "outside the field", choices=("clamp", "refuse")),
    Parameter("map", "", "RESULT.json to start with; empty = wait for selfcal/error_map"),
    Parameter("require_qualified", True, "use only maps that are qualified, of one run, and of "
              "all planned views; false = any map"),
    Parameter("max_map_age", 0.0, "age of the map in use above which there is a warning; "
              "0 = none", "s", 0.0, 1e9),
)
PLAYER = (
    Parameter("bag", "", "MCAP file or rosbag2 folder"),
    Parameter("rate", 1.0, "speed of the replay; 0 = as fast as the subscribers keep up",
              "", 0.0, 1000.0),
    Parameter("seed", -1, "shuffle the order of arrival with this seed; -1 = as recorded",
              "", -1, 2**31),
    Parameter("wait_for_subscribers", 10.0, "longest wait for a subscriber of each topic",
              "s", 0.0, 3600.0),
)
RECORDER = (
    Parameter("bag", "", "folder to write"),
    Parameter("all_topics", True, "record selfcal/* results beside the inputs"),
)
_LENGTH: dict[str, Any] = {"unit": "m", "low": 0.0, "high": 1e-3}
_ANGLE: dict[str, Any] = {"unit": "rad", "low": 0.0, "high": 0.1}
_RATIO: dict[str, Any] = {"unit": "m/m", "low": -0.1, "high": 0.1}
_DRIFT = "motion of the plate at the last grid exposure of a view, standard deviation: "

SIMULATOR = (
    _SENSE, _FRAME, _PLAN,
    Parameter("seed", 0, "seed of the truth and of the noise", "", 0, 2**31),
    Parameter("sigma_xy", 2e-8, "standard deviation of one grid reading", **_LENGTH),
    Parameter("sigma_theta", 1.7453292519943296e-05, "standard deviation of one angular reading",
              **_ANGLE),
    Parameter("encoder_rate", 500.0, "encoder samples a second", "Hz", 1.0, 10000.0),
    Parameter("exposure_period", 0.01, "time between two exposures", "s", 0.001, 10.0),
    Parameter("with_ids", True, "detections name their marks"),
    Parameter("truth_path", "", "JSON file for the known truth; empty = none"),
    Parameter("declare_sigma", False, "detections state their standard deviation"),
    Parameter("servo_sigma", 2e-8, "scatter of the stage about where it stopped", **_LENGTH),
    Parameter("servo_sigma_theta", 1e-7, "the same of theta", **_ANGLE),
    Parameter("stop_sigma", 0.0, "how far from its target the stage stops", **_LENGTH),
    Parameter("stop_sigma_theta", 0.0, "the same of theta", **_ANGLE),
    Parameter("follow_mark", False, "the stage goes to the mark as it lies, not to its nominal "
              "place"),
    Parameter("visit_order", "", "order of the marks where the command asks for none; empty = "
              "serpentine"),
    Parameter("consecutive", False, "all repeats of a mark one after another, in one pass"),
    Parameter("visit_xy", 0.0, "noise shared by the exposures of a visit", **_LENGTH),
    Parameter("flicker_xy", 0.0, "1/f noise of grid readings", **_LENGTH),
    Parameter("flicker_theta", 0.0, "1/f noise of angular readings", **_ANGLE),
    Parameter("resolution_xy", 0.0, "step of the offsets of marks", **_LENGTH),
    Parameter("resolution_theta", 0.0, "step of the offsets of lines", **_ANGLE),
    Parameter("microscope_scale", 0.0, "a true length over the seen one, less 1", **_RATIO),
    Parameter("microscope_stretch", 0.0, "the same for x more, for y less", **_RATIO),
    Parameter("microscope_rotation", 0.0, "turn of the microscope against the stage", "rad", -0.1,
              0.1),
    Parameter("microscope_shear", 0.0, "symmetric shear of the microscope", **_RATIO),
    Parameter("backlash_x", 0.0, "indicated - true position of x after a motion towards plus",
              "m", -1e-3, 1e-3),
    Parameter("backlash_y", 0.0, "the same of y", "m", -1e-3, 1e-3),
    Parameter("plate_scale", 0.0, "growth of the plate in each view after the first, standard "
              "deviation", "m/m", 0.0, 0.1),
    Parameter("plate_shape", 0.0, "bending of the plate in each view after the first, at mid-edge, "
              "standard deviation", **_LENGTH),
    Parameter("drift_linear", 0.0, _DRIFT + "with time", **_LENGTH),
    Parameter("drift_quadratic", 0.0, _DRIFT + "with its square", **_LENGTH),
    Parameter("drift_cubic", 0.0, _DRIFT + "with its cube", **_LENGTH),
    Parameter("drift_walk", 0.0, _DRIFT + "as a random walk", **_LENGTH),
    Parameter("encoder", "independent", "the rotary encoder's error: of its own, or as the "
              "slopes of the axes", choices=("independent", "xy_axes")),
    Parameter("rotation", "finite", "how the plate turns: by a rotation, or as the papers write "
              "it", choices=("finite", "linear")),
)
NODE_PARAMETERS: dict[str, tuple[Parameter, ...]] = {
    node: (*table, _HARDWARE) for node, table in {
        "measurement_collector": COLLECTOR,
        "solver": SOLVER,
        "pose_sequencer": SEQUENCER,
        "compensator": COMPENSATOR,
        "bag_player": PLAYER,
        "bag_recorder": RECORDER,
        "stage_simulator": SIMULATOR,
    }.items()
}
ROS_OWN = ("use_sim_time", "start_type_description_service")


def parameter_values(node: str, overrides: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the value of every parameter of `node`: its default or the checked override.

    Raises
    ------
    InputError
        For an unknown name, a wrong type or a value out of bounds.
    """
    table = {parameter.name: parameter for parameter in NODE_PARAMETERS[node]}
    values = {name: parameter.default for name, parameter in table.items()}
    for name, value in overrides.items():
        if name in ROS_OWN or name.startswith("qos_overrides."):
            continue
        if name not in table:
            raise InputError(f"{where}: {name}", f"{node} has no such parameter",
                             known_are(name, table))
        values[name] = table[name].check(value, where)
    return values


def overrides_in(data: object, node: str, where: str) -> dict[str, Any]:
    """Return what a parsed ROS parameter file sets for `node`, nested names joined by dots.

    Sections count if they are ``/**``, ``**``, the node's name, or end with ``/`` + its name;
    a section of a node that this package does not have is an error.
    """
    found: dict[str, Any] = {}
    for name, section in _sections(data, "", where):
        last = name.rsplit("/", 1)[-1]
        if last not in ("**", "*") and last not in NODE_PARAMETERS:
            raise InputError(f"{where}: {name}", "no node of this package",
                             known_are(last, NODE_PARAMETERS))
        if last == node or last in ("**", "*"):
            flat = dict(_flatten(section, ""))
            if last != node:  # a wild-card section may hold parameters of other nodes
                known = {parameter.name for parameter in NODE_PARAMETERS[node]}
                everywhere = {p.name for table in NODE_PARAMETERS.values() for p in table}
                flat = {key: value for key, value in flat.items()
                        if key in known or key not in everywhere}
            found |= flat
    return found


def _sections(data: object, prefix: str, where: str) -> list[tuple[str, dict]]:
    if not isinstance(data, dict):
        raise InputError(where, "not a ROS parameter file", "write 'NODE: ros__parameters: ...'")
    out = []
    for key, value in data.items():
        if key == "ros__parameters":
            if not isinstance(value, dict | None):
                raise InputError(f"{where}: {prefix}", "ros__parameters is not a mapping",
                                 "write 'name: value' lines below it")
            out.append((prefix, value or {}))
        else:
            out += _sections(value, f"{prefix}/{key}".replace("//", "/"), where)
    return out


def _flatten(section: dict, prefix: str) -> list[tuple[str, Any]]:
    out = []
    for key, value in section.items():
        name = f"{prefix}{key}"
        out += _flatten(value, name + ".") if isinstance(value, dict) else [(name, value)]
    return out


def solver_options(values: dict[str, Any], measurements: Measurements | None = None) -> Options:
    """Return the estimator's options in a solver's parameter values.

    Where `model_terms` is not given the terms that the plan of the `measurements` asks for hold.

    Raises
    ------
    InputError
        For terms that cannot be.
    """
    kind = values["reference_kind"]
    reference = None if kind == "none" else ReferenceLength(
        ReferenceKind(kind), values["reference_error"], values["reference_u"],
        values["reference_certificate"])
    terms, origin = _terms(values["model_terms"], measurements)
    return Options(method=values["method"], datum_theta=ThetaDatum(values["theta_datum"]),
                   misalignment_model="" if values["method"] == "law" else
                   values["misalignment_model"], reference=reference,
                   uncertainty=_UNCERTAINTY[values["uncertainty"]],
                   terms=terms, terms_from=origin if terms else "",
                   drift_degree=values["drift_degree"])


def _terms(given: list[str],
           measurements: Measurements | None) -> tuple[tuple[ModelTerm, ...], str]:
    """Return the terms of the model, and where they come from: ``options`` or ``plan``."""
    if [text.strip() for text in given] == [NO_TERMS]:
        return (), ""
    if any(text.strip() for text in given) or measurements is None:
        return parse_terms(given, "model_terms"), "options"
    where = f"plan '{measurements.plan_id}': model_terms"
    return parse_terms(measurements.model_terms, where), "plan"
