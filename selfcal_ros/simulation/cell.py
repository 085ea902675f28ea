# SPDX-License-Identifier: Apache-2.0
"""A machine cell with known truth: its settings, exposures and messages during a view.

The stage moves from mark to mark, dwells, and the microscope exposes in the middle of the dwell.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Kind, Phase
from selfcal_ros.errors import InputError
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import Plan, View, parse_order, plan_keys
from selfcal_ros.model.visit_order import (
    VisitSequence,
    approach_signs,
    line_targets,
    stage_targets,
    visit_sequence,
)
from selfcal_ros.simulation import physics
from selfcal_ros.simulation.machine import Truth
from selfcal_ros.units import NS_PER_S

DWELL = 0.6
"""Fraction of an exposure period in which the stage rests."""


@dataclass(frozen=True)
class CellSettings:
    """Settings of the cell: SI units, rates in Hz, periods in s; all sizes standard deviations.

    Attributes
    ----------
    sense : Sense
        What moves.
    sigma_xy_m, sigma_theta_rad : float
        White noise of one exposure.
    noise_ratio : float
        Noise of y over that of x, which is `sigma_xy_m`.
    encoder_rate_hz, exposure_period_s : float
        Encoder samples, and the time from one exposure to the next.
    with_ids, declare_sigma : bool
        Whether detections name their marks, and state their noise.
    servo_sigma_m, servo_sigma_theta_rad : float
        Scatter of the stage about its stop position, exposure by exposure: motion, which the
        encoders indicate.
    encoder_sigma_m, encoder_sigma_theta_rad : float
        Noise of the encoder readings, exposure by exposure, without motion.
    visit_order : str
        Order of the marks if a view does not specify one (`selfcal_ros.model.view`).
    consecutive : bool
        All repeats of a mark consecutively, in one pass; if false, one pass per repeat.
    stop_sigma_m, stop_sigma_theta_rad : float
        Stop error relative to the target, visit by visit.
    follow_mark : bool
        Whether the target is the actual position of the mark, not the nominal one.
    visit_xy_m : float
        Noise shared by all exposures of a visit.
    image_xy_m : float
        Noise shared by all marks of an image.
    flicker_xy_m, flicker_theta_rad : float
        Noise with a spectrum of 1/f over the exposures of a view.
    resolution_xy_m, resolution_theta_rad : float
        Step of the published offsets; 0 = none.

    Raises
    ------
    InputError
        For a dwell too short for encoder samples on both sides of the exposure, or an unknown
        order.
    """

    sense: Sense = Sense.MICROSCOPE_MOVES
    sigma_xy_m: float = 0.0
    sigma_theta_rad: float = 0.0
    noise_ratio: float = 1.0
    encoder_rate_hz: float = 500.0
    exposure_period_s: float = 0.01
    with_ids: bool = True
    declare_sigma: bool = False
    servo_sigma_m: float = 20e-9
    servo_sigma_theta_rad: float = 1e-7
    encoder_sigma_m: float = 0.0
    encoder_sigma_theta_rad: float = 0.0
    visit_order: str = ""
    consecutive: bool = False
    stop_sigma_m: float = 0.0
    stop_sigma_theta_rad: float = 0.0
    follow_mark: bool = False
    visit_xy_m: float = 0.0
    image_xy_m: float = 0.0
    flicker_xy_m: float = 0.0
    flicker_theta_rad: float = 0.0
    resolution_xy_m: float = 0.0
    resolution_theta_rad: float = 0.0

    def __post_init__(self) -> None:
        """Refuse impossible settings."""
        if DWELL * self.exposure_period_s * self.encoder_rate_hz < 2.5:
            raise InputError(
                "simulated cell",
                f"{self.encoder_rate_hz:g} Hz gives fewer than 2.5 encoder samples in "
                f"a dwell of {DWELL * self.exposure_period_s:g} s",
                "raise encoder_rate or exposure_period",
            )
        if self.visit_order:
            parse_order(self.visit_order, "simulated cell: visit_order")

    @property
    def period_ns(self) -> int:
        """Time from one exposure to the next, ns."""
        return round(self.exposure_period_s * NS_PER_S)

    @property
    def dwell_ns(self) -> int:
        """Time at rest in each period, ns; the exposure is in its middle."""
        return round(DWELL * self.period_ns)

    @property
    def exposure_ns(self) -> int:
        """Time from the beginning of a period to its exposure, ns: between two samples."""
        return self.dwell_ns // 2 + 1


@dataclass(frozen=True, eq=False)
class GridExposures:
    """Exposures of grid marks in their order.

    Attributes
    ----------
    visits : VisitSequence
        The visits, V of them.
    visit : int array (E,)
        Index of the visit of each exposure.
    position : float array (2, E)
        Indicated position of the stage, m.
    offset : float array (2, E)
        Offset published by the microscope, m.
    mark : int array (2, V)
        m and n of the mark found there: the visited one if the plate is placed as commanded.
    there : bool array (V,)
        Whether there is a mark.
    approach : int8 array (2, V)
        Sign of the last motion of each stage axis before the visit.
    others : tuple of Seen
        What the other cells of the image show, in their order.
    """

    visits: VisitSequence
    visit: np.ndarray
    position: np.ndarray
    offset: np.ndarray
    mark: np.ndarray
    there: np.ndarray
    approach: np.ndarray
    others: tuple["Seen", ...] = ()


@dataclass(frozen=True, eq=False)
class Seen:
    """What a cell of the images shows: fields as in `GridExposures`, for the mark beside."""

    cell: tuple[int, int]
    offset: np.ndarray
    mark: np.ndarray
    there: np.ndarray


@dataclass(frozen=True, eq=False)
class AngularExposures:
    """Exposures of angular lines in their order, (E,) each.

    Attributes
    ----------
    k, line : int arrays
        The line that the view expects, and the one found there.
    position, offset : float arrays
        Indicated angle, and the published offset, rad.
    """

    k: np.ndarray
    line: np.ndarray
    position: np.ndarray
    offset: np.ndarray


def grid_exposures(
    truth: Truth,
    index: int,
    view: View,
    *,
    settings: CellSettings,
    rng: np.random.Generator,
) -> GridExposures:
    """Return the exposures of the grid marks of view `index`.

    The plate drifts from the first of them to the last. The first one is approached in
    + direction, in x and in y (`lead_in`).
    """
    visits = visit_sequence(
        truth.artifact,
        view,
        order=view.visit_order or settings.visit_order,
        consecutive=settings.consecutive,
        rng=rng,
    )
    visit = np.repeat(np.arange(len(visits)), visits.count)
    size = len(visit)
    m, n, is_mark = physics.marks_below(truth, index, view, (visits.m, visits.n))
    place, _ = physics.mark_places(truth, index, truth.placed_as(index, view), (m, n))
    tau = np.arange(size) / max(size - 1, 1)
    drifted_m = physics.drift(truth, index, tau)
    if settings.follow_mark:
        # the stage continues until the mark is under the microscope
        first_of_visit = np.cumsum(visits.count) - visits.count
        centre = place + drifted_m[:, first_of_visit]
        centre = -centre if settings.sense is Sense.PLATE_MOVES else centre
        target = centre + physics.stage_error(truth, centre, index)
    else:
        target = stage_targets(truth.artifact, view, visits, settings.sense)
    stop = target + normal(rng, settings.stop_sigma_m, target.shape) + visits.aside_m
    came = np.concatenate([lead_in(truth, stop[:, :1]), stop], axis=1)
    approach = np.stack([approach_signs(row, physics.NO_MOTION_M)[1:] for row in came])
    position = stop[:, visit] + normal(rng, settings.servo_sigma_m, (2, size))
    rested = np.arange(size) - np.searchsorted(visit, visit)
    stage = physics.true_position(
        truth,
        index,
        position,
        tau=tau,
        approach=approach[:, visit],
        sign=physics.motion_sign(np.diff(came, axis=1))[:, visit],
        rested_s=rested * settings.exposure_period_s,
    )

    def seen(mark_place: np.ndarray) -> np.ndarray:
        """Return what the microscope sees of a mark at each exposure, (2, size), m."""
        drifted = mark_place[:, visit] + drifted_m
        return physics.offset_seen(truth, settings.sense, position, stage, drifted)

    white = white_noise(rng, settings, size)
    shared = (
        normal(rng, settings.visit_xy_m, (2, len(visits)))[:, visit]
        + _flicker(rng, settings.flicker_xy_m, (2, size))
        + normal(rng, settings.image_xy_m, (2, size))
    )
    offset = quantised(seen(place) + white + shared, settings.resolution_xy_m)
    indicated = position + normal(rng, settings.encoder_sigma_m, (2, size))
    other_cells = []
    for sub in view.sub_views:
        if sub.cell is not None and sub.cell != (0, 0):
            m_beside, n_beside, is_mark_beside = physics.marks_beside(
                truth, index, view, (m, n), sub
            )
            place_beside, _ = physics.mark_places(
                truth, index, truth.placed_as(index, view), (m_beside, n_beside)
            )
            white = white_noise(rng, settings, size)
            other_cells.append(
                Seen(
                    sub.cell,
                    quantised(
                        seen(place_beside) + white + shared, settings.resolution_xy_m
                    ),
                    np.stack([m_beside, n_beside]),
                    is_mark & is_mark_beside,
                )
            )
    return GridExposures(
        visits,
        visit,
        indicated,
        offset=offset,
        mark=np.stack([m, n]),
        there=is_mark,
        approach=approach,
        others=tuple(other_cells),
    )


def white_noise(
    rng: np.random.Generator, settings: CellSettings, size: int
) -> np.ndarray:
    """Return the noise of single marks, (2, E), m."""
    white = normal(rng, settings.sigma_xy_m, (2, size))
    white *= np.array([[1.0], [settings.noise_ratio]])
    return white


def lead_in(truth: Truth, first: np.ndarray) -> np.ndarray:
    """Return the position of an axis before the first grid mark of a view, m."""
    return first - truth.artifact.grid_pitch_m / 2


def angular_exposures(
    truth: Truth,
    index: int,
    view: View,
    *,
    settings: CellSettings,
    rng: np.random.Generator,
) -> AngularExposures:
    """Return the exposures of the angular lines of view `index`, line by line."""
    direction, _, is_line = physics.line_directions(truth, index, view)
    k, target = line_targets(
        truth.artifact, view, settings.sense, consecutive=settings.consecutive
    )
    n_stops = len(direction) if settings.consecutive else len(k)
    stop = normal(rng, settings.stop_sigma_theta_rad, n_stops)
    stop = np.repeat(stop, view.repeats) if settings.consecutive else stop
    if settings.follow_mark:
        centre = direction if settings.sense is Sense.MICROSCOPE_MOVES else -direction
        target = (centre + physics.encoder_error(truth, centre))[k]
    position = target + stop + normal(rng, settings.servo_sigma_theta_rad, len(k))
    offset = physics.line_offset(truth, settings.sense, direction[k], position)
    offset_read = (
        truth.line_factor * offset
        + normal(rng, settings.sigma_theta_rad, len(k))
        + _flicker(rng, settings.flicker_theta_rad, (len(k),))
    )
    indicated = position + normal(rng, settings.encoder_sigma_theta_rad, len(k))
    return AngularExposures(
        k, is_line[k], indicated, quantised(offset_read, settings.resolution_theta_rad)
    )


def quantised(values: np.ndarray, step: float) -> np.ndarray:
    """Return the nearest multiples of `step`; unchanged if it is 0."""
    return np.rint(values / step) * step if step else values


def flicker_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return noise of variance 1 along the last axis whose spectrum falls as 1/f."""
    length = 2 * max(shape[-1], 2)  # twice as long: the part used is not periodic
    k = np.arange(1, length // 2)
    spectrum = np.zeros((*shape[:-1], length // 2 + 1), dtype=complex)
    parts = rng.normal(0, 1, (2, *shape[:-1], len(k)))
    spectrum[..., 1:-1] = (parts[0] + 1j * parts[1]) / np.sqrt(k)
    wave = np.fft.irfft(spectrum, length) * (length / (2 * np.sqrt((1 / k).sum())))
    return wave[..., : shape[-1]]


def _flicker(
    rng: np.random.Generator, sigma: float, shape: tuple[int, ...]
) -> np.ndarray | float:
    return sigma * flicker_noise(rng, shape) if sigma and shape[-1] else 0.0


def normal(
    rng: np.random.Generator, sigma: float, shape: tuple[int, ...] | int
) -> np.ndarray:
    """Return normally distributed numbers; 0 without a draw if `sigma` is."""
    return rng.normal(0, sigma, shape) if sigma else np.zeros(shape)


JOINTS = ("x", "y", "theta")

Event = EncoderSample | Detection | Command


def view_events(
    truth: Truth,
    plan: Plan,
    index: int,
    *,
    settings: CellSettings,
    rng: np.random.Generator,
    start_ns: int,
) -> Iterator[EncoderSample | Detection]:
    """Yield encoder samples and detections of view `index` in the order of their stamps.

    Every mark is visited `repeats` times, grid first. The first stamp is `start_ns`; the stage
    rests for a period, and approaches the first grid mark in + direction.
    """
    stops, detected = _exposures(truth, index, plan.views[index], settings, rng)
    period_ns = settings.period_ns
    step_ns = round(NS_PER_S / settings.encoder_rate_hz)
    end_ns = start_ns + period_ns * len(stops)
    exposed = 0
    for stamp in range(start_ns, end_ns + 1, step_ns):
        while exposed < len(detected):
            exposed_ns = start_ns + (exposed + 1) * period_ns + settings.exposure_ns
            if exposed_ns > stamp:
                break
            for offset, mark in detected[exposed]:
                yield _detection(exposed_ns, offset, mark, settings)
            exposed += 1
        yield EncoderSample(stamp, JOINTS, _position(stops, stamp - start_ns, settings))


def plan_events(
    truth: Truth,
    plan: Plan,
    *,
    settings: CellSettings,
    rng: np.random.Generator,
    start_ns: int,
) -> Iterator[Event]:
    """Yield all messages of a plan, commands included, in the order of their stamps."""
    now = start_ns
    pause_ns = 20_000_000
    for index, view in enumerate(plan.views):
        for phase in (Phase.PLACE, Phase.MEASURE):
            yield Command(
                stamp_ns=now,
                phase=phase,
                plan_id=plan.plan_id,
                view_index=index,
                view=view,
                artifact=plan.artifact,
                views_planned=len(plan.views),
                model_terms=plan.model_terms,
                artifact_from=plan.artifact_from,
                **plan_keys(plan),
            )
            now += pause_ns
        for event in view_events(
            truth, plan, index, settings=settings, rng=rng, start_ns=now
        ):
            yield event
            now = max(now, event.stamp_ns)
        now += pause_ns
    yield Command(
        now, Phase.DONE, plan.plan_id, len(plan.views), views_planned=len(plan.views)
    )


def _exposures(
    truth: Truth,
    index: int,
    view: View,
    settings: CellSettings,
    rng: np.random.Generator,
) -> tuple[np.ndarray, list[list[tuple[np.ndarray, tuple]]]]:
    """Return stops (E + 1, 3), the first before any exposure, and what each exposure shows.

    Offset (3,) and mark (kind, m, n, k) of each; none if the plate has none there.
    """
    stops: list[np.ndarray] = [np.zeros((0, 3))]
    marks_shown: list[list[tuple[np.ndarray, tuple]]] = []
    if view.grid:
        grid = grid_exposures(truth, index, view, settings=settings, rng=rng)
        zero = np.zeros(grid.position.shape[1])
        stops.append(np.stack([*grid.position, zero], axis=1))
        marks_shown = [[] for _ in zero]
        for cell in (Seen((0, 0), grid.offset, grid.mark, grid.there), *grid.others):
            offsets = np.stack([*cell.offset, zero], axis=1)
            m, n, is_mark = (
                row[grid.visit].tolist() for row in (*cell.mark, cell.there)
            )
            for number in np.flatnonzero(is_mark).tolist():
                marks_shown[number].append(
                    (offsets[number], (Kind.GRID, m[number], n[number], 0))
                )
    if view.angular:
        lines = angular_exposures(truth, index, view, settings=settings, rng=rng)
        zero = np.zeros(len(lines.k))
        stops.append(np.stack([zero, zero, lines.position], axis=1))
        offsets = np.stack([zero, zero, lines.offset], axis=1)
        marks_shown += [
            [(offset, (Kind.ANGULAR, 0, 0, k))]
            for offset, k in zip(offsets, lines.line.tolist(), strict=True)
        ]
    stops_of_exposures = np.concatenate(stops)
    before = stops_of_exposures[:1].copy()
    if view.grid:
        before[:, :2] = lead_in(truth, before[:, :2])
    return np.concatenate([before, stops_of_exposures]), marks_shown


def _position(
    stops: np.ndarray, elapsed_ns: int, settings: CellSettings
) -> tuple[float, ...]:
    number, within = divmod(elapsed_ns, settings.period_ns)
    position = stops[min(number, len(stops) - 1)]
    if within > settings.dwell_ns and number + 1 < len(stops):
        part = (within - settings.dwell_ns) / (settings.period_ns - settings.dwell_ns)
        position = position + (stops[number + 1] - position) * part
    return tuple(position.tolist())


def _detection(
    stamp_ns: int, offset: np.ndarray, mark: tuple, settings: CellSettings
) -> Detection:
    kind, m, n, k = mark
    sigma = settings.sigma_xy_m if kind == Kind.GRID else settings.sigma_theta_rad
    m, n, k = (m, n, k) if settings.with_ids else (0, 0, 0)
    x, y, theta = offset.tolist()
    return Detection(
        stamp_ns,
        int(kind),
        settings.with_ids,
        m=m,
        n=n,
        k=k,
        offset_x=x,
        offset_y=y,
        offset_theta=theta,
        sigma=sigma if settings.declare_sigma else 0.0,
        score=0.95,
    )
