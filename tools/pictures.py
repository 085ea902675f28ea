# SPDX-License-Identifier: Apache-2.0
"""`make pictures`: the pictures of README and docs, made from the demo's bag and the code."""

import base64
import io
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from selfcal_ros.bagio.offline import bag_input, collect_bag, read_truth
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult, with_input
from selfcal_ros.outputs import write_text
from selfcal_ros.reporting.chapters import chapters
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.reporting.figures.places import plan_figure
from selfcal_ros.reporting.figures.svg import svg_file
from selfcal_ros.reporting.summary.numbers import truth_arrays
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.settings.nodes import CollectorSettings, SolverSettings
from selfcal_ros.simulation.rendering import Camera, Exposure
from selfcal_ros.simulation.spec import read_simulation
from selfcal_ros.vision.detector import MarkDetector
from selfcal_ros.vision.images import Picture

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "pictures"
BAG = ROOT / "bags" / "hu_noise"
SHOWN = 12
"""The exposure of the simulated camera that the documents show: its axis at the plate's centre."""
FIGURES = ("error-map", "residual-maps")
"""Figures of the report of the demo's bag that the documents show."""


def calibrated() -> tuple[CalibrationResult, Measurements]:
    """Return the calibration of the demo's bag, and the readings in it."""
    measurements, _, lost, _ = collect_bag(
        BAG, CollectorSettings.checked({}, "pictures")
    )
    options = solver_options(SolverSettings.checked({}, "pictures"), measurements)
    result = with_input(worded(calibrate(measurements, options)), bag_input(BAG), lost)
    return result, measurements


def camera_image() -> str:
    """Return an image of the simulated camera and the marks found in it, as SVG."""
    simulation = read_simulation(ROOT / "config" / "simulations" / "camera.yaml")
    _, arrivals, _ = simulation.run()
    exposed = [event for _, event in arrivals if isinstance(event, Exposure)]
    camera = simulation.camera or Camera()
    values = camera.image(exposed[SHOWN].offsets, np.random.default_rng(1))
    detector = MarkDetector(
        DetectorSettings(pixel_size=camera.pixel_size_m, mark_size=camera.mark_size_m)
    )
    marks, _ = detector.marks(Picture(values, camera.full_scale))
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG")
    data = base64.b64encode(file.getvalue()).decode()
    rings = "".join(
        f'<circle cx="{mark.u + 0.5:.1f}" cy="{mark.v + 0.5:.1f}" r="8"/>'
        for mark in marks
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {camera.width} {camera.height}" '
        f'width="{5 * camera.width}" height="{5 * camera.height}">\n'
        f'<image width="{camera.width}" height="{camera.height}" '
        f'style="image-rendering:pixelated" href="data:image/png;base64,{data}"/>\n'
        f'<g fill="none" stroke="#d62728" stroke-width="0.5">{rings}</g>\n'
        f'<text x="2" y="{camera.height - 2}" font-size="5" font-family="sans-serif" '
        f'fill="#d62728">{len(marks)} marks</text>\n</svg>\n'
    )


def pictures() -> dict[str, str]:
    """Return name -> content of every picture."""
    result, measurements = calibrated()
    found = {
        figure.drawing.name: figure.drawing
        for chapter in chapters(result, truth_arrays(result.error_map, read_truth(BAG)))
        for figure in chapter.figures
    }
    drawings: list[Drawing] = [
        *(found[name] for name in FIGURES),
        plan_figure(measurements.artifact, [view.view for view in measurements.views]),
    ]
    return {f"{drawing.name}.svg": svg_file(drawing) for drawing in drawings} | {
        "camera-image.svg": camera_image()
    }


def main() -> int:
    FOLDER.mkdir(exist_ok=True)
    for name, text in pictures().items():
        write_text(FOLDER / name, text)
        print(f"{(FOLDER / name).relative_to(ROOT)}: {len(text) / 1024:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
