# SPDX-License-Identifier: Apache-2.0
"""From messages to the model, one by one or many as columns.

Messages of rclpy and of rosbags have the same fields.
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import islice
from struct import Struct
from typing import Any, NamedTuple

import numpy as np

from selfcal_ros.bagio.messages import cdr
from selfcal_ros.collection.inputs import (
    DETECTED,
    DETECTION,
    Command,
    Detection,
    EncoderBlock,
    EncoderSample,
    Phase,
)
from selfcal_ros.errors import InputError, printable
from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum
from selfcal_ros.model.marks import marks_of
from selfcal_ros.model.pose import ImageCells
from selfcal_ros.model.readings import (
    COLUMNS,
    VISIT_COLUMNS,
    GridVisits,
    RejectedPlaces,
    RepeatMotion,
    Sense,
    ViewReadings,
)
from selfcal_ros.model.view import PLAN_KEYS, View, parse_order
from selfcal_ros.topics import COMMAND_TOPIC, ERROR_MAP_TOPIC, MEASUREMENT_TOPIC
from selfcal_ros.units import NS_PER_S

MOST_NOTES = 20
"""Largest number of lines on the session."""
TIME = (cdr.Field("sec", "i4"), cdr.Field("nanosec", "u4"))
HEADER = (cdr.Field("stamp", TIME), cdr.Field("frame_id", cdr.TEXT))
JOINT_STATE = (
    cdr.Field("header", HEADER),
    cdr.Field("name", cdr.TEXT, cdr.SEQUENCE),
    *(
        cdr.Field(name, "f8", cdr.SEQUENCE)
        for name in ("position", "velocity", "effort")
    ),
)
"""Fields of sensor_msgs/msg/JointState."""
STAMP_END = 12
"""Bytes of the encapsulation, and of the stamp after it."""


def stamp_ns(message: Any) -> int:
    """Return the stamp in the header of a message, integer ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def encoder_sample(message: Any) -> EncoderSample:
    """Return the sample in a sensor_msgs/JointState."""
    return EncoderSample(
        stamp_ns(message),
        tuple(message.name),
        tuple(_floats(message.position)),
        tuple(_floats(getattr(message, "velocity", ()))),
    )


def _floats(values: Any) -> list[float]:
    return values.tolist() if hasattr(values, "tolist") else list(values)


def detection(message: Any) -> Detection:
    """Return the detection in a selfcal_msgs/MarkDetection."""
    return Detection(
        stamp_ns=stamp_ns(message),
        kind=int(message.kind),
        has_id=bool(message.has_id),
        m=int(message.m),
        n=int(message.n),
        k=int(message.k),
        offset_x=float(message.offset_x),
        offset_y=float(message.offset_y),
        offset_theta=float(message.offset_theta),
        sigma=float(message.sigma),
        score=float(message.score),
    )


def command(message: Any) -> Command:
    """Return the command in a selfcal_msgs/ViewCommand.

    Raises
    ------
    InputError
        For an unknown phase, an invalid plate, a stamp before 1970, or an unknown key of the plan.
    """
    if stamp_ns(message) < 0:
        raise InputError(COMMAND_TOPIC, "the stamp is before 1970", "set the clock")
    refuse_unknown_keys(message, COMMAND_TOPIC)
    try:
        phase = Phase(int(message.phase))
    except ValueError as error:
        raise InputError(
            COMMAND_TOPIC,
            f"unknown phase {message.phase}",
            "use PLACE, MEASURE, DONE or ABORT",
        ) from error
    placed = phase in (Phase.PLACE, Phase.MEASURE)
    return Command(
        stamp_ns=stamp_ns(message),
        phase=phase,
        plan_id=str(message.plan_id),
        view_index=int(message.view_index),
        view=view_of(
            message,
            repeats=max(1, int(message.repeats)),
            grid=bool(message.grid),
            angular=bool(message.angular),
        )
        if placed
        else None,
        artifact=artifact_of(message) if placed else None,
        views_planned=int(getattr(message, "views_planned", 0)),
        run_id=str(getattr(message, "run_id", "")),
        model_terms=terms_of(message),
        artifact_from=plate_from(message),
        **plan_keys_of(message),
    )


def refuse_unknown_keys(message: Any, topic: str) -> None:
    """Raise InputError if a ViewCommand or ViewMeasurement has a key of a plan unknown here."""
    for text in getattr(message, "plan_keys", ()):
        key, colon, _ = str(text).partition(": ")
        if colon and key in PLAN_KEYS:
            continue
        raise InputError(
            topic,
            f"the key {printable(str(text).partition(':')[0])!r} of the plan is not known here",
            "run all nodes in the newer version",
        )


def terms_of(message: Any) -> tuple[str, ...]:
    """Return the terms of a ViewCommand or ViewMeasurement; none in old bags."""
    return tuple(map(str, getattr(message, "model_terms", ())))


def plate_from(message: Any) -> str:
    """Return the result that made the plate of a ViewCommand or ViewMeasurement known, or ""."""
    return str(getattr(message, "artifact_from", ""))


def plan_keys_of(message: Any) -> dict[str, str]:
    """Return the `PLAN_KEYS` of a ViewCommand or ViewMeasurement, "" for those not there."""
    texts = reversed(
        [str(text).partition(": ") for text in getattr(message, "plan_keys", ())]
    )
    text_of_key = {key: value for key, _, value in texts}  # the first of a key counts
    return {key: text_of_key.get(key, "") for key in PLAN_KEYS}


def notes_of(message: Any) -> tuple[str, ...]:
    """Return the lines on the session in a ViewMeasurement, at most `MOST_NOTES`."""
    return tuple(
        map(printable, islice(getattr(message, "session_notes", ()), MOST_NOTES))
    )


def artifact_of(message: Any) -> Artifact:
    """Return the plate of a ViewCommand, ViewMeasurement or ErrorMap."""
    ids = [int(number) for number in getattr(message, "mark_id", ())]
    marks = (
        marks_of(ids, _floats(message.mark_x), _floats(message.mark_y)) if ids else None
    )
    return Artifact(
        grid_size=int(message.grid_size),
        grid_pitch_m=float(message.grid_pitch),
        angular_count=int(message.angular_count),
        grid_size_y=int(getattr(message, "grid_size_y", 0)),
        map_grid=_map_grid_of(message),
        harmonics=int(getattr(message, "map_harmonics", 0)),
        marks=marks,
    )


def _map_grid_of(message: Any) -> MapGrid | None:
    """Return the nodes of the map; None if they are the sites of the plate, as in old bags."""
    size = int(getattr(message, "map_grid_size", 0))
    if not size:
        return None
    name = str(getattr(message, "map_interpolation", "")) or Interpolation.BICUBIC
    if name not in list(Interpolation):
        raise InputError(
            "map_interpolation",
            f"{name!r} is not known",
            f"use one of {', '.join(Interpolation)}",
        )
    return MapGrid(
        size,
        float(getattr(message, "map_grid_pitch", 0.0)),
        Interpolation(name),
        int(getattr(message, "map_grid_size_y", 0)),
    )


def view_of(message: Any, *, repeats: int, grid: bool, angular: bool) -> View:
    """Return the view of a ViewCommand or ViewMeasurement."""
    return View(
        str(message.view_name),
        float(message.rotation),
        (float(message.translation_x), float(message.translation_y)),
        grid=grid,
        angular=angular,
        repeats=repeats,
        visit_order=_order_of(message),
        check_marks=int(getattr(message, "check_marks", 0)),
        check_offset_m=float(getattr(message, "check_offset", 0.0)),
        image=_image_of(message),
        cell=cell_of(message),
    )


def _image_of(message: Any) -> ImageCells | None:
    """Return the marks that an image shows; None where it is one, as in old bags."""
    nx, ny = (int(getattr(message, name, 0)) for name in ("image_nx", "image_ny"))
    if max(nx, ny) < 2:
        return None
    image = ImageCells(nx, ny, float(message.image_pitch) or float(message.grid_pitch))
    image.steps(artifact_of(message))
    return image


def cell_of(message: Any) -> tuple[int, int] | None:
    """Return the cell of a ViewMeasurement; None without images, and for a ViewCommand."""
    if not hasattr(message, "image_x") or _image_of(message) is None:
        return None
    return int(message.image_x), int(message.image_y)


def _order_of(message: Any) -> str:
    """Return the visiting order of a message; empty (chosen by the cell) if unknown."""
    try:
        text = str(getattr(message, "visit_order", ""))
        return str(parse_order(text)) if text else ""
    except InputError:
        return ""


def view_readings(message: Any) -> ViewReadings:
    """Return the readings in a selfcal_msgs/ViewMeasurement.

    Raises
    ------
    InputError
        If arrays that belong together differ in length (`u` and `u_theta` may be empty), or the
        plan has an unknown key.
    """
    refuse_unknown_keys(message, f"{MEASUREMENT_TOPIC} of '{message.view_name}'")
    table: dict[str, Any] = {
        name: np.array(getattr(message, name), dtype=kind) for name, kind in COLUMNS
    }
    for *names, u in (
        ("m", "n", "dx", "dy", "count", "u"),
        ("k", "dtheta", "count_theta", "u_theta"),
    ):
        names += [u] * (len(table[u]) > 0)
        if len({len(table[name]) for name in names}) > 1:
            raise _bad_measurement(message, f"{', '.join(names)} differ in length")
    return ViewReadings(
        view_of(
            message,
            repeats=int(message.repeats),
            grid=bool(message.grid),
            angular=bool(message.angular),
        ),
        **table,
        sigma_xy=float(message.sigma_xy),
        sigma_theta=float(message.sigma_theta),
        dof_xy=int(message.dof_xy),
        dof_theta=int(message.dof_theta),
        used=int(message.detections_used),
        rejected=counts(message, "reject"),
        visits=_visits_of(message),
        places=_places_of(message),
        motion=_motion_of(message, "motion", 4),
        motion_theta=_motion_of(message, "motion_theta", 2),
        axis_theta=float(message.axis_theta),
    )


def _bad_measurement(message: Any, what: str) -> InputError:
    """Return the error of a ViewMeasurement that its publisher has to correct."""
    return InputError(
        f"{MEASUREMENT_TOPIC} of '{message.view_name}'", what, "correct the publisher"
    )


def _motion_of(message: Any, name: str, size: int) -> RepeatMotion | None:
    """Return the sums over repeats in a ViewMeasurement; None if it has none."""
    products = np.array(getattr(message, name, ()), dtype=float)
    if not len(products):
        return None
    if len(products) != size**2:
        raise _bad_measurement(
            message, f"{name} has {len(products)} values, not {size**2}"
        )
    return RepeatMotion(
        products.reshape(size, size), int(getattr(message, f"dof_{name}"))
    )


def _visits_of(message: Any) -> GridVisits | None:
    """Return the visits in a ViewMeasurement; None if it has none."""
    if not len(getattr(message, "visit_mark", ())):
        return None
    table = {
        name: np.array(
            getattr(message, f"visit_{name.removesuffix('_ns')}"), dtype=kind
        )
        for name, kind in VISIT_COLUMNS
    }
    lengths = {
        len(column) for name, column in table.items() if name != "u" or len(column)
    }
    if (
        len(lengths) > 1
        or table["mark"].min() < 0
        or table["mark"].max() >= len(message.m)
    ):
        raise _bad_measurement(
            message, "the visits differ in length or name marks that were not read"
        )
    return GridVisits(
        **table, sigma_m=float(message.sigma_visit), dof=int(message.dof_visit)
    )


def _places_of(message: Any) -> RejectedPlaces:
    """Return the positions of rejected detections in a ViewMeasurement."""
    number, x, y = (
        np.array(getattr(message, f"rejected_{name}"), dtype=kind)
        for name, kind in (("reason", int), ("x", float), ("y", float))
    )
    reasons = list(map(str, message.reject_reasons))
    if not len(number) == len(x) == len(y) or (number >= len(reasons)).any():
        raise _bad_measurement(
            message, "the rejected detections differ in length or name no reason"
        )
    return RejectedPlaces(tuple(reasons[index] for index in number), x, y)


def counts(message: Any, prefix: str) -> dict[str, int]:
    """Return reason -> count from a pair of arrays; InputError if they differ in length."""
    reasons, numbers = (
        getattr(message, f"{prefix}_{name}") for name in ("reasons", "counts")
    )
    if len(reasons) != len(numbers):
        raise _bad_measurement(
            message, f"{prefix}_reasons and {prefix}_counts differ in length"
        )
    return {
        str(reason): int(number)
        for reason, number in zip(reasons, numbers, strict=True)
    }


def sense_of(message: Any) -> Sense:
    """Return the sense of measurement of a ViewMeasurement; InputError if unknown."""
    try:
        return Sense(message.measurement_sense or Sense.MICROSCOPE_MOVES)
    except ValueError as error:
        raise InputError(
            f"{MEASUREMENT_TOPIC} of '{message.view_name}'",
            f"measurement_sense {message.measurement_sense!r} is not known",
            f"use one of {', '.join(Sense)}",
        ) from error


def error_map(message: Any) -> ErrorMap:
    """Return the map in a selfcal_msgs/ErrorMap.

    Raises
    ------
    InputError
        If an array does not have one value per site or line, an error that is stated as known is
        not finite, no error is known, or the datum is unknown.
    """
    artifact = artifact_of(message)
    sites = math.prod(artifact.shape)
    lines = artifact.angular_count
    for name, size in (
        ("gx", sites),
        ("gy", sites),
        ("u_gx", sites),
        ("u_gy", sites),
        ("valid", sites),
        ("g_theta", lines),
        ("u_g_theta", lines),
    ):
        if len(getattr(message, name)) != size:
            raise InputError(
                ERROR_MAP_TOPIC,
                f"{name} has {len(getattr(message, name))} values, the plate {size}",
                "correct the publisher",
            )
    if message.datum_theta not in list(ThetaDatum):
        raise InputError(
            ERROR_MAP_TOPIC,
            f"datum_theta {message.datum_theta!r} is not known",
            f"use one of {', '.join(ThetaDatum)}",
        )
    grids = {
        name: np.array(getattr(message, name), dtype=float).reshape(artifact.shape)
        for name in ("gx", "gy", "u_gx", "u_gy")
    }
    valid = np.array(message.valid, dtype=bool).reshape(artifact.shape)
    g_theta, u_g_theta = (
        np.array(getattr(message, name), dtype=float)
        for name in ("g_theta", "u_g_theta")
    )
    _refuse_not_finite(grids, valid, g_theta, u_g_theta)
    for values in grids.values():
        values[~valid] = np.nan
    return ErrorMap(
        artifact,
        **grids,
        g_theta=g_theta,
        u_g_theta=u_g_theta,
        nonorthogonality=float(message.nonorthogonality),
        scale_difference=float(message.scale_difference),
        datum_theta=ThetaDatum(message.datum_theta),
    )


def _refuse_not_finite(
    grids: dict[str, np.ndarray],
    valid: np.ndarray,
    g_theta: np.ndarray,
    u_g_theta: np.ndarray,
) -> None:
    """Refuse a map that is not finite where it is said to be known, or known nowhere."""
    for name in ("gx", "gy"):
        bad = int((~np.isfinite(grids[name][valid])).sum())
        if bad:
            raise InputError(
                ERROR_MAP_TOPIC,
                f"{name} is not finite at {bad} of the {int(valid.sum())} valid sites",
                "correct the publisher",
            )
    for name, u in {**grids, "u_g_theta": u_g_theta}.items():
        if name.startswith("u_") and (u < 0).any():
            raise InputError(
                ERROR_MAP_TOPIC, f"{name} is negative", "correct the publisher"
            )
    if np.isinf(g_theta).any():
        raise InputError(
            ERROR_MAP_TOPIC, "g_theta is infinite", "correct the publisher"
        )
    if not valid.any() or (len(g_theta) and np.isnan(g_theta).all()):
        raise InputError(
            ERROR_MAP_TOPIC,
            "the error of no site or of no line is known",
            "measure, or correct the publisher",
        )


class PositionEditor:
    """Read and replace the positions of sensor_msgs/JointState one by one, within their bytes.

    A message of a known layout takes 2 us, compared with 90 as columns of one.
    """

    def __init__(self) -> None:
        self._known: deque[_Positions] = deque(maxlen=cdr.MAX_KNOWN)

    def read(self, data: bytes) -> tuple[tuple[str, ...], tuple[float, ...]] | None:
        """Return names and positions; None if the message is damaged or too long."""
        if not self._find(data):
            return None
        layout = self._known[0]
        return layout.names, layout.form.unpack_from(data, layout.at)

    @property
    def frame_id(self) -> str:
        """The frame in the header of the last message read."""
        return self._known[0].frame_id

    def replaced(self, data: bytes, positions: Sequence[float]) -> bytes:
        """Return the last message read with other positions."""
        layout = self._known[0]
        end = layout.at + layout.form.size
        return data[: layout.at] + layout.form.pack(*positions) + data[end:]

    def _find(self, data: bytes) -> bool:
        """Move the layout of a message to the front; return whether it has one."""
        for number, known_layout in enumerate(self._known):
            if (
                len(data) == known_layout.length
                and int.from_bytes(data) & known_layout.mask == known_layout.value
            ):
                self._known.rotate(-number)
                return True
        layout = (
            cdr.layout_of(JOINT_STATE, data) if len(data) <= cdr.MAX_LENGTH else None
        )
        if layout is None:
            return False
        code, offset, count = layout.values["position"]
        mask = int.from_bytes(layout.fixed)
        self._known.appendleft(
            _Positions(
                length=len(data),
                mask=mask,
                value=int.from_bytes(data) & mask,
                names=layout.texts["name"],
                frame_id=layout.texts["header.frame_id"][0],
                form=Struct(f"{code[0]}{count}d"),
                at=offset,
            )
        )
        return True


class _Positions(NamedTuple):
    """Offsets of the positions in messages of one layout, and the bits that identify it."""

    length: int
    mask: int
    value: int
    names: tuple[str, ...]
    frame_id: str
    form: Struct
    at: int


def stamps_ns(group: cdr.Columns) -> np.ndarray:
    """Return the stamps in the headers of messages, integer ns."""
    seconds = group["header.stamp.sec"].astype(np.int64)
    return seconds * NS_PER_S + group["header.stamp.nanosec"]


def first_stamps_ns(messages: cdr.Payloads) -> tuple[np.ndarray, np.ndarray]:
    """Return the stamps of messages that begin with a header, if long enough for one.

    Returns
    -------
    stamps_ns : int64 array (k,)
        Stamps, ns.
    has_header : bool array (n,)
        Which of the messages have one.
    """
    has_header = messages.length >= STAMP_END
    octets = np.frombuffer(messages.data, np.uint8)[
        messages.start[has_header][:, None] + np.arange(STAMP_END)
    ]
    words = octets[:, 4:].copy()
    little, big = (
        words.view(np.dtype([("sec", f"{order}i4"), ("nanosec", f"{order}u4")]))[:, 0]
        for order in "<>"
    )
    is_little = octets[:, 1] & 1 == 1
    second = np.where(is_little, little["sec"], big["sec"]).astype(np.int64)
    return second * NS_PER_S + np.where(
        is_little, little["nanosec"], big["nanosec"]
    ), has_header


def frame_id(message: bytes) -> str:
    """Return the frame_id of a message that begins with a header; "" if it is damaged."""
    begin = STAMP_END + 4
    is_little = message[:2] == cdr.LITTLE
    n_bytes = int.from_bytes(message[STAMP_END:begin], "little" if is_little else "big")
    return message[begin : begin + n_bytes].rstrip(b"\0").decode(errors="replace")


def encoder_block(group: cdr.Columns) -> EncoderBlock:
    """Return the samples in messages of sensor_msgs/JointState."""
    velocities = group["velocity"] if "velocity" in group else np.zeros((len(group), 0))
    return EncoderBlock(
        stamps_ns(group),
        group.layout.texts["name"],
        group["position"],
        velocities if velocities.shape[1] else None,
    )


def detection_table(group: cdr.Columns) -> np.ndarray:
    """Return messages of selfcal_msgs/MarkDetection as a table of `collection.inputs.DETECTION`."""
    table = np.empty(len(group), dtype=DETECTION)
    table["stamp"] = stamps_ns(group)
    for name in DETECTED:
        table[name] = group[name]
    return table
