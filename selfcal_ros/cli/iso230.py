# SPDX-License-Identifier: Apache-2.0
"""``selfcal iso230``: accuracy and repeatability of axes, circles and diagonals."""

from __future__ import annotations

import argparse
from typing import Any

from selfcal_ros.applications.standards import iso230
from selfcal_ros.applications.standards.iso230 import AxisFigures, PathFigures
from selfcal_ros.apply import StageMap, load
from selfcal_ros.bagio.offline import bag_input, collect_bag
from selfcal_ros.cli.terminal import add_json, busy, exit_code, say, warn
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.readings import Measurements, Sense
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.outputs import plain
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.settings.nodes import CollectorSettings, SolverSettings
from selfcal_ros.units import M_PER_MM, MM_PER_M, UM_PER_M


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "source",
        metavar="BAG|RESULT.json",
        help="bag of a calibration, with repeats; or its result, without them",
    )
    parser.add_argument(
        "--result",
        metavar="RESULT.json",
        help="calibration of this bag (default: solve it with default options)",
    )
    parser.add_argument(
        "--line",
        type=int,
        default=0,
        metavar="N",
        help="line of sites along each axis, counted from the centre (default 0)",
    )
    parser.add_argument(
        "--radius",
        type=float,
        metavar="MM",
        help="radius of the circle (default: the largest in the field)",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the figures; a result that is not qualified ends with code 5, as in `solve`."""
    stage, measurements = _read(args)
    if stage.result.plate.map_grid is not None:
        measurements = None
    artifact = stage.error_map.artifact
    axes, problems = [], []
    for axis in (0, 1):
        repeats = None if measurements is None else iso230.scatters(measurements, axis)
        in_model = any(term.name == "approach" for term in stage.result.model.terms)
        try:
            axes.append(
                iso230.axis_figures(
                    stage, axis, args.line, repeats, approach_in_model=in_model
                )
            )
        except InputError as error:
            if measurements is None:
                raise
            problems.append(str(error))
            axes.append(iso230.axis_figures(stage, axis, args.line))
    radius = (
        min(artifact.half) * artifact.grid_pitch_m
        if args.radius is None
        else args.radius * M_PER_MM
    )
    problems = [f"{line}; only M is given" for line in problems]
    paths = []
    for figures, chosen in (
        (lambda: [iso230.circle_figures(stage, radius)], args.radius),
        (lambda: iso230.diagonal_figures(stage), None),
    ):
        try:
            paths += figures()
        except iso230.UnknownSitesError as error:
            if chosen is not None:
                raise
            problems.append(f"{error}; left out")
    for line in problems:
        warn(args, line)
    say(args, _text(stage, axes, paths), _json(stage, axes, paths))
    return exit_code(stage.result)


def _read(args: argparse.Namespace) -> tuple[StageMap, Measurements | None]:
    """Return the map, and the readings of a bag."""
    if args.source.lower().endswith(".json"):
        if args.result:
            raise InputError("--result", f"{args.source} is a result itself", "omit it")
        return load(args.source), None
    stage = load(args.result) if args.result else None
    settings = CollectorSettings(
        measurement_sense=stage.result.sense if stage else str(Sense.MICROSCOPE_MOVES)
    )
    with busy("reading"):
        measurements = collect_bag(args.source, settings)[0]
    if stage is None:
        with busy("solving"):
            stage = StageMap(
                worded(
                    calibrate(
                        measurements, solver_options(SolverSettings(), measurements)
                    )
                )
            )
    elif stage.error_map.artifact != measurements.artifact.field:
        raise InputError(
            f"{args.source} and {args.result}",
            "the plates differ",
            "name the result of this bag",
        )
    elif not _is_of(stage.result, args.source, measurements.run_id):
        raise InputError(
            f"{args.source} and {args.result}",
            "the result is of another recording",
            "name the result of this bag",
        )
    return stage, measurements


def _is_of(result: CalibrationResult, bag: str, run_id: str) -> bool:
    """Return whether a result is of a bag, as far as its run or its digest tells."""
    if result.run_id and result.run_id == run_id:
        return True
    if digest := result.input.get("sha256"):
        return digest == bag_input(bag)["sha256"]
    return not (result.run_id and run_id)


def _figures(evaluated: AxisFigures | PathFigures) -> dict[str, Any]:
    return {
        name: {"value": figure.value, "u": figure.u}
        for name, figure in evaluated.figures.items()
    }


def _json(
    stage: StageMap, axes: list[AxisFigures], paths: list[PathFigures]
) -> dict[str, Any]:
    return plain(
        {
            "axes": [
                {
                    "axis": item.axis,
                    "line": item.line_m,
                    "positions": item.position_m,
                    "left_out": item.left_out_m,
                    "up": item.up_m,
                    "down": item.down_m,
                    "s_up": item.s_up_m,
                    "s_down": item.s_down_m,
                    "approaches": list(item.approaches),
                    "figures": _figures(item),
                }
                for item in axes
            ],
            "paths": [{"name": item.name, "figures": _figures(item)} for item in paths],
            "scale": "reference" if stage.result.reference else "convention",
            "qualified": stage.result.verdict.qualified,
        }
    )


def _text(stage: StageMap, axes: list[AxisFigures], paths: list[PathFigures]) -> str:
    lines = []
    for item in axes:
        up, down = item.approaches
        how = (
            f"{up} and {down} approaches from each side or more"
            if up
            else "mean deviation of the map, without repeats"
        )
        place = item.position_m * MM_PER_M
        lines.append(
            f"axis {item.axis} at {'yx'['xy'.index(item.axis)]} = "
            f"{item.line_m * MM_PER_M:g} mm, {len(place)} positions from {place[0]:g} to "
            f"{place[-1]:g} mm, {how}:"
        )
        if len(item.left_out_m):
            why = "unknown, or too few approaches from a side" if up else "unknown"
            lines.append(
                "  left out: "
                + ", ".join(f"{p * MM_PER_M:g}" for p in item.left_out_m)
                + f" mm ({why})"
            )
        lines += _rows(item)
    for path in paths:
        lines += [f"{path.name}:", *_rows(path)]
    lines.append(
        "deviations: actual minus commanded, ISO 230-1; u: standard uncertainty (k=1)"
    )
    if not stage.result.reference:
        lines.append(
            "scale: a convention, no reference length: a linear deviation common to both "
            "axes is not in these figures"
        )
    return "\n".join(lines)


def _rows(evaluated: AxisFigures | PathFigures) -> list[str]:
    return [
        f"  {name:7}{figure.value * UM_PER_M:10.4f} µm   u "
        + (f"{figure.u * UM_PER_M:.4f} µm" if figure.u == figure.u else "not known")
        for name, figure in evaluated.figures.items()
    ]
