# SPDX-License-Identifier: Apache-2.0
"""Every parameter of every node, declared once: type, default, unit, bounds and description.

The nodes declare these parameters, ``selfcal solve --params`` checks a ROS parameter file against
the same classes, and the documentation is generated from them. An unknown name is an error.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, get_args

from selfcal_ros.blocks import BUILT_IN
from selfcal_ros.compensation.cells import Interpolation, Outside
from selfcal_ros.errors import InputError, did_you_mean, known_are
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.reference import ReferenceKind
from selfcal_ros.model.terms import DRIFT_DEGREE, MAX_DRIFT_DEGREE
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.parameter import (
    ManagedSettings,
    Parameter,
    Settings,
    declared,
)

NO_TERMS = "none"
"""The word for no terms, which overrides those of the plan."""

UNCERTAINTY = {"auto": None, "always": True, "never": False}
"""Values of the parameter `uncertainty`; None lets the size decide."""

_LENGTH: dict[str, Any] = {"unit": "m", "low": 0.0, "high": 1e-3}
_ANGLE: dict[str, Any] = {"unit": "rad", "low": 0.0, "high": 0.1}
_RATIO: dict[str, Any] = {"unit": "m/m", "low": -0.1, "high": 0.1}
_DRIFT = "motion of the plate at the last grid exposure of a view, standard deviation, growing "


def _sense() -> Any:
    return declared(
        str(Sense.MICROSCOPE_MOVES),
        "what moves: the microscope over a resting plate, or the plate under the microscope",
        choices=tuple(str(sense) for sense in Sense),
    )


def _frame() -> Any:
    return declared("stage", "frame of published messages (REP-103)")


def _plan() -> Any:
    return declared("", "path of PLAN.yaml")


@dataclass(frozen=True)
class CollectorSettings(ManagedSettings):
    """How measurement_collector treats samples and detections."""

    NODE: ClassVar[str] = "measurement_collector"
    measurement_sense: str = _sense()
    frame_id: str = _frame()
    joint_x: str = declared("x", "name of the joint that indicates x")
    joint_y: str = declared("y", "name of the joint that indicates y")
    joint_theta: str = declared("theta", "name of the joint that indicates theta")
    max_encoder_gap: float = declared(
        0.1,
        "largest gap between the encoder samples around an exposure",
        "s",
        1e-6,
        10.0,
    )
    max_speed: float = declared(
        5e-4, "largest speed at which the stage counts as at rest", "m/s", 0.0, 1.0
    )
    max_angular_speed: float = declared(
        5e-3,
        "largest turn rate at which the stage counts as at rest",
        "rad/s",
        0.0,
        10.0,
    )
    encoder_agreement: float = declared(
        1e-9,
        "largest difference between two samples with the same stamp",
        "m or rad",
        0.0,
        1e-3,
    )
    min_score: float = declared(
        0.4, "smallest score of a usable detection (ignored if all are 0)", "", 0.0, 1.0
    )
    max_deviation: float = declared(
        5e-4,
        "largest distance of a mark from its nominal position after removal of the view's "
        "own rotation and offset; never more than a quarter pitch",
        "m",
        1e-9,
        1.0,
    )
    ambiguity_ratio: float = declared(
        0.5,
        "a mark without id is ambiguous if the ratio of its distances to the nearest and "
        "second nearest nominal mark exceeds this",
        "",
        0.01,
        1.0,
    )
    max_rotation: float = declared(
        0.035,
        "largest rotational misalignment to expect when marks have no ids; in views of "
        "lines alone it must be below 0.45 of a line",
        "rad",
        0.0,
        0.2,
    )
    max_stage_distance: float = declared(
        0.0,
        "largest distance of the indicated stage position from the nominal site of the "
        "detected mark; 0 = half a pitch plus max_rotation times the radius of the plate",
        "m",
        0.0,
        10.0,
    )
    outlier_limit: float = declared(
        6.0,
        "distance from the median of a mark's repeats, in standard deviations of one reading, "
        "beyond which a repeat is an outlier; 0 = keep all",
        "",
        0.0,
        1000.0,
    )
    min_repeats: int = declared(
        0,
        "good readings that complete a mark once it has been read as often as the plan asks, "
        "outliers included; 0 = as many as the plan asks",
        "",
        0,
        1_000_000,
    )
    approach_threshold: float = declared(
        1e-6,
        "smallest displacement of x or y before an exposure that counts as a motion and "
        "gives the direction of approach",
        "m",
        0.0,
        1e-2,
    )
    status_period: float = declared(
        0.5, "time between two ViewStatus messages", "s", 0.02, 60.0
    )
    clock_limit: float = declared(
        0.1,
        "offset between the cell's clock and this machine's above which there is a warning; "
        "a view is not declared complete on stamps that far in the future",
        "s",
        0.001,
        3600.0,
    )
    encoder_rate_min: float = declared(
        0.0,
        "encoder samples per second below which there is a warning while a view is measured; "
        "0 = none",
        "Hz",
        0.0,
        1e5,
    )
    encoder_jitter_limit: float = declared(
        0.0,
        "half of the range of 95 % of the intervals between encoder samples above which there "
        "is a warning while a view is measured; 0 = none",
        "s",
        0.0,
        10.0,
    )
    repeatability_xy_limit: float = declared(
        0.0,
        "repeatability of one grid reading above which there is a warning; 0 = none",
        "m",
        0.0,
        1e-3,
    )
    repeatability_theta_limit: float = declared(
        0.0,
        "repeatability of one angular reading above which there is a warning; 0 = none",
        "rad",
        0.0,
        0.1,
    )
    journal: str = declared(
        "",
        "folder for journals: received messages, written before they are used, from which a "
        "run resumes after a crash; empty or none = no journal",
    )
    journal_lag_limit: float = declared(
        5.0,
        "time by which the disk may lag behind the journal before there is a warning",
        "s",
        0.1,
        3600.0,
    )
    journal_max_age: float = declared(
        86400.0,
        "time since the last message of a journal after which its run is not resumed",
        "s",
        0.0,
        1e8,
    )


@dataclass(frozen=True)
class SolverSettings(ManagedSettings):
    """How solver estimates, and where it writes."""

    NODE: ClassVar[str] = "solver"
    frame_id: str = _frame()
    method: str = declared("joint", "estimator", choices=("joint", "law"))
    theta_datum: str = declared(
        str(ThetaDatum.ZERO_MEAN),
        "condition that fixes the constant of the angular map",
        choices=tuple(str(datum) for datum in ThetaDatum),
    )
    misalignment_model: str = declared(
        "rigid",
        "rotation of the plate in the joint method: rigid = finite, or linear = as "
        "published; the law is always linear",
        choices=("linear", "rigid"),
    )
    uncertainty: str = declared(
        "auto",
        "uncertainty map of the joint solution: auto = up to 201 x 201 sites; always = up "
        "to 401 x 401, in many seconds",
        choices=tuple(UNCERTAINTY),
    )
    reference_kind: str = declared(
        "none",
        "object on which a known length was measured, which sets the scale",
        choices=("none", *map(str, ReferenceKind)),
    )
    reference_error: float = declared(
        0.0,
        "relative error of that length: artifact (true - nominal) / nominal, stage axis "
        "(indicated - true) / nominal",
        "m/m",
        -0.09,
        0.09,
    )
    reference_u: float = declared(
        0.0, "standard uncertainty of that (k=1)", "m/m", 0.0, 0.09
    )
    reference_marks: str = declared(
        "",
        "kind marks: marks, distance, its u (m), M,N:M,N:LENGTH:U; of a list ID:ID:LENGTH:U",
    )
    reference_certificate: str = declared(
        "", "certificate of the known length: number, issuer"
    )
    reference_at: str = declared(
        "",
        "temperatures for converting that length to the measurement: T:U_T:ALPHA:U_ALPHA[:T0], "
        "e.g. 20.4:0.05:0.5e-6:0.05e-6 (docs/guides/certificate.md); empty = measured where it "
        "is used",
    )
    model_terms: list[str] = declared(
        [""],
        f"terms estimated with the map, each TERM or TERM:SIZE of {', '.join(BUILT_IN)}; the "
        f"size is a standard deviation, SI; 0 = exactly zero; empty = those of the plan; "
        f"{NO_TERMS} = none, not even those assumed by default",
    )
    scale_u: float = declared(
        0.01,
        "standard uncertainty of the microscope's scale, if plan and model_terms do not "
        "state it; 0 = known exactly",
        "m/m",
        0.0,
        1.0,
    )
    rotation_u: float = declared(
        0.01,
        "standard uncertainty of the microscope's rotation relative to the axes, likewise",
        "rad",
        0.0,
        1.0,
    )
    shear_u: float = declared(
        0.002,
        "standard uncertainty of half the difference of the microscope's scales, and of "
        "half its error of squareness, likewise",
        "m/m",
        0.0,
        1.0,
    )
    magnification_limit: float = declared(
        1e-4,
        "difference of the scales of plate and encoders above which there is a warning",
        "m/m",
        0.0,
        1.0,
    )
    drift_degree: int = declared(
        DRIFT_DEGREE,
        "degree of the polynomial of time for the drift of a view, if drift is a term",
        "",
        1,
        MAX_DRIFT_DEGREE,
    )
    robust: bool = declared(False, "leave out readings that contradict the others")
    save_path: str = declared(
        "",
        "RESULT.json to write whenever the map changes; {run_id} in it "
        "is replaced by the run; empty = none",
    )
    result_folder: str = declared(
        "",
        "folder in which save_map may write, and to which paths are relative; empty = "
        "the working directory",
    )


@dataclass(frozen=True)
class SequencerSettings(ManagedSettings):
    """How pose_sequencer leads through a plan."""

    NODE: ClassVar[str] = "pose_sequencer"
    plan: str = _plan()
    frame_id: str = _frame()
    auto_start: bool = declared(
        False, "start the plan without waiting for the start service"
    )
    start_checks: bool = declared(
        True,
        "start only when collector, encoder, detections and solver are present; false = "
        "start without",
    )
    resume: bool = declared(
        True,
        "the first start resumes the unfinished run of the plan that the collector knows",
    )
    stall_time: float = declared(
        5.0,
        "time without a detection after which a view is reported as stalled",
        "s",
        0.1,
        3600.0,
    )
    auto_confirm: bool = declared(
        False, "measure without waiting for confirm_view (robot loaders)"
    )
    settle_time: float = declared(
        0.5, "time between PLACE and MEASURE when auto_confirm is set", "s", 0.0, 3600.0
    )
    view_timeout: float = declared(
        0.0,
        "time after which waiting for a view's completion ends; 0 = wait forever",
        "s",
        0.0,
        1e6,
    )
    max_redos: int = declared(
        0, "redos of an incomplete view after a time-out", "", 0, 100
    )
    result_path: str = declared(
        "",
        "file to which run_calibration has the solver save the map; empty = PLAN_ID.json in "
        "the solver's result_folder",
    )
    save_timeout: float = declared(
        60.0, "longest wait of run_calibration for the solver to save", "s", 0.1, 3600.0
    )


@dataclass(frozen=True)
class CompensatorSettings(ManagedSettings):
    """Which map compensator uses, and how."""

    NODE: ClassVar[str] = "compensator"
    frame_id: str = declared(
        "stage",
        "frame of the positions to correct; a map that states another one is not used",
    )
    joint_x: str = declared("x", "name of the joint that indicates x")
    joint_y: str = declared("y", "name of the joint that indicates y")
    joint_theta: str = declared("theta", "name of the joint that indicates theta")
    interpolation: Interpolation = declared(
        "bilinear",
        "interpolation between nodes, unless the map states its own",
        choices=get_args(Interpolation),
    )
    outside: Outside = declared(
        "clamp", "treatment of positions outside the field", choices=get_args(Outside)
    )
    map: str = declared(
        "",
        "RESULT.json to start with, or a folder with an active map (selfcal history); "
        "empty = wait for selfcal/error_map",
    )
    require_qualified: bool = declared(
        True,
        "use only maps that are qualified, of one run, and based on all planned views; false "
        "= any map",
    )
    max_correction: float = declared(
        1e-3,
        "largest error of a map that is used: of a site, and of the farthest site by the "
        "angular map",
        "m",
        1e-9,
        1.0,
    )
    max_map_age: float = declared(
        0.0,
        "age of the map in use above which there is a warning; 0 = none",
        "s",
        0.0,
        1e9,
    )
    max_age: float = declared(
        0.02,
        "time from the reception of a sample to its corrected one above which there is a warning",
        "s",
        0.0,
        3600.0,
    )


@dataclass(frozen=True)
class PlayerSettings(Settings):
    """What bag_player plays and how."""

    NODE: ClassVar[str] = "bag_player"
    bag: str = declared("", "MCAP file or rosbag2 folder")
    rate: float = declared(
        1.0,
        "speed of the replay; 0 = as fast as the subscribers keep up",
        "",
        0.0,
        1000.0,
    )
    seed: int = declared(
        -1,
        "shuffle the order of arrival with this seed; -1 = as recorded",
        "",
        -1,
        2**31,
    )
    listener: str = declared(
        CollectorSettings.NODE,
        "node that must subscribe to every topic of the bag before the first message "
        "is played, in the player's namespace unless it begins with /; empty = play "
        "without waiting",
    )
    wait_for_subscribers: float = declared(
        30.0,
        "longest wait for that node, after which the player ends with code 2 without having "
        "played anything; 0 = play without waiting",
        "s",
        0.0,
        3600.0,
    )
    beside_others: bool = declared(
        False,
        "also play where another node publishes on the topics played, e.g. the driver of a "
        "stage; false = end with code 2 and the name of that node",
    )


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """What bag_recorder writes."""

    NODE: ClassVar[str] = "bag_recorder"
    bag: str = declared("", "folder to write")
    all_topics: bool = declared(
        True, "record selfcal/* results in addition to the inputs"
    )


@dataclass(frozen=True)
class DriverSettings(Settings):
    """The machine that cell_driver drives."""

    NODE: ClassVar[str] = "cell_driver"
    frame_id: str = _frame()
    cell: str = declared("", "path of CELL.yaml (docs/start/machines.md)")


@dataclass(frozen=True)
class SimulatorSettings(Settings):
    """The cell of stage_simulator, by the keys of SIM.yaml (docs/guides/simulate.md)."""

    NODE: ClassVar[str] = "stage_simulator"
    measurement_sense: str = _sense()
    frame_id: str = _frame()
    plan: str = _plan()
    seed: int = declared(0, "seed of the truth and of the noise", "", 0, 2**31)
    sigma_xy: float = declared(
        2e-8, "standard deviation of one grid reading", **_LENGTH
    )
    sigma_theta: float = declared(
        1.7453292519943296e-05, "standard deviation of one angular reading", **_ANGLE
    )
    noise_ratio: float = declared(1.0, "noise of y over that of x", "", 0.0, 100.0)
    encoder_rate: float = declared(
        500.0, "encoder samples per second", "Hz", 1.0, 10000.0
    )
    exposure_period: float = declared(
        0.01, "time between two exposures", "s", 0.001, 10.0
    )
    with_ids: bool = declared(True, "detections name their marks")
    truth_path: str = declared("", "JSON file for the known truth; empty = none")
    camera: str = declared(
        "", "SIM.yaml: camera for images, sizes of the truth; empty = none"
    )
    declare_sigma: bool = declared(False, "detections state their standard deviation")
    servo_sigma: float = declared(
        2e-8, "scatter of the stage about its stop position", **_LENGTH
    )
    servo_sigma_theta: float = declared(1e-7, "the same of theta", **_ANGLE)
    encoder_sigma: float = declared(
        0.0, "noise of the encoder readings, without motion", **_LENGTH
    )
    encoder_sigma_theta: float = declared(0.0, "the same of theta", **_ANGLE)
    stop_sigma: float = declared(
        0.0, "stop error of the stage relative to its target", **_LENGTH
    )
    stop_sigma_theta: float = declared(0.0, "the same of theta", **_ANGLE)
    follow_mark: bool = declared(
        False,
        "the stage goes to the actual position of the mark, not to the nominal one",
    )
    visit_order: str = declared(
        "", "order of the marks if the command specifies none; empty = serpentine"
    )
    consecutive: bool = declared(
        False, "all repeats of a mark consecutively, in one pass"
    )
    visit_xy: float = declared(
        0.0, "noise shared by the exposures of a visit", **_LENGTH
    )
    image_xy: float = declared(0.0, "noise shared by the marks of an image", **_LENGTH)
    flicker_xy: float = declared(0.0, "1/f noise of grid readings", **_LENGTH)
    flicker_theta: float = declared(0.0, "1/f noise of angular readings", **_ANGLE)
    resolution_xy: float = declared(0.0, "step of the offsets of marks", **_LENGTH)
    resolution_theta: float = declared(0.0, "step of the offsets of lines", **_ANGLE)
    microscope_scale: float = declared(
        0.0, "true over measured length, minus 1", **_RATIO
    )
    microscope_stretch: float = declared(
        0.0, "the same, positive for x, negative for y", **_RATIO
    )
    microscope_rotation: float = declared(
        0.0, "rotation of the microscope relative to the stage", "rad", -0.1, 0.1
    )
    microscope_shear: float = declared(
        0.0, "symmetric shear of the microscope", **_RATIO
    )
    microscope_axes: str = declared(
        "xy",
        "what is published as x and y of an offset",
        choices=("xy", "-x-y", "-xy", "x-y", "yx", "-y-x", "y-x", "-yx"),
    )
    microscope_pixels: float = declared(
        1.0, "published over measured offset", "", -100.0, 100.0
    )
    line_factor: float = declared(
        1.0, "published over true offset of a line", "", -100.0, 100.0
    )
    microscope_distortion: float = declared(
        0.0,
        "relative amount by which offsets are too long at the edge of the microscope's field",
        **_RATIO,
    )
    microscope_field: float = declared(
        250e-6, "distance of that edge from the optical axis", "m", 1e-6, 1e-3
    )
    optical_tilt_x: float = declared(
        0.0,
        "tilt of the optical axis: a mark appears shifted by it times its height",
        "rad",
        -0.1,
        0.1,
    )
    optical_tilt_y: float = declared(0.0, "the same along y", "rad", -0.1, 0.1)
    backlash_x: float = declared(
        0.0,
        "indicated - true position of x after a motion in + direction",
        "m",
        -1e-3,
        1e-3,
    )
    backlash_y: float = declared(0.0, "the same of y", "m", -1e-3, 1e-3)
    backlash_growth: float = declared(
        0.0, "growth of both during a view", "m", -1e-3, 1e-3
    )
    settling: float = declared(
        0.0,
        "distance by which an axis is short of its position at the exposure after a motion",
        "m",
        -1e-3,
        1e-3,
    )
    settling_time: float = declared(
        0.01, "time in which this falls to 1/e at rest", "s", 1e-6, 3600.0
    )
    stage_bend: float = declared(
        0.0,
        "bending of the stage in each view, at mid-edge, standard deviation",
        **_LENGTH,
    )
    stage_yaw: float = declared(
        0.0, "rotation of the stage from site to site, standard deviation", **_ANGLE
    )
    plate_scale: float = declared(
        0.0,
        "growth of the plate in views after the first, standard deviation",
        "m/m",
        0.0,
        0.1,
    )
    plate_shape: float = declared(
        0.0,
        "bending of the plate in each view after the first, at mid-edge, standard deviation",
        **_LENGTH,
    )
    plate_strain: float = declared(
        0.0,
        "strain of the plate in views after the first, standard deviation",
        "m/m",
        0.0,
        0.1,
    )
    plate_tilt: float = declared(
        0.0, "tilt of the plate in each view, standard deviation", **_ANGLE
    )
    plate_bow: float = declared(
        0.0, "height of the plate's centre above its edges", "m", -1e-3, 1e-3
    )
    line_eccentricity: float = declared(
        0.0,
        "eccentricity of the circle of lines in each view, over its radius, standard deviation",
        **_ANGLE,
    )
    pitch_error: float = declared(0.0, "true over declared pitch, minus 1", **_RATIO)
    drift_linear: float = declared(0.0, _DRIFT + "with time", **_LENGTH)
    drift_quadratic: float = declared(0.0, _DRIFT + "with time squared", **_LENGTH)
    drift_cubic: float = declared(0.0, _DRIFT + "with time cubed", **_LENGTH)
    drift_walk: float = declared(0.0, _DRIFT + "as a random walk", **_LENGTH)
    encoder: str = declared(
        "independent",
        "error of the rotary encoder: independent, or following the slopes of the axes",
        choices=("independent", "xy_axes"),
    )
    rotation: str = declared(
        "finite",
        "rotation of the plate: finite, or linearised as in the papers",
        choices=("finite", "linear"),
    )


NODE_SETTINGS: dict[str, type[Settings]] = {
    kind.NODE: kind
    for kind in (
        CollectorSettings,
        SolverSettings,
        SequencerSettings,
        CompensatorSettings,
        DetectorSettings,
        PlayerSettings,
        RecorderSettings,
        DriverSettings,
        SimulatorSettings,
    )
}
NODE_PARAMETERS: dict[str, tuple[Parameter, ...]] = {
    node: kind.parameters() for node, kind in NODE_SETTINGS.items()
}


def overrides_in(data: object, node: str, where: str) -> dict[str, Any]:
    """Return what a parsed ROS parameter file sets for `node`, nested names joined by dots.

    Sections count if they are ``/**``, ``**``, the node's name, or end with ``/`` + its name;
    a section of a node that this package does not have is an error, and so are two cells
    that differ.
    """
    overrides: dict[str, Any] = {}
    section_of: dict[str, str] = {}
    for name, section in _sections(data, "", where):
        last = name.rsplit("/", 1)[-1]
        if last not in ("**", "*") and last not in NODE_PARAMETERS:
            raise InputError(
                f"{where}: {name}",
                "no node of this package",
                known_are(last, NODE_PARAMETERS),
            )
        if last == node or last in ("**", "*"):
            flat = dict(_flatten(section, ""))
            if last != node:  # a wild-card section may hold parameters of other nodes
                names_of_node = {parameter.name for parameter in NODE_PARAMETERS[node]}
                everywhere = {
                    p.name for table in NODE_PARAMETERS.values() for p in table
                }
                flat = {
                    key: value
                    for key, value in flat.items()
                    if key in names_of_node or key not in everywhere
                }
            for key in flat if "*" not in name else ():
                if (
                    section_of.setdefault(key, name) != name
                    and flat[key] != overrides[key]
                ):
                    raise InputError(
                        f"{where}: {key}",
                        f"differs between {section_of[key]} and {name}",
                        "give a file of one cell",
                    )
            overrides |= flat
    return overrides


def check_parameters(data: object, where: str) -> None:
    """Refuse a parsed ROS parameter file with a misspelt node or name, or a value of another kind.

    Each section is checked by itself: those of several cells may differ. Nodes of other packages
    may be in the file, and their parameters in a section of all nodes.

    Raises
    ------
    InputError
        For the first of them.
    """
    of_any_node = {p.name for table in NODE_PARAMETERS.values() for p in table}
    for name, section in _sections(data, "", where):
        last = name.rsplit("/", 1)[-1]
        if last in ("**", "*"):
            for key in section:
                hint = did_you_mean(str(key), of_any_node)
                if key not in of_any_node and hint:
                    raise InputError(f"{where}: {key}", "no node has it", hint)
            section = {key: section[key] for key in section if key in of_any_node}
        elif last not in NODE_PARAMETERS and not did_you_mean(last, NODE_PARAMETERS):
            continue
        alone = {name: {"ros__parameters": section}}
        for node, kind in NODE_SETTINGS.items():
            kind.checked(overrides_in(alone, node, where), where)


def _sections(data: object, prefix: str, where: str) -> list[tuple[str, dict]]:
    if not isinstance(data, dict):
        raise InputError(
            where, "not a ROS parameter file", "write 'NODE: ros__parameters: ...'"
        )
    out = []
    for key, value in data.items():
        if key == "ros__parameters":
            if not isinstance(value, dict | None):
                raise InputError(
                    f"{where}: {prefix}",
                    "ros__parameters is not a mapping",
                    "write 'name: value' lines below it",
                )
            out.append((prefix, value or {}))
        else:
            out += _sections(value, f"{prefix}/{key}".replace("//", "/"), where)
    return out


def _flatten(section: dict, prefix: str) -> list[tuple[str, Any]]:
    out = []
    for key, value in section.items():
        name = f"{prefix}{key}"
        out += (
            _flatten(value, name + ".") if isinstance(value, dict) else [(name, value)]
        )
    return out
