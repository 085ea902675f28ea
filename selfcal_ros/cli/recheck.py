# SPDX-License-Identifier: Apache-2.0
"""``selfcal recheck``: one view of a calibrated plate, and whether the stage has changed."""

import argparse
from pathlib import Path

from selfcal_ros.cli import solve
from selfcal_ros.cli.terminal import busy, say
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.estimation.recheck.plate import known_plate
from selfcal_ros.estimation.recheck.solve import predict_recheck
from selfcal_ros.model.view import Plan
from selfcal_ros.outputs import plain
from selfcal_ros.reporting.summary.numbers import counted
from selfcal_ros.reporting.words.phrases import ONE_PASS
from selfcal_ros.results import read_result


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "plate_from", metavar="RESULT.json", help="calibration of the plate"
    )
    solve.add_arguments(
        parser, {"theta_datum": "theta_datum", "reference_at": "reference_at"}
    )


def run(args: argparse.Namespace) -> int:
    """Collect, find the map and its change, print both and write the result."""
    if args.reference:
        raise InputError(
            "--reference",
            "a recheck always uses the reference length of the plate's calibration",
            "leave it out",
        )
    return solve.run(args)


def _awaited(args: argparse.Namespace, plan: Plan) -> int:
    """Print what can be said before the plate is calibrated."""
    say(
        args,
        f"plan {plan.plan_id}: {counted(len(plan.views), 'view')} of a plate that a calibration "
        f"makes known\n{plan.artifact_from} is not there yet: `selfcal solve BAG -o FILE` writes "
        "it;\nwhat the view will show is predicted from it",
        {
            "plan_id": plan.plan_id,
            "identifiable": None,
            "artifact_from": plan.artifact_from,
            "predicted": None,
        },
    )
    return ExitCode.DONE


def planned(args: argparse.Namespace, plan: Plan) -> int:
    """Print what views of a known plate will show; for `selfcal plan check`."""
    if args.plan_verb == "suggest":
        raise InputError(
            args.plan,
            "its plate is already calibrated: any view that reads all marks will do",
            "use selfcal plan check",
        )
    if not Path(plan.artifact_from).exists():
        return _awaited(args, plan)
    plate = known_plate(read_result(plan.artifact_from), plan.artifact_from)
    with busy("judging the plan"):
        prediction = predict_recheck(plan, plate)
    of_map = prediction.map
    lines = [
        f"plan {plan.plan_id}: {counted(len(plan.views), 'view')} of the "
        f"plate calibrated in {plan.artifact_from}"
    ]
    if of_map.n_unknown:
        lines.append(
            f"{of_map.n_unknown} of {of_map.u_xy[0].size} nodes of the map remain unknown"
        )
    lines += [
        "predicted standard uncertainty, in units of the noise of one averaged reading:",
        f"  XY     rms {of_map.rms_xy:.4f}   largest {of_map.max_xy:.4f}",
    ]
    if len(of_map.u_theta):
        lines.append(f"  theta  rms {of_map.rms_theta:.4f}")
    lines.append(f"  change of XY since the calibration: rms {prediction.change:.4f}")
    if min(view.repeats for view in plan.views) == 1:
        lines.append(ONE_PASS)
    data = {
        "plan_id": plan.plan_id,
        "identifiable": True,
        "artifact_from": plan.artifact_from,
        "unknown_sites": of_map.n_unknown,
        "predicted": {
            "rms_gain_xy": of_map.rms_xy,
            "max_gain_xy": of_map.max_xy,
            "rms_gain_theta": of_map.rms_theta,
            "rms_gain_change": prediction.change,
        },
    }
    say(args, "\n".join(lines), plain(data))
    return ExitCode.DONE
