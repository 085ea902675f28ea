# SPDX-License-Identifier: Apache-2.0
"""What a certificate states of a simulated measurement."""

from pathlib import Path

DETAILS = Path(__file__).parents[2] / "config/certificates/details.yaml"


def simulated_details(folder: Path) -> str:
    """Return the path of the example's details with a word on the clock of simulated readings."""
    path = folder / "details.yaml"
    path.write_text(
        DETAILS.read_text().replace(
            "certificate:\n", "certificate:\n  clock: simulated\n", 1
        )
    )
    return str(path)
