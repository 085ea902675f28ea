# SPDX-License-Identifier: Apache-2.0
"""From the model to the fields of messages, as plain nested dicts.

`bagio.writer.build` creates messages of rosbags from them, nodes those of rclpy.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from selfcal_ros.collection.expected import Missing, ViewProgress
from selfcal_ros.collection.inputs import DETECTED, Command, Detection, EncoderSample
from selfcal_ros.collection.timeline import Timeline
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import (
    COLUMNS,
    VISIT_COLUMNS,
    GridVisits,
    Measurements,
    RepeatMotion,
    ViewReadings,
)
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Grade
from selfcal_ros.model.view import View, plan_keys
from selfcal_ros.topics import COMMAND_TOPIC, DETECTION_TOPIC, ENCODER_TOPIC
from selfcal_ros.units import NS_PER_S

Fields = dict[str, Any]
NAMED_BELOW = 20
"""Number of missing marks and lines from which a status that makes progress does not name them."""


def header(stamp_ns: int, frame_id: str) -> Fields:
    """Return the fields of a std_msgs/Header."""
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}


def event_fields(
    event: Command | Detection | EncoderSample, frame_id: str
) -> tuple[str, Fields]:
    """Return topic and fields of a message of a cell."""
    if isinstance(event, Command):
        return COMMAND_TOPIC, command(event, frame_id)
    if isinstance(event, Detection):
        return DETECTION_TOPIC, detection(event, frame_id)
    return ENCODER_TOPIC, joint_state(event, frame_id)


def joint_state(sample: EncoderSample, frame_id: str) -> Fields:
    """Return the fields of a sensor_msgs/JointState."""
    return {
        "header": header(sample.stamp_ns, frame_id),
        "name": list(sample.names),
        "position": list(sample.positions),
        "velocity": list(sample.velocities),
        "effort": [],
    }


def image(values: np.ndarray, encoding: str, stamp_ns: int, frame_id: str) -> Fields:
    """Return the fields of a sensor_msgs/Image with values of one channel (h, w)."""
    height, width = values.shape
    return {
        "header": header(stamp_ns, frame_id),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": width * values.itemsize,
        "data": np.frombuffer(
            values.astype(values.dtype.newbyteorder("<")).tobytes(), np.uint8
        ),
    }


def detection(d: Detection, frame_id: str) -> Fields:
    """Return the fields of a selfcal_msgs/MarkDetection."""
    return {
        "header": header(d.stamp_ns, frame_id),
        **{name: getattr(d, name) for name in DETECTED},
    }


def _artifact(artifact: Artifact) -> Fields:
    if artifact.marks:
        return {
            **_NO_PLATE,
            "angular_count": artifact.angular_count,
            "map_harmonics": artifact.harmonics,
        }
    return {
        "grid_size": artifact.grid_size,
        "grid_pitch": artifact.grid_pitch_m,
        "angular_count": artifact.angular_count,
        "grid_size_y": artifact.grid_size_y,
        "map_harmonics": artifact.harmonics,
    }


_NO_PLATE = {
    "grid_size": 0,
    "grid_pitch": 0.0,
    "angular_count": 0,
    "grid_size_y": 0,
    "map_harmonics": 0,
}


def _marks(artifact: Artifact | None) -> Fields:
    """Return the fields of a list of marks; empty for a lattice."""
    marks = artifact.marks if artifact else None
    return {
        "mark_id": marks.id_array if marks else [],
        "mark_x": marks.places_m[0] if marks else [],
        "mark_y": marks.places_m[1] if marks else [],
    }


def _map_grid(artifact: Artifact | None) -> Fields:
    """Return the fields of the map's nodes; zeros where they are the sites of the plate."""
    grid = artifact.map_grid if artifact else None
    return {
        "map_grid_size": grid.size if grid else 0,
        "map_grid_size_y": grid.size_y if grid else 0,
        "map_grid_pitch": grid.pitch_m if grid else 0.0,
        "map_interpolation": str(grid.interpolation) if grid else "",
    }


def _image(view: View | None) -> Fields:
    """Return the fields of the marks that an image shows; zeros without images."""
    image = view.image if view else None
    return {
        "image_nx": image.nx if image else 0,
        "image_ny": image.ny if image else 0,
        "image_pitch": image.pitch_m if image else 0.0,
    }


def _view(view: View) -> Fields:
    return {
        "view_name": view.name,
        "rotation": view.rotation_rad,
        "translation_x": view.translation_m[0],
        "translation_y": view.translation_m[1],
        "grid": view.grid,
        "angular": view.angular,
        "repeats": view.repeats,
    }


def command(c: Command, frame_id: str) -> Fields:
    """Return the fields of a selfcal_msgs/ViewCommand."""
    view = _view(c.view or View("", grid=False, angular=False, repeats=0))
    plate = _artifact(c.artifact) if c.artifact else _NO_PLATE
    return {
        "header": header(c.stamp_ns, frame_id),
        "phase": int(c.phase),
        "plan_id": c.plan_id,
        "view_index": c.view_index,
        **view,
        **plate,
        "views_planned": c.views_planned,
        "visit_order": c.view.visit_order if c.view else "",
        "run_id": c.run_id,
        "model_terms": list(c.model_terms),
        "check_marks": c.view.check_marks if c.view else 0,
        "check_offset": c.view.check_offset_m if c.view else 0.0,
        **_map_grid(c.artifact),
        **_image(c.view),
        "artifact_from": c.artifact_from,
        **_marks(c.artifact),
        "plan_keys": _plan_keys(c),
    }


def _plan_keys(source: Command | Measurements) -> list[str]:
    """Return the keys of a plan that have no field of their own."""
    return [f"{key}: {text}" for key, text in plan_keys(source).items() if text]


def view_status(
    progress: ViewProgress,
    plan_id: str,
    stamp_ns: int,
    frame_id: str,
    *,
    run_id: str = "",
    name_all: bool = False,
) -> Fields:
    """Return the fields of a selfcal_msgs/ViewStatus.

    Missing marks and lines are named if they are fewer than `NAMED_BELOW`, or with `name_all`.
    """
    readings = progress.readings
    n_missing = (
        progress.grid_expected
        - progress.grid_done
        + progress.angular_expected
        - progress.angular_done
    )
    missing = progress.missing if name_all or n_missing < NAMED_BELOW else Missing()
    return {
        "header": header(stamp_ns, frame_id),
        "plan_id": plan_id,
        "view_index": progress.view_index,
        "view_name": progress.view.name,
        "grid_expected": progress.grid_expected,
        "grid_done": progress.grid_done,
        "angular_expected": progress.angular_expected,
        "angular_done": progress.angular_done,
        "detections_used": readings.used,
        "detections_rejected": sum(readings.rejected.values()),
        **_rejected(readings.rejected, "reject"),
        "sigma_xy": readings.sigma_xy,
        "sigma_theta": readings.sigma_theta,
        "complete": progress.complete,
        "missing_m": list(missing.m),
        "missing_n": list(missing.n),
        "missing_k": list(missing.k),
        "run_id": run_id,
        "check_expected": progress.check_expected,
        "check_done": progress.check_done,
    }


def view_measurement(
    progress: ViewProgress,
    measurements: Measurements,
    stamp_ns: int,
    frame_id: str,
    notes: Iterable[str] = (),
) -> Fields:
    """Return the fields of a selfcal_msgs/ViewMeasurement; `notes` are lines on the session.

    With images there is one message for each of the readings' parts.
    """
    readings = progress.readings
    return {
        "header": header(stamp_ns, frame_id),
        "plan_id": measurements.plan_id,
        "view_index": progress.view_index,
        **_view(readings.view),
        **_artifact(measurements.artifact),
        **{name: getattr(readings, name) for name, _ in COLUMNS},
        "sigma_xy": readings.sigma_xy,
        "sigma_theta": readings.sigma_theta,
        "dof_xy": readings.dof_xy,
        "dof_theta": readings.dof_theta,
        "detections_used": readings.used,
        **_rejected(readings.rejected, "reject"),
        "measurement_sense": str(measurements.sense),
        **_rejected(measurements.rejected, "session_reject"),
        **_visits(readings.visits),
        **_motion("motion", readings.motion),
        **_motion("motion_theta", readings.motion_theta),
        "run_id": measurements.run_id,
        "model_terms": list(measurements.model_terms),
        "session_notes": list(notes),
        **_map_grid(measurements.artifact),
        **_image(readings.view),
        "image_x": (readings.view.cell or (0, 0))[0],
        "image_y": (readings.view.cell or (0, 0))[1],
        "artifact_from": measurements.artifact_from,
        **_marks(measurements.artifact),
        "axis_theta": readings.axis_theta,
        "visit_order": readings.view.visit_order,
        **_places(readings),
        "plan_keys": _plan_keys(measurements),
    }


def _visits(visits: GridVisits | None) -> Fields:
    """Return the fields of the visits of a view; empty if unknown."""
    fields = {
        f"visit_{name.removesuffix('_ns')}": getattr(visits, name) if visits else []
        for name, _ in VISIT_COLUMNS
    }
    return {
        **fields,
        "sigma_visit": visits.sigma_m if visits else float("nan"),
        "dof_visit": visits.dof if visits else 0,
    }


def _places(readings: ViewReadings) -> Fields:
    """Return the fields of the positions of rejected detections."""
    number = {reason: index for index, reason in enumerate(readings.rejected)}
    return {
        "rejected_reason": [number[reason] for reason in readings.places.reason],
        "rejected_x": readings.places.x,
        "rejected_y": readings.places.y,
    }


def _motion(name: str, motion: RepeatMotion | None) -> Fields:
    """Return the fields of sums over repeats; empty if unknown."""
    return {
        name: motion.products.ravel() if motion else [],
        f"dof_{name}": motion.dof if motion else 0,
    }


def _rejected(rejected: dict[str, int], prefix: str) -> Fields:
    return {
        f"{prefix}_reasons": list(rejected),
        f"{prefix}_counts": list(rejected.values()),
    }


def error_map(result: CalibrationResult, stamp_ns: int, frame_id: str) -> Fields:
    """Return the fields of a selfcal_msgs/ErrorMap."""
    emap = result.error_map
    return {
        "header": header(stamp_ns, frame_id),
        "plan_id": result.plan_id,
        "datum_theta": str(emap.datum_theta),
        **_artifact(emap.artifact),
        **{name: getattr(emap, name).ravel() for name in ("gx", "gy", "u_gx", "u_gy")},
        "valid": emap.valid.ravel().tolist(),
        "g_theta": emap.g_theta,
        "u_g_theta": emap.u_g_theta,
        "nonorthogonality": emap.nonorthogonality,
        "scale_difference": emap.scale_difference,
        "sigma_xy": result.noise.sigma_xy,
        "sigma_theta": result.noise.sigma_theta,
        "identifiable": result.observability.identifiable,
        "qualified": result.verdict.qualified,
        "run_id": result.run_id,
        "grade": grade_number(result),
        "interpolation": result.interpolation,
    }


def grade_number(result: CalibrationResult) -> int:
    """Return the grade of a result for ErrorMap and CalibrationSummary."""
    if not result.observability.identifiable:
        return 0
    return {Grade.NOT_QUALIFIED: 0, Grade.ENLARGED: 1, Grade.GOOD: 2}[
        result.verdict.grade
    ]


def session_stamp_ns(timeline: Timeline, progress: ViewProgress) -> int:
    """Return the end of a view, or the last command while the view is still open."""
    return min(progress.end_ns, timeline.last_stamp_ns)
