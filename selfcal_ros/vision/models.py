# SPDX-License-Identifier: Apache-2.0
"""Image models of marks: blurred shapes with derivatives, all lengths in pixels.

A shape is 1 inside the mark and 0 outside, blurred by a Gaussian whose variance includes that of
the pixel, 1/12. The image of a mark is (b + a s) (1 + gx u + gy v): ground, contrast and a linear
illumination.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

PIXEL_VARIANCE = 1 / 12
"""Variance of the position within a pixel, px²."""
SMALLEST_BLUR = 0.05
"""Smallest blur of a fit, px."""
TWO_PI_ROOT = np.sqrt(2 * np.pi)

Shaped = tuple[np.ndarray, np.ndarray]
"""Value (n,) and derivatives (n, 2 + parameters): centre u, centre v, then its parameters."""


@dataclass(frozen=True)
class MarkModel:
    """The shape of one kind of mark.

    Attributes
    ----------
    names : tuple of str
        Its parameters: lengths, then perhaps ``angle``, last ``blur``.
    shape : callable (u, v, parameters) -> Shaped
        The shape at points relative to the centre.
    start : callable (size, width, angle, blur) -> array
        Parameters of a nominal mark.
    reach : float
        Radius of the part of the image that is fitted, in sizes of the mark.
    turns : float
        Angle after which the mark looks the same; 0 = always.
    """

    names: tuple[str, ...]
    shape: Callable[[np.ndarray, np.ndarray, np.ndarray], Shaped]
    start: Callable[[float, float, float, float], np.ndarray]
    reach: float
    turns: float


def _edge(distance: np.ndarray, blur: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a blurred step, 0 at negative distances, its slope, and its derivative by the blur."""
    variance = blur * blur + PIXEL_VARIANCE
    sigma = np.sqrt(variance)
    slope = np.exp(distance * distance / (-2 * variance)) / (sigma * TWO_PI_ROOT)
    return ndtr(distance / sigma), slope, -slope * distance * (blur / variance)


def _bar(along: np.ndarray, length: float, blur: float) -> tuple[np.ndarray, ...]:
    """Return a blurred bar of a length, and its derivatives by position, length and blur."""
    low, low_slope, low_blur = _edge(along + length / 2, blur)
    high, high_slope, high_blur = _edge(along - length / 2, blur)
    return low - high, low_slope - high_slope, (low_slope + high_slope) / 2, low_blur - high_blur


def _disc(u: np.ndarray, v: np.ndarray, p: np.ndarray) -> Shaped:
    radius = np.hypot(u, v)
    inside, slope, by_blur = _edge(p[0] / 2 - radius, p[1])
    outward = slope / np.maximum(radius, 1e-9)
    return inside, np.stack([outward * u, outward * v, slope / 2, by_blur], axis=1)


def _ring(u: np.ndarray, v: np.ndarray, p: np.ndarray) -> Shaped:
    """Parameters: outer diameter, width of the line, blur."""
    outer, by_outer = _disc(u, v, p[[0, 2]])
    inner, by_inner = _disc(u, v, np.array([p[0] - 2 * p[1], p[2]]))
    by = by_outer - by_inner
    return outer - inner, np.insert(by, 3, 2 * by_inner[:, 2], axis=1)


def _turned(u: np.ndarray, v: np.ndarray, angle: float,
            ) -> tuple[np.ndarray, np.ndarray, float, float]:
    cosine, sine = np.cos(angle), np.sin(angle)
    return cosine * u + sine * v, cosine * v - sine * u, cosine, sine


def _cross(u: np.ndarray, v: np.ndarray, p: np.ndarray) -> Shaped:
    """Parameters: length of the bars, their width, angle of the first one, blur."""
    length, width, angle, blur = p
    a, b, cosine, sine = _turned(u, v, angle)
    long_a, long_b = _bar(a, length, blur), _bar(b, length, blur)
    wide_a, wide_b = _bar(a, width, blur), _bar(b, width, blur)
    only_a, only_b = long_a[0] - wide_a[0], long_b[0] - wide_b[0]
    shape = long_a[0] * wide_b[0] + wide_a[0] * only_b
    by_a = long_a[1] * wide_b[0] + wide_a[1] * only_b
    by_b = long_b[1] * wide_a[0] + wide_b[1] * only_a
    by_length = long_a[2] * wide_b[0] + wide_a[0] * long_b[2]
    by_width = only_a * wide_b[2] + wide_a[2] * only_b
    by_blur = (long_a[3] * wide_b[0] + only_a * wide_b[3] + wide_a[3] * only_b
               + wide_a[0] * long_b[3])
    return shape, np.stack([sine * by_b - cosine * by_a, -sine * by_a - cosine * by_b, by_length,
                            by_width, by_a * b - by_b * a, by_blur], axis=1)


def _corner(u: np.ndarray, v: np.ndarray, p: np.ndarray) -> Shaped:
    """Parameters: angle of the first edge, blur; squares 1 and 3 between the edges are inside."""
    a, b, cosine, sine = _turned(u, v, p[0])
    (over_a, slope_a, blur_a), (over_b, slope_b, blur_b) = _edge(a, p[1]), _edge(b, p[1])
    odd_a, odd_b = 2 * over_a - 1, 2 * over_b - 1
    by_a, by_b = slope_a * odd_b, odd_a * slope_b
    return (1 + odd_a * odd_b) / 2, np.stack([
        sine * by_b - cosine * by_a, -sine * by_a - cosine * by_b, by_a * b - by_b * a,
        blur_a * odd_b + odd_a * blur_b], axis=1)


MODELS = {
    "disc": MarkModel(("size", "blur"), _disc,
                      lambda size, width, angle, blur: np.array([size, blur]), 0.75, 0.0),
    "ring": MarkModel(("size", "width", "blur"), _ring,
                      lambda size, width, angle, blur: np.array([size, width, blur]), 0.75, 0.0),
    "cross": MarkModel(("size", "width", "angle", "blur"), _cross,
                       lambda size, width, angle, blur: np.array([size, width, angle, blur]),
                       0.75, np.pi / 2),
    "corner": MarkModel(("angle", "blur"), _corner,
                        lambda size, width, angle, blur: np.array([angle, blur]), 0.6, np.pi),
}
"""Kind of mark -> its model."""
