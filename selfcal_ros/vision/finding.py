# SPDX-License-Identifier: Apache-2.0
"""Candidates for marks: correlation of a reduced image with templates of the mark."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import fft, ndimage

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
ANGLES = 6
"""Number of templates over the turns of a mark."""
MARGIN, APART = 0.7, 0.6
"""Half the side of a template, and smallest distance between two candidates, in sizes."""
TEMPLATE_BLUR = 0.08
"""Blur of a template, in sizes."""


@dataclass(frozen=True)
class Candidate:
    """Place of a possible mark in the image, px, its angle, rad, and correlation."""

    column: int
    row: int
    angle: float
    correlation: float


def reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Return the means of blocks of `factor` x `factor` pixels, float32."""
    if factor == 1:
        return image.astype(np.float32)
    height, width = (side // factor * factor for side in image.shape)
    rows = image[:height, :width].reshape(height // factor, factor, width)
    sums = rows.sum(axis=1, dtype=np.uint32)
    sums = sums.reshape(-1, width // factor, factor).sum(axis=2, dtype=np.uint32)
    return (sums / (factor * factor)).astype(np.float32)


@lru_cache(maxsize=16)
def _templates(mark: str, size: float, width: float, shape: tuple[int, int],
               ) -> tuple[list[tuple[float, np.ndarray]], int]:
    """Return angle and transform of each template, of norm 1 and mean 0, and half its side."""
    model, half = MODELS[mark], int(np.ceil(MARGIN * size))
    v, u = np.mgrid[-half:half + 1, -half:half + 1].astype(float)
    found = []
    for angle in np.arange(ANGLES) * model.turns / ANGLES if model.turns else [0.0]:
        value = model.shape(u.ravel(), v.ravel(), model.start(
            size, width, float(angle), TEMPLATE_BLUR * size))[0]
        value = value - value.mean()
        padded = np.zeros(shape, dtype=np.float32)
        padded[:2 * half + 1, :2 * half + 1] = (value / np.sqrt(value @ value)).reshape(u.shape)
        found.append((float(angle), np.conj(fft.rfft2(np.roll(padded, (-half, -half), (0, 1))))))
    return found, half


def _reflected(image: np.ndarray, half: int) -> np.ndarray:
    """Return the image with a reflected border, of a size with a fast transform."""
    pad = [(half, fft.next_fast_len(side + 2 * half, real=True) - side - half)
           for side in image.shape]
    return np.pad(image, pad, mode="symmetric")


def candidates(image: np.ndarray, *, mark: str, size: float, width: float, sign: int,
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
    """
    factor = max(1, int(size / REDUCED_SIZE))
    small = reduced(image, factor)
    small -= small.mean()
    half = int(np.ceil(MARGIN * size / factor))
    if min(small.shape) <= half:
        return []
    padded = _reflected(small, half)
    templates, _ = _templates(mark, size / factor, width / factor, padded.shape)
    transform = fft.rfft2(padded)
    part = (slice(half, half + small.shape[0]), slice(half, half + small.shape[1]))
    best, which = np.full(small.shape, -np.inf, dtype=np.float32), np.zeros(small.shape, np.int8)
    for number, (_, template) in enumerate(templates):
        found = fft.irfft2(transform * template, padded.shape)[part].astype(np.float32)
        found = np.abs(found) if sign == 0 else sign * found
        better = found > best
        best[better], which[better] = found[better], number
    norm = _norm(small, half)
    correlation = best / norm
    peaks = ndimage.maximum_filter(best, 2 * round(APART * size / factor) + 1) == best
    amplitude = max(NOISES * max(_noise(small), QUANTUM / factor), FAINT * float(best.max()))
    good = peaks & (correlation > CORRELATION) & (best > amplitude)
    found_at = []
    for row, column in zip(*np.nonzero(good), strict=True):
        finer = (float(column) + _vertex(best[row, :], column),
                 float(row) + _vertex(best[:, column], row))
        found_at.append(Candidate(
            round((finer[0] + 0.5) * factor - 0.5), round((finer[1] + 0.5) * factor - 0.5),
            templates[which[row, column]][0], float(correlation[row, column])))
    return found_at


def _vertex(row: np.ndarray, peak: int) -> float:
    """Return the vertex of the parabola through a peak and its neighbours, relative to it."""
    if not 0 < peak < len(row) - 1:
        return 0.0
    before, at, after = row[peak - 1:peak + 2].tolist()
    return (before - after) / (2 * (before - 2 * at + after)) if before + after < 2 * at else 0.0


def _norm(image: np.ndarray, half: int) -> np.ndarray:
    """Return the root of the sum of squared deviations in the square around each pixel."""
    side = 2 * half + 1
    mean = ndimage.uniform_filter(image, side, mode="reflect")
    square = ndimage.uniform_filter(image * image, side, mode="reflect")
    return side * np.sqrt(np.maximum(square - mean * mean, 1e-6))


def _noise(image: np.ndarray) -> float:
    """Return the standard deviation of the noise of a pixel, from second differences."""
    second = image[:, 2:] - 2 * image[:, 1:-1] + image[:, :-2]
    return 1.4826 * float(np.median(np.abs(second[::2, ::2]))) / np.sqrt(6)
