# SPDX-License-Identifier: Apache-2.0
"""``selfcal reproduce``: the published simulations, run again and set beside the paper."""

import argparse
from pathlib import Path

HELP = "run the published simulations of Hu or Qiao, side by side with their figures"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("paper", choices=("hu", "qiao"))
    parser.add_argument("--draws", type=int, default=200, metavar="N",
                        help="draws of noise (default 200)")
    parser.add_argument("--seed", type=int, default=1, metavar="S",
                        help="seed of all random numbers (default 1)")
    parser.add_argument("--out", metavar="DIR", help="folder for the plots and the text")


def run(args: argparse.Namespace) -> int:
    """Run, print, and save what was asked for."""
    from selfcal_ros.errors import ExitCode, InputError
    from selfcal_ros.files import write_text

    if args.draws < 1:
        raise InputError("--draws", f"{args.draws} is not positive", "give 1 or more")
    if args.seed < 0:
        raise InputError("--seed", f"{args.seed} is negative", "give 0 or more")
    folder = Path(args.out) if args.out else None
    if folder is not None:
        _make(folder)
    text, save = _hu(args) if args.paper == "hu" else _qiao(args)
    print(text)
    if folder is not None:
        write_text(folder / f"{args.paper}.txt", text + "\n")
        for path in save(folder):
            print(f"wrote {path}")
    return int(ExitCode.DONE)


def _make(folder: Path) -> None:
    from selfcal_ros.errors import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(str(folder), f"cannot be made ({error.strerror})",
                         "name a folder that you may write") from error


def _hu(args: argparse.Namespace) -> tuple:
    from selfcal_ros.simulation.reproduce.hu import hu_text, reproduce_hu

    found = reproduce_hu(args.draws, args.seed)

    def save(folder: Path) -> list[Path]:
        from selfcal_ros.reporting.reproduce_plots import save_hu_plots

        return save_hu_plots(found, folder)

    return hu_text(found), save


def _qiao(args: argparse.Namespace) -> tuple:
    from selfcal_ros.simulation.reproduce.qiao import qiao_text, reproduce_qiao

    found = reproduce_qiao(args.draws, args.seed)

    def save(folder: Path) -> list[Path]:
        from selfcal_ros.reporting.reproduce_plots import save_qiao_plots

        return save_qiao_plots(found, folder)

    return qiao_text(found), save
