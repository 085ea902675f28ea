# SPDX-License-Identifier: Apache-2.0
"""``selfcal plan new``: a plan and a cell from what a person knows of stage, plate and time."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from selfcal_ros.cli.terminal import add_json, late_progress, say
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.estimation.normal.equations import planned_system
from selfcal_ros.estimation.observability.plan_check import (
    CHECK_MARKS,
    CHECK_OFFSET_M,
    candidate_views,
    check_plan,
    measured_like,
    predict_plan,
)
from selfcal_ros.estimation.observability.resistance import PlanBudget, plan_budget
from selfcal_ros.estimation.observability.suggest import (
    Against,
    best_plan,
    rank_next,
    score_plan,
)
from selfcal_ros.estimation.terms.planned import Assumed
from selfcal_ros.files import yaml_text
from selfcal_ros.machine.cell import PLACERS, SHIPPED, known_machines
from selfcal_ros.machine.visiting import stops
from selfcal_ros.model.artifact import DEFAULT_NODES, Artifact, MapGrid
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.plan_form import MAX_VIEWS, plan_to_dict, view_to_dict
from selfcal_ros.model.pose import ImageCells
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import default_terms
from selfcal_ros.model.view import MOST_CHECK_OFFSET, Plan, View
from selfcal_ros.outputs import check_outputs, refuse_existing, utf8, write_together
from selfcal_ros.plain_numbers import number_of, quantity_of
from selfcal_ros.reporting.words.observability import (
    describe_view,
    worded_observability,
)
from selfcal_ros.units import M_PER, MM_PER_M, UM_PER_M

REPEATS = {1: "", 2: "there_and_back@plate", 4: "x_back_y_back@plate"}
"""Measurements of a mark in a view -> the order of the visits that completes them."""
MOST_VIEWS = 5
"""Views of marks of the longest plan; a view of the lines comes on top."""
PLACING_MIN = {"person": 5.0, "robot": 0.5}
"""Minutes that a placing of the plate takes."""
STEPS = (0.75, 0.5)
"""Steps of a plate over a longer stage, as parts of the plate: what is left of it overlaps, and
joins the views."""
NODES_APART = 2
"""Distance of the nodes of a map wider than the plate, in pitches: the marks beside each node are
read in several views, so that one pass tests whether the stage is smooth enough for them."""
PIXELS_A_MARK = 12
"""Pixels across a mark of the simulated camera."""
OWN_KEYS = {
    "gcode": "{port: /dev/ttyUSB0, dialect: grbl, feed: 600.0, camera: 0}",
    "joint_trajectory": "{joints: [x, y], image: camera/image_raw}",
    "micromanager": "{config: microscope.cfg}",
    "ophyd": "{x: 'beamline:stage.x', y: 'beamline:stage.y', unit: mm, "
    "detector: 'beamline:camera', image: image1.image}",
}
"""Machine -> its own keys in CELL.yaml, to be edited."""
KNOWN_AS = {
    "gcode": "CNC, printer",
    "joint_trajectory": "ros2_control",
    "ophyd": "EPICS",
    "micromanager": "microscope",
}
"""Machine -> what its owner calls it."""
OFTEN = {1: "once", 2: "twice"}


@dataclass(frozen=True)
class Question:
    """What a person is asked, and the option that answers it.

    `default` is the answer of an empty line; without one there is none.
    """

    name: str
    text: str
    read: Callable[[str, str], Any]
    default: str = ""


@dataclass(frozen=True)
class Known:
    """The answers; lengths in m, `seconds` of an exposure with its move."""

    travel: tuple[float, float]
    marks: tuple[int, int]
    pitch: float
    lines: int
    field: tuple[float, float]
    placing: str
    minutes: float
    seconds: float
    machine: str

    @property
    def is_simulated(self) -> bool:
        """Whether the machine is a simulation."""
        return self.machine == "simulated"

    @property
    def has_camera(self) -> bool:
        """Whether the camera sees several marks at once."""
        return any(self.field)

    @property
    def mark_size_m(self) -> float:
        """The size of a mark, the default of `selfcal plate`."""
        return self.pitch / 5


def _length(text: str, option: str) -> float:
    """Return a length with a unit, m."""
    try:
        value, unit = quantity_of(text, M_PER)
    except ValueError:
        value, unit = math.nan, ""
    if not 0 < value < math.inf:
        raise InputError(
            option,
            f"'{text}' is not a positive length",
            "write a number with m, mm, um or nm, as in 10mm",
        )
    if not unit:
        raise InputError(option, f"'{text}' has no unit", "write for example 10mm")
    return value


def _lengths(text: str, option: str) -> tuple[float, float]:
    """Return one or two lengths such as 100x80mm, m."""
    x, _, y = text.partition("x")
    unit = re.search(r"[a-zµμ]*\s*$", y)
    assert unit  # it may be empty
    return _length(x if x.strip()[-1:] == "m" else x + unit[0], option), _length(
        y or x, option
    )


def _field(text: str, option: str) -> tuple[float, float]:
    return (0.0, 0.0) if text == "none" else _lengths(text, option)


def _counts(text: str, option: str) -> tuple[int, int]:
    """Return one or two numbers such as 11x9."""
    x, _, y = text.partition("x")
    return _count(x, option), _count(y or x, option)


def _count(text: str, option: str) -> int:
    if not (text.isascii() and text.strip().isdecimal()):
        raise InputError(
            option, f"'{text}' is not a whole number", "give for example 11"
        )
    return int(text)


def _positive(text: str, option: str) -> float:
    try:
        value = number_of(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise InputError(
            option, f"'{text}' is not a number above 0", "give for example 1.5"
        )
    return value


def _one_of(*words: str) -> Callable[[str, str], str]:
    def read(text: str, option: str) -> str:
        if text not in words:
            raise InputError(
                option, f"'{text}' is not one of {', '.join(words)}", "name one"
            )
        return text

    return read


def _known_as(machine: str) -> str:
    owners = KNOWN_AS.get(machine)
    return f"{machine} ({owners})" if owners else machine


QUESTIONS = (
    Question("travel", "travel of the stage, as in 120mm or 120x100mm", _lengths),
    Question("marks", "marks along a side of the plate, as in 11 or 11x9", _counts),
    Question("pitch", "distance between neighbouring marks, as in 10mm", _length),
    Question(
        "machine",
        f"what is driven: {', '.join(map(_known_as, SHIPPED))}, or another package's",
        lambda text, option: _one_of(*known_machines())(text, option),
        "simulated",
    ),
    Question(
        "lines",
        "angular lines of the plate; 0 = none, or the stage does not turn",
        _count,
        "0",
    ),
    Question(
        "field",
        "what the camera sees at once, as in 25x20mm; none = one mark",
        _field,
        "none",
    ),
    Question(
        "placing", "who places the plate: person or robot", _one_of(*PLACERS), "person"
    ),
    Question("minutes", "minutes that the measurement may take", _positive, "60"),
    Question(
        "seconds", "seconds for a mark: move, come to rest, expose", _positive, "2"
    ),
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options; in a terminal what is missing is asked."""
    parser.description = (
        "Writes a plan and a CELL.yaml to be completed, and says what the plan will determine and "
        "how long it takes. In a terminal it asks; a script gives --travel, --marks and --pitch, "
        "and what differs from the defaults."
    )
    for question in QUESTIONS:
        default = f" (default: {question.default})" if question.default else ""
        parser.add_argument(
            f"--{question.name}",
            metavar=question.name.upper(),
            help=question.text + default,
        )
    parser.add_argument(
        "-o",
        "--output",
        metavar="PLAN.yaml",
        required=True,
        help="plan to write; its name is that of the plan",
    )
    parser.add_argument(
        "--cell",
        metavar="CELL.yaml",
        help="cell to write (default: cell.yaml beside the plan)",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Ask, plan, write and say what the plan will determine."""
    path = Path(args.output)
    cell_path = Path(args.cell) if args.cell else path.with_name("cell.yaml")
    simulation = cell_path.with_name(f"{cell_path.stem}_simulation.yaml")
    if sys.stdin.isatty():  # before anything is asked
        check_outputs([], [path, cell_path])
        refuse_existing([path, cell_path], force=args.force)
    answers = _answers(args)
    artifact = _artifact(answers)
    outputs = [path, cell_path, *([simulation] if answers.is_simulated else [])]
    check_outputs([], outputs)
    refuse_existing(outputs, force=args.force)
    with late_progress("judging plans") as progress:
        plan, why_not = _best(answers, artifact, path.stem, lambda: progress(0, None))
        prediction = _budget(plan), _next(plan)
    texts = {
        path: yaml_text(plan_to_dict(plan)),
        cell_path: _cell_text(answers, simulation.name),
    }
    if answers.is_simulated:
        folder = path.resolve().parent
        named = (
            path.name if folder == simulation.resolve().parent else str(path.resolve())
        )
        texts[simulation] = yaml_text(_simulation(answers, named))
    write_together({name: utf8(text) for name, text in texts.items()})
    say(
        args,
        "\n".join(_text(answers, plan, prediction, why_not, outputs)),
        _json(answers, plan, prediction, why_not, outputs),
    )
    return ExitCode.DONE


def _answers(args: argparse.Namespace) -> Known:
    """Return the answers from the options, and from a person where some are missing."""
    missing = [
        item
        for item in QUESTIONS
        if not item.default and getattr(args, item.name) is None
    ]
    asks = bool(missing) and sys.stdin.isatty()
    if missing and not asks:
        raise InputError(
            f"--{missing[0].name}",
            "is missing, and there is nobody to ask: stdin is not a terminal",
            f"give the {missing[0].text}",
        )
    values: dict[str, Any] = {}
    for item in QUESTIONS:
        answer = getattr(args, item.name)
        # a camera finds no lines
        is_settled = (item.name == "lines" and values["machine"] in OWN_KEYS) or (
            item.name == "field" and values["lines"]
        )
        if answer is None and asks and not is_settled:
            values[item.name] = _answer_to(item)
        else:
            text = item.default if answer is None else answer
            values[item.name] = item.read(text, f"--{item.name}")
        if item.name == "pitch":  # before more is asked
            _require_travel(
                values["travel"], _plate(values["marks"], values["pitch"], lines=0)
            )
    return Known(**values)


def _answer_to(item: Question) -> Any:
    """Ask until there is an answer that can be read."""
    while True:
        default = f" [{item.default}]" if item.default else ""
        print(f"{item.text}{default}: ", end="", file=sys.stderr, flush=True)
        try:
            text = input().strip() or item.default
        except EOFError:
            print(file=sys.stderr)
            raise KeyboardInterrupt from None
        if not text:
            continue
        try:
            return item.read(text, item.name)
        except InputError as error:
            print(f"  {error}", file=sys.stderr)


def _artifact(answers: Known) -> Artifact:
    if answers.lines and answers.has_camera:
        raise InputError(
            "--lines",
            "lines are not found in images, and a camera is given",
            "plan the lines apart, with --field none",
        )
    if answers.lines and answers.machine in OWN_KEYS:
        raise InputError(
            "--lines",
            f"lines are not found in images, and {answers.machine} has nothing but a camera",
            "leave them out: --lines 0",
        )
    return _plate(answers.marks, answers.pitch, answers.lines)


def _plate(marks: tuple[int, int], pitch: float, lines: int) -> Artifact:
    nx, ny = marks
    return Artifact(nx, pitch, lines, 0 if nx == ny else ny)


def _require_travel(travels: tuple[float, float], artifact: Artifact) -> None:
    """Refuse a plate that the stage cannot pass over."""
    aside = _check_offset_m(artifact)
    pitch = artifact.grid_pitch_m
    for axis, travel, count in zip("xy", travels, artifact.shape, strict=True):
        span = (count - 1) * pitch + 2 * aside
        if span > travel:
            fits = int((travel - 2 * aside) / pitch) + 1
            mend = (
                f"take {fits} marks, or marks that are closer"
                if fits >= 3
                else ("take a plate whose marks are closer")
            )
            raise InputError(
                "--travel",
                f"{travel * MM_PER_M:g} mm along {axis}, and {count} marks with their "
                f"check stops need {span * MM_PER_M:g} mm",
                mend,
            )


def _check_offset_m(artifact: Artifact) -> float:
    return min(CHECK_OFFSET_M, MOST_CHECK_OFFSET * artifact.grid_pitch_m)


def _image(answers: Known) -> ImageCells | None:
    """Return the cells that the camera sees; None for a single mark."""
    counts = []
    for side, marks in zip(answers.field, answers.marks, strict=True):
        # 0.6 mm are 3 pitches of 0.2 mm
        n_seen = min(int(side / answers.pitch * (1 + 1e-9)), marks)
        counts.append(max(1, n_seen - 1 + n_seen % 2))
    nx, ny = counts
    return ImageCells(nx, ny, answers.pitch) if nx * ny > 1 else None


def _best(
    answers: Known, artifact: Artifact, name: str, tick: Callable[[], None]
) -> tuple[Plan, str]:
    """Return the plan of the smallest uncertainty that the time allows.

    And where the travel is longer than the plate, but the map is not, what a wider one takes.
    """
    like = View(
        "",
        check_marks=CHECK_MARKS,
        check_offset_m=_check_offset_m(artifact),
        image=_image(answers),
    )
    fewest = _fewest_exposures(artifact, like)
    plans: list[Plan] = []
    for n_views in range(3, MOST_VIEWS + 1):
        if plans and _minutes(answers, n_views, n_views * fewest) > answers.minutes:
            break  # without the search that takes longest
        views = best_plan(
            artifact,
            n_views + bool(answers.lines),
            angular=bool(answers.lines),
            like=like,
            against=_against(),
        )[0].views
        plans += list(_repeated(Plan(name, artifact, views)))
        tick()
        if minutes_of(answers, plans[-len(REPEATS)]) > answers.minutes:
            break
    wider, why_not = _wider(answers, plans[0], tick)
    if wider:
        return min(wider, key=_u_of_reading), ""
    fitting = [plan for plan in plans if minutes_of(answers, plan) <= answers.minutes]
    if not fitting:
        raise InputError(
            "--minutes",
            f"{answers.minutes:g}, and the shortest plan takes "
            f"{math.ceil(minutes_of(answers, plans[0]))}: "
            f"{_counted_visits(plans[0], answers)}",
            "give more minutes, fewer marks, or fewer seconds for a mark",
        )
    return min(fitting, key=_u_of_reading), why_not


def _wider(
    answers: Known, plan: Plan, tick: Callable[[], None]
) -> tuple[list[Plan], str]:
    """Return the plans with maps as wide as the travel that the time allows, or why there are none.

    The views of `plan` tell the plate from the stage; those of the plate stepped over the travel
    carry the map on.
    """
    stepped = []
    for step in STEPS:
        tiles = _tiles(answers, plan, step)
        if not tiles:
            return [], ""
        if len(plan.views) + len(tiles) > MAX_VIEWS:
            break
        artifact = replace(plan.artifact, map_grid=_nodes(plan.artifact, tiles))
        once = replace(plan, artifact=artifact, views=(*plan.views, *tiles))
        untested = planned_system(artifact, once.views).nodes_untested
        plans = list(_repeated(once))
        # in one pass the map would not be qualified
        stepped.append(plans[1:] if untested else plans)
        tick()
    if not stepped:
        return [], (
            f"for a map of all of the travel the plate would be placed more than {MAX_VIEWS} "
            "times: take a longer plate"
        )
    shortest = stepped[0][0]
    fitting = []
    for plans in stepped:
        affordable = [
            each for each in plans if minutes_of(answers, each) <= answers.minutes
        ]
        if affordable and _determines_all(affordable[0]):
            fitting += affordable
        tick()
    if minutes_of(answers, shortest) <= answers.minutes:
        return fitting, (
            "no steps of this plate that the time allows determine a map of all of the travel: "
            "give more minutes, or take a longer plate or one with more marks"
        )
    return fitting, (
        "a map of all of the travel takes "
        f"--minutes {math.ceil(minutes_of(answers, shortest))}: "
        f"{_counted_visits(shortest, answers)}"
    )


def _determines_all(plan: Plan) -> bool:
    checked = check_plan(plan)
    return checked.observability.identifiable and not checked.unknown_sites


def _tiles(answers: Known, plan: Plan, step: float) -> list[View]:
    """Return the views of the plate stepped over the travel; none if it is hardly longer."""
    artifact = plan.artifact
    pitch = artifact.grid_pitch_m
    aside = _check_offset_m(artifact)
    places = []
    for travel, half in zip(answers.travel, artifact.half, strict=True):
        room = math.floor(10 * ((travel / 2 - aside) / pitch - half) + 1e-9) / 10
        n_steps = math.ceil(room / (step * half)) if room >= 1 else 0
        places.append(
            [round(room * (2 * i / n_steps - 1), 1) + 0.0 for i in range(n_steps + 1)]
            if n_steps
            else [0.0]
        )
    return [
        replace(
            plan.views[0],
            name=f"at{x:+g}x{y:+g}y",
            translation_m=(x * pitch, y * pitch),
            angular=False,
        )
        for y in places[1]
        for x in places[0]
        if (x, y) != (0, 0)
    ]


def _nodes(artifact: Artifact, tiles: list[View]) -> MapGrid:
    """Return the nodes of a map of all places that the marks of stepped views reach."""
    pitch = artifact.grid_pitch_m
    sides = [
        2 * (max(view.translation_m[axis] for view in tiles) / pitch + half)
        for axis, half in enumerate(artifact.half)
    ]
    longer = max(sides)
    most = max(2, min(int(longer / NODES_APART + 1e-9), DEFAULT_NODES - 1))

    def beyond(cells: int) -> float:
        """Return how far, in cells, the outermost nodes lie beyond the shorter side."""
        shorter = cells * min(sides) / longer
        return round(math.ceil(shorter - 1e-9) - shorter, 9)

    # of nearly the largest numbers that whose cells fit the shorter side best
    cells = min(range(most, math.ceil(0.75 * most) - 1, -1), key=beyond)
    nx, ny = (max(3, math.ceil(cells * side / longer - 1e-9) + 1) for side in sides)
    return MapGrid(nx, longer * pitch / cells, size_y=0 if nx == ny else ny)


def _fewest_exposures(artifact: Artifact, like: View) -> int:
    """Return the exposures of the shortest view that can be chosen, measured once."""
    return min(
        _exposures(Plan("", artifact, (measured_like(view, like),)))
        for view in candidate_views(artifact, angular=False)
    )


def _repeated(plan: Plan) -> Iterator[Plan]:
    """Yield the plan with every number of repeats."""
    for repeats, order in REPEATS.items():
        yield replace(
            plan,
            views=tuple(
                replace(view, repeats=repeats, visit_order=order if view.grid else "")
                for view in plan.views
            ),
        )


def _u_of_reading(plan: Plan) -> float:
    """Return the predicted uncertainty, rms, in units of the noise of one reading."""
    return score_plan(plan, against=_against()).rms_xy / math.sqrt(
        plan.views[0].repeats
    )


def _against() -> Against:
    return Against((), by_default=tuple(default_terms()))


def _exposures(plan: Plan) -> int:
    return sum(
        stop.exposures
        for view in plan.views
        for stop in stops(plan.artifact, view, Sense.MICROSCOPE_MOVES)
    )


def minutes_of(answers: Known, plan: Plan) -> float:
    """Return the minutes that a plan takes."""
    return _minutes(answers, len(plan.views), _exposures(plan))


def _minutes(answers: Known, placings: int, exposures: int) -> float:
    return placings * PLACING_MIN[answers.placing] + exposures * answers.seconds / 60


def _counted_visits(plan: Plan, answers: Known) -> str:
    return (
        f"{len(plan.views)} placings of {PLACING_MIN[answers.placing]:g} minutes, "
        f"{_exposures(plan)} exposures of {answers.seconds:g} s"
    )


def _budget(plan: Plan) -> PlanBudget:
    """Return the predicted budget, as of `selfcal plan check`."""
    observability = check_plan(plan).observability
    if not observability.identifiable:  # only a search that misses its aim
        raise InputError(
            "--marks",
            "no plan of these marks identifies the stage",
            "; ".join(
                advice.text for advice in worded_observability(observability).advice
            ),
        )
    return plan_budget(
        plan, default_terms(), Assumed(), predict_plan(plan, ThetaDatum.ZERO_MEAN)
    )


def _next(plan: Plan) -> tuple[View, float] | None:
    """Return the further view that helps most, and by which factor it changes u.

    None for a map wider than the plate: to try the poses of many views would take too long.
    """
    if plan.artifact.map_grid:
        return None
    now, ranked = rank_next(plan, against=_against())
    added = next(item for item in ranked if len(item.views) > len(plan.views))
    return added.views[-1], added.score.rms_xy / now.rms_xy


def _cell_text(answers: Known, simulation: str) -> str:
    """Return CELL.yaml, the places to be edited named in comments."""
    machine_keys = (
        f"{{simulation: {simulation}}}"
        if answers.is_simulated
        else f"{OWN_KEYS.get(answers.machine, '{}')}  # edit these"
    )
    x, y = (f"[{-travel / 2:.6g}, {travel / 2:.6g}]" for travel in answers.travel)
    theta = ", theta: [-7.0, 7.0]" if answers.lines else ""
    lines = [
        "# From `selfcal plan new`.",
        f"machine: {answers.machine}",
        f"{answers.machine}: {machine_keys}",
        f"limits: {{x: {x}, y: {y}{theta}}}  # m, as the stage indicates; never left",
        "origin: {x: 0.0, y: 0.0}  # what it indicates at the centre of the field, m",
        "sense: microscope_moves  # plate_moves where the stage carries the plate",
    ]
    if answers.has_camera or not answers.is_simulated:
        size = answers.mark_size_m
        pixel = (
            f", pixel_size: {size / PIXELS_A_MARK:.6g}" if answers.is_simulated else ""
        )
        lines.append(
            f"detector: {{mark: disc, mark_size: {size:.6g}{pixel}}}  # as the artwork; "
            "`selfcal cell try` finds pixel size, turn and mirror"
        )
    placing = "robot  # the simulation" if answers.is_simulated else answers.placing
    return "\n".join([*lines, "settle: {time: 0.0}  # s", f"placing: {placing}", ""])


def _simulation(answers: Known, plan: str) -> dict[str, Any]:
    """Return SIM.yaml of the simulated machine."""
    out: dict[str, Any] = {
        "plan": plan,
        "seed": 1,
        "truth": {
            "t": min(3e-5, answers.pitch / 20),  # error of the placing
            "correlation": 4,
        },  # pitches: a smooth stage, as stages are
        "noise": {"sigma_xy": 2e-8, "sigma_theta": 1e-6},
    }
    if answers.has_camera:
        pixel_m = answers.mark_size_m / PIXELS_A_MARK
        width, height = (round(side / pixel_m) for side in answers.field)
        out["camera"] = {
            "width": width,
            "height": height,
            "pixel_size": pixel_m,
            "mark_size": answers.mark_size_m,
        }
    return out


def _covered_m(plan: Plan) -> list[float]:
    """Return the sides of the field that the map covers, about the middle of the travel, m."""
    artifact = plan.artifact
    shifts = np.array(
        [view.translation_m for view in plan.views if not view.rotation_rad]
    )
    both_sides = np.minimum(shifts.max(axis=0), -shifts.min(axis=0))
    read_half_m = both_sides + np.array(artifact.half) * artifact.grid_pitch_m
    return list(2 * np.minimum(artifact.field_half_m, read_half_m))


def _text(
    answers: Known,
    plan: Plan,
    prediction: tuple[PlanBudget, tuple[View, float] | None],
    why_not: str,
    outputs: list[Path],
) -> Iterator[str]:
    budget, further_view = prediction
    artifact = plan.artifact
    nx, ny = artifact.shape
    span = " x ".join(f"{side * MM_PER_M:.4g}" for side in _covered_m(plan))
    travel = " x ".join(f"{side * MM_PER_M:g}" for side in answers.travel)
    yield (
        f"plan {plan.plan_id}: {nx} x {ny} marks, {answers.lines or 'no'} angular lines; the map "
        f"covers {span} of {travel} mm of travel"
    )
    if why_not:
        yield why_not
    for view in plan.views:
        kind = "" if view.grid else ", lines only"
        how_often = OFTEN.get(view.repeats, f"{view.repeats} times")
        yield f"  {view.name}: {describe_view(view, artifact)}, {how_often}{kind}"
    noise = Assumed()
    yield (
        f"it identifies the stage: U of XY {2 * budget.u_rms('xy') * UM_PER_M:.3g} µm (k = 2, "
        f"rms) for {noise.sigma_m * UM_PER_M:g} µm noise of one reading; `selfcal plan check` "
        "shows where U comes from"
    )
    strain = next(term for term in default_terms() if term.name == "plate_strain")
    yield (
        f"U assumes a plate that grows by {strain.size * UM_PER_M:g} µm/m (k = 1) from view "
        "to view, fused silica within 0.1 K; for soda-lime glass write model_terms: "
        f'["plate_strain:8e-7"] into {outputs[0]}'
    )
    yield (
        f"it takes about {minutes_of(answers, plan):.0f} minutes: {_counted_visits(plan, answers)}"
    )
    if further_view:
        further, factor = further_view
        longer = minutes_of(answers, replace(plan, views=(further,)))
        yield (
            f"the further view that helps most: {describe_view(further, artifact)}; it makes U "
            f"{100 * (1 - factor):.0f} % smaller and takes {longer:.0f} minutes more"
        )
    yield f"written: {', '.join(map(str, outputs))}"
    tried = "" if answers.is_simulated else f"selfcal cell try {outputs[1]}; "
    yes = " --yes" if answers.is_simulated else ""
    yield (
        f"next: selfcal plate {outputs[0]} -o plate.svg; {tried}"
        f"selfcal measure {outputs[0]} {outputs[1]} -o BAG{yes}"
    )


def _json(
    answers: Known,
    plan: Plan,
    prediction: tuple[PlanBudget, tuple[View, float] | None],
    why_not: str,
    outputs: list[Path],
) -> dict[str, Any]:
    budget, further_view = prediction
    theta = budget.u_rms("theta")
    return {
        "plan_id": plan.plan_id,
        "written": list(map(str, outputs)),
        "views": [view_to_dict(view, plan.artifact) for view in plan.views],
        "covers": _covered_m(plan),
        "why_not_wider": why_not or None,
        "minutes": minutes_of(answers, plan),
        "exposures": _exposures(plan),
        "U_xy": 2 * budget.u_rms("xy"),
        "U_theta": 2 * theta if answers.lines else None,
        "next_view": view_to_dict(further_view[0], plan.artifact)
        if further_view
        else None,
    }
