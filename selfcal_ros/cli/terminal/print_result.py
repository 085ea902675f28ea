# SPDX-License-Identifier: Apache-2.0
"""Terminal output of a result."""

import sys
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from selfcal_ros.model.result import CalibrationResult


def show(result: "CalibrationResult", bag: str, output: str | None, stream: TextIO) -> None:
    """Print the summary, compared with the truth if the bag folder has one."""
    from selfcal_ros.bagio.offline import read_truth
    from selfcal_ros.reporting.summary.format import can_print_symbols
    from selfcal_ros.reporting.summary.sections import summary_text

    print(summary_text(result, truth=read_truth(bag), ascii_only=not can_print_symbols(stream)),
          file=stream)
    if output:
        print(f"result: {output}", file=stream)


def exit_code(result: "CalibrationResult") -> int:
    """Return the exit code of a result that was computed: 0, or 5 if it is not qualified.

    The reason is printed in one line on stderr in any case.
    """
    from selfcal_ros.errors import ExitCode

    said = say_unless_qualified(result, "selfcal")
    return int(ExitCode.NOT_QUALIFIED if said else ExitCode.DONE)


def say_unless_qualified(result: "CalibrationResult", who: str) -> bool:
    """Print the verdict on stderr, and return whether a result is not qualified."""
    from selfcal_ros.model.verdict import Grade
    from selfcal_ros.reporting.summary.format import can_print_symbols, printable, to_ascii

    if result.verdict.grade is Grade.GOOD:
        return False
    line = printable(f"{who}: {result.verdict.sentence}")
    print(line if can_print_symbols(sys.stderr) else to_ascii(line), file=sys.stderr)
    return not result.verdict.qualified
