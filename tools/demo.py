# SPDX-License-Identifier: Apache-2.0
"""`make demo`: replay a recorded bag through the live nodes and show the map that they find."""

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from selfcal_ros.model.error_map import ErrorMap
    from selfcal_ros.model.result import CalibrationResult

ROOT = Path(__file__).parents[1]
BAG = ROOT / "bags" / "demo"
FOLDER = ROOT / "build" / "demo"

MOST = 27
"""Sites along a side; of larger fields every second, third, ... is shown."""


def main() -> int:
    """Run the demo; Ctrl-C is one line at any time."""
    try:
        return demo()
    except KeyboardInterrupt:
        print("demo: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT


def demo() -> int:
    """Replay, plot, report; what takes long to import is imported here, where Ctrl-C is caught."""
    from selfcal_ros.bagio.offline import read_truth
    from selfcal_ros.cli.main import main as selfcal
    from selfcal_ros.cli.terminal import tell
    from selfcal_ros.files import read_json
    from selfcal_ros.model.result import result_from_dict
    from selfcal_ros.reporting.figures.maps import map_picture
    from selfcal_ros.reporting.figures.paper import save_picture

    FOLDER.mkdir(parents=True, exist_ok=True)
    output = (FOLDER / "result.json").relative_to(Path.cwd(), walk_up=True)
    print(
        f"Replaying {BAG.relative_to(ROOT)} over DDS through measurement_collector, "
        "pose_sequencer and solver ...",
        flush=True,
    )
    code = selfcal(["replay", str(BAG), "--fast", "--force", "-o", str(output)])
    if code:
        return code
    result = result_from_dict(read_json(output), str(output))
    save_picture(map_picture(result, read_truth(BAG)), FOLDER / "map.png")
    code = selfcal(
        [
            "report",
            str(output),
            "--force",
            "-o",
            str(FOLDER / "report.html"),
            "--truth",
            str(BAG / "truth.json"),
        ]
    )
    if code:
        return code
    if sys.stdout.isatty():
        tell("\n".join(["", *shades(result.error_map), *known_to(result), ""]))
    for name, what in (
        ("result.json", "the result"),
        ("map.png", "picture of the map"),
        ("report.html", "report: open it"),
    ):
        print(f"{what:18} {(FOLDER / name).relative_to(ROOT)}")
    return 0


def shades(emap: "ErrorMap") -> list[str]:
    """Return the length of the error at the sites as shades, y upwards; ``?`` = not known."""
    import numpy as np

    from selfcal_ros.cli.screen import SHADES
    from selfcal_ros.units import UM_PER_M

    artifact = emap.artifact
    step = max(1, -(-max(artifact.shape) // MOST))
    sites = tuple(slice(at % step, None, step) for at in artifact.middle)
    length = np.hypot(emap.gx, emap.gy)[sites] * UM_PER_M
    known = np.isfinite(length)
    most = float(length[known].max()) if known.any() else 0.0
    part = np.where(known, length, 0.0) / (most or 1.0)
    level = np.minimum((part * len(SHADES)).astype(int), len(SHADES) - 1)
    rows = [
        " ".join(
            SHADES[k] if good else "?" for k, good in zip(levels, goods, strict=True)
        )
        for levels, goods in zip(
            level.T[::-1].tolist(), known.T[::-1].tolist(), strict=True
        )
    ]
    return [f"  {row}" for row in rows] + [
        f"  length of the error: from ' ' = 0 to '{SHADES[-1]}' = {most:.3g} µm; x to the right, "
        "y upwards"
    ]


def known_to(result: "CalibrationResult") -> list[str]:
    """Return the line with the uncertainty of the map, at its nodes and between them."""
    from selfcal_ros.estimation.verdict.uncertainty import budgets
    from selfcal_ros.reporting.summary.numbers import um

    nodes, anywhere = (budget for budget in budgets(result) if budget.quantity == "xy")
    return [
        f"  known to ±{um(nodes.U_max)} at the nodes, ±{um(anywhere.U_max)} anywhere "
        f"(k={nodes.k:.3g})"
    ]


if __name__ == "__main__":
    sys.exit(main())
