# SPDX-License-Identifier: Apache-2.0
"""Candidates for marks: correlation of a reduced image with templates of the mark."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import fft

from selfcal_ros.errors import InputError
from selfcal_ros.vision.models import MODELS

REDUCED_SIZE = 8
"""Smallest size of a mark in the reduced image, px."""
CORRELATION = 0.6
"""Smallest correlation with a template."""
NOISES = 8.0
"""Smallest amplitude of a candidate, in standard deviations of its own noise."""
QUANTUM = 0.3
"""Standard deviation of rounding to grey values, at least that of noise."""
FAINT = 0.05
"""Smallest amplitude of a candidate relative to the largest one."""
PEAKS = 10
"""Largest number of peaks of the correlation, over that of candidates: each takes some time."""
ANGLES = 6
"""Number of templates over the turns of a mark."""
MARGIN, APART = 0.7, 0.6
"""Half the side of a template, and smallest distance between two candidates, in sizes."""
TEMPLATE_BLUR = 0.08
"""Blur of a template, in sizes."""


@dataclass(frozen=True)
class Candidate:
    """Place of a possible mark in the image, px, and its angle, rad."""

    column: int
    row: int
    angle: float


def reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Return the means of blocks of `factor` x `factor` pixels, float32."""
    if factor == 1:
        return image.astype(np.float32)
    height, width = (side // factor * factor for side in image.shape)
    rows = np.zeros((height // factor, width), dtype=np.uint32)
    for first in range(factor):
        rows += image[first:height:factor, :width]
    sums = np.zeros((height // factor, width // factor), dtype=np.uint32)
    for first in range(factor):
        sums += rows[:, first::factor]
    return (sums / (factor * factor)).astype(np.float32)


@dataclass(frozen=True)
class _Template:
    """A mark of norm 1 and mean 0 in a square, and the transform that correlates with it."""

    angle: float
    square: np.ndarray
    transform: np.ndarray


@lru_cache(maxsize=16)
def _templates(
    mark: str, size: float, width: float, shape: tuple[int, int], sign: int
) -> list[_Template]:
    """Return the templates over the turns of a mark.

    Those of the second half of the turns of a mark without sign, a corner, are the negatives of
    those of the first half.
    """
    model = MODELS[mark]
    half = _half(size)
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    templates = []
    angles = np.arange(ANGLES if sign else ANGLES // 2) * model.turns / ANGLES
    for angle in angles if model.turns else [0.0]:
        value = (sign or 1) * model.shape(
            u.ravel(),
            v.ravel(),
            model.start(size, width, float(angle), TEMPLATE_BLUR * size),
        )[0]
        value = value - value.mean()
        square = (value / np.sqrt(value @ value)).reshape(u.shape).astype(np.float32)
        padded = np.zeros(shape, dtype=np.float32)
        padded[: 2 * half + 1, : 2 * half + 1] = square
        templates.append(
            _Template(
                float(angle),
                square,
                np.conj(fft.rfft2(np.roll(padded, (-half, -half), (0, 1)))),
            )
        )
    return templates


def _half(size: float) -> int:
    return int(np.ceil(MARGIN * size))


def _reflected(image: np.ndarray, half: int) -> np.ndarray:
    """Return the image with a reflected border, of a size with a fast transform."""
    pad = [
        (half, fft.next_fast_len(side + 2 * half, real=True) - side - half)
        for side in image.shape
    ]
    return np.pad(image, pad, mode="symmetric")


def candidates(
    image: np.ndarray, *, mark: str, size: float, width: float, sign: int, most: int
) -> list[Candidate]:
    """Return the candidates for marks, row by row.

    Parameters
    ----------
    image : uint8 or uint16 array (h, w)
        The image.
    mark : str
        Kind of mark.
    size, width : float
        Its size and the width of its lines, px.
    sign : int
        1 for marks brighter than the ground, -1 for darker ones, 0 for both.
    most : int
        Largest number of candidates.

    Raises
    ------
    InputError
        If there are more.
    """
    factor = max(1, int(size / REDUCED_SIZE))
    half = _half(size / factor)
    if min(image.shape) // factor <= half:
        return []
    small = reduced(image, factor)
    small -= small.mean()
    padded = _reflected(small, half)
    templates = _templates(mark, size / factor, width / factor, padded.shape, sign)
    best = _correlated(padded, templates, sign)[
        half : half + small.shape[0], half : half + small.shape[1]
    ]
    amplitude = max(
        NOISES * max(_noise(small), QUANTUM / factor), FAINT * float(best.max())
    )
    peaks = (best > amplitude) & (best == _largest(best, round(APART * size / factor)))
    if np.count_nonzero(peaks) > PEAKS * most:
        raise too_many(most)
    rows, columns = np.nonzero(peaks)
    squares = np.lib.stride_tricks.sliding_window_view(
        padded, (2 * half + 1, 2 * half + 1)
    )[rows, columns].reshape(len(rows), (2 * half + 1) ** 2)
    norms = squares.shape[1] ** 0.5 * np.maximum(squares.std(axis=1, dtype=float), 1e-3)
    similar = best[rows, columns] > CORRELATION * norms
    if np.count_nonzero(similar) > most:
        raise too_many(most)
    near = (
        squares[similar]
        @ np.stack([template.square.ravel() for template in templates]).T
    )
    which = np.argmax(np.abs(near) if sign == 0 else near, axis=1)
    return [
        Candidate(
            round((column + _vertex(best[row, :], column) + 0.5) * factor - 0.5),
            round((row + _vertex(best[:, column], row) + 0.5) * factor - 0.5),
            templates[nearest].angle,
        )
        for row, column, nearest in zip(
            rows[similar].tolist(),
            columns[similar].tolist(),
            which.tolist(),
            strict=True,
        )
    ]


def too_many(most: int) -> InputError:
    """Return the error that an image shows more possible marks than `most`."""
    return InputError(
        "image",
        f"more than {most} possible marks",
        "check mark_size and pixel_size, or set max_marks",
    )


def _correlated(
    padded: np.ndarray, templates: list[_Template], sign: int
) -> np.ndarray:
    """Return the largest correlation of each place with a template; without sign, absolute."""
    transform = fft.rfft2(padded)
    best = np.full(padded.shape, -np.inf, dtype=np.float32)
    for template in templates:
        correlation = fft.irfft2(transform * template.transform, padded.shape)
        np.maximum(
            best,
            correlation if sign else np.abs(correlation, out=correlation),
            out=best,
        )
    return best


def _largest(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the largest value of the square of side 2 `reach` + 1 around each place."""
    side = 2 * reach + 1
    for _ in range(2):
        values = np.pad(values.T, ((reach, reach), (0, 0)), constant_values=-np.inf)
        width = 1  # of the maxima so far
        while width < side:
            step = min(width, side - width)
            values = np.maximum(values[:-step], values[step:])
            width = width + step
    return values


def _vertex(row: np.ndarray, peak: int) -> float:
    """Return the vertex of the parabola through a peak and its neighbours, relative to it."""
    if not 0 < peak < len(row) - 1:
        return 0.0
    before, top, after = row[peak - 1 : peak + 2].tolist()
    return (
        (before - after) / (2 * (before - 2 * top + after))
        if before + after < 2 * top
        else 0.0
    )


def _noise(image: np.ndarray) -> float:
    """Return the standard deviation of the noise of a pixel, from second differences."""
    second = image[:, 2:] - 2 * image[:, 1:-1] + image[:, :-2]
    return 1.4826 * float(np.median(np.abs(second[::2, ::2]))) / np.sqrt(6)
