# SPDX-License-Identifier: Apache-2.0
"""``selfcal certificate``: a digital calibration certificate (DCC) of a result."""

import argparse

from selfcal_ros.applications.standards.dcc import certificate
from selfcal_ros.applications.standards.details import read_details
from selfcal_ros.applications.standards.statements import is_traceable
from selfcal_ros.cli.deliver import deliver
from selfcal_ros.cli.terminal import add_json, file_of
from selfcal_ros.outputs import check_outputs
from selfcal_ros.results import read_result


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "result",
        metavar="RESULT.json",
        help="result of `selfcal solve` or `selfcal combine`",
    )
    parser.add_argument(
        "details",
        metavar="DETAILS.yaml",
        help="laboratory, customer, item, persons, conditions (docs/guides/certificate.md)",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="DCC.xml",
        required=True,
        help="certificate to write; - = stdout",
    )
    parser.add_argument(
        "--covariance",
        action="store_true",
        help="include the covariance of all nodes, up to 21 x 21",
    )
    parser.add_argument(
        "--not-qualified",
        action="store_true",
        help="certify a result that is not qualified, and state that it is not",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Read result and details, write the certificate."""
    check_outputs([args.result, args.details], [file_of(args)])
    result = read_result(args.result)
    details = read_details(args.details)
    xml = certificate(
        result, details, covariance=args.covariance, not_qualified=args.not_qualified
    )
    traceable = is_traceable(result)
    return deliver(
        args,
        result,
        xml,
        "xml",
        note=f", {'' if traceable else 'not '}traceable",
        traceable=traceable,
        qualified=result.verdict.qualified,
    )
