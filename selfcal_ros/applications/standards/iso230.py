# SPDX-License-Identifier: Apache-2.0
"""Figures of ISO 230 from a map and the repeats behind it: parts 2 (axes), 4 (circles), 6.

ISO 230 counts deviations as actual minus commanded position, x = -G. Uncertainties are the rms
difference between a figure and those of draws of the deviations, reversals and scatters.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, digamma, polygamma

from selfcal_ros.apply import StageMap
from selfcal_ros.collection.marks.stops import stage_aside
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.model.readings import GridVisits, Measurements, ViewReadings

DRAWS = 2000
"""Draws behind the uncertainties: 1.6 % standard error."""
LEVEL = 0.01
"""Probability below which values differ by more than their noise."""
SHARES = 400
"""Steps of the share of noise in the variance of measured values."""
CIRCLE_POINTS = 72
"""Points of a circle."""
FEWEST = 3
"""Smallest number of positions along an axis."""


class UnknownSitesError(InputError):
    """Raised for a path in the field over sites that are not known."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Repeats at one site, approached along one axis in both directions.

    Attributes
    ----------
    reversal_m : float
        Mean stage error after a positive approach minus that after a negative one.
    u_reversal_m : float
        Its standard deviation for unit scatter of one approach.
    s_up_m, s_down_m : float
        Standard deviation of one approach in each direction.
    dof_up, dof_down : int
        Their degrees of freedom.
    mean_sign : float
        Mean sign of all approaches: +1 if all were positive.
    """

    reversal_m: float
    u_reversal_m: float
    s_up_m: float
    s_down_m: float
    dof_up: int
    dof_down: int
    mean_sign: float


@dataclass(frozen=True)
class Figure:
    """A figure of a standard with its standard uncertainty, m."""

    value: float
    u: float


@dataclass(frozen=True, eq=False)
class AxisFigures:
    """Figures of an axis, ISO 230-2, along a line of sites.

    Attributes
    ----------
    axis : str
        ``x`` or ``y``.
    line_m : float
        The other coordinate of the line.
    position_m, up_m, down_m, s_up_m, s_down_m : float array (n,)
        Positions, mean deviations and standard deviations by approach; a map without repeats
        has the mean deviation in `up_m` and `down_m`, and NaN for the others.
    approaches : tuple of int
        Smallest number of approaches behind a standard deviation, positive and negative.
    left_out_m : float array
        Positions along the line that are not among these: unknown, or with too few repeats.
    figures : dict of Figure
        By the symbols of the standard: ``M``, and with repeats ``E``, ``B``, ``R``, ``A``
        and those of one direction, ``E+``, ``R-`` ...
    """

    axis: str
    line_m: float
    position_m: np.ndarray
    up_m: np.ndarray
    down_m: np.ndarray
    s_up_m: np.ndarray
    s_down_m: np.ndarray
    approaches: tuple[int, int]
    left_out_m: np.ndarray
    figures: dict[str, Figure]


def scatters(measurements: Measurements, axis: int) -> dict[tuple[int, int], Scatter]:
    """Return the repeats at each site of the lattice that was approached from both sides.

    Only differences within a view and mark count: what the plate and the views do is in the map.

    Parameters
    ----------
    measurements : Measurements
        Readings with their visits.
    axis : int
        0 = x, 1 = y.

    Raises
    ------
    InputError
        If the map has nodes of its own.
    """
    if measurements.artifact.map_grid is not None:
        raise InputError(
            "iso230",
            "the map has nodes of its own, off the marks",
            "give its RESULT.json: figures without repeats",
        )
    sign = measurements.sense.sign
    groups: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
    for view in measurements.views:
        for site, group in _groups(view, measurements, axis, sign):
            groups.setdefault(site, []).append(group)
    scatter_at = {site: _scatter(parts) for site, parts in groups.items()}
    return {site: item for site, item in scatter_at.items() if item is not None}


def _groups(
    view: ViewReadings, measurements: Measurements, axis: int, sign: int
) -> Iterator[tuple[tuple[int, int], tuple[np.ndarray, np.ndarray]]]:
    """Yield the site of each mark with stage errors and signs of approach of its visits.

    Not of check stops: what they add to the scatter is the scale and turn of the microscope.
    """
    visits = view.visits
    if visits is None or not len(visits.mark):
        return
    artifact = measurements.artifact
    pose = view.view.lattice_pose(artifact)
    off = artifact.off_centre
    x, y = pose.site_of(*artifact.places(view.m, view.n))
    values = sign * (visits.dx, visits.dy)[axis]
    approach = (visits.approach_x, visits.approach_y)[axis]
    ordinary = np.flatnonzero(~_at_check_stops(visits, view.view.check_offset_m))
    order = ordinary[np.argsort(visits.mark[ordinary], kind="stable")]
    starts = np.flatnonzero(np.diff(visits.mark[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        mark = visits.mark[rows[0]]
        site = int(sign * x[mark] - off[0]), int(sign * y[mark] - off[1])
        yield site, (values[rows], approach[rows])


def _at_check_stops(visits: GridVisits, check_offset_m: float) -> np.ndarray:
    """Return which visits are check stops, bool (V,)."""
    place_m = np.stack([visits.dx - visits.offset_x, visits.dy - visits.offset_y])
    aside = (
        stage_aside(visits.mark, place_m, check_offset_m) if check_offset_m else None
    )
    if aside is None:
        return np.zeros(len(visits.mark), dtype=bool)
    return aside.any(axis=0)


def _scatter(parts: list[tuple[np.ndarray, np.ndarray]]) -> Scatter | None:
    """Return the pooled repeats of a site; None if a direction has none, or no second one."""
    weight = weighted_reversal = 0.0
    square = np.zeros(2)
    dof = np.zeros(2, dtype=int)
    signs = np.concatenate([approach for _, approach in parts])
    for values, approach in parts:
        means = np.zeros(2)
        counts = np.zeros(2, dtype=int)
        for side, wanted in enumerate((1, -1)):
            repeats = values[approach == wanted]
            counts[side] = len(repeats)
            if len(repeats):
                means[side] = repeats.mean()
                square[side] += ((repeats - repeats.mean()) ** 2).sum()
                dof[side] += len(repeats) - 1
        if counts.all():
            w = 1 / (1 / counts).sum()
            weight = weight + w
            weighted_reversal = weighted_reversal + w * (means[0] - means[1])
    if not weight or not dof.all():
        return None
    s = np.sqrt(square / dof)
    return Scatter(
        reversal_m=float(weighted_reversal / weight),
        u_reversal_m=float(1 / np.sqrt(weight)),
        s_up_m=float(s[0]),
        s_down_m=float(s[1]),
        dof_up=int(dof[0]),
        dof_down=int(dof[1]),
        mean_sign=float(signs.mean()),
    )


def bidirectional(
    up: np.ndarray, down: np.ndarray, s_up: np.ndarray, s_down: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the figures of ISO 230-2, clause 3, over the last axis of the arrays.

    Parameters
    ----------
    up, down, s_up, s_down : float array (..., n)
        Mean deviation and standard deviation at each position, by direction of approach.
    """

    def spread(high: np.ndarray, low: np.ndarray) -> np.ndarray:
        return high.max(axis=-1) - low.min(axis=-1)

    reversal = up - down
    repeatability = np.maximum(
        2 * s_up + 2 * s_down + np.abs(reversal), np.maximum(4 * s_up, 4 * s_down)
    )
    high = np.maximum(up + 2 * s_up, down + 2 * s_down)
    low = np.minimum(up - 2 * s_up, down - 2 * s_down)
    return {
        "M": spread((up + down) / 2, (up + down) / 2),
        "B": np.abs(reversal).max(axis=-1),
        "mean B": reversal.mean(axis=-1),
        "E": spread(np.maximum(up, down), np.minimum(up, down)),
        "E+": spread(up, up),
        "E-": spread(down, down),
        "R": repeatability.max(axis=-1),
        "R+": 4 * s_up.max(axis=-1),
        "R-": 4 * s_down.max(axis=-1),
        "A": spread(high, low),
        "A+": spread(up + 2 * s_up, up - 2 * s_up),
        "A-": spread(down + 2 * s_down, down - 2 * s_down),
    }


def axis_figures(
    stage: StageMap,
    axis: int,
    line: int,
    repeats: dict[tuple[int, int], Scatter] | None = None,
    *,
    approach_in_model: bool = False,
) -> AxisFigures:
    """Return the figures of an axis along a line of sites.

    Parameters
    ----------
    stage : StageMap
        The map.
    axis, line : int
        0 = x, 1 = y; index of the line, 0 = through the centre of the field, or half a pitch
        beside it between an even number of lines.
    repeats : dict, optional
        As `scatters` returns; None = figures of the mean deviation alone.
    approach_in_model : bool
        Whether the map is that of the mean of both approaches already (term `approach`).

    Raises
    ------
    InputError
        If the line has fewer than three positions.
    """
    sites = _positions(stage, axis, line, repeats)
    plate = stage.error_map.artifact
    emap = stage.error_map
    index = plate.index(*np.array(sites).T)
    error = (emap.gx, emap.gy)[axis][index]
    drawn = error + _map_draws(stage, index, axis)
    along = (plate.x_m[:, 0], plate.y_m[0])[axis]
    position = along[index[axis]]
    left_out = np.delete(along, index[axis])
    line_m = (line + plate.off_centre[1 - axis]) * plate.grid_pitch_m
    nothing = np.full(len(sites), np.nan)
    if repeats is None:
        value = -error
        range_m = float(np.ptp(value))
        return AxisFigures(
            "xy"[axis],
            line_m,
            position,
            up_m=value,
            down_m=value,
            s_up_m=nothing,
            s_down_m=nothing,
            approaches=(0, 0),
            left_out_m=left_out,
            figures={"M": Figure(range_m, _rms_about(np.ptp(drawn, axis=-1), range_m))},
        )
    items = [repeats[site] for site in sites]
    s_up, s_down, reversal, u_reversal, dof_up, dof_down, sign = (
        np.array([getattr(item, name) for item in items])
        for name in (
            "s_up_m",
            "s_down_m",
            "reversal_m",
            "u_reversal_m",
            "dof_up",
            "dof_down",
            "mean_sign",
        )
    )
    shift = np.zeros(len(sites)) if approach_in_model else sign * reversal / 2
    up = -(error - shift + reversal / 2)
    down = -(error - shift - reversal / 2)
    rng = np.random.default_rng(0)
    u = u_reversal * np.sqrt(np.mean(s_up**2 + s_down**2) / 2)
    turned = _true_values(reversal, u, rng)
    draws = bidirectional(
        -(drawn - shift + turned / 2),
        -(drawn - shift - turned / 2),
        _true_scatters(s_up, dof_up, rng),
        _true_scatters(s_down, dof_down, rng),
    )
    values_of = bidirectional(up, down, s_up, s_down)
    return AxisFigures(
        "xy"[axis],
        line_m,
        position,
        up_m=up,
        down_m=down,
        s_up_m=s_up,
        s_down_m=s_down,
        approaches=(int(dof_up.min()) + 1, int(dof_down.min()) + 1),
        left_out_m=left_out,
        figures={
            name: Figure(float(value), _rms_about(draws[name], float(value)))
            for name, value in values_of.items()
        },
    )


def _true_values(
    values: np.ndarray, u: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return draws of the true values at positions, (DRAWS, n), given measured ones with u.

    The largest of measured values is larger than the largest true one.
    """
    if not (u > 0).all():
        return np.broadcast_to(values, (DRAWS, len(values)))
    centre, true_share = _true_shares(values, u, rng)
    drawn = rng.standard_normal((DRAWS, len(values))) * u * np.sqrt(true_share)
    return centre + true_share * (values - centre) + drawn


def _true_scatters(
    s: np.ndarray, dof: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return draws of the true standard deviations at positions, (DRAWS, n), given measured ones.

    As `_true_values`, of their logarithms: the largest s is larger than the largest true one.
    """
    noise = rng.chisquare(dof, (DRAWS, len(s))) / dof
    if not (s > 0).all():
        return s * np.sqrt(noise)
    u = np.sqrt(polygamma(1, dof / 2)) / 2
    bias = (digamma(dof / 2) - np.log(dof / 2)) / 2
    centre, true_share = _true_shares(np.log(s) - bias, u, rng)
    drawn = np.log(noise) / 2 * np.sqrt(true_share)
    return np.exp(centre + true_share * (np.log(s) - centre) + drawn)


def _true_shares(
    values: np.ndarray, u: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return draws of the centre of values with u, (DRAWS, 1), and of how much about it is true.

    Values that differ by no more than their noise (chi-square test, 1 %) are taken as equal, which
    makes the bias of the largest of them largest: nothing about the centre is true. Otherwise the
    true ones are normal about their mean, with a variance t^2 that is drawn given the measured
    ones; its prior makes the share u^2 / (u^2 + t^2) of noise uniform (Daniels, 1999). The share of
    truth is then (DRAWS, n).
    """
    n = len(values)
    equal = 1 / u**2
    common = equal @ values / equal.sum()
    if chdtrc(n - 1, equal @ (values - common) ** 2) > LEVEL:
        centre = common + rng.standard_normal((DRAWS, 1)) / np.sqrt(equal.sum())
        return centre, np.zeros((DRAWS, n))
    share = (np.arange(SHARES) + 0.5) / SHARES
    variance = np.mean(u**2) * (1 / share - 1)[:, None] + u**2
    weight = 1 / variance
    mean = weight @ values / weight.sum(axis=1)
    fit = 0.5 * (np.log(weight) - weight * (values - mean[:, None]) ** 2).sum(axis=1)
    fit -= 0.5 * np.log(weight.sum(axis=1))
    chosen = rng.choice(
        SHARES, DRAWS, p=np.exp(fit - fit.max()) / np.exp(fit - fit.max()).sum()
    )
    centre = mean[chosen] + rng.standard_normal(DRAWS) / np.sqrt(
        weight[chosen].sum(axis=1)
    )
    return centre[:, None], 1 - u**2 * weight[chosen]


def _positions(
    stage: StageMap,
    axis: int,
    line: int,
    repeats: dict[tuple[int, int], Scatter] | None,
) -> list[tuple[int, int]]:
    """Return the known sites along a line, with repeats if there are some."""
    plate, valid = stage.error_map.artifact, stage.error_map.valid
    first, last = plate.limits[axis]
    low, high = plate.limits[1 - axis]
    sites = [(i, line) if axis == 0 else (line, i) for i in range(first, last + 1)]
    known_sites = [
        site
        for site in sites
        if low <= line <= high
        and valid[site[0] + plate.middle[0], site[1] + plate.middle[1]]
        and (repeats is None or site in repeats)
    ]
    if len(known_sites) < FEWEST:
        raise InputError(
            f"line {line} along {'xy'[axis]}",
            f"{len(known_sites)} positions "
            + (
                "are known"
                if repeats is None
                else "were approached at least twice from each side in one view"
            ),
            "choose another line"
            if repeats is None
            else "measure with visit_order "
            "there_and_back, or x_back_y_back for both axes, and repeats 4 or more",
        )
    return known_sites


def _rms_about(values: np.ndarray, centre: float) -> float:
    return float(np.sqrt(np.mean((values - centre) ** 2)))


def _map_draws(
    stage: StageMap, place: tuple[np.ndarray, np.ndarray], axis: int
) -> np.ndarray:
    """Return draws of the error of the map at sites along one axis, (DRAWS, n), m."""
    emap = stage.error_map
    chosen = np.zeros(emap.artifact.shape, dtype=bool)
    chosen[place] = True
    cover = covariance_of(stage.result, "xy", chosen)
    n = int(chosen.sum())
    part = slice(axis * n, (axis + 1) * n)
    along_axis = cover[part, part] if cover.ndim == 2 else np.diag(cover[part])
    order = np.argsort(np.ravel_multi_index(place, emap.artifact.shape))
    out = np.empty((DRAWS, n))
    out[:, order] = _draws(along_axis)
    return out


def _draws(cover: np.ndarray) -> np.ndarray:
    """Return draws with a covariance; zeros where it is not known."""
    if not np.isfinite(cover).all():
        return np.full((DRAWS, len(cover)), np.nan)
    values, vectors = np.linalg.eigh(cover)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.random.default_rng(1).standard_normal((DRAWS, len(cover))) @ root.T


@dataclass(frozen=True, eq=False)
class PathFigures:
    """Figures of a path that is commanded in the field: a circle, or a diagonal."""

    name: str
    figures: dict[str, Figure]


def circle_figures(
    stage: StageMap, radius_m: float, centre_m: tuple[float, float] = (0.0, 0.0)
) -> PathFigures:
    """Return circular deviation G and radial deviations F of a circle, ISO 230-4.

    G is the range of radii about the least-squares centre of the actual path, Fmax and Fmin the
    largest and smallest deviation of the radius about the commanded centre. Static: without the
    contouring errors of the drives, and the mean of both directions of approach.

    Raises
    ------
    InputError
        If the circle is not in the field, or crosses unknown sites (UnknownSitesError).
    """
    plate = stage.error_map.artifact
    reach = np.array(plate.half) * plate.grid_pitch_m - np.abs(centre_m)
    if not 0 < radius_m <= reach.min() * (1 + 1e-9):
        raise InputError(
            "circle",
            f"a radius of {radius_m:g} m about {centre_m} m is not in the field",
            f"give one up to {max(reach.min(), 0.0):g} m",
        )
    angle = 2 * np.pi * np.arange(CIRCLE_POINTS) / CIRCLE_POINTS
    e = np.stack([np.cos(angle), np.sin(angle)])
    x, y = np.array(centre_m)[:, None] + radius_m * e

    def figures(path: np.ndarray) -> dict[str, np.ndarray]:
        """Return the figures of the deviations of paths, (..., 2, points)."""
        radial = (path * e).sum(axis=-2)
        centre = 2 * np.einsum("...p,cp->...c", radial, e) / CIRCLE_POINTS
        about = radial - np.einsum("...c,cp->...p", centre, e)
        return {
            "G": np.ptp(about, axis=-1),
            "Fmax": radial.max(axis=-1),
            "Fmin": radial.min(axis=-1),
        }

    name = f"circle of radius {radius_m * 1e3:g} mm"
    return PathFigures(
        name,
        _path(
            stage, (x, y), figures, (name, "measure them, or choose a smaller --radius")
        ),
    )


def diagonal_figures(stage: StageMap) -> list[PathFigures]:
    """Return the figures of both face diagonals, ISO 230-6, and of their difference.

    ``M`` is the range of the deviation along the diagonal, ``length`` that of its length: actual
    minus commanded. The difference of the lengths, first minus second, shows the squareness.
    """
    plate = stage.error_map.artifact
    hx, hy = np.array(plate.half) * plate.grid_pitch_m
    count = min(plate.shape)
    along = np.linspace(-1, 1, count)
    ends = np.hypot(hx, hy)
    diagonals = []
    x = np.concatenate([hx * along, hx * along])
    y = np.concatenate([hy * along, -hy * along])
    e = np.stack([np.full(2 * count, hx), np.repeat([hy, -hy], count)]) / ends

    def figures(path: np.ndarray) -> dict[str, np.ndarray]:
        d = (path * e).sum(axis=-2)
        first = d[..., :count]
        second = d[..., count:]
        lengths = [part[..., -1] - part[..., 0] for part in (first, second)]
        return {
            "1 M": np.ptp(first, axis=-1),
            "1 length": lengths[0],
            "2 M": np.ptp(second, axis=-1),
            "2 length": lengths[1],
            "3 length": lengths[0] - lengths[1],
        }

    figures_of_both = _path(stage, (x, y), figures, ("diagonals", "measure them"))
    for key, name in (
        ("1", "diagonal +x +y"),
        ("2", "diagonal +x -y"),
        ("3", "difference of the diagonals"),
    ):
        diagonals.append(
            PathFigures(
                name,
                {
                    symbol.partition(" ")[2]: figure
                    for symbol, figure in figures_of_both.items()
                    if symbol.startswith(key)
                },
            )
        )
    return diagonals


def _path(
    stage: StageMap,
    points: tuple[np.ndarray, np.ndarray],
    figures: Callable[[np.ndarray], dict[str, np.ndarray]],
    messages: tuple[str, str],
) -> dict[str, Figure]:
    """Return the figures of the deviations, actual minus commanded, at points of a path.

    `messages` are the name of the path, and what helps if it crosses unknown sites.
    """
    gx, gy = stage.error(*points)
    if not np.isfinite(gx + gy).all():
        raise UnknownSitesError(messages[0], "unknown sites on the path", messages[1])
    deviation = -np.stack([gx, gy])
    measured = figures(deviation)
    try:
        drawn = figures(
            deviation - _draws(stage.covariance(*points)).reshape(DRAWS, 2, -1)
        )
    except InputError:  # without the correlations of the sites
        drawn = {name: np.full(1, np.nan) for name in measured}
    return {
        name: Figure(float(value), _rms_about(drawn[name], float(value)))
        for name, value in measured.items()
    }
