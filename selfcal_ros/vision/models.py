# SPDX-License-Identifier: Apache-2.0
"""Image models of marks: blurred shapes with derivatives, all lengths in pixels.

A shape is 1 inside the mark and 0 outside, blurred by a Gaussian whose variance includes that of
the pixel, 1/12. The image of a mark is (b + a s) (1 + gx u + gy v): ground, contrast and a linear
illumination.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

PIXEL_VARIANCE = 1 / 12
"""Variance of the position within a pixel, px²."""
SMALLEST_BLUR = 0.05
"""Smallest blur of a fit, px."""
TWO_PI_ROOT = np.sqrt(2 * np.pi)
ERF_TERM = 0.3275911 / np.sqrt(2)
ERF_SERIES = (0.5307027145, -0.7265760135, 0.7107068705, -0.142248368, 0.127414796)
"""Abramowitz and Stegun, 7.1.26: p and half of a5 to a1, for the normal distribution."""

Shaped = tuple[np.ndarray, np.ndarray]
"""Value (n,) and derivatives (2 + parameters, n): centre u, centre v, then its parameters.

Of many marks at once (marks, n) and (2 + parameters, marks, n), from parameters (parameters,
marks, 1).
"""

Value = float | np.ndarray
"""A parameter: of one mark, or (marks, 1) of many."""


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


def _edge(
    distance: np.ndarray, blur: Value
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a blurred step, 0 at negative distances, its slope, and its derivative by the blur.

    The normal distribution is Abramowitz and Stegun's 7.1.26, within 1e-7: a third of the time of
    scipy's, as its exponential is that of the slope.
    """
    variance = blur * blur + PIXEL_VARIANCE
    sigma = np.sqrt(variance)
    bell = np.exp(distance * distance / (-2 * variance))
    term = np.abs(distance)
    term *= ERF_TERM / sigma
    term += 1
    np.reciprocal(term, out=term)
    tail = ERF_SERIES[0] * term
    for coefficient in ERF_SERIES[1:]:
        tail += coefficient
        tail *= term
    tail *= bell
    bell *= 1 / (sigma * TWO_PI_ROOT)
    return (
        np.where(distance > 0, 1 - tail, tail),
        bell,
        bell * distance * (-blur / variance),
    )


def _bars(
    along: np.ndarray, sides: tuple[Value, Value], blur: Value
) -> tuple[np.ndarray, ...]:
    """Return blurred bars of two lengths, and their derivatives by position, length and blur."""
    half = np.stack(np.broadcast_arrays(*map(np.atleast_1d, sides)))[:, None] / 2
    ends, slopes, by_blur = _edge(np.stack([along + half, along - half]), blur)
    return (
        ends[0] - ends[1],
        slopes[0] - slopes[1],
        (slopes[0] + slopes[1]) / 2,
        by_blur[0] - by_blur[1],
    )


def _disc(u: np.ndarray, v: np.ndarray, p: np.ndarray) -> Shaped:
    radius = np.hypot(u, v)
    inside, slope, by_blur = _edge(p[0] / 2 - radius, p[1])
    outward = slope / np.maximum(radius, 1e-9)
    return inside, np.stack([outward * u, outward * v, slope / 2, by_blur])


def _ring(u: np.ndarray, v: np.ndarray, p: np.ndarray) -> Shaped:
    """Parameters: outer diameter, width of the line, blur."""
    radius = np.hypot(u, v)
    inside, slope, by_blur = _edge(
        np.stack([p[0] / 2 - radius, p[0] / 2 - p[1] - radius]), p[2]
    )
    change = slope[0] - slope[1]
    outward = change / np.maximum(radius, 1e-9)
    return inside[0] - inside[1], np.stack(
        [outward * u, outward * v, change / 2, slope[1], by_blur[0] - by_blur[1]]
    )


def _turned(
    u: np.ndarray, v: np.ndarray, angle: Value
) -> tuple[np.ndarray, np.ndarray, Value, Value]:
    cosine, sine = np.cos(angle), np.sin(angle)
    return cosine * u + sine * v, cosine * v - sine * u, cosine, sine


def _cross(u: np.ndarray, v: np.ndarray, p: np.ndarray) -> Shaped:
    """Parameters: length of the bars, their width, angle of the first one, blur."""
    length, width, angle, blur = p
    a, b, cosine, sine = _turned(u, v, angle)
    (
        ((long_a, long_b), (wide_a, wide_b)),
        (to_long, to_wide),
        (by_long, by_wide),
        (blur_long, blur_wide),
    ) = _bars(np.stack([a, b]), (length, width), blur)
    only_a, only_b = long_a - wide_a, long_b - wide_b
    shape = long_a * wide_b + wide_a * only_b
    by_a = to_long[0] * wide_b + to_wide[0] * only_b
    by_b = to_long[1] * wide_a + to_wide[1] * only_a
    by_length = by_long[0] * wide_b + wide_a * by_long[1]
    by_width = only_a * by_wide[1] + by_wide[0] * only_b
    by_blur = (
        blur_long[0] * wide_b
        + only_a * blur_wide[1]
        + blur_wide[0] * only_b
        + wide_a * blur_long[1]
    )
    return shape, np.stack(
        [
            sine * by_b - cosine * by_a,
            -sine * by_a - cosine * by_b,
            by_length,
            by_width,
            by_a * b - by_b * a,
            by_blur,
        ]
    )


def _corner(u: np.ndarray, v: np.ndarray, p: np.ndarray) -> Shaped:
    """Parameters: angle of the first edge, blur; squares 1 and 3 between the edges are inside."""
    a, b, cosine, sine = _turned(u, v, p[0])
    (over_a, over_b), (slope_a, slope_b), (blur_a, blur_b) = _edge(
        np.stack([a, b]), p[1]
    )
    odd_a, odd_b = 2 * over_a - 1, 2 * over_b - 1
    by_a, by_b = slope_a * odd_b, odd_a * slope_b
    return (1 + odd_a * odd_b) / 2, np.stack(
        [
            sine * by_b - cosine * by_a,
            -sine * by_a - cosine * by_b,
            by_a * b - by_b * a,
            blur_a * odd_b + odd_a * blur_b,
        ]
    )


MODELS = {
    "disc": MarkModel(
        ("size", "blur"),
        _disc,
        lambda size, width, angle, blur: np.array([size, blur]),
        0.75,
        0.0,
    ),
    "ring": MarkModel(
        ("size", "width", "blur"),
        _ring,
        lambda size, width, angle, blur: np.array([size, width, blur]),
        0.75,
        0.0,
    ),
    "cross": MarkModel(
        ("size", "width", "angle", "blur"),
        _cross,
        lambda size, width, angle, blur: np.array([size, width, angle, blur]),
        0.75,
        np.pi / 2,
    ),
    "corner": MarkModel(
        ("angle", "blur"),
        _corner,
        lambda size, width, angle, blur: np.array([angle, blur]),
        0.6,
        np.pi,
    ),
}
"""Kind of mark -> its model."""
