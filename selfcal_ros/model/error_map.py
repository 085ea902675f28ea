# SPDX-License-Identifier: Apache-2.0
"""The calibrated error map of the stage, its uncertainty, and the modes of its datum.

NaN means unknown. No view determines the modes (method eqs. 3.1-3.3); slopes of the half axes
are those of eq. 3.7.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from selfcal_ros.model.artifact import Artifact

COVERAGE = 0.9545
"""Coverage of an expanded uncertainty: k = 2 for many degrees of freedom."""

MANY_DOF = 1e9
"""Finite substitute for infinite degrees of freedom in the tails of F and t."""


def rms(values: np.ndarray) -> float:
    """Return the root mean square of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


class ThetaDatum(StrEnum):
    """Condition that fixes the constant of the angular map (method eqs. 3.6, 3.7)."""

    XY_AXES = "xy_axes"
    ZERO_MEAN = "zero_mean"


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """Stage error G = indicated - true at the sites, stage frame.

    Datum: no translation, rotation or magnification (Hu eq. 5), unless a reference
    length sets the scale; theta by `datum_theta`.

    Attributes
    ----------
    artifact : Artifact
        Lattice of the sites.
    gx, gy : float array (nx, ny)
        Error at site m = i - Nx//2, n = j - Ny//2, m; NaN where unknown.
    u_gx, u_gy : float array (nx, ny)
        Standard uncertainties (k=1), m.
    g_theta, u_g_theta : float array (K,)
        Angular error at line k and its standard uncertainty, rad; NaN where unknown.
    nonorthogonality, scale_difference : float
        O and R of Hu eq. 6: Gx = O y + R x + Fx, Gy = O x - R y + Fy.
    datum_theta : ThetaDatum
        Convention behind `g_theta`.
    """

    artifact: Artifact
    gx: np.ndarray
    gy: np.ndarray
    u_gx: np.ndarray
    u_gy: np.ndarray
    g_theta: np.ndarray = field(default_factory=lambda: np.zeros(0))
    u_g_theta: np.ndarray = field(default_factory=lambda: np.zeros(0))
    nonorthogonality: float = 0.0
    scale_difference: float = 0.0
    datum_theta: ThetaDatum = ThetaDatum.ZERO_MEAN

    @classmethod
    def of_maps(
        cls,
        artifact: Artifact,
        xy: tuple[np.ndarray, np.ndarray],
        theta: tuple[np.ndarray, np.ndarray],
    ) -> "ErrorMap":
        """Return a map with its O and R, from Gx, Gy (2, nx, ny), Gtheta (K,) and their u."""
        (gx, gy), (u_gx, u_gy) = xy
        o, r = first_order(artifact, xy[0])
        return cls(artifact, gx, gy, u_gx, u_gy, *theta, o, r)

    @property
    def u_xy(self) -> np.ndarray:
        """Standard uncertainty of both coordinates, (2, nx, ny), m."""
        return np.stack([self.u_gx, self.u_gy])

    @property
    def valid(self) -> np.ndarray:
        """Sites whose error is known, bool (nx, ny)."""
        return np.isfinite(self.gx) & np.isfinite(self.gy)

    def of(self, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """Return one of the maps and its u, (2, nx, ny) of ``xy``, (1, K) of ``theta``."""
        if kind == "xy":
            return np.stack([self.gx, self.gy]), np.stack([self.u_gx, self.u_gy])
        return self.g_theta[None], self.u_g_theta[None]


def datum_modes(artifact: Artifact, *, scale: bool) -> np.ndarray:
    """Return the rigid modes of a map, (modes, 2, nx, ny): two translations, rotation, scale.

    Parameters
    ----------
    artifact : Artifact
        Lattice of the map.
    scale : bool
        Whether magnification belongs to the datum (stage: yes, plate: no).
    """
    x, y = artifact.x_m, artifact.y_m
    ones, zeros = np.ones(artifact.shape), np.zeros(artifact.shape)
    modes = [(ones, zeros), (zeros, ones), (-y, x)]
    return np.array([*modes, (x, y)] if scale else modes)


def datum_columns(
    artifact: Artifact, kind: str, known_places: np.ndarray, *, scale: bool
) -> np.ndarray:
    """Return the modes of the datum over known places as columns, (values, modes).

    Parameters
    ----------
    artifact : Artifact
        Lattice of the map.
    kind : str
        ``xy``, or ``theta``, whose datum is a constant.
    known_places : bool array (nx, ny) or (K,)
        Places of the values: Gx, then Gy of these sites, or these lines.
    scale : bool
        Whether magnification belongs to the datum.
    """
    if kind == "theta":
        return np.ones((int(known_places.sum()), 1))
    modes = datum_modes(artifact, scale=scale)[:, :, known_places]
    return modes.reshape(len(modes), -1).T


def remove_modes(field_m: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Return `field_m` (2, nx, ny) minus its least-squares part in `modes`, over known sites.

    Sites with NaN stay NaN and are ignored. With the modes of `datum_modes` the result
    satisfies Hu eq. 5 (stage) or eq. 11 (plate).
    """
    known_sites = np.isfinite(field_m).all(axis=0)
    basis = modes[:, :, known_sites].reshape(len(modes), -1).T
    basis = basis / np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
    coefficients = np.linalg.lstsq(basis, field_m[:, known_sites].ravel(), rcond=None)[
        0
    ]
    out = field_m.copy()
    out[:, known_sites] -= (basis @ coefficients).reshape(2, -1)
    return out


def first_order(artifact: Artifact, g_m: np.ndarray) -> tuple[float, float]:
    """Return O and R (Hu eq. 6) of a map (2, nx, ny), m; NaN where it is unknown."""
    known_sites = np.isfinite(g_m).all(axis=0)
    half_m = float(np.abs([artifact.x_m, artifact.y_m]).max())
    x, y = artifact.x_m / half_m, artifact.y_m / half_m
    rigid = datum_modes(artifact, scale=True)
    rigid[2:] /= half_m
    modes = np.concatenate([rigid, [(y, x), (x, -y)]])[:, :, known_sites]
    rows = modes.reshape(len(modes), -1)
    # A few sites may not separate the modes: the smallest coefficients that fit.
    inverse = np.linalg.pinv(rows @ rows.T, rcond=1e-12, hermitian=True)
    coefficients = inverse @ (rows @ g_m[:, known_sites].ravel())
    return float(coefficients[4]) / half_m, float(coefficients[5]) / half_m


def half_axis_slopes(artifact: Artifact, g_m: np.ndarray) -> np.ndarray:
    """Return the slopes of the XY error along the half axes +X, +Y, -X, -Y, rad (Hu eq. 27).

    They are the angular errors at lines 0, K/4, K/2, 3K/4: ordinary least squares with
    intercept; +Gy on x along +-X, -Gx on y along +-Y. NaN if a half axis has only one site, or
    none: along a side with an even number of sites no site lies on the other axis.

    Parameters
    ----------
    artifact : Artifact
        Lattice of the map.
    g_m : float array (2, nx, ny, ...)
        XY error, m; further axes are kept.
    """
    if not all(size % 2 for size in artifact.shape):
        return np.full((4, *g_m.shape[3:]), np.nan)
    hx, hy = artifact.middle
    # eq. 27 prints the lines as 1, 1 + K/4, ...; eq. 9 counts them from 0
    along = (
        g_m[1, hx + 1 :, hy],
        -g_m[0, hx, hy + 1 :],
        g_m[1, :hx, hy],
        -g_m[0, hx, :hy],
    )
    return np.stack([_slope(line, artifact.grid_pitch_m) for line in along])


def _slope(values: np.ndarray, pitch_m: float) -> np.ndarray:
    """Return the slope of equidistant values (n, ...) along their first axis."""
    n = len(values)
    if n < 2:
        return np.full(values.shape[1:], np.nan)
    steps = (np.arange(1, n + 1) - (n + 1) / 2) * pitch_m
    return np.tensordot(steps / (steps @ steps), values, axes=1)


def slope_rows(z_m: np.ndarray, known_sites: np.ndarray) -> np.ndarray:
    """Return the slopes of `half_axis_slopes` as rows over the sites, complex (4, nx, ny).

    The row of a half axis with fewer than two known sites is zero.

    Parameters
    ----------
    z_m : complex array (nx, ny)
        Site positions, m.
    known_sites : bool array (nx, ny)
        Sites to use.
    """
    hx, hy = (size // 2 for size in z_m.shape)
    out = np.zeros((4, *z_m.shape), dtype=complex)
    halves = (
        (np.s_[hx + 1 :, hy], 1j),
        (np.s_[hx, hy + 1 :], -1),
        (np.s_[:hx, hy], 1j),
        (np.s_[hx, :hy], -1),
    )
    for row, (half_axis, unit) in zip(out, halves, strict=True):
        good = known_sites[half_axis]
        if good.sum() >= 2:
            at = (z_m[half_axis].real + z_m[half_axis].imag) * good
            centred = (at - at.sum() / good.sum()) * good
            row[half_axis] = unit * centred / (centred @ centred)
    return out


CELL_MEAN = 8 / 15
"""Mean square over a cell of the error of interpolation, as a share of that halfway."""
_LINEAR = {1: 1.0}
_CUBIC = {1: 9 / 8, 3: -1 / 8}
"""Weights of the pairs of neighbours at a distance in pitches, which predict a node."""
_SMOOTH = 1 / 4
"""Error of linear interpolation over a pitch, as a share of that over two, of a smooth function."""
SHOWN_AT_EDGE = 16.0
"""Mean square at an edge, over the largest one inside and its own noise, that is no chance: with
two rows inside, less than 1 in 200 smooth stages reaches it anywhere."""
FEWEST_ROWS = 4
"""Nodes along an axis that have two neighbours: two inside tell what occurs there."""


def along_axes(
    error: Callable[[np.ndarray, np.ndarray], object], error_map: ErrorMap
) -> np.ndarray:
    """Return `error` of the nodes of Gx and Gy and their u, along x and along y, (2, 2, ...)."""
    emap = error_map
    return np.array(
        [
            [error(np.moveaxis(g, axis, 0), np.moveaxis(u, axis, 0)) for axis in (0, 1)]
            for g, u in ((emap.gx, emap.u_gx), (emap.gy, emap.u_gy))
        ]
    )


def error_halfway(
    values: np.ndarray, u: np.ndarray, *, cubic: bool = False, ring: bool = False
) -> tuple[float, float]:
    """Return the rms and the largest error of interpolation halfway between nodes.

    A node minus the value interpolated from its neighbours is the error over two pitches. Over one
    pitch it is taken to shrink as from four to two: by 4 for a smooth function, not at all if
    the nodes are independent; a cubic spline shrinks it by the square of that. What the noise of
    the nodes explains is subtracted. Fewer than seven nodes: as linear.

    Parameters
    ----------
    values, u : float array (n, ...)
        Nodes along the first axis and their standard uncertainties; NaN where unknown.
    cubic : bool
        Whether the interpolation is a cubic spline.
    ring : bool
        Whether the first node follows the last one, as the lines of an angular map.
    """
    over_two, over_four = (
        _squares(values, u, _LINEAR, pitches, ring) for pitches in (1, 2)
    )
    if not len(over_two):
        return 0.0, 0.0
    coarse = float(over_four.mean()) if len(over_four) else 0.0
    shrunk = (
        np.clip(over_two.mean() / coarse, _SMOOTH**2, 1.0) if coarse > 0 else _SMOOTH**2
    )
    if cubic and (ring or len(values) > 2 * max(_CUBIC)):
        over_two = _squares(values, u, _CUBIC, 1, ring)
        shrunk = shrunk**2
        if not len(over_two):
            return 0.0, 0.0
    mean, largest = np.sqrt(shrunk * np.maximum([over_two.mean(), over_two.max()], 0.0))
    return float(mean), float(largest)


def error_at_edges(values: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the error halfway in the first and last cell that the edge node alone feels, (2,).

    An error that begins within the last cell makes the last node depart from its course. No
    reading shows where it begins, so nothing is taken to shrink from two pitches to one. 0 unless
    the departure is beyond all that occur inside.

    Parameters
    ----------
    values, u : float array (n, ...)
        As for `error_halfway`.
    """
    if len(values) - 2 < FEWEST_ROWS:
        return np.zeros(2)
    square, noise = (
        part.reshape(len(part), -1)
        for part in _departures(values, u, _LINEAR, 1, ring=False)
    )
    unknown = ~np.isfinite(square - noise)
    square, noise = (
        np.ma.masked_array(part, unknown).mean(axis=1).filled(0.0)
        for part in (square, noise)
    )
    excess = np.maximum(square - noise, 0.0)
    edges = [0, -1]
    is_shown = square[edges] > SHOWN_AT_EDGE * (excess[1:-1].max() + noise[edges])
    return np.where(is_shown, np.sqrt(excess[edges]), 0.0)


def _squares(
    values: np.ndarray,
    u: np.ndarray,
    weights: dict[int, float],
    pitches: int,
    ring: bool,
) -> np.ndarray:
    """Return the squared errors of known nodes predicted from neighbours, less noise, (k,)."""
    error_square, noise = _departures(values, u, weights, pitches, ring)
    square = error_square - noise
    return square[np.isfinite(square)]


def _departures(
    values: np.ndarray,
    u: np.ndarray,
    weights: dict[int, float],
    pitches: int,
    ring: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared errors of nodes predicted from neighbours, and their noise."""
    reach = pitches * max(weights)
    if ring:
        values, u = (np.pad(series, reach, mode="wrap") for series in (values, u))
    n = len(values)
    middle = slice(reach, max(n - reach, reach))
    error = values[middle]
    power = u[middle] ** 2
    for distance, weight in weights.items():
        low, high = (
            slice(reach + step, max(n - reach, reach) + step)
            for step in (-pitches * distance, pitches * distance)
        )
        error = error - weight * (values[low] + values[high]) / 2
        power = power + weight**2 * (u[low] ** 2 + u[high] ** 2) / 4
    return error**2, power


def share_between(position: np.ndarray) -> np.ndarray:
    """Return the error of interpolation at positions in pitches, as a share of that halfway.

    The parabola 4 s (1 - s) over a cell, with the mean square `CELL_MEAN`: 0 at the nodes.
    """
    fraction = position - np.floor(position)
    return 4 * fraction * (1 - fraction)
