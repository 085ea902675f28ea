# SPDX-License-Identifier: Apache-2.0
"""Whether the microscope's offsets follow the stage correctly, before any map is computed.

If the stage moves by m from one repeat of a mark to the next, the offset measured by the microscope
is -m. With readout noise of the encoder, which is not motion, and noise of the
detection, independent of each other and of the motion, the covariance of position and offset is
-S D', where S is the covariance of the motion and D the wiring of the offsets: the identity, or
one of the other seven that exchange and reverse axes. For the right one tr(S D' D) is largest, so
neither noise can favour another one. Noise of the position pulls the slope of the offset on it
towards 0, noise of the offset the slope of the position: the scale is between the two.
Of 2,000 clean simulated measurements none was refused (test_wiring.py).

A stage that rests on the marks does not show how the offsets follow it. But the plate
never lies exactly as planned, and its displacement and turn differ from view to view: offsets D o
for the true o fit one rigid plate only for the right D, apart from an overall sign of marks and
lines together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from math import exp, lgamma, log, pi

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.readings import (
    GridVisits,
    Measurements,
    RepeatMotion,
    ViewReadings,
)

BEYOND_DOUBT = 1e-6
"""Probability, over all tests, below which a finding is beyond doubt, as that of a wrong wiring:
not by chance in a million sessions."""
F_LEVEL = 1e-3
"""Level of a test of all readings together, or of all offsets of an axis: one good session in a
thousand fails it."""
SHOWN = 0.01
"""Probability without motion below which the sign of the offsets counts as confirmed."""
DOUBLED, HALVED = 1.5, 0.7
"""Scales beyond which an offset is in wrong units; nearer to 1 the scale is fitted."""
BEYOND = 3.0
"""Standard uncertainties beyond which a value is not chance: 0.3 % of good ones are."""
MAX_REMOVED = 0.1
"""Largest share of readings that are outliers; if it is more, the fault is another one."""

LEAST_SLOPE = 0.3
"""Scale below which an offset is taken not to follow the stage."""
LEAST_NOISE_M = 1e-12
"""Noise, motion or misclosure, m or rad, below which there is nothing but rounding."""
AXES = {"grid": ("x", "y"), "angular": ("theta",)}


class WiringError(InputError):
    """Raised for offsets with the wrong sign, on exchanged axes, or in wrong units."""


@dataclass(frozen=True)
class OffsetResponse:
    """Response of one offset to the position of the optical axis over the plate; nominally -1.

    Attributes
    ----------
    offset, axis : str
        ``x``, ``y`` or ``theta``: the offset, and the axis that it follows.
    slope, u_slope : float
        Regression of the offset on the position, and its standard uncertainty.
    most : float
        Offset over position by the regression of the position on the offset: without noise the
        ratio is between this and the slope.
    p : float
        Probability of such a covariance without motion.
    """

    offset: str
    axis: str
    slope: float
    u_slope: float
    most: float
    p: float

    @property
    def crossed(self) -> bool:
        """Whether the offset follows the other axis."""
        return self.offset != self.axis


@dataclass(frozen=True)
class WiringFault:
    """Offsets that do not follow the stage correctly.

    Attributes
    ----------
    view : str
        Name of the view that shows it; empty = all views together.
    kind : str
        ``grid`` or ``angular``.
    responses : tuple of OffsetResponse
        The wrong ones, at least one.
    """

    view: str
    kind: str
    responses: tuple[OffsetResponse, ...]


def check_wiring(measurements: Measurements) -> None:
    """Raise WiringError for the first fault of `wiring_faults`."""
    for error in map(wiring_error, wiring_faults(measurements)):
        raise WiringError(
            f"plan '{measurements.plan_id}', {error.where}", error.what, error.remedy
        )


def wiring_faults(measurements: Measurements) -> list[WiringFault]:
    """Return the faults in the wiring of offsets shown by repeats of marks.

    From all views together, else from the first view that shows a fault by itself.
    """
    faults = []
    for kind, name in (("grid", "motion"), ("angular", "motion_theta")):
        motions = [
            (view.view.name, motion)
            for view in measurements.views
            if (motion := getattr(view, name)) is not None and motion.dof > 1
        ]
        tries = (len(AXES[kind]) ** 3 + len(AXES[kind])) * (len(motions) + 1)
        for view, motion in _together(motions):
            responses = _wrong(motion, AXES[kind], BEYOND_DOUBT / tries)
            if responses:
                faults.append(WiringFault(view, kind, responses))
                break
    return faults


def sign_is_shown(measurements: Measurements) -> bool:
    """Return whether the repeats of grid marks confirm the sign of the offsets.

    All views together, compared with the opposite sign. Images show it by themselves: with the
    opposite sign their marks would be on the other side of the stage.
    """
    if any(view.view.cell is not None and len(view.m) for view in measurements.views):
        return True
    motion = _of_all_views(measurements)
    return motion is not None and _p_for(motion, np.eye(2), -np.eye(2)) < SHOWN


def sign_of_lines_is_shown(measurements: Measurements) -> bool:
    """Return whether the repeats of lines confirm the sign of their offsets, or they have none.

    A stage that rests on each line by its own sight has no offset, of whatever sign.
    """
    motions = [
        view.motion_theta
        for view in measurements.views
        if view.motion_theta is not None
    ]
    if not motions:
        return False
    motion = _sum(motions)
    place, offset = np.diag(motion.products)
    follows = place > LEAST_NOISE_M**2 * motion.dof
    return bool(follows) and (
        offset == 0
        or (motion.dof > 1 and _p_for(motion, np.eye(1), -np.eye(1)) < SHOWN)
    )


def contradicted_scale(
    measurements: Measurements, u_scale: float
) -> OffsetResponse | None:
    """Return the response that most contradicts a microscope's scale of 1 ± u_scale; None if none.

    From all views together. The scale is between the slope and `OffsetResponse.most`, so noise of
    encoder and detection, however large, does not contradict a correct one.
    """
    motion = _of_all_views(measurements)
    if motion is None:
        return None
    limits = max(1 - BEYOND * u_scale, 0.0), 1 + BEYOND * u_scale
    p_of_axes = [_p_of_scale(motion, [(i, i)], limits) for i in range(2)]
    axis = int(np.argmin(p_of_axes))
    p = min(*p_of_axes, _p_of_scale(motion, [(0, 0), (1, 1)], limits))
    return (
        replace(_response(motion, (axis, axis), AXES["grid"]), p=6 * p)
        if (6 * p < F_LEVEL)
        else None
    )


def _of_all_views(measurements: Measurements) -> RepeatMotion | None:
    """Return the sums of grid marks over all views; None without motion along both axes."""
    motions = [view.motion for view in measurements.views if view.motion is not None]
    if not motions:
        return None
    motion = _sum(motions)
    has_moved = np.diag(motion.products) > LEAST_NOISE_M**2 * motion.dof
    return motion if motion.dof > 1 and bool(has_moved.all()) else None


def _sum(motions: Sequence[RepeatMotion]) -> RepeatMotion:
    return RepeatMotion(
        np.sum([motion.products for motion in motions], axis=0),
        sum(motion.dof for motion in motions),
    )


def _together(
    motions: list[tuple[str, RepeatMotion]],
) -> Iterator[tuple[str, RepeatMotion]]:
    """Yield the sums of all views, then those of each view with its name."""
    if motions:
        yield "", _sum([motion for _, motion in motions])
    if len(motions) > 1:
        yield from motions


@cache
def _wirings(n: int) -> tuple[np.ndarray, ...]:
    """Return the ways to wire n offsets, the right one first: offset = -D motion."""
    orders = [np.eye(n), np.eye(n)[::-1]][:n]
    return tuple(
        np.array(signs)[:, None] * order
        for order in orders
        for signs in product((1.0, -1.0), repeat=n)
    )


def _wrong(
    motion: RepeatMotion, axes: tuple[str, ...], level: float
) -> tuple[OffsetResponse, ...]:
    """Return the offsets that follow the stage wrongly; none if in doubt."""
    limits = HALVED, DOUBLED
    n = len(axes)
    least = LEAST_NOISE_M**2 * motion.dof
    has_moved = np.diag(motion.products) > np.repeat([least, 0.0], n)
    if not has_moved[:n].any() or not has_moved[n:].any():
        return ()
    wiring = _wiring(motion, level)
    out = []
    for j in range(n):
        i = int(np.abs(wiring[j]).argmax())
        if (
            not (has_moved[i] and has_moved[n + j])
            or motion.products[i, n + j] * wiring[j, i] >= 0
        ):
            continue
        response = _response(motion, (i, j), axes)
        if response.p >= F_LEVEL or response.most < LEAST_SLOPE:
            continue
        if (
            response.crossed
            or wiring[j, i] < 0
            or _p_of_scale(motion, [(i, j)], limits) < level
        ):
            out.append(response)
    return tuple(out)


def _wiring(motion: RepeatMotion, level: float) -> np.ndarray:
    """Return the wiring of the offsets: the right one unless another is beyond doubt.

    If the axes move together, exchanged and reversed offsets look the same: then reversed.
    """
    n = len(motion.products) // 2

    def likely(wiring: np.ndarray) -> float:
        return float(-np.trace(motion.products[:n, n:] @ wiring))

    right, *wrong_wirings = _wirings(n)
    sure = [wiring for wiring in wrong_wirings if _p_for(motion, wiring, right) < level]
    if not sure:
        return right
    best = max(sure, key=likely)
    straight = [
        wiring
        for wiring in wrong_wirings
        if wiring[0, 0] and _p_for(motion, best, wiring) > F_LEVEL
    ]
    return max(straight, key=likely, default=best)


def _p_for(motion: RepeatMotion, wiring: np.ndarray, alternative: np.ndarray) -> float:
    """Return the probability of the evidence for one wiring and against another.

    The evidence is tr(C (D' - D)): negative, or 0 without motion, if the other one is true.
    """
    n = len(wiring)
    change = alternative - wiring
    size2 = np.trace(
        motion.products[:n, :n] @ change.T @ motion.products[n:, n:] @ change
    )
    if not size2 > 0:
        return 1.0
    evidence = np.trace(motion.products[:n, n:] @ change)
    rank = int(np.linalg.matrix_rank(change))
    return _p_of(float(evidence / np.sqrt(rank * size2)), rank * (motion.dof - 1) + 1)


def _p_of_scale(
    motion: RepeatMotion, pairs: Sequence[tuple[int, int]], limits: tuple[float, float]
) -> float:
    """Return the probability of a scale as far from 1 if it is within the `limits`.

    Offset j of each pair (i, j) follows axis i, all with the same scale. With o the offset and p
    the position: o - s p correlates with p if even the smallest scale is beyond s, s p - o with o
    if even the largest is below it.
    """
    n = len(motion.products) // 2
    least, most = limits
    summed = np.zeros((2, 2))
    for i, j in pairs:
        of_pair = motion.products[np.ix_([i, n + j], [i, n + j])]
        summed += np.where(np.eye(2, dtype=bool), of_pair, abs(of_pair))
    place, offset = np.eye(2)
    dof = len(pairs) * (motion.dof - 1) + 1
    return min(
        _p_of(_correlation(summed, place, offset - most * place), dof),
        _p_of(_correlation(summed, offset, least * place - offset), dof),
    )


def _correlation(products: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of two combinations of positions and offsets."""
    size2 = (a @ products @ a) * (b @ products @ b)
    return float(a @ products @ b / np.sqrt(size2)) if size2 > 0 else 0.0


def _p_of(correlation: float, dof: int) -> float:
    """Return a close upper bound of the probability of a larger correlation, without scipy.

    The density is proportional to (1 - r^2)^(d/2 - 1), integrated with a factor r / correlation.
    """
    d = dof - 1
    if correlation <= 0:
        return 0.5
    density = lgamma((d + 1) / 2) - lgamma(d / 2) - 0.5 * log(pi)
    log_uncorrelated = log(max(1 - correlation**2, 1e-30))
    return min(
        0.5, exp(max(d / 2 * log_uncorrelated + density - log(d * correlation), -700.0))
    )


def _response(
    motion: RepeatMotion, at: tuple[int, int], axes: tuple[str, ...]
) -> OffsetResponse:
    """Return the response of offset j to axis i, `at` = (i, j)."""
    i, j = at
    n = len(axes)
    place = motion.products[i, i]
    offset = motion.products[n + j, n + j]
    cross = float(motion.products[i, n + j])
    r2 = min(cross**2 / (place * offset), 1.0)
    return OffsetResponse(
        offset=axes[j],
        axis=axes[i],
        slope=cross / place,
        u_slope=float(np.sqrt((1 - r2) * offset / place / (motion.dof - 1))),
        most=offset / abs(cross),
        p=_p_of(float(np.sqrt(r2)), motion.dof),
    )


def wiring_error(fault: WiringFault) -> WiringError:
    """Return the error for a fault: in one line, what is wrong and how to correct it."""
    responses = fault.responses
    names = " and ".join(f"offset_{response.offset}" for response in responses)
    numbers = ", ".join(
        f"offset_{r.offset} against {r.axis}: {r.slope:+.2f} ± {r.u_slope:.2g}, expected "
        f"{0 if r.crossed else -1}"
        for r in responses
    )
    if any(response.crossed for response in responses):
        fault_text = "exchanged axes: " + " and ".join(
            f"offset_{r.offset} follows {r.axis}" for r in responses
        )
        remedy = (
            "publish offsets along the stage's axes, mark - optical axis; or, if the joints "
            "are exchanged, correct joint_x and joint_y"
        )
    elif any(response.slope > 0 for response in responses):
        fault_text = (
            "offsets of the other sign: "
            + names
            + (" rise" if len(responses) > 1 else " rises")
            + " where the optical axis moves on"
        )
        remedy = (
            f"publish mark - optical axis: reverse the sign of {names}; or, if it is right, "
            "stamp the detections with the time of the exposure"
        )
    else:
        fault_text = (
            f"offsets in wrong units: {names} "
            + ", ".join(f"{abs(r.slope):.3g}" for r in responses)
            + " times what the stage moves"
        )
        remedy = "correct the pixel size, or the unit: offsets are in " + (
            "rad" if fault.kind == "angular" else "m"
        )
    where = "stage/mark_detections" + (f" of view '{fault.view}'" if fault.view else "")
    return WiringError(
        where, f"{fault_text} (slope among repeats of {numbers})", remedy
    )


@dataclass(frozen=True, eq=False)
class Turned:
    """Another wiring of the offsets.

    Attributes
    ----------
    of_offsets : float array (2, 2)
        D: the published offset is D times the true one.
    of_lines : int
        Sign of the published offset_theta; -1 = the other one.
    what : str
        In words.
    """

    of_offsets: np.ndarray
    of_lines: int
    what: str


TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
MIRROR = np.diag([-1.0, 1.0])
AS_IS = Turned(np.eye(2), 1, "the offsets are as they are published")
OTHER_LINES = Turned(
    np.eye(2), -1, "offset_theta has the other sign, or the offsets are turned by 180°"
)
PAIRS = (
    (
        Turned(TURN, 1, "the offsets are turned by 90° counter-clockwise"),
        Turned(-TURN, 1, "the offsets are turned by 90° clockwise"),
    ),
    (
        Turned(MIRROR, 1, "offset_x has the other sign"),
        Turned(-MIRROR, 1, "offset_y has the other sign"),
    ),
    (
        Turned(-TURN @ MIRROR, 1, "offset_x and offset_y are exchanged"),
        Turned(
            TURN @ MIRROR,
            1,
            "offset_x and offset_y are exchanged, both with the other sign",
        ),
    ),
)
"""Wirings that grid marks do not distinguish: the lines do."""


def turned_readings(measurements: Measurements, wiring: Turned) -> Measurements:
    """Return the readings as they are with true offsets, if the published ones have this wiring."""
    return replace(
        measurements, views=tuple(_undone(view, wiring) for view in measurements.views)
    )


def shows_offsets(measurements: Measurements) -> bool:
    """Return whether the offsets of all grid marks are known, one mark an image."""
    return not measurements.has_images and all(
        view.visits is not None or not len(view.m) for view in measurements.views
    )


def turned_error(measurements: Measurements, wirings: Sequence[Turned]) -> WiringError:
    """Return the error for the wirings with which alone the readings agree."""
    texts = ", or ".join(wiring.what for wiring in wirings)
    return WiringError(
        f"plan '{measurements.plan_id}', stage/mark_detections",
        f"{texts}: only so do the readings of all views agree",
        "publish mark - optical axis along the stage's axes (a camera: --turn and "
        "--mirror, `selfcal camera init` finds them); check_stops in the plan show it "
        "in the first view",
    )


def _undone(view: ViewReadings, wiring: Turned) -> ViewReadings:
    """Return the readings of a view with true offsets, if the published ones had this wiring."""
    back = wiring.of_offsets.T
    view = replace(
        view,
        dtheta=wiring.of_lines * view.dtheta,
        motion_theta=_turned_motion(view.motion_theta, np.array([[wiring.of_lines]])),
    )
    if view.visits is None:
        return view
    x, y = (back - np.eye(2)) @ np.stack([view.visits.offset_x, view.visits.offset_y])
    return with_offsets(view, view.visits, x + 1j * y, back)


def with_offsets(
    view: ViewReadings, visits: GridVisits, change: np.ndarray, back: np.ndarray
) -> ViewReadings:
    """Return the readings of a view with other offsets.

    Parameters
    ----------
    view, visits : ViewReadings, GridVisits
        The readings, and their visits.
    change : complex array (V,)
        What the offset of each visit, and with it the deviation, gains, stage axes, m.
    back : float array (2, 2)
        Slope of the other offsets on these.
    """
    of_mean = visits.means(change, len(view.m))
    return replace(
        view,
        dx=view.dx + of_mean.real,
        dy=view.dy + of_mean.imag,
        motion=_turned_motion(view.motion, back),
        visits=replace(
            visits,
            dx=visits.dx + change.real,
            dy=visits.dy + change.imag,
            offset_x=visits.offset_x + change.real,
            offset_y=visits.offset_y + change.imag,
        ),
    )


def _turned_motion(
    motion: RepeatMotion | None, back: np.ndarray
) -> RepeatMotion | None:
    """Return the sums over repeats with other offsets."""
    if motion is None:
        return None
    n = len(back)
    transformation = np.eye(2 * n)
    transformation[n:, n:] = back
    return replace(motion, products=transformation @ motion.products @ transformation.T)
