# SPDX-License-Identifier: Apache-2.0
"""Calibrations of one simulated machine in a folder, for the verbs that follow them."""

import json
from pathlib import Path

from selfcal_ros.cli.main import main


def simulate(folder: Path, name: str, plan: dict, **machine: object) -> None:
    """Write the bag NAME of a plan, measured on a machine as simulation files describe it."""
    (folder / f"{name}_plan.yaml").write_text(json.dumps(plan))  # YAML, too
    (folder / f"{name}.yaml").write_text(
        json.dumps(machine | {"plan": f"{name}_plan.yaml"})
    )
    assert (
        main(["simulate", str(folder / f"{name}.yaml"), "-o", str(folder / name)]) == 0
    )


def two_and_a_view(
    folder: Path, plan: dict, seeds: tuple[int, int, int], **machine: object
) -> Path:
    """Return the folder with two calibrations, results one.json, two.json, and one view: again.

    All of one machine and plate, with the seeds of their noise.
    """
    for name, seed in zip(("one", "two", "again"), seeds, strict=True):
        views = plan["views"][:1] if name == "again" else plan["views"]
        simulate(folder, name, plan | {"views": views}, noise_seed=seed, **machine)
        if name != "again":
            assert (
                main(
                    [
                        "solve",
                        str(folder / name),
                        "-o",
                        str(folder / f"{name}.json"),
                        "--quiet",
                    ]
                )
                == 0
            )
    return folder
