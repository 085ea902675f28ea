# SPDX-License-Identifier: Apache-2.0
"""``selfcal reproduce``: the published simulations, rerun and compared with the paper."""

import argparse
import sys
from pathlib import Path

from selfcal_ros.applications.papers.figures import hu_figures, qiao_figures
from selfcal_ros.applications.papers.hu import hu_text, reproduce_hu
from selfcal_ros.applications.papers.ibaraki import (
    CASE_STUDY_UM,
    ibaraki_text,
    reproduce_ibaraki,
)
from selfcal_ros.applications.papers.qiao import SIZES, qiao_text, reproduce_qiao
from selfcal_ros.cli.terminal import add_json, late_progress, save_drawing, say
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.outputs import creating, write_text
from selfcal_ros.parallel import Progress, check_workers

MANY = 1000
"""Number of draws from which several processes are faster."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("paper", choices=tuple(PAPERS))
    parser.add_argument(
        "--draws",
        type=int,
        default=200,
        metavar="N",
        help="draws of noise (default 200)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=1,
        metavar="S",
        help="seed of all random numbers (default 1)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="processes; the numbers do not depend on it (default: 1, from "
        f"{MANY} draws on one per core)",
    )
    add_json(parser, "the numbers")
    parser.add_argument(
        "--out", metavar="DIR", help="folder for the plots and the text"
    )


def run(args: argparse.Namespace) -> int:
    """Run the simulation, print and save the requested output."""
    if args.draws < 1:
        raise InputError("--draws", f"{args.draws} is not positive", "give 1 or more")
    if args.seed < 0:
        raise InputError("--seed", f"{args.seed} is negative", "give 0 or more")
    folder = Path(args.out) if args.out else None
    if folder is not None:
        with creating(folder):
            folder.mkdir(parents=True, exist_ok=True)
    workers = check_workers(
        1 if args.workers is None and args.draws < MANY else args.workers
    )
    with late_progress("solving draws") as progress:
        text, figures, numbers = PAPERS[args.paper](args, workers, progress)
    say(
        args,
        text,
        {"paper": args.paper, "draws": args.draws, "seed": args.seed, **numbers},
    )
    if folder is not None:
        write_text(folder / f"{args.paper}.txt", text + "\n")
        for drawing in figures():
            path = folder / f"{drawing.name}.png"
            save_drawing(drawing, path)
            print(f"wrote {path}", file=sys.stderr if args.json else sys.stdout)
    return ExitCode.DONE


def _hu(args: argparse.Namespace, workers: int, progress: Progress) -> tuple:
    reproduction = reproduce_hu(
        args.draws, args.seed, workers=workers, progress=progress
    )

    tables = [
        {
            "name": run.published.name,
            "sigma_um": run.published.sigma_um,
            "sigma_deg": run.published.sigma_deg,
            "published": run.published.table,
            "law_first": run.law.first.tolist(),
            "law_std": run.law.std.tolist(),
            "joint_std": run.joint.std.tolist(),
            "bound": run.bound,
        }
        for run in reproduction.runs
    ]
    return (
        hu_text(reproduction),
        lambda: hu_figures(reproduction),
        {
            "noise_free_um": reproduction.noise_free_um,
            "noise_free_deg": reproduction.noise_free_deg,
            "tables": tables,
        },
    )


def _qiao(args: argparse.Namespace, workers: int, progress: Progress) -> tuple:
    reproduction = reproduce_qiao(
        args.draws, args.seed, workers=workers, progress=progress
    )

    programs = [
        {
            "views": program.views,
            "rms_um": program.rms_um,
            "deficiency": program.deficiency,
        }
        for program in reproduction.programs
    ]
    return (
        qiao_text(reproduction),
        lambda: qiao_figures(reproduction),
        {
            "sizes": SIZES,
            "ranks": reproduction.ranks.tolist(),
            "unknowns": reproduction.unknowns.tolist(),
            "programs": programs,
            "rms_um": reproduction.rms_um.tolist(),
            "rms_uniform_um": reproduction.rms_uniform_um.tolist(),
            "bound_um": reproduction.bound_um,
        },
    )


def _ibaraki(args: argparse.Namespace, workers: int, progress: Progress) -> tuple:
    reproduction = reproduce_ibaraki(args.draws, args.seed, progress=progress)

    return (
        ibaraki_text(reproduction),
        list,
        {
            "table_1_mm": {
                case: values.tolist()
                for case, values in reproduction.table_1_mm.items()
            },
            "published_um": CASE_STUDY_UM,
            "new_um": reproduction.new_um.tolist(),
            "conventional_um": reproduction.conventional_um.tolist(),
        },
    )


PAPERS = {"hu": _hu, "qiao": _qiao, "ibaraki": _ibaraki}
