# SPDX-License-Identifier: Apache-2.0
"""``selfcal solve``: a bag in, the calibrated error map out, without middleware."""

import argparse
import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from selfcal_ros.applications.papers.methods import calibrate_by
from selfcal_ros.bagio.offline import BagSession, bag_input, collect_bag, read_truth
from selfcal_ros.blocks import BUILT_IN
from selfcal_ros.cli.terminal import (
    Once,
    add_parameters,
    add_recorded_namespace,
    add_solved,
    aside,
    busy,
    exit_code,
    file_of,
    given,
    node_settings,
    on_stdout,
    option_of,
    progress_bar,
    put,
    show,
    tell,
    warn,
)
from selfcal_ros.collection.inputs import rejections
from selfcal_ros.collection.reduce import with_collected
from selfcal_ros.errors import InputError, NotIdentifiableError, SelfcalError, printable
from selfcal_ros.estimation.checks.placing import PlacingError
from selfcal_ros.estimation.checks.wiring import WiringError
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.outliers import clean
from selfcal_ros.estimation.quality.validation import judged_by, validate
from selfcal_ros.estimation.verdict.uncertainty import budgets
from selfcal_ros.model.plate_form import with_nodes
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import (
    CalibrationResult,
    created_now,
    result_to_dict,
    unidentified_result,
    with_input,
)
from selfcal_ros.model.terms import microscope_term, parse_terms
from selfcal_ros.outputs import check_outputs, write_json
from selfcal_ros.plain_numbers import number_of
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.reporting.words.observability import with_advice
from selfcal_ros.reporting.words.phrases import recheck_lines
from selfcal_ros.reporting.words.tables import (
    budget_text,
    held_out_figures,
    validation_text,
)
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.settings.nodes import NO_TERMS, CollectorSettings, SolverSettings


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_arguments(parser, SOLVER)
    parser.add_argument(
        "--validate",
        action="store_true",
        help="hold out tenths of the readings and whole views, and predict them",
    )


def add_arguments(parser: argparse.ArgumentParser, names: Mapping[str, str]) -> None:
    """Add what `selfcal solve` and `selfcal recheck` have in common, and options as `names`."""
    parser.add_argument("bag", metavar="BAG", help="MCAP file or rosbag2 folder")
    add_solved(parser)
    add_options(parser, names)
    parser.add_argument(
        "--reference",
        action=Once,
        metavar="KIND:ERROR:U",
        help="known length that sets the "
        "scale: artifact, stage_x or stage_y, its relative error and the standard "
        "uncertainty of this error, e.g. artifact:1.2e-6:3e-7; or the distance of two "
        "marks and its u in m: marks:M,N:M,N:LENGTH:U, of a list of marks "
        "marks:ID:ID:LENGTH:U",
    )
    parser.set_defaults(validate=False)
    parser.add_argument(
        "--budget",
        action="store_true",
        help="print the uncertainty budget of the map (GUM)",
    )
    parser.add_argument(
        "--report",
        metavar="REPORT.html|.pdf",
        help="also write the report, compared with the truth if the bag has one",
    )
    parser.add_argument(
        "--map",
        metavar="NODES[:INTERPOLATION]",
        help="nodes per side of the "
        "map over the field of the plan, bicubic (default) or bilinear, instead "
        "of those of the plan, e.g. 9:bicubic",
    )
    parser.add_argument("--quiet", action="store_true", help="print no summary")


METHOD = {
    "method": "method",
    "theta_datum": "theta_datum",
    "misalignment": "misalignment_model",
    "uncertainty": "uncertainty",
}
REFERENCE = {"certificate": "reference_certificate", "reference_at": "reference_at"}
ROBUST = {"robust": "robust"}
SOLVER = METHOD | REFERENCE | ROBUST
SENSE = {"sense": "measurement_sense"}
"""Options for parameters of solver and collector -> their names."""


def add_options(parser: argparse.ArgumentParser, names: Mapping[str, str]) -> None:
    """Add the options for collecting and solving a bag.

    Parameters
    ----------
    parser : ArgumentParser
        Where to.
    names : mapping
        Options for parameters of the solver -> their names; the others are set by --params alone.
    """
    add_parameters(parser, SolverSettings, names)
    parser.set_defaults(
        reference=None, plate_from="", **dict.fromkeys(SOLVER.keys() - names)
    )
    add_parameters(parser, CollectorSettings, SENSE)
    parser.add_argument(
        "--params",
        metavar="NODES.yaml",
        help="ROS parameter file, the same as for the nodes",
    )
    parser.add_argument(
        "--model",
        metavar="TERM[:SIZE],...",
        action="append",
        help=f"terms estimated with the map: {', '.join(BUILT_IN)}; "
        "SIZE is a standard deviation known from elsewhere (SI; 0: exactly zero), "
        "e.g. drift,plate_shape:30e-9; in addition to those of the plan; none: no terms, "
        "not even those assumed by default (docs/theory/estimation.md)",
    )
    parser.add_argument(
        "--microscope",
        action=Once,
        metavar="SCALE_U[:ROTATION_U[:SHEAR_U]]",
        help="standard uncertainties of the microscope's scale, rotation (rad) "
        "and shear (default: 0.01:0.01:0.002)",
    )
    add_recorded_namespace(parser)


def parameters(args: argparse.Namespace) -> tuple[CollectorSettings, SolverSettings]:
    """Return the settings of collector and solver; options take precedence over the file."""
    collector = node_settings(args.params, CollectorSettings, **given(args, SENSE))
    solver = node_settings(
        args.params,
        SolverSettings,
        model_terms=_model(args),
        **given(args, SOLVER),
        **_reference(args.reference),
    )
    of_plate = {"reference_at"} if args.plate_from else set()
    for option in {"certificate", "reference_at"} - of_plate:
        if getattr(args, option) is not None and solver.reference_kind == "none":
            raise InputError(
                option_of(option),
                "it belongs to a reference length, and none is given",
                "name the length with --reference KIND:ERROR:U",
            )
    if args.misalignment == "rigid" and solver.method == "law":
        raise InputError(
            "--misalignment",
            "Hu's law is linear, not rigid",
            "omit it, or use --method joint",
        )
    return collector, solver


def _model(args: argparse.Namespace) -> list[str] | None:
    """Return the terms of --model and --microscope; None if neither is given."""
    words = [word.strip() for text in args.model or () for word in text.split(",")]
    parse_terms([word for word in words if word != NO_TERMS], "--model")
    if args.microscope is None:
        return args.model
    sizes = args.microscope.split(":")
    usual = microscope_term()
    missing = [f"{size:g}" for size in usual.parts[len(sizes) :]]
    if len(sizes) > len(usual.parts) or any(
        usual.name in text or text == NO_TERMS for text in args.model or ()
    ):
        raise InputError(
            "--microscope",
            f"'{args.microscope}' does not fit",
            "give up to three sizes, and no microscope or none in --model",
        )
    term = ":".join([usual.name, *sizes, *missing])
    parse_terms([term], "--microscope")
    return [*(args.model or ()), term]


def _reference(text: str | None) -> dict[str, Any]:
    """Return the solver parameters in KIND:ERROR:U."""
    if text is None:
        return {}
    kind, _, sizes = text.partition(":")
    if kind == "marks":
        return {"reference_kind": kind, "reference_marks": sizes}
    try:
        error, u = sizes.split(":")
        return {
            "reference_kind": kind,
            "reference_error": number_of(error),
            "reference_u": number_of(u),
        }
    except ValueError as error:
        raise InputError(
            "--reference",
            f"{text!r} is not KIND:ERROR:U",
            "write e.g. artifact:1.2e-6:3e-7, or marks:-5,0:5,0:0.1000002:5e-9",
        ) from error


def run(args: argparse.Namespace) -> int:
    """Collect, calibrate, print the summary and write the result."""
    check_outputs(
        [args.bag, args.params, args.plate_from], [file_of(args), args.report]
    )
    if args.report:
        from selfcal_ros.reporting.report import check_name  # loads every figure

        check_name(args.report)
    collector, solver = parameters(args)
    if args.validate and solver.method == "law":  # the joint solution is validated
        raise InputError(
            "--validate",
            "Hu's law needs every reading and cannot hold any out",
            "solve with --method joint",
        )
    session = collected(args, collector)
    if not session.findings:
        used = sum(view.used for view in session.measurements.views)
        for line in rejections(session.measurements.all_rejected(), used):
            warn(args, f"{args.bag}: {line}")
    measurements = _with_map(args, session.measurements)
    options = solver_options(solver, measurements, plate_from=args.plate_from)
    if options.plate is not None and args.validate:
        raise InputError(
            "--validate",
            f"the plate is known from {options.plate_from}, and one view has nothing "
            "to check its readings against",
            "omit it",
        )
    try:
        with busy("solving"), named_bag(args.bag):
            result = calibrate_by(solver.method, measurements, options)
    except NotIdentifiableError as refused:
        raise _unidentified(args, measurements, session, refused) from refused
    if options.plate is not None:
        _require_other_recording(args.bag, options.plate, options.plate_from)
    with busy("validating"):
        result, lines = _validated(args, measurements, options, result)
    result = _described(args, result, session.lost)
    _write(args, result)
    lines = [*_report(args, result), *lines]
    if args.quiet:
        lines = []
    else:
        show(result, args.bag, file_of(args), aside(args))
        lines += _since(result)
    lines += _budget(result) if args.budget else []
    if lines:
        tell("\n".join(lines), aside(args))
    return exit_code(result)


def _unidentified(
    args: argparse.Namespace,
    measurements: Measurements,
    session: BagSession,
    refused: NotIdentifiableError,
) -> SelfcalError:
    """Write what is known of a stage that the readings do not identify; return what to say."""
    error = with_advice(refused)
    if error.observability is not None:
        result = unidentified_result(measurements, error.observability)
        result = with_collected(result, measurements.views)
        _write(args, _described(args, result, session.lost))
    return _first_fault(args.bag, error, session)


def collected(args: argparse.Namespace, settings: CollectorSettings) -> BagSession:
    """Return the readings of the bag; what was found or lost in it is told."""
    with progress_bar("reading") as bar:
        session = collect_bag(
            args.bag,
            settings,
            namespace=args.namespace,
            progress=lambda count: bar(count, None),
        )
    # a clock step is a finding, and noted in the result
    for line in dict.fromkeys([*session.findings, *session.lost]):
        warn(args, f"{args.bag}: {line}")
    return session


@contextlib.contextmanager
def named_bag(bag: str) -> Iterator[None]:
    """Name the bag in errors of its offsets or its plate."""
    try:
        yield
    except (WiringError, PlacingError) as error:
        raise InputError(f"{bag}: {error.where}", error.what, error.remedy) from error


def _require_other_recording(
    bag: str, plate: CalibrationResult, plate_from: str
) -> None:
    """Refuse to recheck a plate by the recording that made it known."""
    if plate.input.get("sha256") == bag_input(bag)["sha256"]:
        raise InputError(
            bag,
            f"the recording that {plate_from} was computed from: it would be "
            "compared with itself",
            "record a new view of the plate",
        )


def _first_fault(
    bag: str, error: NotIdentifiableError, session: BagSession
) -> SelfcalError:
    """Return what to correct before the plan, if the readings are deficient for another cause."""
    # a fault of the cell: a plate placed otherwise, a wrong sign
    if set(session.findings) - set(session.lost):
        return InputError(bag, "correct this first", f"as it is, {error}")
    if session.findings:  # missing readings look like a deficient plan
        return NotIdentifiableError(
            f"{bag}: correct this first; as it is, {error}", error.observability
        )
    return error


def _with_map(args: argparse.Namespace, measurements: Measurements) -> Measurements:
    """Return the readings with the nodes of --map, if it is given."""
    if not args.map:
        return measurements
    return replace(
        measurements, artifact=with_nodes(measurements.artifact, args.map, "--map")
    )


def _described(
    args: argparse.Namespace, result: CalibrationResult, lost: list[str]
) -> CalibrationResult:
    """Return a result with its sentences, the recording it was solved from, and the time."""
    return created_now(with_input(worded(result), bag_input(args.bag), lost))


def _write(args: argparse.Namespace, result: CalibrationResult) -> None:
    """Write a result to a file, to stdout, or both."""
    if file_of(args):
        write_json(args.output, result_to_dict(result))
    if on_stdout(args):
        put(result_to_dict(result))


def _validated(
    args: argparse.Namespace,
    measurements: Measurements,
    options: Options,
    result: CalibrationResult,
) -> tuple[CalibrationResult, list[str]]:
    """Return the result with places, validated if requested, and the text to print."""
    lines: list[str] = []
    result = with_collected(result, measurements.views)
    if args.validate:
        used = (
            clean(measurements, options).measurements
            if options.robust
            else measurements
        )
        validation = validate(used, options)
        result = judged_by(result, validation)
        result = replace(
            result,
            parts=replace(
                result.parts, validation=held_out_figures(validation, result.plate)
            ),
        )
        lines += [
            "",
            "held-out readings:",
            *(f"  {line}" for line in validation_text(validation, result.plate)),
        ]
    return result, lines


def _report(args: argparse.Namespace, result: CalibrationResult) -> list[str]:
    """Write the report, if one is wanted, and return the line that names it."""
    if not args.report:
        return []
    from selfcal_ros.reporting.report import write_report  # loads every figure

    write_report(result, args.report, truth=read_truth(args.bag))
    return [f"report: {printable(args.report)}"]


def _since(result: CalibrationResult) -> list[str]:
    """Return the text of the change since the calibration of a known plate."""
    recheck = result.recheck
    return (
        []
        if recheck is None
        else [
            "",
            f"change since {recheck.of}:",
            *(f"  {line}" for line in recheck_lines(recheck)),
        ]
    )


def _budget(result: CalibrationResult) -> list[str]:
    """Return the text of the budget."""
    if not result.has_uncertainty:
        return [
            "",
            "no budget: the uncertainty map was not computed (--uncertainty always)",
        ]
    return ["", *budget_text(budgets(result))]
