# SPDX-License-Identifier: Apache-2.0
"""The one fault of a cell that explains its rejections: what would be used if it were not there.

Each possible fault is undone in the recorded messages, which are collected again.
"""

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from math import degrees, isfinite, nan, pi, radians
from typing import NamedTuple

import numpy as np

from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.diagnosis import fault_text
from selfcal_ros.collection.inputs import (
    Command,
    Detection,
    EncoderBlock,
    EncoderSample,
    Kind,
)
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.checks.wiring import wiring_faults
from selfcal_ros.model.artifact import MAX_GRID_SIZE, Artifact
from selfcal_ros.model.readings import RepeatMotion, Sense
from selfcal_ros.model.view import View
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.units import MM_PER_M

AT_ONE_PLACE_M = 1e-4
"""Way that is none: the stops beside a mark."""
STILL = 0.25
"""Part of the pitch within which a stage has not moved."""
FOLLOWS = 0.9
"""Fraction of the variance of an offset that must follow the stage for a valid slope."""
SAME_SCALE, SAME_UNIT = 0.01, 0.1
"""Parts by which an axis may be indicated too long: of its length, and of a unit."""
NEAR_FACTOR = 4.0
"""Factor by which the response of an offset to the stage may differ from -1: a wrong unit makes at
least 10, a turn or a wrong size of a pixel less."""


@dataclass(frozen=True)
class Recorded:
    """The messages of a view: its MEASURE, samples of the encoder, and detections."""

    command: Command
    samples: Sequence[EncoderSample]
    detections: Sequence[Detection]

    @property
    def view(self) -> View:
        """The view, as it was commanded."""
        return self.command.placed()

    @property
    def plate(self) -> Artifact:
        """Its plate."""
        return self.command.plate()


@dataclass(frozen=True)
class Fault:
    """A fault and its remedy."""

    what: str
    remedy: str


type Tried = Iterator[tuple[Fault, Recorded]]
"""Faults, each with the messages as they would be without it."""


def explaining(recorded: Recorded, settings: CollectorSettings) -> Fault | None:
    """Return the fault without which most of the rejected detections would be used, if any.

    Of several, one whose offsets then follow the stage; all of them if nothing tells them apart.

    Parameters
    ----------
    recorded : Recorded
        All messages of the view.
    settings : CollectorSettings
        Names of the joints, sense, limits.
    """
    standing = _standing(recorded, settings)
    if standing is not None:
        return standing
    as_recorded = _worth(recorded, settings)
    faults: list[Fault] = []
    best = Worth((as_recorded.used + len(recorded.detections)) / 2, -np.inf, 0, 0)
    for fault, mended in _faults(recorded, settings):
        try:
            worth = _worth(mended, settings)
        except InputError:  # an even and an odd side do not lie so
            continue
        # without ids, positions in mm are all those of one mark
        if worth.seen < as_recorded.seen:
            continue
        # any offset is small enough in another unit
        if not worth.following:
            continue
        if worth > best:
            faults = []
            best = worth
        if worth == best:
            faults.append(fault)
    if not faults:
        return None
    return Fault(
        ", or ".join(dict.fromkeys(fault.what for fault in faults)),
        "; or ".join(dict.fromkeys(fault.remedy for fault in faults)),
    )


class Worth(NamedTuple):
    """What messages are worth, the more the better.

    Attributes
    ----------
    used : float
        Detections that would be used.
    faults : float
        Minus the faults of the offsets.
    following : int
        Of x and y, how many offsets follow the stage; 2 if no check stops show it.
    seen : int
        Marks and lines seen.
    """

    used: float
    faults: float
    following: int
    seen: int


def _worth(recorded: Recorded, settings: CollectorSettings) -> Worth:
    """Return what messages are worth."""
    collector = Collector(settings)
    collector.add_command(recorded.command)
    for _, alike in groupby(
        recorded.samples,
        key=lambda sample: (
            sample.names,
            len(sample.positions),
            len(sample.velocities),
        ),
    ):
        collector.add_encoder_block(EncoderBlock.of([*alike]))
    for detection in recorded.detections:
        collector.add_detection(detection)
    measurements, progress = collector.collect()
    views = measurements.views
    slopes = [slope_of(view.motion, axis) for view in views for axis in (0, 1)]
    following = sum(
        slope is not None and 1 / NEAR_FACTOR < -slope < NEAR_FACTOR for slope in slopes
    )
    has_stops = any(view.check_done for view in progress.values())
    return Worth(
        used=sum(view.used for view in views),
        faults=-len(wiring_faults(measurements)),
        following=following if has_stops else 2,
        seen=sum(len(view.m) + len(view.k) for view in views),
    )


def slope_of(motion: RepeatMotion | None, axis: int) -> float | None:
    """Return the response of an offset to its axis; None if mostly noise."""
    if motion is None:
        return None
    n = len(motion.products) // 2
    place, offset, cross = (
        float(motion.products[index])
        for index in ((axis, axis), (n + axis, n + axis), (axis, n + axis))
    )
    return cross / place if cross**2 > FOLLOWS * place * offset else None


def _standing(recorded: Recorded, settings: CollectorSettings) -> Fault | None:
    """Return the fault of a stage that is indicated at one place, or turn, during the view."""
    plate = recorded.plate
    indicated = [_place(sample, settings) for sample in recorded.samples]
    places = np.array([place for place in indicated if place is not None])
    if not len(places):
        return None
    ways_m = np.ptp(places, axis=0).tolist()
    if max(ways_m) <= STILL * plate.grid_pitch_m:
        x, y = np.median(places, axis=0) * MM_PER_M
        return Fault(
            f"the stage moves by {max(ways_m) * MM_PER_M:.3g} mm alone during the whole view"
            if max(ways_m) > AT_ONE_PLACE_M
            else f"the stage does not move: it is indicated at x = {x:.6g} mm, "
            f"y = {y:.6g} mm during the whole view",
            "move the stage to each mark, name the joints that move in joint_x and joint_y, "
            "and publish them in m",
        )
    for axis, way_m in zip("xy", ways_m, strict=True):
        if way_m <= STILL * plate.grid_pitch_m:
            return Fault(
                f"{axis} does not move: it is indicated within {way_m * MM_PER_M:.3g} mm during "
                "the whole view",
                f"move the stage to each mark, and name the joint that moves in joint_{axis}",
            )
    named = {(mark.m, mark.n) for mark in _marks(recorded)}
    if len(named) == 1 and _way_seen_m(recorded, settings) > STILL * plate.grid_pitch_m:
        m, n = named.pop()
        return Fault(
            f"all marks are called ({m}, {n})",
            "publish m and n of the mark that is seen, or leave ids out (has_id)",
        )
    lines = {detection.k for detection in _lines(recorded)}
    _, turns = _turns(recorded.samples, settings)
    if (
        len(lines) > 1
        and len(turns)
        and np.ptp(turns) <= STILL * 2 * pi / plate.angular_count
    ):
        return Fault(
            f"theta does not move: it is indicated at {np.median(turns):.6g} rad during "
            "the whole view",
            "turn the stage to each line, and name the joint that turns in joint_theta",
        )
    return None


def _place(
    sample: EncoderSample, settings: CollectorSettings
) -> tuple[float, float] | None:
    """Return the indicated x and y of a sample that has both, as numbers."""
    where = sample.by_joint
    x, y = (where.get(joint, nan) for joint in (settings.joint_x, settings.joint_y))
    return (x, y) if isfinite(x) and isfinite(y) else None


def _way_seen_m(recorded: Recorded, settings: CollectorSettings) -> float:
    """Return how far apart the stage is indicated where marks are seen; one alone: 0."""
    indicated = [_place(sample, settings) for sample in recorded.samples]
    stamps = [sample.stamp_ns for sample in recorded.samples]
    seen_at = [
        indicated[min(bisect_left(stamps, mark.stamp_ns), len(stamps) - 1)]
        for mark in _marks(recorded)
    ]
    places = np.array([place for place in seen_at if place is not None])
    return float(np.ptp(places, axis=0).max()) if len(places) else 0.0


def _marks(recorded: Recorded) -> list[Detection]:
    """Return the detections that name a grid mark."""
    return [
        detection
        for detection in recorded.detections
        if detection.kind == Kind.GRID and detection.has_id
    ]


def _lines(recorded: Recorded) -> list[Detection]:
    """Return the detections that name an angular line."""
    return [
        detection
        for detection in recorded.detections
        if detection.kind == Kind.ANGULAR and detection.has_id
    ]


def _faults(recorded: Recorded, settings: CollectorSettings) -> Tried:
    """Yield the faults that are tried."""
    yield from _counts(recorded)
    yield from _origins(recorded, settings)
    yield from _counts_of_lines(recorded, settings)
    yield (
        Fault(
            "m and n are exchanged",
            "m counts the marks along plate x, n along plate y",
        ),
        _with_marks(recorded, [(mark.n, mark.m) for mark in recorded.detections]),
    )
    yield from _offsets(recorded, settings)
    yield from _stamps(recorded)
    yield from _positions(recorded, settings)
    yield from _placings(recorded)


def _with_marks(recorded: Recorded, ids: Sequence[tuple[int, int]]) -> Recorded:
    """Return the messages with other m and n of the detections."""
    return replace(
        recorded,
        detections=[
            replace(detection, m=m, n=n)
            for detection, (m, n) in zip(recorded.detections, ids, strict=True)
        ],
    )


def _counts(recorded: Recorded) -> Tried:
    """Yield that marks are counted in another direction."""
    sizes = recorded.plate.shape
    for signs, what in (
        ((-1, 1), "m is counted against plate x"),
        ((1, -1), "n is counted against plate y"),
        ((-1, -1), "m and n are counted against plate x and y"),
    ):
        even_m, even_n = (
            sign < 0 and size % 2 == 0 for sign, size in zip(signs, sizes, strict=True)
        )
        # an even side is counted from -N/2 to N/2 - 1; without that its signs are reversed alone
        for one in (1, 0) if even_m or even_n else (0,):
            ids = [
                (signs[0] * mark.m - one * even_m, signs[1] * mark.n - one * even_n)
                for mark in recorded.detections
            ]
            yield (
                Fault(what, "m counts the marks along plate x, n along plate y"),
                _with_marks(recorded, ids),
            )


def _origins(recorded: Recorded, settings: CollectorSettings) -> Tried:
    """Yield that marks are counted from another one."""
    m, n = _other_origin(recorded, settings)
    if m or n:
        yield (
            Fault(
                "m and n are counted from another mark: the one in the middle is called "
                f"({m}, {n})",
                "call the mark in the middle of the plate (0, 0): m and n begin at -(N//2)",
            ),
            _with_marks(
                recorded, [(mark.m - m, mark.n - n) for mark in recorded.detections]
            ),
        )


def _counts_of_lines(recorded: Recorded, settings: CollectorSettings) -> Tried:
    """Yield that lines are counted otherwise."""
    lines, count = _lines(recorded), recorded.plate.angular_count
    if not lines or not count:
        return
    yield (
        Fault("the lines are counted clockwise", "count k counter-clockwise"),
        replace(
            recorded,
            detections=[
                replace(detection, k=-detection.k % count)
                for detection in recorded.detections
            ],
        ),
    )
    zero = _other_zero(recorded, settings)
    yield (
        Fault(
            f"theta is indicated {degrees(zero):+.4g}° from where the lines are",
            "count k from the line along plate x, and set theta to 0 where that line is read",
        ),
        _turned(recorded, settings, zero_rad=zero),
    )


def _offsets(recorded: Recorded, settings: CollectorSettings) -> Tried:
    """Yield that offsets are something else."""
    for scale, unit in (
        (1e3, "mm"),
        *((scale, "µm or pixels") for scale in (1e5, 1e6, 1e7)),
    ):
        yield (
            Fault(f"the offsets are in {unit}", "publish offset_x and offset_y in m"),
            replace(
                recorded,
                detections=[
                    replace(
                        mark,
                        offset_x=mark.offset_x / scale,
                        offset_y=mark.offset_y / scale,
                    )
                    for mark in recorded.detections
                ],
            ),
        )
    yield (
        Fault(
            "offset_theta is not the offset of a line in rad",
            "publish offset_theta in rad: line - axis of the stage, counter-clockwise",
        ),
        replace(
            recorded,
            detections=[
                replace(line, offset_theta=0.0) for line in recorded.detections
            ],
        ),
    )
    places = _places_at(recorded.detections, recorded, settings)
    yield (
        Fault(
            "the offsets are places of the marks on the stage",
            "publish mark - optical axis: leave out the position of the stage",
        ),
        replace(
            recorded,
            detections=[
                replace(
                    mark,
                    offset_x=mark.offset_x - place.real,
                    offset_y=mark.offset_y - place.imag,
                )
                for mark, place in zip(recorded.detections, places, strict=True)
            ],
        ),
    )


def _stamps(recorded: Recorded) -> Tried:
    """Yield that detections bear the stamp of another exposure."""
    marks = recorded.detections
    for late in (1, 2):
        exposures = f"{late} exposure{'s' * (late > 1)}"
        for side, more, detections, stamped in (
            ("before", ", and read each image once", marks[late:], marks),
            ("after", "", marks, marks[late:]),
        ):
            yield (
                Fault(
                    f"each detection shows the mark of {exposures} {side} its stamp",
                    f"stamp detections with the time of the exposure{more}",
                ),
                replace(
                    recorded,
                    detections=[
                        replace(mark, stamp_ns=other.stamp_ns)
                        for mark, other in zip(detections, stamped, strict=False)
                    ],
                ),
            )


def _positions(recorded: Recorded, settings: CollectorSettings) -> Tried:
    """Yield that positions are indicated otherwise."""
    turns = list(product((1.0,), (False, True), ((1, 1), (-1, -1), (-1, 1), (1, -1))))
    for scale, swapped, signs in (
        *turns[1:],
        (1e3, False, (1, 1)),
        (1e6, False, (1, 1)),
    ):
        what, _, remedy = fault_text(
            scale, swapped=swapped, signs=signs, sense=Sense(settings.measurement_sense)
        ).partition("; ")
        samples = [
            _sample_at(sample, settings, scale=scale, swapped=swapped, signs=signs)
            for sample in recorded.samples
        ]
        yield Fault(what, remedy), replace(recorded, samples=samples)
    yield from _scales(recorded, settings)
    for what, remedy, factor in (
        ("theta is indicated with the wrong sign", "reverse the sign of theta", -1.0),
        ("theta is indicated in degrees", "publish theta in rad", radians(1.0)),
    ):
        yield Fault(what, remedy), _turned(recorded, settings, factor=factor)


def _scales(recorded: Recorded, settings: CollectorSettings) -> Tried:
    """Yield that axes are indicated too long or too short, by what marks and lines show."""
    sense = Sense(settings.measurement_sense).sign
    marks, lines = _marks(recorded), _lines(recorded)
    view, plate = recorded.view, recorded.plate
    if not plate.marks:
        at = _places_at(marks, recorded, settings)
        m, n = (np.array([getattr(mark, key) for mark in marks]) for key in "mn")
        x, y = plate.places(m, n)
        turned = plate.grid_pitch_m * np.exp(1j * view.rotation_rad)
        sites = sense * turned * (x + 1j * y)
        along = {
            settings.joint_x: _longer(at.real, sites.real),
            settings.joint_y: _longer(at.imag, sites.imag),
        }
        yield from _scaled(recorded, along, "marks", (1e3, 1e6))
    stamps, turns = _turns(recorded.samples, settings)
    if lines and turns:
        theta_rad = np.interp([line.stamp_ns for line in lines], stamps, turns)
        line_rad = 2 * pi * np.array([line.k for line in lines]) / plate.angular_count
        along = {settings.joint_theta: _longer(theta_rad, sense * line_rad)}
        yield from _scaled(recorded, along, "lines", (degrees(1.0),))


def _longer(indicated: np.ndarray, nominal: np.ndarray) -> float:
    """Return how many times as far as nominally positions are indicated from one another."""
    away = nominal - nominal.mean() if len(nominal) else nominal
    return float(away @ indicated / (away @ away)) if away.any() else 1.0


def _scaled(
    recorded: Recorded,
    along: Mapping[str, float],
    of_what: str,
    units: Sequence[float],
) -> Tried:
    """Yield that joints are indicated too long, unless all are in a unit that has its own fault."""
    wrong = {
        joint: factor
        for joint, factor in along.items()
        if factor > 0 and abs(factor - 1) > SAME_SCALE
    }
    has_unit = any(
        all(abs(factor / unit - 1) < SAME_UNIT for factor in along.values())
        for unit in units
    )
    if not wrong or has_unit:
        return
    samples = [
        _indicating(
            sample,
            {
                joint: sample.by_joint.get(joint, nan) / factor
                for joint, factor in wrong.items()
            },
        )
        for sample in recorded.samples
    ]
    what = "; ".join(
        f"{joint} is indicated {factor:.4g} times as far as the {of_what} lie apart"
        for joint, factor in wrong.items()
    )
    yield (
        Fault(what, f"correct unit or scale of {' and '.join(wrong)} (m, rad)"),
        replace(recorded, samples=samples),
    )


def _placings(recorded: Recorded) -> Tried:
    """Yield that the plate lies, or the cell goes, otherwise than commanded."""
    view, pitch_m = recorded.view, recorded.plate.grid_pitch_m
    lies = [
        (f"turned by {deg}°", replace(view, rotation_rad=radians(deg)))
        for deg in (90, 180, 270)
    ]
    lies += [
        (
            f"shifted by {a or b:+d} pitch along {'x' if a else 'y'}",
            replace(view, translation_m=(a * pitch_m, b * pitch_m)),
        )
        for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    for how, other_view in lies:
        yield (
            Fault(
                f"the marks are those of a plate {how}",
                "place the plate as commanded, and measure the view of the command",
            ),
            replace(recorded, command=replace(recorded.command, view=other_view)),
        )


def _other_origin(recorded: Recorded, settings: CollectorSettings) -> tuple[int, int]:
    """Return by how much m and n are usually higher than those of the mark at the axis."""
    view, plate, marks = recorded.view, recorded.plate, _marks(recorded)
    if plate.marks or not marks:
        return 0, 0
    at = _places_at(marks, recorded, settings)
    at = Sense(settings.measurement_sense).sign * at - complex(*view.translation_m)
    at *= np.exp(-1j * view.rotation_rad) / plate.grid_pitch_m
    off_m, off_n = plate.off_centre
    higher = (
        np.median([mark.m for mark in marks] - at.real + off_m),
        np.median([mark.n for mark in marks] - at.imag + off_n),
    )
    if not max(map(abs, higher)) < MAX_GRID_SIZE:  # then the places are wrong
        return 0, 0
    return round(higher[0]), round(higher[1])


def _places_at(
    detections: Sequence[Detection], recorded: Recorded, settings: CollectorSettings
) -> np.ndarray:
    """Return x + i y indicated at each detection, complex array, m; NaN if nothing is indicated."""
    places = [
        (sample.stamp_ns, complex(*place))
        for sample in recorded.samples
        if (place := _place(sample, settings)) is not None
    ]
    if not places:
        return np.full(len(detections), np.nan + 0j)
    stamps, at = zip(*places, strict=True)
    exposed_ns = [detection.stamp_ns for detection in detections]
    return np.interp(exposed_ns, stamps, at)


def _other_zero(recorded: Recorded, settings: CollectorSettings) -> float:
    """Return the mean difference of the indicated theta to that of the lines, rad."""
    stamps, turns = _turns(recorded.samples, settings)
    if not turns:
        return 0.0
    lines = _lines(recorded)
    theta_rad = np.interp([line.stamp_ns for line in lines], stamps, turns)
    line_rad = 2 * pi * np.array([line.k for line in lines])
    sites = recorded.view.rotation_rad + line_rad / recorded.plate.angular_count
    off_rad = theta_rad - Sense(settings.measurement_sense).sign * sites
    return float(np.angle(np.exp(1j * off_rad).mean()))


def _turns(
    samples: Sequence[EncoderSample], settings: CollectorSettings
) -> tuple[list[int], list[float]]:
    """Return stamps, ns, and theta, rad, of the samples that have it."""
    turns = [
        (sample.stamp_ns, theta)
        for sample in samples
        if (theta := sample.by_joint.get(settings.joint_theta)) is not None
    ]
    return [stamp for stamp, _ in turns], [theta for _, theta in turns]


def _turned(
    recorded: Recorded,
    settings: CollectorSettings,
    *,
    factor: float = 1.0,
    zero_rad: float = 0.0,
) -> Recorded:
    """Return the messages with another theta."""
    joint = settings.joint_theta
    samples = [
        _indicating(
            sample, {joint: factor * sample.by_joint.get(joint, nan) - zero_rad}
        )
        for sample in recorded.samples
    ]
    return replace(recorded, samples=samples)


def _sample_at(
    sample: EncoderSample,
    settings: CollectorSettings,
    *,
    scale: float,
    swapped: bool,
    signs: tuple[int, int],
) -> EncoderSample:
    """Return a sample with other x and y."""
    place = _place(sample, settings)
    if place is None:
        return sample
    x, y = place[::-1] if swapped else place
    return _indicating(
        sample,
        {
            settings.joint_x: signs[0] * x / scale,
            settings.joint_y: signs[1] * y / scale,
        },
    )


def _indicating(sample: EncoderSample, at: Mapping[str, float]) -> EncoderSample:
    """Return a sample with other positions of some joints."""
    pairs = zip(sample.names, sample.positions, strict=False)
    positions = tuple(at.get(name, position) for name, position in pairs)
    return replace(sample, positions=positions)
