# SPDX-License-Identifier: Apache-2.0
"""`make pictures`: the pictures of README and docs, made from the demo's bag and the code."""

import sys
from pathlib import Path

from selfcal_ros.bagio.offline import bag_input, collect_bag, read_truth
from selfcal_ros.collection.settings.estimator import solver_options
from selfcal_ros.collection.settings.nodes import CollectorSettings, SolverSettings
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.files import write_text
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult, with_input
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.reporting.figures.places import plan_figure
from selfcal_ros.reporting.figures.svg import svg_file
from selfcal_ros.reporting.report import chapters
from selfcal_ros.reporting.summary.numbers import truth_arrays
from selfcal_ros.reporting.words.findings import worded

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "pictures"
BAG = ROOT / "bags" / "hu_noise"
FIGURES = ("error-map", "residual-maps")
"""Figures of the report of the demo's bag that the documents show."""


def calibrated() -> tuple[CalibrationResult, Measurements]:
    """Return the calibration of the demo's bag, and the readings in it."""
    measurements, _, lost, _ = collect_bag(
        BAG, CollectorSettings.checked({}, "pictures"))
    options = solver_options(SolverSettings.checked({}, "pictures"), measurements)
    result = with_input(worded(calibrate(measurements, options)), bag_input(BAG), lost)
    return result, measurements


def pictures() -> dict[str, str]:
    """Return name -> content of every picture."""
    result, measurements = calibrated()
    found = {figure.drawing.name: figure.drawing for chapter in
             chapters(result, truth_arrays(result.error_map, read_truth(BAG)))
             for figure in chapter.figures}
    drawings: list[Drawing] = [*(found[name] for name in FIGURES), plan_figure(
        measurements.artifact, [view.view for view in measurements.views])]
    return {f"{drawing.name}.svg": svg_file(drawing) for drawing in drawings}


def main() -> int:
    FOLDER.mkdir(exist_ok=True)
    for name, text in pictures().items():
        write_text(FOLDER / name, text)
        print(f"{(FOLDER / name).relative_to(ROOT)}: {len(text) / 1024:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
