# SPDX-License-Identifier: Apache-2.0
"""A first look at a cell: what it sees, and what a few small moves tell of camera and stage."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from selfcal_ros.collection.inputs import EncoderSample
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.machine.cell import Cell
from selfcal_ros.machine.clock import Clock
from selfcal_ros.machine.interface import Image, Machine, MachineError
from selfcal_ros.machine.visiting import Visitor
from selfcal_ros.model.readings import Sense
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.units import NS_PER_S
from selfcal_ros.vision.camera_pose import CameraPose, camera_pose, require_size
from selfcal_ros.vision.detector import (
    LARGEST_SIZE,
    SMALLEST_SIZE,
    Judged,
    MarkDetector,
    rejected_text,
    told_apart,
)
from selfcal_ros.vision.images import Picture
from selfcal_ros.vision.shown import spots_in

PATTERN = (
    (0, 0),
    (1, 0),
    (1, 1),
    (0, 1),
    (-1, 1),
    (-1, 0),
    (-1, -1),
    (0, -1),
    (1, -1),
    (0, 0),
)
"""Places of the stage for the camera, in steps."""
SIZE_STEP = 1.3
"""Ratio of the sizes in pixels that are tried for a mark of unknown size."""
APPROACHES = 4
"""Approaches from either side for the backlash."""
SETTLING = 12
"""Exposures after a move that show how the stage settles."""
SIGMAS = 3.0
"""Standard deviations from which a difference is said to be one."""
LARGE_REVERSAL_M = 1e-6
"""Backlash that is pointed out."""


@dataclass(frozen=True)
class FoundValue:
    """A value found, and its standard uncertainty; SI, angles of the camera in degrees."""

    value: float
    u: float


@dataclass(frozen=True)
class Findings:
    """What a cell shows.

    Attributes
    ----------
    camera : CameraPose or None
        None for a machine without images.
    reversal : dict
        Axis -> indicated minus true position after a motion in + direction, less that after one
        in - direction, m.
    settling_s : float
        Time after a move from which the marks stand still; 0 = from the first exposure on.
    noise_m : float
        Standard deviation of the place of a mark from exposure to exposure.
    notes : tuple of str
        What is implausible, or has to be decided by a person.
    """

    camera: CameraPose | None
    reversal: dict[str, FoundValue]
    settling_s: float
    noise_m: float
    notes: tuple[str, ...] = ()


@dataclass
class Trial:
    """The first look at a cell.

    Parameters
    ----------
    cell, machine
        The cell.
    clock : Clock, optional
        Stamps and waits.
    mark_pixels : float
        Size of a mark in the image; 0 = from the pixel size of the cell, or searched for.

    Attributes
    ----------
    seen : array (h, w) or None
        The image of `look`, also if it shows no mark.
    judged : list of Judged
        The possible marks in it.
    """

    cell: Cell
    machine: Machine
    clock: Clock = field(default_factory=Clock)
    mark_pixels: float = 0.0
    seen: np.ndarray | None = field(default=None, init=False)
    judged: list[Judged] = field(default_factory=list, init=False)

    def look(self) -> tuple[np.ndarray | None, list[tuple[float, float]]]:
        """Return an image and the columns and rows of its marks; without a camera their offsets, m.

        Nothing moves.

        Raises
        ------
        NoDataError
            If nothing is seen.
        MachineError
            If the image cannot be used.
        """
        visitor = Visitor(self.machine, self.cell, self.clock)
        self.position = visitor.sample()
        image_or_offsets = visitor.show()
        if not isinstance(image_or_offsets, Image):
            self._visitor = visitor
            offsets = [
                (item.x, item.y) for item in image_or_offsets if item.theta is None
            ]
            if not offsets:
                raise NoDataError(
                    "machine.offsets", "no mark is seen", "move to a mark first"
                )
            return None, offsets
        settings = self.cell.detector
        if settings is None or not settings.mark_size:
            raise InputError(
                f"{self.cell.path}: detector",
                "the size of the marks is not stated",
                "give detector: {mark: disc, mark_size: ...}, in m",
            )
        picture = visitor.eye.trusted(image_or_offsets, self.position.positions)
        self.seen = picture.values
        self.mark_pixels, self.judged = self._sized(picture, settings)
        marks, rejected = told_apart(self.judged)
        if not marks:
            spots = spots_in(picture.values)
            what = (
                "nothing repeats in it"
                if spots is None
                else f"what repeats is {spots.side_px:.3g} px, {spots.polarity}"
            )
            raise NoDataError(
                "machine.image",
                f"no mark is found in the image{rejected_text(rejected)}; {what}",
                "move to a mark, focus; check mark, polarity and mark_size in CELL.yaml, or give "
                "--mark-pixels",
            )
        size = self.mark_pixels
        in_pixels = replace(
            settings,
            pixel_size=1.0,
            mark_size=size,
            turn=0.0,
            mirror=False,
            mark_width=settings.mark_width * size / settings.mark_size,
        )
        # offsets are pixels in it: those that matter here are those of the stage
        self._visitor = Visitor(
            self.machine, replace(self.cell, detector=in_pixels), self.clock
        )
        return picture.values, [(mark.u, mark.v) for mark in marks]

    def _sized(
        self, picture: Picture, settings: DetectorSettings
    ) -> tuple[float, list[Judged]]:
        """Return the size of a mark, px, and the possible marks of that size."""
        known_size_px = self.mark_pixels or (
            settings.mark_size / settings.pixel_size if settings.pixel_size else 0
        )
        best: tuple[float, float, list[Judged]] = (0.0, known_size_px, [])
        for size in [known_size_px] if known_size_px else _sizes(picture.values.shape):
            width = settings.mark_width * size / settings.mark_size
            detector = MarkDetector(
                replace(settings, pixel_size=1.0, mark_size=size, mark_width=width),
                str(self.cell.path),
            )
            judged = detector.judged(picture)
            marks, _ = told_apart(judged)
            if not marks and known_size_px:
                return size, judged
            score = sum(mark.score for mark in marks) * size
            if score > best[0]:
                fitted = [mark.fit.shape.get("size", size) for mark in marks]
                best = (score, float(np.median(fitted)), judged)
        return best[1], best[2]

    @property
    def step_m(self) -> float:
        """Largest move along an axis, m."""
        return self.cell.first_step_m

    def move(self) -> Findings:
        """Make small moves around the present position; return what they show.

        Raises
        ------
        MachineError
            If position or marks do not follow; the machine was stopped.
        InputError
            If the images contradict the moves.
        """
        with self._visitor.stopping():
            return self._move_findings()

    def _move_findings(self) -> Findings:
        visitor = self._visitor
        visitor.first_move(marks=False, step_m=self.step_m)
        start = visitor.sample()
        self._home = start.by_joint
        has_image = self.seen is not None
        self._per_pixel: Callable[[np.ndarray], np.ndarray] = lambda offset: offset
        camera = self._camera() if has_image else None
        if camera is not None:
            self._per_pixel = _to_metres(camera)
        else:
            visitor.first_move(marks=True)
        reversal = {axis: self._reversal(axis) for axis in ("x", "y")}
        settling_s, noise_m = self._settling()
        self._go(0.0, 0.0)
        notes = [*_notes(camera, reversal), *self._notes_of_sense()]
        return Findings(camera, reversal, settling_s, noise_m, tuple(notes))

    def _go(self, x: float, y: float) -> EncoderSample:
        return self._visitor.go({"x": self._home["x"] + x, "y": self._home["y"] + y})

    def _marks(self) -> np.ndarray:
        """Return offsets of the marks seen now, (k, 2): px with a camera, else m."""
        detections = self._visitor.marks()
        if not detections:
            raise NoDataError(
                "machine",
                "no mark is seen after a small move",
                "begin with a mark near the middle of the image",
            )
        return np.array([(item.offset_x, item.offset_y) for item in detections])

    def _camera(self) -> CameraPose:
        """Return the camera from places around the present one."""
        positions: list[tuple[float, ...]] = []
        images: list[np.ndarray] = []
        again: list[np.ndarray] = []
        for across, up in PATTERN:
            # no backlash in it
            self._go((across - 0.5) * self.step_m, (up - 0.5) * self.step_m)
            at = self._go(across * self.step_m, up * self.step_m)
            positions.append(at.positions[:2])
            images.append(self._marks())
            if len(again) < 2:
                again.append(self._marks())
        late = np.hypot(*(_nearest(images[1]) - _nearest(images[0])))
        fresh = np.hypot(*(_nearest(again[1]) - _nearest(images[1])))
        if fresh > 0.5 * self.mark_pixels and late < 0.1 * self.mark_pixels:
            raise MachineError(
                "the image is late by one frame",
                "machine.image",
                "let the camera expose when it is asked (software trigger), or drop a frame",
            )
        pose = camera_pose(np.array(positions), images, self.cell.sense)
        assert self.cell.detector is not None
        require_size(
            pose,
            mark_size_m=self.cell.detector.mark_size,
            mark_pixels=self.mark_pixels,
            where=str(self.cell.path),
        )
        return pose

    def _true(self, axis: str, at: EncoderSample) -> float:
        """Return the place of the mark nearest to the axis as position and image tell it, m."""
        number = 0 if axis == "x" else 1
        offset = self._per_pixel(_nearest(self._marks()))[number]
        position = at.positions[number]
        return (
            offset - position
            if self.cell.sense is Sense.PLATE_MOVES
            else offset + position
        )

    def _reversal(self, axis: str) -> FoundValue:
        """Return how much an approach in + direction differs from one in - direction, m."""
        number = ("x", "y").index(axis)
        places_m = np.zeros((2, APPROACHES))
        for repeat in range(APPROACHES):
            for side, sign in enumerate((-1, 1)):  # from below, from above
                away = [0.0, 0.0]
                away[number] = sign * self.step_m
                self._go(*away)
                places_m[side, repeat] = self._true(axis, self._go(0.0, 0.0))
        # a mark seems to lie where the stage indicates too much
        difference = places_m[0].mean() - places_m[1].mean()
        sign = -1 if self.cell.sense is Sense.PLATE_MOVES else 1
        u = math.sqrt(places_m.var(axis=1, ddof=1).sum() / APPROACHES)
        return FoundValue(float(sign * difference), float(u))

    def _settling(self) -> tuple[float, float]:
        """Return the time from which a mark stands still after a move, s, and its noise, m."""
        self._go(-self.step_m, -self.step_m)
        arrival = self._go(0.0, 0.0)
        ended_ns = arrival.stamp_ns
        places, times = [], []
        for _ in range(SETTLING):
            places.append(self._per_pixel(_nearest(self._marks())))
            times.append((self.clock.now_ns() - ended_ns) / NS_PER_S)
        place = np.array(places)
        last = place[SETTLING // 2 :]
        noise = float(np.sqrt(last.var(axis=0, ddof=1).mean()))
        away = np.hypot(*(place - last.mean(axis=0)).T)
        moving = np.flatnonzero(away > max(2 * SIGMAS * noise, 1e-9))
        if not len(moving):
            return 0.0, noise
        return times[
            min(int(moving[-1]) + 1, SETTLING - 1)
        ] + self.cell.settle.time, noise

    def _notes_of_sense(self) -> Iterator[str]:
        moving = (
            "the plate under a resting camera"
            if self.cell.sense is Sense.PLATE_MOVES
            else "the camera over a resting plate"
        )
        yield (
            f"sense: {self.cell.sense} as stated: the stage moves {moving}; no image shows "
            "which, and the other sense turns the image by 180 degrees"
        )


def _sizes(shape: tuple[int, ...]) -> Iterator[float]:
    """Yield sizes of marks to be tried, px."""
    size = SMALLEST_SIZE * SIZE_STEP
    while size < min(min(shape) / 1.5, LARGEST_SIZE):
        yield size
        size *= SIZE_STEP


def _nearest(marks: np.ndarray) -> np.ndarray:
    return np.asarray(marks[np.argmin(np.hypot(*marks.T))])


def _to_metres(camera: CameraPose) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function from pixels right and up to an offset in stage axes, m."""
    cosine, sine = math.cos(camera.turn_rad), math.sin(camera.turn_rad)
    turned = camera.pixel_size_m * np.array([[cosine, -sine], [sine, cosine]])
    if camera.mirror:
        turned = turned @ np.diag([-1.0, 1.0])
    return lambda offset: turned @ offset


def _notes(camera: CameraPose | None, reversal: dict[str, FoundValue]) -> Iterator[str]:
    """Yield what is implausible."""
    if camera is not None and camera.mirror:
        yield (
            "the image is mirrored: either the camera mirrors, or an axis counts backwards; if "
            "it is an axis, correct it first"
        )
    if camera is not None and camera.sheared > max(SIGMAS * camera.u_sheared, 0.005):
        yield (
            f"the axes of the stage are unequal or not square by {camera.sheared:.2g}, or the "
            "pixels are not square"
        )
    for axis, backlash in reversal.items():
        if abs(backlash.value) > max(SIGMAS * backlash.u, LARGE_REVERSAL_M):
            yield (
                f"{axis} has a backlash: approach marks from one side, or let the model have the "
                "term approach; the map holds for one side only"
            )


def values_of(findings: Findings) -> tuple[dict[str, object], dict[str, str]]:
    """Return the values for the section detector of CELL.yaml, and their comments."""
    camera = findings.camera
    if camera is None:
        return {}, {}
    turn = math.degrees(camera.turn_rad)
    u_turn = math.degrees(camera.u_turn_rad)
    return (
        {"pixel_size": camera.pixel_size_m, "turn": turn, "mirror": camera.mirror},
        {
            "pixel_size": f"u {camera.u_pixel_size_m:.2g} m",
            "turn": f"u {u_turn:.2g} degrees",
        },
    )
