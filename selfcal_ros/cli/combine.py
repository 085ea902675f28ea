# SPDX-License-Identifier: Apache-2.0
"""``selfcal combine``: the weighted mean of several calibrations, with the part between runs."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from itertools import compress
from typing import cast

from selfcal_ros.cli.arguments import STDOUT
from selfcal_ros.cli.terminal import add_json, aside, busy, file_of, put, tell
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.combine import Member, combine
from selfcal_ros.estimation.comparison.external import map_from_table
from selfcal_ros.files import read_text
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.parts import Combined, CombinedRun
from selfcal_ros.model.result import CalibrationResult, created_now, result_to_dict
from selfcal_ros.outputs import check_outputs, write_json
from selfcal_ros.reporting.summary.numbers import arcsec, p_text, um
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.results import read_result


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "maps",
        metavar="RESULT.json|MAP.csv",
        nargs="+",
        help="results of `selfcal solve`, and maps from other sources as CSV (x, "
        "y, gx, gy, u_gx, u_gy in m, as `selfcal table` writes)",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="MEAN.json",
        required=True,
        help="mean map to write, read by the other verbs as a RESULT.json; - = stdout",
    )
    parser.add_argument(
        "--keep-scale",
        action="store_true",
        help="keep the magnification: every calibration has a reference length",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Combine, write the mean map, print the deviation of each run."""
    check_outputs(args.maps, [file_of(args)])
    parts = read_parts(args.maps)
    with busy("combining"):
        result = worded(created_now(combine(parts, keep_scale=args.keep_scale).result))
    data = result_to_dict(result)
    if args.output == STDOUT:
        put(data)
    else:
        write_json(args.output, data)
    if args.json and args.output != STDOUT:
        put({"written": args.output, **data["combined"], "verdict": data["verdict"]})
    elif not args.json:
        tell(_text(result), aside(args))
    return 0


def read_parts(names: Sequence[str]) -> list[Member]:
    """Return the maps of files; those of CSV files on the lattice of the first result."""
    tables = [name for name in names if name.lower().endswith(".csv")]
    results = {name: read_result(name) for name in names if name not in tables}
    if not results:
        raise InputError(
            names[0],
            "no RESULT.json is named",
            "name at least one: it defines the sites of the mean",
        )
    artifact = next(iter(results.values())).artifact
    return [
        Member(name, results[name].error_map, results[name])
        if name in results
        else Member(name, map_from_table(read_text(name), name, artifact))
        for name in names
    ]


def _text(result: CalibrationResult) -> str:
    emap, noise = result.error_map, result.noise
    figures = cast(Combined, result.parts.combined)
    u = [rms(emap.u_gx), rms(emap.u_gy)]
    lines = [
        f"mean of {len(figures.runs)} maps: {result.verdict.sentence}",
        f"XY     U {um(noise.k_xy * math.hypot(*u) / math.sqrt(2))} rms "
        f"(k = {noise.k_xy:.3g}, 95.45 %), between runs {um(figures.u_between_m)} rms, "
        f"{p_text(figures.p_between)}",
    ]
    if figures.u_between_rad is not None and figures.p_between_theta is not None:
        lines.append(
            f"theta  U {arcsec(noise.k_theta * rms(emap.u_g_theta))} rms "
            f"(k = {noise.k_theta:.3g}), between runs {arcsec(figures.u_between_rad)} rms, "
            f"{p_text(figures.p_between_theta)}"
        )
    lines.append("each map against the mean of the others:")
    for run in figures.runs:
        lines.append(
            f"  {run.file}: weight {run.weight:.3f}, |E_n| rms "
            f"{run.e_n_rms:.2f}, largest {run.e_n_largest:.2f}, beyond 1 at "
            f"{100 * run.beyond:.1f} %{_p(run)}{_run_text(run)}"
        )
    return "\n".join([*lines, *(f"warning: {line}" for line in result.warnings)])


def _p(run: CombinedRun) -> str:
    of_kinds = (run.p, ""), (run.p_theta, " in theta")
    return "".join(
        f", {p_text(p)}{where}"
        for p, where in of_kinds
        if p is not None and not math.isnan(p)
    )


def _run_text(run: CombinedRun) -> str:
    words = []
    for text, shown in (
        ("disagrees in", (run.agrees is False, run.agrees_theta is False)),
        ("stands out in", (run.stands_out, run.stands_out_theta)),
    ):
        kinds = list(compress(("XY", "theta"), shown))
        words += [f"{text} {' and '.join(kinds)}"] if kinds else []
    return f": {', '.join(words)}" if words else ""
