# SPDX-License-Identifier: Apache-2.0
"""The angular map between its lines: linear, a periodic cubic spline, or its Fourier series.

With the basis 1, cos t, sin t, ..., cos H t, sin H t (method eq. 14.1).
"""

import math

import numpy as np

from selfcal_ros.compensation.cells import SNAP, cubic_pieces
from selfcal_ros.errors import InputError

MAX_SLOPE = 0.25
"""Largest slope between neighbours accepted by the inverse: the fixed point converges fast."""


def fourier_basis(angle_rad: np.ndarray, harmonics: int) -> np.ndarray:
    """Return 1, cos t, sin t, ..., cos H t, sin H t at angles t of any shape, (..., 2 H + 1)."""
    turned = np.asarray(angle_rad)[..., None] * np.arange(1, harmonics + 1)
    out = np.ones((*turned.shape[:-1], 2 * harmonics + 1))
    out[..., 1::2], out[..., 2::2] = np.cos(turned), np.sin(turned)
    return out


def fourier_coefficients(values: np.ndarray, harmonics: int) -> np.ndarray:
    """Return the coefficients of a series of H < K/2 harmonics from K values, (2 H + 1, ...).

    Parameters
    ----------
    values : float array (K, ...)
        At equidistant angles from 0.
    harmonics : int
        H.
    """
    count = len(values)
    basis = fourier_basis(np.arange(count) * (2 * np.pi / count), harmonics)
    basis[:, 0] /= 2  # the sines and cosines have the mean square 1/2
    return np.tensordot(basis.T, values, axes=1) * (2 / count)


class Circle:
    """A periodic function given at K equidistant angles from 0.

    Parameters
    ----------
    values : float array (K,)
        Its values; NaN where unknown.
    cubic : bool
        Whether it is a cubic spline between them, or linear.
    harmonics : int
        Harmonics of the Fourier series that it is instead; 0 = none.
    """

    def __init__(self, values: np.ndarray, *, cubic: bool, harmonics: int) -> None:
        self._count = len(values)
        self._holes = bool(np.isnan(values).any())
        self._closed = np.append(values, values[:1])
        self._points: list[float] = self._closed.tolist()
        if cubic and not np.isfinite(values).all():
            raise InputError(
                "error map",
                f"{int((~np.isfinite(values)).sum())} angular lines are unknown",
                "bicubic needs all of them: use bilinear",
            )
        steps = np.abs(np.diff(self._closed))
        if np.any(steps > MAX_SLOPE * 2 * np.pi / max(self._count, 1)):
            raise steep("angular lines")
        self._series = None
        if harmonics:
            of = fourier_coefficients(values, harmonics)
            # Re of powers of e^(it)
            self._series = np.append(of[:1], of[1::2] - 1j * of[2::2])
        cubic &= self._count > 0 and not harmonics
        self._pieces = cubic_pieces(values, periodic=True) if cubic else None
        self._piece_points = None if self._pieces is None else self._pieces.T.tolist()

    def at(self, angle_rad: np.ndarray) -> np.ndarray:
        """Return the values at `angle_rad`, any shape; NaN next to unknown lines."""
        if self._series is not None:
            turn = np.exp(1j * np.where(np.isfinite(angle_rad), angle_rad, np.nan))
            value = np.zeros(np.shape(turn), dtype=complex)
            for factor in self._series[::-1]:
                value = value * turn + factor
            return value.real
        s = angle_rad * (self._count / (2 * np.pi))
        s = np.where(np.isfinite(s), s, np.nan)
        if self._holes:
            s = np.where(np.abs(s - np.round(s)) < SNAP, np.round(s), s)
        below = np.floor(s)
        u = s - below
        with np.errstate(invalid="ignore"):
            # A position that is not finite becomes some integer; u is NaN and so is the result.
            i = below.astype(np.int64) % self._count
        if self._pieces is not None:
            c = self._pieces[:, i]
            return ((c[3] * u + c[2]) * u + c[1]) * u + c[0]
        low = self._closed[i]
        high = self._closed[i + 1]
        # A line of zero weight is ignored, so that a known line stays known.
        return np.where(u == 0, low, low + u * (high - low))

    def at_point(self, angle_rad: float) -> float:
        """Return `at` of one finite angle."""
        if self._series is not None or self._holes:
            return float(self.at(np.asarray(angle_rad)))
        s = angle_rad * (self._count / (2 * np.pi))
        below = math.floor(s)
        u = s - below
        i = below % self._count
        if self._piece_points is not None:
            c0, c1, c2, c3 = self._piece_points[i]
            return ((c3 * u + c2) * u + c1) * u + c0
        low = self._points[i]
        high = self._points[i + 1]
        return low if u == 0 else low + u * (high - low)


def steep(places: str) -> InputError:
    """Return the refusal of a map that cannot be inverted."""
    return InputError(
        "error map",
        f"the error changes between neighbouring {places} by more than a quarter of their distance",
        "such a map cannot be inverted: check its units (m, rad)",
    )
