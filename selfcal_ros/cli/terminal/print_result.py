# SPDX-License-Identifier: Apache-2.0
"""What a verb prints of a result."""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from selfcal_ros.model.result import CalibrationResult


def show(result: "CalibrationResult", bag: str, output: str | None) -> None:
    """Print the summary, against the known truth where the bag folder holds one."""
    from selfcal_ros.bagio.simulated import read_truth
    from selfcal_ros.reporting.summary.format import can_print_symbols
    from selfcal_ros.reporting.summary.text import summary_text

    print(summary_text(result, truth=read_truth(bag), ascii_only=not can_print_symbols(sys.stdout)))
    if output:
        print(f"result: {output}")
