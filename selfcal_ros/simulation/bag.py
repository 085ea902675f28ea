# SPDX-License-Identifier: Apache-2.0
"""A simulation written as a bag, with its truth."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from selfcal_ros import topics
from selfcal_ros.bagio.exposure_table import COLUMNS
from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.offline import TRUTH_FILE
from selfcal_ros.bagio.writer import BagWriter, new_bag
from selfcal_ros.collection import inputs
from selfcal_ros.errors import InputError
from selfcal_ros.outputs import plain, write_json, write_text
from selfcal_ros.simulation.machine import Truth
from selfcal_ros.simulation.physics import stage_error
from selfcal_ros.simulation.rendering import Camera, Exposure
from selfcal_ros.simulation.spec import Simulation

QOS = {
    topics.ENCODER_TOPIC: topics.qos_profile(
        reliable=True, transient_local=False, depth=1000
    ),
    topics.DETECTION_TOPIC: topics.qos_profile(
        reliable=True, transient_local=False, depth=1000
    ),
    topics.COMMAND_TOPIC: topics.qos_profile(
        reliable=True, transient_local=True, depth=64
    ),
}
IMAGE_TOPIC = topics.IMAGE_TOPICS["raw"]
POSITIONS_FILE = "positions.csv"
IMAGES = 0x1D
"""Part of the seed of the images."""


def write_simulation(
    simulation: Simulation,
    path: str | Path,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, int]:
    """Simulate, write the bag folder `path` with `truth.json` in it, return messages by topic.

    It is written under another name and renamed when complete.

    Raises
    ------
    InputError
        If the folder exists, or cannot be created or written.
    """
    with new_bag(path) as unfinished:
        return _write(simulation, unfinished, progress)


def _write(
    simulation: Simulation, path: Path, progress: Callable[[int, int], None]
) -> dict[str, int]:
    truth, arrivals, ledger = simulation.run()
    rng = np.random.default_rng((simulation.seed, simulation.noise_seed or 0, IMAGES))
    with BagWriter(path, simulation.compression) as writer:
        for topic, typename in topics.INPUT_TOPICS.items():
            writer.add_topic(f"/{topic}", typename, [QOS[topic]])
        if simulation.camera:
            writer.add_topic(
                f"/{IMAGE_TOPIC}",
                topics.IMAGE_TYPES["raw"],
                [QOS[topics.DETECTION_TOPIC]],
            )
        for number, (arrival_ns, event) in enumerate(arrivals):
            if isinstance(event, Exposure):
                topic, fields = image_fields(event, simulation.camera or Camera(), rng)
            else:
                topic, fields = from_model.event_fields(event, "stage")
            writer.write(f"/{topic}", fields, arrival_ns)
            if number % 1000 == 0:
                progress(number, len(arrivals))
        write_truth(
            path / TRUTH_FILE,
            truth,
            seed=simulation.seed,
            noise_seed=simulation.noise_seed,
            faults=ledger,
            cell=asdict(simulation.settings),
            spread=asdict(simulation.spread),
            **({"camera": asdict(simulation.camera)} if simulation.camera else {}),
        )
        return writer.counts


def write_files(
    simulation: Simulation,
    path: str | Path,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, int]:
    """Write the images of a simulated camera as PNG files, with positions.csv and truth.json.

    Raises
    ------
    InputError
        If the cell has no camera, or the folder exists or cannot be written.
    """
    from PIL import Image  # needed for files alone

    if simulation.camera is None:
        raise InputError("SIM.yaml", "the cell has no camera", "add the key 'camera'")
    truth, arrivals, _ = simulation.run()
    rng = np.random.default_rng((simulation.seed, simulation.noise_seed or 0, IMAGES))
    view = ""
    last = inputs.EncoderSample(0, (), (0.0, 0.0))
    rows = [",".join(COLUMNS)]
    with new_bag(path) as folder:
        folder.mkdir()
        for number, (_, event) in enumerate(arrivals):
            if isinstance(event, inputs.Command) and event.view is not None:
                view = event.view.name
            elif isinstance(event, inputs.EncoderSample):
                last = event
            elif isinstance(event, Exposure):
                name = f"{len(rows):05}.png"
                Image.fromarray(
                    simulation.camera.image(event.offsets, rng, angles=event.angle)
                ).save(folder / name)
                rows.append(
                    f"{name},{view},{last.positions[0]!r},{last.positions[1]!r}"
                )
            if number % 1000 == 0:
                progress(number, len(arrivals))
        write_text(folder / POSITIONS_FILE, "\n".join(rows) + "\n")
        write_truth(
            folder / TRUTH_FILE,
            truth,
            seed=simulation.seed,
            noise_seed=simulation.noise_seed,
            cell=asdict(simulation.settings),
            spread=asdict(simulation.spread),
            camera=asdict(simulation.camera),
        )
    return {"images": len(rows) - 1}


def image_fields(
    exposure: Exposure, camera: Camera, rng: np.random.Generator
) -> tuple[str, from_model.Fields]:
    """Return topic and fields of a rendered image."""
    values = camera.image(exposure.offsets, rng, angles=exposure.angle)
    return IMAGE_TOPIC, from_model.image(
        values, camera.encoding, exposure.stamp_ns, "camera"
    )


def write_truth(path: Path, truth: Truth, **provenance: object) -> None:
    """Write the known truth, that of the stage at the nodes of its map.

    gx, gy, ax, ay (m), g_theta, a_theta (rad); of each view phi (rad), t, drift, drift_walk,
    plate_shape, stage_bend (m), plate_scale, plate_strain, plate_tilt and line_eccentricity (rad),
    empty if none; stage_yaw (rad) at the sites; rotation, microscope, backlash (m); placed, the
    actual poses of views that are not placed as commanded.
    """
    g = truth.g
    if truth.artifact.map_grid is not None:
        nodes = truth.artifact.field
        still = replace(truth, stage_bend_m=truth.stage_bend_m[:0])
        places = np.stack([nodes.x_m.ravel(), nodes.y_m.ravel()])
        g = stage_error(still, places).reshape(2, *nodes.shape)
    write_json(
        path,
        plain(
            {
                "gx": g[0],
                "gy": g[1],
                "g_theta": truth.g_theta,
                "ax": truth.a[0],
                "ay": truth.a[1],
                "a_theta": truth.a_theta,
                "phi": truth.phi_rad,
                "t": truth.t_m,
                "rotation": "linear" if truth.linear else "finite",
                "microscope": truth.microscope,
                "backlash": truth.backlash_m,
                "plate_scale": truth.plate_scale,
                "plate_shape": truth.plate_shape_m,
                "drift": truth.drift_m,
                "drift_walk": truth.walk_m,
                "stage_bend": truth.stage_bend_m,
                "stage_yaw": truth.yaw,
                "plate_strain": truth.plate_strain,
                "plate_tilt": truth.plate_tilt_rad,
                "line_eccentricity": truth.line_eccentricity_rad,
                "placed": [
                    None
                    if view is None
                    else {
                        "rotation": view.rotation_rad,
                        "translation": view.translation_m,
                    }
                    for view in truth.placed
                ],
                **provenance,
            }
        ),
    )
