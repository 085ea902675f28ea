# SPDX-License-Identifier: Apache-2.0
"""Make the recorded bags in bags/ and their manifest anew.

hu_noise is recorded from the live topics of the simulated cell; the others are written directly.
``make_bags.py NAME ...`` makes only these bags, ``make_bags.py --manifest`` none.
"""

import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml

from selfcal_ros.bagio.images import ImageBag
from selfcal_ros.bagio.offline import TRUTH_FILE, bag_input, collect_bag
from selfcal_ros.cli.replay import domain, process
from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.outputs import write_text
from selfcal_ros.reporting.summary.numbers import summary_numbers
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.settings.nodes import CollectorSettings, SolverSettings
from selfcal_ros.simulation.bag import write_simulation
from selfcal_ros.simulation.spec import read_simulation
from selfcal_ros.units import PPM_PER_ONE, URAD_PER_RAD
from selfcal_ros.vision.exposures import ImageDetector

ROOT = Path(__file__).parents[1]
BAGS = ROOT / "bags"
WRITTEN = {
    "hu_exact": "hu_exact.yaml",
    "fig10_faults": "fig10_faults.yaml",
    "deficient": "deficient.yaml",
    "camera": "camera.yaml",
    "demo": "demo.yaml",
}
DETECT = {"camera": {"pixel_size": 6.0e-6, "mark_size": 72.0e-6, "turn": 1.5}}
"""Parameters of mark_detector for bags of images."""
RECORDED = "hu_noise"
MANIFEST_ALONE = "--manifest"
PARAMS = ROOT / "config" / "params" / "simulated_cell.yaml"
PLAN = ROOT / "config" / "plans" / "hu_repeated.yaml"


def record(bag: Path) -> None:
    """Run the simulated cell, its collector and its sequencer live, and record them."""
    truth = bag.parent / "truth.tmp"
    params = ["--ros-args", "--params-file", str(PARAMS)]
    with ExitStack() as stack:
        environment = stack.enter_context(domain())

        def start(node: str, *more: str, **kwargs):
            return stack.enter_context(
                process(
                    f"selfcal_ros.nodes.{node}", [*params, *more], environment, **kwargs
                )
            )

        start("bag_recorder", "-p", f"bag:={bag}", "-p", "all_topics:=false")
        start("stage_simulator", "-p", f"truth_path:={truth}")
        start("measurement_collector")
        sequencer = start(
            "pose_sequencer",
            "-p",
            f"plan:={PLAN}",
            "-p",
            "settle_time:=3.0",
            stderr=subprocess.PIPE,
            text=True,
        )
        for line in sequencer.stderr:
            print(line, end="", flush=True)
            if "DONE" in line:
                break
    truth.replace(bag / TRUTH_FILE)


def of_images(name: str) -> dict:
    """Return what the detector must find in a bag of images, and what this gives."""
    detector = ImageDetector(DetectorSettings.checked(DETECT[name], name))
    with TemporaryDirectory() as folder:
        ImageBag(BAGS / name).write_detected(
            Path(folder, name), detector.take, check=lambda: None, frame_id="stage"
        )
        return {**detector.counts.values(), **of_detections(Path(folder, name))}


def of_detections(bag: Path) -> dict:
    """Return what a bag must give with the defaults of collector and solver."""
    measurements, _, lost, _ = collect_bag(
        bag, CollectorSettings.checked({}, "defaults")
    )
    expected: dict = {"rejected": measurements.all_rejected(), "lost": lost}
    settings = SolverSettings.checked({}, "defaults")
    try:
        result = calibrate(measurements, solver_options(settings, measurements))
    except NotIdentifiableError as error:
        return expected | {
            "identifiable": False,
            "deficiency": error.observability.deficiency,
        }
    numbers, emap = summary_numbers(result), result.error_map
    return expected | {
        "identifiable": True,
        "grade": str(result.verdict.grade),
        "max_error_um": round(numbers["max_error_um"], 4),
        "nonorthogonality_urad": round(emap.nonorthogonality * URAD_PER_RAD, 4),
        "scale_difference_ppm": round(emap.scale_difference * PPM_PER_ONE, 4),
    }


def entry(name: str, made: str) -> dict:
    """Return the manifest entry of a bag: digest, how it was made, what it must give."""
    about = {
        "sha256": bag_input(BAGS / name)["sha256"],
        "made": made,
        "truth": f"{name}/truth.json",
    }
    if name in DETECT:
        return about | {"detect": DETECT[name], "expected": of_images(name)}
    return about | {"expected": of_detections(BAGS / name)}


def main() -> None:
    names = sys.argv[1:] or [RECORDED, *WRITTEN]
    names = [name for name in names if name != MANIFEST_ALONE]
    for name in names:
        shutil.rmtree(BAGS / name, ignore_errors=True)
        if name == RECORDED:
            record(BAGS / name)
        else:
            write_simulation(
                read_simulation(ROOT / "config" / "simulations" / WRITTEN[name]),
                BAGS / name,
            )
    manifest = {
        RECORDED: entry(
            RECORDED,
            "recorded live by bag_recorder from stage_simulator, "
            "config/params/simulated_cell.yaml (seed 2020) and "
            "config/plans/hu_repeated.yaml; tools/make_bags.py",
        )
    }
    for name, file in WRITTEN.items():
        manifest[name] = entry(name, f"selfcal simulate config/simulations/{file}")
    write_text(
        BAGS / "manifest.yaml",
        "# Recorded bags: digest of the MCAP files, origin, and "
        "what they must give.\n" + yaml.safe_dump(manifest, sort_keys=False),
    )


if __name__ == "__main__":
    main()
